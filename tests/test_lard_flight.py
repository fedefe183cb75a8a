"""What LARD records of the flight, held against what its corners say."""

import csv

import numpy as np
import pytest
from test_audit import approach
from test_lard import DATA, SAMPLE, V1_HEAD, V2_HEAD, needs_data, v1_row, v2_row, write

import shortfinal as sf
from shortfinal.data.lard import EARTH_STUDIO, LARD_V2, read_labels, recorded_pose
from shortfinal.runway import load_database

RUNWAY = sf.Runway(2500, 45)
V2 = {"width": "1024", "height": "1024"}


def flown(pose, **more):
    """The columns of a flight on the flat Earth over a level runway."""
    x, y, z = pose.position_m
    yaw, pitch, roll = pose.attitude
    row = {
        "slant_distance": np.linalg.norm(pose.position_m) / 1852,
        "along_track_distance": -x / 1852,
        "height_above_runway": z / 0.3048,
        "lateral_path_angle": np.degrees(np.arctan2(-y, -x)),
        "yaw": yaw + 77,
        "pitch": pitch + 90,
        "roll": roll,
    }
    return {name: f"{value:.6f}" for name, value in (row | more).items()}


@pytest.mark.parametrize("seed", range(8))
def test_a_recorded_flight_of_v2_is_the_pose(tmp_path, seed):
    pose = approach(np.random.default_rng(seed))
    px = sf.project(LARD_V2, pose, RUNWAY.corners)
    (label,) = read_labels(write(tmp_path / "labels.csv", [v2_row(px, **V2, **flown(pose))]))
    recorded = recorded_pose(label, RUNWAY)
    # Six decimals of a nautical mile are 2 mm; the runway's plane is level here.
    np.testing.assert_allclose(recorded.position_m, pose.position_m, atol=0.05)
    np.testing.assert_allclose(recorded.attitude, pose.attitude, atol=0.002)
    assert label.flight.heading_deg == pytest.approx(pose.attitude.yaw_deg + 77, abs=1e-5)


def test_the_lateral_offset_of_v1_comes_from_the_corners(tmp_path):
    """Whatever its sign says."""
    pose = approach(np.random.default_rng(3))
    px = sf.project(EARTH_STUDIO, pose, RUNWAY.corners)
    for sign in (1, -1):
        row = v1_row(px) | flown(pose, lateral_path_angle=sign * 1.7)
        (label,) = read_labels(write(tmp_path / "labels.csv", [row]))
        assert label.flight.lateral_m is None
        recorded = recorded_pose(label, RUNWAY)
        np.testing.assert_allclose(recorded.position_m[1], pose.position_m[1], atol=3)  # whole pixels, 3 km out
        np.testing.assert_allclose(recorded.position_m[[0, 2]], pose.position_m[[0, 2]], atol=10)


def test_no_flight_or_no_camera_no_pose(tmp_path):
    pose = approach(np.random.default_rng(3))
    px = sf.project(LARD_V2, pose, RUNWAY.corners)
    labels = read_labels(
        write(
            tmp_path / "labels.csv",
            [
                v2_row(px, image=f"{k}.jpg", **V2, **flown(pose)) | change
                for k, change in enumerate(({"yaw": ""}, {"width": "9"}, {}))
            ],
        )
    )
    assert [recorded_pose(label, RUNWAY) is None for label in labels] == [True, True, False]
    assert recorded_pose(labels[1], RUNWAY, LARD_V2) is not None


@pytest.mark.parametrize(
    "change",
    [{"pitch": "200"}, {"roll": "nan"}, {"along_track_distance": "-1"}, {"slant_distance": "0.001"}, {"lat": "91"}],
)
def test_a_flight_that_cannot_be_is_refused(tmp_path, change):
    pose = approach(np.random.default_rng(3))
    px = sf.project(LARD_V2, pose, RUNWAY.corners)
    rows = [v2_row(px, image=f"{k}", **V2, lat="1", lon="2", alt="3", **flown(pose)) for k in "ab"]
    labels = read_labels(write(tmp_path / "labels.csv", [rows[0] | change, rows[1]]))
    (refusal,) = labels.refused
    assert f"line 2: {next(iter(change))} is " in refusal.message


# Real labels, where they are at hand.


