"""The window's promises: false alarms at their rate, faults of the world seen, and what stays unseen."""

import re
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import binom, kstest
from test_pose import CAMERA

import shortfinal as sf
from shortfinal.integrity import Decision
from shortfinal.pose import estimate_pose_batch
from shortfinal.window import (
    FRAME_SUSPECTS,
    SUSPECTS,
    FadingWindow,
    IntegrityWindow,
    RelativeMotion,
    Suspect,
    _in_residual,
    check_window,
)

RATES = (0.05, 0.01, 0.001)
RUNWAY = sf.Runway(1500.0, 45.0)
SHORT = sf.Runway(1500.0 - 184.0, 45.0)
STEP_COV = np.diag([0.2**2] * 3 + [np.radians(0.05) ** 2] * 3)  # of odometry over a second


def flight(rng, start_m, frames, step_m=70.0):
    """Poses down a 3 degree glide path, a second apart at 70 m/s, with slow turns of the attitude."""
    phase, aside = rng.uniform(0, 2 * np.pi, 3), rng.normal(0, 10)
    distance = start_m - step_m * np.arange(frames)
    swing = np.sin(phase + 0.5 * np.arange(frames)[:, None]) * [1.0, 0.7, 2.0] - [0, 3, 0]
    return [sf.Pose.from_attitude([-d, aside, d * np.tan(np.radians(3)) + 10], *a) for d, a in zip(distance, swing)]


def odometry(rng, poses, cov=STEP_COV, stride=1.0):
    """Measured motions between poses, in error as claimed, and `stride` times too long."""
    root, motions = np.linalg.cholesky(cov), []
    for earlier, later in pairwise(poses):
        true = RelativeMotion.between(earlier, later, cov)
        seen = sf.Pose(stride * true.translation_m, true.earlier_from_later).plus(root @ rng.normal(size=6))
        motions.append(RelativeMotion(seen.position_m, seen.runway_from_camera, cov))
    return motions


def frames(rng, poses, sigma=0.5, full=False, image=RUNWAY, camera=CAMERA, noise=None, inflation=1.0):
    """Estimates of RUNWAY through CAMERA where `camera` sees `image`; σ log-normal, or a full Σ."""
    truth = np.array([sf.project(camera, pose, image.corners) for pose in poses])
    size = sigma * np.exp(0.4 * rng.normal(size=(len(poses), 8)))
    correlation = np.tile(np.eye(8), (len(poses), 1, 1))
    if full:
        root = rng.normal(size=(len(poses), 8, 8))
        root /= np.linalg.norm(root, axis=2, keepdims=True)
        correlation = 0.8 * root @ np.swapaxes(root, 1, 2) + 0.2 * correlation
    cov = correlation * size[:, :, None] * size[:, None, :]
    unit = rng.normal(size=(len(poses), 8)) if noise is None else noise
    error = (np.linalg.cholesky(cov) @ unit[..., None]).reshape(-1, 4, 2)
    batch = estimate_pose_batch(truth + error, inflation * cov, RUNWAY.corners, CAMERA)
    return [batch[i] for i in range(len(batch))]


def window(rng, start_m=3000.0, length=20, sigma=0.8, stride=1.0, **fault):
    """A flight's estimates, motions and true poses."""
    poses = flight(rng, start_m, length)
    return frames(rng, poses, sigma, **fault), odometry(rng, poses, stride=stride), poses


COUNTS = {2: 1500, 5: 800, 20: 300, 50: 100}
DRAWS = 10  # of the noise on each flight


@lru_cache
def faultless(length, full):
    """P-values (count, 1 + S), of the whole and of each suspect, on windows at random ranges and sigmas."""
    rng = np.random.default_rng([length, full])
    found = []
    while len(found) < COUNTS[length]:
        step = 70 * min(1.0, 20 / length)
        poses = flight(rng, rng.uniform(500 + step * length, 4000), length, step)
        seen = frames(rng, DRAWS * poses, rng.choice([0.3, 0.8, 2.0]), full)
        for draw in range(DRAWS):
            # No alarm at such a rate: the suspicions stay those of the score test.
            verdict = check_window(seen[draw * length : (draw + 1) * length], odometry(rng, poses), 1e-12)
            of = {suspicion.suspect: suspicion.p_value for suspicion in verdict.suspicions}
            found.append([verdict.p_value, *(of[suspect] for suspect in SUSPECTS)])
    return np.array(found)


