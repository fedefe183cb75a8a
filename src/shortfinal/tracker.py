"""Pose and velocity over time: an error-state filter over single-frame estimates, with honest states.

The state is a pose, a velocity, and the part of the measurements' error that persists from frame to
frame. Increments are the solver's own (`Pose.plus`). A measurement is what the solver solved, its
whitened rows taken anew about the prediction: about its own estimate the range and its weight err
together, and their mean is biased (docs/tracking.md). Frames, axes and units: the table of
conventions in docs/architecture.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from shortfinal.errors import InputError
from shortfinal.geometry import Pose, frozen, log_kernel, project_kernel, so3_exp
from shortfinal.integrity import FALSE_ALARM_RATE, Decision, IntegrityVerdict, check_rate
from shortfinal.pose import PoseEstimate, SolverStatus
from shortfinal.window import FadingWindow, IntegrityWindow, RelativeMotion

Array = NDArray[np.float64]

VELOCITY_SIGMA_MPS = 100.0  # of each axis, about rest, before anything was measured
# Frames of the odometry's window are so many correlation times apart: errors then correlate by 5 %.
WINDOW_SPACING = 3.0
WINDOW_LENGTH = 20  # frames
RELIEF_P = 0.05  # of the most suspicious fault, from which on the frames' residuals are in doubt no more

_POSE, _VELOCITY, _ERROR = slice(0, 6), slice(6, 9), slice(9, 15)
_POSITION, _TURN = slice(0, 3), slice(3, 6)
_EYE = np.eye(15)


class TrackState(Enum):
    """What there is of a track."""

    SEARCHING = "searching"  # none: waiting for measurements that agree
    TRACKING = "tracking"  # measurements are taken in
    DEGRADED = "degraded"  # carried on by the motion model, or contradicted; covariance grows
    LOST = "lost"  # given up: no pose


@dataclass(frozen=True)
class TrackerSettings:
    """What the tracker takes the motion and the errors to be; docs/tracking.md says why these defaults.

    Raises InputError for a density, a share or a time that is not positive (the correlation time may
    be zero), a rate outside (0, 1), or fewer than two confirmations.
    """

    acceleration_density: float = 1.0  # m/s² per √Hz, of each axis: white
    turn_density_deg: float = 2.0  # degrees per √s, of each axis: a random walk
    correlation_time_s: float = 2.0  # for which measurements' errors persist; 0: independent from frame to frame
    false_alarm_rate: float = FALSE_ALARM_RATE  # share of faultless measurements that may be refused
    confirmations: int = 5  # measurements in a row that start a track, or end its degradation
    degraded_after_s: float = 0.25  # without a measurement
    contradicted_after_s: float = 0.75  # of measurements that agree among themselves, not with the track: it is lost
    lost_after_s: float = 3.0  # without a measurement; also for how long a search is remembered
    largest_share: float = 0.2  # of the distance to the runway, that the position's sigma may reach

    def __post_init__(self) -> None:
        check_rate(self.false_alarm_rate, "false_alarm_rate")
        for name in (
            "acceleration_density", "turn_density_deg", "degraded_after_s", "contradicted_after_s", "lost_after_s",
            "largest_share", "correlation_time_s",
        ):  # fmt: skip
            value = getattr(self, name)
            if not (math.isfinite(value) and (value > 0 or (value == 0 and name == "correlation_time_s"))):
                raise InputError(f"tracker: {name} is {value}; it must be finite and positive")
        if self.confirmations < 2:
            raise InputError(f"tracker: confirmations is {self.confirmations}; it takes two measurements to agree")


@dataclass(frozen=True, eq=False)
class Track:
    """What is known at `timestamp_s`. Without a track (SEARCHING, LOST) the numbers are None."""

    timestamp_s: float  # of the last frame whose time advanced; minus infinity before any
    state: TrackState
    reason: str  # why this state, and what came of this frame
    pose: Pose | None
    velocity_mps: Array | None  # (3,) of the camera, runway frame
    cov: Array | None  # (9, 9): position (m, runway frame), local rotation (rad), velocity (m/s)
    taken: bool  # whether this frame's measurement was taken in
    innovation_p: float | None  # of the innovation test; None where nothing was tested
    coasting_s: float  # since the last measurement that was taken in; before any, since the first frame

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; what is not known is None. Metres, m/s, degrees; `cov` as it is."""
        return {
            "timestamp_s": self.timestamp_s if math.isfinite(self.timestamp_s) else None,
            "state": self.state.value,
            "reason": self.reason,
            "position_m": None if self.pose is None else self.pose.position_m.tolist(),
            "velocity_mps": None if self.velocity_mps is None else self.velocity_mps.tolist(),
            "attitude_deg": None if self.pose is None else list(self.pose.attitude),
            "cov": None if self.cov is None else self.cov.tolist(),
            "taken": self.taken,
            "innovation_p": self.innovation_p,
            "coasting_s": self.coasting_s,
        }


