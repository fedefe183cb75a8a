import json
import os

import numpy as np
import pymap3d
import pytest

import shortfinal as sf
from shortfinal.runway import lard_database

HOME = (48.0, 2.0, 100.0)


def place(points, heading_deg):
    """Runway-frame points to WGS84, by a route of its own: local east, north, up at HOME."""
    h = np.radians(heading_deg)
    along, left, up = np.asarray(points, float).T
    east = along * np.sin(h) - left * np.cos(h)
    north = along * np.cos(h) + left * np.sin(h)
    return np.column_stack(pymap3d.enu2geodetic(east, north, up, *HOME))


def database(tmp_path):
    lla = place(sf.Runway(2000, 45).corners, 240)
    entry = {
        name: {"coordinate": dict(zip(("latitude", "longitude", "altitude"), lla[k], strict=True))}
        for name, k in zip("CDBA", range(4), strict=True)
    }
    path = tmp_path / "runways.json"
    path.write_text(json.dumps({"LFPO": {"24": entry, "02": entry}}))
    return path


def test_a_flat_runway_in_the_order_of_its_corners():
    expected = [[0, 30, 0], [0, -30, 0], [1500, -30, 0], [1500, 30, 0]]
    np.testing.assert_array_equal(sf.Runway(1500, 60).corners, expected)


def test_edges_run_from_the_near_end_to_the_far_one():
    left, right = sf.Runway(1500, 60).edges
    np.testing.assert_array_equal(left, [[0, 30, 0], [1500, 30, 0]])
    np.testing.assert_array_equal(right, [[0, -30, 0], [1500, -30, 0]])


@pytest.mark.parametrize(
    ("length", "width", "begin", "half"),
    [
        (3000, 45, 400, 15),
        (2400, 45, 400, 15),
        (2399, 45, 300, 15),
        (1200, 30, 300, 13),  # narrowed: 2 m to the edge
        (1199, 30, 250, 10.5),
        (799, 23, 150, 7),
    ],
)
def test_the_aiming_point_stands_where_annex_14_puts_it(length, width, begin, half):
    expected = [[begin, half, 0], [begin, -half, 0], [begin + 45, -half, 0], [begin + 45, half, 0]]
    np.testing.assert_allclose(sf.Runway(length, width).aiming_point, expected, atol=1e-9)


def test_the_aiming_point_lies_on_a_sloping_runway():
    corners = [[0, 22.5, 0], [0, -22.5, 1], [2000, -22.5, 21], [2000, 22.5, 20]]
    marking = sf.Runway(2000, 45, corners=corners).aiming_point
    np.testing.assert_allclose(marking[:, 2], 0.01 * marking[:, 0] + 0.5 - marking[:, 1] / 45)


@pytest.mark.parametrize("size", [(190, 20), (3000, 20), (600, 9)])
def test_a_runway_too_small_has_no_aiming_point(size):
    with pytest.raises(sf.InputError, match="no room for an aiming point"):
        _ = sf.Runway(*size).aiming_point


@pytest.mark.parametrize("heading", [0, 57, 183, 300])
@pytest.mark.parametrize("order", [(0, 1, 2, 3), (1, 0, 3, 2), (0, 1, 3, 2)])
def test_wgs84_corners_come_back_in_metres_whichever_side_was_listed_first(heading, order):
    truth = np.array([[0, 22.5, 0], [0, -22.5, 0], [2500, -22.5, 8], [2500, 22.5, 8]])
    runway = sf.Runway.from_corners_wgs84(place(truth, heading)[list(order)], "TEST/01")
    np.testing.assert_allclose(runway.corners, truth, atol=1e-6)
    assert runway.length_m == pytest.approx(2500, abs=1e-6)
    assert runway.width_m == pytest.approx(45, abs=1e-6)


def test_thresholds_give_the_same_runway_as_corners():
    ends = place([[0, 0, 0], [2500, 0, 8]], 75)
    runway = sf.Runway.from_thresholds_wgs84(*ends, width_m=45)
    np.testing.assert_allclose(runway.corners[2], [2500, -22.5, 8], atol=1e-6)


def test_look_up_by_name(tmp_path, monkeypatch):
    path = database(tmp_path)
    assert sf.find_runway("LFPO/24", path).length_m == pytest.approx(2000, abs=1e-6)
    monkeypatch.setenv("SHORTFINAL_RUNWAYS", str(path))
    assert sf.find_runway("lfpo-24").ident == "LFPO/24"
    assert sf.find_runway("LFPO/2").ident == "LFPO/02"  # in the file as "02"


@pytest.mark.parametrize(
    ("ident", "message"),
    [
        ("LFPO/06", r"unknown runway 'LFPO/06'; nearest: LFPO/02, LFPO/24$"),
        ("LFPO", "nearest: LFPO/02, LFPO/24$"),
        ("LFPG/24", "unknown runway 'LFPG/24'; nearest: LFPO/24$"),
        ("LFP/2", "nearest: LFPO/02$"),
        ("KJFK/24", "unknown runway 'KJFK/24'$"),
    ],
)
def test_an_unknown_runway_names_the_nearest(tmp_path, ident, message):
    with pytest.raises(sf.InputError, match=message):
        sf.find_runway(ident, database(tmp_path))


def test_the_files_faults_are_named(tmp_path, monkeypatch):
    monkeypatch.delenv("SHORTFINAL_RUNWAYS", raising=False)
    with pytest.raises(sf.InputError, match="SHORTFINAL_RUNWAYS"):
        sf.find_runway("LFPO/24")
    with pytest.raises(sf.InputError, match="cannot read"):
        sf.find_runway("LFPO/24", tmp_path / "absent.json")
    (tmp_path / "bad.json").write_text("{")
    with pytest.raises(sf.InputError, match="not a JSON"):
        sf.find_runway("LFPO/24", tmp_path / "bad.json")
    with pytest.raises(sf.InputError, match="no WGS84 coordinate"):
        lard_database({"AAAA": {"01": {"A": {}}}}, "database").find("AAAA/01")


def test_a_file_is_read_again_when_it_has_changed(tmp_path):
    path = database(tmp_path)
    sf.find_runway("LFPO/24", path)
    path.write_text(path.read_text().replace("LFPO", "LFPG"))
    os.utime(path, ns=(0, 0))
    assert sf.find_runway("LFPG/24", path).ident == "LFPG/24"


@pytest.mark.parametrize("displaced", [-1, float("nan"), float("inf")])
def test_a_displacement_is_not_negative(displaced):
    with pytest.raises(sf.InputError, match=r"displaced_m is .*; it must be >= 0"):
        sf.Runway(2000, 45, displaced_m=displaced)


@pytest.mark.parametrize("size", [(0, 45), (2000, -1), (float("nan"), 45)])
def test_a_size_must_be_positive(size):
    with pytest.raises(sf.InputError, match="must be > 0"):
        sf.Runway(*size)


def test_corners_that_make_no_runway_are_refused():
    lla = place([[0, 22.5, 0], [2500, -22.5, 0], [0, -22.5, 0], [2500, 22.5, 0]], 0)
    with pytest.raises(sf.InputError, match="check their order"):
        sf.Runway.from_corners_wgs84(lla)
