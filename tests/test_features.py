"""Lines and priors enter the solver as rows like any other: same derivatives, optimum and statistics."""

from functools import lru_cache
from itertools import product

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import binom, kstest
from test_pose import CAMERA, MORE_POINTS, RUNWAY, WIDE, approaches, on_approach

import shortfinal as sf
from shortfinal.features import Altitude, AttitudePrior, GaussianLines, PositionPrior
from shortfinal.geometry import log_kernel, project_lines, so3_exp
from shortfinal.integrity import Decision, check_integrity_batch
from shortfinal.pose import CONTRADICTION_SIGMAS, STATUS_OF_CODE, SolverStatus, estimate_pose_batch

EDGES = RUNWAY.edges
PINHOLE_WIDE = sf.Camera(1280, 960, 700.0, 690.0, 630.0, 470.0)


def spd(rng, *sigmas):
    """A covariance with the given standard deviations, and correlations of about a half."""
    size = len(sigmas)
    root = rng.normal(size=(size, size))
    cov = root @ root.T / size + 0.2 * np.eye(size)
    scale = np.array(sigmas) / np.sqrt(np.diag(cov))
    return cov * np.outer(scale, scale)


def line_sigmas(count):
    return [0.7, 4e-4] * count  # px, rad


def everything(rng, truth, camera=CAMERA, points=RUNWAY.corners, noise=1.0):
    """Keypoints with a full covariance and every other measurement, drawn around the truth."""

    def draw(cov):
        return noise * np.linalg.cholesky(cov) @ rng.normal(size=len(cov))

    cov = spd(rng, *rng.uniform(0.3, 1.0, 2 * len(points)))
    mean = sf.project(camera, truth, points) + draw(cov).reshape(-1, 2)
    line_cov, turn_cov, shift_cov = spd(rng, *line_sigmas(2)), spd(rng, 0.002, 0.003, 0.001), spd(rng, 9.0, 2.0, 1.5)
    lines = project_lines(camera, truth, EDGES) + draw(line_cov).reshape(-1, 2)
    attitude = truth.runway_from_camera @ so3_exp(draw(turn_cov))
    return sf.GaussianKeypoints(mean, cov), {
        "lines": GaussianLines(lines, line_cov),
        "edges": EDGES,
        "attitude_prior": AttitudePrior(attitude, turn_cov),
        "position_prior": PositionPrior(truth.position_m + draw(shift_cov), shift_cov),
        "altitude": Altitude(truth.position_m[2] + 0.8 * noise * rng.normal(), 0.8),
    }


def raw_residual(pose, kp, points, camera, options):
    """Measured minus predicted, by scipy's rotations and the image's own points: no kernel of the solver's."""
    rows = [(kp.mean_px - sf.project(camera, pose, points)).ravel()]
    if "lines" in options:
        pinhole = sf.Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        for (rho, theta), (a, b) in zip(options["lines"].mean, options["edges"]):
            # Two points of the line's visible part give the line.
            p, q = sf.project(pinhole, pose, [a + 0.9 * (b - a), b])
            normal = np.array([q[1] - p[1], p[0] - q[0]]) / np.hypot(*(q - p))
            normal *= np.sign(normal @ [np.cos(theta), np.sin(theta)])
            off = theta - np.arctan2(normal[1], normal[0])
            rows.append([rho - normal @ p, (off + np.pi) % (2 * np.pi) - np.pi])
    if "attitude_prior" in options:
        turn = options["attitude_prior"].runway_from_camera.T @ pose.runway_from_camera
        rows.append(-Rotation.from_matrix(turn).as_rotvec())
    if "position_prior" in options:
        rows.append(options["position_prior"].position_m - pose.position_m)
    if "altitude" in options:
        rows.append([options["altitude"].height_m - pose.position_m[2]])
    return np.concatenate(rows)


NAMES = ("attitude_prior", "position_prior", "altitude", "lines")


