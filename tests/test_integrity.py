"""The χ² test keeps its promise on faultless frames, and its blindness is the one predicted."""

from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import binom, kstest, ncx2
from test_pose import CAMERA, RUNWAY, approaches, on_approach, solve

import shortfinal as sf
from shortfinal.integrity import (
    Decision,
    bias_effect,
    check_integrity_as_published,
    check_integrity_batch,
    check_integrity_batch_as_published,
    detection_probability,
)
from shortfinal.pose import estimate_pose_batch

COUNT = 20_000
RATES = (0.05, 0.01, 0.001)


def binomial_interval(rate, count=COUNT):
    """Counts that a true rate yields in 99 % of samples."""
    low, high = binom.interval(0.99, count, rate)
    return low, high


@lru_cache
def faultless(full, farthest_m=5000.0):
    """20,000 problems whose noise is as claimed: σ log-normal (spread 0.6, median 0.5 px), or a full Σ.

    The estimates, the cost at the truth, and the errors of the estimates (N, 6).
    """
    rng = np.random.default_rng(11)
    poses, corners, pixels = approaches(10, COUNT, farthest_m=farthest_m)
    sigma = 0.5 * np.exp(0.6 * rng.normal(size=(COUNT, 8)))
    correlation = np.tile(np.eye(8), (COUNT, 1, 1))
    if full:
        root = rng.normal(size=(COUNT, 8, 8))
        correlation = root @ np.swapaxes(root, 1, 2)
        size = np.sqrt(np.diagonal(correlation, axis1=1, axis2=2))
        # A tenth of independent noise keeps every covariance well away from singular.
        correlation = 0.9 * correlation / (size[:, :, None] * size[:, None, :]) + 0.1 * np.eye(8)
    cov = correlation * sigma[:, :, None] * sigma[:, None, :]
    unit = rng.normal(size=(COUNT, 8))
    noise = (np.linalg.cholesky(cov) @ unit[..., None])[..., 0].reshape(-1, 4, 2)
    batch = estimate_pose_batch(pixels + noise, cov, corners, CAMERA)
    turns = np.swapaxes([pose.runway_from_camera for pose in poses], 1, 2) @ batch.rotations
    shifts = batch.positions - [pose.position_m for pose in poses]
    return batch, np.sum(unit**2, axis=1), np.hstack([shifts, Rotation.from_matrix(turns).as_rotvec()])


def normalised(batch, errors):
    """Squared errors (N,) in units of the estimates' own covariance."""
    return np.einsum("ni,nij,nj->n", errors, np.linalg.inv(batch.covs), errors)


@pytest.mark.parametrize("full", [False, True], ids=["unequal sigma", "full covariance"])
def test_false_alarms_come_at_the_nominal_rate(full):
    batch, _, _ = faultless(full)
    assert batch.converged.all()
    p = check_integrity_batch(batch).p_value
    for rate in RATES:
        low, high = binomial_interval(rate)
        assert low <= (p < rate).sum() <= high
    assert kstest(p, "uniform").pvalue > 0.01


@pytest.mark.parametrize("full", [False, True], ids=["unequal sigma", "full covariance"])
def test_the_published_projection_raises_many_times_the_false_alarms(full):
    _, p = check_integrity_batch_as_published(faultless(full)[0])
    for rate in RATES:
        assert (p < rate).sum() > 4 * rate * COUNT
    assert kstest(p, "uniform").pvalue < 1e-100


def test_with_equal_sigmas_the_published_statistic_is_ours():
    rng = np.random.default_rng(12)
    est = solve(sf.project(CAMERA, on_approach(1500), RUNWAY.corners) + rng.normal(size=(4, 2)), sigma=0.7)
    statistic, p = check_integrity_as_published(est)
    verdict = sf.check_integrity(est)
    assert statistic == pytest.approx(verdict.statistic)
    assert p == pytest.approx(verdict.p_value)


