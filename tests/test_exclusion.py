"""The feature at fault is named, or it is said that it cannot be: never a guess."""

from functools import lru_cache

import numpy as np
import pytest
from scipy.stats import binom
from test_pose import CAMERA, RUNWAY, approaches, on_approach, solve

import shortfinal as sf
from shortfinal.exclusion import SURE, exclude_faults
from shortfinal.geometry import project_lines
from shortfinal.integrity import Decision

AIMING = np.array([[300.0, 12, 0], [300, -12, 0], [345, -12, 0], [345, 12, 0]])
EIGHT = np.vstack([RUNWAY.corners, AIMING])
NAMES = ("near-left", "near-right", "far-right", "far-left", "point 4", "point 5", "point 6", "point 7")
COUNT = 2000


def least(count, rate):
    """The smallest count that a true rate yields in 99.5 % of samples."""
    return binom.ppf(0.005, count, rate)


def most(count, rate):
    return binom.ppf(0.995, count, rate)


def covariance(rng, kind):
    if kind == "equal sigma":
        return 0.25 * np.eye(16)
    sigma, correlation = 0.5 * np.exp(0.6 * rng.normal(size=16)), np.eye(16)
    if kind == "full covariance":
        root = rng.normal(size=(16, 16))
        size = np.linalg.norm(root, axis=1)
        correlation = 0.9 * (root @ root.T) / np.outer(size, size) + 0.1 * np.eye(16)
    return correlation * np.outer(sigma, sigma)


class Draw:
    """A frame of eight points of which `at_fault` are off by `size` of their own sigma, or by `size_px`."""

    def __init__(self, rng, pose, corners, kind, at_fault, size, size_px=None):
        self.pose, self.points, self.cov = pose, np.vstack([corners, AIMING]), covariance(rng, kind)
        self.at_fault = tuple(sorted(at_fault))
        px = sf.project(CAMERA, pose, self.points) + (np.linalg.cholesky(self.cov) @ rng.normal(size=16)).reshape(8, 2)
        self.clean = self.solve(px)
        for k in self.at_fault:
            direction = rng.normal(size=2)
            direction /= np.linalg.norm(direction)
            own = np.linalg.cholesky(self.cov[2 * k : 2 * k + 2, 2 * k : 2 * k + 2])
            px[k] += size_px * direction if size_px else size * own @ direction
        self.est = self.solve(px)
        self.found = exclude_faults(self.est)

    def solve(self, px):
        return sf.estimate_pose(sf.GaussianKeypoints(px, self.cov), self.points, CAMERA)

    @property
    def named(self):
        return self.found.excluded == tuple(NAMES[k] for k in self.at_fault)

    @property
    def alarm(self):
        return bool(self.found.excluded) or self.found.verdict.decision is not Decision.USE


@lru_cache
def draws(kind, count=COUNT, faults=1, size=8.0, size_px=None, seed=21):
    rng = np.random.default_rng(seed)
    poses, corners, _ = approaches(seed, count, nearest_m=500.0, farthest_m=2000.0)
    return [
        Draw(rng, pose, points, kind, rng.choice(8, faults, replace=False), size, size_px)
        for pose, points in zip(poses, corners)
    ]


KINDS = ("unequal sigma", "full covariance")


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_one_point_off_by_eight_sigma_is_named_whenever_there_is_an_alarm(kind):
    alarms = [d for d in draws(kind) if d.alarm]
    wrong = sum(bool(d.found.excluded) and not d.named for d in draws(kind))
    assert sum(d.named for d in alarms) >= least(len(alarms), 0.95)
    assert wrong <= most(COUNT, 0.01)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_alarms_come_as_often_as_the_noncentral_law_says(kind):
    # Which of the faults of 8 sigma raise an alarm is physics: in some directions a near corner's
    # fault is explained by a change of pose, whatever comes after the chi-squared test.
    chances = []
    for d in draws(kind):
        shift = d.est.keypoints.mean_px - d.clean.keypoints.mean_px
        chances.append(sf.detection_probability(d.clean, shift))
    alarms = sum(d.alarm for d in draws(kind))
    expected, spread = np.sum(chances), np.sqrt(np.sum(np.multiply(chances, np.subtract(1, chances))))
    assert abs(alarms - expected) < 2.58 * spread + 0.01 * COUNT  # the law is first-order: to a hundredth


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_after_the_exclusion_errors_are_at_most_half_as_large_again(kind):
    named = [d for d in draws(kind) if d.named]
    after = np.array([d.found.estimate.pose.position_m - d.pose.position_m for d in named])
    clean = np.array([d.clean.pose.position_m - d.pose.position_m for d in named])
    assert (np.sqrt(np.mean(after**2, axis=0)) < 1.5 * np.sqrt(np.mean(clean**2, axis=0))).all()


