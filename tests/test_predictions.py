"""Predictions made elsewhere, read and matched to labels."""

import json
from pathlib import Path

import numpy as np
import pytest

from shortfinal.data.formats import CORNER_COLUMNS
from shortfinal.data.labelled import Label, Picture
from shortfinal.data.predictions import (
    SIGMA_COLUMNS,
    Prediction,
    Target,
    match,
    read_predictions,
    triangle_text,
)
from shortfinal.errors import InputError
from shortfinal.keypoints import CORNER_NAMES

PLACES = [10.0, 20.0, 30.0, 20.0, 25.0, 5.0, 15.0, 5.0]
SIGMAS = [0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2]


def table(path: Path, *rows: dict) -> Path:
    columns = list(dict.fromkeys(name for row in rows for name in row))
    lines = [",".join(columns), *(",".join(str(row.get(name, "")) for name in columns) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


def row(image="a.png", sigma=SIGMAS, **more):
    return {"image": image, **dict(zip(CORNER_COLUMNS, PLACES)), **dict(zip(SIGMA_COLUMNS, sigma or [])), **more}


def result(**more):
    values = [n for k in range(4) for n in (*PLACES[2 * k : 2 * k + 2], 0.9)]
    return {"image_id": "a", "keypoints": values, "score": 0.8, **more}


def results(path: Path, content) -> Path:
    path.write_text(json.dumps(content))
    return path


def test_a_table_with_sigmas(tmp_path):
    (one,) = read_predictions(table(tmp_path / "p.csv", row(ident="lfpo/24", score=0.7))).found
    np.testing.assert_array_equal(one.mean_px.ravel(), PLACES)
    np.testing.assert_allclose(np.sqrt(np.diag(one.cov_px)), SIGMAS)
    assert (one.ident, one.score, one.where.rpartition(": ")[2]) == ("LFPO/24", 0.7, "line 2")


def test_a_table_with_covariances_comes_back_as_it_was_written(tmp_path):
    root = np.random.default_rng(0).normal(size=(8, 8))
    cov = root @ root.T
    (one,) = read_predictions(table(tmp_path / "p.csv", row(sigma=None, cov=triangle_text(cov)))).found
    np.testing.assert_allclose(one.cov_px, cov, rtol=1e-8)


def test_coco_results_count_from_the_corner_unless_told(tmp_path):
    path = results(tmp_path / "p.json", [result(sigma=SIGMAS)])
    (one,) = read_predictions(path).found
    np.testing.assert_allclose(one.mean_px.ravel(), np.array(PLACES) - 0.5)
    np.testing.assert_allclose(np.sqrt(np.diag(one.cov_px)), SIGMAS)
    np.testing.assert_allclose(read_predictions(path, "centre").found[0].mean_px.ravel(), PLACES)


def test_coco_with_names_in_another_order_is_brought_into_ours(tmp_path):
    order = [2, 0, 3, 1]  # the file's k-th keypoint is our order[k]-th
    values = [n for k in order for n in (*PLACES[2 * k : 2 * k + 2], 2)]
    sigma = [n for k in order for n in SIGMAS[2 * k : 2 * k + 2]]
    content = {
        "images": [{"id": 7, "file_name": "a.png"}],
        "categories": [{"id": 1, "keypoints": [CORNER_NAMES[k] for k in order]}],
        "annotations": [{"image_id": 7, "keypoints": values, "sigma": sigma}],
    }
    (one,) = read_predictions(results(tmp_path / "p.json", content), "centre").found
    assert one.image == "a.png"
    np.testing.assert_allclose(one.mean_px.ravel(), PLACES)
    np.testing.assert_allclose(np.sqrt(np.diag(one.cov_px)), SIGMAS)


DAMAGE = {
    "a place is NaN": (row(near_left_u="nan"), "near_left_u", "finite number"),
    "a place is empty": (row(far_right_v=""), "far_right_v", "finite number"),
    "a place is far away": (row(near_left_u=1e9), "near_left_u", "expected -100000"),
    "a sigma is NaN": (row(sigma=[*SIGMAS[:7], "nan"]), "far_left_sigma_v", "finite number"),
    "a sigma is zero": (row(sigma=[0, *SIGMAS[1:]]), "near_left_sigma_u", "expected 1e-06"),
    "a sigma is negative": (row(sigma=[-1, *SIGMAS[1:]]), "near_left_sigma_u", "expected 1e-06"),
    "no picture is named": (row(image=""), "image", "expected a name"),
    "a covariance is too short": (row(sigma=None, cov="1 2 3"), "cov", "36 numbers"),
    "a covariance is none": (row(sigma=None, cov=triangle_text(np.ones((8, 8)))), "cov", "positive definite"),
    "a covariance is text": (row(sigma=None, cov="x " * 36), "cov", "36 numbers"),
    "a score is text": (row(score="high"), "score", "finite number"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_bad_line_is_named_and_the_others_kept(damage, tmp_path):
    bad, field, mend = DAMAGE[damage]
    good = {**row("b.png"), **{"cov": triangle_text(np.eye(8)) if "cov" in bad else "", "score": ""}}
    good = {name: value for name, value in good.items() if name in bad}
    read = read_predictions(table(tmp_path / "p.csv", bad, good))
    assert [one.image for one in read.found] == ["b.png"]
    (problem,) = read.refused
    assert (problem.row, problem.field, problem.kind) == ("line 2", field, "prediction")
    assert mend in problem.mend


BROKEN = {
    "not an object": ("text", "result"),
    "no picture": (result(image_id=None), "image_id"),
    "two keypoints": (result(keypoints=[1, 2, 3] * 2), "keypoints"),
    "a NaN": (result(keypoints=[float("nan")] * 12), "keypoints"),
    "words": (result(keypoints=["a"] * 12), "keypoints"),
    "a sigma too few": (result(sigma=SIGMAS[:7]), "sigma"),
    "a sigma of zero": (result(sigma=[0, *SIGMAS[1:]]), "sigma"),
    "a covariance that is none": (result(cov=np.ones((8, 8)).tolist()), "cov"),
    "an infinite covariance": (result(cov=np.diag([np.inf] * 8).tolist()), "cov"),
}


@pytest.mark.parametrize("damage", BROKEN)
def test_a_bad_result_is_named_and_the_others_kept(damage, tmp_path):
    bad, field = BROKEN[damage]
    read = read_predictions(results(tmp_path / "p.json", [bad, result(image_id="b")]))
    assert [one.image for one in read.found] == ["b"]
    (problem,) = read.refused
    assert (problem.row, problem.field) == ("result 0", field)


@pytest.mark.parametrize(
    "name, content, says",
    [
        ("p.csv", "image,near_left_u\na.png,1\n", "no column near_left_v"),
        ("p.csv", ",".join(["image", *CORNER_COLUMNS, SIGMA_COLUMNS[0]]) + "\n", "no column near_left_sigma_v"),
        ("p.json", "{}", "no list of results"),
        ("p.json", "{", "not a JSON file"),
    ],
)
def test_a_file_of_no_use_is_refused(name, content, says, tmp_path):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=says):
        read_predictions(tmp_path / name)


# Matching.


def target(name, line=2, ident="", shift=0.0):
    label = Label("d/labels.csv", f"line {line}", CORNER_NAMES, np.zeros((4, 2)), np.full(4, 2, np.int8), ident)
    return Target(Picture(Path(name), name, "", None, (label,)), label, np.reshape(PLACES, (4, 2)) + shift)


def found(image, shift=0.0, **more):
    return Prediction(f"p.csv: {image}", image, np.reshape(PLACES, (4, 2)) + shift, np.eye(8), **more)


def test_a_picture_is_known_by_its_name_its_last_part_or_its_number():
    targets = [target("images/000012.png"), target("images/x.png"), target("deep/y.jpg")]
    matched, strangers = match(targets, [found("12"), found("x"), found("deep/y.jpg"), found("z")])
    assert [one.image for one in matched] == ["12", "x", "deep/y.jpg"]
    (stranger,) = strangers
    assert (stranger.kind, stranger.picture) == ("unmatched", "z")


def test_a_name_that_two_pictures_share_is_nobodys():
    matched, strangers = match([target("a/1.png"), target("b/1.png")], [found("1.png"), found("b/1.png")])
    assert [one and one.image for one in matched] == [None, "b/1.png"]
    assert "2 pictures" in strangers[0].what


def test_the_highest_score_counts():
    (best,), _ = match([target("a.png")], [found("a", 0.1, score=0.2), found("a", 3.0, score=0.9), found("a")])
    assert best.score == 0.9


def test_runways_of_one_picture_are_told_apart_by_name_else_by_place():
    near, far = target("a.png", 2, "LFPO/24", 0.0), target("a.png", 3, "LFPO/25", 50.0)
    by_name, _ = match([near, far], [found("a", 50.0, ident="LFPO/24"), found("a", 0.0, ident="LFPO/25")])
    assert [one.ident for one in by_name] == ["LFPO/24", "LFPO/25"]
    by_place, _ = match([near, far], [found("a", 51.0), found("a", 1.0)])
    assert [one.mean_px[0, 0] for one in by_place] == [11.0, 61.0]
    by_label, _ = match([near, far], [found("a", 50.0, label="labels.csv: line 2")])
    assert [one is None for one in by_label] == [False, True]
