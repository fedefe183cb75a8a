import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from small import INFO, MEAN, constant_model, labelled_folder, named

import shortfinal as sf
from shortfinal.calibrate import calibrate
from shortfinal.calibration import fit_calibration
from shortfinal.crops import box_around, centre_crop

pytest.importorskip("onnx")

IDENTS = ("BIRK/01", "LFPO/24", "BIRK/19")
COV = np.diag(np.linspace(0.5, 3.0, 8)) + 0.1


def errors_of(corners):
    """What the constant model's errors are (N, 8), in pixels of its crops of these runways."""
    windows = [centre_crop(box_around(c), INFO.margin, INFO.size) for c in corners]
    return np.array([(MEAN - w.apply(c)).ravel() for w, c in zip(windows, corners)])


def fitted_to(errors, fitted_on):
    return fit_calibration(errors, np.tile(np.sqrt(np.diag(COV)), (len(errors), 1)), fitted_on)


def assert_same(got, want):
    for name in ("sigma_scale", "bounds"):  # the network's sigmas are float32
        np.testing.assert_allclose(getattr(got, name), getattr(want, name), rtol=1e-6)
    assert (got.count, got.fitted_on, got.levels) == (want.count, want.fitted_on, want.levels)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "pictures"
    return path, labelled_folder(path, 90, IDENTS)


@pytest.fixture
def model(tmp_path):
    return constant_model(tmp_path / "m.onnx", cov=COV)


def test_a_model_is_calibrated_on_what_it_gets_wrong(folder, model, tmp_path):
    data, corners = folder
    steps = []
    calibration = calibrate(model, data, tmp_path / "out.onnx", progress=lambda done, of: steps.append((done, of)))
    assert_same(calibration, fitted_to(errors_of(corners), "90 runways of pictures"))
    assert steps == [(n, 90) for n in range(1, 91)]
    detector, before = sf.KeypointDetector(tmp_path / "out.onnx"), sf.KeypointDetector(model)
    assert detector.info == dataclasses.replace(before.info, calibration=calibration)
    window = sf.PixelWindow(0, 0, 32, 32, 32, 32)
    picture = np.zeros((32, 32, 3), np.uint8)
    ratio = detector.detect(picture, window).sigma_px / before.detect(picture, window).sigma_px
    np.testing.assert_allclose(ratio.ravel(), calibration.sigma_scale)


def test_calibrating_twice_is_calibrating_once(folder, model):
    first = calibrate(model, folder[0], model)
    once = model.read_bytes()
    assert calibrate(model, folder[0], model) == first
    assert model.read_bytes() == once


@pytest.mark.parametrize(
    ("airports", "chosen"), [(["birk"], (0, 2)), (["BIRK/01"], (0,)), (["LFPO", "BIRK/19"], (1, 2))]
)
def test_only_the_airports_that_are_named(folder, model, tmp_path, airports, chosen):
    data, corners = folder
    of_these = corners[np.isin(np.arange(90) % 3, chosen)]
    calibration = calibrate(model, data, tmp_path / "out.onnx", airports)
    where = ", ".join(sorted(airports))
    assert_same(calibration, fitted_to(errors_of(of_these), f"{30 * len(chosen)} runways of pictures at {where}"))


def test_corners_beyond_the_picture_do_not_count(model, tmp_path):
    # Every third runway begins before the picture does; it is framed by its far end.
    corners = labelled_folder(tmp_path / "data", 90)
    text = (tmp_path / "data" / "labels.csv").read_text().splitlines()
    for n in range(0, 90, 3):
        corners[n, :2, 1] = 60
        text[n + 1] = ",".join([f"images/{n}.png", "LFPO/24", *map(str, corners[n].ravel())])
    (tmp_path / "data" / "labels.csv").write_text("\n".join(text))
    calibration = calibrate(model, tmp_path / "data", tmp_path / "out.onnx")
    errors = errors_of(corners)
    windows = [centre_crop(box_around(c[2:]), INFO.margin, INFO.size) for c in corners[::3]]
    errors[::3] = [(MEAN - w.apply(c)).ravel() for w, c in zip(windows, corners[::3])]
    errors[::3, :4] = np.nan
    assert_same(calibration, fitted_to(errors, "90 runways of data"))
    assert calibration.count == (60,) * 4 + (90,) * 4


def test_further_keypoints_are_known_by_name(tmp_path):
    # COCO keypoints, in another order, one more than the corners and hidden in half of the pictures.
    corners = labelled_folder(tmp_path / "data", 60)
    (tmp_path / "data" / "labels.csv").unlink()
    names = ["aim", "BL", "BR", "TR", "TL"]
    aims = corners.mean(axis=1)
    keypoints = [
        [*((*aim + 0.5, 2) if n % 2 else (0, 0, 0)), *np.column_stack([c + 0.5, [2] * 4]).ravel()]
        for n, (aim, c) in enumerate(zip(aims, corners))
    ]
    (tmp_path / "data" / "labels.json").write_text(json.dumps({
        "images": [{"id": n, "file_name": f"images/{n}.png", "width": 64, "height": 48} for n in range(60)],
        "annotations": [{"id": n, "image_id": n, "category_id": 1, "keypoints": [float(v) for v in k],
                         "num_keypoints": 4} for n, k in enumerate(keypoints)],
        "categories": [{"id": 1, "name": "runway", "keypoints": names}],
    }))  # fmt: skip
    mean = np.vstack([MEAN, MEAN.mean(axis=0)])
    model = constant_model(tmp_path / "m.onnx", named(INFO, "aim"), mean, cov=np.eye(10))
    calibration = calibrate(model, tmp_path / "data", model)
    windows = [centre_crop(box_around(c), INFO.margin, INFO.size) for c in corners]
    points = np.concatenate([corners, aims[:, None]], axis=1)
    errors = np.array([(mean - w.apply(p)).ravel() for w, p in zip(windows, points)])
    errors[::2, 8:] = np.nan
    assert_same(calibration, fit_calibration(errors, np.ones_like(errors), "60 runways of data"))


@pytest.mark.parametrize(
    ("airports", "message"),
    [
        (["KSFO", "LFPO"], "no runway at KSFO; its labels have BIRK, LFPO"),
        (["LFPO/06"], "no runway at LFPO/06"),
    ],
)
def test_an_airport_that_is_not_there_is_named(folder, model, airports, message):
    with pytest.raises(sf.InputError, match=message):
        calibrate(model, folder[0], model, airports)


def test_too_few_runways_leave_the_model_as_it_was(model, tmp_path):
    labelled_folder(tmp_path / "data", 19)
    before = model.read_bytes()
    with pytest.raises(sf.InputError, match=r"data: 19 runways of data: .* at least 20"):
        calibrate(model, tmp_path / "data", model)
    with pytest.raises(sf.InputError, match=r"absent: no such folder"):
        calibrate(model, tmp_path / "absent", model)
    with pytest.raises(sf.InputError, match="no such model file"):
        calibrate(tmp_path / "absent.onnx", tmp_path / "data", model)
    assert model.read_bytes() == before


def test_nothing_in_the_file_says_where_it_was_made(folder, model):
    calibrate(model, folder[0], model)
    assert str(Path(folder[0]).parent).encode() not in model.read_bytes()
