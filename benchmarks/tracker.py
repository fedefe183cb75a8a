"""The tracker on simulated approaches: errors against the single frame's, honesty, false refusals, time a frame.

    python benchmarks/tracker.py [--flights 20] [--seed 1] [--json]

Straight down a 3 degree glide path at 70 m/s, 30 frames a second; the velocity is disturbed by white
acceleration and the attitude by a random walk about a nose-down mean, as the tracker takes them to be.
Keypoints err with 0.5 to 1 px, white, or persisting as a first-order Gauss-Markov process, or both.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.special import chdtri, chndtrinc
from scipy.stats import chi2

import shortfinal as sf
import shortfinal.tracker as tracker_module
from shortfinal.integrity import Decision, IntegrityVerdict
from shortfinal.pose import PoseEstimate, estimate_pose_batch
from shortfinal.tracker import Track, Tracker, TrackerSettings, TrackState
from shortfinal.window import FadingWindow, RelativeMotion

Array = NDArray[np.float64]

CAMERA = sf.Camera(2448, 2648, 3401.6, 3401.6, 1223.5, 1323.5)  # LARD's
RUNWAY = sf.Runway(1500.0, 45.0)
SPEED_MPS, GLIDE_DEG, RATE_HZ = 70.0, 3.0, 30.0


class Flight(NamedTuple):
    """Truth and what was measured of it, frame by frame."""

    times_s: Array  # (N,)
    poses: list[sf.Pose]
    velocities: Array  # (N, 3)
    estimates: list[PoseEstimate]
    verdicts: list[IntegrityVerdict]


@dataclass(frozen=True)
class Noise:
    """How keypoints err: a share of the variance persists for a time, the rest is white."""

    share: float = 0.0
    time_s: float = 0.5
    sigma_px: tuple[float, float] = (0.5, 1.0)  # of each coordinate of each flight, uniform
    spread: float = 0.0  # of log sigma from frame to frame: a network's sigmas are never twice the same
    inflation: float = 1.0  # of the covariance that the estimates are told
    full: bool = False  # the keypoints' errors correlate, differently in each frame


def truth(
    rng: np.random.Generator,
    times_s: Array,
    start_m: float,
    acceleration: float = 0.5,
    turn_deg: float = 0.2,
    steered: bool = False,
    speed_mps: float = SPEED_MPS,
) -> tuple[list[sf.Pose], Array]:
    """Poses and velocities: white acceleration (m/s² per √Hz) and a random walk of the attitude (° per √s).

    The attitude is drawn back to its mean within some ten seconds: else the runway leaves the frame.
    `steered`, the path is drawn back to the glide path as well, at 0.5 rad/s with a damping of 0.7: else
    a whole approach ends far from the runway.
    """
    glide = np.radians(GLIDE_DEG)
    velocity = speed_mps * np.array([np.cos(glide), 0.0, -np.sin(glide)])
    position = np.array([-start_m, rng.normal(0, 10), start_m * np.tan(glide)])
    planned, course = position - [0.0, position[1], 0.0], velocity
    angles = rng.normal(0, 1.0, 3)
    poses, velocities = [], []
    for step in np.diff(times_s, prepend=times_s[0]):
        # Position and velocity of the integral of white noise, exactly.
        kick, slip = rng.normal(size=(2, 3)) * acceleration
        position = position + velocity * step + step**1.5 * (kick / 2 + slip / np.sqrt(12))
        velocity = velocity + kick * np.sqrt(step)
        planned = planned + course * step
        if steered:
            velocity = velocity - step * (0.25 * (position - planned) + 0.7 * (velocity - course))
        angles = angles * np.exp(-step / 10) + turn_deg * np.sqrt(step) * rng.normal(size=3)
        poses.append(sf.Pose.from_attitude(position, angles[0], angles[1] - GLIDE_DEG, angles[2]))
        velocities.append(velocity)
    return poses, np.array(velocities)


def measure(
    rng: np.random.Generator,
    times_s: Array,
    poses: list[sf.Pose],
    noise: Noise,
    image: sf.Runway = RUNWAY,
    runway: sf.Runway = RUNWAY,
    camera: sf.Camera = CAMERA,
) -> tuple[list[PoseEstimate], list[IntegrityVerdict]]:
    """Estimates on `runway` with `CAMERA` of frames that show `image` through `camera`, with their verdicts."""
    count = len(poses)
    unit = rng.normal(size=(count, 8))
    slow = rng.normal(size=8)
    for k, step in enumerate(np.diff(times_s, prepend=times_s[0])):
        fade = np.exp(-step / noise.time_s)
        slow = fade * slow + np.sqrt(1 - fade**2) * rng.normal(size=8)
        unit[k] = np.sqrt(noise.share) * slow + np.sqrt(1 - noise.share) * unit[k]
    sigma = rng.uniform(*noise.sigma_px, 8) * np.exp(noise.spread * rng.normal(size=(count, 8)))
    seen = np.array([sf.project(camera, pose, image.corners) for pose in poses])
    root = sigma[:, :, None] * np.eye(8)
    if noise.full:
        mixed = rng.normal(size=(count, 8, 8))
        mixed /= np.linalg.norm(mixed, axis=2, keepdims=True)
        root = root @ np.linalg.cholesky(0.8 * mixed @ np.swapaxes(mixed, 1, 2) + 0.2 * np.eye(8))
    error, cov = (root @ unit[:, :, None]).reshape(-1, 4, 2), noise.inflation * root @ np.swapaxes(root, 1, 2)
    batch = estimate_pose_batch(seen + error, cov, runway.corners, CAMERA, threads=1)
    estimates = [batch[k] for k in range(count)]
    return estimates, [sf.check_integrity(est) for est in estimates]


def fly(
    rng: np.random.Generator,
    noise: Noise,
    start_m: float = 5000.0,
    seconds: float | None = None,
    rate_hz: float = RATE_HZ,
    **motion: float,
) -> Flight:
    """An approach from `start_m` before the threshold: steered, to 100 m, or as it falls, for `seconds`."""
    times = np.arange(0.0, (start_m - 100.0) / SPEED_MPS if seconds is None else seconds, 1.0 / rate_hz)
    poses, velocities = truth(rng, times, start_m, steered=seconds is None, **motion)
    return Flight(times, poses, velocities, *measure(rng, times, poses, noise))


def track(flight: Flight, settings: TrackerSettings | None = None) -> list[Track]:
    """What the tracker says, frame by frame."""
    tracker = Tracker(settings)
    return [
        tracker.update(float(t), est, verdict)
        for t, est, verdict in zip(flight.times_s, flight.estimates, flight.verdicts, strict=True)
    ]


def error(tracked: Track, pose: sf.Pose, velocity: Array) -> Array:
    """Truth minus track (9,), in the order of its covariance."""
    assert tracked.pose is not None
    assert tracked.velocity_mps is not None
    return np.concatenate([pose.minus(tracked.pose), velocity - tracked.velocity_mps])


@dataclass(frozen=True)
class Honesty:
    """What many short flights say of a tracker's covariance."""

    nees: Array  # (flights, frames) squared error over the covariance: should average 9; NaN without a track
    within: NDArray[np.bool_]  # (flights, 9) at the last frame: each error within 2 sigma
    tested: int  # faultless measurements
    refused: int

    @property
    def end(self) -> Array:
        """NEES (flights,) of the last frames: independent of one another."""
        return self.nees[:, -1]


