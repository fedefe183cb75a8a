"""The tracker's promises: honest covariance whatever persists, faults refused in words, states one by one, no lock-out.

Flights are those of benchmarks/tracker.py: down a glide path at 70 m/s, the corners found with noise.
"""

import dataclasses
import json
import math
import re
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import binom

import shortfinal as sf
from shortfinal.integrity import Decision, IntegrityVerdict
from shortfinal.tracker import Tracker, TrackerSettings, TrackState, _rows, _triangular, _Watch

BENCHMARK = "tracker"
SEARCHING, TRACKING, DEGRADED, LOST = TrackState
SHARP = (0.3, 0.5)  # px
BLIND = IntegrityVerdict(Decision.NOT_MONITORED, ("the lens is covered",), 0, 1e-3)
PERIOD_S = 1 / 30

_FLIGHTS = {}


@pytest.fixture
def fly(benchmark):
    """`fly(start_m, seconds, ...)`: a flight with sharp white noise; of the same arguments, the same one."""

    def make(start_m=1500.0, seconds=6.0, **options):
        key = (start_m, seconds, *sorted(options.items()))
        if key not in _FLIGHTS:
            noise = benchmark.Noise(sigma_px=SHARP)
            _FLIGHTS[key] = benchmark.fly(np.random.default_rng(7), noise, start_m, seconds, **options)
        return _FLIGHTS[key]

    return make


@pytest.fixture
def moved(benchmark):
    """`moved(flight, frames, runway)`: the flight, where in those frames the camera sees another runway."""

    def make(flight, frames, runway):
        rng, noise = np.random.default_rng(8), benchmark.Noise(sigma_px=SHARP)
        estimates, verdicts = list(flight.estimates), list(flight.verdicts)
        for k in frames:
            seen = runway(k) if callable(runway) else runway
            [estimates[k]], [verdicts[k]] = benchmark.measure(
                rng, flight.times_s[k : k + 1], flight.poses[k : k + 1], noise, seen
            )
        return flight._replace(estimates=estimates, verdicts=verdicts)

    return make


def feed(tracker, flight, frames=None, shift_s=0.0):
    """Tracks of these frames (default: all), the clock shifted."""
    frames = range(len(flight.times_s)) if frames is None else frames
    return [tracker.update(float(flight.times_s[k]) + shift_s, flight.estimates[k], flight.verdicts[k]) for k in frames]


def started(flight, frames=60, settings=None):
    """A tracker that has followed the first frames."""
    tracker = Tracker(settings)
    assert feed(tracker, flight, range(frames))[-1].state is TRACKING
    return tracker


def states(tracks):
    """The states, each once."""
    seen = [track.state for track in tracks]
    return [state for k, state in enumerate(seen) if k == 0 or state is not seen[k - 1]]


def off_m(track, pose):
    return float(np.linalg.norm(track.pose.position_m - pose.position_m))


# Honest, with white and with persisting errors


FEW = 40
REFUSED = 0.02  # large enough to count


@lru_cache
def honest(benchmark, name, time_s, flights=FEW):
    settings = TrackerSettings(correlation_time_s=time_s, turn_density_deg=0.2, false_alarm_rate=REFUSED)
    return benchmark.honesty(benchmark.NOISES[name], settings, flights, seed=11, seconds=1.5)


def few_within(count, share=0.9545, axes=9):
    """Fewer than so many of `count` within 2 sigma have a chance of 1e-3, over all axes."""
    return binom.ppf(1e-3 / axes, count, share)


def test_with_white_errors_the_covariance_is_right(benchmark):
    found = honest(benchmark, "white", 0.0)
    low, high = benchmark.nees_bounds(FEW)
    assert low < found.end.mean() < high
    assert (found.within.sum(axis=0) >= few_within(FEW)).all()


