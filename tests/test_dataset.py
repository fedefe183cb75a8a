import csv
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.stats import binomtest, kstest, uniform

import shortfinal as sf
from shortfinal.audit import audit_labels
from shortfinal.data.augment import inside
from shortfinal.data.check import check_dataset
from shortfinal.data.dataset import LARD_CONE, plan_shot, read_dataset, write_dataset
from shortfinal.data.formats import CAMERA_COLUMNS, CORNER_COLUMNS, POSE_COLUMNS, convert, open_dataset
from shortfinal.data.image import read_image
from shortfinal.data.lard import (
    AIMING_POINT_M,
    EARTH_STUDIO,
    NAUTICAL_MILE_M,
    NewLabel,
    read_labels,
    write_database,
    write_labels,
)
from shortfinal.files import write_whole
from shortfinal.runway import load_database

LARD_SAMPLE = Path(__file__).parents[2] / "shared" / "data" / "lard_sample"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes")
    write_dataset(path, 6, seed=3)
    return path


@pytest.fixture(scope="module")
def views(tmp_path_factory):
    """Views of runways, of ends of them (3, 5 to 7), and of land without one (2)."""
    path = tmp_path_factory.mktemp("views")
    write_dataset(path, 8, seed=5)
    return path


@pytest.fixture(scope="module")
def crops(tmp_path_factory):
    """The paper's crops of LARD's camera."""
    path = tmp_path_factory.mktemp("crops")
    write_dataset(path, 3, seed=6, camera=EARTH_STUDIO, crop_px=96)
    return path


def rows_of(folder):
    with (folder / "labels.csv").open() as file:
        return list(csv.DictReader(file))


def as_recorded(row):
    """Camera and corners as a row's numbers have them."""
    v = {k: float(row[k]) for k in (*CAMERA_COLUMNS, *POSE_COLUMNS, "length_m", "width_m")}
    lens = tuple(float(k) for k in row["distortion"].split())
    camera = sf.Camera(int(v["width"]), int(v["height"]), v["fx"], v["fy"], v["cx"], v["cy"], lens)
    pose = sf.Pose.from_attitude([v["x_m"], v["y_m"], v["z_m"]], v["yaw_deg"], v["pitch_deg"], v["roll_deg"])
    return camera, sf.project(camera, pose, sf.Runway(v["length_m"], v["width_m"]).corners)


@pytest.mark.parametrize("name", ["folder", "views", "crops"])
def test_labels_agree_with_the_camera_of_their_row(name, request):
    folder = request.getfixturevalue(name)
    for row, example in zip(rows_of(folder), read_dataset(folder), strict=True):
        camera, px = as_recorded(row)
        assert example.image.shape == (camera.height, camera.width, 3)
        if example.corners_px is None:
            assert not inside(px, camera.width, camera.height).any()
            continue
        np.testing.assert_allclose(example.corners_px, px, atol=1e-3, rtol=1e-6)  # beyond the border, to nine digits
        seen = inside(px, camera.width, camera.height)
        assert seen.all() if name != "views" else seen.sum() >= 2


def test_views_show_runways_ends_of_them_and_land():
    shots = [plan_shot(4, n) for n in range(400)]
    sizes = np.array([s.camera.width for s in shots])
    assert (sizes == [s.camera.height for s in shots]).all()
    land = [s for s in shots if s.empty]
    assert binomtest(len(land), 400, 0.1).pvalue > 0.001
    kinds = [inside(s.corners_px, s.camera.width, s.camera.height) for s in shots if not s.empty]
    whole = sum(seen.all() for seen in kinds)
    # Some views of an end hold the other too.
    assert 0.65 * 400 - 4 * 9.5 < whole < 0.9 * 400
    ends = [seen for seen in kinds if not seen.all()]
    near, far = (sum(seen[pair].all() for seen in ends) for pair in (slice(0, 2), slice(2, 4)))
    assert min(near, far) > 0.15 * len(ends)
    assert near + far >= len(ends)  # one end is there as a whole
    assert far > near
    # What is shown, the runway or an end, leaves room around it for the crop to move.
    for shot in shots:
        if not shot.empty:
            width, px = shot.camera.width, shot.corners_px
            parts = [part for part in (px, px[:2], px[2:]) if inside(part, width, width).all()]
            assert any(11 <= np.ptp(part, axis=0).max() <= width / 1.29 for part in parts)
    assert max(sizes) <= 1.3 * 200 + 3
    # Some show much of the land around a runway that is small in it.
    spans = [np.ptp(s.corners_px, axis=0).max() / s.camera.width for s in shots if not s.empty]
    assert np.mean(np.array(spans) < 0.3) > 0.08


