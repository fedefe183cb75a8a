import numpy as np
import pytest
from test_pose import CAMERA, RUNWAY, on_approach

import shortfinal as sf
from shortfinal.evaluate.frames import corner_figures, evaluate
from shortfinal.pipeline import FrameResult


def result(distance, shift=0.0):
    px = sf.project(CAMERA, on_approach(distance), RUNWAY.corners)
    px[2:] += shift
    kp = sf.GaussianKeypoints.from_sigma(px, 0.5)
    est = sf.estimate_pose(kp, RUNWAY.corners, CAMERA)
    return FrameResult(0.0, None, kp, est, sf.check_integrity(est)), px


def test_near_and_far_are_told_apart():
    one, truth = result(1000)
    figures = evaluate([one], [truth + [[0, 0], [0, 0], [3, 3], [3, 3]]], [None])
    assert figures.near.median_px == 0
    assert figures.far.median_px == pytest.approx(3)
    assert figures.all.mean_px == pytest.approx(1.5)
    assert figures.distance_error is None


def test_distance_is_to_the_middle_of_the_threshold():
    one, truth = result(1000)
    distance = float(np.linalg.norm(on_approach(1000).position_m))
    figures = evaluate([one], [truth], [distance / 1.02])
    assert figures.distance_error["median"] == pytest.approx(0.02, abs=1e-6)


def test_frames_without_keypoints_are_counted_not_dropped():
    one, truth = result(1000)
    lost = FrameResult(1.0, None, None, None, sf.check_integrity(one.estimate))
    figures = evaluate([one, lost], [truth, truth], [None, None])
    assert figures.frames == 2
    assert figures.all.count == 8


def test_coverage_of_known_errors():
    rng = np.random.default_rng(0)
    sigma = np.exp(rng.normal(size=(5000, 4, 2)))
    figures = corner_figures(sigma * rng.normal(size=sigma.shape), sigma)
    # 40,000 coordinates: three standard errors are 0.7 and 0.33 points.
    assert figures.coverage_68 == pytest.approx(0.68, abs=0.007)
    assert figures.coverage_95 == pytest.approx(0.95, abs=0.0033)
