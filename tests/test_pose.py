"""The solver: exact where there is no noise, efficient where there is, and honest where it fails."""

from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares

import shortfinal as sf
from shortfinal.pose import STATUS_OF_CODE, SolverStatus, estimate_pose_batch

CAMERA = sf.Camera(2448, 2648, 3401.6, 3401.6, 1223.5, 1323.5)  # LARD's
WIDE = sf.Camera(1280, 960, 700.0, 690.0, 630.0, 470.0, (-0.2, 0.05, 1e-3, -5e-4, 0.01, 0.02, -0.01, 0.002))
RUNWAY = sf.Runway(2000.0, 45.0)
MORE_POINTS = np.array([[300, 9, 0], [300, -9, 0], [1000, 22.5, 0], [1000, -22.5, 0]])  # aiming points, midway edges


@lru_cache
def approaches(seed, count, nearest_m=300.0, farthest_m=5000.0):
    """Poses and runways from a cone like LARD's, all corners in view: poses, corners (N, 4, 3), pixels."""
    rng = np.random.default_rng(seed)
    poses, corners, pixels = [], [], []
    while len(poses) < count:
        distance = rng.uniform(nearest_m, farthest_m)
        glide, lateral = np.radians([rng.uniform(2.2, 3.8), rng.uniform(-4, 4)])
        position = distance * np.array([-1.0, np.tan(lateral), np.tan(glide)])
        pose = sf.Pose.from_attitude(position, *rng.uniform([-10, -8, -10], [10, 0, 10]))
        runway = sf.Runway(rng.uniform(1500, 3500), rng.uniform(30, 60))
        px = sf.project(CAMERA, pose, runway.corners)
        if (px > 0).all() and (px < [CAMERA.width - 1, CAMERA.height - 1]).all():
            poses.append(pose)
            corners.append(runway.corners)
            pixels.append(px)
    return poses, np.array(corners), np.array(pixels)


def on_approach(distance, **attitude):
    return sf.Pose.from_attitude([-distance, 0.02 * distance, 0.0524 * distance], **attitude)


def solve(px, points=RUNWAY.corners, camera=CAMERA, sigma=0.5, **options):
    return sf.estimate_pose(sf.GaussianKeypoints.from_sigma(px, sigma), points, camera, **options)


