"""OurAirports' tables, written here from runways whose geometry is known."""

import csv
import time
from pathlib import Path

import numpy as np
import pymap3d
import pymap3d.vincenty
import pytest

import shortfinal as sf
from shortfinal.airports import FOOT_M
from shortfinal.runway import load_database

LARD = Path(__file__).resolve().parents[2] / "shared/data/lard_runways.json"
HOME = (48.72, 2.37, 90.0)
END = ("ident", "latitude_deg", "longitude_deg", "elevation_ft", "heading_degT", "displaced_threshold_ft")
COLUMNS = ("id", "airport_ref", "airport_ident", "length_ft", "width_ft", "surface", "lighted", "closed")
COLUMNS += tuple(f"{end}_{name}" for end in ("le", "he") for name in END)
AIRPORT_COLUMNS = ("id", "ident", "type", "name", "elevation_ft", "icao_code", "iata_code", "gps_code", "local_code")


def position(along, rise, heading_deg):
    """Latitude, longitude (degrees), height (m) of a point of a centreline that begins at HOME."""
    h = np.radians(heading_deg)
    lat, lon, _ = pymap3d.enu2geodetic(along * np.sin(h), along * np.cos(h), 0, *HOME)
    return lat, lon, HOME[2] + rise


def row(
    airport="LFPO", names=("06", "24"), heading=64.0, length=3320.0, rise=4.0, width=45.0, displaced=(0, 0), **other
):
    """A row of runways.csv: the low-numbered end at HOME, with as many digits as OurAirports gives at its best."""
    cells = {
        "id": "1", "airport_ref": "2", "airport_ident": airport, "length_ft": f"{length / FOOT_M:.0f}",
        "width_ft": f"{width / FOOT_M:.3f}", "surface": "ASP", "lighted": "1", "closed": "0",
    }  # fmt: skip
    for k, end in enumerate(("le", "he")):
        lat, lon, height = position(k * length, k * rise, heading)
        values = (names[k], f"{lat:.8f}", f"{lon:.8f}", f"{height / FOOT_M:.3f}", f"{(heading + 180 * k) % 360:.0f}",
                  f"{displaced[k] / FOOT_M:.3f}" if displaced[k] else "")  # fmt: skip
        cells |= dict(zip((f"{end}_{name}" for name in END), values, strict=True))
    return cells | other


def write(folder, *rows, airports=()):
    """runways.csv, and airports.csv if airports are given; the folder."""
    for name, columns, lines in (("runways.csv", COLUMNS, rows), ("airports.csv", AIRPORT_COLUMNS, airports)):
        if lines:
            with (folder / name).open("w", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, columns, quoting=csv.QUOTE_NONNUMERIC, restval="")
                writer.writeheader()
                writer.writerows(lines)
    return folder


# Geometry


@pytest.mark.parametrize("heading", [3.0, 64.0, 95.0, 178.0])
@pytest.mark.parametrize("displaced", [(0, 0), (300, 0), (0, 450), (300, 450)])
def test_both_directions_of_a_known_runway(tmp_path, heading, displaced):
    """Length, width, both elevations and displaced thresholds come back within what the digits hold."""
    length, rise, width = 3320.0, 12.0, 45.0
    number = round(heading / 10) or 36
    names = (f"{number:02d}", f"{number + 18:02d}")
    write(tmp_path, row(names=names, heading=heading, rise=rise, displaced=displaced))
    for k, direction in enumerate(names):
        runway = sf.find_runway(f"LFPO/{direction}", tmp_path)
        assert runway.ident == f"LFPO/{direction}"
        assert runway.displaced_m == pytest.approx(displaced[k], abs=1e-3)
        # Heights differ by 90 m from the ellipsoid's, which stretches the runway by 90 / 6.4e6 of itself.
        assert runway.length_m == pytest.approx(length - displaced[k], abs=0.01)
        assert runway.width_m == pytest.approx(width, abs=1e-3)
        # The far end: its own elevation, less the Earth's curvature over the distance.
        landed = length - displaced[k]
        climb = (rise if k == 0 else -rise) * landed / length
        drop = landed**2 / 2 / 6.37e6
        assert runway.corners[2:, 2].mean() == pytest.approx(climb - drop, abs=0.01)
        np.testing.assert_allclose(runway.corners[:2], [[0, 22.5, 0], [0, -22.5, 0]], atol=1e-3)