@needs_data
def test_the_flight_of_78_real_rows_explains_their_corners():
    """Height, along-track distance, pitch and roll of v1, as read here, leave the corners to half a pixel.

    The heading is not used, so that it tells: yaw plus the runway's heading, which is one number.
    """
    database = load_database(DATA / "lard_runways.json")
    misses, headings = [], {}
    for label in read_labels(SAMPLE):
        runway = database.find(label.ident)
        pose = recorded_pose(label, runway)
        misses.append(np.abs(sf.project(EARTH_STUDIO, pose, runway.corners) - label.corners_px).max())
        heading = (label.flight.heading_deg - pose.attitude.yaw_deg) % 360
        headings.setdefault(label.ident, []).append(heading)
        # The record's own rounding is 18.5 m, half of it either way, of both distances.
        assert abs(np.linalg.norm(pose.position_m) - label.distance_m) < 25
    assert len(misses) == 78
    assert np.median(misses) < 0.45  # of eight coordinates, uniform within half a pixel: 0.46 before any fit
    assert max(misses) < 0.75
    # By the database's coordinates the runways point to 355.29 and 48.59 degrees.
    for ident, heading in (("BIRK/01", 355.30), ("LFST/05", 48.59)):
        assert np.mean(headings[ident]) == pytest.approx(heading, abs=0.02)
        assert np.std(headings[ident]) < 0.03


@needs_data
def test_the_lateral_angle_of_v1_has_an_inconsistent_sign():
    """Why it is not read: on one runway it is positive left of the centreline, on the other right."""
    database = load_database(DATA / "lard_runways.json")
    with open(SAMPLE, newline="") as file:
        angles = [float(row["lateral_path_angle"]) for row in csv.DictReader(file, delimiter=";")]
    products = {"BIRK/01": [], "LFST/05": []}
    for label, angle in zip(read_labels(SAMPLE), angles, strict=True):
        pose = recorded_pose(label, database.find(label.ident))
        if abs(angle) > 0.3:
            products[label.ident].append(pose.position_m[1] * angle)
    signs = {ident: np.sign(values) for ident, values in products.items()}
    assert np.mean(signs["BIRK/01"] > 0) > 0.95
    assert np.mean(signs["LFST/05"] < 0) > 0.95


@needs_data
def test_three_real_rows_of_v2_have_a_field_of_view_of_60_degrees():
    """From height, slant distance, pitch and roll alone, without the runway.

    The focal length that puts the middle of the threshold at its recorded distance; a whole-pixel
    label leaves it uncertain to some 10 px in 887.
    """
    with open(V2_HEAD, newline="") as file:
        rows = list(csv.DictReader(file, delimiter=";"))
    found = []
    for row, label in zip(rows, read_labels(V2_HEAD), strict=True):
        assert label.camera == LARD_V2
        flight = label.flight
        assert flight.wgs84 == tuple(float(row[name]) for name in ("lat", "lon", "alt"))
        level = sf.Pose.from_attitude([0, 0, 0], 0, flight.pitch_deg, flight.roll_deg).runway_from_camera
        u, v = label.corners_px[:2].mean(axis=0) - 511.5
        depression = np.arcsin(flight.height_m / label.distance_m)

        def off(focal, u=u, v=v, level=level, depression=depression):
            ray = level @ [u, v, focal]
            return np.arcsin(-ray[2] / np.linalg.norm(ray)) - depression

        # d(depression) / d(focal length), and what a third of a pixel in v does to the depression.
        slope = (off(900.0) - off(880.0)) / 20
        found.append((880.0 - off(880.0) / slope, abs(0.3 / 887 / slope)))
    focal, sigma = np.array(found).T
    mean = np.average(focal, weights=sigma**-2)
    error = 1 / np.sqrt((sigma**-2).sum())
    assert error < 10
    assert abs(mean - LARD_V2.fx) < 3 * error


@needs_data
def test_the_head_of_v1_says_what_its_picture_is():
    first, second = read_labels(V1_HEAD)
    picture = first.picture
    assert (picture.source, picture.scenario, picture.time) == ("earth_studio", "BIRK_01_500", "01/08/2020 15:22")
    assert (picture.watermark_rows, picture.night, picture.weather) == (300, None, "")
    assert first.flight.height_m == pytest.approx(1340.09 * 0.3048)
    assert first.flight.along_m == pytest.approx(4.14 * 1852)
    assert second.flight.pitch_deg == pytest.approx(83.81266021438161 - 90)
