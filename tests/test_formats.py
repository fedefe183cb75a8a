import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

import shortfinal as sf
from shortfinal.data.dataset import write_dataset
from shortfinal.data.formats import convert, open_dataset, split_by_airport
from shortfinal.data.image import read_image
from shortfinal.data.labelled import Label, Picture, split_named
from shortfinal.keypoints import CORNER_NAMES

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
WIDTH, HEIGHT = 160, 96
# In keypoint order, our pixels; the second runway's far end lies outside the picture.
FIRST = np.array([[40.25, 80.5], [71.125, 81.0], [66.75, 30.375], [58.5, 30.0]])
SECOND = np.array([[100.0, 70.0], [120.3, 71.7], [170.1, 20.2], [165.9, 19.6]])
NAMES = ["near_left", "near_right", "far_right", "far_left"]
# In another order than ours, under the names tools' users choose: near-left is second here.
TOOL_NAMES, TOOL_ORDER = ["TL", "BL", "BR", "TR"], [3, 0, 1, 2]


def picture(path, seed=0, size=(WIDTH, HEIGHT)):
    path.parent.mkdir(parents=True, exist_ok=True)
    noise = np.random.default_rng(seed).integers(0, 255, (6, 8, 3), np.uint8)
    cv2.imwrite(str(path), cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC))
    return path


def coco(named, annotations, names=NAMES, **changes):
    content = {
        "images": [{"id": k, "file_name": n, "width": WIDTH, "height": HEIGHT} for k, n in named.items()],
        "annotations": annotations,
        "categories": [{"id": 1, "name": "runway", "keypoints": names, "skeleton": [[1, 2]]}],
    }
    return content | changes


def annotation(px, number=1, image=1, visible=2, **changes):
    flat = [v for u_v in np.asarray(px).tolist() for v in (*u_v, visible)]
    return {"id": number, "image_id": image, "category_id": 1, "keypoints": flat, "num_keypoints": 4} | changes