def test_the_displaced_threshold_lies_on_the_centreline(tmp_path):
    """Against a geodesic: far north, a line straight in latitude and longitude would be 0.4 m beside it."""
    a, b = (70.0, 25.0, 0.0), pymap3d.vincenty.vreckon(70.0, 25.0, 4000.0, 90.0)
    ends = {"le_latitude_deg": a[0], "le_longitude_deg": a[1], "le_elevation_ft": 0,
            "he_latitude_deg": b[0], "he_longitude_deg": b[1], "he_elevation_ft": 0}  # fmt: skip
    write(tmp_path, row(names=("09", "27"), heading=90, length=4000, rise=0, displaced=(2000, 0), **ends))
    threshold, _, displaced = load_database(tmp_path).airports["LFPO"]["09"][0].ends_wgs84()
    assert displaced == pytest.approx(2000, abs=1e-3)
    middle = pymap3d.vincenty.vreckon(70.0, 25.0, 2000.0, 90.0)
    east, north, _ = pymap3d.geodetic2enu(*threshold, *middle, 0)
    assert np.hypot(east, north) < 0.01


@pytest.mark.skipif(not LARD.exists(), reason="needs shared/data/lard_runways.json")
def test_lards_runways_come_back_from_the_middles_of_their_ends(tmp_path):
    """Every runway of LARD's database, written as OurAirports would with a threshold displaced by 250 m."""
    database = load_database(LARD)
    checked = 0
    for airport, directions in database.airports.items():
        for direction in directions:
            truth = sf.find_runway(f"{airport}/{direction}", LARD)
            corners = {k: v["coordinate"] for k, v in directions[direction][0].corners.items()}
            near, far = (middle(corners[a], corners[b]) for a, b in ("CD", "AB"))
            lat, lon, _ = pymap3d.enu2geodetic(*outwards(near, far, 250.0), *near)
            rise = (near[2] - far[2]) / truth.length_m * 250
            cells = row(airport, (direction, "H1"), width=truth.width_m, displaced=(250, 0), length_ft="",
                        le_latitude_deg=lat, le_longitude_deg=lon, le_elevation_ft=(near[2] + rise) / FOOT_M,
                        he_latitude_deg=far[0], he_longitude_deg=far[1], he_elevation_ft=far[2] / FOOT_M,
                        le_heading_degT="")  # fmt: skip
            (tmp_path / f"{checked}").mkdir()
            runway = sf.find_runway(f"{airport}/{direction}", write(tmp_path / f"{checked}", cells))
            assert runway.displaced_m == pytest.approx(250, abs=1e-3)
            # LARD's corners are no exact rectangle: their middles are compared, and the length.
            assert runway.length_m == pytest.approx(truth.length_m, abs=1e-3)
            middles, expected = (r.corners.reshape(2, 2, 3).mean(axis=1) for r in (runway, truth))
            np.testing.assert_allclose(middles, expected, atol=1e-3)
            checked += 1
    assert checked == 115


def middle(a, b):
    return tuple((a[name] + b[name]) / 2 for name in ("latitude", "longitude", "altitude"))


def outwards(near, far, distance):
    """East, north, up of a point before the near end, in line with the far one."""
    east, north, up = pymap3d.geodetic2enu(*far, *near)
    return np.array([east, north, up]) * -distance / np.hypot(east, north)


# Names

AIRPORTS = (
    {"ident": "LFPO", "name": "Paris-Orly Airport", "iata_code": "ORY", "gps_code": "LFPO", "icao_code": "LFPO"},
    {"ident": "KSEA", "name": "Seattle", "iata_code": "SEA", "gps_code": "KSEA", "local_code": "SEA"},
    {"ident": "00AK", "name": "Lowell Field", "gps_code": "00AK", "local_code": "TWIN"},
    {"ident": "FR-0123", "name": "Aérodrome d'Essai", "local_code": "TWIN"},
    {"ident": "EGLL", "name": "London Heathrow", "iata_code": "LHR", "gps_code": "EGLL"},
)  # fmt: skip