@pytest.mark.parametrize("used", list(product([False, True], repeat=4)))
def test_rows_features_and_factor_are_those_of_what_entered(used):
    rng = np.random.default_rng(1)
    truth = on_approach(900, yaw_deg=2, pitch_deg=-3)
    points = np.vstack([RUNWAY.corners, MORE_POINTS])
    kp, options = everything(rng, truth, points=points)
    attitude, position, altitude, lines = used
    kept = {name for name, use in zip(NAMES, used) if use} | ({"edges"} if lines else set())
    options = {name: value for name, value in options.items() if name in kept}
    est = sf.estimate_pose(kp, points, CAMERA, **options)
    rows = 16 + 4 * lines + 3 * attitude + 3 * position + altitude
    assert est.dof == rows - 6
    assert est.residual.shape == (rows,)
    assert est.jacobian.shape == (rows, 6)
    names = [*sf.CORNER_NAMES, "point 4", "point 5", "point 6", "point 7"]
    names += ["line 0", "line 1"] * lines + ["attitude prior"] * attitude
    names += ["position prior"] * position + ["altitude"] * altitude
    assert [feature.name for feature in est.features] == names
    np.testing.assert_array_equal(np.concatenate([np.r_[f.rows] for f in est.features]), np.arange(rows))
    # Residual and Jacobian are those of the rows, whitened by the factor.
    raw = raw_residual(est.pose, kp, points, CAMERA, options)
    np.testing.assert_allclose(est.factor @ est.residual, raw, atol=2e-9)
    step = 1e-6 * np.sqrt(np.diag(est.cov))[:, None] * np.eye(6)
    moved = [
        [raw_residual(est.pose.plus(sign * d), kp, points, CAMERA, options) for sign in (-1, 1)] for d in 1e3 * step
    ]
    slope = np.array([(minus - plus) / (2e3 * d.sum()) for (minus, plus), d in zip(moved, step)]).T
    scale = np.abs(est.factor @ est.jacobian).max(axis=0)
    np.testing.assert_allclose(est.factor @ est.jacobian / scale, slope / scale, atol=2e-6)


@pytest.mark.parametrize("camera", [CAMERA, WIDE], ids=["pinhole", "distorted"])
def test_the_optimum_of_all_rows_is_that_of_an_independent_solver(camera):
    rng = np.random.default_rng(2)
    for distance in np.geomspace(300, 3000, 12):
        truth = on_approach(distance, **dict(zip(("yaw_deg", "pitch_deg", "roll_deg"), rng.uniform(-6, 6, 3))))
        kp, options = everything(rng, truth, camera)
        est = sf.estimate_pose(kp, RUNWAY.corners, camera, **options)
        scale, whitening = np.sqrt(np.diag(est.cov)), np.linalg.inv(est.factor)

        def residual(d, kp=kp, truth=truth, options=options, scale=scale, whitening=whitening):
            return whitening @ raw_residual(truth.plus(d * scale), kp, RUNWAY.corners, camera, options)

        other = least_squares(residual, np.zeros(6), jac="3-point", xtol=1e-12, ftol=1e-15, gtol=1e-12)
        assert est.status is SolverStatus.CONVERGED
        assert est.chi2 == pytest.approx(2 * other.cost, rel=1e-7)
        assert np.abs(est.pose.minus(truth) / scale - other.x).max() < 1e-3
        np.testing.assert_allclose(est.cov @ (est.jacobian.T @ est.jacobian), np.eye(6), atol=1e-6)