@pytest.mark.parametrize("full", [False, True], ids=["unequal sigma", "full covariance"])
@pytest.mark.parametrize("length", COUNTS)
def test_p_values_of_faultless_windows_are_uniform(length, full):
    p = faultless(length, full)
    assert np.isfinite(p).all()
    for column in p.T:
        assert kstest(column, "uniform").pvalue > 0.002  # forty such tests: one fails in a dozen seeds
        low, high = binom.interval(0.999, len(p), 0.05)
        assert low <= (column < 0.05).sum() <= high


@pytest.mark.parametrize("full", [False, True], ids=["unequal sigma", "full covariance"])
def test_false_alarms_come_at_the_nominal_rate(full):
    p = np.vstack([faultless(length, full) for length in COUNTS])
    for rate in RATES:
        low, high = binom.interval(0.999, len(p), rate)
        for column in p.T:
            assert low <= (column < rate).sum() <= high
        # The decision: half for the whole, half shared by the suspects. Bonferroni wastes little.
        refused = (p[:, 0] < rate / 2) | (p[:, 1:] < rate / 2 / len(SUSPECTS)).any(axis=1)
        assert binom.ppf(0.0005, len(p), 0.7 * rate) <= refused.sum() <= high


def log(rotation):
    return Rotation.from_matrix(rotation).as_rotvec()