@pytest.mark.parametrize("full", [False, True], ids=["unequal sigma", "full covariance"])
def test_the_cost_of_the_truth_over_the_optimum_is_chi_squared_with_six_degrees(full):
    # The normalised estimation error in its form that no curvature of the parameters disturbs.
    # Its standard error is sqrt(2 · 6 / N).
    batch, at_truth, _ = faultless(full)
    assert abs(np.mean(at_truth - batch.chi2) - 6) < 3 * np.sqrt(12 / COUNT)


@pytest.mark.parametrize("full", [False, True], ids=["unequal sigma", "full covariance"])
def test_normalised_errors_average_six(full):
    # Within 2 km, where the problem is as good as linear.
    batch, _, errors = faultless(full, farthest_m=2000.0)
    squared = normalised(batch, errors)
    assert abs(squared.mean() - 6) < 3 * squared.std() / np.sqrt(COUNT)


def test_far_out_the_covariance_is_too_small():
    # A limit, kept in sight: range goes as one over the runway's size in pixels, so that beyond 2 km
    # its error is no longer Gaussian and the first-order covariance falls short of it.
    batch, _, errors = faultless(True)
    far = batch.positions[:, 0] < -4000
    assert normalised(batch, errors)[far].mean() > 7


def estimate(sigma=0.5, points=RUNWAY.corners, distance=1200):
    return solve(sf.project(CAMERA, on_approach(distance), points), points, sigma=sigma)


# One far corner 3 px to the side; the far edge tilted by 2 px. (Both far corners moved alike would
# not do: to first order a change of pose explains that.)
FAULTS = [np.array([[0, 0], [0, 0], [3.0, 0], [0, 0]]), np.array([[0, 0], [0, 0], [0, 1.0], [0, -1.0]])]


@pytest.mark.parametrize("fault", FAULTS)
def test_detection_matches_the_noncentral_law(fault):
    rng = np.random.default_rng(13)
    clean, count, rate = estimate(), 10_000, 0.01
    px = clean.keypoints.mean_px + fault + 0.5 * rng.normal(size=(count, 4, 2))
    batch = estimate_pose_batch(px, clean.keypoints.cov_px, RUNWAY.corners, CAMERA)
    refused = count - check_integrity_batch(batch, rate).usable.sum()
    want = sf.detection_probability(clean, fault, rate)
    assert 0.02 < want < 0.98  # else the comparison says nothing
    low, high = binomial_interval(want, count)
    assert low <= refused <= high
    # The pose moves as predicted, to a tenth (first order) and three standard errors of the mean.
    moved, predicted = batch.positions.mean(0) - clean.pose.position_m, bias_effect(clean, fault)[:3]
    assert (abs(moved - predicted) < 0.1 * abs(predicted) + 3 * clean.sigma_position_m / np.sqrt(count)).all()


def test_detection_probability_without_a_fault_is_the_false_alarm_rate():
    assert sf.detection_probability(estimate(), np.zeros((4, 2)), 1e-3) == pytest.approx(1e-3)
    assert sf.detection_probability(estimate(), np.full(8, 0.0), 0.2) == pytest.approx(0.2)
    assert sf.detection_probability(estimate(), 1e3 * FAULTS[0]) == pytest.approx(1.0)


def test_the_minimal_detectable_bias_is_detected_with_the_power_asked():
    est = estimate()
    for power in (0.5, 0.8, 0.99):
        scale = sf.minimal_detectable_bias(est, FAULTS[0], 1e-3, power)
        assert sf.detection_probability(est, scale * FAULTS[0], 1e-3) == pytest.approx(power, abs=1e-9)
    # Sharper keypoints show proportionally smaller faults.
    assert sf.minimal_detectable_bias(estimate(0.25), FAULTS[0]) == pytest.approx(
        0.5 * sf.minimal_detectable_bias(est, FAULTS[0]), rel=1e-6
    )