def test_errors_that_persist_are_no_news(benchmark):
    name = "all persists 0.5 s"
    # Taken as independent, thirty looks at one error are thirty proofs of it.
    assert honest(benchmark, name, 0.0).end.mean() > 4 * 9
    found = honest(benchmark, name, 0.5)
    assert found.end.mean() < benchmark.nees_bounds(FEW)[1]
    assert found.end.mean() > 9 / 2  # not by claiming next to nothing: sigma is at most 1.4 times too large
    assert (found.within.sum(axis=0) >= few_within(FEW)).all()


@pytest.mark.parametrize(
    "name", ["white", "half persists 0.5 s", "all persists 0.5 s, sigma changes", "all persists 10 s"]
)
def test_the_default_is_honest_whatever_persists(benchmark, name):
    flights = 25
    found = honest(benchmark, name, TrackerSettings().correlation_time_s, flights)
    assert found.end.mean() < benchmark.nees_bounds(flights)[1]
    assert (found.within.sum(axis=0) >= few_within(flights)).all()


def test_faultless_measurements_are_refused_at_the_rate(benchmark):
    # An exact filter's innovations are independent: the refusals are binomial.
    found = honest(benchmark, "white", 0.0)
    low, high = binom.ppf([5e-4, 1 - 5e-4], found.tested, REFUSED)
    assert low <= found.refused <= high
    # Where the filter allows for more than there is, refusals are rarer.
    found = honest(benchmark, "all persists 0.5 s", 0.5)
    assert found.refused <= binom.ppf(1 - 1e-3, found.tested, REFUSED)


@pytest.mark.slow
@pytest.mark.parametrize("time_s", [0.5, 2.0, 20.0])
def test_a_whole_approach_stays_within_two_sigma(benchmark, time_s):
    # One sample in 10 s of each flight; errors that persist for longer leave as many as there are 2 time_s in its 70 s.
    rng, within, flights = np.random.default_rng(12), [], 8
    for _ in range(flights):
        flight = benchmark.fly(rng, benchmark.Noise(1.0, time_s), rate_hz=10.0)
        for k, track in enumerate(benchmark.track(flight)):
            if k % 100 == 50:
                error = benchmark.error(track, flight.poses[k], flight.velocities[k])
                within.append(np.abs(error) < 2 * np.sqrt(np.diag(track.cov)))
    assert np.mean(within) > 0.9545
    independent = int(flights * min(7, 70 / (2 * time_s)))
    assert np.mean(within, axis=0).min() >= few_within(independent) / independent


@pytest.mark.slow
def test_filtered_is_more_accurate_than_single_frames(benchmark):
    rows = benchmark.accuracy(2, seed=13)
    for row in rows:
        if row["noise"] == "white":
            assert min(row["factor"]) > 1.5
    # An error that persists cannot be averaged away; but it must not get worse by more than the motion's noise.
    mean = {row["correlation_time_s"]: [] for row in rows}
    for row in rows:
        if row["noise"] != "white":
            mean[row["correlation_time_s"]].append(np.mean(row["factor"]))
    assert np.mean(mean[TrackerSettings().correlation_time_s]) > 1.0


def test_frames_at_any_time_are_followed(fly, benchmark):
    flight = fly(2000.0, 6.0)
    rng, tracker = np.random.default_rng(1), Tracker()
    for k in np.flatnonzero(rng.random(len(flight.times_s)) < 0.3):  # 9 Hz on average, gaps up to half a second
        track = tracker.update(float(flight.times_s[k]), flight.estimates[k], flight.verdicts[k])
    error = benchmark.error(track, flight.poses[k], flight.velocities[k])
    assert track.state in (TRACKING, DEGRADED)
    assert error @ np.linalg.solve(track.cov, error) < 28  # 99.9 % of χ²(9)


def test_a_turn_is_within_what_the_motion_may_be(benchmark):
    # Wilder than any approach. Its errors persist: a flight is one sample, so that few more than 2 sigma are let pass.
    off, tracks = benchmark.turning(TrackerSettings(), seed=1)
    assert states(tracks) == [SEARCHING, TRACKING]
    assert all(track.taken for track in tracks[4:])
    assert np.abs(off).max() < 4
    tame, _ = benchmark.turning(TrackerSettings(acceleration_density=0.25, turn_density_deg=0.5), seed=1)
    assert np.abs(tame).max() > 6


