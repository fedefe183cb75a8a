"""Searching a frame: windows that cover it, spots that are places, and the pipeline that finds the runway by itself."""

import dataclasses

import numpy as np
import pytest

import shortfinal as sf
from shortfinal.crops import search_crop
from shortfinal.detector import Spot, shipped_model
from shortfinal.integrity import Decision
from shortfinal.scene.render import random_scene, render
from shortfinal.scene.sensor import Sensor
from shortfinal.search import WINDOWS, Search, distinct, search_windows, windows_around

SIZE = 224
CAMERA = sf.Camera(640, 480, 700.0, 700.0, 319.5, 239.5)
RUNWAY = sf.Runway(1800.0, 45.0, "XXXX/09")


@pytest.mark.parametrize(("width", "height"), [(1920, 1080), (640, 640), (480, 1000), (224, 224)])
def test_windows_cover_the_frame_at_each_scale_and_hold_what_is_small(width, height):
    windows = search_windows(width, height, SIZE)
    longest = max(width, height)
    assert {round(longest / w.width, 9) for w in windows} == {1.0, 2.0, 4.0}
    assert all(w.width == w.height and (w.out_width, w.out_height) == (SIZE, SIZE) for w in windows)
    rng = np.random.default_rng(0)
    for side in {w.width for w in windows}:
        scale = [w for w in windows if w.width == side]
        for _ in range(200):  # a box of a quarter of the window's side, anywhere in the frame
            box = min(side / 4, width, height)
            left, top = rng.uniform(0, width - box), rng.uniform(0, height - box)
            assert any(
                w.left <= left + 1e-9 and w.top <= top + 1e-9
                and left + box <= w.left + side + 1e-9 and top + box <= w.top + side + 1e-9
                for w in scale
            )  # fmt: skip


def test_each_place_is_followed_once_the_likeliest_first():
    spots = [Spot(0.5, (100.0, 100.0), 20.0), Spot(0.9, (104.0, 97.0), 22.0), Spot(0.7, (160.0, 100.0), 20.0)]
    assert distinct(spots) == [spots[1], spots[2]]
    assert distinct([]) == []
    np.testing.assert_allclose(spots[0].box, [90, 90, 110, 110])


def test_windows_around_a_spot_are_centred_on_it():
    for window in windows_around(Spot(0.5, (100.0, 50.0), 10.0), SIZE):
        np.testing.assert_allclose(window.inverse(np.array([[(SIZE - 1) / 2] * 2])), [[100.0, 50.0]])


def test_training_windows_are_the_searchs_own():
    rng = np.random.default_rng(1)
    box = np.array([300.0, 200.0, 330.0, 240.0])
    shares, held = [], []
    for _ in range(2000):
        window = search_crop(box, (640, 480), SIZE, rng)
        assert window.width == window.height
        assert SIZE / 2.2 - 1e-9 <= window.width <= 1.15 * 640 + 1e-9
        shares.append(40 / window.width)
        centre = window.apply(np.array([[315.0, 220.0]]))[0]
        held.append(bool(((centre > 0) & (centre < SIZE)).all()))
    assert min(shares) < 0.06
    assert max(shares) > 0.38
    # Three in four hold the centre by design, some of the others by chance.
    assert 0.75 - 4 * np.sqrt(0.75 * 0.25 / 2000) < np.mean(held)
    for shape in ((60, 40), (4000, 100)):
        window = search_crop(None, shape, SIZE, rng)
        assert 0 < window.width <= 1.15 * max(shape) + 1e-9


class Finder:
    """A detector whose spots and looks are told: at each place of `runways`, the corners of one."""

    calibration, searches, sharpens = None, True, False

    def __init__(self, info, runways):
        self.info, self.runways, self.windows = info, runways, 0

    def spots(self, image, windows):
        self.windows += len(windows)
        found = []
        for corners in self.runways:
            box = np.concatenate([corners.min(axis=0), corners.max(axis=0)])
            centre, side = (box[:2] + box[2:]) / 2, float((box[2:] - box[:2]).max())
            for window in windows:
                inside = (window.apply(centre[None])[0] / SIZE - 0.5).__abs__().max() < 0.5
                if inside and side / window.width > 0.03:
                    found.append(Spot(0.9, (float(centre[0]), float(centre[1])), side))
        return found

    def look(self, image, window):
        from shortfinal.detector import Look

        middle = window.inverse(np.array([[(SIZE - 1) / 2] * 2]))[0]
        corners = min(self.runways, key=lambda c: np.linalg.norm(c.mean(axis=0) - middle))
        return Look(window, sf.GaussianKeypoints.from_sigma(corners, 0.3), np.ones(4), 1.0)


@pytest.fixture(scope="module")
def info():
    return sf.KeypointDetector(shipped_model()).info


def corners_from(cross_m, distance_m=2500.0):
    """Where the runway's corners are, seen from so far to its right, px; the camera looks along it."""
    pose = sf.Pose.from_attitude([-distance_m, -cross_m, 150.0], 0.0, -3.0, 0.0)
    return sf.project(CAMERA, pose, RUNWAY.corners)


FRAME = np.random.default_rng(2).integers(0, 255, (480, 640, 3), dtype=np.uint8)