def honesty(
    noise: Noise,
    settings: TrackerSettings,
    flights: int,
    seed: int,
    start_m: tuple[float, float] = (600.0, 5000.0),
    seconds: float = 3.0,
) -> Honesty:
    """Flights of `seconds` from log-uniform ranges; their motion is drawn as `settings` takes it to be."""
    rng = np.random.default_rng(seed)
    motion = {"acceleration": settings.acceleration_density, "turn_deg": settings.turn_density_deg}
    nees, within, tested, refused = [], [], 0, 0
    for _ in range(flights):
        start = float(np.exp(rng.uniform(*np.log(start_m))))
        flight = fly(rng, noise, start, seconds, **motion)
        tracks, row = track(flight, settings), np.full(len(flight.times_s), np.nan)
        for k, tracked in enumerate(tracks):
            tested += tracked.innovation_p is not None
            refused += tracked.innovation_p is not None and not tracked.taken
            if tracked.cov is not None:
                off = error(tracked, flight.poses[k], flight.velocities[k])
                row[k] = off @ np.linalg.solve(tracked.cov, off)
        nees.append(row)
        within.append(np.abs(off) < 2 * np.sqrt(np.diag(tracked.cov)) if tracked.cov is not None else np.full(9, False))
    return Honesty(np.array(nees), np.array(within), tested, refused)


