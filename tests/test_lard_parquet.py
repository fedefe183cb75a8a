"""LARD v2 from parquet: files written here with the columns of the real metadata, pictures as the hub stores them."""

import builtins
import csv

import cv2
import numpy as np
import pytest
from test_lard import V2_HEAD, see, v2_row

import shortfinal as sf
from shortfinal.data.fetch import LARD_V2_SUBSETS
from shortfinal.data.lard import LARD_V2, read_labels
from shortfinal.data.parquet import stream_lard_v2

pa = pytest.importorskip("pyarrow", reason="the extra data is not installed")
pq = pytest.importorskip("pyarrow.parquet")
pytest.importorskip("datasets")

TEXT = ("image", "type", "original_dataset", "scenario", "airport", "runway", "time", "runway_in_cone")


def rows_like_the_head(count):
    """The real metadata's first rows where they are at hand, else rows of its columns."""
    if V2_HEAD.exists():
        with open(V2_HEAD, newline="") as file:
            head = list(csv.DictReader(file, delimiter=";"))
    else:
        head = [v2_row(np.round(see() / 4), width="1024", height="1024", weather="")]
    return [head[k % len(head)] | {"image": f"{k:03d}.jpg"} for k in range(count)]


def picture(number):
    image = np.full((40, 40, 3), (number, 100, 200), np.uint8)  # blue, green, red for OpenCV
    return cv2.imencode(".png", image)[1].tobytes()


def value(name, cell):
    """As a parquet file holds it: text, numbers, nothing."""
    if cell == "":
        return None
    if name in TEXT:
        return cell
    number = float(cell)
    return int(number) if number.is_integer() and name[:2] in ("x_", "y_", "wi", "he") else number


def write(path, rows, pictures=None, row_group_size=5):
    path.parent.mkdir(parents=True, exist_ok=True)
    columns = {name: [value(name, row[name]) for row in rows] for name in rows[0] if name != "image"}
    pictures = pictures or [picture(k) for k in range(len(rows))]
    columns["image"] = [{"bytes": p, "path": row["image"]} for p, row in zip(pictures, rows)]
    pq.write_table(pa.table(columns), path, row_group_size=row_group_size)
    return path


def test_pictures_and_labels_come_row_by_row(tmp_path):
    rows = rows_like_the_head(9)
    write(tmp_path / "flsim" / "train-00000-of-00002.parquet", rows[:6])
    write(tmp_path / "flsim" / "train-00001-of-00002.parquet", rows[6:])
    write(tmp_path / "flsim" / "test-00000-of-00001.parquet", rows[:1])
    pairs = list(stream_lard_v2(tmp_path, "flsim", "train"))
    assert [label.image for _, label in pairs] == [row["image"] for row in rows]
    for image, _ in pairs:
        assert (image.shape, image.dtype) == ((40, 40, 3), np.uint8)
        assert image[0, 0, :2].tolist() == [200, 100]  # red first
    assert pairs[4][0][0, 0, 2] == 4
    assert len(list(stream_lard_v2(tmp_path, "flsim", "test"))) == 1


@pytest.mark.skipif(not V2_HEAD.exists(), reason="shared/data is not here: no real LARD labels to read")
def test_the_labels_are_those_of_the_csv(tmp_path):
    write(tmp_path / "train.parquet", rows_like_the_head(3))
    for from_csv, (_, label) in zip(read_labels(V2_HEAD), stream_lard_v2(tmp_path, "flsim"), strict=True):
        np.testing.assert_array_equal(label.corners_px, from_csv.corners_px)
        assert (label.ident, label.camera, label.distance_m) == (from_csv.ident, LARD_V2, from_csv.distance_m)
        assert (label.picture, label.flight) == (from_csv.picture, from_csv.flight)


