"""The model card: what is known of a model, from its evaluation, as Markdown and in the model file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from shortfinal.detector import METADATA_KEY, ModelInfo
from shortfinal.errors import InputError
from shortfinal.evaluate.figures import LIGHTS, is_share

Evidence = Mapping[str, Any]  # the content of evaluation.json
CARD_KEY = "shortfinal.card"  # of the ONNX metadata


def model_card(evidence: Evidence) -> str:
    """What is known of a model, or of predictions made elsewhere, as Markdown, from evaluation.json's content.

    Its parts are those of Mitchell et al., "Model Cards for Model Reporting" (2019). Intervals are of 95 %.
    """
    subject = evidence["subject"]
    parts = (
        _about(evidence), _use(evidence), _training(subject), _evaluation_data(evidence), _figures(evidence),
        _calibration(evidence), _limitations(evidence), _not_to_conclude(evidence),
    )  # fmt: skip
    head = f"# Model card: {_plain(subject['name'])}\n\nForm: Mitchell et al., Model Cards for Model Reporting, 2019."
    written = f"Written from the evaluation of {_plain(evidence['created'])} by shortfinal {evidence['version']}."
    return "\n\n".join((f"{head} {written}", *parts)) + "\n"


_HEADLINE = (  # of all rows
    "error_px.mean", "error_px.median", "error_px.q90", "error_px.q99", "error_input_px.median", "sigma_px.median",
    "nll", "nees", "coverage.68", "coverage.95", "use", "do_not_use", "not_monitored", "missing", "alarm",
    "distance_relative.median", "along_m.q95", "cross_m.q95", "vertical_m.q95", "over_level", "available", "hazardous",
    "detection.far_threshold_184m", "latency_ms.median", "latency_ms.q95",
)  # fmt: skip
_BY_GROUP = ("error_px.median", "error_px.q90", "coverage.95", "use")
_WORSE = {"error_px.median": 1, "far_error_px.median": 1, "coverage.95": -1, "use": -1, "over_level": 1}  # which way
_KINDS = ("distance", "glide", "airport", "light")
_MOST_GROUPS = 12  # of each kind in a table


def _about(evidence: Evidence) -> str:
    subject, info = evidence["subject"], evidence["subject"]["model"]
    facts = [("file", subject["name"]), ("SHA-256", subject["sha256"]), ("sigma", subject["sigma"])]
    if info is None:
        what = "Predictions made elsewhere: the corners of runways with their uncertainty. The network is not at hand."
    else:
        what = (
            "A network that finds the corners of a runway in a picture, and says how uncertain it is of each. "
            "From these a pose is solved, and the integrity test decides whether it may be used."
        )
        calibration = info["calibration"]
        facts += [
            ("backbone", info["backbone"]),
            ("input", f"{info['size']} × {info['size']} px, a crop of {info['margin']} times the runway's box"),
            ("keypoints", ", ".join(info["keypoints"])),
            ("covariance predicted", info["covariance"]),
            ("precision", info["precision"]),
            ("calibration in the file", "none" if calibration is None else f"fitted on {calibration['fitted_on']}"),
        ]
    return f"## What it is\n\n{what}\n\n{_table(('', ''), facts)}"


def _use(evidence: Evidence) -> str:
    seen = {m["group"] for m in evidence["metrics"] if m["by"] == "light"}
    unseen = [light for light in LIGHTS if light not in seen]
    light = f"; of light: {', '.join(unseen)}" if unseen else ""
    outside = [
        "Runways whose corners or size are not known beforehand; taxiways, helipads.",
        "Any picture in which the runway's corners cannot be made out.",
        "As the only ground for a landing, or without the integrity test.",
        f"Conditions that the evaluation data does not hold{light if seen else '; of their light nothing is known'}.",
    ]
    return (
        "## Intended use\n\nResearch on, and development and testing of, vision-based landing: one camera, "
        "a runway of known size, on the approach. For engineers, not for operators. "
        "It has not been approved for any operation.\n\n"
        f"## Out of scope\n\n{_bullets(outside)}"
    )


def _training(subject: Mapping[str, Any]) -> str:
    info = subject["model"]
    text = "Not known."
    if info is not None and info["training"]:
        facts = [(name, ", ".join(map(str, v)) if isinstance(v, list) else v) for name, v in info["training"].items()]
        text = f"As the model file says:\n\n{_table(('', ''), facts)}"
        text += "\n\nWhat these pictures show, and whose they are, the file does not say."
    return f"## Training data\n\n{text}"


def _evaluation_data(evidence: Evidence) -> str:
    data, counts = evidence["data"], evidence["counts"]
    airports = sorted(data["airports"].items(), key=lambda item: (-item[1], item[0]))
    facts = [
        ("data", f"{data['name']} ({data['format']})"),
        ("pictures, labelled runways", f"{data['pictures']}, {data['labels']}"),
        ("predicted, missing", f"{counts['predicted']}, {counts['missing']}"),
        ("left out or doubtful", ", ".join(f"{n} {kind}" for kind, n in sorted(counts["problems"].items())) or "none"),
        ("airports", _names([f"{name or 'no name'} ({rows})" for name, rows in airports]) or "none named"),
    ]
    apart = "Whether any of these airports or pictures was trained on is not recorded here."
    return f"## Evaluation data\n\n{_table(('', ''), facts)}\n\n{apart}"


def _figures(evidence: Evidence) -> str:
    overall = _of(evidence, "all")
    rows = [(name, *_cells(overall[name])) for name in _HEADLINE if name in overall]
    text = f"## Figures\n\n{_table(('figure', 'value', '95 % interval', 'of'), rows)}"
    text += "\n\nThe last column counts what a figure is of: coordinates (eight to a runway) or runways."
    for kind in _KINDS:
        groups = dict.fromkeys(m["group"] for m in evidence["metrics"] if m["by"] == kind)
        shown = [name for name in _BY_GROUP if any((kind, name) == (m["by"], m["name"]) for m in evidence["metrics"])]
        if groups and shown:
            lines = []
            for group in list(groups)[:_MOST_GROUPS]:
                found = _of(evidence, kind, group)
                lines.append((group, *(_brief(found.get(name)) for name in shown)))
            left = (
                f"\n\nand {len(groups) - _MOST_GROUPS} more in evaluation.json." if len(groups) > _MOST_GROUPS else ""
            )
            text += f"\n\nBy {kind}:\n\n{_table((kind, *shown), lines)}{left}"
    return text


def _calibration(evidence: Evidence) -> str:
    overall, curve = _of(evidence, "all"), evidence["calibration"]
    rows = []
    for level in (50, 68, 90, 95, 99):
        metric = overall.get(f"coverage.{level}")
        if metric is not None and metric["value"] is not None:
            off = 100 * metric["value"] - level
            rows.append((f"{level} %", *_cells(metric)[:2], f"{off:+.1f} points"))
    text = f"Sigma is {_plain(evidence['subject']['sigma'])}."
    if not rows:
        return f"## Calibration\n\n{text} No errors to hold it against."
    table = _table(("claimed", "found", "95 % interval", "off"), rows)
    text += f" Of the errors within the interval that sigma claims:\n\n{table}"
    pairs = [
        (nominal, seen) for nominal, seen in zip(curve["nominal"], curve["observed"], strict=True) if seen is not None
    ]
    if pairs:
        nominal, seen = max(pairs, key=lambda pair: abs(pair[1] - pair[0]))
        side = "too bold" if seen < nominal else "too cautious"
        text += f"\n\nFarthest off at {_share(nominal)}: {_share(seen)} found, {side}."
    if overall.get("nees", {}).get("value") is not None:
        text += f" Mean eᵀΣ⁻¹e per coordinate: {overall['nees']['value']:.3g}; 1 is right, more is too bold."
    return f"## Calibration\n\n{text}"


def _limitations(evidence: Evidence) -> str:
    counts, overall = evidence["counts"], _of(evidence, "all")
    rows = [
        row for kind in _KINDS for name, way in _WORSE.items() if (row := _worst(evidence, overall, kind, name, way))
    ]
    text = "## Limitations found in the data"
    if rows:
        head = ("figure", "worst group", "there", "95 % interval", "of all", "clearly worse")
        text += f"\n\n{_table(head, rows)}\n\nClearly: its interval and that of all do not meet."
    else:
        text += "\n\nNo groups to compare: of what is worse where, nothing is known."
    found = (
        [f"{counts['missing']} of {counts['labels']} labelled runways have no prediction."] if counts["missing"] else []
    )
    for name, what in (("do_not_use", "refused"), ("not_monitored", "not monitored")):
        if overall.get(name, {}).get("value"):
            found.append(f"{_value(overall[name])} of the runways are {what}.")
    for name, what in (("over_level", "accepted errors exceed their level"), ("hazardous", "rows are hazardous")):
        if overall.get(name, {}).get("value"):
            found.append(f"{_value(overall[name])}: {what}.")
    for record in evidence["requirements"] or ():
        if record["result"] != "shown":
            what = f"Requirement {record['id']} ({record['metric']}, {record['where']})"
            found.append(f"{what} {record['result']}: {record['why']}.")
    found += [str(note) for note in evidence["notes"]]
    return text + (f"\n\n{_bullets(found)}" if found else "")


def _not_to_conclude(evidence: Evidence) -> str:
    overall = _of(evidence, "all")
    lines = [
        "That it does as well elsewhere. The figures are of this data; intervals say what chance in drawing it may "
        "have done, not what other airports, weather, cameras or seasons do.",
        "That an accepted picture is right. The test sees only errors that do not fit a pose of the runway.",
        "That a group without its own rows is covered by the figures of all.",
        "That a figure whose interval is wide, or absent, is good because its estimate is.",
        "That it meets a standard or may be flown. This card is evidence for those who decide that.",
    ]
    over = overall.get("over_level")
    if over is not None and over["value"] == 0:
        most = (
            "" if over["high"] is None else f": {over['count']} rows without one do not exclude {_share(over['high'])}"
        )
        lines.append(
            f"That errors never exceed their protection levels{most}. Risks of 10⁻⁷ cannot be counted like this."
        )
    if "fitted here" in evidence["subject"]["sigma"]:
        lines.append(
            "That sigma is honest: it was fitted to these very errors, so that their coverage is right by itself."
        )
    if not any(name in overall for name in ("along_m.q95", "cross_m.q95", "vertical_m.q95")):
        lines.append("Anything of errors in metres: the data holds no true poses that could be compared.")
    return f"## What must not be concluded\n\n{_bullets(lines)}"


def _worst(evidence: Evidence, overall: Mapping[str, Any], kind: str, name: str, way: int) -> tuple[str, ...] | None:
    """The group of a kind with the worst figure, unless there is none to compare it with."""
    groups = [m for m in evidence["metrics"] if (m["by"], m["name"]) == (kind, name) and m["value"] is not None]
    whole = overall.get(name)
    if len(groups) < 2 or whole is None or whole["value"] is None:
        return None
    worse = [m for m in groups if way * m["value"] > way * whole["value"]]
    if not worse:
        return None
    # Of few rows any figure may come: what is clearly worse goes before what merely is.
    worst = max(worse, key=lambda m: (_clearly_worse(m, whole, way), way * m["value"]))
    value, interval, _ = _cells(worst)
    clearly = "yes" if _clearly_worse(worst, whole, way) else "no"
    return name, f"{kind}: {worst['group']}", value, interval, _value(whole), clearly


def _clearly_worse(group: Mapping[str, Any], whole: Mapping[str, Any], way: int) -> bool:
    low, high = (group["low"], whole["high"]) if way > 0 else (whole["low"], group["high"])
    return None not in (low, high) and bool(low > high)


def _of(evidence: Evidence, by: str, group: str | None = None) -> dict[str, Mapping[str, Any]]:
    return {m["name"]: m for m in evidence["metrics"] if m["by"] == by and group in (None, m["group"])}


def _cells(metric: Mapping[str, Any]) -> tuple[str, str, str]:
    """Value, interval, count."""
    low, high = metric["low"], metric["high"]
    ends = (_number(low, metric), _number(high, metric))
    return _value(metric), "too few to say" if low is None and high is None else " to ".join(ends), str(metric["count"])


def _brief(metric: Mapping[str, Any] | None) -> str:
    if metric is None or metric["value"] is None:
        return "–"
    value, interval, _ = _cells(metric)
    return f"{value} ({interval})"


def _value(metric: Mapping[str, Any]) -> str:
    unit = "" if not metric["unit"] or metric["value"] is None else f" {metric['unit']}"
    return f"{_number(metric['value'], metric)}{unit}"


def _number(value: float | None, metric: Mapping[str, Any]) -> str:
    if value is None:
        return "–"
    return _share(value) if is_share(metric["name"]) else f"{value:.3g}"


def _share(value: float) -> str:
    return f"{100 * value:.3g} %"


def _names(names: list[str]) -> str:
    more = len(names) - _MOST_GROUPS
    return ", ".join(names[:_MOST_GROUPS]) + (f" and {more} more" if more > 0 else "")


def _table(head: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    head = tuple(head)
    lines = (head, ("---",) * len(head), *rows)
    return "\n".join(f"| {' | '.join(_plain(cell) for cell in line)} |" for line in lines)


def _bullets(lines: Iterable[str]) -> str:
    return "\n".join(f"- {_plain(line)}" for line in lines)


def _plain(text: object) -> str:
    """In one line, nothing of it taken for Markdown's tables or HTML."""
    line = " ".join(str(text).split())
    return line.replace("&", "&amp;").replace("<", "&lt;").replace("|", "\\|")