def test_a_very_sharp_attitude_makes_it_known():
    # An attitude to 1e-9 rad, half a degree off what the corners alone say: three unknowns are left.
    rng = np.random.default_rng(3)
    for truth, points, px in zip(*approaches(3, 10, farthest_m=3000.0)):
        kp = sf.GaussianKeypoints(px + 0.5 * rng.normal(size=px.shape), spd(rng, *rng.uniform(0.3, 1.0, 8)))
        attitude = truth.runway_from_camera @ so3_exp(0.002 * rng.normal(size=3))
        est = sf.estimate_pose(kp, points, CAMERA, attitude_prior=(attitude, 1e-18 * np.eye(3)))

        def residual(position, kp=kp, attitude=attitude, points=points):
            return kp.whitening @ (kp.mean_px - sf.project(CAMERA, sf.Pose(position, attitude), points)).ravel()

        other = least_squares(residual, truth.position_m, method="lm", xtol=1e-13, ftol=1e-15, gtol=1e-13)
        known = np.linalg.inv(other.jac.T @ other.jac)
        np.testing.assert_allclose(
            est.pose.position_m, other.x, atol=1e-4 * np.sqrt(known.min(where=known > 0, initial=1))
        )
        np.testing.assert_allclose(est.cov[:3, :3], known, rtol=1e-4)
        assert np.abs(est.pose.runway_from_camera - attitude).max() < 1e-6
        assert est.chi2 == pytest.approx(2 * other.cost, rel=1e-5)


def test_the_logarithm_inverts_the_exponential_up_to_half_a_turn():
    rng = np.random.default_rng(4)
    found = np.empty(3)
    for angle in (0.0, 1e-12, 1e-6, 1e-3, 0.5, 2.0, 3.0, 3.1, 3.14159, np.pi - 1e-9):
        for axis in [*np.eye(3), *rng.normal(size=(5, 3))]:
            vector = angle * axis / np.linalg.norm(axis)
            log_kernel(so3_exp(vector), found)
            np.testing.assert_allclose(found, vector, atol=1e-7 if angle > 3 else 1e-12)


@pytest.mark.parametrize("camera", [CAMERA, PINHOLE_WIDE], ids=["narrow", "wide"])
def test_an_edge_is_drawn_where_its_points_are(camera):
    for truth in approaches(5, 20)[0]:
        for (rho, theta), (a, b) in zip(project_lines(camera, truth, EDGES), EDGES):
            u, v = sf.project(camera, truth, a + np.linspace(0, 1, 5)[:, None] * (b - a)).T
            np.testing.assert_allclose(u * np.cos(theta) + v * np.sin(theta), rho, atol=1e-8)
            assert 0 <= theta < np.pi


def test_an_edge_that_begins_behind_the_camera_is_drawn_as_well():
    over_runway = sf.Pose.from_attitude([500.0, 3.0, 20.0], pitch_deg=-1)
    lines = project_lines(CAMERA, over_runway, EDGES)
    visible = EDGES[:, 1:] + [[[-500.0], [0.0]]] * np.array([1.0, 0, 0])
    np.testing.assert_allclose(lines, project_lines(CAMERA, over_runway, visible), atol=1e-9)


def test_lines_behind_and_before_solve_a_pose_over_the_runway():
    # Three points ahead and two edges that begin behind: the landing roll.
    truth = sf.Pose.from_attitude([300.0, 3.0, 12.0], yaw_deg=1, pitch_deg=-1)
    points = np.array([[1000.0, 22.5, 0], [1000, -22.5, 0], [2000, -22.5, 0], [2000, 22.5, 0]])
    kp = sf.GaussianKeypoints.from_sigma(sf.project(CAMERA, truth, points), 0.5)
    lines = GaussianLines(project_lines(CAMERA, truth, EDGES), np.diag([0.25, 1e-7] * 2))
    est = sf.estimate_pose(kp, points, CAMERA, lines=lines, edges=EDGES)
    assert est.status is SolverStatus.CONVERGED
    assert est.dof == 6
    assert np.abs(est.pose.minus(truth) / np.sqrt(np.diag(est.cov))).max() < 1e-5
    alone = sf.estimate_pose(kp, points, CAMERA)
    assert (np.diag(est.cov) < np.diag(alone.cov)).all()