class Tracker:
    """A track of one camera over one runway, frame after frame.

    `update` takes each frame's estimate and verdict; only estimates with verdict USE are taken in,
    and of those only what the prediction does not contradict. Nothing that comes with a frame raises:
    what cannot be used is refused with its reason. For another camera, make another tracker.
    An estimate must not rest on the track itself (a prior from `predict`); an `initial` may.
    """

    def __init__(self, settings: TrackerSettings | None = None) -> None:
        self.settings = settings or TrackerSettings()
        self._state, self._why = TrackState.SEARCHING, "no measurement yet"
        self._belief: _Belief | None = None  # the track
        self._candidate: _Candidate | None = None  # for a track: what is found in a search, or what contradicts
        self._watch = _Watch(self.settings)
        self._time_s = self._stale_s = -math.inf  # of the last frame; of the last one out of order
        self._taken_s = 0.0  # the last measurement taken in; before any, the first frame
        self._in_a_row = self._stale = self._rewound = 0  # frames: taken; out of order; of those, running forward

    def predict(self, timestamp_s: float) -> Track | None:
        """Where the camera should be at `timestamp_s`; None while there is no track, or too old a one.

        A time that is not after the last frame's is answered with the last frame's. Changes nothing.
        """
        belief = self._belief
        if belief is None:
            return None
        if math.isfinite(timestamp_s) and timestamp_s > belief.timestamp_s:
            belief = _advance(belief, timestamp_s, self.settings)
        coasting = belief.timestamp_s - self._taken_s
        if coasting > self.settings.lost_after_s or self._vague(belief):
            return None
        state, why = self._state, self._why
        if state is TrackState.TRACKING and coasting > self.settings.degraded_after_s:
            state, why = TrackState.DEGRADED, f"no measurement for {coasting:.2f} s"
        return _track(belief, state, f"{why}; predicted", False, None, coasting)

    def update(
        self,
        timestamp_s: float,
        estimate: PoseEstimate | None,
        verdict: IntegrityVerdict,
        motion: RelativeMotion | None = None,
    ) -> Track:
        """The track with this frame.

        What the frames leave over is watched by a `FadingWindow`. `motion` is what odometry measured since
        the last update, independently of the frames; from the first one on an `IntegrityWindow` watches as
        well. While either refuses, the track is degraded.
        """
        if not (math.isfinite(timestamp_s) and timestamp_s > self._time_s):
            return self._out_of_order(timestamp_s)
        if self._time_s == -math.inf:
            self._taken_s = timestamp_s
        self._time_s, self._stale, self._rewound = timestamp_s, 0, 0
        self._watch.move(motion)
        measured, words = _usable(estimate, verdict)
        if self._belief is not None:
            return self._follow(timestamp_s, self._belief, measured, words)
        return self._search(timestamp_s, measured, words)

    def restart(self, why: str) -> None:
        """Give up the track, and any search, for a reason from outside: poses will be of another runway."""
        self._lose(why)

    def _follow(self, now: float, belief: _Belief, measured: PoseEstimate | None, words: str) -> Track:
        limits, coasting = self.settings, now - self._taken_s
        if coasting > limits.lost_after_s:
            self._lose(f"no measurement was taken in for {coasting:.2f} s (limit {limits.lost_after_s:g} s)")
            if measured is not None:
                words = self._propose(now, measured)
            return self._report(words)
        belief, taken, p = _advance(belief, now, limits), False, None
        if measured is not None:
            tested = _correct(belief, measured)
            p = tested.p_value
            taken = p >= limits.false_alarm_rate
            if taken:
                belief, words = tested.belief, f"measurement taken in (p = {p:.2g})"
                self._taken_s, coasting, self._candidate = now, 0.0, None
                self._watch.look(now, measured)
            else:
                words = f"measurement refused: {tested.words} (p = {p:.1g} < {limits.false_alarm_rate:.1g})"
                self._propose(now, measured)
        self._belief, self._in_a_row = belief, self._in_a_row + 1 if taken else 0
        end, rival = self._end(now, belief), self._candidate
        if end:
            self._lose(end)
            self._candidate = rival  # measurements that agree need not do so once more
        else:
            self._judge(coasting)
        return self._report(words, taken, p)

    def _end(self, now: float, belief: _Belief) -> str:
        """Why the track must be given up; nothing if it goes on."""
        rival, limits = self._candidate, self.settings
        if rival is not None and rival.confirmed(limits) and now - rival.since_s >= limits.contradicted_after_s:
            apart = float(np.linalg.norm(rival.belief.position - belief.position))
            return (
                f"contradicted by {rival.agreed} measurements over {now - rival.since_s:.2f} s that agree among "
                f"themselves, the last {apart:.3g} m from the track"
            )
        return self._vague(belief)

    def _vague(self, belief: _Belief) -> str:
        """Whether the position is too uncertain to be of use, in words."""
        distance, share = belief.distance_m, self.settings.largest_share
        if belief.sigma_m <= share * distance:
            return ""
        return f"the position's sigma is {belief.sigma_m:.3g} m, over {share:.0%} of the distance ({distance:.4g} m)"

    def _judge(self, coasting: float) -> None:
        """TRACKING or DEGRADED, each held until there is reason enough for the other."""
        limits, doubt = self.settings, self._watch.words
        if self._state is TrackState.TRACKING and (doubt or coasting > limits.degraded_after_s):
            self._state = TrackState.DEGRADED
            self._why = doubt or f"no measurement was taken in for {coasting:.2f} s"
        elif self._state is TrackState.DEGRADED and not doubt and self._in_a_row >= limits.confirmations:
            self._state, self._why = TrackState.TRACKING, f"{self._in_a_row} measurements in a row were taken in"

    def _search(self, now: float, measured: PoseEstimate | None, words: str) -> Track:
        if measured is None:
            return self._report(words)
        if self._state is TrackState.LOST:
            self._state, self._why = TrackState.SEARCHING, f"measurements are back (lost: {self._why})"
        words, found = self._propose(now, measured), self._candidate
        if found is None or not found.confirmed(self.settings):
            return self._report(words)
        obstacle = self._vague(found.belief)
        if obstacle:
            return self._report(f"{words}, but {obstacle}")
        self._belief, self._candidate, self._taken_s, self._in_a_row = found.belief, None, now, found.agreed
        self._state = TrackState.TRACKING
        self._why = f"{found.agreed} measurements in {now - found.since_s:.2f} s agree"
        return self._report("measurement taken in", True, found.p_value)

    def _propose(self, now: float, measured: PoseEstimate) -> str:
        """Goes on with the candidate for a track, or begins another; which, in words."""
        held, limits = self._candidate, self.settings
        words = "the first measurement of a search"
        if held is not None and now - held.belief.timestamp_s <= limits.lost_after_s:
            tested = _correct(_advance(held.belief, now, limits), measured)
            late = now - held.since_s > limits.lost_after_s and not held.confirmed(limits)
            if tested.p_value >= limits.false_alarm_rate and not late:
                self._candidate = _Candidate(tested.belief, held.since_s, held.agreed + 1, tested.p_value)
                return f"measurement {held.agreed + 1} of {limits.confirmations} that agree"
            words += f", as {'the last took too long' if late else tested.words}"
        self._candidate = _Candidate(_begin(now, measured, limits), now, 1, 1.0)
        return words

    def _out_of_order(self, timestamp_s: float) -> Track:
        """A time that stands still or runs back: the frame is not taken in. A clock that was set back and
        runs on from there is a new beginning.
        """
        self._stale += 1
        self._rewound = self._rewound + 1 if timestamp_s > self._stale_s else 0
        self._stale_s = timestamp_s
        words = f"timestamp {timestamp_s:.3f} s is not after {self._time_s:.3f} s: frame not taken in"
        self._watch.move(None)
        if self._rewound >= self.settings.confirmations and math.isfinite(timestamp_s):
            self._lose(f"the clock was set back from {self._time_s:.3f} s to {timestamp_s:.3f} s")
            self._time_s = self._taken_s = timestamp_s
        elif self._state is TrackState.TRACKING and self._stale >= self.settings.confirmations:
            self._state, self._why = TrackState.DEGRADED, f"the timestamps of {self._stale} frames did not advance"
            self._in_a_row = 0
        return self._report(words)

    def _lose(self, why: str) -> None:
        self._state, self._why = TrackState.LOST, why
        self._belief, self._candidate, self._in_a_row = None, None, 0
        self._watch = self._watch.anew()

    def _report(self, words: str, taken: bool = False, p: float | None = None) -> Track:
        reason = f"{self._why}; this frame: {words}"
        coasting = max(self._time_s - self._taken_s, 0.0)
        if self._belief is None:
            return Track(self._time_s, self._state, reason, None, None, None, taken, p, coasting)
        return _track(self._belief, self._state, reason, taken, p, coasting)