def nees_bounds(flights: int, risk: float = 1e-3) -> tuple[float, float]:
    """Where the mean of so many independent NEES of 9 degrees of freedom lies but for `risk`."""
    low, high = chi2.ppf([risk / 2, 1 - risk / 2], 9 * flights) / flights
    return float(low), float(high)


NOISES = {
    "white": Noise(0.0),
    "half persists 0.5 s": Noise(0.5),
    "all persists 0.2 s": Noise(1.0, 0.2),
    "all persists 0.5 s": Noise(1.0, 0.5),
    "all persists 0.5 s, sigma changes": Noise(1.0, 0.5, spread=0.4),
    "all persists 2 s": Noise(1.0, 2.0),
    "all persists 10 s": Noise(1.0, 10.0),
}
TIMES_S = (0.0, 0.5, 2.0)  # what the tracker takes the errors' correlation time to be
BINS_M = (5000.0, 3000.0, 2000.0, 1000.0, 500.0, 100.0)


def consistency(flights: int, seed: int) -> list[dict[str, Any]]:
    """Honesty for each noise and each correlation time that the tracker may take it to have."""
    rows = []
    for name, noise in NOISES.items():
        for time_s in TIMES_S:
            found = honesty(noise, TrackerSettings(correlation_time_s=time_s, turn_density_deg=0.2), flights, seed)
            rows.append({
                "noise": name,
                "correlation_time_s": time_s,
                "nees": float(np.nanmean(found.end)),
                "within_2_sigma": float(found.within.mean()),
                "refused": found.refused / found.tested,
            })  # fmt: skip
    return rows


def about_own_estimate(measured: PoseEstimate, position: Array, rotation: Array) -> tuple[Array, Array]:
    """In place of the tracker's rows about the prediction: the estimate with its own covariance."""
    assert measured.pose is not None
    _, root = tracker_module._triangular(measured.jacobian)
    return root @ measured.pose.minus(sf.Pose(position, rotation)), root


def inflation(time_s: float, rate_hz: float = RATE_HZ) -> float:
    """What makes white errors weigh as little, in the long run, as errors that persist so long."""
    fade = float(np.exp(-1.0 / (rate_hz * time_s)))
    return (1.0 + fade) / (1.0 - fade)


def alternatives(flights: int, seed: int) -> list[dict[str, Any]]:
    """What was tried instead: a covariance inflated for the persistence, and rows about the estimate itself."""
    rows = []
    for name, noise, time_s, own in (
        ("white, independent", Noise(), 0.0, False),
        ("white, independent, about own estimate", Noise(), 0.0, True),
        ("persists 0.5 s, as a state", Noise(1.0), 0.5, False),
        ("persists 0.5 s, inflated", Noise(1.0, inflation=inflation(0.5)), 0.0, False),
    ):
        ours = tracker_module._rows
        try:
            tracker_module._rows = about_own_estimate if own else ours
            far = (4000.0, 5000.0)
            settings = TrackerSettings(correlation_time_s=time_s, turn_density_deg=0.2)
            found = honesty(noise, settings, flights, seed, far, seconds=6.0)
        finally:
            tracker_module._rows = ours
        first, last = (float(np.nanmean(found.nees[:, part])) for part in (slice(4, 15), slice(-30, None)))
        within = float(found.within[:, :3].mean())
        rows.append({"tracker": name, "nees_first": first, "nees_last": last, "position_within_2_sigma": within})
    return rows