def test_a_motion_unknown_leaves_the_single_frame(fly):
    flight = fly()
    tracker = Tracker(TrackerSettings(1e6, 1e4, correlation_time_s=0.0))
    track = feed(tracker, flight, range(20))[-1]
    own = flight.estimates[19]
    assert np.abs(track.pose.minus(own.pose) / np.sqrt(np.diag(own.cov))).max() < 0.05
    np.testing.assert_allclose(np.diag(track.cov)[:6], np.diag(own.cov), rtol=0.05)


def test_measurements_are_rows_about_any_pose(fly):
    # y = U (measured - pose) to first order, keypoints and other rows alike.
    rng, truth = np.random.default_rng(3), fly().poses[0]
    keypoints = sf.GaussianKeypoints.from_sigma(
        sf.project(sf.Camera(2448, 2648, 3401.6, 3401.6, 1223.5, 1323.5), truth, sf.Runway(1500, 45).corners), 0.4
    )
    est = sf.estimate_pose(
        keypoints, sf.Runway(1500, 45).corners, fly().estimates[0].camera,
        attitude_prior=(truth.plus([0, 0, 0, 0.01, 0, -0.01]).runway_from_camera, 1e-4 * np.eye(3)),
        altitude=(truth.position_m[2] + 1.0, 2.0),
    )  # fmt: skip
    assert len(est.residual) == 12
    seen, root = _rows(est, est.pose.position_m, est.pose.runway_from_camera)
    np.testing.assert_allclose(seen, 0, atol=1e-4)
    np.testing.assert_allclose(root.T @ root, est.jacobian.T @ est.jacobian, rtol=1e-6)
    step = np.linalg.solve(root, 0.3 * rng.normal(size=6))
    away = est.pose.plus(step)
    seen, moved = _rows(est, away.position_m, away.runway_from_camera)
    np.testing.assert_allclose(seen, -moved @ step, atol=0.02)
    q, r = _triangular(est.jacobian)
    assert (np.diag(r) > 0).all()
    np.testing.assert_allclose(q @ r, est.jacobian, atol=1e-9 * np.abs(est.jacobian).max())


# States, one by one


def test_a_search_ends_when_enough_measurements_agree(fly):
    tracks = feed(Tracker(), fly(), range(6))
    assert [track.state for track in tracks] == [SEARCHING] * 4 + [TRACKING] * 2
    assert all(t.pose is None and t.cov is None and not t.taken for t in tracks[:4])
    assert "measurement 3 of 5 that agree" in tracks[2].reason
    assert "5 measurements in 0.13 s agree" in tracks[4].reason
    assert tracks[4].taken
    assert tracks[4].pose is not None


def test_measurements_that_disagree_start_no_track(fly, moved):
    flight = moved(fly(), range(0, 40, 3), lambda k: _shifted(30.0 * (1 + k % 2)))
    tracks = feed(Tracker(), flight, range(40))
    assert states(tracks) == [SEARCHING]
    assert any("m from the prediction" in track.reason for track in tracks)


def test_a_search_that_takes_too_long_begins_anew(fly):
    flight = fly(1500.0, 8.0)
    tracks = feed(Tracker(), flight, range(0, 240, 30))  # one a second: five take four
    assert states(tracks) == [SEARCHING]
    assert "took too long" in tracks[4].reason
    assert feed(Tracker(), flight, range(0, 240, 15))[4].state is TRACKING  # two a second