def test_land_has_no_runway_in_it():
    land = [shot for shot in (plan_shot(4, n) for n in range(300)) if shot.empty]
    along, across = np.meshgrid(np.linspace(0, 1, 60), np.linspace(-0.5, 0.5, 7))
    for shot in land:
        assert shot.corners_px is None
        assert not np.asarray(shot.scene.airfield.other).any()
        runway = shot.scene.runway
        surface = np.stack([along * runway.length_m, across * runway.width_m, 0 * along], axis=-1).reshape(-1, 3)
        # Between its ends the runway is flat enough here: a tenth of a pixel at most.
        px = sf.project(shot.camera, shot.pose, surface)
        assert not inside(px, shot.camera.width, shot.camera.height).any()
    assert len({shot.camera.width for shot in land}) > 10


def test_a_row_without_a_runway_has_empty_corners_and_all_the_rest(views):
    rows = rows_of(views)
    assert [not row["near_left_u"] for row in rows] == [False, False, True, *[False] * 5]
    places = [name for name in rows[0] if name.endswith(("_u", "_v"))]
    assert set(CORNER_COLUMNS) < set(places)
    assert all(rows[2][name] == "" for name in places)
    assert all(row[name] for row in rows for name in row if name not in ("distortion", *places))
    examples = list(read_dataset(views))
    assert examples[2].corners_px is None
    assert examples[2].image.std() > 1
    picture = open_dataset(views).pictures[2]
    assert picture.labels == ()
    assert picture.size == examples[2].image.shape[1::-1]


def test_crops_are_the_papers_of_lards_camera(crops):
    """A power of one half of LARD's resolution, the runway inside by 8 px, seen from LARD's own cone."""
    assert not (crops / "lard.csv").exists()
    for row, example in zip(rows_of(crops), read_dataset(crops), strict=True):
        assert example.image.shape == (96, 96, 3)
        halvings = np.log2(EARTH_STUDIO.fx / float(row["fx"]))
        assert halvings == pytest.approx(round(halvings), abs=1e-9)
        assert ((example.corners_px > 7.4) & (example.corners_px < 95 - 7.4)).all()
    shots = [plan_shot(6, n, EARTH_STUDIO, 96) for n in range(120)]
    for shot in shots:
        x, y, z = shot.pose.position_m
        miles = -x / NAUTICAL_MILE_M
        assert LARD_CONE.nautical_miles[0] <= miles <= LARD_CONE.nautical_miles[1]
        assert 2.2 <= np.degrees(np.arctan2(z, AIMING_POINT_M - x)) <= 3.8
        assert abs(np.degrees(np.arctan2(y, -x))) <= 4
        attitude = shot.pose.attitude
        assert max(abs(attitude.yaw_deg), abs(attitude.roll_deg)) < 20  # LARD's 10, or turned to hold the runway
        # Half as many halvings would not do: the runway with its margin is over half of the crop.
        extent = np.ptp(shot.corners_px, axis=0).max()
        assert shot.camera.fx == pytest.approx(EARTH_STUDIO.fx) or extent > (96 - 2 * 8) / 2 - 8
    assert len({round(float(np.log2(EARTH_STUDIO.fx / shot.camera.fx))) for shot in shots}) >= 3


def test_a_crop_needs_a_camera_and_its_own_folder(crops, tmp_path):
    with pytest.raises(sf.InputError, match=r"^crop_px: crops are of a camera's frames; give the camera too$"):
        write_dataset(tmp_path / "x", 1, crop_px=224)
    for other in (None, 64):
        with pytest.raises(sf.InputError, match="holds a data set of another seed, camera or crop"):
            write_dataset(crops, 3, seed=6, camera=EARTH_STUDIO, crop_px=other)


def test_a_data_set_of_views_is_clean(views, tmp_path):
    """Land without a runway and corners beyond the border are no faults."""
    report = check_dataset(views, tmp_path)
    assert report.serious == ()
    assert (report.pictures, report.labels, report.unlabelled) == (8, 7, 1)
    assert sorted(p.picture for p in report.problems if p.kind == "cut") == [
        f"images/00000{k}.png" for k in (3, 5, 6, 7)
    ]
    assert len(report.audit.labels) == 7
    assert not report.audit.not_checked
    # A runway is as large as it is seen.
    sizes = {len(read_image(p.path)) for p in open_dataset(views).pictures}
    assert np.concatenate(list(report.measures["runway_px"].values())).max() <= max(sizes)
    assert (tmp_path / "contact_sheet.png").stat().st_size > 10_000