def turning(settings: TrackerSettings, seed: int, start_m: float = 1000.0) -> tuple[Array, list[Track]]:
    """A turn aside and back, 3 m/s² for 2 s each way at 17° of bank, rolled at 15° a second: errors in sigma.

    Returns them (frames, 9), of the frames with a pose, and the tracks. Keypoints' errors persist for 5 s.
    """
    rng, times = np.random.default_rng(seed), np.arange(0.0, 8.0, 1.0 / RATE_HZ)
    push = 3.0 * (np.where((times > 2) & (times < 4), 1.0, 0.0) - np.where((times > 4) & (times < 6), 1.0, 0.0))
    sideways = np.cumsum(push) / RATE_HZ
    aside, bank, poses = np.cumsum(sideways) / RATE_HZ, 0.0, []
    for t, y, a in zip(times, aside, push, strict=True):
        bank += float(np.clip(-np.degrees(np.arctan(a / 9.81)) - bank, -15.0 / RATE_HZ, 15.0 / RATE_HZ))
        position = [SPEED_MPS * t - start_m, y, (start_m - SPEED_MPS * t) * np.tan(np.radians(GLIDE_DEG))]
        poses.append(sf.Pose.from_attitude(position, 0.0, -GLIDE_DEG, bank))
    level = SPEED_MPS * np.array([1.0, 0.0, -np.tan(np.radians(GLIDE_DEG))])
    velocities = level + np.column_stack([0 * times, sideways, 0 * times])
    flight = Flight(times, poses, velocities, *measure(rng, times, poses, Noise(1.0, 5.0)))
    tracks = track(flight, settings)
    off = [
        error(tracked, pose, velocity) / np.sqrt(np.diag(tracked.cov))
        for tracked, pose, velocity in zip(tracks, poses, velocities, strict=True)
        if tracked.cov is not None
    ]
    return np.array(off), tracks


def manoeuvre(seed: int, flights: int = 4) -> list[dict[str, Any]]:
    """Share of the errors in a turn within 2 sigma, the least of the three axes, by how wild the motion is taken."""
    rows = []
    for q, w in ((0.25, 0.5), (0.5, 1.0), (1.0, 2.0)):
        settings = TrackerSettings(acceleration_density=q, turn_density_deg=w)
        flown = [turning(settings, seed + n) for n in range(flights)]
        within = np.concatenate([np.abs(off) < 2 for off, _ in flown]).mean(axis=0)
        rows.append({
            "acceleration_density": q,
            "turn_density_deg": w,
            "position": float(within[:3].min()),
            "attitude": float(within[3:6].min()),
            "velocity": float(within[6:].min()),
            "refused": sum(t.innovation_p is not None and not t.taken for _, tracks in flown for t in tracks),
        })  # fmt: skip
    return rows


def smallest_jumps(seed: int, time_s: float = 2.0) -> list[dict[str, Any]]:
    """How far (m; along, across, up) a measurement must jump after 2 s of track to be refused in 99 of 100 cases.

    To first order, the attitude staying as it is. With the errors' persistence as a state, and inflated.
    """
    rows = []
    for distance in (3000.0, 1500.0, 700.0):
        row: dict[str, Any] = {"distance_m": distance}
        for name, taken_s, factor in (("state", time_s, 1.0), ("inflated", 0.0, inflation(time_s))):
            noise = Noise(1.0, time_s, inflation=factor)
            flight = fly(np.random.default_rng(seed), noise, distance + 2.0 * SPEED_MPS, 2.05)
            tracker = Tracker(TrackerSettings(correlation_time_s=taken_s))
            for t, est, verdict in zip(flight.times_s, flight.estimates, flight.verdicts, strict=True):
                tracker.update(float(t), est, verdict)
            belief = tracker._belief
            assert belief is not None
            belief = tracker_module._advance(belief, belief.timestamp_s + 1.0 / RATE_HZ, tracker.settings)
            seen = tracker_module._rows(flight.estimates[-1], belief.position, belief.rotation)
            assert seen is not None
            effect = np.hstack([seen[1], np.zeros((6, 3)), np.eye(6)])
            spread = effect @ belief.cov @ effect.T + np.eye(6)
            needed = chndtrinc(chdtri(6, tracker.settings.false_alarm_rate), 6, 0.01)
            unit = np.diag(seen[1].T @ np.linalg.solve(spread, seen[1]))[:3]
            row[name] = np.sqrt(needed / unit).tolist()
        rows.append(row)
    return rows


def endurance(flights: int, seed: int) -> list[dict[str, Any]]:
    """Share of errors within 2 sigma along whole approaches, ten frames a second: of position, and of all."""
    rows = []
    for time_s in (0.5, 2.0, 5.0, 20.0):
        rng = np.random.default_rng(seed)
        flown = [fly(rng, Noise(1.0, time_s), rate_hz=10.0) for _ in range(flights)]
        for taken_s in (0.5, 2.0, 5.0):
            within = []
            for flight in flown:
                tracks = track(flight, TrackerSettings(correlation_time_s=taken_s))
                for tracked, pose, velocity in list(zip(tracks, flight.poses, flight.velocities, strict=True))[5::10]:
                    if tracked.cov is not None:
                        within.append(np.abs(error(tracked, pose, velocity)) < 2 * np.sqrt(np.diag(tracked.cov)))
            share = np.mean(within, axis=0)
            rows.append({
                "persists_s": time_s,
                "correlation_time_s": taken_s,
                "position": float(share[:3].mean()),
                "least": float(share.min()),
                "all": float(share.mean()),
            })  # fmt: skip
    return rows