def test_a_gap_of_half_a_second_is_coasted(fly):
    flight = fly()
    tracker = started(flight)
    blind = [tracker.update(float(flight.times_s[k]), None, BLIND) for k in range(60, 75)]
    assert states(blind) == [TRACKING, DEGRADED]
    assert blind[6].state is TRACKING  # 7 frames: 0.23 s
    assert blind[7].state is DEGRADED
    assert "no measurement was taken in for 0.27 s" in blind[7].reason
    assert "not-monitored: the lens is covered" in blind[7].reason
    assert all(not t.taken and t.innovation_p is None and t.pose is not None for t in blind)
    growth = [np.linalg.eigvalsh(later.cov - earlier.cov)[-1] for earlier, later in pairwise(blind)]
    assert min(growth) > 0
    assert [np.sqrt(np.trace(t.cov[:3, :3])) for t in blind] == sorted(np.sqrt(np.trace(t.cov[:3, :3])) for t in blind)
    assert blind[-1].coasting_s == pytest.approx(0.5)
    back = feed(tracker, flight, range(75, 82))
    assert all(track.taken for track in back)
    assert [track.state for track in back] == [DEGRADED] * 4 + [TRACKING] * 3
    assert "5 measurements in a row were taken in" in back[4].reason
    assert off_m(back[-1], flight.poses[81]) < 3 * np.sqrt(np.trace(back[-1].cov[:3, :3]))


def test_a_gap_without_any_frame_is_the_same(fly):
    flight = fly()
    tracker = started(flight)
    assert feed(tracker, flight, [75])[0].taken
    assert feed(tracker, flight, range(76, 81))[-1].state is TRACKING


@pytest.mark.parametrize("blind", [True, False], ids=["frames", "no frames"])
def test_a_gap_of_five_seconds_loses_the_track(fly, blind):
    flight = fly(1500.0, 8.0)
    tracker = started(flight)
    if blind:
        tracks = [tracker.update(float(flight.times_s[k]), None, BLIND) for k in range(60, 210)]
        assert states(tracks) == [TRACKING, DEGRADED, LOST]
        lost = next(t for t in tracks if t.state is LOST)
        assert lost.coasting_s == pytest.approx(3.0, abs=2 * PERIOD_S)
        assert tracker.predict(float(flight.times_s[210])) is None
    else:
        [lost] = feed(tracker, flight, [210])
    assert lost.state is LOST
    assert "no measurement was taken in for" in lost.reason
    assert "limit 3 s" in lost.reason
    assert lost.pose is lost.cov is lost.velocity_mps is None
    back = feed(tracker, flight, range(211, 220))
    assert states(back) == [SEARCHING, TRACKING]
    assert "lost: no measurement was taken in" in back[0].reason
    assert off_m(back[-1], flight.poses[219]) < 3 * np.sqrt(np.trace(back[-1].cov[:3, :3]))


def test_a_position_too_vague_is_lost(fly):
    flight = fly()
    tracker = started(flight, settings=TrackerSettings(acceleration_density=50.0, largest_share=0.05))
    tracks = [tracker.update(float(flight.times_s[k]), None, BLIND) for k in range(60, 120)]
    assert states(tracks) == [TRACKING, DEGRADED, LOST]
    lost = next(t for t in tracks if t.state is LOST)
    assert "the position's sigma is" in lost.reason
    assert "over 5% of the distance" in lost.reason
    assert lost.coasting_s < 3.0


def test_no_track_from_measurements_too_vague(fly):
    tracks = feed(Tracker(TrackerSettings(largest_share=1e-6)), fly(), range(10))
    assert states(tracks) == [SEARCHING]
    assert "but the position's sigma" in tracks[-1].reason


# What a frame may bring


@pytest.mark.parametrize("decision", [Decision.DO_NOT_USE, Decision.NOT_MONITORED])
def test_only_use_is_taken_in(fly, decision):
    flight = fly()
    tracker = started(flight)
    verdict = IntegrityVerdict(decision, ("residual 40 over 13.8",), 2, 1e-3)
    track = tracker.update(float(flight.times_s[60]), flight.estimates[60], verdict)
    assert not track.taken
    assert track.innovation_p is None
    assert f"not taken in, {decision.value}: residual 40 over 13.8" in track.reason


