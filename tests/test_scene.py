import cv2
import numpy as np
import pytest

import shortfinal as sf
from shortfinal.data.scene import Sensor, random_scene, random_sensor, render

RUNWAY = sf.Runway(1800, 45)
CAMERA = sf.Camera(800, 600, 1100, 1100, 399.5, 299.5)
WIDE = sf.Camera(800, 600, 600, 610, 390.0, 310.0, (-0.12, 0.03, 5e-4, -3e-4, 0.0))


def plain_scene():
    """A white runway on black ground in clear air: nothing but the runway's outline."""
    scene = random_scene(np.random.default_rng(0), RUNWAY)
    black, nothing = np.zeros(3), 0.0
    return scene._replace(
        surface=np.ones(3), paint=np.ones(3), roughness=nothing, rubber=np.zeros((2, 3)), shoulder_width=nothing,
        pad=np.zeros((2, 6)), threshold_line=nothing, strips=np.zeros((16, 8)), roads=np.zeros((6, 7)),
        verge=np.zeros(5), airfield=np.array([50.0, 50.0, 0, 0, 0, 1.0]), palette=np.zeros((6, 3)),
        town=np.array([1000.0, 2.0, 10.0]), forest=np.array([1000.0, 2.0, 0, 0, 0]),
        water=np.array([1000.0, -1.0, 0, 0, 0, 0, 0]), horizon=black, zenith=black, hills=np.array([0, 1.0, 0, 0, 0]),
        haze=np.array([1e9, 0, 0, 0]), sun=np.ones(4),
    )  # fmt: skip


def flat_pose(distance, seed=0):
    rng = np.random.default_rng(seed)
    attitude = rng.uniform([-3, -5, -8], [3, -2, 8])
    return sf.Pose.from_attitude([-distance, 0.02 * distance, 0.06 * (distance + 305)], *attitude)


@pytest.mark.parametrize("camera", [CAMERA, WIDE], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("distance", [250, 900, 3000])
def test_corners_lie_where_project_puts_them(camera, distance):
    # Each corner is looked at 32 times magnified and located there by OpenCV, from a start 5 of those
    # pixels off: to 0.05 px of the camera is to 1.6 of them.
    pose, zoom, half = flat_pose(distance), 32, 4.0
    for corner in sf.project(camera, pose, RUNWAY.corners):
        u, v = corner + 0.5 - half
        window = sf.PixelWindow(u, v, 2 * half, 2 * half, int(2 * half * zoom), int(2 * half * zoom))
        view = camera.view(window)
        picture = cv2.cvtColor(render(plain_scene(), view, pose), cv2.COLOR_RGB2GRAY)
        start = (window.apply(corner) + [5.0, -5.0]).astype(np.float32).reshape(1, 1, 2)
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-3)
        found = cv2.cornerSubPix(picture, start, (12, 12), (-1, -1), stop)[0, 0]
        assert np.linalg.norm(window.inverse(found) - corner) < 0.05


def test_a_pixel_is_the_mean_of_what_it_covers():
    # Rendering at a quarter of the resolution is the block average of rendering at the full one.
    pose, fine = flat_pose(900), CAMERA
    coarse = CAMERA.view(sf.PixelWindow.resize(800, 600, 200, 150))
    sharp = render(plain_scene(), fine, pose, samples=4)[..., 0].astype(float)
    blocks = sharp.reshape(150, 4, 200, 4).mean(axis=(1, 3))
    small = render(plain_scene(), coarse, pose, samples=8)[..., 0].astype(float)
    # 64 samples of an edge are off by less than 1/8 of the contrast; by much less on average.
    assert np.abs(small - blocks).max() < 255 / 8
    assert abs(small.mean() - blocks.mean()) < 0.02


def test_the_paint_is_where_the_rules_put_it():
    # Straight down, one pixel a decimetre: the first threshold bar begins at its offset.
    scene = plain_scene()._replace(
        surface=np.full(3, 0.2), wear=0.0, side_stripe=0.0, bars=np.array([6.0, 30.0, 1.8, 1.8, 1.5, 0.9])
    )
    down = sf.Pose([20.0, 0.0, 100.0], np.array([[0, -1, 0], [-1, 0, 0], [0, 0, -1.0]]))
    camera = sf.Camera(400, 400, 1000, 1000, 199.5, 199.5)
    picture = render(scene, camera, down)[..., 0]
    for (x, y), painted in {(20.0, 2.0): True, (20.0, 3.9): False, (5.0, 2.0): False, (20.0, 0.0): False}.items():
        u, v = np.round(sf.project(camera, down, [[x, y, 0.0]])[0]).astype(int)
        assert (picture[v, u] > 200) == painted


def test_a_seed_is_a_scene():
    pose = flat_pose(900)
    one, same, other = (render(random_scene(np.random.default_rng(s), RUNWAY), CAMERA, pose) for s in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one.astype(int) - other).mean() > 5


def test_the_sensor_blurs_and_adds_noise():
    pose, scene = flat_pose(900), plain_scene()
    clean = render(scene, CAMERA, pose).astype(float)
    noisy = render(scene, CAMERA, pose, Sensor(noise=5.0), seed=3).astype(float)
    grey = (clean > 30) & (clean < 225)
    assert 4.0 < (noisy - clean)[grey].std() < 6.0
    blurred = render(scene, CAMERA, pose, Sensor(blur_px=2.0)).astype(float)
    assert np.abs(np.diff(blurred, axis=1)).max() < 0.5 * np.abs(np.diff(clean, axis=1)).max()
    assert random_sensor(np.random.default_rng(0)) == random_sensor(np.random.default_rng(0))


def test_random_scenes_are_finite_from_anywhere():
    rng = np.random.default_rng(9)
    for _ in range(12):
        pose = sf.Pose.from_attitude(rng.uniform([-5000, -500, 1], [3000, 500, 900]), *rng.uniform(-25, 25, 3))
        picture = render(random_scene(rng), sf.Camera(64, 48, 60, 60, 31.5, 23.5), pose, samples=2)
        assert picture.shape == (48, 64, 3)
        assert picture.std() > 0


def test_a_camera_in_the_ground_sees_nothing():
    with pytest.raises(sf.InputError, match="above the runway"):
        render(plain_scene(), CAMERA, sf.Pose.from_attitude([-100, 0, 0]))