@dataclass(frozen=True)
class Fault:
    """What is not as it is taken to be, all along the approach."""

    name: str
    longer_m: float = 0.0  # of the runway in the image
    focal: float = 1.0
    drift_mps2: float = 0.0  # the measured position moves aside, so much faster every second


FAULTS = (
    Fault("none"),
    Fault("far threshold 184 m short", longer_m=-184.0),
    Fault("focal length 3 % long", focal=1.03),
    Fault("drift aside, 0.2 m/s faster a second", drift_mps2=0.2),
)
WATCHED_M, WATCHED_MPS = (3000.0, 300.0), 65.0
# What an aid errs by when summed, of each axis: 0.2 m/s and 0.12 degrees over 6 s.
VELOCITY_WALK, TURN_WALK_DEG = 0.5, 0.05  # m and degrees per √s


def watched(rng: np.random.Generator, fault: Fault, length_m: float, noise: Noise, aid: bool, rate_hz: float) -> Array:
    """An approach with a fault from 3 km to 300 m, frame by frame: distance (m), whether the track is TRACKING,
    whether the window says why not, and the error of its position (m; NaN without one).

    `aid`: a velocity in the runway's axes comes with each frame, as GNSS measures it, turned into the camera's
    by the frame's own attitude; and a gyro's turn.
    """
    start, end = WATCHED_M
    times = np.arange(0.0, (start - end) / WATCHED_MPS, 1.0 / rate_hz)
    poses, _ = truth(rng, times, start, steered=True, speed_mps=WATCHED_MPS)
    aside = 0.5 * fault.drift_mps2 * times**2
    shown = [pose.plus([0, y, 0, 0, 0, 0]) for pose, y in zip(poses, aside, strict=True)]
    image, runway = (sf.Runway(length_m + more, 45.0) for more in (fault.longer_m, 0.0))
    camera = replace(CAMERA, fx=fault.focal * CAMERA.fx, fy=fault.focal * CAMERA.fy)
    estimates, verdicts = measure(rng, times, shown, noise, image, runway, camera)
    cov = np.diag([VELOCITY_WALK**2 / rate_hz] * 3 + [np.radians(TURN_WALK_DEG) ** 2 / rate_hz] * 3)
    tracker, rows = Tracker(), []
    for k, t in enumerate(times):
        motion = None
        if aid and k:
            before, errors = poses[k - 1], np.sqrt(np.diag(cov)) * rng.normal(size=6)
            turned = before.runway_from_camera.T @ poses[k].plus([0, 0, 0, *errors[3:]]).runway_from_camera
            attitude = (estimates[k - 1].pose or before).runway_from_camera
            moved = poses[k].position_m - before.position_m + errors[:3]
            motion = RelativeMotion(attitude.T @ moved, turned, cov)
        tracked = tracker.update(float(t), estimates[k], verdicts[k], motion)
        off = np.nan if tracked.pose is None else float(np.linalg.norm(tracked.pose.position_m - poses[k].position_m))
        said = tracked.state is TrackState.DEGRADED and tracked.reason.startswith("window")
        rows.append([-poses[k].position_m[0], tracked.state is TrackState.TRACKING, said, off])
    return np.array(rows, np.float64)


def watching(flights: int, seed: int, rate_hz: float = 5.0) -> list[dict[str, Any]]:
    """Share of approaches on which the window has degraded the track by then, and on which anything has."""
    rows = []
    for length, sigma, aid in product((1500.0, 3000.0), (0.3, 0.8), (False, True)):
        for fault in FAULTS:
            rng, noise = np.random.default_rng(seed), Noise(1.0, 2.0, (sigma, sigma))
            flown = [watched(rng, fault, length, noise, aid, rate_hz) for _ in range(flights)]
            row: dict[str, Any] = {"fault": fault.name, "length_m": length, "sigma_px": sigma, "velocity": aid}
            for name, column in (("window", 2), ("any", None)):
                row[name] = [
                    float(np.mean([_seen(one, column)[one[:, 0] >= near].any() for one in flown]))
                    for near in WATCHED_AT_M
                ]
            row["unseen_error_m"] = float(np.median([_worst_unseen(one) for one in flown]))
            rows.append(row)
    return rows


