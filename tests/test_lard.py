import csv
import itertools
from pathlib import Path

import numpy as np
import pytest

import shortfinal as sf
from shortfinal.data.lard import EARTH_STUDIO, LARD_V2, SOURCES, RunwayLabel, read_labels
from shortfinal.runway import load_database

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
RUNWAYS = DATA / "lard_runways.json"
TEST_SYNTH = DATA / "lard_labels" / "test_synth_labels.csv"
SAMPLE = DATA / "lard_sample" / "labels.csv"
V1_HEAD = DATA / "lard_labels" / "LARD_v1_LARD_train_head.csv"
V2_HEAD = DATA / "lard_labels" / "LARD_v2_metadata_flsim_train_head.csv"
needs_data = pytest.mark.skipif(not RUNWAYS.exists(), reason="shared/data is not here: no real LARD labels to read")

EARTH_RADIUS_M = 6_371_000
RUNWAY = sf.Runway(2500, 45)
NAMED = ("BL", "BR", "TR", "TL")  # keypoint order
SWAPS = list(itertools.combinations(range(4), 2))


def see(distance=3000.0, roll=0.0, yaw=0.0):
    """Exact corners (4, 2) of RUNWAY on a three-degree approach, aimed at it."""
    height = (distance + 305) * np.tan(np.radians(3))
    return sf.project(EARTH_STUDIO, sf.Pose.from_attitude([-distance, 40, height], yaw, -3, roll), RUNWAY.corners)


def reading_order(px):
    return sorted(px.tolist(), key=lambda p: (p[1], p[0]))


def cells(names, px):
    return {f"{a}_{n}": f"{c:g}" for n, p in zip(names, px) for a, c in zip("xy", p)}


def v1_row(px, **changes):
    row = {"image": "a.jpeg", "height": "1024", "width": "1024", "type": "earth_studio", "airport": "TEST"}
    row |= {"runway": "1", "slant_distance": "1.62"} | cells("ABCD", reading_order(np.round(px)))
    return row | changes


def short_row(px, **changes):
    row = {"image": "a.jpeg", "airport": "TEST", "runway": "01", "slant_distance_km": "3.00024"}
    return row | cells("ABCD", reading_order(np.round(px))) | changes


def v2_row(px, **changes):
    row = {"image": "a.jpg", "type": "flight_simulator", "airport": "TEST", "runway": "1", "slant_distance": "1.62"}
    return row | cells(NAMED, px) | changes


def both_row(px, **changes):
    return v1_row(px) | cells(NAMED, np.round(px)) | changes


def write(path, rows, delimiter=";"):
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), delimiter=delimiter)
        writer.writeheader()
        writer.writerows(rows)
    return path


@pytest.fixture
def file(tmp_path):
    return lambda *rows, **options: write(tmp_path / "labels.csv", rows, **options)


@pytest.mark.parametrize("layout", [v1_row, v2_row, short_row, both_row])
@pytest.mark.parametrize("roll", [-25, -10, 0, 10, 25])
@pytest.mark.parametrize("distance", [500, 6000])
def test_every_layout_gives_keypoint_order_at_any_roll(file, layout, roll, distance):
    px = see(distance, roll)
    (label,) = read_labels(file(layout(px)), EARTH_STUDIO)
    np.testing.assert_allclose(label.corners_px, px, atol=0.5)
    assert label.raw_order_ok
    assert label.ident == "TEST/01"


def test_distances_are_metres(file):
    px = see()
    for row in (v1_row(px), short_row(px), v2_row(px)):
        assert read_labels(file(row))[0].distance_m == pytest.approx(1.62 * 1852)
    assert read_labels(file(v1_row(px, slant_distance="")))[0].distance_m is None


def test_the_camera_is_known_for_earth_studio_only(file):
    px = see()
    assert read_labels(file(v1_row(px)))[0].camera == EARTH_STUDIO
    assert read_labels(file(short_row(px)))[0].camera == EARTH_STUDIO
    assert read_labels(file(v1_row(px, type="real")))[0].camera is None
    assert read_labels(file(v2_row(px)))[0].camera is None
    other = sf.Camera(1024, 1024, 1500, 1500, 511.5, 511.5)
    assert read_labels(file(v2_row(px / 3)), other)[0].camera == other
    sized = {"width": "1024", "height": "1024"}
    assert read_labels(file(v2_row(px / 3, **sized)))[0].camera == LARD_V2
    assert read_labels(file(v2_row(px / 3, **sized, type="drone")))[0].camera is None
    assert read_labels(file(v2_row(px / 3, **sized | {"width": "2048"})))[0].camera is None