def reference(estimates, motions, size, start=None):
    """The same least squares by scipy, written out: cost, poses and covariance of their local increments."""

    def poses(x):
        given = start or [est.pose for est in estimates]
        return [pose.plus(d * size) for pose, d in zip(given, x.reshape(-1, 6))]

    def residual(x):
        at, rows = poses(x), []
        for est, pose in zip(estimates, at):
            left = est.keypoints.mean_px - sf.project(est.camera, pose, est.points)
            rows.append(est.keypoints.whitening @ left.ravel())
            beside = slice(left.size, None)
            rows.append(est.residual[beside] - est.jacobian[beside] @ pose.minus(est.pose))
        for motion, (a, b) in zip(motions, pairwise(at)):
            shift = motion.translation_m - a.runway_from_camera.T @ (b.position_m - a.position_m)
            turn = log((a.runway_from_camera.T @ b.runway_from_camera).T @ motion.earlier_from_later)
            rows.append(np.linalg.solve(np.linalg.cholesky(motion.cov), np.concatenate([shift, turn])))
        return np.concatenate(rows)

    fit = least_squares(residual, np.zeros(6 * len(estimates)), method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    if start is None:  # once more, for derivatives at the optimum
        return reference(estimates, motions, size, poses(fit.x))
    return 2 * fit.cost, poses(fit.x), np.linalg.inv(fit.jac.T @ fit.jac)


def with_altitude(est, height_m, sigma_m):
    """An estimate with one more row, as a radar altimeter's."""
    row = np.eye(6)[2] / sigma_m
    left = (height_m - est.pose.position_m[2]) / sigma_m
    return replace(est, residual=np.append(est.residual, left), jacobian=np.vstack([est.jacobian, row]))


@pytest.mark.parametrize("start_m", [1500.0, 3500.0])
def test_statistic_poses_and_covariances_are_those_of_an_independent_solver(start_m):
    rng = np.random.default_rng(1)
    poses = flight(rng, start_m, 6)
    root = 0.02 * rng.normal(size=(6, 6)) + np.diag([0.5] * 3 + [0.01] * 3)
    scale = np.diag([1.0] * 3 + [0.05] * 3)
    motions = odometry(rng, poses, scale @ root @ root.T @ scale)
    estimates = frames(rng, poses, 1.0, full=True)
    points = np.vstack([RUNWAY.corners, [[300, 9, 0], [300, -9, 0]]])  # two more keypoints in one frame
    px = sf.project(CAMERA, poses[2], points) + rng.normal(size=(6, 2))
    estimates[2] = sf.estimate_pose(sf.GaussianKeypoints.from_sigma(px, 1.0), points, CAMERA)
    estimates[4] = with_altitude(estimates[4], poses[4].position_m[2] + 1.0, 2.0)
    size = np.array([1.0] * 3 + [1e-3] * 3)
    cost, at, cov = reference(estimates, motions, size)
    verdict = check_window(estimates, motions)
    assert verdict.dof == 6 * 8 + 4 + 1 + 5 * 6 - 6 * 6
    assert verdict.statistic == pytest.approx(cost, abs=2e-6)
    # The statistic is within 1e-6 of its minimum, so each pose within a thousandth of a deviation.
    for k, pose in enumerate(at):
        block = cov[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] * np.outer(size, size)
        apart = sf.Pose(verdict.positions[k], verdict.rotations[k]).minus(pose)
        assert np.abs(apart / np.sqrt(np.diag(block))).max() < 2e-3
        correlation = np.outer(*2 * [np.sqrt(np.diag(block))])
        np.testing.assert_allclose(verdict.covs[k] / correlation, block / correlation, atol=2e-3)
    assert np.abs(verdict.pose.minus(at[-1])[:3]).max() < 0.1


def test_smoothed_errors_are_as_large_as_their_covariance_says():
    # The mean of 300 squared normalised errors of six components: 6 with a standard error of 0.2.
    rng = np.random.default_rng(2)
    squared = []
    for _ in range(300):
        estimates, motions, poses = window(rng, 1800, 10, 0.5)
        verdict = check_window(estimates, motions)
        error = verdict.pose.minus(poses[-1])
        squared.append(error @ np.linalg.solve(verdict.covs[-1], error))
    assert abs(np.mean(squared) - 6) < 3 * np.sqrt(12 / 300)


FAULTS = {
    "shorter": ({"image": SHORT}, -184.0),
    "wider": ({"image": sf.Runway(1500.0, 50.0)}, 5.0),
    "longer focal length": ({"camera": replace(CAMERA, fx=1.03 * CAMERA.fx, fy=1.03 * CAMERA.fy)}, 0.03),
    "odometry long": ({"stride": 1.06}, 0.06),
}


@pytest.mark.parametrize("suspect", range(4), ids=FAULTS)
def test_a_constant_fault_is_seen_named_and_measured(suspect):
    rng = np.random.default_rng([3, suspect])
    fault, value = list(FAULTS.values())[suspect]
    pulls, seen, alone = [], 0, 0
    for _ in range(30):
        estimates, motions, _ = window(rng, 2600, 20, 0.6, **fault)
        verdict = check_window(estimates, motions)
        seen += verdict.decision is Decision.DO_NOT_USE
        alone += sf.check_integrity(estimates[0]).decision is Decision.DO_NOT_USE
        found = next(s for s in verdict.suspicions if s.suspect is SUSPECTS[suspect])
        if verdict.decision is Decision.DO_NOT_USE:
            pulls.append((found.value - value) / found.sigma)
            assert verdict.suspicions[0].statistic - found.statistic < 14
    assert seen >= 27
    assert alone <= 6
    assert abs(np.mean(pulls)) < 3.3 / np.sqrt(len(pulls))
    assert np.mean(np.square(pulls)) < 1 + 3.3 * np.sqrt(2 / len(pulls))


def test_the_184_m_fault_is_named_in_words():
    estimates, motions, _ = window(np.random.default_rng(4), image=SHORT)
    verdict = check_window(estimates, motions)
    assert verdict.decision is Decision.DO_NOT_USE
    assert verdict.suspicions[0].suspect is SUSPECTS[0]
    assert "explained by: runway " in verdict.reasons[1]
    assert " m shorter" in verdict.reasons[1]
    only_whole = check_window(estimates, motions, suspects=())
    assert only_whole.statistic == pytest.approx(verdict.statistic, rel=1e-9)
    assert only_whole.suspicions == ()


def test_which_end_is_wrong_is_not_to_be_known():
    # A runway 60 m short at its far end, or at its near end with the world 60 m further on: the
    # images are the same, and so is the statistic. Only a position from elsewhere tells.
    motions, statistics = None, []
    for near in (False, True):
        rng = np.random.default_rng(5)
        poses = flight(rng, 2500, 10)
        corners = np.array(RUNWAY.corners) - np.outer([0, 0, 1, 1], [60.0, 0, 0])
        moved = [60.0, 0, 0] if near else [0, 0, 0]
        poses = [sf.Pose(pose.position_m + moved, pose.runway_from_camera) for pose in poses]
        image = sf.Runway(1440.0, 45.0, corners=corners + moved)
        estimates, motions = frames(rng, poses, image=image), odometry(rng, poses)
        statistics.append(check_window(estimates, motions).statistic)
    assert statistics[0] == pytest.approx(statistics[1], rel=1e-9)


@pytest.mark.parametrize(("rho", "most", "least"), [(0.5, 0.2, 0.01), (0.9, 0.8, 0.1)])
def test_errors_correlated_in_time_raise_false_alarms_and_an_inflated_covariance_mends_that(rho, most, least):
    # A limit, kept in sight: the test takes the errors of frames as independent.
    rng = np.random.default_rng(6)
    refused, mended, count = 0, 0, 100
    for _ in range(count):
        poses = flight(rng, 2500, 20)
        noise = rng.normal(size=(20, 8))
        for k in range(1, 20):
            noise[k] = rho * noise[k - 1] + np.sqrt(1 - rho**2) * noise[k]
        motions, state = odometry(rng, poses), rng.bit_generator.state
        refused += check_window(frames(rng, poses, noise=noise), motions, 0.01).decision is Decision.DO_NOT_USE
        rng.bit_generator.state = state
        inflated = frames(rng, poses, noise=noise, inflation=(1 + rho) / (1 - rho))
        mended += check_window(inflated, motions, 0.01).decision is Decision.DO_NOT_USE
    assert binom.ppf(0.999, count, 0.01) < refused
    assert least * count < refused < most * count
    assert mended <= binom.ppf(0.999, count, 0.01)


# The running window


def unsolved(pose):
    """No estimate: all points lie on a line."""
    line = np.column_stack([np.linspace(0, 1500, 4), np.zeros(4), np.zeros(4)])
    keypoints = sf.GaussianKeypoints.from_sigma(sf.project(CAMERA, pose, line), 1.0)
    return sf.estimate_pose(keypoints, line, CAMERA)


def test_a_flight_is_checked_frame_after_frame():
    estimates, motions, _ = window(np.random.default_rng(7), length=9)
    run = IntegrityWindow(length=4, false_alarm_rate=2e-3)
    first = run.push(estimates[0])
    assert first.decision is Decision.NOT_MONITORED
    assert first.reasons == ("a window needs two frames",)
    for k in range(1, 9):
        verdict, start = run.push(estimates[k], motions[k - 1]), max(0, k - 3)
        whole = check_window(estimates[start : k + 1], motions[start:k], 1e-3)
        assert verdict.statistic == whole.statistic
        assert verdict.false_alarm_rate == 1e-3
        assert verdict.decision is Decision.USE


def test_frames_between_are_checked_but_not_held():
    estimates, motions, _ = window(np.random.default_rng(8), length=8)
    run = IntegrityWindow(length=3, every=3)
    verdicts = [run.push(est, motion) for est, motion in zip(estimates, [None, *motions])]
    composed = [motions[0].then(motions[1]).then(motions[2]), motions[3].then(motions[4]).then(motions[5])]
    want = check_window([estimates[k] for k in (0, 3, 6)], composed, 5e-4)
    assert verdicts[6].statistic == pytest.approx(want.statistic, abs=1e-6)
    want = check_window([estimates[k] for k in (3, 6, 7)], [composed[1], motions[6]], 5e-4)
    assert verdicts[7].statistic == pytest.approx(want.statistic, abs=1e-6)


def test_bad_frames_are_left_out_and_do_not_linger():
    rng = np.random.default_rng(9)
    estimates, motions, poses = window(rng, 1500, 6)
    slid = estimates[2].keypoints.mean_px + np.array([[0, 0], [0, 0], [40.0, 0], [0, 0]])
    slid = sf.estimate_pose(sf.GaussianKeypoints(slid, estimates[2].keypoints.cov_px), RUNWAY.corners, CAMERA)
    run = IntegrityWindow(length=6)
    given = [*estimates[:2], slid, unsolved(poses[3]), None, estimates[5]]
    verdicts = [run.push(est, motion) for est, motion in zip(given, [None, *motions])]
    assert verdicts[2].decision is Decision.DO_NOT_USE
    assert verdicts[2].reasons[0].startswith("this frame by itself: residual")
    assert verdicts[3].decision is verdicts[4].decision is Decision.NOT_MONITORED
    assert verdicts[3].reasons == ("no unique estimate: the solver ended ill-conditioned",)
    assert verdicts[4].reasons == ("no estimate",)
    composed = motions[1].then(motions[2]).then(motions[3]).then(motions[4])
    want = check_window([*estimates[:2], estimates[5]], [motions[0], composed], 5e-4)
    assert verdicts[5].statistic == pytest.approx(want.statistic, abs=1e-6)
    assert verdicts[5].decision is Decision.USE


def test_where_the_motion_is_unknown_the_frames_are_tied_by_the_suspects_alone():
    estimates, _, _ = window(np.random.default_rng(10), 2000, image=SHORT)
    verdict = check_window(estimates, [None] * 19)
    assert verdict.dof == 20 * 2
    assert verdict.statistic == pytest.approx(sum(est.chi2 for est in estimates), abs=2e-6)
    np.testing.assert_allclose(verdict.covs[3], estimates[3].cov, rtol=1e-3)
    assert verdict.decision is Decision.DO_NOT_USE
    assert verdict.suspicions[-1].sigma == np.inf
    assert str(verdict.suspicions[-1]) == "odometry short or long: not to be seen"


def test_lost_odometry_is_lost_until_the_next_frame_held():
    estimates, motions, _ = window(np.random.default_rng(14), length=5)
    run = IntegrityWindow(every=2)
    given = [None, motions[0], None, motions[2], motions[3]]
    verdicts = [run.push(est, motion) for est, motion in zip(estimates, given)]
    assert [verdict.dof for verdict in verdicts] == [2, 2 + 8, 2 + 2, 2 + 2 + 8, 2 + 2 + 8]
    want = check_window([estimates[k] for k in (0, 2, 4)], [None, motions[2].then(motions[3])], 5e-4)
    assert verdicts[4].statistic == pytest.approx(want.statistic, abs=1e-6)


# Relative motion


def test_motions_compose_like_poses_and_so_do_their_errors():
    rng = np.random.default_rng(11)
    a, b, c = (sf.Pose.from_attitude(rng.normal(0, 50, 3), *rng.uniform(-30, 30, 3)) for _ in range(3))
    cov = np.diag([0.1, 0.2, 0.3, 0.004, 0.005, 0.006]) ** 2
    whole = RelativeMotion.between(a, b, cov).then(RelativeMotion.between(b, c, 4 * cov))
    want = RelativeMotion.between(a, c, cov)
    np.testing.assert_allclose(whole.translation_m, want.translation_m, atol=1e-12)
    np.testing.assert_allclose(whole.earlier_from_later, want.earlier_from_later, atol=1e-12)
    assert a.plus(np.zeros(6)).position_m + a.runway_from_camera @ want.translation_m == pytest.approx(c.position_m)

    def noisy(start, end, size):
        true = RelativeMotion.between(start, end, cov)
        moved = sf.Pose(true.translation_m, true.earlier_from_later).plus(
            size * np.sqrt(np.diag(cov)) * rng.normal(size=6)
        )
        return RelativeMotion(moved.position_m, moved.runway_from_camera, cov)

    true = sf.Pose(want.translation_m, want.earlier_from_later)
    errors = []
    for _ in range(3000):
        both = noisy(a, b, 1.0).then(noisy(b, c, 2.0))
        errors.append(sf.Pose(both.translation_m, both.earlier_from_later).minus(true))
    # Mean of squared normalised errors: 6 with a standard error of sqrt(12 / 3000).
    squared = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(whole.cov), errors)
    assert abs(squared.mean() - 6) < 3 * np.sqrt(12 / 3000)