WATCHED_AT_M = (2000.0, 1000.0, 500.0, 300.0)


def _seen(flown: Array, column: int | None) -> NDArray[np.bool_]:
    """Frames in which the window speaks; or, once there was a track, in which it is not TRACKING."""
    if column is not None:
        return np.asarray(flown[:, column] > 0)
    began = np.flatnonzero(flown[:, 1])
    return np.asarray(flown[:, 1] == 0) & (np.arange(len(flown)) > (began[0] if len(began) else len(flown)))


def _worst_unseen(flown: Array) -> float:
    """Largest error of position (m) within 1 km while TRACKING; 0 if it never is."""
    near = flown[(flown[:, 0] < 1000.0) & (flown[:, 1] > 0), 3]
    return float(near.max()) if len(near) else 0.0


def alarms(flights: int, seed: int, rate: float = 0.01) -> list[dict[str, Any]]:
    """Share of faultless approaches that the window of residuals, told 2 s, suspects: at their end, and at any time.

    Twice a second, on a 1,500 m runway; at `rate`, large enough to count, and at any time at a tenth of it.
    """
    start, end = WATCHED_M
    times = np.arange(0.0, (start - end) / WATCHED_MPS, 0.5)
    rows = []
    for (share, time_s, spread), full in product(((1, 2, 0), (1, 2, 0.4), (0.5, 0.5, 0), (1, 10, 0)), (False, True)):
        rng, least = np.random.default_rng(seed), []
        for _ in range(flights):
            poses, _ = truth(rng, times, start, steered=True, speed_mps=WATCHED_MPS)
            estimates, verdicts = measure(rng, times, poses, Noise(share, time_s, spread=spread, full=full))
            window = FadingWindow(2.0)
            p = [
                window.push(float(t), est)[0].p_value
                for t, est, verdict in zip(times, estimates, verdicts, strict=True)
                if verdict.decision is Decision.USE
            ]
            least.append((p[-1], min(p)))
        suspected = np.array(least) * len(window.suspects)
        rows.append({
            "share": share, "persists_s": time_s, "spread": spread, "full": full, "rate": rate,
            "end": float(np.mean(suspected[:, 0] < rate)),
            "any": float(np.mean(suspected[:, 1] < rate)),
            "any_at_a_tenth": float(np.mean(suspected[:, 1] < 0.1 * rate)),
        })  # fmt: skip
    return rows


def accuracy(flights: int, seed: int) -> list[dict[str, Any]]:
    """RMS errors of position (along, across, up; m), filtered and not, by distance, on whole approaches."""
    rows = []
    for name in ("white", "all persists 0.5 s"):
        rng = np.random.default_rng(seed)
        flown = [fly(rng, NOISES[name]) for _ in range(flights)]
        for time_s in TIMES_S:
            off, distance = [], []
            for flight in flown:
                for k, tracked in enumerate(track(flight, TrackerSettings(correlation_time_s=time_s))):
                    own, truth_m = flight.estimates[k].pose, flight.poses[k].position_m
                    if tracked.pose is not None and own is not None:
                        off.append([own.position_m - truth_m, tracked.pose.position_m - truth_m])
                        distance.append(-truth_m[0])
            squared, range_m = np.square(off), np.array(distance)
            for far, near in pairwise(BINS_M):
                single, filtered = np.sqrt(squared[(range_m <= far) & (range_m > near)].mean(axis=0))
                rows.append({
                    "noise": name,
                    "correlation_time_s": time_s,
                    "from_m": far,
                    "to_m": near,
                    "single_m": single.tolist(),
                    "filtered_m": filtered.tolist(),
                    "factor": (single / filtered).tolist(),
                })  # fmt: skip
    return rows


def speed(seed: int) -> dict[str, float]:
    """Microseconds of one update."""
    flight, taken = fly(np.random.default_rng(seed), Noise(), 2000.0, 20.0), []
    for _ in range(3):
        tracker = Tracker()
        for t, est, verdict in zip(flight.times_s, flight.estimates, flight.verdicts, strict=True):
            begin = time.perf_counter()
            tracker.update(float(t), est, verdict)
            taken.append(1e6 * (time.perf_counter() - begin))
    return {f"p{share}": float(np.percentile(taken, share)) for share in (5, 50, 95)}