@pytest.fixture
def world(tmp_path):
    return write(
        tmp_path,
        row("LFPO", ("06", "24")),
        row("LFPO", ("02", "20"), closed="1"),
        row("LFPO", ("H1", "")),
        row("KSEA", ("16L", "34R"), heading=160),
        row("KSEA", ("16C", "34C"), heading=160),
        row("00AK", ("1", "19"), heading=10),
        row("FR-0123", ("N", "S"), heading=0),
        row("EGLL", ("09L", "27R"), heading=90, closed="1", width=20),
        row("EGLL", ("09L", "27R"), heading=90, width=50),
        airports=AIRPORTS,
    )


@pytest.mark.parametrize(
    ("asked", "ident"),
    [
        ("LFPO/24", "LFPO/24"),
        ("lfpo/6", "LFPO/06"),
        ("LFPO-06", "LFPO/06"),
        (" LFPO / 06 ", "LFPO/06"),
        ("ORY/24", "LFPO/24"),
        ("SEA/16l", "KSEA/16L"),
        ("00AK/01", "00AK/01"),
        ("00AK/1", "00AK/01"),
        ("FR-0123/N", "FR-0123/N"),
        ("FR-0123-N", "FR-0123/N"),
        ("LFPO/02", "LFPO/02"),  # closed, but there is no other of that name
    ],
)
def test_a_runway_by_any_of_its_names(world, asked, ident):
    assert sf.find_runway(asked, world).ident == ident


def test_the_file_the_folder_and_the_environment(world, monkeypatch):
    assert sf.find_runway("ORY/24", world / "runways.csv").ident == "LFPO/24"
    monkeypatch.setenv("SHORTFINAL_RUNWAYS", str(world))
    assert sf.find_runway("ORY/24").ident == "LFPO/24"
    (world / "airports.csv").unlink()
    assert sf.find_runway("LFPO/24").ident == "LFPO/24"
    with pytest.raises(sf.InputError, match="unknown runway 'ORY/24'"):
        sf.find_runway("ORY/24")


def test_an_open_runway_goes_before_a_closed_one(world):
    assert sf.find_runway("EGLL/27R", world).width_m == pytest.approx(50, abs=1e-3)


@pytest.mark.parametrize(
    ("asked", "line"),
    [
        ("KSEA/16", r"runway 'KSEA/16' is ambiguous; choose KSEA/16C or KSEA/16L"),
        ("KSEA/16R", r"unknown runway 'KSEA/16R'; nearest: KSEA/16C, KSEA/16L, KSEA/34C, KSEA/34R"),
        ("LFPO/09", r"unknown runway 'LFPO/09'; nearest: LFPO/02, LFPO/06, LFPO/20, LFPO/24"),
        ("LFPO/H1", r"nearest: LFPO/02, LFPO/06, LFPO/20, LFPO/24"),
        ("LFPO", r"nearest: LFPO/02, LFPO/06, LFPO/20, LFPO/24"),
        ("LFPG/24", r"nearest: LFPO/24 \(Paris-Orly Airport\)"),
        ("LFPG/07", r"nearest: LFPO \(Paris-Orly Airport\)"),
        ("orly/06", r"nearest: LFPO/06 \(Paris-Orly Airport\)"),
        ("SEE/34C", r"nearest: KSEA/34C \(Seattle\)"),
        ("ZZZZ/01", r"unknown runway 'ZZZZ/01'$"),
        ("TWIN/01", r"is ambiguous; choose 00AK/01 \(Lowell Field\) or FR-0123/01 \(Aérodrome d'Essai\)"),
        ("", r"unknown runway ''"),
        ("/", r"unknown runway '/'"),
    ],
)
def test_a_name_that_is_not_one_runway_says_what_to_choose(world, asked, line):
    with pytest.raises(sf.InputError, match=line) as raised:
        sf.find_runway(asked, world)
    assert "\n" not in str(raised.value)