def test_a_rotation_object_will_do():
    turn = Rotation.from_euler("z", 5, degrees=True)
    np.testing.assert_array_equal(RelativeMotion([1, 0, 0], turn, np.eye(6)).earlier_from_later, turn.as_matrix())


# Refusals


@pytest.mark.parametrize(
    ("translation", "turn", "cov", "message"),
    [
        ([1, 2], np.eye(3), np.eye(6), "motion: position_m: expected shape"),
        ([1, 2, np.nan], np.eye(3), np.eye(6), "motion: position_m: entry"),
        ([1, 2, 3], 2 * np.eye(3), np.eye(6), "motion: runway_from_camera: not a rotation"),
        ([1, 2, 3], np.eye(3), np.eye(5), "motion: cov: expected shape"),
        ([1, 2, 3], np.eye(3), np.zeros((6, 6)), "motion: cov: the variance of x is 0"),
        ([1, 2, 3], np.eye(3), np.diag([1, 1, 1, 1, 1, -1.0]), "motion: cov: the variance of the turn about z is -1"),
        ([1, 2, 3], np.eye(3), np.ones((6, 6)), "motion: cov: not positive definite"),
        ([1, 2, 3], np.eye(3), np.eye(6) + np.eye(6, k=1) / 2, "motion: cov: not symmetric"),
    ],
)
def test_bad_motions_are_refused(translation, turn, cov, message):
    with pytest.raises(sf.InputError, match=message):
        RelativeMotion(translation, turn, cov)