def write_json(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


@pytest.fixture
def coco_folder(tmp_path):
    picture(tmp_path / "d" / "images" / "a.png")
    write_json(tmp_path / "d" / "labels.json", coco({1: "a.png"}, [annotation(FIRST + 0.5)]))
    return tmp_path / "d"


def yolo_line(px, width=WIDTH, height=HEIGHT, visible=2):
    share = (np.asarray(px) + 0.5) / [width, height]
    box = [*share.mean(axis=0), 0.2, 0.2]
    return " ".join(map(str, [0, *box, *(v for p in share for v in (*p, visible))])) + "\n"


YAML = """train: images/train
kpt_shape: [4, 3]
names: [runway]
kpt_names:
  0: [near_left, near_right, far_right, far_left]
"""


@pytest.fixture
def yolo_folder(tmp_path):
    pytest.importorskip("yaml")
    folder = tmp_path / "d"
    picture(folder / "images" / "train" / "a.png")
    (folder / "labels" / "train").mkdir(parents=True)
    (folder / "labels" / "train" / "a.txt").write_text(yolo_line(FIRST))
    (folder / "data.yaml").write_text(YAML)
    return folder


def snapshot(folder):
    return {p.relative_to(folder): (p.stat().st_mtime_ns, p.stat().st_size) for p in sorted(folder.rglob("*"))}


# What is read: the layouts of the tools.


def test_cvat_layout(tmp_path):
    """annotations/ beside images/<subset>/, a name of the runway among the attributes, names of our own."""
    picture(tmp_path / "images" / "train" / "a.png")
    tool = (FIRST + 0.5)[TOOL_ORDER]
    content = coco({7: "a.png"}, [annotation(tool, image=7, attributes={"runway": "lfpo/24"})], TOOL_NAMES)
    write_json(tmp_path / "annotations" / "person_keypoints_train.json", content)
    data = open_dataset(tmp_path)
    assert data.format == "COCO"
    assert not data.refused
    (read,) = data.pictures
    assert read.path == tmp_path / "images" / "train" / "a.png"
    assert (read.split, read.labels[0].ident, read.labels[0].airport) == ("train", "LFPO/24", "LFPO")
    np.testing.assert_allclose(read.labels[0].corners_px, FIRST, atol=1e-12)


def test_roboflow_layout(tmp_path):
    """One folder a split, the JSON among its pictures; a category without keypoints is passed over."""
    for split in ("train", "valid", "test"):
        picture(tmp_path / split / "a_jpg.rf.1.png")
        content = coco(
            {0: "a_jpg.rf.1.png"}, [annotation(FIRST + 0.5, image=0), {"id": 2, "image_id": 0, "category_id": 0}]
        )
        content["categories"].insert(0, {"id": 0, "name": "runways", "supercategory": "none"})
        write_json(tmp_path / split / "_annotations.coco.json", content)
    data = open_dataset(tmp_path)
    assert [p.split for p in data.pictures] == ["test", "train", "val"]
    assert {p.path.parent.name for p in data.pictures} == {"train", "valid", "test"}
    assert not data.refused
    assert len(data.notes) == 3
    assert "1 annotations of category 0, which has no keypoints" in data.notes[0]


def test_roboflow_yolo_layout(tmp_path):
    """data.yaml names ../train/images for the folder beside it, and val `valid`."""
    pytest.importorskip("yaml")
    for split in ("train", "valid"):
        picture(tmp_path / split / "images" / "a.png")
        (tmp_path / split / "labels").mkdir()
        (tmp_path / split / "labels" / "a.txt").write_text(yolo_line(FIRST))
    (tmp_path / "data.yaml").write_text(
        "train: ../train/images\nval: ../valid/images\ntest: \n"
        "kpt_shape: [4, 3]\nflip_idx: [1, 0, 3, 2]\nnames: ['runway']\nnc: 1\n"
    )
    data = open_dataset(tmp_path, corners=["0", "1", "2", "3"])
    assert [(p.split, len(p.labels)) for p in data.pictures] == [("train", 1), ("val", 1)]
    np.testing.assert_allclose(data.pictures[0].labels[0].corners_px, FIRST, atol=1e-9)
    with pytest.raises(sf.InputError, match=r"keypoints 0, 1, 2, 3: none is the near-left corner; .*--corners"):
        open_dataset(tmp_path)


def test_cvat_yolo_layout(yolo_folder):
    """train.txt lists the pictures; classes by number; two numbers a keypoint."""
    (yolo_folder / "train.txt").write_text("images/train/a.png\n")
    (yolo_folder / "labels" / "train" / "a.txt").write_text(
        " ".join(map(str, [0, 0.5, 0.5, 0.5, 0.5, *((FIRST + 0.5) / [WIDTH, HEIGHT]).ravel()]))
    )
    (yolo_folder / "data.yaml").write_text("path: ./\ntrain: train.txt\nkpt_shape: [4, 2]\nnames:\n  0: runway\n")
    (read,) = open_dataset(yolo_folder, corners="0123").pictures
    np.testing.assert_allclose(read.labels[0].corners_px, FIRST, atol=1e-9)
    assert read.labels[0].visible.tolist() == [2, 2, 2, 2]


def test_a_picture_without_labels_is_kept(yolo_folder):
    picture(yolo_folder / "images" / "train" / "b.png")
    assert [len(p.labels) for p in open_dataset(yolo_folder).pictures] == [1, 0]


@pytest.mark.parametrize("at", [(17, 9), (0, 0), (WIDTH - 1, HEIGHT - 1)])
def test_a_mark_is_read_at_the_pixel_it_was_made_on(tmp_path, at):
    """A tool's mark in the middle of a pixel is half a pixel from its corner; here it is that pixel's index."""
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[at[1], at[0]] = 255
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "a.png"), image)
    px = np.vstack([[at], FIRST[1:]]).astype(float)
    write_json(tmp_path / "tool.json", coco({1: "a.png"}, [annotation(px + 0.5)]))
    write_json(tmp_path / "indices.json", coco({1: "a.png"}, [annotation(px)]))
    pytest.importorskip("yaml")
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "a.txt").write_text(yolo_line(px))
    (tmp_path / "data.yaml").write_text(YAML.replace("images/train", "images"))
    for file, origin in (("tool.json", "corner"), ("indices.json", "centre"), ("data.yaml", "corner")):
        (read,) = open_dataset(tmp_path / file, origin=origin).pictures
        v, u = np.unravel_index(read_image(read.path)[..., 0].argmax(), (HEIGHT, WIDTH))
        np.testing.assert_allclose(read.labels[0].keypoints_px[0], [u, v], atol=1e-9)


def test_whole_numbers_are_remarked_on(coco_folder):
    write_json(coco_folder / "labels.json", coco({1: "a.png"}, [annotation(np.round(FIRST))]))
    assert "--origin centre" in open_dataset(coco_folder).notes[0]
    assert not open_dataset(coco_folder, origin="centre").notes


