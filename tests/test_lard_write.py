import csv
import json

import numpy as np
import pytest
from test_audit import approach
from test_lard import DATA, RUNWAYS, SAMPLE, TEST_SYNTH, V1_HEAD, V2_HEAD, needs_data

import shortfinal as sf
from shortfinal.audit import audit_file, audit_labels
from shortfinal.data.lard import (
    EARTH_STUDIO,
    WHOLE_PIXEL_SIGMA,
    NewLabel,
    read_labels,
    recorded_pose,
    write_database,
    write_labels,
)
from shortfinal.runway import find_runway, load_database

CAMERA = sf.Camera(640, 480, 1100.5, 1080.25, 322.5, 241.125)


def rendered(rng, number):
    """A label of a random runway through a random lens, exact."""
    runway = sf.Runway(rng.uniform(900, 3500), rng.uniform(23, 60), f"SYN{number:03d}/{1 + number % 36:02d}")
    distortion = tuple(rng.normal(0, [0.05, 0.02, 1e-3, 1e-3])) if number % 2 else ()
    camera = sf.Camera(1280, 1024, 1800.5, 1790.25, 641.5, 508.125, distortion)
    pose = approach(rng)
    return runway, NewLabel(
        f"images/{number:06d}.png", camera, runway.ident, pose, sf.project(camera, pose, runway.corners)
    )


@pytest.fixture
def scenes():
    rng = np.random.default_rng(20)
    return [rendered(rng, number) for number in range(60)]


def test_what_is_written_is_read_back(tmp_path, scenes):
    path = tmp_path / "labels.csv"
    write_labels(path, [row for _, row in scenes])
    labels = read_labels(path)
    assert not labels.refused
    for label, (runway, row) in zip(labels, scenes, strict=True):
        assert (label.image, label.ident, label.raw_order_ok) == (row.image, row.ident, True)
        assert np.abs(label.corners_px - row.corners_px).max() <= 0.5
        assert label.camera.width == row.camera.width
        np.testing.assert_allclose(label.camera.intrinsics, row.camera.intrinsics, rtol=1e-8)
        # Six decimals of a nautical mile: within a millimetre.
        assert label.distance_m == pytest.approx(np.linalg.norm(row.pose.position_m), abs=1e-3)
        pose = recorded_pose(label, runway)
        np.testing.assert_allclose(pose.position_m, row.pose.position_m, atol=0.1)
        np.testing.assert_allclose(pose.attitude, row.pose.attitude, atol=0.02)  # yaw: from whole pixels
        turn = label.flight.heading_deg - 10.0 * int(row.ident[-2:]) - row.pose.attitude.yaw_deg
        assert abs((turn + 180) % 360 - 180) < 1e-5


def test_the_audit_passes_what_is_written(tmp_path, scenes):
    write_labels(tmp_path / "labels.csv", [row for _, row in scenes])
    write_database(tmp_path / "runways.json", [runway for runway, _ in scenes])
    report = audit_file(tmp_path / "labels.csv", tmp_path / "runways.json", tmp_path / "out")
    assert not report.contradicting
    assert not report.not_checked
    assert not report.refused
    assert report.sigma_ratio == pytest.approx(1, abs=3 / np.sqrt(4 * len(scenes)))


def test_a_database_gives_the_runways_back(tmp_path, scenes):
    sloping = np.array([[0.0, 20, 0], [0, -20, 0], [1800, -20, 12.5], [1800, 20, 12.5]])
    runways = [runway for runway, _ in scenes[:5]] + [sf.Runway(1800, 40, "LFPO/24", sloping)]
    path = tmp_path / "runways.json"
    write_database(path, runways)
    for runway in runways:
        np.testing.assert_allclose(find_runway(runway.ident, path).corners, runway.corners, atol=1e-6)
    with pytest.raises(sf.InputError, match="a name such as LFPO/24"):
        write_database(path, [sf.Runway(1800, 40)])


def test_the_file_has_lards_columns_order_and_units(tmp_path):
    path, pose = tmp_path / "labels.csv", sf.Pose.from_attitude([-1852.0, -10.0, 100.0], 2, -3, 4)
    px = sf.project(EARTH_STUDIO, pose, sf.Runway(2500, 45).corners)
    write_labels(path, [NewLabel("a.png", EARTH_STUDIO, "LFPO/07L", pose, px)])
    header, line = path.read_text().splitlines()
    row = dict(zip(header.split(";"), line.split(";"), strict=True))
    if V1_HEAD.exists():
        lard = V1_HEAD.read_text().split("\n")[0]
        assert header.startswith(lard + ";fx;fy;cx;cy;distortion;")
    assert (row["height"], row["width"], row["type"]) == ("2648", "2448", "shortfinal")
    assert (row["airport"], row["runway"], row["scenario"]) == ("LFPO", "07L", "LFPO_07L")
    assert float(row["along_track_distance"]) == 1.0
    assert float(row["height_above_runway"]) == pytest.approx(100 / 0.3048, abs=1e-4)
    assert float(row["slant_distance"]) == pytest.approx(np.hypot(1852, np.hypot(10, 100)) / 1852, abs=1e-6)
    assert float(row["lateral_path_angle"]) == pytest.approx(np.degrees(np.arctan(10 / 1852)), abs=1e-6)  # right
    assert float(row["vertical_path_angle"]) == pytest.approx(np.degrees(np.arctan(100 / 2157)), abs=1e-6)
    np.testing.assert_allclose([float(row[name]) for name in ("yaw", "pitch", "roll")], [72, 87, 4])
    order = [(int(row[f"y_{name}"]), int(row[f"x_{name}"])) for name in "ABCD"]
    assert order == sorted(order)
    # LARD truncates what is counted from the picture's edge: the pixel that holds the corner.
    assert [int(row["x_BL"]), int(row["y_BL"])] == np.floor(px[0] + 0.5).astype(int).tolist()