@pytest.mark.parametrize("camera", [CAMERA, WIDE], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("extra", [0, 1, 4])
@pytest.mark.parametrize("relief_m", [0.0, 3.0], ids=["plane", "uneven"])
def test_without_noise_the_pose_is_exact(camera, extra, relief_m):
    rng = np.random.default_rng(1)
    for distance in np.geomspace(100, 8000, 40):
        points = np.vstack([RUNWAY.corners, MORE_POINTS[:extra]])
        points[:, 2] += relief_m * rng.normal(size=len(points))
        truth = on_approach(distance, **dict(zip(("yaw_deg", "pitch_deg", "roll_deg"), rng.uniform(-8, 8, 3))))
        est = solve(sf.project(camera, truth, points), points, camera)
        assert est.status is SolverStatus.CONVERGED
        # A millionth of a standard deviation, or the rounding of pixels (1e-13 of 1e3) through it.
        assert np.abs(est.pose.minus(truth) / np.sqrt(np.diag(est.cov))).max() < 1e-6


def test_the_optimum_is_that_of_an_independent_solver():
    rng = np.random.default_rng(2)
    poses, corners, pixels = approaches(2, 30)
    for truth, points, px in zip(poses, corners, pixels):
        root = rng.normal(size=(8, 8))
        kp = sf.GaussianKeypoints(px + 0.5 * rng.normal(size=px.shape), 0.05 * root @ root.T + 0.1 * np.eye(8))
        est = sf.estimate_pose(kp, points, CAMERA)
        scale = np.sqrt(np.diag(est.cov))

        def residual(d, kp=kp, truth=truth, points=points, scale=scale):
            return kp.whitening @ (kp.mean_px - sf.project(CAMERA, truth.plus(d * scale), points)).ravel()

        other = least_squares(residual, np.zeros(6), method="lm", xtol=1e-12, ftol=1e-15, gtol=1e-12)
        assert est.chi2 == pytest.approx(2 * other.cost, rel=1e-7, abs=1e-9)
        apart = est.pose.minus(truth) / scale - other.x
        assert np.abs(apart).max() < 1e-3
        np.testing.assert_allclose(
            est.jacobian, kp.whitening @ sf.project_jacobian(CAMERA, est.pose, points), rtol=1e-6
        )


def test_covariance_is_the_inverse_information_and_the_residual_belongs_to_the_pose():
    px = sf.project(CAMERA, on_approach(1500), RUNWAY.corners) + np.array(
        [[0.3, -0.2], [0.1, 0.4], [-0.5, 0], [0, 0.2]]
    )
    est = solve(px, sigma=0.7)
    information = est.jacobian.T @ est.jacobian
    np.testing.assert_allclose(est.cov @ information, np.eye(6), atol=1e-6)
    left = px - sf.project(CAMERA, est.pose, RUNWAY.corners)
    np.testing.assert_allclose(est.residual, left.ravel() / 0.7, atol=1e-9)
    assert est.chi2 == pytest.approx(est.residual @ est.residual)
    assert est.dof == 2
    np.testing.assert_allclose(est.sigma_position_m, np.sqrt(np.diag(est.cov)[:3]))


def test_errors_are_as_large_as_the_covariance_says():
    # 4000 solves of one pose: the mean of the squared normalised error is 6 with a standard error of
    # sqrt(12 / 4000) = 0.055; three of them either way.
    rng = np.random.default_rng(3)
    truth = on_approach(1200, yaw_deg=2, pitch_deg=-3, roll_deg=4)
    root = np.tril(rng.normal(size=(8, 8))) * 0.1 + 0.3 * np.eye(8)
    px = sf.project(CAMERA, truth, RUNWAY.corners) + (rng.normal(size=(4000, 8)) @ root.T).reshape(-1, 4, 2)
    batch = estimate_pose_batch(px, root @ root.T, RUNWAY.corners, CAMERA)
    assert batch.converged.all()
    errors = np.array([batch[i].pose.minus(truth) for i in range(len(batch))])
    squared = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(batch.covs), errors)
    assert abs(squared.mean() - 6) < 3 * np.sqrt(12 / 4000)


def test_doubt_about_where_the_points_are_counts_as_it_is_seen():
    """Surveyed with errors, and seen with unequal, correlated ones: the χ² of pose and residual, with and without."""
    rng, survey_m = np.random.default_rng(4), 0.5
    poses, corners, _ = approaches(6, 600)
    truly, without = [], []
    for pose, points in zip(poses, corners):
        root = np.tril(rng.normal(0, 0.15, (8, 8)), -1) + np.diag(np.exp(rng.normal(np.log(0.4), 0.4, 8)))
        there = points + rng.normal(0, survey_m, points.shape)
        px = sf.project(CAMERA, pose, there) + (root @ rng.normal(size=8)).reshape(4, 2)
        keypoints = sf.GaussianKeypoints(px, root @ root.T)
        est = sf.estimate_pose(keypoints, points, CAMERA, points_sigma_m=survey_m)
        error = est.pose.minus(pose)
        truly.append([error @ np.linalg.solve(est.cov, error), est.residual @ est.residual])
        bare = sf.estimate_pose(keypoints, points, CAMERA)
        without.append(bare.residual @ bare.residual)
        assert (np.linalg.eigvalsh(est.keypoints.cov_px - keypoints.cov_px) > -1e-9).all()
        if len(truly) < 20:  # the batch does the same
            alike = estimate_pose_batch(px[None], root @ root.T, points, CAMERA, points_sigma_m=survey_m)
            np.testing.assert_allclose(alike.covs[0], est.cov, rtol=1e-5)
            assert alike.chi2[0] == pytest.approx(est.chi2, rel=1e-4, abs=1e-6)
    truly = np.array(truly)
    # Sums of 600 χ² of 6 and of 2 degrees of freedom: four standard deviations, and 2 % for what is not linear.
    for column, dof in zip(truly.T, (6, 2)):
        assert abs(column.mean() / dof - 1) < 4 * np.sqrt(2 / dof / len(column)) + 0.02
    assert np.mean(without) > 1.5 * 2  # which the monitor would take for faults