def test_both_normal_forms_of_a_line_are_one():
    truth = on_approach(900)
    kp, options = everything(np.random.default_rng(6), truth)
    est = sf.estimate_pose(kp, RUNWAY.corners, CAMERA, **options)
    lines = options["lines"]
    flip = np.array([-1.0, 1, 1, 1])
    mean = lines.mean * [[-1, 1], [1, 1]] + [[0, np.pi], [0, -4 * np.pi]]
    options["lines"] = GaussianLines(mean, lines.cov * np.outer(flip, flip))
    other = sf.estimate_pose(kp, RUNWAY.corners, CAMERA, **options)
    assert other.chi2 == pytest.approx(est.chi2, rel=1e-9)
    np.testing.assert_allclose(other.pose.position_m, est.pose.position_m, atol=1e-6)


def test_lines_through_points_carry_their_covariance():
    rng = np.random.default_rng(7)
    ends, cov = np.array([[[100.0, 900], [700, 200]], [[1500, 1000], [900, 250]]]), spd(rng, *rng.uniform(0.2, 1, 8))
    lines = GaussianLines.through(ends, cov)
    for (rho, theta), pair in zip(lines.mean, ends):
        np.testing.assert_allclose(pair @ [np.cos(theta), np.sin(theta)], rho)
    slope = np.empty((4, 8))
    for column, shift in enumerate(1e-4 * np.eye(8).reshape(8, 2, 2, 2)):
        moved = [GaussianLines.through(ends + sign * shift, cov).mean for sign in (-1, 1)]
        slope[:, column] = (moved[1] - moved[0]).ravel() / 2e-4
    np.testing.assert_allclose(lines.cov, slope @ cov @ slope.T, rtol=1e-6)


COUNT = 20_000


@lru_cache
def faultless(farthest_m):
    """COUNT problems with every measurement in play, each drawn around its truth: batch, truth, cost at the truth."""
    rng = np.random.default_rng(8)
    poses, corners, pixels = approaches(9, COUNT, farthest_m=farthest_m)
    edges = corners[:, [[0, 3], [1, 2]]]
    base = spd(rng, *[1.0] * 8)
    sigma = 0.5 * np.exp(0.6 * rng.normal(size=(COUNT, 8)))
    cov = base * sigma[:, :, None] * sigma[:, None, :]
    # As sharp as what the corners tell, so that every row counts.
    line_cov, turn_cov, shift_cov = spd(rng, *line_sigmas(2)), spd(rng, 0.001, 0.002, 0.0005), spd(rng, 9.0, 2.0, 1.5)
    unit = [rng.normal(size=(COUNT, size)) for size in (8, 4, 3, 3, 1)]
    noise = [
        (np.linalg.cholesky(c) @ u[..., None])[..., 0]
        for c, u in zip((cov, line_cov, turn_cov, shift_cov, [[0.8**2]]), unit)
    ]
    rotations, positions = (np.array([getattr(p, n) for p in poses]) for n in ("runway_from_camera", "position_m"))
    lines = np.array([project_lines(CAMERA, pose, ends) for pose, ends in zip(poses, edges)])
    batch = estimate_pose_batch(
        pixels + noise[0].reshape(-1, 4, 2),
        cov,
        corners,
        CAMERA,
        lines=(lines + noise[1].reshape(-1, 2, 2), line_cov),
        edges=edges,
        attitude_prior=(rotations @ Rotation.from_rotvec(noise[2]).as_matrix(), turn_cov),
        position_prior=(positions + noise[3], shift_cov),
        altitude=(positions[:, 2] + noise[4][:, 0], 0.8),
    )
    turns = np.swapaxes(rotations, 1, 2) @ batch.rotations
    errors = np.hstack([batch.positions - positions, Rotation.from_matrix(turns).as_rotvec()])
    return batch, errors, sum((u**2).sum(axis=1) for u in unit)


def test_false_alarms_are_nominal_with_every_row_in_play():
    batch, _, at_truth = faultless(5000.0)
    assert batch.dof == 8 + 4 + 3 + 3 + 1 - 6
    assert batch.converged.all()
    p = check_integrity_batch(batch).p_value
    for rate in (0.05, 0.01, 0.001):
        low, high = binom.interval(0.99, COUNT, rate)
        assert low <= (p < rate).sum() <= high
    assert kstest(p, "uniform").pvalue > 0.01
    # Six parameters were estimated: the truth costs χ²(6) more than the optimum.
    assert abs(np.mean(at_truth - batch.chi2) - 6) < 3 * np.sqrt(12 / COUNT)