def test_names_of_corners_can_be_given(coco_folder):
    odd = ["c", "d", "a", "b"]
    write_json(coco_folder / "labels.json", coco({1: "a.png"}, [annotation(FIRST + 0.5)], odd))
    with pytest.raises(sf.InputError, match=r"labels\.json: category 'runway': keypoints c, d, a, b: .*--corners"):
        open_dataset(coco_folder)
    read = open_dataset(coco_folder, corners=["a", "b", "c", "d"]).pictures[0].labels[0]
    np.testing.assert_allclose(read.corners_px, FIRST[[2, 3, 0, 1]], atol=1e-12)
    for wrong in (["a", "b", "c", "c"], ["a", "b", "c", "x"], ["a", "b"]):
        with pytest.raises(sf.InputError, match="--corners"):
            open_dataset(coco_folder, corners=wrong)


@pytest.mark.parametrize("name", ["Near Left", "near-left", "bottom_left", "BL", "nearLeft"])
def test_usual_names_are_known(coco_folder, name):
    write_json(coco_folder / "labels.json", coco({1: "a.png"}, [annotation(FIRST + 0.5)], [name, *NAMES[1:]]))
    assert open_dataset(coco_folder).pictures[0].labels[0].names == CORNER_NAMES


def test_reading_order_is_not_trusted(coco_folder):
    write_json(coco_folder / "labels.json", coco({1: "a.png"}, [annotation(FIRST + 0.5)], list("ABCD")))
    with pytest.raises(sf.InputError, match="keypoints A, B, C, D"):
        open_dataset(coco_folder)


@pytest.mark.parametrize(
    "name, split",
    [("train", "train"), ("train2017", "train"), ("valid", "val"), ("person_keypoints_val2017.json", "val"),
     ("LARD_test_synth.csv", "test"), ("contest.json", ""), ("images", ""), ("constraint", "")],
)  # fmt: skip
def test_splits_are_known_by_name(name, split):
    assert split_named(name) == split


# What is written, and read again.


@pytest.fixture
def rich_folder(tmp_path):
    """Two splits, two runways in a picture, hidden and missing corners, a fifth keypoint."""
    folder, names = tmp_path / "rich", [*NAMES, "aiming_point"]
    five = np.vstack([FIRST, [[62.2, 60.6]]])
    hidden = annotation(five + 0.5, visible=1, attributes={"runway": "AAAA/01"})
    partial = annotation(np.vstack([SECOND, [[110.0, 60.0]]]) + 0.5, number=2, attributes={"runway": "AAAA/02"})
    partial["keypoints"][0:3] = [0, 0, 0]
    for split, annotations in (("train", [hidden, partial]), ("val", [annotation(five * 0.9 + 0.5)])):
        picture(folder / "images" / split / "a.png", seed=len(split))
        write_json(folder / "annotations" / f"{split}.json", coco({1: "a.png"}, annotations, names))
    return folder


@pytest.mark.parametrize("to, tolerance_px", [("coco", 1e-9), ("yolo", 1e-7)])
def test_round_trip(rich_folder, tmp_path, to, tolerance_px):
    """YOLO's ten decimals are 1e-8 px of 160; what lies outside, it cannot hold, and that is counted."""
    pytest.importorskip("yaml")
    before = snapshot(rich_folder)
    seen = []
    result = convert(rich_folder, tmp_path / "out", to, progress=lambda *n: seen.append(n))
    assert snapshot(rich_folder) == before
    assert (result.pictures, result.labels, result.splits) == (2, 3, {"train": 1, "val": 1})
    assert not result.refused
    assert seen == [(1, 2), (2, 2)]
    assert result.outside == (2 if to == "yolo" else 0)
    again = open_dataset(tmp_path / "out")
    assert not again.refused
    for one, two in zip(open_dataset(rich_folder).pictures, again.pictures, strict=True):
        assert (one.split, one.size) == (two.split, two.size)
        assert one.path.read_bytes() == two.path.read_bytes()
        for a, b in zip(one.labels, two.labels, strict=True):
            assert a.names == b.names == (*CORNER_NAMES, "aiming_point")
            kept = b.visible > 0
            assert kept.sum() == (a.visible > 0).sum() - (result.outside if a.ident == "AAAA/02" else 0)
            np.testing.assert_array_equal(a.visible[kept], b.visible[kept])
            np.testing.assert_allclose(b.keypoints_px[kept], a.keypoints_px[kept], atol=tolerance_px)
            assert np.isnan(b.keypoints_px[~kept]).all()
            assert b.ident == (a.ident if to == "coco" else "")


