"""Protection levels are the levels of the definition, and the promise holds with the real solver."""

import math
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq, minimize
from scipy.stats import binom, ncx2, norm
from scipy.stats import chi2 as chi_squared
from test_pose import CAMERA, RUNWAY, on_approach

import shortfinal as sf
from shortfinal.geometry import project_lines
from shortfinal.integrity import check_integrity_batch
from shortfinal.pose import STATUS_OF_CODE, estimate_pose_batch
from shortfinal.protection import (
    _STEP,
    LARGEST_GROWTH,
    METHODS,
    NO_FAULT,
    SENSORS,
    TOO_MANY_FAULTS,
    AlertLimits,
    _acceptance,
    protection_levels,
    protection_levels_batch,
)

AIMING_POINTS = np.array([[300.0, 12, 0], [300, -12, 0], [345, -12, 0], [345, 12, 0]])
EIGHT = np.vstack([RUNWAY.corners, AIMING_POINTS])


def covariance(rng, k, full, sigma=0.5):
    """Unequal sigma (log-normal about `sigma` px, spread 0.4), or that with correlations."""
    scale = sigma * np.exp(0.4 * rng.normal(size=2 * k))
    correlation = np.eye(2 * k)
    if full:
        root = rng.normal(size=(2 * k, 2 * k))
        correlation = root @ root.T
        size = np.sqrt(np.diag(correlation))
        correlation = 0.6 * correlation / np.outer(size, size) + 0.4 * np.eye(2 * k)
    return correlation * np.outer(scale, scale)


def estimate(seed=0, points=RUNWAY.corners, distance=1500.0, full=False, sigma=0.5, noise=1.0, **options):
    rng = np.random.default_rng(seed)
    cov = covariance(rng, len(points), full, sigma)
    truth = on_approach(distance, yaw_deg=2, pitch_deg=-3, roll_deg=4)
    px = sf.project(CAMERA, truth, points) + noise * rng.multivariate_normal(np.zeros(len(cov)), cov).reshape(-1, 2)
    return sf.estimate_pose(sf.GaussianKeypoints(px, cov), points, CAMERA, **options)


def axes_at(position, points):
    """The five numbers that are protected, from their definition."""
    x, y, z = np.moveaxis(np.asarray(position), -1, 0)
    lateral = np.degrees(np.arctan2(y, points[:, 0].max() - x))
    vertical = np.degrees(np.arctan2(z, np.hypot(x - 300.0, y)))
    return np.stack([x, y, z, lateral, vertical], axis=-1)


def gradients_at(position, points):
    """Their derivatives by the pose's increment (5, 6), by central differences."""
    steps = 0.01 * np.eye(3)
    slopes = [(axes_at(position + d, points) - axes_at(position - d, points)) / 0.02 for d in steps]
    return np.column_stack([*slopes, np.zeros((5, 3))])


class Linear:
    """The linearised problem in numpy: sigma and slopes from their definitions."""

    def __init__(self, est):
        jacobian = est.jacobian
        self.raw, self.cov = est.factor @ jacobian, est.factor @ est.factor.T
        self.rows = {f.name: list(range(f.rows.start, f.rows.stop)) for f in est.features}
        self.unit = np.linalg.inv(est.factor)
        self.projection = np.eye(len(jacobian)) - jacobian @ np.linalg.pinv(jacobian)
        self.gradients = gradients_at(est.pose.position_m, est.points)
        self.shares = self.gradients @ np.linalg.pinv(jacobian)  # (5, n): axis error of a whitened error
        self.sigma = np.linalg.norm(self.shares, axis=1)

    def without(self, names):
        """Covariance of the pose estimated without these features: their rows and columns struck out."""
        keep = np.setdiff1d(np.arange(len(self.raw)), [r for name in names for r in self.rows[name]])
        return np.linalg.inv(self.raw[keep].T @ np.linalg.solve(self.cov[np.ix_(keep, keep)], self.raw[keep]))

    def slopes(self, names):
        """g (5,) of a fault of these features, from sigma² without them = sigma² + g²."""
        cov = self.without(names)
        return np.sqrt(np.einsum("ai,ij,aj->a", self.gradients, cov, self.gradients) - self.sigma**2)