def test_a_runway_is_found_and_then_followed(info):
    finder = Finder(info, [corners_from(0.0)])
    pipeline = sf.LandingPipeline(finder, RUNWAY, CAMERA)
    search = Search(640, 480, SIZE)
    assert search.frames == -(-len(search.windows) // WINDOWS)
    for _ in range(search.frames):
        result = pipeline.step(FRAME)
        if result.verdict.decision is Decision.USE:
            break
        assert "searching for the runway" in result.verdict.reasons[0]
    assert result.verdict.decision is Decision.USE
    assert np.linalg.norm(result.estimate.pose.position_m - [-2500, 0, 150]) < 1
    asked = finder.windows
    assert pipeline.step(FRAME).verdict.decision is Decision.USE
    assert finder.windows == asked  # not searched any more


def test_a_runway_whose_corners_do_not_fit_when_looked_at_closely_is_found_and_not_used(info, monkeypatch):
    class Closer(Finder):
        sharpens = True

        def sharpened(self, image, keypoints, looks=2):
            off = np.array([[0, 0], [0, 0], [0, 0], [-4.0, 0]])
            return sf.GaussianKeypoints.from_sigma(keypoints.mean_px + off, 0.1)

        def look(self, image, window):
            look = super().look(image, window)
            return dataclasses.replace(look, keypoints=sf.GaussianKeypoints.from_sigma(look.keypoints.mean_px, 1.0))

    monkeypatch.setattr("shortfinal.detector.MAGNIFIED", np.inf)
    corners = corners_from(0.0)
    pipeline = sf.LandingPipeline(Closer(info, [corners]), RUNWAY, CAMERA)
    results = [pipeline.step(FRAME) for _ in range(pipeline._search.frames + 1)]
    assert {r.verdict.decision for r in results if r.crop is not None} == {Decision.DO_NOT_USE}
    assert results[-1].crop is not None  # looked at where it was found
    np.testing.assert_allclose(results[-1].keypoints.mean_px[:3], corners[:3])


def sighted(info, runways, ident):
    """The results of one whole search for a runway of that name."""
    pipeline = sf.LandingPipeline(Finder(info, runways), dataclasses.replace(RUNWAY, ident=ident), CAMERA)
    return [pipeline.step(FRAME) for _ in range(pipeline._search.frames)]


def used(results):
    return [r.estimate.pose.position_m[1] for r in results if r.verdict.decision is Decision.USE]


# Seen to the left, a runway is to the left: the camera is to its right, at a negative y.
@pytest.mark.parametrize(
    ("ident", "crosses", "wanted"),
    [
        ("XXXX/09", (-120, 120), None), ("XXXX/09L", (-120, 120), 120), ("XXXX/09R", (-120, 120), -120),
        ("XXXX/09C", (-120, 120), None), ("XXXX/09L", (0,), None), ("XXXX/09R", (0,), None),
        ("XXXX/09C", (-150, 20, 150), 20), ("XXXX/09", (0,), 0), ("", (0,), 0), ("HELICOPTER", (0,), 0),
    ],
)  # fmt: skip
def test_of_runways_side_by_side_the_named_one_is_used_or_none(info, ident, crosses, wanted):
    results = sighted(info, [corners_from(cross) for cross in crosses], ident)
    if wanted is None:
        assert not used(results)
        words = "2 runways in view fit" if ident == "XXXX/09" else f"none found that is {ident} for certain"
        assert any(words in r.verdict.reasons[0] for r in results)
    else:
        assert used(results)[0] == pytest.approx(-wanted, abs=1)


def test_a_prior_decides_between_two(info):
    pair = [corners_from(-120.0), corners_from(120.0)]
    pipeline = sf.LandingPipeline(Finder(info, pair), RUNWAY, CAMERA)
    prior = sf.Pose.from_attitude([-2500.0, 120.0, 150.0], 0.0, -3.0, 0.0)
    assert pipeline.step(FRAME, prior=prior).verdict.decision is Decision.USE


def test_a_runway_that_is_gone_is_searched_for(info):
    finder = Finder(info, [corners_from(0.0)])
    pipeline = sf.LandingPipeline(finder, RUNWAY, CAMERA)
    while pipeline.step(FRAME).verdict.decision is not Decision.USE:
        pass
    finder.runways = [corners_from(400.0, 1500.0)]
    decisions = [pipeline.step(FRAME).verdict.decision for _ in range(5)]
    assert decisions[-1] is Decision.USE


def test_nothing_is_found_where_nothing_is(info):
    pipeline = sf.LandingPipeline(Finder(info, []), RUNWAY, CAMERA)
    reasons = [pipeline.step(FRAME).verdict.reasons[0] for _ in range(pipeline._search.frames)]
    count = len(search_windows(640, 480, SIZE))
    assert reasons[0] == f"searching for the runway: {WINDOWS} of {count} windows of the frame looked at, none found"
    assert reasons[-1] == f"searching for the runway: {count} of {count} windows of the frame looked at, none found"


@pytest.mark.slow
def test_the_shipped_model_finds_a_rendered_runway_unaided():
    rng = np.random.default_rng(8)
    found = 0
    for seed in range(8):
        scene = random_scene(np.random.default_rng([8, seed]), RUNWAY)
        pose = sf.Pose.from_attitude([-rng.uniform(600, 1800), rng.uniform(-40, 40), 90.0], rng.uniform(-8, 8), -2, 2)
        frame = render(scene, CAMERA, pose, Sensor(0.4, 2.0, 92), samples=2, seed=seed)
        corners = sf.project(CAMERA, pose, RUNWAY.corners)
        pipeline = sf.LandingPipeline(sf.KeypointDetector(), RUNWAY, CAMERA)
        for _ in range(3):
            crop = pipeline.step(frame).crop
            if crop is not None:
                centre = np.array([crop.left + crop.width / 2, crop.top + crop.height / 2])
                found += bool(((centre >= corners.min(axis=0)) & (centre <= corners.max(axis=0))).all())
                break
    assert found >= 6  # of 8 scenes in any weather