@pytest.mark.parametrize("sigma", [-1.0, np.nan, np.inf])
def test_a_doubt_that_is_no_length_is_refused(sigma):
    with pytest.raises(sf.InputError, match=r"^points_sigma_m: .*; it must be 0 or more, in metres$"):
        solve(sf.project(CAMERA, on_approach(1000), RUNWAY.corners), points_sigma_m=sigma)
    with pytest.raises(sf.InputError, match=r"survey_sigma_m is .*; it must be from 0 to 100, in metres"):
        sf.Runway(2000.0, 45.0, survey_sigma_m=sigma)


def ippe_rotations(px, points):
    """OpenCV's two poses of a level plane: runway_from_camera."""
    _, turns, _, _ = cv2.solvePnPGeneric(points, px, CAMERA.matrix, None, flags=cv2.SOLVEPNP_IPPE)
    return [cv2.Rodrigues(turn)[0].T for turn in turns]


def test_of_the_two_poses_of_a_plane_the_upright_one_is_kept():
    # OpenCV's IPPE returns both, best first by reprojection; without noise the first is exact, and
    # the second, from far off nearly as good, hangs upside down.
    for truth, points, px in zip(*approaches(4, 100)):
        first, second = ippe_rotations(px, points)
        est = solve(px, points)
        np.testing.assert_allclose(est.pose.runway_from_camera, truth.runway_from_camera, atol=1e-8)
        np.testing.assert_allclose(first, truth.runway_from_camera, atol=1e-4)
        assert second[2, 1] > 0 > est.pose.runway_from_camera[2, 1]


# A pad of 40 m seen 1000 m away and 55° below the axis of a level wide camera: its mirror about the
# line of sight is upright too, and at σ = 1 px fits as well.
PAD = np.array([[20.0, 20, 0], [-20, 20, 0], [-20, -20, 0], [20, -20, 0]])
FISH = sf.Camera(2000, 2000, 500.0, 500.0, 999.5, 999.5)
OVER_PAD = sf.Pose.from_attitude([-1000 * np.cos(0.96), 0, 1000 * np.sin(0.96)])


def test_two_upright_optima_are_ambiguous_until_the_pixels_are_sharp_enough():
    px = sf.project(FISH, OVER_PAD, PAD)
    blurred, sharp = (solve(px, PAD, FISH, sigma) for sigma in (1.0, 1e-4))
    assert blurred.status is SolverStatus.AMBIGUOUS
    assert blurred.pose is not None
    assert sharp.status is SolverStatus.CONVERGED
    assert np.abs(sharp.pose.minus(OVER_PAD)[:3]).max() < 1e-3