def test_what_the_others_see_well_is_named_outright():
    # Aiming-point corners, equal sigma: every direction is seen, so that 8 sigma do not pass.
    rng = np.random.default_rng(22)
    poses, corners, _ = approaches(22, 400, nearest_m=500.0, farthest_m=2000.0)
    found = [Draw(rng, p, c, "equal sigma", [4 + i % 4], 8.0) for i, (p, c) in enumerate(zip(poses, corners))]
    assert sum(d.named for d in found) >= least(400, 0.98)


@pytest.mark.parametrize("size_px", [30.0, 300.0])
def test_a_gross_fault_is_always_named_even_where_all_rows_have_no_solution(size_px):
    found = draws("unequal sigma", 150, size_px=size_px, seed=23)
    assert all(d.named for d in found)
    if size_px == 300.0:
        assert sum(d.est.pose is None for d in found) > 10


@pytest.mark.slow
def test_two_gross_faults_are_named_together():
    found = draws("full covariance", 100, faults=2, size_px=200.0, seed=24)
    assert sum(d.named for d in found) >= least(100, 0.99)


@pytest.mark.slow
def test_two_faults_of_twelve_sigma_are_seldom_taken_for_healthy_points():
    # One of the two may hide in what a pose explains; the other is then named by itself.
    found = draws("unequal sigma", 300, faults=2, size=12.0, seed=25)
    innocent = sum(not set(d.found.excluded) <= {NAMES[k] for k in d.at_fault} for d in found)
    assert innocent <= most(300, 0.02)
    assert sum(d.named for d in found) > 150


@pytest.mark.slow
def test_faultless_frames_alarm_at_the_stated_rate():
    rng, rate = np.random.default_rng(26), 0.05
    poses, corners, _ = approaches(26, COUNT, nearest_m=500.0, farthest_m=2000.0)
    alarms = 0
    for pose, points in zip(poses, corners):
        est = Draw(rng, pose, points, "unequal sigma", [], 0.0).est
        found = exclude_faults(est, rate)
        assert (found.verdict.decision is Decision.USE and not found.excluded) == (
            sf.check_integrity(est, rate).decision is Decision.USE
        )
        alarms += found.verdict.decision is not Decision.USE or bool(found.excluded)
    assert binom.ppf(0.005, COUNT, rate) <= alarms <= most(COUNT, rate)


def test_the_culprit_is_among_the_candidates_as_often_as_their_weight_says():
    # Five points: two of three faults cannot be told apart from another's.
    rng, alarms, held, named = np.random.default_rng(27), 0, 0, 0
    poses, corners, _ = approaches(27, 400, nearest_m=500.0, farthest_m=2000.0)
    for i, (pose, four) in enumerate(zip(poses, corners)):
        points = np.vstack([four, AIMING[:1]])
        px = sf.project(CAMERA, pose, points) + 0.5 * rng.normal(size=(5, 2))
        direction = rng.normal(size=2)
        px[i % 5] += 7.5 * direction / np.linalg.norm(direction)
        found = exclude_faults(solve(px, points), max_faults=1)
        if found.candidates:
            alarms += 1
            held += (NAMES[i % 5],) in found.candidates
            named += bool(found.excluded)
            assert bool(found.excluded) == (found.verdict.decision is Decision.USE)
    assert held >= least(alarms, SURE)
    assert 0.3 * alarms < named < 0.9 * alarms


def eight_seen(shift=(0.0, 0.0), k=6, seed=28, distance=1200):
    px = sf.project(CAMERA, on_approach(distance), EIGHT) + 0.5 * np.random.default_rng(seed).normal(size=(8, 2))
    px[k] += shift
    return px