def test_an_estimate_with_nothing_in_it_is_not_taken_in(fly):
    flight = fly()
    tracker, use, good = started(flight), flight.verdicts[60], flight.estimates[60]
    nan = sf.Pose.trusted(np.full(3, np.nan), good.pose.runway_from_camera)
    unsolved = sf.estimate_pose(good.keypoints, np.zeros((4, 3)), good.camera)
    assert unsolved.pose is None
    for k, (estimate, words) in enumerate([
        (None, "no estimate"), (dataclasses.replace(good, pose=nan), "NaN"),
        (unsolved, unsolved.status.value), (dataclasses.replace(good, jacobian=np.full((8, 6), np.nan)), "NaN"),
    ]):  # fmt: skip
        track = tracker.update(float(flight.times_s[60 + k]), estimate, use)
        assert not track.taken
        assert words in track.reason
        assert np.isfinite(track.cov).all()
    assert feed(tracker, flight, [64])[0].taken


def test_time_that_stands_still(fly):
    flight = fly()
    tracker, now = started(flight), float(flight.times_s[59])
    tracks = [tracker.update(now, flight.estimates[60], flight.verdicts[60]) for _ in range(8)]
    assert not any(track.taken for track in tracks)
    assert "timestamp 1.967 s is not after 1.967 s" in tracks[0].reason
    assert [track.state for track in tracks] == [TRACKING] * 4 + [DEGRADED] * 4
    assert "the timestamps of 5 frames did not advance" in tracks[4].reason
    assert {track.timestamp_s for track in tracks} == {now}
    assert states(feed(tracker, flight, range(68, 75))) == [DEGRADED, TRACKING]


def test_every_frame_twice_harms_nothing(fly):
    flight = fly()
    tracker = Tracker()
    tracks = [feed(tracker, flight, [k, k]) for k in range(30)]
    assert all(track.state is TRACKING and track.taken for track, _ in tracks[4:])
    assert not any(again.taken for _, again in tracks)


def test_time_that_jumps_back(fly):
    flight = fly()
    tracker = started(flight)
    [back] = feed(tracker, flight, [60], shift_s=-0.5)
    assert back.state is TRACKING
    assert not back.taken
    assert "is not after" in back.reason
    assert feed(tracker, flight, [61])[0].taken  # once: a frame that came late
    # For good: the clock was set, and the flight goes on.
    tracks = feed(tracker, flight, range(62, 80), shift_s=-100.0)
    assert states(tracks) == [TRACKING, DEGRADED, LOST, SEARCHING, TRACKING]
    assert any("the clock was set back from 2.033 s to" in track.reason for track in tracks)
    assert next(k for k, t in enumerate(tracks) if k > 3 and t.state is TRACKING) * PERIOD_S < 1.0
    assert tracks[-1].timestamp_s == pytest.approx(float(flight.times_s[79]) - 100.0)


@pytest.mark.parametrize("time_s", [math.nan, math.inf, -math.inf])
def test_a_time_that_is_no_number(fly, time_s):
    flight = fly()
    tracker = Tracker()
    first = tracker.update(time_s, flight.estimates[0], flight.verdicts[0])
    assert first.state is SEARCHING
    json.dumps(first.to_dict(), allow_nan=False)
    tracker = started(flight)
    for _ in range(20):
        assert not tracker.update(time_s, flight.estimates[60], flight.verdicts[60]).taken
    assert tracker.predict(time_s).timestamp_s == pytest.approx(flight.times_s[59])
    assert feed(tracker, flight, [60])[0].taken


# Faults


def _shifted(aside_m):
    """The runway, moved to the left."""
    return sf.Runway(1500.0, 45.0, corners=sf.Runway(1500.0, 45.0).corners + [0.0, aside_m, 0.0])


SHORT = sf.Runway(1500.0 - 184.0, 45.0)


