import csv
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image as Pillow

import shortfinal as sf
from shortfinal.data.check import check_dataset, render_summary, report_as_dict
from shortfinal.data.dataset import COLUMNS, write_dataset
from shortfinal.data.formats import CORNER_COLUMNS as CORNERS
from shortfinal.files import csv_text

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
SAMPLE, RUNWAYS = DATA / "lard_sample", DATA / "lard_runways.json"
needs_data = pytest.mark.skipif(not SAMPLE.exists(), reason="shared/data is not here: no real LARD pictures to check")

WIDTH, HEIGHT = 240, 200
CAMERA = sf.Camera(WIDTH, HEIGHT, 900.0, 900.0, 119.5, 99.5)
RUNWAY = sf.Runway(1500.0, 40.0)


def scene(seed):
    """A picture like no other: smooth blotches with fine noise on them."""
    rng = np.random.default_rng(seed)
    blotches = cv2.resize(rng.uniform(40, 200, (5, 6, 3)), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    return np.clip(blotches + rng.normal(0, 3, blotches.shape), 0, 255).astype(np.uint8)


def row(number, split, **changes):
    """A label as exact as nine digits, 1.2 to 3 km out."""
    rng = np.random.default_rng([7, number])
    distance = float(rng.uniform(1200, 3000))
    pose = sf.Pose.from_attitude(
        [-distance, rng.uniform(-40, 40), (distance + 305) * 0.0524], 0.3, -3, rng.uniform(-5, 5)
    )
    px = sf.project(CAMERA, pose, RUNWAY.corners)
    numbers = [WIDTH, HEIGHT, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, RUNWAY.length_m, RUNWAY.width_m]
    numbers += [*pose.position_m, *pose.attitude, *px.ravel()]
    columns = [name for name in COLUMNS if name not in ("ident", "distortion") and not name.startswith("aiming")]
    cells = dict(zip(columns, [f"images/{number:03d}.png", *(f"{n:.9g}" for n in numbers)]))
    return cells | {"split": split, "ident": f"{'ABC'[number % 3]}AAA/01"} | changes


def data_set(folder, count=12):
    """Twelve pictures of three airports, of which train has two and val one."""
    (folder / "images").mkdir(parents=True)
    rows = [row(k, "val" if k % 3 == 2 else "train") for k in range(count)]
    for k in range(count):
        cv2.imwrite(str(folder / "images" / f"{k:03d}.png"), scene(k))
    return rows


def save(folder, rows):
    (folder / "labels.csv").write_text(csv_text(rows[0], rows))
    return folder


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "d"


@pytest.fixture
def rows(folder):
    return data_set(folder)


def check(folder, **options):
    return check_dataset(folder, folder.parent / "out", **options)


def test_a_clean_data_set_is_clean(folder, rows):
    done = []
    report = check(save(folder, rows), progress=lambda *n: done.append(n))
    assert report.serious == ()
    assert report.problems == ()
    assert (report.pictures, report.labels, report.splits) == (12, 12, {"train": 8, "val": 4})
    assert report.airports == {"AAAA": {"train": 4}, "BAAA": {"train": 4}, "CAAA": {"val": 4}}
    assert len(report.audit.not_checked) == 0
    assert done == [(k, 12) for k in range(1, 13)]
    distances = np.concatenate(list(report.measures["distance_m"].values()))
    assert distances.min() > 1200
    np.testing.assert_allclose(np.concatenate(list(report.measures["yaw_deg"].values())), 0.3, atol=1e-6)
    assert np.concatenate(list(report.measures["lateral_deg"].values())).min() < 0


def test_what_is_written(folder, rows, tmp_path):
    rows[3]["ident"] = "CAAA/01"  # in train, while the others of CAAA are in val
    report = check(save(folder, rows))
    content = json.loads((tmp_path / "out" / "check.json").read_text())
    assert content == json.loads(json.dumps(report_as_dict(report)))
    assert content["clean"] is False
    assert content["problems"] == {"leakage": 1}
    assert content["distributions"]["runway_px"]["train"]["count"] == 8
    with (tmp_path / "out" / "problems.csv").open() as file:
        (line,) = csv.DictReader(file)
    assert line["level"] == "problem"
    assert line["what"] == "CAAA is in train (1) and val (4)"
    assert "--split" in line["mend"]
    assert cv2.imread(str(tmp_path / "out" / "check.png")).shape[0] > 500
    sheet = cv2.imread(str(tmp_path / "out" / "contact_sheet.png"))
    assert sheet.shape[1] == 6 * 240
    amber = np.abs(sheet.astype(int) - (84, 196, 255)).max(axis=2) < 60  # BGR
    assert amber.sum() > 24 * 100  # outlines are drawn
    assert "problem: " in render_summary(report)


def test_the_data_set_is_only_read_and_threads_change_nothing(folder, rows, tmp_path):
    save(folder, rows)
    before = {p: (p.stat().st_mtime_ns, p.stat().st_size) for p in folder.rglob("*")}
    one = check_dataset(folder, tmp_path / "one", workers=1)
    two = check_dataset(folder, tmp_path / "two", workers=4)
    assert {p: (p.stat().st_mtime_ns, p.stat().st_size) for p in folder.rglob("*")} == before
    assert report_as_dict(one) == report_as_dict(two)


# One thing spoilt in one picture, one kind of problem, told of that picture.


def image_of(folder, number):
    return folder / "images" / f"{number:03d}.png"


def spoil_image(change):
    """A fault of the image: `change` makes bytes, a picture, or nothing of the file's bytes."""

    def spoil(folder, rows, k):
        path = image_of(folder, k)
        content = change(path.read_bytes())
        path.unlink()
        if isinstance(content, bytes):
            path.write_bytes(content)
        elif content is not None:
            cv2.imwrite(str(path), content)

    return spoil


def spoil_corners(change):
    """A fault of the corners, as a function of (4, 2) makes it."""

    def spoil(folder, rows, k):
        old = np.array([float(rows[k][c]) for c in CORNERS]).reshape(4, 2)
        rows[k] |= dict(zip(CORNERS, (f"{v:.9g}" for v in change(old).ravel())))

    return spoil


def spoil_cell(name, change):
    return lambda folder, rows, k: rows[k].update({name: change(rows[k][name])})


def shifted(corner, by):
    return lambda px: px + np.eye(4)[corner][:, None] * by


def cut_jpeg(folder, rows, k):
    content = cv2.imencode(".jpg", scene(k))[1].tobytes()
    (folder / "images" / f"{k:03d}.jpg").write_bytes(content[: len(content) // 2])
    rows[k]["image"] = f"images/{k:03d}.jpg"


def turned_jpeg(folder, rows, k):
    exif = Pillow.Exif()
    exif[274] = 6
    Pillow.fromarray(scene(k)).save(folder / "images" / f"{k:03d}.jpg", exif=exif, quality=95)
    rows[k]["image"] = f"images/{k:03d}.jpg"


def copied(same_split):
    def spoil(folder, rows, k):
        spare = range(len(rows) - 6, len(rows) - 3) if same_split else range(len(rows) - 3, len(rows))
        other = next(n for n in spare if (rows[n]["split"] == rows[k]["split"]) == same_split)
        shutil.copy(image_of(folder, k), image_of(folder, other))

    return spoil


FAULTS = (
    (spoil_image(lambda b: None), "image", "no such image"),
    (spoil_image(lambda b: b""), "image", "cannot be read"),
    (spoil_image(lambda b: b"no picture"), "image", "cannot be read"),
    (spoil_image(lambda b: b[:5000]), "image", "cannot be read"),
    (cut_jpeg, "image", "truncated JPEG"),
    (turned_jpeg, "orientation", "orientation 6"),
    (spoil_image(lambda b: scene(999)[:100]), "size", "240 x 100 pixels, but its labels say 240 x 200"),
    (spoil_image(lambda b: np.zeros((HEIGHT, WIDTH, 3))), "flat", "grey level 0"),
    (spoil_image(lambda b: np.full((HEIGHT, WIDTH, 3), [120, 130, 140])), "flat", "grey level 132"),
    (spoil_corners(lambda px: px[[1, 0, 3, 2]]), "order", "left and right are swapped"),
    (spoil_corners(lambda px: px[[0, 1, 3, 2]]), "order", "crosses itself"),
    (spoil_corners(lambda px: px[[2, 3, 0, 1]]), "order", "near end is above the far end"),
    (spoil_corners(lambda px: px[[0, 0, 2, 3]]), "order", "coincide"),
    (spoil_corners(lambda px: px[0] + [[0, 0], [1, 0], [2, 0], [3, 0]]), "order", "coincide or lie on one line"),
    (spoil_corners(lambda px: px + 500), "outside", "outside the picture"),
    (spoil_corners(shifted(0, (1.5, 0))), "audit", "residual"),
    (spoil_cell("width_m", lambda v: "45"), "audit", "contradicts"),
    (spoil_cell("x_m", lambda v: str(1.05 * float(v))), "audit", "distance"),
    (spoil_cell("far_left_u", lambda v: "nan"), "label", "expected a finite number"),
    (spoil_cell("width", lambda v: "0"), "label", "width is '0'"),
    (spoil_cell("length_m", lambda v: "-5"), "label", "length_m is '-5'"),
    (spoil_cell("image", lambda v: ""), "label", "image is ''"),
    (copied(same_split=True), "duplicate", "same pixels as"),
    (copied(same_split=False), "leakage", "same pixels as"),
)


@pytest.fixture(scope="module")
def spoilt(tmp_path_factory):
    """A data set whose picture k has fault k, followed by six without."""
    folder = tmp_path_factory.mktemp("spoilt") / "d"
    rows = data_set(folder, len(FAULTS) + 6)
    for k, (spoil, *_) in enumerate(FAULTS):
        spoil(folder, rows, k)
    return check(save(folder, rows))


@pytest.mark.parametrize("k", range(len(FAULTS)))
def test_a_fault_is_found_where_it_is(spoilt, k):
    _, kind, words = FAULTS[k]
    told = [p for p in spoilt.serious if f"{k:03d}." in str(p) or p.row == f"line {k + 2}"]
    # A label far outside contradicts its runway as well.
    assert kind in {p.kind for p in told} <= {kind, "audit"}
    problem = next(p for p in told if p.kind == kind)
    assert words in str(problem)
    assert problem.mend
    assert "\n" not in str(problem)


def test_nothing_but_the_faults_is_found(spoilt):
    audited = [p for p in spoilt.serious if p.kind == "audit"]
    assert len(spoilt.serious) - len(audited) == sum(kind != "audit" for _, kind, _ in FAULTS)
    assert len(audited) <= 1 + sum(kind == "audit" for _, kind, _ in FAULTS)
    assert all(p.kind in ("grey", "small") for p in spoilt.problems if not p.serious)


def test_a_grey_or_cut_or_small_runway_is_a_remark(folder, rows):
    grey = cv2.cvtColor(scene(4), cv2.COLOR_BGR2GRAY)
    cv2.imwrite(str(image_of(folder, 4)), np.dstack([grey] * 3))
    spoil_corners(lambda px: px + [WIDTH + 2 - px[1, 0], 0])(folder, rows, 5)
    spoil_corners(lambda px: px[0] + 0.05 * (px - px[0]))(folder, rows, 6)
    for k in (5, 6):
        rows[k] |= {"width_m": "", "length_m": ""}  # no runway to hold it against
    report = check(save(folder, rows))
    assert report.serious == ()
    assert {p.kind: p.picture or p.file for p in report.problems} == {
        "grey": "images/004.png", "cut": "images/005.png", "small": "images/006.png",
    }  # fmt: skip
    assert "2 labels were not held against a runway: no runway database: pass --runways" in report.notes


# Leakage.


@pytest.mark.parametrize("quality", [95, 75, 50])
def test_the_same_picture_encoded_anew_in_another_split_is_found(folder, rows, quality):
    rows += [row(12, "val", image="images/copy.jpg", ident="CAAA/01")]
    cv2.imwrite(str(folder / "images" / "copy.jpg"), scene(0), [cv2.IMWRITE_JPEG_QUALITY, quality])
    (found,) = check(save(folder, rows)).serious
    assert found.kind == "leakage"
    assert "copy.jpg: shows the same scene as" in str(found)
    assert "000.png, in train" in str(found)


def test_the_same_scene_in_one_split_is_a_remark(folder, rows):
    rows += [
        row(12, "train", image="images/half.png", ident="AAAA/01", width="", height="", fx="", fy="", cx="", cy="")
    ]
    rows[-1] |= {name: rows[0][name] for name in ("width", "height", "fx", "fy", "cx", "cy")}
    cv2.imwrite(str(folder / "images" / "half.png"), cv2.convertScaleAbs(scene(0), alpha=0.9, beta=5))
    report = check(save(folder, rows))
    assert report.serious == ()
    assert [p.kind for p in report.problems] == ["near-duplicate"]


def test_many_copies_are_found_one_line_each(folder, rows):
    """Forty pictures of one scene are 780 pairs, and 39 lines."""
    for k in range(40):
        noisy = np.clip(scene(0) + np.random.default_rng(k).normal(0, 2, (HEIGHT, WIDTH, 3)), 0, 255)
        cv2.imwrite(str(folder / "images" / f"c{k}.png"), noisy.astype(np.uint8))
        rows.append(row(20 + k, "train", image=f"images/c{k}.png", ident="AAAA/01"))
    report = check(save(folder, rows))
    assert [p.kind for p in report.problems] == ["near-duplicate"] * 40


def test_no_leakage_is_found_among_scenes_that_differ(folder, tmp_path):
    rows = data_set(folder, 120)
    report = check(save(folder, rows))
    assert report.problems == ()


def test_without_airports_it_is_said_that_they_could_not_be_looked_at(folder, rows, tmp_path):
    from shortfinal.data.formats import convert

    pytest.importorskip("yaml")
    convert(save(folder, rows), tmp_path / "yolo", "yolo")
    report = check_dataset(tmp_path / "yolo", tmp_path / "out")
    assert report.serious == ()
    assert any("no label names its airport" in note for note in report.notes)
    assert any("12 labels were not held against a runway" in note for note in report.notes)


def test_coco_with_a_camera_and_a_database_is_audited(folder, rows, tmp_path):
    import pymap3d

    from shortfinal.data.formats import convert

    # RUNWAY's corners on the equator, far end first as LARD has it.
    places = dict(zip("CDBA", RUNWAY.corners))
    entry = {}
    for name, (x, y, z) in places.items():
        latitude, longitude, height = pymap3d.enu2geodetic(x, y, z, 0.0, 0.0, 100.0)
        entry[name] = {"coordinate": {"latitude": latitude, "longitude": longitude, "altitude": height}}
    (tmp_path / "runways.json").write_text(json.dumps({f"{a}AAA": {"01": entry} for a in "ABC"}))
    spoil_corners(shifted(3, (8, 0)))(folder, rows, 4)
    convert(save(folder, rows), tmp_path / "coco", "coco")
    report = check_dataset(tmp_path / "coco", tmp_path / "out", runways=tmp_path / "runways.json", camera=CAMERA)
    assert [(p.kind, p.picture) for p in report.serious] == [("audit", "004.png")]
    assert len(report.audit.not_checked) == 0
    assert sum(len(v) for v in report.measures["glide_deg"].values()) == 12
    other = sf.Camera(100, 100, 900.0, 900.0, 49.5, 49.5)
    report = check_dataset(tmp_path / "coco", tmp_path / "out", runways=tmp_path / "runways.json", camera=other)
    assert len(report.audit.not_checked) == 12
    assert any("the camera has 100 x 100 pixels" in note for note in report.notes)


def test_rendered_scenes_are_clean(tmp_path):
    write_dataset(tmp_path / "d", 8, seed=3)
    report = check_dataset(tmp_path / "d", tmp_path / "out")
    assert report.problems == ()
    assert len(report.audit.not_checked) == 0


def test_train_and_val_in_folders_of_their_own(tmp_path):
    """Rendered with two seeds they differ; with one seed val is train's copy."""
    for name, seed in (("train", 3), ("val", 4)):
        write_dataset(tmp_path / "d" / name, 3, seed=seed)
    assert check_dataset(tmp_path / "d", tmp_path / "out").problems == ()
    shutil.rmtree(tmp_path / "d" / "val")
    write_dataset(tmp_path / "d" / "val", 2, seed=3)
    report = check_dataset(tmp_path / "d", tmp_path / "out")
    # The pictures, and the airfields they were drawn of.
    found = [(p.kind, p.picture) for p in report.serious]
    assert sorted(found) == [("leakage", "")] * 2 + [("leakage", f"val/images/00000{k}.png") for k in range(2)]


def test_wrong_arguments_and_no_data_set(tmp_path):
    with pytest.raises(sf.InputError, match="not a data set"):
        check_dataset(tmp_path, tmp_path / "out")
    with pytest.raises(sf.InputError, match="sigma_px"):
        check_dataset(tmp_path, tmp_path / "out", sigma_px=0)
    assert not (tmp_path / "out").exists()


# The real sample.


@needs_data
def test_the_real_sample_is_clean(tmp_path):
    report = check_dataset(SAMPLE, tmp_path, runways=RUNWAYS)
    assert report.serious == ()
    assert (report.pictures, report.labels) == (78, 78)
    assert len(report.audit.not_checked) == 0
    assert report.airports == {"BIRK": {"": 44}, "LFST": {"": 34}}
    glide = np.concatenate(list(report.measures["glide_deg"].values()))
    assert 2.5 < glide.min() < glide.max() < 3.5  # LARD's cone: 2.2 to 3.8 degrees


@needs_data
def test_leakage_planted_in_the_real_sample_is_found(tmp_path):
    """Split at random, both airports are in both; a copy encoded anew is found among the real pictures."""
    folder = tmp_path / "d"
    shutil.copytree(SAMPLE / "images", folder / "images")
    with open(SAMPLE / "labels.csv", newline="") as file:
        rows = list(csv.DictReader(file, delimiter=";"))
    rng = np.random.default_rng(0)
    for line in rows:
        line["split"] = str(rng.choice(["train", "val"]))
    first = rows[0]
    copy = first | {"image": "images/copy.jpg", "split": {"train": "val", "val": "train"}[first["split"]]}
    cv2.imwrite(str(folder / copy["image"]), cv2.imread(str(folder / first["image"])), [cv2.IMWRITE_JPEG_QUALITY, 50])
    with open(folder / "labels.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(copy), delimiter=";")
        writer.writeheader()
        writer.writerows([*rows, copy])
    report = check_dataset(folder, tmp_path / "out", runways=RUNWAYS)
    assert [(p.kind, p.field) for p in report.serious] == [("leakage", "airport")] * 2 + [("leakage", "")]
    assert {"copy.jpg", Path(first["image"]).name} <= {Path(w).name.strip(":,") for w in str(report.serious[2]).split()}