def test_what_coco_and_yolo_tools_expect(rich_folder, tmp_path):
    yaml = pytest.importorskip("yaml")
    convert(rich_folder, tmp_path / "c", "coco")
    content = json.loads((tmp_path / "c" / "annotations" / "keypoints_train.json").read_text())
    (category,), first = content["categories"], content["annotations"][0]
    assert category["keypoints"] == [*NAMES, "aiming_point"]
    assert category["skeleton"] == [[1, 2], [2, 3], [3, 4], [4, 1]]
    assert first["num_keypoints"] == 5
    np.testing.assert_allclose(first["bbox"], [40.75, 30.5, 71.125 - 40.25, 81.0 - 30.0])
    assert first["area"] == pytest.approx(first["bbox"][2] * first["bbox"][3])
    convert(rich_folder, tmp_path / "y", "yolo")
    described = yaml.safe_load((tmp_path / "y" / "data.yaml").read_text())
    assert described["kpt_shape"] == [5, 3]
    assert described["flip_idx"] == [1, 0, 3, 2, 4]
    assert described["names"] == {0: "runway"}
    for line in (tmp_path / "y" / "labels" / "train" / "a.txt").read_text().splitlines():
        values = np.array(line.split(), float)
        assert len(values) == 5 + 5 * 3
        shares = np.delete(values[5:], np.s_[2::3])
        assert ((shares >= 0) & (shares <= 1)).all()
        left, top = values[1:3] - values[3:5] / 2
        assert min(left, top) >= -1e-9
        assert max(left + values[3], top + values[4]) <= 1 + 1e-9


def test_rendered_scenes_become_coco_and_yolo(tmp_path):
    pytest.importorskip("yaml")
    write_dataset(tmp_path / "d", 4, seed=3)
    source = open_dataset(tmp_path / "d")
    assert source.format == "shortfinal"
    for to, tolerance in (("coco", 1e-9), ("yolo", 1e-7)):
        convert(tmp_path / "d", tmp_path / to, to, fractions=(0.5, 0.5))
        there = {p.path.name: p for p in open_dataset(tmp_path / to).pictures}
        assert sorted(p.split for p in there.values()) == ["train", "train", "val", "val"]
        for one in source.pictures:
            px = there[one.path.name].labels[0].keypoints_px
            np.testing.assert_allclose(px, one.labels[0].keypoints_px, atol=tolerance)


def test_pictures_without_a_runway_and_corners_beyond_the_border_are_kept(tmp_path):
    """Of eight views, the third is of land and four show one end only (test_dataset.py)."""
    pytest.importorskip("yaml")
    write_dataset(tmp_path / "d", 8, seed=5)
    source = {p.path.name: p for p in open_dataset(tmp_path / "d").pictures}
    assert [len(p.labels) for p in source.values()] == [1, 1, 0, 1, 1, 1, 1, 1]
    for to in ("coco", "yolo"):
        result = convert(tmp_path / "d", tmp_path / to, to, fractions=(0.5, 0.5))
        assert (result.pictures, result.labels, result.refused) == (8, 7, ())
        assert result.splits == {"train": 4, "val": 4}
        there = {p.path.name: p for p in open_dataset(tmp_path / to).pictures}
        assert there.keys() == source.keys()
        beyond = 0
        for name, one in source.items():
            assert len(there[name].labels) == len(one.labels)
            for label, other in zip(one.labels, there[name].labels):
                share = (label.keypoints_px + 0.5) / one.size
                labelled = label.visible > 0
                outside = labelled & ((share < 0) | (share > 1)).any(axis=1)
                beyond += outside.sum()
                kept = labelled & ~outside if to == "yolo" else labelled
                assert (other.visible == np.where(kept, 2, 0)).all()
                np.testing.assert_allclose(other.keypoints_px[kept], label.keypoints_px[kept], atol=1e-6)
        assert beyond >= 8
        assert result.outside == (beyond if to == "yolo" else 0)
    text = (tmp_path / "yolo" / "labels").rglob("000002.txt")
    assert [file.read_text() for file in text] == [""]  # how YOLO says that there is nothing