def test_bad_windows_are_refused():
    estimates, motions, _ = window(np.random.default_rng(12), length=3)
    with pytest.raises(sf.InputError, match="motions: 1 for 3 estimates; give one between each two"):
        check_window(estimates, motions[:1])
    with pytest.raises(sf.InputError, match="false_alarm_rate: 2 is no probability"):
        check_window(estimates, motions, 2)
    for bad in ({"length": 1}, {"every": 0}):
        with pytest.raises(sf.InputError, match="must be at least 2, and every"):
            IntegrityWindow(**bad)
    with pytest.raises(sf.InputError, match="false_alarm_rate"):
        IntegrityWindow(false_alarm_rate=0)
    with pytest.raises(sf.InputError, match="suspect lamp: does nothing; give shift, zoom or stride"):
        Suspect("lamp", ("dim", "bright"))
    with pytest.raises(sf.InputError, match="suspect lamp: shift: expected shape"):
        Suspect("lamp", ("dim", "bright"), shift=((1.0, 0.0),))


def test_a_suspect_of_ones_own():
    # The far edge shifted 2 m to the left in the world: none of the built-in suspects does that.
    skew = Suspect("far end", ("to the right", "to the left"), shift=((0, 0, 0), (0, 0, 0), (0, 1, 0), (0, 1, 0)))
    lift = Suspect("far left corner", ("lower", "higher"), shift=((0, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 1)))
    rng = np.random.default_rng(15)
    raised = sf.Runway(1500.0, 45.0, corners=RUNWAY.corners + np.outer([0, 0, 0, 1], [0, 0, 2.0]))
    estimates, motions, _ = window(rng, 2000, image=raised, sigma=0.4)
    verdict = check_window(estimates, motions, suspects=(skew, lift))
    first = verdict.suspicions[0]
    assert first.suspect is lift
    assert abs(first.value - 2.0) < 3.3 * first.sigma
    assert verdict.reasons[1].startswith("explained by: far left corner ")