CAMERA = sf.Camera(160, 160, 222.3, 205.5, 79.5, 79.5, (-0.2, 0.05, 0.0, 0.0))


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    path = tmp_path_factory.mktemp("frames")
    write_dataset(path, 4, seed=8, camera=CAMERA)
    return path


def test_whole_frames_hold_the_runway(frames):
    for example in read_dataset(frames):
        assert example.image.shape == (160, 160, 3)
        assert (example.corners_px >= 0).all()
        assert (example.corners_px <= 159).all()


def test_frames_look_where_the_cone_says_unless_the_runway_would_be_lost():
    # LARD's own camera: of the widened cone's approaches nearly all hold the runway as they are, so
    # yaw, pitch and roll keep their uniform distributions; a narrow lens has to be turned.
    wide = [plan_shot(3, n, EARTH_STUDIO).pose.attitude for n in range(150)]
    assert kstest([a.roll_deg for a in wide], uniform(-12, 24).cdf).pvalue > 0.01
    narrow = sf.Camera(640, 480, 4000, 4000, 319.5, 239.5)
    shots = [plan_shot(3, n, narrow) for n in range(30)]
    for shot in shots:
        assert (shot.corners_px >= 0).all()
        assert (shot.corners_px <= [639, 479]).all()


def test_a_camera_that_holds_no_runway_is_refused():
    with pytest.raises(sf.InputError, match="wider lens"):
        plan_shot(0, 0, sf.Camera(64, 48, 40000, 40000, 31.5, 23.5))


def test_the_lard_form_says_the_same(frames):
    ours = read_dataset(frames)
    labels = read_labels(frames / "lard.csv")
    assert not labels.refused
    for label, example in zip(labels, ours, strict=True):
        np.testing.assert_allclose(label.corners_px, example.corners_px, atol=0.5 + 1e-6)
    report = audit_labels(labels, load_database(frames / "runways.json"))
    assert [a.verdict for a in report.labels] == ["passed"] * len(ours)


@pytest.mark.slow
def test_the_audit_finds_none_of_5000_rendered_labels_inconsistent(tmp_path):
    # By chance the test names one good label in a thousand if errors are Gaussian; rounding's are
    # bounded, and cannot reach that far.
    shots = [plan_shot(11, n, EARTH_STUDIO) for n in range(5000)]
    rows = [NewLabel(str(n), s.camera, s.ident, s.pose, s.corners_px) for n, s in enumerate(shots)]
    write_labels(tmp_path / "lard.csv", rows)
    write_database(tmp_path / "runways.json", [s.runway for s in shots])
    report = audit_labels(read_labels(tmp_path / "lard.csv"), load_database(tmp_path / "runways.json"))
    assert len(report.labels) == 5000
    assert not report.not_checked
    assert not report.contradicting


def test_rendering_goes_on_where_it_stopped(folder, tmp_path):
    # A run killed after three pictures leaves no labels.csv; the second run leaves what one run would.
    write_dataset(tmp_path, 3, seed=3)
    (tmp_path / "labels.csv").unlink()
    write_dataset(tmp_path, 6, seed=3)
    assert (tmp_path / "labels.csv").read_text() == (folder / "labels.csv").read_text()
    assert sorted(p.name for p in (tmp_path / "images").iterdir()) == [f"{i:06d}.png" for i in range(6)]


def test_a_data_set_grows_without_rendering_again(folder, tmp_path):
    write_dataset(tmp_path, 2, seed=3)
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "images").iterdir()}
    write_dataset(tmp_path, 4, seed=3)
    assert all(p.stat().st_mtime_ns == time for p, time in before.items())
    assert len(read_dataset(tmp_path)) == 4


def test_an_example_follows_from_its_number():
    np.testing.assert_array_equal(plan_shot(5, 2).render().image, plan_shot(5, 2).render().image)


def test_another_seed_is_not_mixed_in(folder):
    with pytest.raises(sf.InputError, match="another seed"):
        write_dataset(folder, 6, seed=4)