@pytest.mark.parametrize("camera", [CAMERA, WIDE], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("kept", [[0, 1, 2], [2, 0, 3], [1, 2, 3], [3, 1, 0]])
def test_three_points_fix_a_pose_and_leave_nothing_to_check(camera, kept):
    rng = np.random.default_rng(8)
    for distance in np.geomspace(100, 4000, 12):
        truth = on_approach(distance, **dict(zip(("yaw_deg", "pitch_deg", "roll_deg"), rng.uniform(-8, 8, 3))))
        px = sf.project(camera, truth, RUNWAY.corners)[kept]
        est = solve(px, RUNWAY.corners[kept], camera)
        assert est.status is SolverStatus.CONVERGED
        assert est.dof == 0
        assert np.abs(est.pose.minus(truth) / np.sqrt(np.diag(est.cov))).max() < 1e-4
        # Any other image of three points has a pose as well, and no residual.
        assert solve(px + rng.normal(size=(3, 2)), RUNWAY.corners[kept], camera).chi2 < 1e-9
        assert sf.check_integrity(est).decision is sf.Decision.NOT_MONITORED


def test_three_points_with_several_poses_are_ambiguous():
    # Grunert's quartic has two roots here with the camera above the pad and upright, and both fit exactly.
    px = sf.project(FISH, OVER_PAD, PAD[:3])
    est = solve(px, PAD[:3], FISH)
    assert est.status is SolverStatus.AMBIGUOUS
    assert est.chi2 < 1e-9
    known = solve(px, PAD[:3], FISH, attitude_prior=(OVER_PAD.runway_from_camera, 1e-6 * np.eye(3)))
    assert known.status is SolverStatus.CONVERGED
    assert np.abs(known.pose.minus(OVER_PAD)[:3]).max() < 1e-3


def test_points_in_space_need_no_plane():
    rng = np.random.default_rng(9)
    for count in (4, 5, 8):
        for _ in range(20):
            truth = on_approach(rng.uniform(300, 1500), roll_deg=rng.uniform(-30, 30))
            points = rng.uniform([0, -100, 0], [800, 100, 60], (count, 3))
            points[1] = 0.5 * (points[0] + points[2])  # three on a line
            est = solve(sf.project(CAMERA, truth, points), points)
            # Four of which three lie on a line are a plane, with its second pose.
            assert est.status is SolverStatus.CONVERGED or count == 4
            assert np.abs(est.pose.minus(truth) / np.sqrt(np.diag(est.cov))).max() < 1e-5


def test_points_on_a_line_and_a_position_fix_the_attitude():
    truth = on_approach(1000, yaw_deg=2, pitch_deg=-2, roll_deg=5)
    px, prior = sf.project(CAMERA, truth, LINE), (truth.position_m, 4.0 * np.eye(3))
    est = solve(px, LINE, position_prior=prior)
    assert est.status is SolverStatus.CONVERGED
    assert np.abs(est.pose.minus(truth) / np.sqrt(np.diag(est.cov))).max() < 1e-4


def test_points_that_are_read_only_are_used_as_they_are_and_checked_all_the_same():
    px = sf.project(CAMERA, on_approach(1000), RUNWAY.corners)
    assert solve(px).points is RUNWAY.corners
    points = RUNWAY.corners.copy()
    assert solve(px, points).points is not points
    points[2, 1] = np.nan
    points.setflags(write=False)
    with pytest.raises(sf.InputError, match=r"points: entry \[2, 1\] is nan"):
        solve(px, points)


LINE = np.array([[0.0, 0, 0], [500, 0, 0], [1000, 0, 0], [2000, 0, 0]])


@pytest.mark.parametrize(
    "points", [LINE, LINE * [0.02, 0, 0] + [0, 1, 0] * LINE[:, :1] * 0.02, np.tile([100.0, 5, 0], (4, 1))],
    ids=["centreline", "diagonal", "one point"],
)  # fmt: skip
def test_points_on_a_line_are_ill_conditioned(points):
    est = solve(sf.project(CAMERA, on_approach(1000), points), points)
    assert est.status is SolverStatus.ILL_CONDITIONED
    assert est.pose is None
    assert est.cov is None
    assert est.sigma_position_m is None
    assert np.isnan(est.residual).all()
    assert np.isnan(est.chi2)


def test_a_runway_seen_from_below_is_unphysical():
    # Left and right exchanged: the image of a camera under the ground.
    px = sf.project(CAMERA, on_approach(1000), RUNWAY.corners)[[1, 0, 3, 2]]
    assert solve(px).status is SolverStatus.BEHIND_CAMERA


def test_an_upside_down_image_does_not_pass_for_an_approach():
    # The one upright optimum is a view from beyond the far end, which fits nothing like it should.
    px = sf.project(CAMERA, on_approach(1000, roll_deg=180), RUNWAY.corners)
    assert solve(px).chi2 > 1000


def test_too_few_iterations_are_said():
    px = sf.project(CAMERA, on_approach(1000), RUNWAY.corners) + np.array([[3, 0], [0, -2], [0, 1], [1, 1]])
    assert solve(px, max_iterations=1).status is SolverStatus.MAX_ITERATIONS


def test_overflow_is_non_finite():
    px = sf.project(CAMERA, on_approach(1000), RUNWAY.corners) + np.array([[3, 0], [0, -2], [0, 1], [1, 1]])
    assert solve(px, sigma=1e-160).status is SolverStatus.NON_FINITE


def test_an_initial_pose_is_one_more_start():
    truth = on_approach(1500)
    px = sf.project(CAMERA, truth, RUNWAY.corners)
    good, silly = truth.plus([30, 5, 5, 0.01, 0, 0]), sf.Pose.from_attitude([5000, 0, -30], 180)
    for initial in (good, silly):
        est = solve(px, initial=initial)
        assert est.status is SolverStatus.CONVERGED
        assert np.abs(est.pose.minus(truth)).max() < 1e-6


@pytest.mark.parametrize(
    ("px", "points", "message"),
    [
        (np.ones((2, 2)), np.ones((2, 3)), "a pose needs at least three"),
        (np.ones((4, 2)), np.ones((5, 3)), "5 points for 4 keypoints"),
        (np.ones((4, 2)), np.ones((4, 2)), "points: expected shape"),
        (np.ones((4, 2)), np.full((4, 3), np.nan), "points: entry"),
    ],
)
def test_wrong_input_is_refused_in_one_line(px, points, message):
    with pytest.raises(sf.InputError, match=message) as caught:
        solve(px, points)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("mean", "cov", "points", "name"),
    [
        ((5, 4), (8, 8), (4, 3), "mean_px"),
        ((0, 4, 2), (8, 8), (4, 3), "mean_px"),
        ((5, 4, 2), (6, 6), (4, 3), "cov_px"),
        ((5, 4, 2), (3, 8, 8), (4, 3), "cov_px"),
        ((5, 4, 2), (8, 8), (4, 4, 3), "points"),
        ((5, 2, 2), (4, 4), (2, 3), "at least three"),
    ],
)
def test_wrong_batch_shapes_are_refused(mean, cov, points, name):
    with pytest.raises(sf.InputError, match=name):
        estimate_pose_batch(np.ones(mean), np.ones(cov), np.ones(points), CAMERA)