def test_a_far_threshold_misplaced_in_flight_is_refused(fly, moved):
    fault, frames = range(90, 110), len(fly(3000.0).times_s)
    flight = moved(fly(3000.0), fault, SHORT)
    used = [k for k in fault if flight.verdicts[k].decision is Decision.USE]
    jumps = [np.linalg.norm(flight.estimates[k].pose.minus(flight.poses[k])[:3]) for k in used]
    assert len(used) >= 10  # a single frame mostly accepts it
    assert np.median(jumps) > 20
    tracker = started(flight, 90)
    tracks = feed(tracker, flight, fault)
    assert not any(track.taken for track in tracks)
    assert all(tracks[k - 90].innovation_p < 1e-3 for k in used)
    assert all("m from the prediction" in tracks[k - 90].reason for k in used)
    assert states(tracks) == [TRACKING, DEGRADED]
    assert "measurement was taken in for 0.27 s" in next(t.reason for t in tracks if t.state is DEGRADED)
    assert max(off_m(track, flight.poses[k]) for k, track in zip(fault, tracks)) < 0.5 * np.median(jumps)
    back = feed(tracker, flight, range(110, frames))
    assert back[0].taken
    assert [t.state for t in back].index(TRACKING) * PERIOD_S < 1.0
    assert DEGRADED not in states(back)[1:]


def test_refusals_that_agree_do_not_lock_the_track_out(fly, moved):
    # The camera is right, say, and the track was wrong: who knows? No pose then, and a search that has found already.
    flight = moved(fly(), range(90, 180), _shifted(20.0))
    tracker = started(flight, 90)
    tracks = feed(tracker, flight, range(90, 180))
    assert states(tracks) == [TRACKING, DEGRADED, LOST, TRACKING]
    lost = next(k for k, t in enumerate(tracks) if t.state is LOST)
    assert lost * PERIOD_S == pytest.approx(0.75, abs=0.15)
    assert "contradicted by" in tracks[lost].reason
    assert re.search(r"agree among themselves, the last (19\.\d|20|20\.\d) m from the track", tracks[lost].reason)
    assert tracks[lost].pose is None
    assert tracks[lost + 1].taken
    # The camera sees the runway 20 m to the left of where the database has it: it seems 20 m to the right.
    assert tracks[-1].pose.position_m[1] - flight.poses[179].position_m[1] == pytest.approx(-20, abs=1)


def test_refusals_that_disagree_do_not_contradict(fly, moved):
    flight = moved(fly(), range(60, 120), lambda k: _shifted((-1) ** k * (20.0 + k)))
    tracks = feed(started(flight), flight, range(60, 120))
    assert states(tracks) == [TRACKING, DEGRADED]
    assert feed(started(flight), flight, range(120, 130))[0].taken


def test_a_slow_drift_is_a_velocity(fly, moved):
    # Without odometry a measurement that drifts is an aircraft that drifts: not to be seen while it lasts.
    start, end, speed = 60, 210, 3.0
    flight = moved(fly(1500.0, 9.0), range(start, end), lambda k: _shifted((k - start) * PERIOD_S * speed))
    tracker = started(flight, start)
    tracks = feed(tracker, flight, range(start, end))
    assert tracks[-1].state is TRACKING
    assert tracks[-1].pose.position_m[1] - flight.poses[end - 1].position_m[1] == pytest.approx(-15, abs=1)
    # Its end is seen, and a second later all is well.
    after = feed(tracker, flight, range(end, end + 30))
    assert not after[0].taken
    assert after[-1].state is TRACKING
    assert off_m(after[-1], flight.poses[end + 29]) < 3 * np.sqrt(np.trace(after[-1].cov[:3, :3]))