def test_the_new_estimate_is_that_of_the_rest():
    px = eight_seen((9.0, -4.0), k=5)
    root = np.random.default_rng(3).normal(size=(16, 16))
    cov = 0.02 * root @ root.T + 0.1 * np.eye(16)
    est = sf.estimate_pose(sf.GaussianKeypoints(px, cov), EIGHT, CAMERA)
    found = exclude_faults(est)
    assert found.excluded == ("point 5",)
    assert found.candidates == (("point 5",),)
    assert found.kept == (*NAMES[:5], *NAMES[6:])
    keep = np.delete(np.arange(16), [10, 11])
    rest = sf.GaussianKeypoints(np.delete(px, 5, axis=0), cov[np.ix_(keep, keep)])
    want = sf.estimate_pose(rest, np.delete(EIGHT, 5, axis=0), CAMERA)
    np.testing.assert_array_equal(found.estimate.pose.position_m, want.pose.position_m)
    np.testing.assert_array_equal(found.estimate.cov, want.cov)
    verdict = sf.check_integrity(want)
    assert (found.verdict.decision, found.verdict.statistic, found.verdict.dof) == (Decision.USE, verdict.statistic, 8)
    assert "point 5 excluded" in found.verdict.reasons[0]


def test_a_swapped_pair_is_named_as_a_pair():
    px = eight_seen()
    px[[4, 5]] = px[[5, 4]]
    found = exclude_faults(solve(px, EIGHT))
    assert found.excluded == ("point 4", "point 5")
    assert found.verdict.decision is Decision.USE
    alone = exclude_faults(solve(px, EIGHT), max_faults=1)
    assert alone.excluded == ()
    assert alone.verdict.decision is Decision.DO_NOT_USE
    assert "no single feature" in alone.verdict.reasons[-1]


def test_names_of_ones_own():
    names = ("A", "B", "C", "D", "E", "F", "G", "H")
    found = exclude_faults(solve(eight_seen((20.0, 0.0)), EIGHT), names=names)
    assert found.excluded == ("G",)
    assert found.kept == ("A", "B", "C", "D", "E", "F", "H")


def test_nothing_is_excluded_without_an_alarm():
    est = solve(eight_seen(), EIGHT)
    found = exclude_faults(est)
    assert found.estimate is est
    assert (found.excluded, found.candidates, found.kept) == ((), (), NAMES)
    assert found.verdict == sf.check_integrity(est)


def test_four_corners_have_no_freedom_to_name_one():
    px = eight_seen((30.0, 0.0), k=2)[:4]
    est = solve(px)
    found = exclude_faults(est)
    assert found.verdict.decision is Decision.DO_NOT_USE
    assert found.excluded == ()
    assert found.estimate is est
    assert "no freedom to spare" in found.verdict.reasons[-1]


def test_rivals_are_both_named():
    # Of five points two on the near left: what one of them shows to the left, the other shows to the right.
    points = EIGHT[:5]
    px = sf.project(CAMERA, on_approach(1200), points)
    px[0, 0] += 6.0
    found = exclude_faults(solve(px, points), max_faults=1)
    assert found.verdict.decision is Decision.DO_NOT_USE
    assert found.excluded == ()
    assert found.candidates == (("near-left",), ("point 4",))
    assert "cannot be told: near-left or point 4" in found.verdict.reasons[-1]


def test_hopeless_geometry_stays_not_monitored():
    line = np.column_stack([np.arange(6) * 200.0, np.zeros(6), np.zeros(6)])
    found = exclude_faults(solve(sf.project(CAMERA, on_approach(1200), line), line))
    assert found.verdict.decision is Decision.NOT_MONITORED
    assert found.estimate.pose is None
    assert found.excluded == ()


def test_the_gap_that_a_set_leaves_keeps_it_under_suspicion():
    # Four points on a line and one beside it, which is off: leaving out the first on the line would
    # do, but without the one beside it there is no solution to ask.
    points = np.array([[0.0, 0, 0], [300, 0, 0], [1000, 0, 0], [2000, 0, 0], [500, 20, 0]])
    px = sf.project(CAMERA, on_approach(1200), points)
    px[4, 1] -= 25.0
    found = exclude_faults(solve(px, points))
    assert sf.check_integrity(solve(px[1:], points[1:])).decision is Decision.USE
    assert found.verdict.decision is Decision.DO_NOT_USE
    assert found.excluded == ()
    assert found.candidates == (("point 4",),)
    assert "the rest cannot be checked" in found.verdict.reasons[-1]


@pytest.mark.parametrize("rate", [0.0, 1.0, np.nan])
def test_a_rate_that_is_no_probability_is_refused(rate):
    with pytest.raises(sf.InputError, match="between 0 and 1"):
        exclude_faults(solve(eight_seen(), EIGHT), rate)