def test_a_shift_that_a_pose_explains_is_never_detected():
    est = estimate()
    shift = sf.project_jacobian(CAMERA, est.pose, RUNWAY.corners) @ [10.0, 1, 1, 0.001, 0.002, 0]
    assert sf.minimal_detectable_bias(est, shift) == np.inf
    assert sf.detection_probability(est, shift, 1e-3) == pytest.approx(1e-3)
    np.testing.assert_allclose(bias_effect(est, shift), [10, 1, 1, 0.001, 0.002, 0], rtol=1e-6, atol=1e-9)


def test_noncentral_tails_agree_with_scipy_stats():
    est, threshold = estimate(), 13.815510557964274  # 2 ln 1000: χ²(2) at 1e-3
    whitened = est.keypoints.whitening @ FAULTS[0].ravel()
    q, _ = np.linalg.qr(est.jacobian)
    size = np.sum((whitened - q @ q.T @ whitened) ** 2)
    assert sf.detection_probability(est, FAULTS[0]) == pytest.approx(ncx2.sf(threshold, 2, size), rel=1e-9)


def test_a_good_frame_is_used_and_a_contradiction_is_not():
    good = sf.check_integrity(estimate())
    assert good.decision is Decision.USE
    assert good.dof == 2
    assert good.threshold == pytest.approx(-2 * np.log(1e-3))
    px = sf.project(CAMERA, on_approach(1200), RUNWAY.corners) + 20 * FAULTS[0]
    bad = sf.check_integrity(solve(px))
    assert bad.decision is Decision.DO_NOT_USE
    # Two degrees of freedom: the survival function is exp(-x / 2).
    assert bad.p_value == pytest.approx(np.exp(-bad.statistic / 2))
    assert "do not fit the runway" in bad.reasons[0]


def test_very_small_rates_do_not_saturate():
    est = estimate()
    verdict = sf.check_integrity(est, 1e-12)
    assert verdict.threshold == pytest.approx(-2 * np.log(1e-12))


def test_what_could_not_be_checked_is_not_monitored():
    line = np.array([[0.0, 0, 0], [500, 0, 0], [1000, 0, 0], [2000, 0, 0]])
    verdict = sf.check_integrity(estimate(points=line))
    assert verdict.decision is Decision.NOT_MONITORED
    assert verdict.p_value is None
    assert verdict.statistic is None
    assert "ill-conditioned" in verdict.reasons[0]
    with pytest.raises(sf.InputError, match="ill-conditioned"):
        sf.detection_probability(estimate(points=line), np.ones((4, 2)))


def test_the_batch_decides_as_the_single_call():
    px = np.tile(sf.project(CAMERA, on_approach(1200), RUNWAY.corners), (3, 1, 1))
    px[1] += 20 * FAULTS[0]
    px[2, 0, 0] = np.nan
    batch = estimate_pose_batch(px, 0.25 * np.eye(8), RUNWAY.corners, CAMERA)
    checked = check_integrity_batch(batch)
    assert [checked.decision(i) for i in range(3)] == [Decision.USE, Decision.DO_NOT_USE, Decision.NOT_MONITORED]
    assert checked.statistic[1] == sf.check_integrity(batch[1]).statistic
    assert checked.p_value[1] == sf.check_integrity(batch[1]).p_value
    assert not checked.usable[2]


@pytest.mark.parametrize("rate", [0.0, 1.0, -0.1, 2.0, np.nan])
def test_a_rate_that_is_no_probability_is_refused(rate):
    with pytest.raises(sf.InputError, match="between 0 and 1"):
        sf.check_integrity(estimate(), rate)


def test_wrong_bias_and_power_are_refused():
    with pytest.raises(sf.InputError, match="bias_px"):
        sf.detection_probability(estimate(), np.ones((3, 2)))
    with pytest.raises(sf.InputError, match="power"):
        sf.minimal_detectable_bias(estimate(), FAULTS[0], 0.1, 0.05)