# Holes and mistakes


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"width_ft": ""}, "line 2: width_ft is empty; fill it in, or pass width_m"),
        ({"width_ft": "0"}, "line 2: width_ft is '0'; fill it in, or pass width_m"),
        ({"width_ft": "-5"}, "width_ft is '-5'; expected a number from 0 to 2000"),
        ({"width_ft": "wide"}, "width_ft is 'wide'; expected a number"),
        ({"width_ft": "nan"}, "width_ft is 'nan'; expected a number"),
        ({"le_latitude_deg": ""}, "le_latitude_deg is empty; fill in the ends' coordinates"),
        ({"he_longitude_deg": ""}, "he_longitude_deg is empty; fill in the ends' coordinates"),
        ({"he_latitude_deg": "95"}, "he_latitude_deg is '95'; expected a number from -90 to 90"),
        ({"le_longitude_deg": "2,37"}, "le_longitude_deg is '2,37'; expected a number from -180 to 180"),
        ({"le_elevation_ft": ""}, "le_elevation_ft is empty; fill it in, or pass level=True"),
        ({"he_elevation_ft": ""}, "he_elevation_ft is empty; fill it in, or pass level=True"),
        ({"he_elevation_ft": "99999"}, "he_elevation_ft is '99999'; expected a number from -2000 to 20000"),
        ({"le_displaced_threshold_ft": "-1"}, "le_displaced_threshold_ft is '-1'; expected a number from 0 to 10"),
        ({"le_displaced_threshold_ft": "12000"}, "le_displaced_threshold_ft is '12000'; expected a number from 0"),
        ({"length_ft": "8000"}, "length_ft is '8000'; but the ends lie 1089. ft apart; correct it or the coordinates"),
        ({"he_longitude_deg": "3.37"}, "length_ft is '10892'; but the ends lie 2"),
        ({"le_heading_degT": "244"}, "le_heading_degT is '244'; but the ends lie on 64 degrees; their coordinates"),
        ({"le_heading_degT": "", "le_ident": "23"}, "le_ident is '23'; but the ends lie on 64 degrees"),
        ({"le_heading_degT": "400"}, "le_heading_degT is '400'; expected a number from 0 to 360"),
    ],
)  # fmt: skip
def test_a_hole_or_a_mistake_is_one_line(tmp_path, changes, line):
    write(tmp_path, row(**changes))
    direction = changes.get("le_ident", "06")
    with pytest.raises(sf.InputError, match=line) as raised:
        sf.find_runway(f"LFPO/{direction}", tmp_path)
    assert str(raised.value).startswith(f"{tmp_path}/runways.csv: line 2: ")
    assert "\n" not in str(raised.value)


def test_a_missing_end_can_only_be_at_the_far_end_of_no_direction(tmp_path):
    write(tmp_path, row(names=("06", ""), he_latitude_deg="", he_longitude_deg=""))
    with pytest.raises(sf.InputError, match="he_latitude_deg is empty"):
        sf.find_runway("LFPO/06", tmp_path)


def test_ends_in_one_point_are_refused_without_a_length_too(tmp_path):
    lat, lon, _ = position(0, 0, 64)
    write(tmp_path, row(length_ft="", he_latitude_deg=f"{lat:.8f}", he_longitude_deg=f"{lon:.8f}"))
    with pytest.raises(sf.InputError, match="length_ft is empty; but the ends lie 0 ft apart"):
        sf.find_runway("LFPO/06", tmp_path)


def test_what_the_caller_passes_fills_the_holes_only(tmp_path):
    write(tmp_path, row(width_ft="", le_elevation_ft="", he_elevation_ft=""), row("LFPG", displaced=(100, 0)))
    runway = sf.find_runway("LFPO/06", tmp_path, width_m=45, level=True)
    assert runway.width_m == 45
    assert runway.corners[2, 2] == pytest.approx(-(3320**2) / 2 / 6.37e6, abs=0.01)  # level but for the curvature
    known = sf.find_runway("LFPG/06", tmp_path, width_m=10, level=True)
    assert known.width_m == pytest.approx(45, abs=1e-3)
    assert known.corners[2, 2] > 2  # its own rise


def test_a_length_that_is_not_known_is_not_checked(tmp_path):
    write(tmp_path, row(length_ft=""))
    assert sf.find_runway("LFPO/06", tmp_path).length_m == pytest.approx(3320, abs=0.1)