def test_a_row_may_state_its_camera(file):
    stated = {"width": "640", "height": "480", "fx": "700.5", "fy": "700", "cx": "320", "cy": "240.25"}
    row = v2_row(see() / 4, **stated, distortion="0.1 -0.2 0 0.001")
    camera = sf.Camera(640, 480, 700.5, 700, 320, 240.25, (0.1, -0.2, 0, 0.001))
    assert read_labels(file(row))[0].camera == camera
    assert read_labels(file(row), EARTH_STUDIO)[0].camera == EARTH_STUDIO


def test_the_database_goes_with_version_and_source(file):
    px = see()
    assert read_labels(file(v1_row(px)))[0].picture.database == "runways_database.json"
    assert read_labels(file(short_row(px)))[0].picture.database == "runways_database.json"
    assert read_labels(file(v2_row(px)))[0].picture.database == "runways_db_V2_FLSim.json"
    assert read_labels(file(v2_row(px, type="drone")))[0].picture.database == ""
    assert len({s.database for (version, _), s in SOURCES.items() if version == 2}) == 5


def test_a_real_picture_may_lack_its_runway_and_its_time_to_landing(file):
    row = v1_row(see(), type="real", airport="", runway="", weather="rain", night="True", time_to_landing="12.5")
    (label,) = read_labels(file(row))
    assert (label.ident, label.camera, label.flight) == ("", None, None)
    picture = label.picture
    assert (picture.source, picture.weather, picture.night, picture.time_to_landing_s) == ("real", "rain", True, 12.5)
    assert read_labels(file(v1_row(see(), night="0")))[0].picture.night is False
    assert read_labels(file(v1_row(see())))[0].picture.night is None


def test_corners_of_v2_left_of_the_picture_were_truncated_upwards(file):
    """int(-12.3) is -12: the corner lies in the pixel to the left of it, -13."""
    px = see() / 4
    px[[0, 3]] -= [px[0, 0] + 13, 0]
    row = v2_row(np.trunc(px + 0.5))
    (label,) = read_labels(file(row))
    np.testing.assert_allclose(label.corners_px, px, atol=0.5)
    assert label.corners_px[0, 0] == -13


@pytest.mark.parametrize(
    "runway, ident", [("1", "TEST/01"), ("09", "TEST/09"), ("4r", "TEST/04R"), ("24L", "TEST/24L"), ("N", "TEST/N")]
)
def test_the_landing_direction_has_two_digits(file, runway, ident):
    assert read_labels(file(v1_row(see(), runway=runway)))[0].ident == ident


@pytest.mark.parametrize("swap", SWAPS)
@pytest.mark.parametrize("layout, names", [(v1_row, "ABCD"), (short_row, "ABCD"), (v2_row, NAMED), (both_row, NAMED)])
def test_any_two_corners_that_change_places_are_out_of_order(file, swap, layout, names):
    row = layout(see(roll=7))
    a, b = (names[k] for k in swap)
    for axis in "xy":
        row[f"{axis}_{a}"], row[f"{axis}_{b}"] = row[f"{axis}_{b}"], row[f"{axis}_{a}"]
    assert not read_labels(file(row))[0].raw_order_ok


def test_named_corners_are_not_sorted(file):
    """A swap must reach the solver as it stands, or the audit would repair what it is to find."""
    px = see()[[1, 0, 2, 3]]
    np.testing.assert_allclose(read_labels(file(v2_row(px)))[0].corners_px, px, rtol=1e-4)


def test_separator_byte_order_mark_and_blank_lines(tmp_path, file):
    path = file(short_row(see()), short_row(see(4000), image="b.jpeg"), delimiter=",")
    header, first, second = path.read_text().splitlines()
    path.write_text("\ufeff" + "\n".join([header, "", first, ",,,", second, ""]))
    assert [label.line for label in read_labels(path)] == [3, 5]


def test_a_label_is_frozen(file):
    label = read_labels(file(short_row(see())))[0]
    assert isinstance(label, RunwayLabel)
    with pytest.raises(ValueError, match="read-only"):
        label.corners_px[0, 0] = 1
    assert label.rounding_sigma_px == pytest.approx(12**-0.5)


def broken(text):
    return lambda path: path.write_bytes(text)


