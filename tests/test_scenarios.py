"""Every fault of `shortfinal.scenarios`, flown for real: what must rise, what may be accepted, and what comes back."""

import functools

import cv2
import numpy as np
import pytest

import shortfinal as sf
from shortfinal.demo import RUNWAY, demo_scene
from shortfinal.scenarios import (
    BEGIN_S,
    CAMERA,
    END_S,
    FRAMES,
    INTEGRITY_RISK,
    OTHER_RUNWAY,
    RATE_HZ,
    RISES,
    Fault,
    fly_with,
    render_approach,
)
from shortfinal.scene.render import render
from shortfinal.scene.sensor import Sensor
from shortfinal.tracker import TrackState

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def approach():
    return render_approach()


@pytest.fixture(scope="module")
def outcome_of(approach, tmp_path_factory):
    @functools.cache
    def fly(fault):
        return fly_with(fault, approach, tmp_path_factory.mktemp("flight"))

    return fly


def covered(outcome):
    """Every accepted frame's error, and the track's, is within that frame's protection level."""
    assert outcome.accepted
    assert outcome.worst < 1.0


def back_within_a_second(outcome):
    assert outcome.recovered_after_s is not None
    assert outcome.recovered_after_s <= 1.0 + 1e-6


def test_the_frames_are_the_drawn_ones_moved_exactly(approach):
    # A frame from the homography against the same frame drawn, by the shift that correlates best.
    drawn = render(demo_scene(), CAMERA, approach.poses[0], Sensor(blur_px=0.4), samples=2)
    parts = [each[160:300, 200:440].mean(axis=2) for each in (drawn, approach.images[0])]
    shift, _ = cv2.phaseCorrelate(*parts)
    assert np.hypot(*shift) < 0.1  # half a second of flight moves the corners by up to 5 px


def test_without_a_fault_all_is_accepted_once_there_is_a_track(outcome_of):
    sound = outcome_of(None)
    assert [m.accepted for m in sound.moments] == [n >= 4 for n in range(FRAMES)]  # five agree: the fifth is taken
    covered(sound)


@pytest.mark.parametrize(
    "fault",
    [
        Fault.FROZEN, Fault.BLACK, Fault.WHITE, Fault.CORRUPTED, Fault.OCCLUDED, Fault.RESOLUTION, Fault.TIME_BACK,
        Fault.TIME_STALLS, Fault.TAXIWAY_CORNER,
    ],
)  # fmt: skip
def test_what_shows_is_said_at_once_and_nothing_is_accepted(outcome_of, fault):
    outcome = outcome_of(fault)
    assert outcome.rose_after_s(RISES[fault]) == pytest.approx(0.0, abs=1e-6)
    assert outcome.during
    if fault is not Fault.OCCLUDED:  # the approach goes on, and in the end the runway shows beside the dirt
        assert outcome.accepted == []
    assert (outcome.worst or 0.0) < 1.0
    back_within_a_second(outcome)
    assert len(outcome.moments) == FRAMES  # no frame without a result
    assert outcome.notes == ()


def test_a_frozen_picture_is_named_as_long_as_it_lasts_and_the_track_is_degraded(outcome_of):
    during = outcome_of(Fault.FROZEN).during
    assert all("the same picture as" in m.result.verdict.reasons[0] for m in during)
    assert during[-1].result.track.state is TrackState.DEGRADED


def test_a_clock_that_was_set_back_is_a_new_beginning(outcome_of):
    words = [m.words for m in outcome_of(Fault.TIME_BACK).moments]
    assert any("the clock was set back from 1.100 s" in each for each in words)


def test_a_clock_that_stands_still_degrades_the_track(outcome_of):
    during = outcome_of(Fault.TIME_STALLS).during
    assert "timestamps of 5 frames did not advance" in during[-1].words


def test_blur_shows_in_the_networks_own_sigma(outcome_of):
    # The network finds the runway in it, and says how much less it knows: no level is given, or one that holds.
    outcome, sound = outcome_of(Fault.BLUR), outcome_of(None)
    sigma, before = (
        np.median([m.result.estimate.sigma_position_m[0] for m in each.accepted]) for each in (outcome, sound)
    )
    assert sigma > 2 * before
    covered(outcome)
    assert outcome.unbounded > 0
    back_within_a_second(outcome)


def test_a_mirrored_picture_jumps_and_then_wins(outcome_of):
    # It is a right picture of another approach: only the jump shows, and after 0.75 s the track must follow it.
    outcome = outcome_of(Fault.MIRRORED)
    assert outcome.rose_after_s(RISES[Fault.MIRRORED]) == pytest.approx(0.0, abs=1e-6)
    assert any("contradicted by" in m.words for m in outcome.during)
    first = next(m.time_s for m in outcome.during if m.accepted)
    assert first - BEGIN_S > 0.75
    assert outcome.largest_error_m[1] > 5.0  # it is wrong all the same,
    assert outcome.worst > 1.0  # and beyond the level, which is for one keypoint at fault
    back_within_a_second(outcome)