def residual_level(slopes, sigma, priors, fault_free, risk, rate, dof):
    """The level by root-finding on the definition, the worst fault by search on a fine grid."""
    threshold = chi_squared.isf(rate, dof)
    t = np.linspace(1e-3, math.sqrt(threshold) + 12.0, 20_000)
    accepted = np.log(ncx2.cdf(threshold, dof, t * t))

    def missed(level, slope):  # max over the root t of the non-centrality of P(|error| > level) P(accepted)
        error = norm.logsf((level - slope * t) / sigma), norm.logsf((level + slope * t) / sigma)
        chance = np.logaddexp(*error) + accepted
        best = min(max(int(np.argmax(chance)), 1), len(t) - 2)
        left, top, right = chance[best - 1 : best + 2]
        bow = left - 2 * top + right  # the parabola through three points
        return math.exp(top - (right - left) ** 2 / (8 * bow) if bow < 0 else chance.max())

    def excess(level):
        total = fault_free * (1 - rate) * 2 * norm.sf(level / sigma)
        return math.log(total + sum(p * missed(level, g) for p, g in zip(priors, slopes))) - math.log(risk)

    top = sigma
    while excess(top) > 0:
        top *= 1.5
    return brentq(excess, top / 1.5, top, rtol=1e-9)


def sets_of(names, order):
    return [s for size in range(1, order + 1) for s in combinations(names, size)]


@pytest.mark.parametrize("full", [False, True], ids=["unequal sigma", "full covariance"])
def test_slopes_are_those_of_the_worst_fault(full):
    # The definition: over the directions of a fault, the largest error for a non-centrality of one.
    est = estimate(1, full=full)
    pl, linear = protection_levels(est), Linear(est)
    assert pl.hypotheses == sf.CORNER_NAMES
    for k, name in enumerate(pl.hypotheses):
        bias = linear.unit[:, linear.rows[name]]
        for axis in range(5):

            def ratio(angle, bias=bias, axis=axis):
                fault = bias @ [math.cos(angle), math.sin(angle)]
                return (linear.shares[axis] @ fault) ** 2 / (fault @ linear.projection @ fault)

            grid = np.linspace(0, np.pi, 2000)
            start = grid[np.argmax([ratio(a) for a in grid])]
            best = minimize(lambda a: -ratio(a[0]), [start], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 0})
            assert pl.slopes[k, axis] == pytest.approx(math.sqrt(-best.fun), rel=1e-6)
            assert pl.slopes[k, axis] == pytest.approx(linear.slopes([name])[axis], rel=1e-6)
    np.testing.assert_allclose(pl.sigma, linear.sigma, rtol=1e-7)
    np.testing.assert_allclose(pl.sigma[:3], est.sigma_position_m, rtol=1e-7)


def test_slopes_of_pairs():
    # Four numbers of bias against ten degrees of freedom: by optimisation over their directions.
    est = estimate(2, EIGHT, full=True)
    pl, linear = protection_levels(est, max_faults=2), Linear(est)
    assert len(pl.hypotheses) == 8 + 28
    rng = np.random.default_rng(3)
    for pair in (("near-left", "near-right"), ("far-left", "point 4"), ("point 5", "point 6")):
        bias = linear.unit[:, [r for name in pair for r in linear.rows[name]]]
        slopes = pl.slopes[pl.hypotheses.index(" + ".join(pair))]
        for axis in (0, 2, 3):

            def loss(f, bias=bias, axis=axis):
                fault = bias @ f
                return -((linear.shares[axis] @ fault) ** 2) / (fault @ linear.projection @ fault)

            found = min(minimize(loss, rng.normal(size=4), tol=1e-12).fun for _ in range(8))
            assert slopes[axis] == pytest.approx(math.sqrt(-found), rel=1e-5)
    for s in sets_of(linear.rows, 2):
        np.testing.assert_allclose(pl.slopes[pl.hypotheses.index(" + ".join(s))], linear.slopes(s), rtol=1e-6)


@pytest.mark.parametrize("dof", [1, 2, 7, 26])
@pytest.mark.parametrize("rate", [0.3, 1e-3, 1e-12])
def test_the_chance_of_acceptance_is_the_noncentral_law(dof, rate):
    # P(χ² ≤ c) is that of a ball: over the part along the fault, the chance of the rest.
    table, radius = _acceptance(dof, rate), math.sqrt(chi_squared.isf(rate, dof))
    for t in np.linspace(0.01, radius + 9, 23):
        cell, u = divmod(t / _STEP, 1.0)
        got = table[int(cell)] @ u ** np.arange(4)
        if dof == 1:
            want = math.log(norm.cdf(radius - t) - norm.cdf(-radius - t))
        else:

            def slab(angle, t=t):
                along, rest = radius * math.sin(angle), radius * math.cos(angle)
                return norm.pdf(along - t) * chi_squared.cdf(rest * rest, dof - 1) * rest

            peak = math.asin(min(t / radius, 1.0) * 0.99)
            want = math.log(quad(slab, -math.pi / 2, math.pi / 2, points=[peak], epsabs=0, epsrel=1e-11, limit=500)[0])
        assert got == pytest.approx(want, rel=1e-8, abs=1e-9)