def test_what_cannot_be_checked_is_not_monitored():
    rng = np.random.default_rng(13)
    poses = flight(rng, 3000, 3)
    estimates, motions = frames(rng, poses), odometry(rng, poses)
    exact = odometry(rng, poses, 1e-16 * STEP_COV)
    vague = frames(rng, poses, 18.0, noise=np.zeros((3, 8)))
    blank = [replace(e, sharp_rows=0) for e in estimates]
    for given, moved, reason in (
        ([], [], "two frames"),
        (estimates[:1], [], "two frames"),
        (estimates, exact, "no well-determined optimum"),
        (vague, [None, None], "uncertain by more than 50% of its distance"),
        (blank, motions, "no redundancy in effect"),
        ([estimates[0], unsolved(poses[1]), estimates[2]], motions, "frame 1: .* ended ill-conditioned"),
    ):
        verdict = check_window(given, moved)
        assert verdict.decision is Decision.NOT_MONITORED
        assert re.search(reason, verdict.reasons[0])
        assert verdict.statistic is verdict.p_value is verdict.pose is verdict.covs is None
        assert verdict.suspicions == ()


# Frame after frame without motion, errors persisting


TAU_S, PERIOD_S = 2.0, 0.5


def persisting(rng, count, time_s):
    """Unit errors (count, 8), a period apart, that persist as a first-order Gauss-Markov process."""
    unit, fade = rng.normal(size=(count, 8)), np.exp(-PERIOD_S / time_s)
    for k in range(1, count):
        unit[k] = fade * unit[k - 1] + np.sqrt(1 - fade**2) * unit[k]
    return unit