def test_equal_names_do_not_overwrite_one_another(tmp_path):
    names = ["x/a.png", "y/a.png", "a.jpg", "x_a.png"]
    for k, name in enumerate(names):
        picture(tmp_path / "d" / name, seed=k)
    marks = [annotation(FIRST + k, number=k, image=k) for k in range(4)]
    write_json(tmp_path / "d" / "labels.json", coco(dict(enumerate(names)), marks))
    pytest.importorskip("yaml")
    for to in ("coco", "yolo"):
        convert(tmp_path / "d", tmp_path / to, to)
        there = open_dataset(tmp_path / to).pictures
        assert len({p.path for p in there}) == 4
        content = {p.path.read_bytes(): p.labels[0].keypoints_px[0, 0] for p in there}
        for k, name in enumerate(names):
            assert content[(tmp_path / "d" / name).read_bytes()] == pytest.approx(FIRST[0, 0] + k - 0.5)


def test_whole_or_not_at_all(coco_folder, tmp_path):
    with pytest.raises(sf.InputError, match="expected coco or yolo"):
        convert(coco_folder, tmp_path / "out", "voc")
    # Labels of two kinds, which YOLO cannot hold: found while writing.
    content = coco({1: "a.png"}, [annotation(FIRST), annotation([*FIRST, [1, 1]], 2, category_id=2)])
    content["categories"].append({"id": 2, "name": "long", "keypoints": [*NAMES, "papi"]})
    write_json(coco_folder / "labels.json", content)
    with pytest.raises(sf.InputError, match="labels of 2 kinds"):
        convert(coco_folder, tmp_path / "out", "yolo")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["d"]
    convert(coco_folder, tmp_path / "out", "coco")
    with pytest.raises(sf.InputError, match=r"out: is there already; choose an empty folder"):
        convert(coco_folder, tmp_path / "out", "coco")
    (tmp_path / "b.partial").mkdir()
    with pytest.raises(sf.InputError, match=r"b\.partial: left by a conversion that was stopped"):
        convert(coco_folder, tmp_path / "b", "coco")
    assert (tmp_path / "b.partial").is_dir()


def test_stopped_in_the_middle_nothing_is_left(rich_folder, tmp_path):
    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        convert(rich_folder, tmp_path / "out", "coco", progress=stop)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["rich"]


def test_pictures_that_are_wrong_are_left_out_and_told(coco_folder, tmp_path):
    images = coco_folder / "images"
    picture(images / "b.png", size=(64, 64))
    (images / "c.png").write_bytes(b"no picture")
    names = {1: "a.png", 2: "b.png", 3: "c.png", 4: "d.png"}
    write_json(coco_folder / "labels.json", coco(names, [annotation(FIRST, k, k) for k in names]))
    result = convert(coco_folder, tmp_path / "out", "coco")
    assert (result.pictures, result.labels) == (1, 1)
    told = [str(p) for p in result.refused]
    assert "b.png: 64 x 64 pixels, but its labels say 160 x 96" in told[0]
    assert "c.png: cannot be read as an image" in told[1]
    assert "d.png: no such image" in told[2]
    (images / "a.png").unlink()
    with pytest.raises(sf.InputError, match=r"no sound picture to write; the first: .*no such image"):
        convert(coco_folder, tmp_path / "none", "coco")


# Splits by airport.


def at(airport, count, first=0):
    px, seen = FIRST, np.full(4, 2, np.int8)
    label = Label("f", "line 2", CORNER_NAMES, px, seen, ident=f"{airport}/01" if airport else "")
    return [Picture(Path("a"), f"{airport}{first + k}", "", None, (label,)) for k in range(count)]


@pytest.mark.parametrize("seed", range(5))
def test_no_airport_is_in_two_splits(seed):
    rng = np.random.default_rng(seed)
    pictures = [p for k in range(30) for p in at(f"A{k:03d}", int(rng.integers(1, 40)))]
    splits = split_by_airport(pictures, (0.7, 0.2, 0.1), seed)
    airports = {}
    for picture_, split in zip(pictures, splits, strict=True):
        airports.setdefault(picture_.labels[0].airport, set()).add(split)
    assert all(len(where) == 1 for where in airports.values())
    # Greedy by size, largest first: a share is off by less than one airport.
    for split, share in zip(("train", "val", "test"), (0.7, 0.2, 0.1)):
        assert abs(splits.count(split) - share * len(pictures)) < 40
    shuffled = rng.permutation(len(pictures))
    again = split_by_airport([pictures[k] for k in shuffled], (0.7, 0.2, 0.1), seed)
    assert [splits[k] for k in shuffled] == again