@pytest.mark.parametrize(
    "spoil, words",
    [
        (lambda path: path.unlink(missing_ok=True), ["cannot read"]),
        (lambda path: path.mkdir(), ["cannot read"]),
        (broken(b""), ["empty"]),
        (broken(b"\n \n"), ["empty"]),
        (broken(b"\x89PNG\xff\xfe"), ["not a text file"]),
        (broken(b"image;airport;runway\na;b;c\n"), ["line 1", "x_A", "found image, airport, runway"]),
        (broken(b"image;airport;runwy;x_A;y_A;x_B;y_B;x_C;y_C;x_D;y_D\n"), ["line 1", "runway", "nearest: runwy"]),
        (broken(b"image;airport;runway;x_A;x_A;y_A;x_B;y_B;x_C;y_C;x_D;y_D\n"), ["line 1", "x_A", "twice"]),
        (broken(b"image;airport;runway;x_A;y_A;x_B;y_B;x_C;y_C;x_D;y_D\n"), ["line 1", "without rows"]),
        (
            broken(b"image;airport;runway;x_A;y_A;x_B;y_B;x_C;y_C;x_D;y_D\na;b;1;2\n"),
            ["line 2", "4 cells under 11 columns"],
        ),
    ],
)
def test_a_file_that_holds_no_labels_is_refused(tmp_path, spoil, words):
    path = tmp_path / "labels.csv"
    spoil(path)
    with pytest.raises(sf.InputError) as caught:
        read_labels(path)
    for word in [str(path), *words]:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


# Real labels, where they are at hand.


@needs_data
@pytest.mark.parametrize("path, count", [(TEST_SYNTH, 1047), (SAMPLE, 78), (V1_HEAD, 2), (V2_HEAD, 3)])
def test_the_real_files_are_read_whole_and_in_order(path, count):
    labels = read_labels(path)
    assert len(labels) == count
    assert all(label.raw_order_ok for label in labels)
    assert [label.line for label in labels] == list(range(2, count + 2))
    assert not labels.refused
    assert labels[0].camera == (LARD_V2 if path == V2_HEAD else EARTH_STUDIO)


@needs_data
def test_sorting_reading_order_gives_the_corners_lard_names(tmp_path):
    with open(SAMPLE, newline="") as file:
        rows = list(csv.DictReader(file, delimiter=";"))
    unnamed = [{k: v for k, v in row.items() if k[2:] not in NAMED} for row in rows]
    for a, b in zip(read_labels(write(tmp_path / "unnamed.csv", unnamed)), read_labels(SAMPLE), strict=True):
        np.testing.assert_array_equal(a.corners_px, b.corners_px)


@needs_data
def test_pose_from_the_real_whole_pixel_labels():
    """1,047 rows of LARD's test set: no row fails, and distance and reprojection are what rounding allows."""
    database, errors, misses = load_database(RUNWAYS), [], []
    for label in read_labels(TEST_SYNTH):
        runway = database.find(label.ident)
        keypoints = sf.GaussianKeypoints.from_sigma(label.corners_px, label.rounding_sigma_px)
        estimate = sf.estimate_pose(keypoints, runway.corners, label.camera)
        assert estimate.status is sf.SolverStatus.CONVERGED, label
        errors.append(abs(np.linalg.norm(estimate.pose.position_m) / label.distance_m - 1))
        miss = sf.project(label.camera, estimate.pose, runway.corners) - label.corners_px
        misses.append(np.sqrt((miss**2).sum(axis=1).mean()))
    assert len(errors) == 1047
    assert np.median(errors) < 0.01
    assert np.percentile(errors, 98) < 0.04
    assert np.median(misses) < 0.25


@needs_data
def test_whole_pixels_are_nearest_not_half_a_pixel_off():
    """A shift of all corners is no residual but a tilt, so it is looked for in the recorded pitch.

    Recorded pitch is from the vertical under the camera (90 is level), ours from the threshold's;
    the Earth's curvature lies between. Half a pixel would be 0.0084 degrees.
    """
    with open(SAMPLE, newline="") as file:
        recorded = [float(row["pitch"]) - 90 for row in csv.DictReader(file, delimiter=";")]
    database, off = load_database(RUNWAYS), []
    for label, pitch in zip(read_labels(SAMPLE), recorded, strict=True):
        runway = database.find(label.ident)
        keypoints = sf.GaussianKeypoints.from_sigma(label.corners_px, label.rounding_sigma_px)
        estimate = sf.estimate_pose(keypoints, runway.corners, label.camera)
        curvature = np.degrees(estimate.pose.position_m[0] / EARTH_RADIUS_M)
        # Weighted, for the pitch of a far runway is poorly determined.
        off.append((estimate.pose.attitude.pitch_deg - pitch + curvature, estimate.cov[4, 4]))
    error, variance = np.array(off).T
    mean = np.average(error, weights=1 / variance)
    standard_error = np.degrees(1 / np.sqrt((1 / variance).sum()))
    half_pixel = np.degrees(0.5 / EARTH_STUDIO.fy)
    assert abs(mean) < half_pixel / 2
    assert standard_error < half_pixel / 4
