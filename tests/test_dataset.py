import csv
import shutil

import cv2
import numpy as np
import pytest

import shortfinal as sf
from shortfinal.data.dataset import plan_shot, read_dataset, read_image, write_dataset
from shortfinal.files import write_whole


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes")
    write_dataset(path, 6, seed=3)
    return path


def test_labels_agree_with_the_camera_of_their_row(folder):
    with (folder / "labels.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row, example in zip(rows, read_dataset(folder)):
        v = {k: float(row[k]) for k in row if k != "image"}
        camera = sf.Camera(int(v["width"]), int(v["height"]), v["fx"], v["fy"], v["cx"], v["cy"])
        pose = sf.Pose.from_attitude([v["x_m"], v["y_m"], v["z_m"]], v["yaw_deg"], v["pitch_deg"], v["roll_deg"])
        px = sf.project(camera, pose, sf.Runway(v["length_m"], v["width_m"]).corners)
        np.testing.assert_allclose(example.corners_px, px, atol=1e-3)
        assert example.image.shape == (camera.height, camera.width, 3)
        assert (px > -0.5).all()
        assert (px < camera.width - 0.5).all()


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


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda text: text.replace("near_left_u", "left_u"), "lacks the columns near_left_u"),
        (lambda text: "\n".join([*text.splitlines()[:2], text.splitlines()[2].rsplit(",", 1)[0] + ",nan"]),
         "line 3: far_left_v is 'nan'"),
        (lambda text: text.splitlines()[0], "no rows"),
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
    with pytest.raises(sf.InputError, match="cannot read the labels"):
        read_dataset(tmp_path / "nowhere")


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