class _Watch:
    """What measurements that were taken in show only together: of their residuals, and against odometry."""

    def __init__(self, settings: TrackerSettings, odometry: bool = False) -> None:
        self._settings, self._spacing_s = settings, WINDOW_SPACING * settings.correlation_time_s
        self._frames, self._doubt, self._since_s = FadingWindow(settings.correlation_time_s), "", math.inf
        # With odometry: measurements so far apart that each errs on its own.
        self._window = IntegrityWindow(WINDOW_LENGTH, settings.false_alarm_rate) if odometry else None
        self._refusal, self._looked_s = "", -math.inf
        self._moved: RelativeMotion | None = None  # since the last look
        self._fresh = True  # no motion since the last look

    @property
    def words(self) -> str:
        """Why the track is in doubt; nothing if it is not."""
        return self._doubt or self._refusal

    def anew(self) -> _Watch:
        """One that has seen nothing yet."""
        return _Watch(self._settings, self._window is not None)

    def move(self, motion: RelativeMotion | None) -> None:
        """The motion since the last call; None: unknown. With the first one, the watch over odometry begins."""
        if self._window is None and motion is not None:
            self._window = IntegrityWindow(WINDOW_LENGTH, self._settings.false_alarm_rate)
        elif self._fresh:
            self._moved = motion
        else:
            self._moved = None if self._moved is None or motion is None else self._moved.then(motion)
        self._fresh = self._window is None

    def look(self, now: float, measured: PoseEstimate) -> None:
        self._since_s = min(self._since_s, now)
        ranked, rate = self._frames.push(now, measured), self._settings.false_alarm_rate
        best, share = ranked[0], rate / len(ranked)
        if best.p_value < share:
            named = ", or ".join(str(suspicion) for suspicion in ranked if suspicion.p_value < RELIEF_P)
            self._doubt = (
                f"window: the frames of {now - self._since_s:.1f} s lean one way, as if {named} "
                f"(p = {best.p_value:.1g} < {share:.1g})"
            )
        elif best.p_value >= RELIEF_P:
            self._doubt = ""
        if self._window is not None and now - self._looked_s >= self._spacing_s:
            verdict = self._window.push(measured, self._moved)
            self._looked_s, self._fresh = now, True
            if verdict.decision is not Decision.NOT_MONITORED:
                self._refusal = "" if verdict.decision is Decision.USE else f"window: {'; '.join(verdict.reasons)}"