def noisy(seed, count):
    rng = np.random.default_rng(seed)
    poses, corners, pixels = approaches(seed, count)
    sigma = 0.5 * np.exp(0.6 * rng.normal(size=(count, 8)))
    return poses, corners, pixels + (sigma * rng.normal(size=(count, 8))).reshape(-1, 4, 2), sigma


def test_the_batch_equals_the_single_call():
    _, corners, px, sigma = noisy(5, 1200)  # more than two chunks
    cov = sigma[:, :, None] ** 2 * np.eye(8)
    batch = estimate_pose_batch(px, cov, corners, CAMERA, threads=2)
    assert len(batch) == 1200
    for i in range(0, 1200, 37):
        est, row = sf.estimate_pose(sf.GaussianKeypoints(px[i], cov[i]), corners[i], CAMERA), batch[i]
        assert row.status is est.status is batch.status(i)
        assert row.chi2 == est.chi2
        np.testing.assert_array_equal(row.cov, est.cov)
        np.testing.assert_array_equal(row.pose.position_m, est.pose.position_m)
        np.testing.assert_array_equal(row.residual, est.residual)


def test_a_shared_covariance_and_runway_need_one_copy():
    px = np.array([sf.project(CAMERA, on_approach(d), RUNWAY.corners) for d in (800, 1600, 3200)])
    batch = estimate_pose_batch(px, np.eye(8), RUNWAY.corners, CAMERA)
    np.testing.assert_allclose(batch.positions[:, 0], [-800, -1600, -3200], atol=1e-6)
    np.testing.assert_array_equal(batch[2].points, RUNWAY.corners)


def test_a_bad_problem_in_a_batch_gets_a_status_and_harms_no_other():
    px = np.tile(sf.project(CAMERA, on_approach(1000), RUNWAY.corners), (5, 1, 1))
    cov, points = np.tile(np.eye(8), (5, 1, 1)), np.tile(RUNWAY.corners, (5, 1, 1))
    px[0, 0, 0], cov[1, 2, 2], points[2, 0, 0], cov[3, 0, 0] = np.nan, np.inf, np.nan, -1.0
    batch = estimate_pose_batch(px, cov, points, CAMERA)
    wanted = ["non-finite", "non-finite", "non-finite", "ill-conditioned", "converged"]
    assert [STATUS_OF_CODE[c].value for c in batch.status_codes] == wanted
    assert np.isnan(batch.positions[:4]).all()
    np.testing.assert_allclose(batch.positions[4], on_approach(1000).position_m, atol=1e-6)


def test_threads_do_not_disturb_one_another_and_arguments_are_left_alone():
    _, corners, px, sigma = noisy(6, 300)
    cov = sigma[:, :, None] ** 2 * np.eye(8)
    copies = [a.copy() for a in (px, cov, corners)]
    want = estimate_pose_batch(px, cov, corners, CAMERA, threads=1)
    with ThreadPoolExecutor(4) as pool:
        got = list(pool.map(lambda _: estimate_pose_batch(px, cov, corners, CAMERA), range(8)))
    for batch in got:
        np.testing.assert_array_equal(batch.positions, want.positions)
    for before, after in zip(copies, (px, cov, corners)):
        np.testing.assert_array_equal(before, after)