def test_corners_outside_the_picture_and_rounding_at_half_a_pixel(tmp_path):
    pose = sf.Pose.from_attitude([-1852.0, -10.0, 100.0], 0, -3, 0)
    px = np.array([[-100.5, 400.49], [300.5, 401.0], [250.0, 200.0], [-0.4, 200.0]])
    write_labels(tmp_path / "labels.csv", [NewLabel("a.png", CAMERA, "LFPO/24", pose, px)])
    (label,) = read_labels(tmp_path / "labels.csv")
    np.testing.assert_array_equal(label.corners_px, [[-100, 400], [301, 401], [250, 200], [0, 200]])
    for far in (px + [2000, 0], px * np.nan):
        with pytest.raises(sf.InputError, match=r"label a\.png"):
            write_labels(tmp_path / "other.csv", [NewLabel("a.png", CAMERA, "LFPO/24", pose, far)])
    assert not (tmp_path / "other.csv").exists()


@pytest.mark.parametrize(
    "image, ident",
    [("a;b.png", "LFPO/24"), ('"a.png', "LFPO/24"), ("a\nb", "LFPO/24"), ("", "LFPO/24"), ("a", "LFPO"), ("a", "")],
)
def test_names_that_cannot_stand_in_the_file_are_refused(tmp_path, image, ident):
    pose = sf.Pose.from_attitude([-1852.0, 0.0, 100.0])
    px = sf.project(CAMERA, pose, sf.Runway(2500, 45).corners)
    with pytest.raises(sf.InputError, match="cannot stand in a LARD file"):
        write_labels(tmp_path / "labels.csv", [NewLabel(image, CAMERA, ident, pose, px)])


def test_any_roll_is_written_and_read(tmp_path):
    """At 80 degrees reading order mixes the ends; the named corners do not."""
    rows, runway = [], sf.Runway(1200, 60)
    for roll in range(-80, 81, 20):
        pose = sf.Pose.from_attitude([-900.0, 30.0, 90.0], 0, -4, roll)
        px = sf.project(EARTH_STUDIO, pose, runway.corners)
        rows.append(NewLabel(f"{roll}.png", EARTH_STUDIO, "LFPO/24", pose, px))
    write_labels(tmp_path / "labels.csv", rows)
    for label, row in zip(read_labels(tmp_path / "labels.csv"), rows, strict=True):
        assert label.raw_order_ok
        assert np.abs(label.corners_px - row.corners_px).max() <= 0.5


# Real labels, where they are at hand.


def solved(label, runway):
    keypoints = sf.GaussianKeypoints.from_sigma(label.corners_px, WHOLE_PIXEL_SIGMA)
    return sf.estimate_pose(keypoints, runway.corners, label.camera).pose


@needs_data
@pytest.mark.parametrize("source", [SAMPLE, TEST_SYNTH, V1_HEAD])
def test_real_files_survive_read_write_read(tmp_path, source):
    database, labels = load_database(RUNWAYS), read_labels(source)
    poses = []
    for label in labels:
        runway = database.find(label.ident)
        poses.append(recorded_pose(label, runway) or solved(label, runway))
    path = tmp_path / "labels.csv"
    write_labels(path, [NewLabel(b.image, b.camera, b.ident, pose, b.corners_px) for b, pose in zip(labels, poses)])
    again = read_labels(path)
    assert not again.refused
    for before, after, pose in zip(labels, again, poses, strict=True):
        np.testing.assert_array_equal(before.corners_px, after.corners_px)
        assert (before.image, before.ident, before.camera) == (after.image, after.ident, after.camera)
        assert after.distance_m == pytest.approx(np.linalg.norm(pose.position_m), abs=1e-3)
    report = audit_labels(again, database)
    # Held to the millimetre against a pose that fits the corners: what rounding of 18.5 m hid may show, of few.
    assert not report.not_checked
    assert not any(f.value != "distance" for a in report.contradicting for f in a.findings)
    assert len(report.contradicting) <= 0.02 * len(labels)


@needs_data
def test_v2_survives_read_write_read(tmp_path):
    """Its runway is in no database here; any will do to write."""
    labels = read_labels(V2_HEAD)
    pose = sf.Pose.from_attitude([-5000.0, 0.0, 300.0])
    write_labels(tmp_path / "labels.csv", [NewLabel(b.image, b.camera, b.ident, pose, b.corners_px) for b in labels])
    for before, after in zip(labels, read_labels(tmp_path / "labels.csv"), strict=True):
        np.testing.assert_array_equal(before.corners_px, after.corners_px)
        assert (before.image, before.ident) == (after.image, after.ident)
        np.testing.assert_allclose(before.camera.intrinsics, after.camera.intrinsics, rtol=1e-8)


@needs_data
def test_the_real_database_has_the_form_that_is_written(tmp_path):
    write_database(tmp_path / "runways.json", [sf.Runway(2000, 45, "LFST/05")])
    ours = json.loads((tmp_path / "runways.json").read_text())["LFST"]["05"]
    theirs = json.loads((DATA / "lard_runways.json").read_text())["LFST"]["05"]
    assert sorted(ours) == sorted(theirs)
    assert list(ours["A"]["coordinate"]) == list(theirs["A"]["coordinate"])
    with open(SAMPLE, newline="") as file:
        assert next(csv.reader(file, delimiter=";"))[0] == "image"
