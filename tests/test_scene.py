import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import shortfinal as sf
from shortfinal.scene.render import Motion, Scene, project_rolling, random_scene, render
from shortfinal.scene.sensor import Sensor, random_sensor

RUNWAY = sf.Runway(1800, 45)
CAMERA = sf.Camera(800, 600, 1100, 1100, 399.5, 299.5)
WIDE = sf.Camera(800, 600, 600, 610, 390.0, 310.0, (-0.12, 0.03, 5e-4, -3e-4, 0.0))


def bare(part):
    """The same part of a scene with every colour black."""
    black = {name: np.zeros_like(value) for name, value in part._asdict().items() if name in COLOURS}
    return part._replace(**black)


COLOURS = {
    "fields", "wild", "crowns", "water_rgb", "road_rgb", "roofs", "walls", "yards", "hedge",
    "horizon", "zenith", "airlight", "glow", "cloud_rgb", "rock", "ridges", "veil",
}  # fmt: skip


def outline_of(scene):
    """The same scene in clear white light, with its runway painted white and all else black."""
    a, land, sky = scene
    nothing = 0.0
    airfield = a._replace(
        surface=np.ones(3), shoulder=np.zeros(3), shoulder_width=nothing, paint=np.ones(3), wear=nothing,
        roughness=nothing, rubber=np.zeros((2, 4)), patches=np.zeros(2), concrete=np.array([0.0, 0, 1, 1, 1, 0]),
        pad=np.array([[0.0, 0, 0, 0, 0, 0, 1]] * 2), threshold_line=np.zeros(2), strips=np.zeros((16, 9)),
        other=np.array([0.0, 0, 1, 0, 0, 0]), verge=np.zeros(5), grounds=np.array([*a.grounds[:2], 0, 0, 0, 1.0]),
    )  # fmt: skip
    lit = bare(sky)._replace(
        ambient=np.ones(3), direct=np.zeros(3), glow=np.array([0, 0, 0, 1.0]), beta=np.zeros(3), darkness=-1.0
    )
    return Scene(airfield, bare(land)._replace(shore=land.shore * [1, 1, 0, 0]), lit)


def plain_scene():
    """A white runway on black ground in clear air: nothing but the runway's outline."""
    return outline_of(random_scene(np.random.default_rng(0), RUNWAY))


def flat_pose(distance, seed=0):
    rng = np.random.default_rng(seed)
    attitude = rng.uniform([-3, -5, -8], [3, -2, 8])
    return sf.Pose.from_attitude([-distance, 0.02 * distance, 0.06 * (distance + 305)], *attitude)


def corner_errors(scene, camera, pose, corners_px, motion=None, zoom=32, half=1.5):
    """How far (px) each corner lies from where it was said to, each looked at `zoom` times magnified.

    OpenCV finds it there from a start 5 of those pixels off: to 0.05 px of the camera is to 1.6 of them.
    """
    errors = []
    for corner in corners_px:
        u, v = corner + 0.5 - half
        window = sf.PixelWindow(u, v, 2 * half, 2 * half, int(2 * half * zoom), int(2 * half * zoom))
        seen, at = motion.through(window, camera, pose) if motion else (None, pose)
        picture = cv2.cvtColor(render(scene, camera.view(window), at, motion=seen), cv2.COLOR_RGB2GRAY)
        start = (window.apply(corner) + [5.0, -5.0]).astype(np.float32).reshape(1, 1, 2)
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-3)
        found = cv2.cornerSubPix(picture, start, (12, 12), (-1, -1), stop)[0, 0]
        errors.append(np.linalg.norm(window.inverse(found) - corner))
    return np.array(errors)