def faded(estimates, time_s=TAU_S):
    """What a window says of each frame's past."""
    window = FadingWindow(time_s)
    return [window.push(PERIOD_S * k, estimate) for k, estimate in enumerate(estimates)]


@lru_cache
def approaches(full, time_s, taken_s=TAU_S, count=120):
    """Least p of the suspects at the end of faultless approaches of 12 s, sigma changing from frame to frame."""
    rng, found = np.random.default_rng([full, 40]), []
    for _ in range(count):
        poses = flight(rng, rng.uniform(1200, 3000), 24, 70.0 * PERIOD_S)
        seen = frames(rng, poses, rng.choice([0.3, 0.8]), full, noise=persisting(rng, 24, time_s))
        found.append(faded(seen, taken_s)[-1][0].p_value)
    return np.array(found)


@pytest.mark.parametrize("full", [False, True], ids=["unequal sigma", "full covariance"])
@pytest.mark.parametrize("time_s", [TAU_S, 0.2])
def test_errors_that_persist_raise_no_more_alarms_than_stated(full, time_s):
    p = approaches(full, time_s)
    for rate in RATES:
        assert np.sum(p < rate / len(FRAME_SUSPECTS)) <= binom.ppf(1 - 1e-3, len(p), rate)


def test_errors_that_persist_for_longer_do():
    # Twenty looks at one error are no twenty proofs: the rate rests on the time.
    p = approaches(False, TAU_S, 0.0)
    assert np.mean(p < 0.01 / len(FRAME_SUSPECTS)) > 0.2


def test_the_bound_is_exact_where_nothing_moves():
    # The same pose and sigma in each frame: every effect is the same, and Cauchy-Schwarz an equality.
    rng, found = np.random.default_rng(41), []
    pose = flight(rng, 1500.0, 1)[0]
    cov = np.diag(rng.uniform(0.1, 0.4, 8) ** 2)
    truth = sf.project(CAMERA, pose, RUNWAY.corners).ravel()
    for _ in range(300):
        px = truth + persisting(rng, 10, TAU_S) @ np.sqrt(cov)
        batch = estimate_pose_batch(px.reshape(-1, 4, 2), cov, RUNWAY.corners, CAMERA)
        ranked = faded([batch[k] for k in range(10)])[-1]
        found.append([next(s.p_value for s in ranked if s.suspect is suspect) for suspect in FRAME_SUSPECTS])
    assert all(kstest(p, "uniform").pvalue > 1e-3 / len(FRAME_SUSPECTS) for p in np.transpose(found))