def test_frames_that_lean_one_way_degrade_the_track(fly, moved):
    flight = moved(fly(3000.0), range(180), SHORT)
    tracks = feed(Tracker(TrackerSettings(correlation_time_s=0.1)), flight)
    assert sum(verdict.decision is Decision.USE for verdict in flight.verdicts) > 90  # a single frame mostly accepts it
    assert states(tracks) == [SEARCHING, TRACKING, DEGRADED]
    degraded = next(track for track in tracks if track.state is DEGRADED)
    assert re.match(r"window: the frames of \d\.\d s lean one way, as if .* \(p = .* < 0\.0003\)", degraded.reason)
    assert re.search(r"runway \d+ ± \d+ m shorter", degraded.reason)
    assert "askew" not in degraded.reason  # what does not lean is not named
    assert degraded.pose is not None


def test_doubt_stays_until_there_is_little_reason_for_it(fly, moved):
    # One frame a second: a minute with the fault, two without. Within a minute the window has forgotten.
    flight = fly(3000.0)
    short = moved(flight, range(60), SHORT)
    settings = TrackerSettings(correlation_time_s=0.1)
    watch, said, ranked = _Watch(settings), [], []
    for k in range(180):
        watch.look(float(k), short.estimates[k] if k < 60 else flight.estimates[k])
        said.append(bool(watch.words))
        ranked.append(watch._frames._suspicions()[0].p_value)
    first, last = said.index(True), 179 - said[::-1].index(True)
    assert first < 60 < last < 179
    assert all(said[first : last + 1])  # once
    assert max(ranked[first : last + 1]) > 10 * settings.false_alarm_rate  # it had passed the limit long before
    assert ranked[last + 1] >= 0.05
    assert watch.anew().words == ""


@pytest.mark.parametrize("drift", [True, False], ids=["drifting", "faultless"])
def test_with_a_velocity_a_slow_drift_is_seen(benchmark, drift):
    fault = next(fault for fault in benchmark.FAULTS if bool(fault.drift_mps2) == drift)
    noise = benchmark.Noise(1.0, 2.0, (0.5, 0.5))
    alone, aided = (
        benchmark.watched(np.random.default_rng(4), fault, 1500.0, noise, aid, 5.0) for aid in (False, True)
    )
    assert not alone[:, 2].any()
    assert aided[:, 2].any() == drift
    if drift:
        assert alone[-1, 3] > 100  # followed, as if the aircraft drifted
        seen_s = np.flatnonzero(aided[:, 2])[0] / 5.0
        assert 0.5 * fault.drift_mps2 * seen_s**2 < 50  # m aside by then


@pytest.mark.parametrize("short", [True, False], ids=["short", "right"])
def test_the_window_degrades_the_track_in_its_words(fly, moved, short):
    flight = fly(3000.0, 6.0)
    if short:
        flight = moved(flight, range(len(flight.times_s)), SHORT)
    rng, cov = np.random.default_rng(5), np.diag([0.02**2] * 3 + [1e-4**2] * 3)
    tracker, root = Tracker(TrackerSettings(correlation_time_s=0.1)), np.linalg.cholesky(cov)
    tracks, before = [], flight.poses[0]
    for k, pose in enumerate(flight.poses):
        true = sf.RelativeMotion.between(before, pose, cov)
        step = sf.Pose(true.translation_m, true.earlier_from_later).plus(root @ rng.normal(size=6))
        motion = sf.RelativeMotion(step.position_m, step.runway_from_camera, cov) if k else None
        tracks.append(tracker.update(float(flight.times_s[k]), flight.estimates[k], flight.verdicts[k], motion))
        before = pose
    if short:
        degraded = next(track for track in tracks if track.state is DEGRADED)
        assert degraded.reason.startswith("window: ")
        assert tracker._watch._refusal.startswith("window: residual")
        assert "runway" in degraded.reason
        assert "shorter" in degraded.reason
        assert tracks[-1].state is DEGRADED
        assert tracks[-1].pose is not None
    else:
        assert states(tracks) == [SEARCHING, TRACKING]
        assert tracker._watch._window._held  # it did watch