def test_normalised_errors_average_six_with_every_row_in_play():
    batch, errors, _ = faultless(2000.0)
    squared = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(batch.covs), errors)
    assert abs(squared.mean() - 6) < 3 * squared.std() / np.sqrt(COUNT)


def test_the_batch_equals_the_single_call_with_every_row():
    batch, _, _ = faultless(5000.0)
    for i in range(0, COUNT, 1999):
        row = batch[i]
        est = sf.estimate_pose(
            row.keypoints, row.points, CAMERA, lines=row.lines, edges=row.edges, attitude_prior=row.attitude_prior,
            position_prior=row.position_prior, altitude=row.altitude,
        )  # fmt: skip
        assert row.status is est.status
        assert row.chi2 == pytest.approx(est.chi2, rel=1e-9)
        np.testing.assert_allclose(row.pose.position_m, est.pose.position_m, rtol=1e-9)
        np.testing.assert_allclose(row.factor, batch.factors[i])
        assert row.features == batch.features == est.features


def test_measurements_of_a_batch_may_be_shared():
    truth = on_approach(1000)
    px = np.tile(sf.project(CAMERA, truth, RUNWAY.corners), (3, 1, 1))
    lines, cov = project_lines(CAMERA, truth, EDGES), np.diag([0.25, 1e-7] * 2)
    shared = {
        "attitude_prior": (truth.runway_from_camera, 1e-6 * np.eye(3)),
        "position_prior": (truth.position_m, np.eye(3)),
        "altitude": (truth.position_m[2], 0.5),
        "lines": (lines, cov),
        "edges": EDGES,
    }
    each = {
        "attitude_prior": (np.tile(truth.runway_from_camera, (3, 1, 1)), np.tile(1e-6 * np.eye(3), (3, 1, 1))),
        "position_prior": (np.tile(truth.position_m, (3, 1)), np.eye(3)),
        "altitude": (np.full(3, truth.position_m[2]), np.full(3, 0.5)),
        "lines": (np.tile(lines, (3, 1, 1)), np.tile(cov, (3, 1, 1))),
        "edges": np.tile(EDGES, (3, 1, 1, 1)),
    }
    one, other = (estimate_pose_batch(px, np.eye(8), RUNWAY.corners, CAMERA, **given) for given in (shared, each))
    assert one.converged.all()
    assert one.dof == 13
    np.testing.assert_array_equal(one.covs, other.covs)
    np.testing.assert_array_equal(one.factors[0], other.factors[2])
    assert one.factors.shape == (1, 19, 19)


def test_a_bad_measurement_in_a_batch_gets_a_status_and_harms_no_other():
    truth, count = on_approach(1000), 8
    px = np.tile(sf.project(CAMERA, truth, RUNWAY.corners), (count, 1, 1))
    rotations, turns = np.tile(truth.runway_from_camera, (count, 1, 1)), np.tile(1e-6 * np.eye(3), (count, 1, 1))
    positions, shifts = np.tile(truth.position_m, (count, 1)), np.tile(np.eye(3), (count, 1, 1))
    heights, sigmas = np.full(count, truth.position_m[2]), np.full(count, 0.5)
    lines = np.tile(project_lines(CAMERA, truth, EDGES), (count, 1, 1))
    rotations[0, 0, 0] = np.nan
    rotations[1] *= 1.1
    turns[2] = 0
    positions[3, 0] = np.inf
    shifts[4, 0, 1] = shifts[4, 1, 0] = 2.0
    sigmas[5] = 0
    lines[6, 0, 1] = np.nan
    batch = estimate_pose_batch(
        px, np.eye(8), RUNWAY.corners, CAMERA, attitude_prior=(rotations, turns), position_prior=(positions, shifts),
        altitude=(heights, sigmas), lines=(lines, np.diag([0.25, 1e-7] * 2)), edges=EDGES,
    )  # fmt: skip
    wanted = ["non-finite", *["ill-conditioned"] * 2, "non-finite", *["ill-conditioned"] * 2, "non-finite", "converged"]
    assert [STATUS_OF_CODE[c].value for c in batch.status_codes] == wanted
    np.testing.assert_allclose(batch.positions[7], truth.position_m, atol=1e-6)
    np.testing.assert_array_equal(np.isfinite(batch.factors).all(axis=(1, 2)), [1, 1, 0, 1, 0, 0, 1, 1])
    assert check_integrity_batch(batch).monitored.tolist() == [False] * 7 + [True]