def test_every_split_gets_an_airport():
    pictures = at("BIG", 1000) + at("AAA", 1) + at("BBB", 1)
    splits = split_by_airport(pictures, (0.9, 0.05, 0.05))
    assert sorted({split: splits.count(split) for split in splits}.values()) == [1, 1, 1000]


def test_pictures_without_a_runway_go_one_by_one():
    land = [Picture(Path(f"land{k}.png"), f"land{k}", "", None, ()) for k in range(40)]
    splits = split_by_airport(at("AAA", 30) + at("BBB", 30) + land, (0.5, 0.5))
    assert len(set(splits[:30])) == len(set(splits[30:60])) == 1
    assert splits[0] != splits[30]
    assert sorted((splits[60:].count("train"), splits[60:].count("val"))) == [20, 20]


@pytest.mark.parametrize(
    "pictures, fractions, message",
    [
        (at("AAA", 3), (0.5, 0.5), "1 airports cannot fill 2 splits: AAA"),
        (at("AAA", 3) + at("", 1), (1.0,), "1 pictures are at no known airport"),
        (at("AAA", 3), (0.5, 0.6), "add up to 1"),
        (at("AAA", 3), (1.5, -0.5), "add up to 1"),
        (at("AAA", 3), (float("nan"), 0.5), "add up to 1"),
    ],
)
def test_a_split_that_cannot_be_is_refused(pictures, fractions, message):
    with pytest.raises(sf.InputError, match=message):
        split_by_airport(pictures, fractions)


# Damage: one line each, and the sound rest is kept.

GOOD = annotation(FIRST + 0.5, number=9)


def with_annotation(**changes):
    return lambda: coco({1: "a.png"}, [GOOD, annotation(FIRST, **changes)])


def with_images(*entries):
    return lambda: coco(
        {1: "a.png"}, [GOOD], images=[{"id": 1, "file_name": "a.png", "width": WIDTH, "height": HEIGHT}, *entries]
    )


@pytest.mark.parametrize(
    "content, words",
    [
        (with_annotation(image_id=5), ["annotation 1: image_id", "no image 5"]),
        (with_annotation(image_id=None), ["annotation 1: image_id", "no image None"]),
        (with_annotation(image_id=[1]), ["annotation 1: image_id", "no image [1]"]),
        (with_annotation(category_id=[1]), ["annotation 1: category_id", "no category [1]"]),
        (with_annotation(category_id=3), ["annotation 1: category_id", "no category 3", "the file has 1"]),
        (with_annotation(id=9), ["annotation 9: id", "stands there twice"]),
        (with_annotation(keypoints=None), ["annotation 1: keypoints", "are None", "4 keypoints"]),
        (with_annotation(keypoints=[1.0, 2.0, 2]), ["annotation 1: keypoints", "3 numbers", "of 4 keypoints"]),
        (with_annotation(keypoints=[float("nan"), *[1] * 11]), ["annotation 1: keypoints", "nan", "finite"]),
        (with_annotation(keypoints=[float("inf"), *[1] * 11]), ["annotation 1: keypoints", "inf", "finite"]),
        (with_annotation(keypoints=["1", *[1] * 11]), ["annotation 1: keypoints", "'1'", "finite"]),
        (with_annotation(keypoints=[1e9, *[1] * 11]), ["annotation 1: keypoints", "1e+09 is no pixel"]),
        (with_annotation(visible=-1), ["annotation 1: keypoints", "visibility -1"]),
        (with_annotation(visible=3), ["annotation 1: keypoints", "visibility 3"]),
        (with_annotation(visible=0), ["annotation 1: keypoints", "no keypoint is labelled"]),
        (lambda: coco({1: "a.png"}, [GOOD, 7]), ["annotations[1]", "7 is no annotation"]),
        (with_images({"id": 2, "file_name": "b.png"}), ["images[1]: width", "width is None"]),
        (with_images({"id": 2, "file_name": "b.png", "width": 0, "height": 4}), ["images[1]: width", "width is 0"]),
        (with_images({"id": 2, "width": 3, "height": 4}), ["images[1]: file_name", "file_name is None"]),
        (with_images({"file_name": "b.png", "width": 3, "height": 4}), ["images[1]: id", "id is None"]),
        (with_images({"id": 2, "file_name": "a.png", "width": WIDTH, "height": HEIGHT}),
         ["images[1]: file_name", "a.png stands there twice"]),
        (with_images("b.png"), ["images[1]", "'b.png' is no image"]),
    ],
)  # fmt: skip
def test_a_bad_annotation_is_one_line_and_the_rest_is_kept(coco_folder, content, words):
    write_json(coco_folder / "labels.json", content())
    data = open_dataset(coco_folder)
    (problem,) = data.refused
    for word in ["labels.json", *words]:
        assert word in str(problem)
    assert "\n" not in str(problem)
    assert problem.mend
    assert len(data.pictures[0].labels) == 1
    np.testing.assert_allclose(data.pictures[0].labels[0].corners_px, FIRST, atol=1e-12)