def _print(record: dict[str, Any]) -> None:
    console = Console(width=120)
    table = Table("keypoints' errors", "taken to persist s", "NEES of 9", "within 2 σ", "refused")
    for row in record["consistency"]:
        figures = (f"{row['nees']:.2f}", f"{row['within_2_sigma']:.1%}", f"{row['refused']:.2%}")
        table.add_row(row["noise"], f"{row['correlation_time_s']:g}", *figures)
    low, high = nees_bounds(record["flights"])
    console.print(table)
    console.print(f"NEES of an exact covariance: {low:.2f} to {high:.2f} (99.9 %)")
    table = Table("4 to 5 km out", "NEES of 9, first half second", "of the sixth second", "position within 2 σ")
    for row in record["alternatives"]:
        figures = (f"{row['nees_first']:.2f}", f"{row['nees_last']:.2f}", f"{row['position_within_2_sigma']:.1%}")
        table.add_row(row["tracker"], *figures)
    console.print(table)
    table = Table("q", "w", "in a turn, position within 2 σ", "attitude", "velocity", "refused")
    for row in record["turn"]:
        shares = (f"{row[key]:.1%}" for key in ("position", "attitude", "velocity"))
        table.add_row(f"{row['acceleration_density']:g}", f"{row['turn_density_deg']:g}", *shares, str(row["refused"]))
    console.print(table)
    table = Table("m", "jump refused with 99 %: along, across, up", "with an inflated covariance")
    for row in record["jumps"]:
        jumps = (" ".join(f"{x:.3g}" for x in row[key]) for key in ("state", "inflated"))
        table.add_row(f"{row['distance_m']:.0f}", *jumps)
    console.print(table)
    table = Table("persists s", "taken to persist s", "position within 2 σ", "all", "least of 9")
    for row in record["endurance"]:
        shares = (f"{row[key]:.1%}" for key in ("position", "all", "least"))
        table.add_row(f"{row['persists_s']:g}", f"{row['correlation_time_s']:g}", *shares)
    console.print(table)
    table = Table(
        "share", "persists s", "σ changes by", "full Σ", "suspected at 1 %: at the end, ever", "ever at 0.1 %"
    )
    for row in record["alarms"]:
        found = f"{row['end']:.2%} {row['any']:.2%}", f"{row['any_at_a_tenth']:.2%}"
        setting = (f"{row['share']:g}", f"{row['persists_s']:g}", f"{row['spread']:g}", "yes" if row["full"] else "-")
        table.add_row(*setting, *found)
    console.print(table)
    table = Table("fault", "runway m", "σ px", "velocity", "window: by 2, 1, 0.5, 0.3 km", "not tracking", "unseen m")
    for row in record["watching"]:
        shares = (" ".join(f"{x:.0%}" for x in row[key]) for key in ("window", "any"))
        given = f"{row['length_m']:.0f}", f"{row['sigma_px']:g}", "yes" if row["velocity"] else "-"
        table.add_row(row["fault"], *given, *shares, f"{row['unseen_error_m']:.3g}")
    console.print(table)
    table = Table("keypoints' errors", "taken to persist s", "m", "single: along, across, up", "filtered", "factor")
    for row in record["accuracy"]:
        metres = (" ".join(f"{x:.3g}" for x in row[key]) for key in ("single_m", "filtered_m", "factor"))
        table.add_row(row["noise"], f"{row['correlation_time_s']:g}", f"{row['from_m']:.0f}-{row['to_m']:.0f}", *metres)
    console.print(table)
    console.print("µs an update: " + ", ".join(f"{k} {v:.0f}" for k, v in record["speed"].items()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--flights", type=int, default=100)
    parser.add_argument("--approaches", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")
    given = parser.parse_args()
    record = {
        "flights": given.flights,
        "speed": speed(given.seed),
        "consistency": consistency(given.flights, given.seed),
        "alternatives": alternatives(given.flights // 2, given.seed),
        "jumps": smallest_jumps(given.seed),
        "turn": manoeuvre(given.seed),
        "endurance": endurance(2 * given.approaches, given.seed),
        "alarms": alarms(4 * given.flights, given.seed),
        "watching": watching(2 * given.approaches, given.seed),
        "accuracy": accuracy(given.approaches, given.seed),
    }
    if given.json:
        print(json.dumps(record, indent=1))
    else:
        _print(record)


if __name__ == "__main__":
    main()