@pytest.mark.parametrize(
    ("seed", "full", "risk", "prior", "rate"),
    [
        (1, False, 1e-7, 1e-4, 1e-3),
        (2, True, 1e-7, 1e-4, 1e-3),
        (3, True, 1e-2, 0.02, 0.05),
        (4, True, 1e-9, 1e-5, 1e-6),
    ],
)
def test_residual_levels_solve_the_definition(seed, full, risk, prior, rate):
    est = estimate(seed, full=full)
    pl = protection_levels(est, integrity_risk=risk, fault_prior=prior, false_alarm_rate=rate)
    assert pl.unmonitored == pytest.approx(binom.sf(1, 4, prior), rel=1e-9)
    linear = Linear(est)
    slopes = np.array([linear.slopes([name]) for name in sf.CORNER_NAMES])
    for axis in range(5):
        want = residual_level(
            slopes[:, axis], linear.sigma[axis], 4 * [prior], (1 - prior) ** 4, risk - pl.unmonitored, rate, est.dof
        )
        assert pl.first_order[axis] == pytest.approx(want, rel=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_two_faults_among_eight_points(method):
    est, prior, risk, rate = estimate(5, EIGHT), 3e-3, 1e-5, 1e-3
    pl = protection_levels(
        est, method=method, max_faults=2, fault_prior=prior, integrity_risk=risk, false_alarm_rate=rate
    )
    linear = Linear(est)
    sets = sets_of(linear.rows, 2)
    priors = [prior ** len(s) for s in sets]
    left, fault_free = risk - binom.sf(2, 8, prior), (1 - prior) ** 8
    for axis in (0, 1, 2) if method == "residual" else range(5):
        sigma, slopes = linear.sigma[axis], [linear.slopes(s)[axis] for s in sets]
        if method == "residual":
            want = residual_level(slopes, sigma, priors, fault_free, left, rate, 10)
        else:
            share, tolerated = left / 37, norm.isf(rate / (2 * 36))
            bounds = [
                tolerated * g + norm.isf(share / (2 * p)) * math.hypot(g, sigma)
                for g, p in zip(slopes, priors)
                if p > share
            ]
            want = max(norm.isf(share / (2 * fault_free)) * sigma, *bounds)
        assert pl.first_order[axis] == pytest.approx(want, rel=1e-6)


def test_the_separation_is_the_difference_of_the_two_estimates():
    est = estimate(6, EIGHT, full=True)
    pl, linear = protection_levels(est, method="solution-separation", max_faults=2), Linear(est)
    measured = est.factor @ est.residual  # raw, about the estimate: it is the solution 0 of the whole
    for s in sets_of(linear.rows, 2)[::5]:
        keep = np.setdiff1d(np.arange(16), [r for name in s for r in linear.rows[name]])
        weight = np.linalg.inv(linear.cov[np.ix_(keep, keep)])
        without = linear.without(s) @ linear.raw[keep].T @ weight @ measured[keep]
        k = pl.hypotheses.index(" + ".join(s))
        # The estimate is the optimum to a millionth of sigma.
        assert (abs(pl.separations[k] + linear.gradients @ without) < 1e-5 * linear.sigma).all()
    np.testing.assert_allclose(pl.thresholds, norm.isf(1e-3 / (2 * 36)) * pl.slopes, rtol=1e-9)
    assert pl.passed == (abs(pl.separations) <= pl.thresholds).all()


def test_runwaylib_documented_example():
    # Corners, camera, sigma, risks and priors of RunwayLib.jl's documentation; its formula, each
    # hypothesis with an equal part of both risks. Its body frame is x forward, y left, z up, its
    # pitch is positive about y, so that 5° is nose down.
    corners = np.array([[0, 50, 0], [0, -50, 0], [3000, -50, 0], [3000, 50, 0]], float)
    position, focal, sigma = np.array([-2000.0, 12.0, 150.0]), 7246.4, 2.0
    pitch, roll = np.radians([5.0, 1.5])
    turn = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]]) @ np.array(
        [[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]]
    )

    def pixels(state):  # position, then a small turn about the body's axes
        a, b, c = state[3:]
        small = np.eye(3) + np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
        body = (corners - state[:3]) @ turn @ small
        return (focal * np.column_stack([-body[:, 1], -body[:, 2]]) / body[:, :1]).ravel()

    start = np.array([*position, 0, 0, 0], complex)
    jacobian = np.column_stack([pixels(start + 1e-30j * e).imag / 1e-30 for e in np.eye(6)]) / sigma

    def deviation(keep):  # of along, cross, vertical
        return np.sqrt(np.diag(np.linalg.inv(jacobian[keep].T @ jacobian[keep]))[:3])

    part, fault_free = 1e-5 / 5, (1 - 1e-3) ** 4
    whole = deviation(np.arange(8))
    bounds = [norm.isf(part / (2 * fault_free)) * whole]
    for k in range(4):
        alone = deviation(np.delete(np.arange(8), [2 * k, 2 * k + 1]))
        tolerated = norm.isf((1e-3 / 4) / (2 * fault_free)) * np.sqrt(alone**2 - whole**2)
        bounds.append(tolerated + norm.isf(part / 2e-3) * alone)
    want = np.max(bounds, axis=0)

    camera = sf.Camera(4096, 3000, focal, focal, 2047.5, 1499.5)
    truth = sf.Pose.from_attitude(position, pitch_deg=-5.0, roll_deg=1.5)
    keypoints = sf.GaussianKeypoints.from_sigma(sf.project(camera, truth, corners), sigma)
    pl = protection_levels(
        sf.estimate_pose(keypoints, corners, camera),
        method="solution-separation",
        fault_prior=1e-3,
        # Theirs leaves double faults uncharged, and its false alarms are those of faultless frames.
        integrity_risk=1e-5 + binom.sf(1, 4, 1e-3),
        false_alarm_rate=1e-3 / fault_free,
    )
    np.testing.assert_allclose(pl.first_order[:3], want, rtol=1e-9)
    np.testing.assert_allclose(want, [652.1532, 38.5108, 70.0378], rtol=2e-6)
    assert pl.passed


