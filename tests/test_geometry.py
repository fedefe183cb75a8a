import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import shortfinal as sf
from shortfinal.geometry import so3_exp

CAMERA = sf.Camera(2448, 2648, 3401.6, 3401.6, 1223.5, 1323.5)
WIDE = sf.Camera(1280, 960, 700.0, 690.0, 630.0, 470.0, (-0.2, 0.05, 1e-3, -5e-4, 0.01, 0.02, -0.01, 0.002))
angle = st.floats(-40, 40)


def poses(seed, count):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        position = [rng.uniform(-4000, -200), rng.uniform(-100, 100), rng.uniform(20, 250)]
        yield sf.Pose.from_attitude(position, *rng.uniform([-5, -7, -15], [5, 2, 15]))


POINTS = np.array([[0, 22.5, 0], [0, -22.5, 0], [2000, -22.5, 3], [2000, 22.5, 2], [300, 9, -1]])


def test_zero_attitude_looks_along_the_runway_with_the_horizon_level():
    # Camera 100 m up, level, over the extended centreline: a point 1000 m ahead on the ground lies
    # f * 100 / 1000 below the principal point, and a point to the left has smaller u.
    px = sf.project(CAMERA, sf.Pose.from_attitude([-1000, 0, 100]), [[0, 0, 0], [0, 50, 0]])
    assert px[0] == pytest.approx([1223.5, 1323.5 + 340.16])
    assert px[1] == pytest.approx([1223.5 - 3401.6 * 0.05, 1323.5 + 340.16])


@pytest.mark.parametrize(
    ("attitude", "axis", "sign"),
    [((1, 0, 0), 0, -1), ((0, 1, 0), 1, 1)],  # nose right: scene moves left; nose up: scene moves down
)
def test_attitude_signs(attitude, axis, sign):
    level = sf.project(CAMERA, sf.Pose.from_attitude([-1000, 0, 100]), [[0, 0, 0]])[0]
    turned = sf.project(CAMERA, sf.Pose.from_attitude([-1000, 0, 100], *attitude), [[0, 0, 0]])[0]
    assert np.sign(turned - level)[axis] == sign


def test_right_wing_down_raises_the_right_of_the_image():
    left, right = sf.project(CAMERA, sf.Pose.from_attitude([-1000, 0, 100], 0, 0, 5), [[0, 50, 0], [0, -50, 0]])
    assert right[1] < left[1]


@given(angle, angle, angle)
def test_attitude_round_trip(yaw, pitch, roll):
    attitude = sf.Pose.from_attitude([0, 0, 10], yaw, pitch, roll).attitude
    assert attitude == pytest.approx((yaw, pitch, roll), abs=1e-9)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-5, 1e-4, 0.3, 3.1])
def test_so3_exp_agrees_with_scipy(size):
    vector = size * np.array([0.36, -0.48, 0.8])
    np.testing.assert_allclose(so3_exp(vector), Rotation.from_rotvec(vector).as_matrix(), atol=2e-15)


def test_plus_undoes_minus():
    rng = np.random.default_rng(1)
    for pose in poses(1, 20):
        increment = rng.normal(size=6) * [10, 10, 10, 0.3, 0.3, 0.3]
        np.testing.assert_allclose(pose.plus(increment).minus(pose), increment, atol=1e-9)


@pytest.mark.parametrize("camera", [CAMERA, WIDE])
def test_projection_agrees_with_opencv(camera):
    for pose in poses(2, 20):
        rotation = pose.runway_from_camera.T
        expected, _ = cv2.projectPoints(
            POINTS, cv2.Rodrigues(rotation)[0], -rotation @ pose.position_m, camera.matrix, np.array(camera.distortion)
        )
        np.testing.assert_allclose(sf.project(camera, pose, POINTS), expected[:, 0], atol=1e-7)


@pytest.mark.parametrize("camera", [CAMERA, WIDE])
def test_jacobian_agrees_with_differences(camera):
    for pose in poses(3, 10):
        analytic = sf.project_jacobian(camera, pose, POINTS)
        for axis in range(6):
            step = np.zeros(6)
            step[axis] = 1e-3 if axis < 3 else 1e-6
            high, low = (sf.project(camera, pose.plus(s * step), POINTS).ravel() for s in (1, -1))
            numeric = (high - low) / (2 * step[axis])
            np.testing.assert_allclose(analytic[:, axis], numeric, rtol=1e-5, atol=1e-5 * np.abs(numeric).max())