def test_the_sums_are_what_they_are_said_to_be():
    rng = np.random.default_rng(42)
    poses, times = flight(rng, 2000.0, 5), np.array([0.0, 0.3, 1.1, 1.2, 4.0])
    seen, window = frames(rng, poses), FadingWindow(2.0, memory_s=5.0)
    ranked = [window.push(t, est) for t, est in zip(times, seen)][-1]
    effects = np.array([_in_residual(est, FRAME_SUSPECTS) for est in seen])  # (5, 8, S)
    weight, size = np.exp((times - times[-1]) / 5.0), np.linalg.norm(effects, axis=1)
    score = np.einsum("k,kn,kns->s", weight, [est.residual for est in seen], effects)
    alike = np.exp(-np.abs(times[:, None] - times) / 2.0)
    variance = np.einsum("k,j,ks,js,kj->s", weight, weight, size, size, alike)
    information = weight @ size**2
    for s, suspect in enumerate(FRAME_SUSPECTS):
        found = next(one for one in ranked if one.suspect is suspect)
        np.testing.assert_allclose(found.statistic, score[s] ** 2 / variance[s], rtol=1e-10)
        np.testing.assert_allclose(found.value, score[s] / information[s], rtol=1e-10)
        np.testing.assert_allclose(found.sigma, np.sqrt(variance[s]) / information[s], rtol=1e-10)
    assert [one.statistic for one in ranked] == sorted((one.statistic for one in ranked), reverse=True)


@pytest.mark.parametrize("suspect", FRAME_SUSPECTS, ids=lambda s: s.name)
def test_a_unit_of_a_suspect_leaves_this_in_the_residual(suspect):
    rng, size = np.random.default_rng(43), 1e-3
    pose = flight(rng, 1500.0, 1)[0]
    wrong = sf.Runway(1500.0, 45.0, corners=RUNWAY.corners + size * np.array(suspect.shift or np.zeros((4, 3))))
    camera = replace(CAMERA, fx=(1 + size * suspect.zoom) * CAMERA.fx, fy=(1 + size * suspect.zoom) * CAMERA.fy)
    cov = np.diag(rng.uniform(0.3, 1.0, 8) ** 2)
    px = sf.project(camera, pose, wrong.corners)
    est = sf.estimate_pose(sf.GaussianKeypoints(px, cov), RUNWAY.corners, CAMERA)
    effect = _in_residual(est, [suspect])[:, 0]
    np.testing.assert_allclose(est.residual / size, effect, atol=2e-3 * np.abs(effect).max())


def test_frames_that_pass_each_by_itself_show_the_far_threshold_together():
    rng = np.random.default_rng(44)
    poses = flight(rng, 3000.0, 50, 70.0 * PERIOD_S)
    seen = frames(rng, poses, 0.8, image=SHORT, noise=persisting(rng, 50, TAU_S))
    ranked = faded(seen)[-1]
    assert np.mean([sf.check_integrity(est).decision is Decision.USE for est in seen]) > 0.8
    assert ranked[0].p_value < 1e-4
    length = next(one for one in ranked if one.suspect.name == "runway" and one.suspect.words[0] == "shorter")
    assert abs(length.value + 184) < 4 * length.sigma
    assert "m shorter" in str(length)


def test_a_world_of_another_size_leaves_nothing():
    # Length, width and path 3 % larger: the same pictures.
    rng = np.random.default_rng(45)
    poses = flight(rng, 3000.0, 20)
    larger = sf.Runway(1.03 * 1500.0, 1.03 * 45.0)
    seen = frames(rng, poses, 0.3, image=larger, noise=np.zeros((20, 8)))
    assert min(ranked[0].p_value for ranked in faded(seen)) > 0.999


def test_a_frame_without_an_estimate_says_nothing():
    rng, window = np.random.default_rng(46), FadingWindow(TAU_S)
    [good] = frames(rng, flight(rng, 1500.0, 1))
    bad = sf.estimate_pose(good.keypoints, np.zeros((4, 3)), CAMERA)
    assert all(one.p_value == 1.0 and one.sigma == np.inf for one in window.push(0.0, bad))
    assert window.push(1.0, good) == window.push(2.0, bad)


@pytest.mark.parametrize(
    ("given", "words"),
    [((-1.0,), "correlation_time_s is -1"), ((np.nan,), "correlation_time_s"), ((2.0, 0.0), "memory_s is 0")],
)
def test_a_fading_window_without_sense_is_refused(given, words):
    with pytest.raises(sf.InputError, match=words):
        FadingWindow(*given)