def test_a_prediction_past_the_runway_refuses(fly):
    flight = fly()
    tracker = Tracker(TrackerSettings(lost_after_s=1000.0, largest_share=1e9))
    feed(tracker, flight, range(60))
    late = tracker.update(100.0, flight.estimates[60], flight.verdicts[60])
    assert not late.taken
    assert "the prediction has the runway behind the camera" in late.reason


# The pose


def test_yaw_past_180_degrees_is_nothing_special(benchmark):
    # From the other end, looking back over the runway: the yaw is about 180 degrees.
    times = np.arange(0, 2, PERIOD_S)
    poses = [
        sf.Pose.from_attitude([1500.0 + 1500 - 70 * t, 5.0, 90.0 - 3.6 * t], 178.0 + 2 * t, -3.0, 1.0) for t in times
    ]
    noise = benchmark.Noise(sigma_px=SHARP)
    estimates, verdicts = benchmark.measure(np.random.default_rng(6), times, poses, noise)
    tracker = Tracker()
    tracks = [tracker.update(float(t), e, v) for t, e, v in zip(times, estimates, verdicts)]
    yaws = [track.pose.attitude.yaw_deg for track in tracks if track.pose is not None]
    assert min(yaws) < -179
    assert max(yaws) > 179
    assert states(tracks) == [SEARCHING, TRACKING]
    assert np.degrees(np.linalg.norm(poses[-1].minus(tracks[-1].pose)[3:])) < 0.2


def test_predict_is_where_it_will_be(fly):
    flight = fly()
    assert Tracker().predict(1.0) is None
    tracker = started(flight)
    now = float(flight.times_s[59])
    at = tracker.predict(now)
    between = tracker.predict(now + 0.4 * PERIOD_S)
    np.testing.assert_allclose(
        between.pose.position_m, at.pose.position_m + 0.4 * PERIOD_S * at.velocity_mps, rtol=1e-12
    )
    assert between.timestamp_s == pytest.approx(now + 0.4 * PERIOD_S)
    assert between.state is TRACKING
    assert not between.taken
    assert np.trace(between.cov[3:6, 3:6]) > np.trace(at.cov[3:6, 3:6])
    later = tracker.predict(now + 1.0)
    assert later.state is DEGRADED
    assert "no measurement for 1.00 s; predicted" in later.reason
    assert off_m(later, flight.poses[89]) < 3 * np.sqrt(np.trace(later.cov[:3, :3]))
    assert tracker.predict(now - 1.0).timestamp_s == now
    assert tracker.predict(now + 3.1) is None
    # Nothing has changed.
    twin = started(flight)
    np.testing.assert_array_equal(
        feed(tracker, flight, [60])[0].pose.position_m, feed(twin, flight, [60])[0].pose.position_m
    )


def test_a_track_as_json(fly):
    flight = fly()
    tracks = feed(Tracker(), flight, range(6)) + [started(flight).update(9.0, None, BLIND)]
    for track in tracks:
        record = json.loads(json.dumps(track.to_dict(), allow_nan=False))
        assert set(record) == {
            "timestamp_s", "state", "reason", "position_m", "velocity_mps", "attitude_deg", "cov", "taken",
            "innovation_p", "coasting_s",
        }  # fmt: skip
        assert record["state"] == track.state.value
        assert (record["cov"] is None) == (track.pose is None)
    assert np.shape(tracks[5].to_dict()["cov"]) == (9, 9)
    assert not tracks[5].pose.position_m.flags.writeable
    assert not tracks[5].cov.flags.writeable


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"acceleration_density": 0.0}, "acceleration_density is 0.0"),
        ({"largest_share": math.nan}, "largest_share is nan"),
        ({"lost_after_s": -1.0}, "lost_after_s is -1.0"),
        ({"correlation_time_s": -1.0}, "correlation_time_s is -1.0"),
        ({"confirmations": 1}, "confirmations is 1"),
        ({"false_alarm_rate": 1.0}, "false_alarm_rate"),
    ],
)
def test_settings_that_make_no_sense_are_refused(given, words):
    with pytest.raises(sf.InputError, match=words):
        TrackerSettings(**given)