class _Belief(NamedTuple):
    """The state at a time: a pose, a velocity, the persisting error, and their covariance.

    `error` is the part of the last measurements' error that persists, whitened: in units of its own
    standard deviation, in the order of `_rows`.
    """

    timestamp_s: float
    position: Array  # (3,)
    rotation: Array  # (3, 3) runway_from_camera
    velocity: Array  # (3,)
    error: Array  # (6,)
    cov: Array  # (15, 15)
    points: Array  # (K, 3) of the runway, to tell the distance

    @property
    def sigma_m(self) -> float:
        return math.sqrt(self.cov[0, 0] + self.cov[1, 1] + self.cov[2, 2])

    @property
    def distance_m(self) -> float:
        return math.sqrt(float(((self.points - self.position) ** 2).sum(axis=1).min()))


class _Candidate(NamedTuple):
    """A track to be: so many measurements in a row that agree."""

    belief: _Belief
    since_s: float
    agreed: int
    p_value: float  # of the last

    def confirmed(self, settings: TrackerSettings) -> bool:
        return self.agreed >= settings.confirmations


class _Tested(NamedTuple):
    """A measurement held against the prediction, and the belief if it is taken in."""

    belief: _Belief
    p_value: float
    words: str  # how far they are apart


def _usable(estimate: PoseEstimate | None, verdict: IntegrityVerdict) -> tuple[PoseEstimate | None, str]:
    """The estimate if it may be taken in; else None and why not."""
    if verdict.decision is not Decision.USE:
        return None, f"not taken in, {verdict.decision.value}: {'; '.join(verdict.reasons)}"
    if estimate is None or estimate.pose is None or estimate.status is not SolverStatus.CONVERGED:
        return None, "not taken in: no estimate" + (f", {estimate.status.value}" if estimate is not None else "")
    numbers = (estimate.pose.position_m, estimate.pose.runway_from_camera, estimate.residual, estimate.jacobian)
    if not all(np.isfinite(each).all() for each in numbers):
        return None, "not taken in: the estimate holds NaN or infinity"
    return estimate, ""