def nothing_else(pose):
    """What is measured at `pose` beside keypoints."""
    return {}


def lines_and_sensors(pose):
    edges = RUNWAY.corners[[[0, 3], [1, 2]]]
    return {
        "lines": (project_lines(CAMERA, pose, edges), np.diag([0.5**2, 2e-3**2] * 2)),
        "edges": edges,
        "attitude_prior": (pose.runway_from_camera, 1e-3**2 * np.eye(3)),
        "altitude": (pose.position_m[2], 2.0),
    }


def second_order_level(est, axis, others, **options):
    """The level by its construction, step by step: slopes from half-way to the truth, one secant step."""
    pl, linear = protection_levels(est, **options), Linear(est)
    first = pl.first_order[axis]
    driver = pl.driver[axis].split(" + ") if pl.driver[axis] != NO_FAULT else []
    gradient = linear.gradients[axis]
    direction = linear.without(driver) @ gradient
    direction *= 0.5 * first / (gradient @ direction)
    away = direction[:3] @ (est.pose.position_m - est.points.mean(axis=0))
    pose = est.pose.plus(math.copysign(1.0, away) * direction)
    there = sf.GaussianKeypoints(sf.project(CAMERA, pose, est.points), est.keypoints.cov_px)
    bent = Linear(sf.estimate_pose(there, est.points, CAMERA, initial=pose, **others(pose)))
    faulty = [name for name in linear.rows if name not in SENSORS]
    prior = options["fault_prior"]
    slopes, sigma = np.array([linear.slopes([name])[axis] for name in faulty]), linear.sigma[axis]
    changes = abs(np.array([bent.slopes([name])[axis] for name in faulty]) - slopes)
    left = options["integrity_risk"] - pl.unmonitored

    def level(slopes, sigma):
        free = (1 - prior) ** len(faulty)
        return residual_level(slopes, sigma, len(faulty) * [prior], free, left, options["false_alarm_rate"], est.dof)

    # The two derivatives by differences.
    h = 1e-3
    by_slopes = (level(slopes + h * changes, sigma) - level(slopes - h * changes, sigma)) / (2 * h)
    by_sigma = (level(slopes, sigma * (1 + h)) - level(slopes, sigma * (1 - h))) / (2 * h * sigma)
    second = first + by_slopes + max(by_sigma, 0.0) * abs(bent.sigma[axis] - sigma)
    return first**2 / (2 * first - second)


@pytest.mark.parametrize("full", [False, True], ids=["unequal sigma", "full covariance"])
def test_levels_are_of_second_order(full):
    est = estimate(7, full=full, noise=0.0)
    options = {"fault_prior": 5e-3, "integrity_risk": 1e-3, "false_alarm_rate": 1e-3}
    pl = protection_levels(est, **options)
    for axis in range(5):
        assert pl.levels[axis] == pytest.approx(second_order_level(est, axis, nothing_else, **options), rel=3e-4)
        assert pl.levels[axis] > 1.002 * pl.first_order[axis]