def test_it_streams(tmp_path):
    """The first row arrives although a later file is damaged, which is told when it is reached."""
    rows = rows_like_the_head(4)
    write(tmp_path / "ges" / "train-00000.parquet", rows)
    (tmp_path / "ges" / "train-00001.parquet").write_bytes(b"PAR1, and then nothing")
    write(tmp_path / "ges" / "train-00002.parquet", rows)
    refused = []
    stream = stream_lard_v2(tmp_path, "ges", refused=refused.append)
    assert next(stream)[1].image == "000.jpg"
    assert not refused
    assert len(list(stream)) == 7
    (refusal,) = refused
    assert "train-00001.parquet: not a whole parquet file" in refusal.message
    assert "\n" not in refusal.message


def test_memory_does_not_grow_with_the_set(tmp_path):
    """pyarrow reads ahead, but within a file: of ten files of 6 MB no more than two are ever held."""
    rng = np.random.default_rng(0)
    for file in range(10):
        pictures = [cv2.imencode(".bmp", rng.integers(0, 256, (256, 256, 3), np.uint8))[1].tobytes() for _ in range(30)]
        path = write(tmp_path / f"train-{file:05d}.parquet", rows_like_the_head(30), pictures)
    size = path.stat().st_size
    assert size > 5.8e6
    before, most, count = pa.total_allocated_bytes(), 0, 0
    for _ in stream_lard_v2(tmp_path, "flsim"):
        most, count = max(most, pa.total_allocated_bytes() - before), count + 1
    assert count == 300
    assert most < 2.5 * size


def test_bad_rows_and_pictures_are_told_and_the_rest_kept(tmp_path):
    rows = rows_like_the_head(6)
    rows[1]["x_TL"] = ""
    rows[2]["airport"] = ""
    jpeg = cv2.imencode(".jpg", np.zeros((64, 64, 3), np.uint8))[1].tobytes()
    pictures = [picture(0), picture(1), picture(2), jpeg[: len(jpeg) // 2], b"", picture(5)]
    path = write(tmp_path / "train.parquet", rows, pictures)
    refused = []
    kept = [label.image for _, label in stream_lard_v2(tmp_path, "xplane", refused=refused.append)]
    assert kept == ["000.jpg", "005.jpg"]
    assert [refusal.line for refusal in refused] == [2, 3, 4, 5]
    words = ("x_TL is ''", "airport is ''", "003.jpg: truncated JPEG", "004.jpg: cannot be read as an image")
    for refusal, word in zip(refused, words, strict=True):
        assert refusal.message.startswith(f"{path}: line {refusal.line}: ")
        assert word in refusal.message


def test_the_camera_may_be_given(tmp_path):
    write(tmp_path / "train.parquet", rows_like_the_head(1))
    other = sf.Camera(1024, 1024, 900, 900, 511.5, 511.5)
    ((_, label),) = stream_lard_v2(tmp_path, "arcgis", camera=other)
    assert label.camera == other


def test_what_cannot_be_streamed_is_refused_at_once(tmp_path, monkeypatch):
    with pytest.raises(sf.InputError, match=f"subset 'bing': LARD v2 has {', '.join(LARD_V2_SUBSETS)}"):
        stream_lard_v2(tmp_path, "bing")
    with pytest.raises(sf.InputError, match=r"holds neither flsim/train\*\.parquet nor train\*\.parquet"):
        stream_lard_v2(tmp_path, "flsim")
    with pytest.raises(sf.InputError, match="no such folder"):
        stream_lard_v2(tmp_path / "absent", "flsim")
    pq.write_table(pa.table({"image": [{"bytes": b"", "path": "a"}], "label": [1]}), tmp_path / "train.parquet")
    with pytest.raises(sf.InputError, match=r"train\.parquet: no column"):
        next(stream_lard_v2(tmp_path, "flsim"))
    real = builtins.__import__

    def without(name, *arguments, **options):
        if name == "datasets":
            raise ImportError(name)
        return real(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(sf.InputError, match=r"pip install 'shortfinal\[data\]'"):
        stream_lard_v2(tmp_path, "flsim")