def _persisting(settings: TrackerSettings) -> float:
    """Variance of the persisting error, in units of the stated one."""
    return 1.0 if settings.correlation_time_s > 0 else 0.0


def _begin(now: float, measured: PoseEstimate, settings: TrackerSettings) -> _Belief:
    """The belief from one measurement alone: its own pose, and no idea of the velocity.

    U (truth - estimate) = -(persisting error + white error).
    """
    assert measured.pose is not None  # as it is usable
    _, root = _triangular(measured.jacobian)
    spread = np.linalg.inv(root)
    cov, share = np.zeros((15, 15)), _persisting(settings)
    cov[_POSE, _POSE] = (1.0 + share) * spread @ spread.T
    cov[_VELOCITY, _VELOCITY] = VELOCITY_SIGMA_MPS**2 * np.eye(3)
    cov[_ERROR, _ERROR] = share * np.eye(6)
    cov[_POSE, _ERROR] = -share * spread
    cov[_ERROR, _POSE] = -share * spread.T
    pose, rest = measured.pose, frozen(np.zeros(3))
    return _Belief(now, pose.position_m, pose.runway_from_camera, rest, np.zeros(6), cov, measured.points)


def _advance(belief: _Belief, now: float, settings: TrackerSettings) -> _Belief:
    """Carried on to a later time: constant velocity, constant attitude, an error that fades."""
    dt, tau = now - belief.timestamp_s, settings.correlation_time_s
    fade = math.exp(-dt / tau) if tau > 0 else 0.0
    step = _EYE.copy()
    step[0, 6] = step[1, 7] = step[2, 8] = dt
    step[_ERROR, _ERROR] *= fade
    cov = step @ belief.cov @ step.T
    density, turn = settings.acceleration_density**2, math.radians(settings.turn_density_deg) ** 2
    for axis in range(3):
        cov[axis, axis] += density * dt**3 / 3.0
        cov[axis, axis + 6] += density * dt**2 / 2.0
        cov[axis + 6, axis] += density * dt**2 / 2.0
        cov[axis + 6, axis + 6] += density * dt
        cov[axis + 3, axis + 3] += turn * dt
    cov[range(9, 15), range(9, 15)] += _persisting(settings) * (1.0 - fade**2)
    position = frozen(belief.position + dt * belief.velocity)
    return belief._replace(timestamp_s=now, position=position, error=fade * belief.error, cov=cov)