def test_an_image_id_that_stands_there_twice_is_nobodys(coco_folder):
    twice = [{"id": 1, "file_name": f"{n}.png", "width": WIDTH, "height": HEIGHT} for n in "ab"]
    write_json(coco_folder / "labels.json", coco({}, [GOOD], images=twice))
    data = open_dataset(coco_folder)
    assert not data.pictures
    assert [("stands there 2 times" in p.what) for p in data.refused] == [True, True, False]
    assert "no image 1" in str(data.refused[2])


@pytest.mark.parametrize(
    "text, words",
    [
        (b'{"images": [], "annotations": [{"id"', ["labels.json", "not a JSON file"]),
        (b'{"images": [], "annotations": []}', ["labels.json", "no list 'categories'"]),
        (b'{"images": {}, "annotations": [], "categories": []}', ["labels.json", "no list 'images'"]),
        (json.dumps(coco({}, [], ["a"])).encode(), ["labels.json", "keypoints a: none is the near-left"]),
        (json.dumps(coco({}, [], categories=[])).encode(), ["no category has keypoints (categories: none)"]),
        (json.dumps(coco({}, [], categories=[{"id": 1, "name": "x"}])).encode(), ["(categories: 'x')"]),
        (json.dumps(coco({}, [], categories=[{"name": "x"}])).encode(), ["categories[0] has no id"]),
        (json.dumps(coco({}, [], categories=2 * [{"id": 1}])).encode(), ["category id 1 stands there twice"]),
        (json.dumps(coco({}, [], {"a": 1})).encode(), ["keypoints must be a list of names"]),
    ],
)
def test_a_file_that_is_no_coco_is_refused(coco_folder, text, words):
    (coco_folder / "labels.json").write_bytes(text)
    with pytest.raises(sf.InputError) as caught:
        open_dataset(coco_folder)
    for word in words:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "line, words",
    [
        ("0 0.5 0.5 0.1 0.1", ["5 numbers; expected 17"]),
        (yolo_line(FIRST).replace("0 ", "7 ", 1), ["class is 7", "data.yaml has 0"]),
        (yolo_line(FIRST).replace("0 ", "-1 ", 1), ["class is -1"]),
        (yolo_line(FIRST * 10), ["keypoint is", "from 0 to 1"]),
        (yolo_line(FIRST - 100), ["keypoint is -", "from 0 to 1"]),
        ("0 1.5 0.5 0.1 0.1 " + " ".join(["0.5 0.5 2"] * 4), ["box is 1.5"]),
        (yolo_line(FIRST, visible=-1), ["visibility is -1"]),
        (yolo_line(FIRST, visible=0), ["no keypoint is labelled"]),
        (yolo_line(FIRST, visible="nan"), ["nan among the numbers"]),
        (yolo_line(FIRST, visible="two"), ["holds more than numbers"]),
    ],
)
def test_a_bad_line_is_one_line_and_the_rest_is_kept(yolo_folder, line, words):
    file = yolo_folder / "labels" / "train" / "a.txt"
    file.write_text(yolo_line(FIRST) + "\n" + line)
    data = open_dataset(yolo_folder)
    (problem,) = data.refused
    for word in ["a.txt", "line 3", *words]:
        assert word in str(problem)
    assert "\n" not in str(problem)
    assert len(data.pictures[0].labels) == 1


def test_labels_that_are_no_text_or_have_no_image(yolo_folder):
    (yolo_folder / "labels" / "train" / "a.txt").write_bytes(b"\xff\xfe\x00")
    (yolo_folder / "labels" / "train" / "b.txt").write_text(yolo_line(FIRST))
    not_text, alone = open_dataset(yolo_folder).refused
    assert "a.txt: not a text file" in str(not_text)
    assert "b.txt: labels without an image" in str(alone)