def test_a_corner_that_is_hardly_known_leaves_nothing_to_check():
    # Six sharp coordinates for six unknowns: any shift of a sharp corner is explained by another pose.
    px = sf.project(CAMERA, on_approach(1200), RUNWAY.corners)
    px[1] += [30.0, 0.0]
    sigma = [[0.5], [0.5], [0.5], [1e4]]
    verdict = sf.check_integrity(sf.estimate_pose(sf.GaussianKeypoints.from_sigma(px, sigma), RUNWAY.corners, CAMERA))
    assert verdict.decision is Decision.NOT_MONITORED
    assert "no redundancy in effect" in verdict.reasons[0]
    cov = np.diag(np.repeat(np.square(np.ravel(sigma)), 2))
    assert not check_integrity_batch(estimate_pose_batch(px[None], cov, RUNWAY.corners, CAMERA)).monitored[0]


def test_priors_that_say_nothing_are_no_redundancy():
    px = sf.project(CAMERA, on_approach(1200), RUNWAY.corners)
    kp, points = sf.GaussianKeypoints.from_sigma(px[:3], 0.5), RUNWAY.corners[:3]
    attitude, position = on_approach(1200).runway_from_camera, on_approach(1200).position_m

    def decision(**priors):
        return sf.check_integrity(sf.estimate_pose(kp, points, CAMERA, **priors)).decision

    vague = {"attitude_prior": (attitude, 2.0 * np.eye(3)), "position_prior": (position, 1e8 * np.eye(3))}
    assert decision(**vague, altitude=(position[2], 1e4)) is Decision.NOT_MONITORED
    for sharp in (
        {"attitude_prior": (attitude, 1e-4 * np.eye(3))},
        {"position_prior": (position, 25.0 * np.eye(3))},
        {"altitude": (position[2], 1.0)},
    ):
        assert decision(**sharp) is Decision.USE


def test_a_bias_of_a_prior_moves_the_pose():
    est = estimate()
    height = est.pose.position_m[2]
    with_height = sf.estimate_pose(est.keypoints, RUNWAY.corners, CAMERA, altitude=(height, 1.0))
    bias = np.zeros(9)
    bias[8] = 0.1
    moved = sf.estimate_pose(est.keypoints, RUNWAY.corners, CAMERA, altitude=(height + 0.1, 1.0))
    expected = moved.pose.minus(with_height.pose)
    np.testing.assert_allclose(bias_effect(with_height, bias), expected, rtol=1e-2, atol=1e-2 * abs(expected[2]))
    # A shift of the keypoints alone has no part in the other rows.
    shift = np.append(FAULTS[0].ravel(), 0.0)
    np.testing.assert_array_equal(bias_effect(with_height, FAULTS[0]), bias_effect(with_height, shift))


def test_a_pose_too_uncertain_for_a_linear_test_is_not_monitored():
    est = solve(sf.project(CAMERA, on_approach(4000), RUNWAY.corners), sigma=15.0)
    verdict = sf.check_integrity(est)
    assert verdict.decision is Decision.NOT_MONITORED
    assert "uncertain" in verdict.reasons[0]


def test_the_batch_refuses_a_skew_covariance():
    px = sf.project(CAMERA, on_approach(1200), RUNWAY.corners)
    cov = 0.25 * np.eye(8)
    cov[0, 1] = 50.0
    batch = estimate_pose_batch(px[None], cov, RUNWAY.corners, CAMERA)
    assert batch.status(0) is sf.SolverStatus.ILL_CONDITIONED
    assert check_integrity_batch(batch).decision(0) is Decision.NOT_MONITORED


def test_the_chance_of_a_false_alarm_does_not_saturate():
    assert detection_probability(estimate(), np.zeros((4, 2)), 1e-18) == pytest.approx(1e-18)


def test_estimates_cannot_be_changed_from_outside():
    px = sf.project(CAMERA, on_approach(1200), RUNWAY.corners)
    batch = estimate_pose_batch(px[None], 0.25 * np.eye(8), RUNWAY.corners, CAMERA)
    one = batch[0]
    batch.covs[:] = 0
    assert np.trace(one.cov) > 0
    with pytest.raises(ValueError, match="read-only"):
        one.cov[0, 0] = 1