@pytest.mark.parametrize("camera", [CAMERA, WIDE], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("distance", [250, 900, 3000])
def test_corners_lie_where_project_puts_them(camera, distance):
    pose = flat_pose(distance)
    assert corner_errors(plain_scene(), camera, pose, sf.project(camera, pose, RUNWAY.corners)).max() < 0.05


def random_camera(rng):
    """A lens of 25 to 65 degrees, in half of the cases distorted."""
    f = rng.uniform(500, 1500)
    bent = (rng.uniform(-0.15, 0.1), rng.uniform(-0.03, 0.03), *rng.uniform(-1e-3, 1e-3, 2), 0.0)
    return sf.Camera(
        640, 640, f, f * rng.uniform(0.9, 1.1), *rng.uniform(290, 350, 2), bent if rng.random() < 0.5 else ()
    )


def random_views(seeds):
    """Scenes, cameras and poses of LARD's cone, with the runway in the picture; outlines only."""
    for seed in seeds:
        rng = np.random.default_rng([31, seed])
        scene, camera = random_scene(rng), random_camera(rng)
        runway = sf.Runway(scene.airfield.length, scene.airfield.width)
        distance = np.exp(rng.uniform(np.log(150), np.log(5500)))
        aside, glide = np.radians([rng.uniform(-4, 4), rng.uniform(2.2, 3.8)])
        attitude = rng.uniform([-10, -8, -10], [10, 0, 10])
        pose = sf.Pose.from_attitude([-distance, distance * np.tan(aside), (distance + 305) * np.tan(glide)], *attitude)
        yield outline_of(scene), camera, pose, runway


def check_outlines(seeds):
    for scene, camera, pose, runway in random_views(seeds):
        corners = sf.project(camera, pose, runway.corners)
        assert corner_errors(scene, camera, pose, corners).max() < 0.05


@pytest.mark.slow
def test_corners_of_random_scenes_lie_where_the_labels_say():
    check_outlines(range(30))


@pytest.mark.slow
def test_corners_of_a_thousand_random_scenes_lie_where_the_labels_say():
    check_outlines(range(1000))


def random_motion(rng):
    """An approach at 70 m/s in turbulence, read in up to 30 ms."""
    return Motion(np.array([70.0, *rng.normal(0, 4, 2)]), rng.normal(0, 15, 3), rng.uniform(0.005, 0.03))


def test_corners_under_a_rolling_shutter_lie_where_project_rolling_puts_them():
    moved = []
    for n, (scene, camera, pose, runway) in enumerate(random_views(range(12))):
        motion = random_motion(np.random.default_rng(n))
        corners = project_rolling(camera, pose, motion, runway.corners)
        assert corner_errors(scene, camera, pose, corners, motion).max() < 0.05
        moved.append(np.abs(corners - sf.project(camera, pose, runway.corners)).max())
    assert np.median(moved) > 0.3  # against the still picture: a test that can fail


def test_the_middle_row_has_the_pose_that_was_given():
    motion, pose = random_motion(np.random.default_rng(1)), flat_pose(900)
    positions, rotations = motion.at_rows(CAMERA, pose, [0, 299.5, 599])
    np.testing.assert_array_equal(positions[1], pose.position_m)
    np.testing.assert_allclose(rotations[1], pose.runway_from_camera, atol=1e-12)
    np.testing.assert_allclose(positions[2] - positions[0], motion.readout_s * motion.velocity_m_s)
    # The rate about the camera's x axis alone: its rows turn by so much about it.
    turning = Motion(np.zeros(3), np.array([10.0, 0, 0]), 0.1)
    _, rotations = turning.at_rows(CAMERA, pose, [0, 599])
    step = rotations[0].T @ rotations[1]
    np.testing.assert_allclose(step, Rotation.from_euler("x", 1.0, degrees=True).as_matrix(), atol=1e-12)


def test_a_motion_of_nothing_is_a_still_picture():
    pose, scene = flat_pose(900), random_scene(np.random.default_rng(3), RUNWAY)
    still = Motion(np.zeros(3), np.zeros(3), 0.02)
    np.testing.assert_array_equal(render(scene, CAMERA, pose, motion=still), render(scene, CAMERA, pose))
    np.testing.assert_allclose(
        project_rolling(CAMERA, pose, still, RUNWAY.corners), sf.project(CAMERA, pose, RUNWAY.corners), atol=1e-9
    )


def test_a_motion_too_fast_for_the_shutter_is_refused():
    # 1100 px x 4.4 rad/s is more than the 3000 rows a second that are read.
    tumbling = Motion(np.zeros(3), np.array([250.0, 0, 0]), 0.2)
    with pytest.raises(sf.InputError, match="as fast as the shutter"):
        project_rolling(CAMERA, flat_pose(900), tumbling, RUNWAY.corners)


@pytest.mark.parametrize(
    ("motion", "named"),
    [
        (([1.0, 2.0], [0.0] * 3, 0.01), "velocity_m_s"),
        (([0.0] * 3, [0.0, np.nan, 0.0], 0.01), "rates_deg_s"),
        (([0.0] * 3, [0.0] * 3, -0.01), "readout_s"),
    ],
)
def test_a_bad_motion_is_refused_by_name(motion, named):
    with pytest.raises(sf.InputError, match=named):
        Motion(*motion)


@pytest.mark.parametrize("seed", [2, 8, 14])
def test_a_part_of_the_picture_is_what_the_whole_shows_there(seed):
    # Whatever order the pixels come in, and whatever was looked up before.
    scene, pose = random_scene(np.random.default_rng(seed), RUNWAY), flat_pose(2500, seed)
    whole = render(scene, CAMERA, pose, samples=2)
    part = render(scene, CAMERA.view(sf.PixelWindow(300, 200, 200, 250, 200, 250)), pose, samples=2)
    difference = np.abs(whole[200:450, 300:500].astype(int) - part)
    if scene.sky.darkness < 0:
        assert difference.max() <= 1  # the last bit, by rounding of the shifted principal point
    assert (difference > 2).mean() < 1e-3


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
    scene = plain_scene()
    marked = scene.airfield._replace(
        surface=np.full(3, 0.2), side_stripe=0.0, bars=np.array([6.0, 30.0, 6.0, 3.6, 0.5, 1.5])
    )
    down = sf.Pose([20.0, 0.0, 100.0], np.array([[0, -1, 0], [-1, 0, 0], [0, 0, -1.0]]))
    camera = sf.Camera(400, 400, 1000, 1000, 199.5, 199.5)
    picture = render(scene._replace(airfield=marked), camera, down)[..., 0]
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