def test_levels_with_lines_and_sensors_are_of_second_order():
    truth = on_approach(1500, yaw_deg=2, pitch_deg=-3, roll_deg=4)
    est = estimate(8, noise=0.0, **lines_and_sensors(truth))
    assert [f.name for f in est.features][4:] == ["line 0", "line 1", "attitude prior", "altitude"]
    options = {"fault_prior": 5e-3, "integrity_risk": 1e-3, "false_alarm_rate": 1e-3}
    pl = protection_levels(est, **options)
    assert pl.hypotheses == (*sf.CORNER_NAMES, "line 0", "line 1")
    for axis in range(5):
        assert pl.levels[axis] == pytest.approx(second_order_level(est, axis, lines_and_sensors, **options), rel=3e-4)
    # A sensor is faulty only where it is named.
    some = protection_levels(est, fault_prior={"altitude": 1e-4, "near-left": 1e-5}, max_faults=2)
    assert some.hypotheses == ("altitude", "near-left", "altitude + near-left")
    assert some.unmonitored == 0.0


def test_a_fault_that_can_hide_is_charged_or_makes_the_level_infinite():
    # With four corners any two faults can imitate another pose.
    est, prior, rate = estimate(9), 1e-3, 1e-3
    pl = protection_levels(est, fault_prior=prior, max_faults=2)
    assert np.isinf(pl.slopes[4:]).all()
    assert np.isfinite(pl.slopes[:4]).all()
    assert pl.levels == (math.inf,) * 5
    assert pl.first_order == (math.inf,) * 5
    assert len(pl.reasons) == 5
    assert "4e-09 for more faults at once" in pl.reasons[0]
    assert "can hide (near-left + near-right" in pl.reasons[0]
    assert pl.driver.along_m == "near-left + near-right"
    # With risk enough they are charged, and the rest goes to the single faults.
    risk = 1e-5
    pl = protection_levels(est, fault_prior=prior, max_faults=2, integrity_risk=risk)
    linear = Linear(est)
    left = risk - binom.sf(2, 4, prior) - 6 * prior**2
    for axis in range(3):
        slopes = [linear.slopes([name])[axis] for name in sf.CORNER_NAMES]
        want = residual_level(slopes, linear.sigma[axis], 4 * [prior], (1 - prior) ** 4, left, rate, 2)
        assert pl.first_order[axis] == pytest.approx(want, rel=1e-6)
    separation = protection_levels(
        est, fault_prior=prior, max_faults=2, integrity_risk=risk, method="solution-separation"
    )
    assert max(separation.levels) < math.inf
    assert np.isinf(separation.thresholds[4:]).all()


def test_more_faults_than_are_protected_use_up_the_risk():
    priors = {"near-left": 0.1, "near-right": 0.2, "far-right": 0.3, "far-left": 0.05}
    pl = protection_levels(estimate(9), fault_prior=priors, integrity_risk=1e-3)
    chance = 0.0  # of two faults or more, by enumeration
    for faulty in sets_of(priors, 4):
        if len(faulty) > 1:
            chance += math.prod(p if name in faulty else 1 - p for name, p in priors.items())
    assert pl.unmonitored == pytest.approx(chance, rel=1e-12)
    assert min(pl.levels) == math.inf
    assert set(pl.driver) == {TOO_MANY_FAULTS}
    assert f"{chance:.2g} for more faults at once" in pl.reasons[0]


def test_without_redundancy_in_effect_the_level_is_out_of_bounds():
    # One corner hardly known: six sharp numbers for six unknowns, and every other fault hides.
    cov = np.diag(np.repeat([0.5, 0.5, 0.5, 1e4], 2) ** 2)
    px = sf.project(CAMERA, on_approach(1500), RUNWAY.corners)
    est = sf.estimate_pose(sf.GaussianKeypoints(px, cov), RUNWAY.corners, CAMERA)
    pl = protection_levels(est)
    assert pl.along_m == math.inf
    assert pl.first_order.along_m > 1e4
    assert "too large a share of the distance" in pl.reasons[0]