def test_pairs_serve_for_priors():
    truth = on_approach(900)
    kp, options = everything(np.random.default_rng(10), truth)
    est = sf.estimate_pose(kp, RUNWAY.corners, CAMERA, **options)
    lines, attitude = options["lines"], options["attitude_prior"]
    options |= {
        "lines": (lines.mean, lines.cov),
        "attitude_prior": (Rotation.from_matrix(attitude.runway_from_camera), attitude.cov_rad2.tolist()),
        "position_prior": (options["position_prior"].position_m, options["position_prior"].cov_m2),
        "altitude": (options["altitude"].height_m, options["altitude"].sigma_m),
    }
    assert sf.estimate_pose(kp, RUNWAY.corners, CAMERA, **options).chi2 == pytest.approx(est.chi2, rel=1e-9)


def test_a_fault_in_a_prior_is_seen():
    truth = on_approach(900)
    kp, options = everything(np.random.default_rng(11), truth)
    assert sf.check_integrity(sf.estimate_pose(kp, RUNWAY.corners, CAMERA, **options)).decision is Decision.USE
    options["altitude"] = Altitude(truth.position_m[2] + 8.0, 0.8)
    verdict = sf.check_integrity(sf.estimate_pose(kp, RUNWAY.corners, CAMERA, **options))
    assert verdict.decision is Decision.DO_NOT_USE


GOOD, EYE = sf.GaussianKeypoints.from_sigma(sf.project(CAMERA, on_approach(1000), RUNWAY.corners), 0.5), np.eye(3)
LINES = GaussianLines([[1.0, 2], [3, 1]], np.eye(4))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"attitude_prior": (2 * EYE, EYE)}, "attitude_prior: not a rotation"),
        ({"attitude_prior": (np.diag([1.0, 1, -1]), EYE)}, "attitude_prior: not a rotation"),
        ({"attitude_prior": (EYE, np.zeros((3, 3)))}, "attitude_prior: covariance: the variance of x is 0"),
        ({"attitude_prior": (EYE, EYE + 1)}, None),
        ({"attitude_prior": (EYE, 2 * np.ones((3, 3)))}, "attitude_prior: covariance: not positive definite"),
        ({"attitude_prior": (EYE, 0.1)}, "attitude_prior: covariance: expected shape"),
        ({"attitude_prior": EYE}, "attitude_prior: expected a value and its covariance"),
        ({"attitude_prior": (EYE, EYE, EYE)}, "attitude_prior: expected a value and its covariance"),
        ({"position_prior": ([1, 2, np.nan], EYE)}, r"position_prior: entry \[2\] is nan"),
        ({"position_prior": ([1, 2], EYE)}, "position_prior: expected shape"),
        ({"position_prior": ([1, 2, 3], -EYE)}, "position_prior: covariance: the variance of x is -1"),
        ({"position_prior": ([1, 2, 3], EYE + np.triu(EYE + 0.5, 1))}, "position_prior: covariance: not symmetric"),
        ({"position_prior": "here"}, "position_prior: expected a value and its covariance, got 'here'"),
        ({"altitude": (50.0, 0.0)}, "altitude: sigma_m is 0.0"),
        ({"altitude": (50.0, 1e-200)}, "altitude: sigma_m is 1e-200"),
        ({"altitude": (np.nan, 1.0)}, "altitude: height_m: entry"),
        ({"altitude": 50.0}, "altitude: expected a value and its covariance, got 50.0"),
        ({"lines": LINES}, "lines and edges: give both"),
        ({"edges": EDGES}, "lines and edges: give both"),
        ({"lines": LINES, "edges": EDGES[:1]}, "1 edges for 2 lines"),
        ({"lines": LINES, "edges": EDGES[0]}, "edges: expected shape"),
        ({"lines": (np.ones((2, 2)), np.zeros((4, 4))), "edges": EDGES}, "lines: cov: the variance of line 0 rho is 0"),
        ({"lines": (np.ones((2, 2)), np.eye(3)), "edges": EDGES}, "lines: cov: expected shape"),
        ({"lines": (np.empty((0, 2)), np.empty((0, 0))), "edges": np.empty((0, 2, 3))}, "at least one line"),
        (
            {"position_prior": ([-1000, 0, 50], EYE), "altitude": (62.0, 1.0)},
            "position_prior and altitude: heights of 50 m and 62 m are 8.5 standard deviations apart",
        ),
    ],
)  # fmt: skip
def test_wrong_measurements_are_refused_in_one_line(options, message):
    if message is None:
        assert sf.estimate_pose(GOOD, RUNWAY.corners, CAMERA, **options).dof == 5
        return
    with pytest.raises(sf.InputError, match=message) as caught:
        sf.estimate_pose(GOOD, RUNWAY.corners, CAMERA, **options)
    assert "\n" not in str(caught.value)