@pytest.mark.parametrize("fault", [Fault.WRONG_RUNWAY, Fault.FAR_THRESHOLD, Fault.WRONG_FOCAL])
def test_what_is_loaded_wrongly_does_not_fit(outcome_of, fault):
    outcome = outcome_of(fault)
    assert outcome.rose_after_s(RISES[fault]) < 0.25  # 3 % of a focal length is the least of them
    assert outcome.moments[-1].result.track.state is not TrackState.TRACKING
    if fault is Fault.WRONG_FOCAL:  # some frames pass, with the error that it makes
        assert len(outcome.accepted) < 0.2 * FRAMES
        covered(outcome)
    else:
        assert not outcome.accepted


def test_a_runway_changed_in_flight_drops_the_track(outcome_of):
    outcome = outcome_of(Fault.RUNWAY_CHANGED)
    assert outcome.rose_after_s(RISES[Fault.RUNWAY_CHANGED]) == pytest.approx(0.0, abs=1e-6)
    first = next((m.time_s for m in outcome.during if m.accepted), END_S)
    assert first - BEGIN_S >= 4 / RATE_HZ - 1e-6  # no pose in the old one's frame; five that agree in the new one's
    assert not outcome.accepted  # what is seen is not the other one
    back_within_a_second(outcome)


def test_the_pipelines_runway_cannot_be_half_changed():
    pipeline = sf.LandingPipeline(sf.KeypointDetector(), RUNWAY, CAMERA)
    with pytest.raises(AttributeError):
        pipeline.runway = OTHER_RUNWAY
    pipeline.land_on(OTHER_RUNWAY)
    assert pipeline.runway is OTHER_RUNWAY
    assert (pipeline.points == OTHER_RUNWAY.corners).all()


def test_a_model_file_that_is_replaced_changes_nothing(outcome_of):
    outcome, sound = outcome_of(Fault.MODEL_REPLACED), outcome_of(None)
    assert outcome.facts["flown"] == outcome.facts["shipped"]  # flight.json names what was loaded
    for one, other in zip(outcome.moments, sound.moments, strict=True):
        assert np.array_equal(one.result.keypoints.mean_px, other.result.keypoints.mean_px)
        assert one.accepted == other.accepted


def test_on_a_full_disk_lines_are_whole_and_the_log_goes_on_when_there_is_room(outcome_of):
    outcome = outcome_of(Fault.DISK_FULL)
    begin, end = round(BEGIN_S * RATE_HZ), round(END_S * RATE_HZ)
    written = outcome.facts["written"]
    assert outcome.facts["broken"] == 0
    assert written == sorted(written)
    assert set(range(begin - 2)) <= set(written)  # what waits to be written when it begins may be lost with it
    assert set(written).isdisjoint(range(begin + 1, end - 2))
    assert set(range(end + round(RATE_HZ), FRAMES)) <= set(written)
    assert len(outcome.moments) == FRAMES  # the other sink has them all
    assert "cannot be written" in outcome.notes[0]
    covered(outcome)


def test_a_peer_that_is_gone_is_counted_and_hears_again(outcome_of):
    pytest.importorskip("pymavlink", reason="needs pymavlink")
    outcome = outcome_of(Fault.PEER_GONE)
    poses = np.array(outcome.facts["poses_s"])
    sent = [m.result.timestamp_s for m in outcome.moments if m.accepted]
    heard = [t for t in sent if t < BEGIN_S - 0.05 or t > END_S + 0.25]  # one more may be lost to tell that it is gone
    assert set(np.round(heard, 3)) <= set(np.round(poses, 3)) <= set(np.round(sent, 3))
    assert not ((poses > BEGIN_S + 0.05) & (poses < END_S - 0.05)).any()
    assert outcome.facts["errors"] > 0
    assert "refused" in outcome.facts["note"]
    assert len(outcome.moments) == FRAMES


def test_a_camera_that_goes_is_missed_and_taken_up_again(outcome_of):
    outcome = outcome_of(Fault.CAMERA_GONE)
    # What was on its way when the camera went may still come in.
    silent = [m for m in outcome.during if m.time_s > BEGIN_S + 0.3]
    assert silent
    assert all("no frame for" in m.words and not m.accepted for m in silent)
    assert outcome.rose_after_s(RISES[Fault.CAMERA_GONE]) < 1.0  # the watchdog, 0.2 s, on a busy machine
    assert outcome.recovered_after_s < 2.5  # likewise; docs/faults.md has it measured
    assert all(m.beyond() < 1.0 for m in outcome.moments if m.accepted)


def test_another_size_from_the_start_is_refused(approach):
    pipeline = sf.LandingPipeline(sf.KeypointDetector(), RUNWAY, CAMERA, integrity_risk=INTEGRITY_RISK)
    with pytest.raises(sf.InputError, match="320 x 240 pixels; the camera has 640 x 480"):
        pipeline.step(approach.images[0][::2, ::2].copy(), 0.0, box=approach.box)