def test_far_out_there_is_no_level():
    # The level grows against its first order until two orders are not enough; then it is infinite.
    growth = []
    for distance in (1000.0, 2000.0, 4000.0, 8000.0, 12_000.0):
        pl = protection_levels(estimate(17, distance=distance, sigma=0.7, noise=0.0))
        growth.append(np.array(pl.levels) / pl.first_order)
        assert (growth[-1][np.isfinite(growth[-1])] < LARGEST_GROWTH).all()
        assert len(pl.reasons) == np.isinf(pl.levels).sum()
    growth = np.array(growth)[:, :3]
    assert np.isfinite(growth[:2]).all()
    assert np.isinf(growth[-1]).all()
    rising = growth[:-1] < growth[1:]
    assert (rising | np.isinf(growth[:-1])).all()


def test_no_fault_prior_leaves_the_normal_error():
    est = estimate(10)
    for method in METHODS:
        pl = protection_levels(est, fault_prior={}, method=method, integrity_risk=1e-5)
        assert pl.hypotheses == ()
        assert set(pl.driver) == {NO_FAULT}
        risk = 1e-5 / (1 - 1e-3) if method == "residual" else 1e-5  # the refused are not at risk
        np.testing.assert_allclose(pl.first_order, norm.isf(risk / 2) * np.array(pl.sigma), rtol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_levels_grow_as_the_risk_shrinks_and_with_sigma_and_the_prior(method):
    est = estimate(11, full=True)
    by_risk = [
        protection_levels(est, integrity_risk=r, fault_prior=1e-5, method=method) for r in 10.0 ** -np.arange(2, 9)
    ]
    assert (np.diff([pl.levels for pl in by_risk], axis=0) > 0).all()
    by_prior = [
        protection_levels(est, integrity_risk=1e-4, fault_prior=p, method=method) for p in 10.0 ** np.arange(-5, -2)
    ]
    assert (np.diff([pl.levels for pl in by_prior], axis=0) > 0).all()
    by_sigma = [protection_levels(estimate(12, sigma=s, noise=0), method=method) for s in (0.1, 0.2, 0.4, 0.8)]
    assert (np.diff([pl.levels for pl in by_sigma], axis=0) > 0).all()
    # To first order in proportion to sigma; to second order faster.
    first = np.array([pl.first_order for pl in by_sigma])
    np.testing.assert_allclose(first[1:] / first[:-1], 2.0, rtol=1e-5)
    assert (np.diff([np.array(pl.levels) / pl.first_order for pl in by_sigma], axis=0) > 0).all()
    # A risk so large that every error is within it asks for no level.
    assert protection_levels(est, integrity_risk=0.9999, fault_prior=1e-5).along_m < 0.01 * by_risk[0].along_m


def test_alert_limits_name_what_exceeds_them():
    pl = protection_levels(estimate(13, distance=1000.0, sigma=0.2))
    verdict = pl.available(AlertLimits.lpv200())
    assert AlertLimits.lpv200() == AlertLimits(along_m=40.0, cross_m=40.0, vertical_m=35.0)
    assert not verdict
    assert len(verdict.reasons) == 1
    assert verdict.reasons[0].startswith("along_m: level")
    assert pl.driver.along_m in verdict.reasons[0]
    assert pl.available(AlertLimits(along_m=pl.along_m, vertical_m=40.0))
    assert pl.available(AlertLimits())
    nothing = protection_levels(estimate(13), max_faults=2, integrity_risk=1e-9)
    assert len(nothing.available(AlertLimits(vertical_deg=1.0)).reasons) == 1
    for bad in (0.0, -1.0, math.nan):
        with pytest.raises(sf.InputError, match="vertical_m"):
            AlertLimits(vertical_m=bad)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("shared", [False, True], ids=["each its covariance", "one covariance"])
def test_the_batch_agrees_with_the_single_call(method, shared):
    rng = np.random.default_rng(14)
    count, truth = 1100, on_approach(1200, yaw_deg=2)  # more than two chunks
    cov = np.array([covariance(rng, 8, True) for _ in range(1 if shared else count)])
    px = sf.project(CAMERA, truth, EIGHT) + rng.normal(size=(count, 8, 2))
    px[7] = np.nan
    batch = estimate_pose_batch(px, cov[0] if shared else cov, EIGHT, CAMERA)
    options = {"method": method, "fault_prior": {"near-left": 1e-3, "point 5": 1e-4}, "max_faults": 2}
    pl = protection_levels_batch(batch, **options)
    assert len(pl) == count
    for i in (0, 3, 600, 1099):
        one = protection_levels(batch[i], **options)
        np.testing.assert_allclose(pl.levels[i], one.levels, rtol=1e-12)
        np.testing.assert_allclose(pl.first_order[i], one.first_order, rtol=1e-12)
        np.testing.assert_allclose(pl.sigma[i], one.sigma, rtol=1e-12)
        assert tuple(pl.hypotheses[d] if d >= 0 else NO_FAULT for d in pl.drivers[i]) == one.driver
        assert (None if pl.passed is None else pl.passed[i]) == one.passed
        assert pl.available(AlertLimits.lpv200())[i] == bool(one.available(AlertLimits.lpv200()))
    assert np.isinf(pl.levels[7]).all()
    assert np.isinf(pl.sigma[7]).all()
    assert not pl.available(AlertLimits.lpv200())[7]
    if pl.passed is not None:
        assert not pl.passed[7]
        assert 0.2 < pl.passed.mean() < 1.0  # the noise is not as claimed: many fail


def test_an_ambiguous_estimate_does_not_pass():
    est = estimate(15)
    batch = estimate_pose_batch(est.keypoints.mean_px[None], est.keypoints.cov_px, est.points, CAMERA)
    assert protection_levels(est, method="solution-separation").passed
    assert protection_levels_batch(batch, method="solution-separation").passed[0]
    est = replace(est, status=sf.SolverStatus.AMBIGUOUS)
    batch = replace(batch, status_codes=np.array([STATUS_OF_CODE.index(sf.SolverStatus.AMBIGUOUS)]))
    assert protection_levels(est, method="solution-separation").passed is False
    assert not protection_levels_batch(batch, method="solution-separation").passed[0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"integrity_risk": 0.0}, "integrity_risk: 0.0"),
        ({"integrity_risk": 1.0}, "integrity_risk"),
        ({"integrity_risk": math.nan}, "integrity_risk"),
        ({"integrity_risk": "small"}, "integrity_risk"),
        ({"false_alarm_rate": -0.1}, "false_alarm_rate"),
        ({"false_alarm_rate": [1e-3]}, "false_alarm_rate"),
        ({"fault_prior": 1.0}, "fault_prior: 1.0"),
        ({"fault_prior": [1e-4]}, "fault_prior"),
        ({"fault_prior": {"near-left": 0.0}}, "fault_prior: near-left: 0.0"),
        ({"fault_prior": {"near left": 1e-4}}, "'near left' was not measured; there are near-left, near-right"),
        ({"method": "chi"}, "method: 'chi' is unknown; choose residual or solution-separation"),
        ({"max_faults": 0}, "max_faults: 0"),
        ({"max_faults": 1.5}, "max_faults: 1.5"),
        ({"max_faults": True}, "max_faults: True"),
    ],
)
def test_wrong_options_are_refused(options, message):
    est = estimate(16)
    batch = estimate_pose_batch(est.keypoints.mean_px[None], est.keypoints.cov_px, est.points, CAMERA)
    for call, given in ((protection_levels, est), (protection_levels_batch, batch)):
        with pytest.raises(sf.InputError, match=message) as error:
            call(given, **options)
        assert "\n" not in str(error.value)