def test_heights_that_differ_within_reason_are_accepted():
    apart = 0.99 * CONTRADICTION_SIGMAS * np.sqrt(2)
    options = {"position_prior": ([-1000, 20, 52.4], EYE), "altitude": (52.4 + apart, 1.0)}
    assert sf.estimate_pose(GOOD, RUNWAY.corners, CAMERA, **options).dof == 6


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: GaussianLines.through(np.ones((1, 2, 2)), np.eye(4)), "two points of line 0 are the same"),
        (
            lambda: project_lines(CAMERA, on_approach(1e3), [[on_approach(1e3).position_m, np.zeros(3)]]),
            "edge 0 points",
        ),
    ],
)
def test_a_line_that_is_none_is_refused(build, message):
    with pytest.raises(sf.InputError, match=message):
        build()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"attitude_prior": (np.ones((4, 3, 3)), EYE)}, "attitude_prior: expected shape"),
        ({"attitude_prior": EYE}, "attitude_prior: expected a pair"),
        ({"attitude_prior": (EYE, np.ones((2, 3, 3)))}, "attitude_prior: covariance: expected shape"),
        ({"position_prior": (np.ones((5, 2)), EYE)}, "position_prior: expected shape"),
        ({"altitude": (np.ones(4), 1.0)}, "altitude: expected shape"),
        ({"lines": (np.ones((5, 2, 2)), np.eye(4))}, "lines and edges"),
        ({"lines": (np.ones((5, 1, 2)), np.eye(4)), "edges": EDGES}, "lines: expected shape"),
        ({"lines": (np.ones((5, 2, 2)), np.eye(2)), "edges": EDGES}, "lines: covariance: expected shape"),
        ({"lines": (np.ones((5, 2, 2)), np.eye(4)), "edges": np.ones(3)}, "edges: expected shape"),
        ({"lines": (np.ones((5, 2, 2)), np.eye(4)), "edges": np.ones((3, 2, 2, 3))}, "edges: expected shape"),
        ({"position_prior": (["a", "b", "c"], EYE)}, "position_prior: expected numbers"),
    ],
)
def test_wrong_batch_measurements_are_refused(options, message):
    with pytest.raises(sf.InputError, match=message):
        estimate_pose_batch(np.ones((5, 4, 2)), np.eye(8), np.ones((4, 3)), CAMERA, **options)
