"""The published 184 m fault: detected as often as the non-central law says, which is not often enough."""

import numpy as np
import pytest

BENCHMARK = "threshold_fault"


@pytest.mark.parametrize(
    ("length_m", "distance_m", "sigma_px", "least", "most"),
    [
        (1500, 1000, 0.3, 0.95, 1.0),
        (1500, 1500, 0.8, 0.1, 0.5),
        (1500, 3000, 0.8, 0.0, 0.03),  # blind
        (3000, 1500, 0.8, 0.0, 0.05),  # blind on a long runway at any range
        (3000, 1000, 0.3, 0.3, 0.9),
    ],
)
def test_detection_agrees_with_prediction(benchmark, length_m, distance_m, sigma_px, least, most):
    point = benchmark.evaluate(length_m, distance_m, sigma_px, draws=4000, seed=1)
    assert point.agrees
    assert least <= point.predicted <= most


def test_an_unseen_fault_moves_the_pose(benchmark):
    # The price of blindness: at 3 km the fault passes, and shifts the solution by tens of metres.
    point = benchmark.evaluate(1500, 3000, 0.8, draws=2000)
    assert point.detected < 0.05 * point.draws
    assert point.noise_free_along_m > 15
    assert point.accepted_along_m > point.noise_free_along_m


def test_crops_are_halved_until_the_runway_fits_and_never_magnified(benchmark):
    for extent, scale in [(50, 1), (224, 1), (225, 0.5), (448, 0.5), (449, 0.25), (1800, 0.0625)]:
        assert benchmark.crop_scale(np.array([[10.0, 10], [10 + extent, 20]])) == scale