def test_an_estimate_without_pose_or_redundancy_is_refused():
    line = np.array([[0.0, 0, 0], [500, 0, 0], [1000, 0, 0], [2000, 0, 0]])
    px = sf.project(CAMERA, on_approach(1500), line)
    with pytest.raises(sf.InputError, match="est: no pose to protect: the solver ended ill-conditioned"):
        protection_levels(sf.estimate_pose(sf.GaussianKeypoints.from_sigma(px, 0.5), line, CAMERA))
    three = RUNWAY.corners[:3]
    px = sf.project(CAMERA, on_approach(1500), three)
    with pytest.raises(sf.InputError, match="no redundancy"):
        protection_levels(sf.estimate_pose(sf.GaussianKeypoints.from_sigma(px, 0.5), three, CAMERA))


# The promise, with the real solver: for every axis, the faults that matter to it, each in its worst
# direction, with its worst magnitude and sign.


class Trial:
    """One geometry and covariance, and what happens in it under a fault."""

    def __init__(self, seed, distance, full, points=RUNWAY.corners):
        self.rng = np.random.default_rng(seed)
        attitude = self.rng.uniform([-4, -5, -5], [4, -1, 5])
        self.points, self.cov = points, covariance(self.rng, len(points), full)
        self.truth = sf.Pose.from_attitude([-distance, 0.02 * distance, 0.0524 * distance], *attitude)
        self.px = sf.project(CAMERA, self.truth, points)
        self.est = sf.estimate_pose(sf.GaussianKeypoints(self.px, self.cov), points, CAMERA, initial=self.truth)
        self.linear = Linear(self.est)

    def worst_faults(self, axis, slopes, level, accepted, t, rows):
        """The bias (n,) of each hypothesis, and its chance to be missed, to first order."""
        for name, slope in slopes.items():
            sigma = self.linear.sigma[axis]
            chance = (norm.sf((level - slope * t) / sigma) + norm.sf((level + slope * t) / sigma)) * accepted
            best = int(np.argmax(chance))
            whitened = self.linear.unit[:, rows[name]]
            shown = whitened.T @ self.linear.projection @ whitened
            fault = np.linalg.solve(shown, whitened.T @ self.linear.shares[axis])
            bias = np.zeros(len(self.cov))
            bias[rows[name]] = fault * t[best] / math.sqrt(fault @ shown @ fault)
            yield bias, chance[best]

    def violations(self, axis, risk, prior, method, count):
        """Chance of an accepted error beyond the level, and the first-order one; standard errors; the risk."""
        options = {"integrity_risk": risk, "fault_prior": prior, "method": method}
        pl = protection_levels(self.est, **options)
        slopes = {name: pl.slopes[k, axis] for k, name in enumerate(pl.hypotheses)}
        t = np.linspace(0.01, 12, 1200)
        if method == "residual":
            accepted = ncx2.cdf(chi_squared.isf(1e-3, self.est.dof), self.est.dof, t * t)
        else:  # the separation is N(t, 1) in units of its sigma
            limit = norm.isf(1e-3 / (2 * len(slopes)))
            accepted = norm.cdf(limit - t) - norm.cdf(-limit - t)
        mean, variance = np.zeros(2), np.zeros(2)
        for bias, chance in self.worst_faults(axis, slopes, pl.first_order[axis], accepted, t, self.linear.rows):
            if prior * chance < 0.01 * risk:
                continue
            # To second order the worst is larger or smaller: tried on other draws.
            trials = [size * bias for size in (1.0, 1.1, 1.2, 1.3, 1.4, -0.8, -0.9, -1.0)]
            trials += [-b for b in trials]
            worst = max(trials, key=lambda b: self.missed(b, axis, options, 500)[0])
            missed = self.missed(worst, axis, options, count)
            mean += prior * missed
            variance += prior**2 * missed * (1 - missed) / count
        return mean, np.sqrt(variance), risk - pl.unmonitored

    def missed(self, bias, axis, options, count):
        noise = self.rng.normal(size=(count, len(self.cov))) @ self.est.factor.T + bias
        batch = estimate_pose_batch(self.px + noise.reshape(count, -1, 2), self.cov, self.points, CAMERA)
        pl = protection_levels_batch(batch, **options)
        passed = check_integrity_batch(batch).usable if pl.passed is None else pl.passed
        error = axes_at(batch.positions, self.points) - axes_at(self.truth.position_m, self.points)
        return np.array(
            [(passed & (abs(error[:, axis]) > level[:, axis])).mean() for level in (pl.levels, pl.first_order)]
        )