@pytest.mark.parametrize("faults", [0, -1, 1.5, True, "two"])
def test_a_wrong_number_of_faults_is_refused(faults):
    with pytest.raises(sf.InputError, match="max_faults"):
        exclude_faults(solve(eight_seen(), EIGHT), max_faults=faults)


@pytest.mark.parametrize("names", ["ABCDEFGH", ["A"] * 8, ["A", "B"]])
def test_wrong_names_are_refused(names):
    with pytest.raises(sf.InputError, match="names"):
        exclude_faults(solve(eight_seen(), EIGHT), names=names)


def with_everything(**faulty):
    """Corners, both edges as lines, and three sharp priors; `faulty` replaces some of them."""
    rng, truth = np.random.default_rng(30), on_approach(1200)
    near_left, near_right, far_right, far_left = RUNWAY.corners
    edges = np.array([[near_left, far_left], [near_right, far_right]])
    given = {
        "px": sf.project(CAMERA, truth, RUNWAY.corners) + 0.5 * rng.normal(size=(4, 2)),
        "lines": project_lines(CAMERA, truth, edges) + [0.3, 5e-4] * rng.normal(size=(2, 2)),
        "turn": 1e-3 * rng.normal(size=3),
        "shift": [3.0, 2.0, 2.0] * rng.normal(size=3),
        "height": 0.5 * rng.normal(),
    }
    given = {name: value + np.asarray(faulty.get(name, 0.0)) for name, value in given.items()}
    return sf.estimate_pose(
        sf.GaussianKeypoints.from_sigma(given["px"], 0.5),
        RUNWAY.corners,
        CAMERA,
        lines=(given["lines"], np.diag(np.tile([0.3, 5e-4], 2) ** 2)),
        edges=edges,
        attitude_prior=(truth.plus([0, 0, 0, *given["turn"]]).runway_from_camera, 1e-6 * np.eye(3)),
        position_prior=(truth.position_m + given["shift"], np.diag([9.0, 4, 4])),
        altitude=(truth.position_m[2] + given["height"], 0.5),
    )


@pytest.mark.parametrize(
    "name, faulty",
    [
        ("far-right", {"px": [[0, 0], [0, 0], [8.0, 0], [0, 0]]}),
        ("line 1", {"lines": [[0, 0], [0, 0.02]]}),
        ("attitude prior", {"turn": [0.02, 0, 0]}),
        ("position prior", {"shift": [30.0, 0, 0]}),
        ("altitude", {"height": 6.0}),
    ],
)
def test_lines_and_priors_are_features_like_points(name, faulty):
    assert exclude_faults(with_everything()).excluded == ()
    est = with_everything(**faulty)
    found = exclude_faults(est)
    assert found.excluded == (name,)
    assert found.verdict.decision is Decision.USE
    assert found.kept == tuple(f.name for f in est.features if f.name != name)
    rows = next(f.rows for f in est.features if f.name == name)
    assert found.estimate.dof == est.dof - (rows.stop - rows.start)
    # To first order, what is left is the least squares of the other rows. (The rows are independent.)
    keep = np.delete(np.arange(len(est.residual)), rows)
    step = np.linalg.lstsq(est.jacobian[keep], est.residual[keep], rcond=None)[0]
    moved = est.pose.plus(step).minus(found.estimate.pose)
    assert np.abs(moved / np.sqrt(np.diag(found.estimate.cov))).max() < 0.2


def test_a_sharp_altimeter_with_four_corners_names_what_it_can():
    # One spare degree of freedom is left without a corner: some corners' faults can then be told.
    truth, named, wrong = on_approach(900), 0, 0
    rng = np.random.default_rng(31)
    for i in range(200):
        px = sf.project(CAMERA, truth, RUNWAY.corners) + 0.5 * rng.normal(size=(4, 2))
        direction = rng.normal(size=2)
        px[i % 4] += 20 * direction / np.linalg.norm(direction)
        found = exclude_faults(solve(px, altitude=(truth.position_m[2] + 0.3 * rng.normal(), 0.3)), max_faults=1)
        named += found.excluded == (NAMES[i % 4],)
        wrong += found.excluded not in ((), (NAMES[i % 4],))
        assert (found.verdict.decision is Decision.USE) or found.excluded == ()
    assert named > 40
    assert wrong <= most(200, 0.03)