def with_cell(text, line, column, value):
    """A table with one cell changed."""
    lines = [row.split(",") for row in text.splitlines()]
    lines[line - 1][lines[0].index(column)] = value
    return "\n".join(",".join(row) for row in lines)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda text: text.replace("near_left_u", "left_u"), "no column near_left_u"),
        (lambda text: with_cell(text, 3, "far_left_v", "nan"), "line 3: far_left_v is 'nan'"),
        (lambda text: with_cell(text, 3, "far_left_v", ""), "line 3: far_left_v is ''"),
        (lambda text: text.splitlines()[0], "a header without rows"),
    ],
)  # fmt: skip
def test_damaged_labels_are_named(folder, tmp_path, damage, message):
    (tmp_path / "labels.csv").write_text(damage((folder / "labels.csv").read_text()))
    with pytest.raises(sf.InputError, match=message):
        read_dataset(tmp_path)


def test_a_missing_or_broken_picture_is_named(folder, tmp_path):
    (tmp_path / "labels.csv").write_text((folder / "labels.csv").read_text())
    with pytest.raises(sf.InputError, match=r"000000\.png: no such image"):
        read_dataset(tmp_path)
    shutil.copytree(folder / "images", tmp_path / "images")
    (tmp_path / "images" / "000000.png").write_bytes(b"not a picture")
    with pytest.raises(sf.InputError, match=r"000000\.png: cannot be read"):
        read_dataset(tmp_path)[0]
    with pytest.raises(sf.InputError, match="no such folder"):
        read_dataset(tmp_path / "nowhere")


@pytest.mark.parametrize("to", ["yolo", "coco"])
def test_other_peoples_formats_are_examples_too(views, tmp_path, to):
    pytest.importorskip("yaml")
    convert(views, tmp_path / to, to)
    source, there = read_dataset(views), read_dataset(tmp_path / to)
    truth = {picture.path.name: example.corners_px for (picture, _), example in zip(source.labels, source, strict=True)}
    assert len(there) == len(truth) == 8
    for (picture, _), example in zip(there.labels, there, strict=True):
        corners, true = example.corners_px, truth[picture.path.name]
        if true is None:
            assert corners is None
            continue
        # YOLO has no room for a corner beyond the border: there it is not labelled.
        kept = inside(true, *example.image.shape[1::-1]) if to == "yolo" else np.ones(4, bool)
        np.testing.assert_allclose(corners[kept], true[kept], atol=1e-5)
        assert np.isnan(corners[~kept]).all()


@pytest.mark.skipif(not LARD_SAMPLE.is_dir(), reason="shared/data is absent")
def test_lards_pictures_are_examples_in_stored_pixels():
    examples = read_dataset(LARD_SAMPLE)
    assert len(examples) == 78
    image, corners = examples[0].image, examples[0].corners_px
    assert image.shape == (640, 640, 3)
    expected = (np.array([[1622, 1130], [1642, 1129], [1641, 1097], [1625, 1098]]) + 0.5) * [
        640 / 2448,
        640 / 2648,
    ] - 0.5
    np.testing.assert_allclose(corners, expected)


def test_a_jpeg_that_is_cut_off_is_refused(tmp_path):
    content = bytes(cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8))[1])
    path = tmp_path / "a.jpg"
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(sf.InputError, match=r"a\.jpg: truncated JPEG"):
        read_image(path)
    path.write_bytes(content + bytes(100))  # padded
    assert read_image(path).shape == (64, 64, 3)


def test_an_empty_file_or_a_folder_is_no_image(tmp_path):
    (tmp_path / "a.png").touch()
    for path in (tmp_path / "a.png", tmp_path):
        with pytest.raises(sf.InputError, match="cannot be read as an image"):
            read_image(path)


def test_a_picture_that_is_cut_off_is_rendered_again(tmp_path):
    write_dataset(tmp_path, 1, seed=3)
    path = tmp_path / "images" / "000000.png"
    whole = path.read_bytes()
    path.write_bytes(whole[:-20])
    write_dataset(tmp_path, 1, seed=3)
    assert path.read_bytes() == whole


def test_a_stamp_that_cannot_be_read_is_refused(tmp_path):
    (tmp_path / "dataset.json").write_bytes(b"\xff\xfe")
    with pytest.raises(sf.InputError, match=r"dataset\.json: not a text file"):
        write_dataset(tmp_path, 1)
    (tmp_path / "dataset.json").unlink()
    (tmp_path / "dataset.json").mkdir()
    with pytest.raises(sf.InputError, match=r"dataset\.json: cannot be read"):
        write_dataset(tmp_path, 1)


def test_a_file_that_cannot_be_written_leaves_no_part(tmp_path):
    (tmp_path / "a.csv").mkdir()
    with pytest.raises(sf.InputError, match=r"a\.csv: cannot be written"):
        write_whole(tmp_path / "a.csv", "x")
    assert [p.name for p in tmp_path.iterdir()] == ["a.csv"]