# Risk, and a prior that makes its violations frequent enough to be counted.
RISKS = [(1e-2, 2e-2), (1e-3, 5e-3), (1e-4, 2e-3)]


@pytest.mark.slow
@pytest.mark.parametrize("full", [False, True], ids=["unequal sigma", "full covariance"])
@pytest.mark.parametrize(("risk", "prior"), RISKS)
@pytest.mark.parametrize("distance", [1000.0, 1800.0, 4000.0])
def test_the_promise_of_the_residual_based_levels(distance, risk, prior, full):
    trial = Trial(20 + full, distance, full)
    for axis in range(5):
        mean, error, left = trial.violations(axis, risk, prior, "residual", 3000)
        assert mean[0] - 2.33 * error[0] <= left  # one-sided 99 %
        if risk == 1e-2:  # and it is not slack
            assert mean[0] + 2.33 * error[0] > left / 3


@pytest.mark.slow
@pytest.mark.parametrize("full", [False, True], ids=["unequal sigma", "full covariance"])
@pytest.mark.parametrize(("risk", "prior"), RISKS)
def test_the_promise_of_the_separation_levels(risk, prior, full):
    trial = Trial(30 + full, 1800.0, full)
    for axis in range(5):
        mean, error, left = trial.violations(axis, risk, prior, "solution-separation", 2000)
        assert mean[0] - 2.33 * error[0] <= left


@pytest.mark.slow
def test_first_order_levels_break_the_promise():
    # Why the slopes are taken a second time: the first-order vertical level is exceeded at more
    # than twice the risk.
    mean, error, left = Trial(20, 4000.0, False).violations(2, 1e-4, 2e-3, "residual", 4000)
    assert mean[1] - 2.33 * error[1] > 2.0 * left
    assert mean[0] - 2.33 * error[0] <= left
