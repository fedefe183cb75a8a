import dataclasses
import json

import numpy as np
import pytest
from small import INFO, MEAN, constant_model

import shortfinal as sf
from shortfinal.crops import box_around
from shortfinal.demo import CAMERA, RUNWAY, Fault, approach_pose, demo_scene, inject, render_frame
from shortfinal.detector import Look
from shortfinal.integrity import Decision
from shortfinal.keypoints import AIMING_NAMES


@pytest.fixture(scope="module")
def pipeline():
    return sf.LandingPipeline(sf.KeypointDetector(), RUNWAY, CAMERA)


@pytest.fixture(scope="module")
def frame():
    return render_frame(demo_scene(), 80)


TRUTH = approach_pose(80)
BOX = box_around(sf.project(CAMERA, TRUTH, RUNWAY.corners))


def test_one_frame_in_keypoints_pose_and_verdict_out(pipeline, frame):
    result = pipeline.step(frame, 12.5, box=BOX)
    assert result.verdict.decision is Decision.USE
    assert result.timestamp_s == 12.5
    error = result.estimate.pose.minus(TRUTH)
    assert error @ np.linalg.inv(result.estimate.cov) @ error < 22.5  # χ²(6) at 0.1 %
    assert set(result.timings) == {"detect_ms", "solve_ms", "doubt_ms"}
    # A level at 1e-7 lies beyond 5.3 sigma (the normal quantile), and that is what is recorded.
    assert (np.array(result.protection.levels[:3]) > 5.3 * result.estimate.sigma_position_m).all()
    recorded = result.to_dict()["protection"]
    for axis in ("along_m", "cross_m", "vertical_m"):  # JSON knows no infinity
        level = getattr(result.protection, axis)
        assert recorded[axis] == (None if np.isinf(level) else level)


def test_a_prior_pose_is_as_good_as_a_box(pipeline, frame):
    near = TRUTH.plus([10, 3, -2, 0.004, 0.003, -0.004])
    one, other = pipeline.step(frame, box=BOX), pipeline.step(frame, prior=near)
    shift = one.keypoints.mean_px - other.keypoints.mean_px
    assert np.abs(shift / one.keypoints.sigma_px).max() < 3


def test_a_crop_that_cuts_the_runway_off_is_moved(pipeline, frame):
    # A third of the runway's box aside: the first crop misses a corner, which the network places
    # inside all the same. Looking again where it was found brings it in.
    shift = (BOX[2] - BOX[0]) * np.array([0.35, 0.0, 0.35, 0.0])
    result = pipeline.step(frame, box=BOX + shift)
    assert result.verdict.decision is Decision.USE
    error = result.estimate.pose.minus(TRUTH)
    assert error @ np.linalg.inv(result.estimate.cov) @ error < 22.5
    inside = result.crop.apply(sf.project(CAMERA, TRUTH, RUNWAY.corners))
    assert (inside > 10).all()
    assert (inside < 213).all()


def test_a_corner_beyond_the_frame_is_not_measured(pipeline):
    # The same picture cut off left of the runway's middle: two corners are not in it.
    full = render_frame(demo_scene(), 80)
    middle = int((BOX[0] + BOX[2]) / 2)
    cut = sf.Camera(CAMERA.width - middle, CAMERA.height, CAMERA.fx, CAMERA.fy, CAMERA.cx - middle, CAMERA.cy)
    half = sf.LandingPipeline(pipeline.detector, RUNWAY, cut)
    result = half.step(np.ascontiguousarray(full[:, middle:]), box=BOX - [middle, 0, middle, 0])
    assert result.verdict.decision is Decision.NOT_MONITORED
    assert result.estimate is None
    assert "border of the frame" in result.verdict.reasons[0] or "does not settle" in result.verdict.reasons[0]


def test_without_a_box_it_looks_where_the_last_accepted_frame_was(frame):
    fresh = sf.LandingPipeline(sf.KeypointDetector(), RUNWAY, CAMERA)
    fresh.step(frame, box=BOX)
    again = fresh.step(frame)
    assert again.verdict.decision is Decision.USE
    assert "search_ms" not in again.timings