@pytest.mark.parametrize("camera", [CAMERA, WIDE])
def test_unproject_undoes_project(camera):
    for pose in poses(4, 10):
        px = sf.project(camera, pose, POINTS)
        in_camera = (POINTS - pose.position_m) @ pose.runway_from_camera
        np.testing.assert_allclose(sf.unproject(camera, px), in_camera / in_camera[:, 2:], atol=1e-9)


def test_unproject_refuses_a_pixel_beyond_the_lens_model():
    with pytest.raises(sf.InputError, match=r"px: pixel 0 .* outside the range"):
        sf.unproject(sf.Camera(100, 100, 50, 50, 49.5, 49.5, (-0.3, 0, 0, 0)), [[300.0, 49.5]])


def test_a_point_beyond_the_lens_model_is_refused_not_folded_back():
    barrel = sf.Camera(960, 720, 600, 600, 479.5, 359.5, (-0.3, 0, 0, 0))
    pose = sf.Pose.from_attitude([0, 0, 50])
    with pytest.raises(sf.InputError, match="point 1 is outside the range of the camera's distortion"):
        sf.project(barrel, pose, [[100, 0, 50], [100, -173, 50]])


def test_window_keeps_pixel_centres_exact():
    # Halving: the centre of the output's first pixel is the corner shared by the first four source pixels.
    half = sf.PixelWindow.resize(8, 4, 4, 2)
    assert half.inverse([0, 0]) == pytest.approx([0.5, 0.5])
    assert half.apply([0.5, 0.5]) == pytest.approx([0, 0])
    window = sf.PixelWindow(-3.5, 10.25, 50, 40, 224, 200)
    px = np.array([[1.5, 12.0], [40.0, 33.3]])
    np.testing.assert_allclose(window.inverse(window.apply(px)), px)
    cov = np.diag([1.0, 4.0])
    np.testing.assert_allclose(window.inverse_cov(cov), np.diag([(50 / 224) ** 2, 4 * (40 / 200) ** 2]))


def test_a_camera_seen_through_a_window_projects_where_the_window_maps():
    window = sf.PixelWindow(100.25, 50.5, 600, 500, 224, 224)
    for camera in (CAMERA, WIDE):
        for pose in poses(5, 5):
            direct = sf.project(camera.view(window), pose, POINTS)
            np.testing.assert_allclose(direct, window.apply(sf.project(camera, pose, POINTS)), atol=1e-9)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: sf.Camera(0, 10, 1, 1, 0, 0), "must be positive"),
        (lambda: sf.Camera(10, 10, float("nan"), 1, 0, 0), "must be finite"),
        (lambda: sf.Camera(10.5, 10, 1, 1, 0, 0), "width is 10.5"),
        (lambda: sf.Camera(10, 10, "a", 1, 0, 0), "camera: fx"),
        (lambda: sf.Camera(10, 10, 10**400, 1, 0, 0), "camera: fx"),
        (lambda: sf.Camera(10, 10, 1, 1, 0, 0, (1, 2, 3)), "3 coefficients"),
        (lambda: sf.Pose([0, 0, float("inf")], np.eye(3)), r"position_m: entry \[2\]"),
        (lambda: sf.Pose([0, 0, 1], np.diag([1, 1, -1])), "not a rotation"),
        (lambda: sf.Pose([0, 0, 1], 2 * np.eye(3)), "not a rotation"),
        (lambda: sf.project(CAMERA, sf.Pose.from_attitude([10, 0, 5]), [[100, 0, 0], [0, 0, 0]]), "point 1 is behind"),
        (lambda: sf.PixelWindow(0, 0, 0, 1, 2, 2), "must be finite and positive"),
    ],
)
def test_wrong_input_is_one_clear_line(build, message):
    with pytest.raises(sf.InputError, match=message) as caught:
        build()
    assert "\n" not in str(caught.value)


def test_values_cannot_be_changed_from_outside():
    position = np.array([1.0, 2.0, 3.0])
    pose = sf.Pose(position, np.eye(3))
    position[0] = 99
    assert pose.position_m[0] == 1
    with pytest.raises(ValueError, match="read-only"):
        pose.position_m[0] = 5