def test_rounded_coordinates_pass(tmp_path):
    """Three decimals, as many rows have them."""
    ends = {f"{end}_{name}_deg": round(position(k * 3320, 0, 64)[i], 3)
            for k, end in enumerate(("le", "he")) for i, name in enumerate(("latitude", "longitude"))}  # fmt: skip
    write(tmp_path, row(**ends))
    assert sf.find_runway("LFPO/06", tmp_path).length_m == pytest.approx(3320, abs=120)


def test_a_row_without_an_airport_or_a_runway_harms_no_other(tmp_path):
    write(tmp_path, row("", ("", "")), row(), row("LFPG", le_latitude_deg="bad"))
    assert sf.find_runway("LFPO/06", tmp_path).ident == "LFPO/06"


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (b"", "no column airport_ident; expected LARD's runway database"),
        (b"a,b\n1,2\n", "line 1: no column airport_ident"),
        (b'"id","ident","iata_code"\n', "a list of airports; pass runways.csv, or the folder with both"),
        (b"<html>", "no column airport_ident"),
        (b"\x89PNG\r\n\x1a\n", "not a table of OurAirports"),
        (b"[1, 2]", "as in LARD's database"),
        (b'{"LFPO": 3}', "as in LARD's database"),
    ],
)
def test_a_file_that_is_no_database_is_one_line(tmp_path, content, line):
    (tmp_path / "runways.csv").write_bytes(content)
    with pytest.raises(sf.InputError, match=line) as raised:
        load_database(tmp_path)
    assert "\n" not in str(raised.value)


def test_a_column_that_is_missing_is_named(tmp_path):
    text = (write(tmp_path, row()) / "runways.csv").read_text()
    (tmp_path / "runways.csv").write_text(text.replace("he_elevation_ft", "elevation"))
    with pytest.raises(sf.InputError, match="line 1: no column he_elevation_ft"):
        load_database(tmp_path)


@pytest.mark.parametrize("cut", [30, 100, 130])
def test_a_file_cut_short_is_told_by_its_last_line(tmp_path, cut):
    content = (write(tmp_path, row(), row("LFPG")) / "runways.csv").read_bytes()
    (tmp_path / "runways.csv").write_bytes(content[:-cut])
    with pytest.raises(sf.InputError, match=r"fetch it again"):
        load_database(tmp_path)


def test_a_folder_without_the_table_is_one_line(tmp_path):
    with pytest.raises(sf.InputError, match=r"runways.csv: cannot read the runway database: No such file"):
        load_database(tmp_path)


def test_a_name_that_stands_there_twice_is_named_by_line(tmp_path):
    write(tmp_path, row(), row(width=30))
    with pytest.raises(sf.InputError, match="runway 'LFPO/06' stands there more than once, line 2 and line 3; remove"):
        sf.find_runway("LFPO/06", tmp_path)


def test_a_byte_order_mark_and_capitals_are_let_pass(tmp_path):
    text = (write(tmp_path, row("lfpo")) / "runways.csv").read_text()
    (tmp_path / "runways.csv").write_text("\ufeff" + text, encoding="utf-8")
    assert sf.find_runway("LFPO/06", tmp_path).ident == "LFPO/06"


def test_looking_up_in_fifty_thousand_rows(tmp_path):
    """After the first look, which reads the file: half a second for a hit, and for a miss with its hints."""
    letters = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
    codes = [f"{a}{b}{c}{d}" for a in "KLMN" for b in letters for c in letters for d in letters][:50_000]
    field = {"ident": "XXXX", "name": "Field XXXX", "iata_code": "XXXX"}
    write(tmp_path, row("XXXX"), airports=[field])
    for table in ("runways.csv", "airports.csv"):
        header, line = (tmp_path / table).read_text().splitlines()
        lines = [header, *(line.replace("XXXX", code) for code in codes if code != "LFPX")]
        (tmp_path / table).write_text("\n".join(lines))
    assert sf.find_runway("LFPO/06", tmp_path).ident == "LFPO/06"
    begin = time.perf_counter()
    sf.find_runway("LFPG/24", tmp_path)
    hit = time.perf_counter() - begin
    with pytest.raises(sf.InputError, match="nearest: LF"):
        sf.find_runway("LFPX/24", tmp_path)
    assert hit < 0.5
    assert time.perf_counter() - begin - hit < 0.5