# The card's place in the model file


def with_card(model: bytes, card: str) -> bytes:
    """A model file's content with `card` in its metadata, in place of any it has; needs no package onnx.

    All else stays byte by byte, so that `without_card` of the result is the file that was evaluated. `shortfinal
    calibrate` writes the metadata anew, and leaves the card out: its figures are of other sigmas.
    Raises InputError if `card` is empty, or the content is no ONNX model that describes itself.
    """
    if not card.strip():
        raise InputError("card: it is empty")
    bare = without_card(model)
    description = _metadata(bare).get(METADATA_KEY)
    if description is None:
        raise InputError(f"model: not one of ours: no {METADATA_KEY!r} metadata; see `shortfinal export`")
    ModelInfo.from_json(description, "model")
    # In protobuf's encoding, what is appended to a repeated field is one more of it.
    entry = _chunk(1, CARD_KEY.encode()) + _chunk(2, card.encode())
    return bare + _chunk(_METADATA_PROPS, entry)


def without_card(model: bytes) -> bytes:
    """A model file's content with no card in it. Raises InputError if it is no ONNX model."""
    kept = (model[start:end] for start, end, key, _ in _entries(model) if key != CARD_KEY)
    return b"".join(kept)


def card_of(model: bytes) -> str | None:
    """The card in a model file's content, if there is one. Raises InputError if it is no ONNX model."""
    return _metadata(model).get(CARD_KEY)


