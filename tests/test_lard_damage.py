"""Thirty and more kinds of damage to a label file: each is told by file, line and field, and harms no other row."""

import re

import cv2
import numpy as np
import pytest
from test_audit import DATABASE, approach
from test_audit import RUNWAY as AUDIT_RUNWAY
from test_lard import EARTH_STUDIO, NAMED, both_row, write

import shortfinal as sf
from shortfinal.audit import audit_labels
from shortfinal.data.lard import read_labels
from shortfinal.stream.source import LabelledFolder

ROWS, BAD = 7, 4  # the row that is damaged, counted from 0: line 6
LINE = BAD + 2


def good_rows():
    rng, rows = np.random.default_rng(11), []
    for k in range(ROWS):
        pose = approach(rng)
        px = sf.project(EARTH_STUDIO, pose, AUDIT_RUNWAY.corners)
        distance = np.linalg.norm(pose.position_m)
        named = both_row(px, image=f"{k}.jpeg", slant_distance=f"{distance / 1852:.2f}", watermark_height="300.0")
        rows.append(named | {"along_track_distance": f"{-pose.position_m[0] / 1852:.2f}", "night": "", "yaw": "-8.25"})
    return rows


@pytest.fixture
def good(tmp_path):
    return write(tmp_path / "labels.csv", good_rows())


def corners(path):
    return {label.line: label.corners_px.tolist() for label in read_labels(path)}


def cell(**changes):
    """Damage to cells of the row."""

    def spoil(lines, names):
        cells = lines[LINE - 1].split(";")
        for name, value in changes.items():
            cells[names.index(name)] = value
        lines[LINE - 1] = ";".join(cells)

    return spoil


def exchange(*pairs):
    """Damage that exchanges corners of the row, by name."""

    def spoil(lines, names):
        cells = lines[LINE - 1].split(";")
        for a, b in pairs:
            for axis in "xy":
                i, j = names.index(f"{axis}_{a}"), names.index(f"{axis}_{b}")
                cells[i], cells[j] = cells[j], cells[i]
        lines[LINE - 1] = ";".join(cells)

    return spoil


def mirror(lines, names):
    cells = lines[LINE - 1].split(";")
    for corner in NAMED:
        place = names.index(f"x_{corner}")
        cells[place] = str(2447 - int(float(cells[place])))
    lines[LINE - 1] = ";".join(cells)


def line(change):
    """Damage to the row's text."""

    def spoil(lines, names):
        lines[LINE - 1] = change(lines[LINE - 1])

    return spoil