@pytest.mark.parametrize(
    "text, words",
    [
        (YAML.replace("[4, 3]", "[3, 3]"), ["kpt_shape is [3, 3]", "[4, 2] or [4, 3]"]),
        (YAML.replace("[4, 3]", "[4, 4]"), ["kpt_shape is [4, 4]"]),
        (YAML.replace("[4, 3]", "12"), ["kpt_shape is 12"]),
        (YAML.replace("kpt_shape: [4, 3]\n", ""), ["kpt_shape is None"]),
        (YAML.replace("[4, 3]", "[5, 3]"), ["class 'runway'", "kpt_names is", "expected 5 names"]),
        (YAML.replace("names: [runway]", "names: 3"), ["names is 3"]),
        (YAML.replace("images/train", "images/nowhere"), ["train", "nowhere: no such folder"]),
        (YAML.replace("train: images/train", "train: [3]"), ["train is 3"]),
        (YAML.replace("train: images/train", "train: labels"), ["name no images"]),
        (YAML + "x: [1, 2", ["not a YAML file"]),
        (YAML + "x: \x01", ["not a YAML file"]),
        ("# kpt_shape\njust words", ["found 'just words'"]),
    ],
)
def test_a_yaml_that_describes_no_keypoints_is_refused(yolo_folder, text, words):
    (yolo_folder / "data.yaml").write_text(text)
    with pytest.raises(sf.InputError) as caught:
        open_dataset(yolo_folder)
    for word in ["data.yaml", *words]:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_no_data_set_is_told_what_was_looked_for(tmp_path):
    with pytest.raises(sf.InputError, match="no such folder"):
        open_dataset(tmp_path / "nowhere")
    (tmp_path / "notes.json").write_text("[1, 2]")
    (tmp_path / "table.csv").write_text("a,b\n1,2\n")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    for where in (tmp_path, tmp_path / "notes.json", tmp_path / "table.csv"):
        with pytest.raises(sf.InputError, match=r"not a data set; looked for labels\.csv .*COCO .*YOLO"):
            open_dataset(where)


def test_two_formats_in_one_folder_are_not_guessed_between(coco_folder):
    (coco_folder / "data.yaml").write_text(YAML)
    with pytest.raises(sf.InputError, match=r"COCO \(labels.json\) and YOLO \(data.yaml\); name the file"):
        open_dataset(coco_folder)
    assert open_dataset(coco_folder / "labels.json").format == "COCO"


def test_rows_of_our_own_table_are_refused_one_by_one(tmp_path):
    write_dataset(tmp_path, 3, seed=3)
    header, first, second, third = (tmp_path / "labels.csv").read_text().splitlines()
    last = header.split(",").index("far_left_v")

    def without(value):
        return ",".join([*second.split(",")[:last], value, *second.split(",")[last + 1 :]])

    # The last: seven numbers of eight are not no runway.
    bad = [without("nan"), third.rsplit(",", 1)[0], first.replace("images/000000.png", ""), without("")]
    (tmp_path / "labels.csv").write_text("\n".join([header, first, *bad]))
    data = open_dataset(tmp_path)
    assert len(data.pictures) == 1
    assert [(p.row, p.field) for p in data.refused] == [
        ("line 3", "far_left_v"), ("line 4", ""), ("line 5", "image"), ("line 6", "far_left_v"),
    ]  # fmt: skip


@pytest.mark.skipif(not (DATA / "lard_sample").exists(), reason="shared/data is not here: no real LARD labels to read")
def test_the_real_sample_becomes_coco_and_yolo_in_stored_pixels(tmp_path):
    pytest.importorskip("yaml")
    with open(DATA / "lard_sample" / "labels.csv", newline="") as file:
        rows = {Path(row["image"]).name: row for row in csv.DictReader(file, delimiter=";")}
    for to in ("coco", "yolo"):
        result = convert(DATA / "lard_sample", tmp_path / to, to, fractions=(0.5, 0.5))
        assert (result.pictures, result.labels, result.refused) == (78, 78, ())
        assert sorted(result.splits.values()) == [34, 44]  # LFST and BIRK
        for read in open_dataset(tmp_path / to).pictures:
            row = rows[read.path.name]
            full = np.array([[float(row[f"x_{n}"]), float(row[f"y_{n}"])] for n in ("BL", "BR", "TR", "TL")])
            stored = (full + 0.5) * [640 / 2448, 640 / 2648] - 0.5
            np.testing.assert_allclose(read.labels[0].corners_px, stored, atol=1e-6)