def test_a_model_that_cannot_search_says_what_is_missing(frame, tmp_path):
    info = dataclasses.replace(INFO, size=224)
    model = constant_model(tmp_path / "model.onnx", info, mean=7 * MEAN)
    lost = sf.LandingPipeline(sf.KeypointDetector(model), RUNWAY, CAMERA).step(frame)
    assert lost.verdict.decision is Decision.NOT_MONITORED
    assert "where to look is not known" in lost.verdict.reasons[0]
    assert lost.estimate is None


def test_the_same_picture_while_time_goes_on_is_a_frozen_camera(frame):
    fresh = sf.LandingPipeline(sf.KeypointDetector(), RUNWAY, CAMERA)
    assert fresh.step(frame, 1.0, box=BOX).verdict.decision is Decision.USE
    assert fresh.step(frame, 1.0).verdict.decision is Decision.USE  # once more, for the same time
    frozen = fresh.step(frame, 1.25)
    assert frozen.verdict.decision is Decision.NOT_MONITORED
    assert frozen.verdict.reasons == ("the same picture as 0.25 s ago: frozen",)
    noisy = frame.copy()
    noisy[::16] ^= 1  # the least that a sensor's noise does
    assert fresh.step(noisy, 1.5).verdict.decision is Decision.USE


def test_a_slid_corner_is_refused(pipeline):
    truth = approach_pose(50)  # where the demo injects it
    box = box_around(sf.project(CAMERA, truth, RUNWAY.corners))
    found = pipeline.step(render_frame(demo_scene(), 50), box=box).keypoints
    _, verdict, _ = pipeline.judge(inject(Fault.NEAR_CORNER, truth)(found))
    assert verdict.decision is Decision.DO_NOT_USE
    assert "do not fit the runway" in verdict.reasons[0]


def test_the_record_is_plain_json(pipeline, frame):
    record = json.loads(json.dumps(pipeline.step(frame, box=BOX).to_dict(), allow_nan=False))
    assert record["decision"] == "use"
    assert np.shape(record["pose_cov"]) == (6, 6)


@pytest.mark.parametrize(
    ("where", "reason"),
    [
        ({"box": [-400, 10, -300, 50]}, "outside the frame"),
        ({"box": [5, 5, 5, 5]}, "not left < right"),
        ({"box": [0, 0, float("nan"), 5]}, "box: entry"),
        ({"prior": sf.Pose.from_attitude([500.0, 0, 60])}, "behind the camera"),
    ],
)
def test_what_cannot_be_looked_at_is_not_monitored(pipeline, frame, where, reason):
    result = pipeline.step(frame, **where)
    assert result.verdict.decision is Decision.NOT_MONITORED
    assert reason in result.verdict.reasons[0]