ROW_DAMAGE = {
    "short row": (line(lambda s: s.rsplit(";", 3)[0]), "cells under"),
    "long row": (line(lambda s: s + ";1;2"), "cells under"),
    "truncated row": (line(lambda s: s[: len(s) // 2]), "cells under"),
    "other delimiter": (line(lambda s: s.replace(";", ",")), "1 cells under"),
    "comment": (line(lambda s: "# taken on Monday"), "1 cells under"),
    "header again": (lambda lines, names: lines.__setitem__(LINE - 1, lines[0]), "header once more"),
    "NUL bytes": (line(lambda s: s[:9] + "\0\0" + s[11:]), "NUL byte"),
    "Latin-1 bytes": (line(lambda s: s.replace("4.jpeg", "é.jpeg").encode("latin-1")), "UTF-8"),
    "lone quotation mark": (line(lambda s: '"' + s), "quotation mark"),
    "quoted newline": (line(lambda s: s.replace("4.jpeg", '"4.\njpeg"')), "quotation mark"),
    "no image": (cell(image=""), "image is ''"),
    "image twice": (cell(image="2.jpeg"), "image is '2.jpeg'; it stands on line 4"),
    "no airport": (cell(airport=""), "airport is ''"),
    "no runway": (cell(runway=" "), "runway is ''"),
    "bad runway name": (cell(runway="2 4/L?"), "runway is '2 4/L?'"),
    "slash in the airport": (cell(airport="LFPO/24"), "airport is 'LFPO/24'"),
    "empty cell": (cell(y_BR=""), "y_BR is ''"),
    "text in a number": (cell(x_TL="left"), "x_TL is 'left'"),
    "nan": (cell(x_TL="nan"), "x_TL is 'nan'"),
    "infinite": (cell(y_TL="-inf"), "y_TL is '-inf'"),
    "decimal comma": (cell(y_TR="1204,5"), "y_TR is '1204,5'; expected a finite number, with a decimal point"),
    "thousands": (cell(x_TR="1_204"), "x_TR is '1_204'"),
    "two numbers": (cell(x_BR="1204 1205"), "x_BR is '1204 1205'"),
    "absurd corner": (cell(x_BL="-90000"), "x_BL is '-90000'; expected -2448 to 4896"),
    "huge number": (cell(y_BL="1e300"), "y_BL is '1e300'"),
    "beyond floating point": (cell(y_BL="1e999"), "y_BL is '1e999'"),
    "distance in words": (cell(slant_distance="far"), "slant_distance is 'far'"),
    "negative distance": (cell(slant_distance="-3"), "slant_distance is '-3'; expected 0 to"),
    "distance in metres": (cell(slant_distance="5556"), "slant_distance is '5556'; expected 0 to 1000"),
    "watermark nan": (cell(watermark_height="nan"), "watermark_height is 'nan'"),
    "night of two minds": (cell(night="perhaps"), "night is 'perhaps'"),
}  # fmt: skip


@pytest.mark.parametrize("kind", ROW_DAMAGE)
def test_a_damaged_row_is_refused_by_line_and_field_and_the_rest_kept(good, kind):
    spoil, words = ROW_DAMAGE[kind]
    whole = corners(good)
    lines = good.read_text().splitlines()
    spoil(lines, lines[0].split(";"))
    good.write_bytes(b"\n".join(text if isinstance(text, bytes) else text.encode() for text in lines))
    labels = read_labels(good)
    refusal = labels.refused[0]
    assert refusal.line == LINE
    assert refusal.message.startswith(f"{good}: line {LINE}: ")
    assert words in refusal.message
    assert "\n" not in refusal.message
    added = int(kind == "quoted newline")
    assert len(labels.refused) == 1 + added  # a quoted newline breaks the row in two
    moved = {at + added * (at > LINE): px for at, px in whole.items() if at != LINE}
    assert corners(good) == moved


GEOMETRY = {
    "near corners exchanged": exchange(("BL", "BR")),
    "ends exchanged": exchange(("BL", "TR"), ("BR", "TL")),
    "crossed": exchange(("TL", "TR")),
    "mirrored": mirror,
    "corners coincide": cell(x_TL="1200", y_TL="1200", x_TR="1200", y_TR="1200"),
    "all in one place": cell(**{f"{axis}_{corner}": "1200" for corner in NAMED for axis in "xy"}),
    "on a line": cell(**{f"{axis}_{corner}": str(1200 + 9 * k) for k, corner in enumerate(NAMED) for axis in "xy"}),
    "corner slipped by 200 px": cell(x_BL="100"),
    "unknown airport": cell(airport="QQQQ"),
    "unknown runway": cell(runway="36"),
}


@pytest.mark.parametrize("kind", GEOMETRY)
def test_a_row_that_reads_well_but_cannot_be_is_named_by_the_audit(good, kind):
    lines = good.read_text().splitlines()
    GEOMETRY[kind](lines, lines[0].split(";"))
    good.write_text("\n".join(lines))
    report = audit_labels(read_labels(good), DATABASE)
    assert not report.refused
    named = [a for a in report.labels if a.verdict != "passed"]
    assert [a.label.line for a in named] == [LINE]
    assert ("unknown runway" in named[0].note) == kind.startswith("unknown")
    assert bool(named[0].findings) == (not kind.startswith("unknown"))


def header(change):
    return lambda text: "\n".join([change(text.split("\n")[0]), *text.split("\n")[1:]]).encode()


FILE_DAMAGE = {
    "empty": (lambda text: b"", "empty"),
    "blank lines only": (lambda text: b"\n \n;;;\n", "empty"),
    "header only": (lambda text: text.split("\n")[0].encode(), "line 1: a header without rows"),
    "missing column": (header(lambda h: h.replace("y_BR", "p").replace("y_D", "q")), "line 1: no column"),
    "renamed column": (header(lambda h: h.replace("runway", "runwy")), "no column runway (nearest: runwy)"),
    "column twice": (header(lambda h: h.replace("y_BR", "x_BR")), "line 1: column 'x_BR' stands there twice"),
    "other delimiter": (lambda text: text.replace(";", "\t").encode(), "; or , separates them"),
    "comment before the header": (lambda text: b"# LARD\n" + text.encode(), "line 1: no column"),
    "UTF-16": (lambda text: text.encode("utf-16"), "save the file as UTF-8"),
    "UTF-16 without a mark": (lambda text: text.encode("utf-16-le"), "save the file as UTF-8"),
    "a picture": (lambda text: b"\x89PNG\r\n\x1a\n\xff\xfe", "not a text file"),
    "no good row": (
        lambda text: re.sub(r"\d+\.jpeg", "", text).encode(),
        "line 2: image is ''; expected a name (and none of the other rows is good)",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", FILE_DAMAGE)
def test_a_file_without_any_label_is_refused_whole(good, kind):
    spoil, words = FILE_DAMAGE[kind]
    good.write_bytes(spoil(good.read_text()))
    with pytest.raises(sf.InputError) as caught:
        read_labels(good)
    assert str(caught.value).startswith(f"{good}: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def interleaved(text):
    return "".join(f"{part}\n\n" for part in text.split("\n"))


HARMLESS = {
    "byte-order mark": lambda text: "\ufeff" + text,
    "Windows line ends": lambda text: text.replace("\n", "\r\n"),
    "old Macintosh line ends": lambda text: text.replace("\n", "\r"),
    "no last line end": lambda text: text.rstrip("\n"),
    "blank lines": interleaved,
    "blank lines before": lambda text: "\n\n" + text,
    "spaces": lambda text: text.replace(";", " ; "),
    "commas": lambda text: text.replace(";", ","),
    "quoted cells": lambda text: re.sub(r"(?m)^([^;\n]+)", r'"\1"', text),
    "signs and exponents": lambda text: re.sub(r";1(\d{3});", r";+1.\1e3;", text),
    "decimals": lambda text: re.sub(r";(\d{3,4})(?=[;\n])", r";\1.0", text),
    "columns more": lambda text: "".join(f"{part};x\n" for part in text.replace("x;", "x;").splitlines()),
}


@pytest.mark.parametrize("kind", HARMLESS)
def test_what_is_harmless_is_read_the_same(good, kind):
    whole = read_labels(good)
    changed = HARMLESS[kind](good.read_text())
    if kind == "columns more":
        changed = changed.replace(";x\n", ";remark\n", 1)
    good.write_bytes(changed.encode())
    labels = read_labels(good)
    assert not labels.refused
    for before, after in zip(whole, labels, strict=True):
        np.testing.assert_array_equal(before.corners_px, after.corners_px)
        assert (before.image, before.ident, before.distance_m) == (after.image, after.ident, after.distance_m)


def test_random_damage_to_one_row_never_changes_the_others(good):
    """Bytes of one line are replaced, dropped or doubled at random; names stay out of it, for a name may come twice."""
    rng, whole = np.random.default_rng(12), corners(good)
    lines = good.read_bytes().split(b"\n")
    refused = 0
    for _ in range(300):
        at = int(rng.integers(1, ROWS + 1))
        name, rest = lines[at].split(b";", 1)
        text = bytearray(rest)
        for _ in range(int(rng.integers(1, 6))):
            place = int(rng.integers(len(text)))
            byte = int(rng.choice([b for b in range(256) if b not in b"\r\n"]))
            text[place : place + int(rng.integers(2))] = bytes([byte] * int(rng.integers(3)))
        good.write_bytes(b"\n".join([*lines[:at], name + b";" + bytes(text), *lines[at + 1 :]]))
        labels = read_labels(good)
        others = {label.line: label.corners_px.tolist() for label in labels if label.line != at + 1}
        assert others == {n: px for n, px in whole.items() if n != at + 1}
        assert {r.line for r in labels.refused} <= {at + 1}
        refused += len(labels.refused)
    assert refused > 200


def test_there_are_thirty_kinds():
    assert len(ROW_DAMAGE) + len(GEOMETRY) + len(FILE_DAMAGE) >= 30


def test_a_folder_is_run_without_its_refused_rows(tmp_path, good):
    lines = good.read_text().splitlines()
    cell(x_TL="nan")(lines, lines[0].split(";"))
    good.write_text("\n".join(lines))
    for k in range(ROWS):
        cv2.imwrite(str(tmp_path / f"{k}.jpeg"), np.full((64, 64, 3), k, np.uint8))
    folder = LabelledFolder(tmp_path, good, runway=AUDIT_RUNWAY)
    assert [frame.name for frame in folder] == [f"{k}.jpeg" for k in range(ROWS) if k != BAD]
    assert [refusal.line for refusal in folder.refused] == [LINE]