def _correct(belief: _Belief, measured: PoseEstimate) -> _Tested:
    """The innovation test, χ²(6), and the update. p is 0 where the prediction cannot be compared."""
    assert measured.pose is not None  # as it is usable
    apart = float(np.linalg.norm(measured.pose.position_m - belief.position))
    rows = _rows(measured, belief.position, belief.rotation)
    if rows is None:
        return _Tested(belief, 0.0, "the prediction has the runway behind the camera")
    seen, root = rows
    effect = np.zeros((6, 15))
    effect[:, _POSE], effect[:, _ERROR] = root, np.eye(6)
    innovation = seen - belief.error
    by_state = effect @ belief.cov
    spread = by_state @ effect.T + np.eye(6)
    solved = np.linalg.solve(spread, np.column_stack([innovation, by_state]))
    statistic, gain = float(innovation @ solved[:, 0]), solved[:, 1:].T
    change, left = gain @ innovation, _EYE - gain @ effect
    cov = left @ belief.cov @ left.T + gain @ gain.T  # Joseph's form: positive definite whatever the rounding
    moved = belief._replace(
        position=frozen(belief.position + change[_POSITION]),
        rotation=frozen(belief.rotation @ so3_exp(change[_TURN])),
        velocity=frozen(belief.velocity + change[_VELOCITY]),
        error=belief.error + change[_ERROR],
        cov=0.5 * (cov + cov.T),
        points=measured.points,
    )
    words = f"{apart:.3g} m from the prediction, χ² {statistic:.3g} of 6 degrees of freedom"
    return _Tested(moved, float(chdtrc(6, statistic)), words)


def _rows(measured: PoseEstimate, position: Array, rotation: Array) -> tuple[Array, Array] | None:
    """What was measured, as six numbers about a pose: y = U (truth - pose) + errors of unit variance.

    With Q U the whitened Jacobian, Q (n, 6) orthonormal, y (6,) is Qᵀ times the whitened residual. Returns
    y and U; None where a point lies behind the camera. Keypoints are projected anew; other rows are
    linear, or nearly.
    """
    points, count = measured.points, 2 * len(measured.points)
    px, by_pose, depth = np.empty(count), np.empty((count, 6)), np.empty(len(points))
    project_kernel(points, np.ascontiguousarray(rotation), position, measured.camera.intrinsics, px, by_pose, depth)
    if not (depth > 0).all():
        return None
    residual, jacobian = measured.residual.copy(), measured.jacobian.copy()
    both = np.linalg.solve(
        measured.factor[:count, :count], np.column_stack([measured.keypoints.mean_px.ravel() - px, by_pose])
    )
    residual[:count], jacobian[:count] = both[:, 0], both[:, 1:]
    if len(residual) > count:
        assert measured.pose is not None  # as it is usable
        off, turn = np.empty(6), measured.pose.runway_from_camera.T @ rotation
        off[:3] = position - measured.pose.position_m
        log_kernel(turn, off[3:])
        residual[count:] -= jacobian[count:] @ off
    basis, root = _triangular(jacobian)
    return basis.T @ residual, root


def _triangular(jacobian: Array) -> tuple[Array, Array]:
    """Q (n, 6) and R (6, 6) with a positive diagonal, so that both change smoothly from frame to frame."""
    basis, root = np.linalg.qr(jacobian)
    sign = np.where(np.diag(root) < 0, -1.0, 1.0)
    return basis * sign, root * sign[:, None]


def _track(belief: _Belief, state: TrackState, reason: str, taken: bool, p: float | None, coasting_s: float) -> Track:
    pose, cov = Pose.trusted(belief.position, belief.rotation), frozen(belief.cov[:9, :9].copy())
    return Track(belief.timestamp_s, state, reason, pose, belief.velocity, cov, taken, p, coasting_s)