def test_noise_is_hardly_ever_accepted(pipeline):
    # The network has no output for "no runway" yet. Of 200 such frames 1 was accepted, with a position
    # known to 43 % of the distance; if that is the rate, 50 frames hold more than 3 once in 10,000 runs.
    rng = np.random.default_rng(0)
    accepted = 0
    for _ in range(50):
        noise = rng.integers(0, 256, (CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
        left, top, side = rng.uniform([100, 100, 40], [600, 500, 250])
        result = pipeline.step(noise, box=[left, top, left + side, top + 0.7 * side])
        accepted += result.verdict.decision is Decision.USE
    assert accepted <= 3


def test_each_corner_is_looked_at_again_and_seen_sharper(pipeline, frame):
    result = pipeline.step(frame, box=BOX)
    corners = sf.project(CAMERA, TRUTH, RUNWAY.corners)
    once = pipeline.detector.detect(frame, result.crop)
    assert (result.keypoints.sigma_px < once.sigma_px).all()
    # Of eight errors a lucky one may grow, the most of them do not.
    assert np.abs(result.keypoints.mean_px - corners).mean() < 0.7 * np.abs(once.mean_px - corners).mean()


def test_a_runway_that_is_small_in_the_frame_is_looked_at_once(pipeline):
    # From 3 km the crop magnifies the frame: a larger one of a corner would show no more.
    truth = approach_pose(0)
    image = render_frame(demo_scene(), 0)
    result = pipeline.step(image, box=box_around(sf.project(CAMERA, truth, RUNWAY.corners)))
    assert result.crop.scale[0] > 3
    once = pipeline.detector.detect(image, result.crop)
    np.testing.assert_array_equal(result.keypoints.mean_px, once.mean_px)


def test_a_model_that_does_not_look_at_corners_looks_once(frame):
    class Blunt(sf.KeypointDetector):
        sharpens = False

    result = sf.LandingPipeline(Blunt(), RUNWAY, CAMERA).step(frame, box=BOX)
    once = Blunt().detect(frame, result.crop)
    np.testing.assert_array_equal(result.keypoints.mean_px, once.mean_px)
    np.testing.assert_array_equal(result.keypoints.cov_px, once.cov_px)


def test_land_without_a_runway_is_said_to_be_none(pipeline):
    # The demo's land beside the airfield, looked at as if a runway lay there.
    frame = render_frame(demo_scene(), 80)
    result = pipeline.step(frame, box=[20.0, 480.0, 180.0, 600.0])
    assert result.verdict.decision is Decision.NOT_MONITORED
    assert result.present < 0.5
    assert "no runway in view" in result.verdict.reasons[0]
    assert result.estimate is None


class Told:
    """A detector that says what it is told: eight keypoints, of which it sees some."""

    calibration, searches, sharpens = None, False, False

    def __init__(self, info, mean_px, visible):
        self.info = dataclasses.replace(info, keypoints=(*sf.CORNER_NAMES, *AIMING_NAMES))
        self.mean_px, self.visible = mean_px, visible

    def look(self, image, window):
        return Look(window, sf.GaussianKeypoints.from_sigma(self.mean_px, 0.3), self.visible, 1.0)


def test_further_keypoints_take_part_as_far_as_they_are_seen(pipeline, frame):
    marking = np.array([[300.0, 12, 0], [300, -12, 0], [350, -12, 0], [350, 12, 0]])
    mean = sf.project(CAMERA, TRUTH, np.vstack([RUNWAY.corners, marking]))
    detector = Told(pipeline.detector.info, mean, np.array([1, 1, 1, 1, 1, 0.2, 1, 0.9]))
    with pytest.raises(sf.InputError, match="expected near-left"):
        sf.LandingPipeline(detector, RUNWAY, CAMERA)
    result = sf.LandingPipeline(detector, RUNWAY, CAMERA, further_points=marking).step(frame, box=BOX)
    assert len(result.keypoints.mean_px) == 7
    assert result.verdict.dof == 2 * 7 - 6
    assert np.linalg.norm(result.estimate.pose.position_m - TRUTH.position_m) < 0.01


def test_a_flat_frame_is_not_looked_into(pipeline):
    for level in (0, 128, 255):
        result = pipeline.step(np.full((CAMERA.height, CAMERA.width, 3), level, np.uint8), box=BOX)
        assert result.verdict.decision is Decision.NOT_MONITORED
        assert "flat" in result.verdict.reasons[0]


def test_a_model_of_other_keypoints_is_refused(pipeline):
    class Other:
        info = dataclasses.replace(pipeline.detector.info, keypoints=("near-left", "far-left"))

    with pytest.raises(sf.InputError, match="its keypoints are near-left, far-left"):
        sf.LandingPipeline(Other(), RUNWAY, CAMERA)
    with pytest.raises(sf.InputError, match="false_alarm_rate"):
        sf.LandingPipeline(pipeline.detector, RUNWAY, CAMERA, false_alarm_rate=5)


@pytest.mark.parametrize(
    ("frame", "time", "message"),
    [
        (np.zeros((10, 10, 3), np.uint8), 0.0, "10 x 10 pixels; the camera has 960 x 720"),
        (np.zeros((720, 960), np.uint8), 0.0, "expected \\(height, width, 3\\)"),
        (np.zeros((720, 960, 3), np.uint8), float("nan"), "timestamp_s"),
    ],
)
def test_wrong_frames_are_refused(pipeline, frame, time, message):
    with pytest.raises(sf.InputError, match=message):
        pipeline.step(frame, time, box=BOX)