_METADATA_PROPS = 14  # the field of ONNX's ModelProto; each entry has its key in field 1, its value in field 2


def _metadata(model: bytes) -> dict[str, str]:
    return {key: value for _, _, key, value in _entries(model) if key is not None}


def _entries(model: bytes) -> Iterator[tuple[int, int, str | None, str]]:
    """The model's fields in order: start, end, and of an entry of the metadata its key and value."""
    try:
        for number, start, body, end in _fields(model):
            key, value = None, ""
            if number == _METADATA_PROPS:
                entry = model[body:end]
                parts = {n: entry[b:e].decode() for n, _, b, e in _fields(entry)}
                key, value = parts.get(1, ""), parts.get(2, "")
            yield start, end, key, value
    except (IndexError, UnicodeDecodeError) as error:
        raise InputError("model: not an ONNX model: its content cannot be read as one") from error


def _fields(content: bytes) -> Iterator[tuple[int, int, int, int]]:
    """The fields of a protobuf message: number, start, start of its content, end. IndexError if it is none."""
    at = 0
    while at < len(content):
        start = at
        tag, at = _varint(content, at)
        kind, body = tag & 7, at
        if kind == 0:
            _, at = _varint(content, at)
        elif kind == 2:
            size, body = _varint(content, at)
            at = body + size
        elif kind in (1, 5):
            at += 8 if kind == 1 else 4
        else:
            raise IndexError(kind)
        if at > len(content):
            raise IndexError(at)
        yield tag >> 3, start, body, at


def _varint(content: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = content[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at


def _chunk(number: int, content: bytes) -> bytes:
    """A field of bytes: tag, length, content."""
    encoded, size = bytearray([number << 3 | 2]), len(content)
    while size > 127:
        encoded.append(size & 127 | 128)
        size >>= 7
    encoded.append(size)
    return bytes(encoded) + content
