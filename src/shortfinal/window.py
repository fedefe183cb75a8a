"""Integrity over time: the χ² test over a window of frames tied by relative motion.

One least squares over all poses of the window (fixed-lag smoothing): each frame's whitened rows,
and for each step between frames the whitened difference of measured and predicted motion. Its cost
is χ² when frames and motion err as they claim, each independent of the others. That test spreads
over hundreds of degrees of freedom. Directed tests (Baarda 1968; the score test of Rao 1948) look
for the suspects by name: one world-fixed parameter each, of which all frames tell, χ² with 1 degree
of freedom.

Errors are taken as independent from frame to frame. Where they are not, alarms come too often: at a
correlation of 0.5 some thirty times, at 0.9 hundreds of times as often (benchmarks/window.py). Thin
the frames (`every`), or inflate their covariance by (1 + ρ) / (1 - ρ). Without odometry `FadingWindow`
takes every frame, and allows for errors that persist. Frames, axes and units: the table of
conventions in docs/architecture.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from scipy.special import chdtrc, chdtri

from shortfinal.errors import InputError
from shortfinal.geometry import Pose, as_array, kernel, project_kernel, so3_exp
from shortfinal.integrity import FALSE_ALARM_RATE, LARGEST_SHARE, Decision, check_integrity, check_rate
from shortfinal.keypoints import check_covariance
from shortfinal.pose import AMBIGUITY_CHI2, PoseEstimate, SolverStatus

Array = NDArray[np.float64]

_MOTION_AXES = ("x", "y", "z", "the turn about x", "the turn about y", "the turn about z")
_MAX_ITERATIONS = 30
_STEP_TOLERANCE = 1e-6  # δᵀJᵀJδ: what a further step could change of the statistic
_UNSEEN = 1e-12  # share of a suspect's effect that no pose explains, below which it is rounding
# Least scaled pivot of the normal matrix: 1 - R² of an unknown with those before it. Motions a million
# times sharper than the frames leave 1e-12; the statistics then lose 1e-12 over it, relatively.
_SINGULAR = 1e-10


@dataclass(frozen=True, eq=False)
class RelativeMotion:
    """How the camera moved between two frames, as odometry measures it: whatever the world's frame.

    Of another body's motion, turn it into the camera's first. The errors of different motions are
    taken as independent: a scale error of odometry is none, but it is among the suspects.

    Raises InputError for a wrong shape, a non-finite entry, a matrix that is no rotation, or a
    covariance that is not symmetric and positive definite.
    """

    translation_m: Array  # (3,) R_kᵀ (p_k+1 - p_k): the later camera, along the axes of the earlier
    earlier_from_later: Array  # (3, 3) R_kᵀ R_k+1, or a scipy Rotation
    cov: Array  # (6, 6) of the local increment: translation (m), then rotation about the later camera's axes (rad)

    def __post_init__(self) -> None:
        try:
            step = Pose(self.translation_m, self.earlier_from_later)
        except InputError as error:
            raise InputError(f"motion: {error}") from error
        cov = as_array(self.cov, (6, 6), "motion: cov")
        check_covariance(cov, "motion: cov", lambda row: _MOTION_AXES[row])
        object.__setattr__(self, "translation_m", step.position_m)
        object.__setattr__(self, "earlier_from_later", step.runway_from_camera)
        object.__setattr__(self, "cov", cov)

    @classmethod
    def between(cls, earlier: Pose, later: Pose, cov: ArrayLike) -> RelativeMotion:
        """The motion from one pose to another, both in any one frame of the world."""
        turn = earlier.runway_from_camera.T
        shift = turn @ (later.position_m - earlier.position_m)
        return cls(shift, turn @ later.runway_from_camera, np.asarray(cov, np.float64))

    def then(self, following: RelativeMotion) -> RelativeMotion:
        """Both motions as one, their errors independent: for a frame left out between them."""
        first, second = np.zeros((6, 6)), np.eye(6)
        first[:3, :3], first[3:, 3:] = np.eye(3), following.earlier_from_later.T
        first[:3, 3:] = -self.earlier_from_later @ _cross(following.translation_m)
        second[:3, :3] = self.earlier_from_later
        return RelativeMotion(
            self.translation_m + self.earlier_from_later @ following.translation_m,
            self.earlier_from_later @ following.earlier_from_later,
            _symmetric(first @ self.cov @ first.T + second @ following.cov @ second.T),
        )


@dataclass(frozen=True)
class Suspect:
    """A parameter of the world that may be wrong by a constant `a`, and what `a` does.

    Points move by a · `shift`, the focal length is (1 + a · `zoom`) times the stated one, and the
    odometry's translation (1 + a · `stride`) times the true one. Raises InputError for a shift that
    is not (k, 3), or where none of the three is given.
    """

    name: str
    words: tuple[str, str]  # for a < 0, for a > 0
    shift: tuple[tuple[float, float, float], ...] = ()  # m per unit of a, of the first points
    zoom: float = 0.0
    stride: float = 0.0

    def __post_init__(self) -> None:
        if self.shift:
            as_array(self.shift, (None, 3), f"suspect {self.name}: shift")
        elif not (self.zoom or self.stride):
            raise InputError(f"suspect {self.name}: does nothing; give shift, zoom or stride")

    def describe(self, value: float, sigma: float) -> str:
        """In words: what would have to be true."""
        scale, unit, digits = (1.0, "m", 0) if self.shift else (100.0, "%", 1)
        size, spread = scale * abs(value), scale * sigma
        if not math.isfinite(spread):
            return f"{self.name} {' or '.join(self.words)}: not to be seen"
        digits = max(digits, 1 - math.floor(math.log10(spread)))
        return f"{self.name} {size:.{digits}f} ± {spread:.{digits}f} {unit} {self.words[value > 0]}"


# Of the four corners, in keypoint order. Which end of the runway is wrong is not to be known: the
# frame's origin moves with the near one. Lines and further points are taken to stay where they are.
_LONGER = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.0, 0.0))
_WIDER = ((0.0, 0.5, 0.0), (0.0, -0.5, 0.0), (0.0, -0.5, 0.0), (0.0, 0.5, 0.0))
SUSPECTS = (
    Suspect("runway", ("shorter", "longer"), _LONGER),
    Suspect("runway", ("narrower", "wider"), _WIDER),
    Suspect("focal length", ("shorter", "longer"), zoom=1.0),
    Suspect("odometry", ("short", "long"), stride=1.0),
)

_ASKEW = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (-0.5, 0.0, 0.0), (0.5, 0.0, 0.0))
# Those of which a frame's own residual tells. Four corners check two things (docs/limits.md): the far end's
# width, given the near one's, which the first three change alike, and its slope.
FRAME_SUSPECTS = (*SUSPECTS[:3], Suspect("far end", ("askew, left side short", "askew, right side short"), _ASKEW))


@dataclass(frozen=True)
class Suspicion:
    """What a directed test found of its suspect."""

    suspect: Suspect
    value: float  # of the parameter: m, or relative; to first order, unless the window was refused
    sigma: float  # its standard deviation; infinite when no such fault could be seen
    statistic: float  # decrease of the window's statistic, χ²(1) without a fault
    p_value: float

    def __str__(self) -> str:
        return self.suspect.describe(self.value, self.sigma)


@dataclass(frozen=True, eq=False)
class WindowVerdict:
    """The decision on the smoothed poses of a window, with the reasons in words.

    A single frame's own pose keeps its own verdict. When not monitored, there are no numbers.
    """

    decision: Decision
    reasons: tuple[str, ...]
    dof: int  # rows of all frames, 6 a known motion, less 6 a frame
    false_alarm_rate: float  # half of it for the statistic, half shared out among the suspects
    statistic: float | None = None  # sum of squares left over
    p_value: float | None = None  # P(χ²(dof) > statistic)
    suspicions: tuple[Suspicion, ...] = ()  # the best explanation first
    positions: Array | None = None  # (N, 3) m, smoothed
    rotations: Array | None = None  # (N, 3, 3) runway_from_camera, smoothed
    covs: Array | None = None  # (N, 6, 6) of their local increments

    @property
    def pose(self) -> Pose | None:
        """The smoothed pose of the last frame; `covs[-1]` belongs to it."""
        if self.positions is None or self.rotations is None:
            return None
        return Pose(self.positions[-1], self.rotations[-1])


def check_window(
    estimates: Sequence[PoseEstimate],
    motions: Sequence[RelativeMotion | None],
    false_alarm_rate: float = FALSE_ALARM_RATE,
    suspects: Sequence[Suspect] = SUSPECTS,
) -> WindowVerdict:
    """Do N frames, and the N - 1 motions between them (None: unknown), fit their uncertainties and each other?

    DO_NOT_USE when p of the whole is below half of `false_alarm_rate`, or p of one of the S suspects
    that can be seen below its share, rate / (2 S); without any the whole has all of it. (Bonferroni:
    together they refuse at most `false_alarm_rate` of faultless windows.) NOT_MONITORED with fewer
    than two frames, a frame without a unique estimate, no redundancy, or poses that stay uncertain.

    Keypoints are projected anew at each iteration; lines and priors are taken as linear about each
    frame's own estimate. Raises InputError for a rate outside (0, 1) or a wrong number of motions.
    """
    check_rate(false_alarm_rate, "false_alarm_rate")
    if len(motions) != max(len(estimates) - 1, 0):
        raise InputError(f"motions: {len(motions)} for {len(estimates)} estimates; give one between each two")
    known = sum(motion is not None for motion in motions)
    dof = sum(len(est.residual) for est in estimates) + 6 * known - 6 * len(estimates)

    def unmonitored(reason: str) -> WindowVerdict:
        return WindowVerdict(Decision.NOT_MONITORED, (reason,), dof, false_alarm_rate)

    obstacle = _obstacle(estimates, dof)
    problem = None if obstacle else _stack(estimates, motions, suspects)
    fit = None if problem is None else _fit(problem)
    if problem is None or fit is None:
        return unmonitored(obstacle or "no well-determined optimum; are the motions' covariances right?")
    covs = _covariances(fit)
    if not _first_order(problem, fit, covs):
        return unmonitored(f"a position is uncertain by more than {LARGEST_SHARE:.0%} of its distance")
    return _judge(problem, fit, covs, dof, false_alarm_rate)


@dataclass
class IntegrityWindow:
    """`check_window` along a flight: push frame after frame.

    The window holds the newest frame and up to `length` - 1 before it, one of every `every` frames:
    errors of consecutive frames are rarely independent, and the odometry's scale shows only over a
    change of range. Motions across frames left out are composed.

    A frame without a unique estimate is left out and NOT_MONITORED. A frame that its own test
    refuses is DO_NOT_USE and left out: a fault of one frame is that frame's, and must not linger.
    Its own test takes half of `false_alarm_rate`, the window the other half. Raises InputError for a
    length below 2, `every` below 1, or a rate outside (0, 1).
    """

    length: int = 20
    false_alarm_rate: float = FALSE_ALARM_RATE
    every: int = 1
    suspects: Sequence[Suspect] = SUSPECTS
    _held: list[tuple[PoseEstimate, RelativeMotion | None]] = field(default_factory=list, init=False, repr=False)
    _since: RelativeMotion | None = field(default=None, init=False, repr=False)  # from the last frame held
    _pushed: int = field(default=0, init=False, repr=False)  # frames since then

    def __post_init__(self) -> None:
        check_rate(self.false_alarm_rate, "false_alarm_rate")
        if self.length < 2 or self.every < 1:
            raise InputError(f"window: length {self.length} must be at least 2, and every {self.every} at least 1")

    def push(self, estimate: PoseEstimate | None, motion: RelativeMotion | None = None) -> WindowVerdict:
        """The verdict with this frame; `motion` is that since the last push, whatever came of it; None: unknown."""
        if self._held:
            both = None if self._since is None or motion is None else self._since.then(motion)
            self._since = both if self._pushed else motion
            self._pushed += 1
        rate = 0.5 * self.false_alarm_rate
        if estimate is None or estimate.status is not SolverStatus.CONVERGED:
            return WindowVerdict(Decision.NOT_MONITORED, (_unsolved(estimate),), 0, rate)
        own = check_integrity(estimate, rate)
        if own.decision is Decision.DO_NOT_USE:
            reasons = tuple(f"this frame by itself: {reason}" for reason in own.reasons)
            return WindowVerdict(own.decision, reasons, own.dof, rate, own.statistic, own.p_value)
        frames = [*self._held[1 - self.length :], (estimate, self._since)]
        verdict = check_window([est for est, _ in frames], [step for _, step in frames[1:]], rate, self.suspects)
        if not self._held or self._pushed >= self.every:
            self._held, self._since, self._pushed = frames, None, 0
        return verdict


class FadingWindow:
    """The directed tests of all frames so far, without motion between them, for errors that persist.

    Of frame k let r be the whitened residual, and g what a suspect's unit does to it, with the pose
    projected out. The score Σ w g·r, older frames weighing less by w = exp(-age / `memory_s`), is normal
    with mean zero without a fault. If the errors of two frames Δt apart correlate by at most
    exp(-Δt / `correlation_time_s`), in whatever combination of keypoints, then by Cauchy and Schwarz its
    variance is at most ΣΣ w w' |g| |g'| exp(-Δt / correlation_time_s). That is what it is divided by:
    faultless flights are suspected at most as often as p says.

    Nothing is lost for want of a motion: with the velocity unknown, a model of smooth motion adds nothing
    to what the residuals tell (docs/tracking.md). A fault that another pose explains is not seen.
    """

    def __init__(
        self, correlation_time_s: float, memory_s: float = 30.0, suspects: Sequence[Suspect] = FRAME_SUSPECTS
    ) -> None:
        for name, value in (("correlation_time_s", correlation_time_s), ("memory_s", memory_s)):
            if not (math.isfinite(value) and (value > 0 or (value == 0 and name == "correlation_time_s"))):
                raise InputError(f"window: {name} is {value}; it must be finite and positive")
        self.suspects = tuple(suspects)
        self._tau_s, self._memory_s, self._last_s = correlation_time_s, memory_s, -math.inf
        self._score, self._information, self._variance, self._alike = np.zeros((4, len(self.suspects)))

    def push(self, timestamp_s: float, estimate: PoseEstimate) -> tuple[Suspicion, ...]:
        """What all frames up to this one say of each suspect, the most suspicious first; times must advance.

        One without a unique estimate says nothing.
        """
        if estimate.status is SolverStatus.CONVERGED:
            passed, self._last_s = timestamp_s - self._last_s, timestamp_s
            seen = _in_residual(estimate, self.suspects)
            size = np.sqrt(np.sum(seen**2, axis=0))
            fade = math.exp(-passed / self._memory_s)
            self._alike *= fade * (math.exp(-passed / self._tau_s) if self._tau_s > 0 else 0.0)
            self._score = fade * self._score + estimate.residual @ seen
            self._information = fade * self._information + size**2
            self._variance = fade**2 * self._variance + 2.0 * size * self._alike + size**2
            self._alike += size
        return self._suspicions()

    def _suspicions(self) -> tuple[Suspicion, ...]:
        found = []
        for suspect, score, information, variance in zip(
            self.suspects, self._score, self._information, self._variance, strict=True
        ):
            if information > 0:
                statistic = float(score**2 / variance)
                value, sigma = float(score / information), math.sqrt(variance) / float(information)
                found.append(Suspicion(suspect, value, sigma, statistic, float(chdtrc(1, statistic))))
            else:
                found.append(Suspicion(suspect, 0.0, math.inf, 0.0, 1.0))
        return tuple(sorted(found, key=lambda suspicion: -suspicion.statistic))


class _Frames(NamedTuple):
    """The frames' numbers, stacked; a frame with fewer rows than another is padded with rows of zero."""

    mean: Array  # (N, 2K) px
    whitener: Array  # (N, 2K, 2K) L⁻¹ of the keypoints
    points: Array  # (N, K, 3)
    intrinsics: Array  # (N, 12)
    positions: Array  # (N, 3) of the estimates
    rotations: Array  # (N, 3, 3)
    other_residual: Array  # (N, m) the rows beside the keypoints, at the estimates
    other_jacobian: Array  # (N, m, 6)


class _Problem(NamedTuple):
    """All that is measured, and who is suspected; an unknown motion has a whitener of zero."""

    frames: _Frames
    translations: Array  # (N-1, 3)
    turns: Array  # (N-1, 3, 3)
    whitener: Array  # (N-1, 6, 6) L⁻¹ of the motions
    suspects: tuple[Suspect, ...]


class _State(NamedTuple):
    """The poses, and the values of the suspects' parameters that are free."""

    positions: Array  # (N, 3)
    rotations: Array  # (N, 3, 3)
    values: Array  # (S,)


class _Rows(NamedTuple):
    """Whitened rows: measured minus predicted, and the derivatives of what is predicted."""

    frame_columns: Array  # (N, n, 1 + S) residual, then d / d(parameter)
    frame_jacobian: Array  # (N, n, 6)
    motion_columns: Array  # (N-1, 6, 1 + S)
    motion_jacobian: Array  # (N-1, 6, 12) by the earlier and the later pose

    @property
    def cost(self) -> float:
        return float(sum(np.sum(columns[..., 0] ** 2) for columns in (self.frame_columns, self.motion_columns)))


class _Fit(NamedTuple):
    """An optimum; the Gram matrix is that of residual and parameters with all poses projected out."""

    state: _State
    cost: float
    gram: Array  # (1 + S, 1 + S)
    factor: Array  # (12, 6N) banded Cholesky factor of the normal matrix


def _unsolved(estimate: PoseEstimate | None) -> str:
    return f"no unique estimate: the solver ended {estimate.status.value}" if estimate else "no estimate"


def _obstacle(estimates: Sequence[PoseEstimate], dof: int) -> str | None:
    """Why the window cannot be checked, or None."""
    if len(estimates) < 2:
        return "a window needs two frames"
    for k, est in enumerate(estimates):
        if est.status is not SolverStatus.CONVERGED:
            return f"frame {k}: {_unsolved(est)}"
    if dof <= 0:
        return f"no redundancy: {dof} degrees of freedom"
    measured = sum(est.sharp_rows for est in estimates)
    return None if measured > 6 else "no redundancy in effect: too few corners are measurements"


def _first_order(problem: _Problem, fit: _Fit, covs: Array) -> bool:
    """Whether the smoothed poses are known well enough for the linearisation the test rests on."""
    distance = np.linalg.norm(problem.frames.points - fit.state.positions[:, None], axis=2).min(axis=1)
    variances = np.trace(covs[:, :3, :3], axis1=1, axis2=2)
    return bool((np.sqrt(variances) < LARGEST_SHARE * distance).all())


def _judge(problem: _Problem, fit: _Fit, covs: Array, dof: int, rate: float) -> WindowVerdict:
    suspicions = _suspicions(problem.suspects, fit)
    seen = sum(math.isfinite(suspicion.sigma) for suspicion in suspicions)
    share, each = (0.5 * rate, 0.5 * rate / seen) if seen else (rate, 0.0)
    p, threshold = float(chdtrc(dof, fit.cost)), float(chdtri(dof, share))
    refused = p < share or any(suspicion.p_value < each for suspicion in suspicions)
    relation, compared = ("over", "<") if p < share else ("within", ">=")
    reasons = [f"residual {fit.cost:.4g} {relation} {threshold:.4g} (p = {p:.1g} {compared} {share:.1g})"]
    if refused and suspicions:
        suspicions = _explanations(problem, fit)
        reasons += _accusations(suspicions, fit.cost, dof, share)
    ranked = tuple(sorted(suspicions, key=lambda suspicion: -suspicion.statistic))
    decision = Decision.DO_NOT_USE if refused else Decision.USE
    poses = fit.state.positions, fit.state.rotations
    return WindowVerdict(decision, tuple(reasons), dof, rate, fit.cost, p, ranked, *poses, covs)


def _suspicions(suspects: Sequence[Suspect], fit: _Fit) -> tuple[Suspicion, ...]:
    """The score tests: what a step in each parameter alone, the poses following, would gain."""
    found = []
    for s, suspect in enumerate(suspects, start=1):
        slope, curvature = float(fit.gram[0, s]), float(fit.gram[s, s])
        if curvature > 0:
            statistic = slope**2 / curvature
            p = float(chdtrc(1, statistic))
            found.append(Suspicion(suspect, slope / curvature, curvature**-0.5, statistic, p))
        else:
            found.append(Suspicion(suspect, 0.0, math.inf, 0.0, 1.0))
    return tuple(found)


def _explanations(problem: _Problem, fit: _Fit) -> tuple[Suspicion, ...]:
    """The suspects with their parameter solved for: a large fault is beyond first order."""
    found = []
    for suspicion in _suspicions(problem.suspects, fit):
        suspect = suspicion.suspect
        free = _fit(problem._replace(suspects=(suspect,)), fit.state, solve_parameters=True)
        if free is not None and math.isfinite(suspicion.sigma):
            gain = max(fit.cost - free.cost, 0.0)
            spread = float(free.gram[1, 1] ** -0.5)
            suspicion = Suspicion(suspect, float(free.state.values[0]), spread, gain, float(chdtrc(1, gain)))
        found.append(suspicion)
    return tuple(found)


def _accusations(suspicions: Sequence[Suspicion], cost: float, dof: int, share: float) -> list[str]:
    """Who explains it best, how well, and who cannot be told apart from that one."""
    best, *others = sorted(suspicions, key=lambda suspicion: -suspicion.statistic)
    left = float(chdtrc(dof - 1, cost - best.statistic))
    verb = "explained by" if left >= share else "explained by none of the suspects; the nearest is"
    rivals = [str(other) for other in others if best.statistic - other.statistic < AMBIGUITY_CHI2]
    reasons = [
        f"{verb}: {best} (residual less by {best.statistic:.3g}, p = {best.p_value:.1g}; the rest p = {left:.1g})"
    ]
    return [*reasons, f"or, not told apart: {'; '.join(rivals)}"] if rivals else reasons


def _stack(
    estimates: Sequence[PoseEstimate], motions: Sequence[RelativeMotion | None], suspects: Sequence[Suspect]
) -> _Problem:
    count, k = len(estimates), max(len(est.points) for est in estimates)
    m = max(len(est.residual) - 2 * len(est.points) for est in estimates)
    frames = _Frames(*(np.zeros((count, *shape)) for shape in (
        (2 * k,), (2 * k, 2 * k), (k, 3), (12,), (3,), (3, 3), (m,), (m, 6)
    )))  # fmt: skip
    for i, est in enumerate(estimates):
        assert est.pose is not None  # as it converged
        points, rows = len(est.points), 2 * len(est.points)
        frames.mean[i, :rows] = est.keypoints.mean_px.ravel()
        frames.whitener[i, :rows, :rows] = np.linalg.inv(est.factor[:rows, :rows])
        frames.points[i] = est.points[0]  # padding that projects; its rows are zero
        frames.points[i, :points] = est.points
        frames.intrinsics[i] = est.camera.intrinsics
        frames.positions[i], frames.rotations[i] = est.pose.position_m, est.pose.runway_from_camera
        frames.other_residual[i, : len(est.residual) - rows] = est.residual[rows:]
        frames.other_jacobian[i, : len(est.residual) - rows] = est.jacobian[rows:]
    steps = count - 1
    problem = _Problem(frames, np.zeros((steps, 3)), np.zeros((steps, 3, 3)), np.zeros((steps, 6, 6)), tuple(suspects))
    for i, motion in enumerate(motions):
        if motion is not None:  # else its rows stay zero
            problem.translations[i], problem.turns[i] = motion.translation_m, motion.earlier_from_later
            problem.whitener[i] = np.linalg.inv(np.linalg.cholesky(motion.cov))
    return problem


def _in_residual(estimate: PoseEstimate, suspects: Sequence[Suspect]) -> Array:
    """What a unit of each suspect does to a frame's whitened residual (n, S), its pose projected out."""
    assert estimate.pose is not None  # as it converged
    problem = _stack([estimate], (), suspects)
    state = _State(problem.frames.positions, problem.frames.rotations, np.zeros(len(suspects)))
    rows = _frame_rows(problem, state)
    if rows is None:  # a point behind the camera: nothing to be told
        return np.zeros((len(estimate.residual), len(suspects)))
    effects = rows[0][0, :, 1:]
    basis = np.linalg.qr(estimate.jacobian)[0]
    seen = effects - basis @ (basis.T @ effects)
    seen[:, np.sum(seen**2, axis=0) < _UNSEEN * np.sum(effects**2, axis=0)] = 0.0
    return seen


def _fit(problem: _Problem, start: _State | None = None, solve_parameters: bool = False) -> _Fit | None:
    """Gauss-Newton over the poses, and over the suspects' parameters if asked; None if it fails.

    The step is halved until the cost falls. The suspects' columns are carried in either case.
    """
    state = start or _State(problem.frames.positions, problem.frames.rotations, np.zeros(0))
    state = state._replace(values=np.zeros(len(problem.suspects)))
    rows = _rows(problem, state)
    if rows is None:
        return None
    for _ in range(_MAX_ITERATIONS):
        solved = _solve(rows)
        if solved is None:
            return None
        solution, gram, factor, gain = solved
        shift: Array = np.zeros(len(problem.suspects))
        if solve_parameters:
            if not (np.diag(gram)[1:] > 0).all():
                return None
            shift = np.asarray(np.linalg.solve(gram[1:, 1:], gram[1:, 0]), np.float64)
            gain += float(shift @ gram[1:, 0])
        if gain < _STEP_TOLERANCE + 1e-12 * rows.cost:
            return _Fit(state, rows.cost, gram, factor)
        moved = _descend(problem, state, rows.cost, solution[:, :, 0] - solution[:, :, 1:] @ shift, shift)
        if moved is None:
            return None
        state, rows = moved
    return None


def _descend(problem: _Problem, state: _State, cost: float, step: Array, shift: Array) -> tuple[_State, _Rows] | None:
    """The state moved by the step, or by the first half, quarter, ... of it that lowers the cost."""
    for scale in 0.5 ** np.arange(12):
        trial = _State(
            state.positions + scale * step[:, :3],
            state.rotations @ np.array([so3_exp(turn) for turn in scale * step[:, 3:]]),
            state.values + scale * shift,
        )
        rows = _rows(problem, trial)
        if rows is not None and rows.cost < cost:
            return trial, rows
    return None


def _rows(problem: _Problem, state: _State) -> _Rows | None:
    """All rows at a state; None where a point lies behind its camera."""
    frames = _frame_rows(problem, state)
    return None if frames is None else _Rows(*frames, *_motion_rows(problem, state))


def _frame_rows(problem: _Problem, state: _State) -> tuple[Array, Array] | None:
    """Keypoints, projected anew; the other rows are linear in the pose, or nearly."""
    frames, suspects = problem.frames, problem.suspects
    count, k = frames.points.shape[:2]
    shifts = np.zeros((len(suspects), k, 3))
    for s, suspect in enumerate(suspects):
        known = np.array(suspect.shift).reshape(-1, 3)[:k]
        shifts[s, : len(known)] = known
    zooms = np.array([suspect.zoom for suspect in suspects])
    points, intrinsics = frames.points + np.tensordot(state.values, shifts, 1), frames.intrinsics.copy()
    intrinsics[:, :2] *= 1.0 + zooms @ state.values
    pixels, jacobian, depth = np.empty((count, 2 * k)), np.empty((count, 2 * k, 6)), np.empty((count, k))
    _project_frames_kernel(points, state.rotations, state.positions, intrinsics, pixels, jacobian, depth)
    if not (depth > 0).all():
        return None
    # A point moved is the camera moved the other way; a focal length scales about the principal point.
    by_point = -jacobian.reshape(count, k, 2, 6)[..., :3]
    effects = np.einsum("nkia,ska->nkis", by_point, shifts)
    from_centre = pixels.reshape(count, k, 2) - intrinsics[:, None, 2:4]
    effects += from_centre[..., None] * (zooms / (1.0 + zooms @ state.values))
    columns = np.concatenate([(frames.mean - pixels)[..., None], effects.reshape(count, 2 * k, -1)], axis=2)
    moved = np.concatenate([state.positions - frames.positions, _turn(frames.rotations, state.rotations)], axis=1)
    others = np.zeros((count, frames.other_residual.shape[1], columns.shape[2]))
    others[..., 0] = frames.other_residual - np.einsum("nri,ni->nr", frames.other_jacobian, moved)
    return (
        np.concatenate([frames.whitener @ columns, others], axis=1),
        np.concatenate([frames.whitener @ jacobian, frames.other_jacobian], axis=1),
    )


def _motion_rows(problem: _Problem, state: _State) -> tuple[Array, Array]:
    """Measured minus predicted motion: translation, then the rotation vector between the turns.

    With R exp(δθ): d(Rᵀ Δp)/dθ = [Rᵀ Δp]x, and Q = R_kᵀ R_k+1 turns by δθ_k+1 - Qᵀ δθ_k. (The inverse
    of the right Jacobian of SO(3) is taken as 1: it changes the way to the optimum, and the optimum by
    the share of half the turn that is left over.)
    """
    strides = np.array([suspect.stride for suspect in problem.suspects])
    earlier, shifts = np.swapaxes(state.rotations[:-1], 1, 2), np.diff(state.positions, axis=0)
    steps, turns = (earlier @ shifts[..., None])[..., 0], earlier @ state.rotations[1:]
    size = 1.0 + strides @ state.values
    columns = np.zeros((len(steps), 6, 1 + len(strides)))
    columns[:, :3, 0], columns[:, 3:, 0] = problem.translations - size * steps, _turn(turns, problem.turns)
    columns[:, :3, 1:] = steps[..., None] * strides
    jacobian = np.zeros((len(steps), 6, 12))
    jacobian[:, :3, :3], jacobian[:, :3, 6:9] = -size * earlier, size * earlier
    jacobian[:, :3, 3:6] = size * _cross(steps)
    jacobian[:, 3:, 3:6], jacobian[:, 3:, 9:] = -np.swapaxes(turns, 1, 2), np.eye(3)
    return problem.whitener @ columns, problem.whitener @ jacobian


def _solve(rows: _Rows) -> tuple[Array, Array, Array, float] | None:
    """The normal equations, block-tridiagonal over the poses, for all columns at once.

    Returns the solutions (N, 6, 1 + S), the Gram matrix of the columns with the poses projected
    out, the Cholesky factor, and what the first column's step gains. None where singular.
    """
    count = len(rows.frame_jacobian)
    by_frame, by_motion = (np.swapaxes(j, 1, 2) for j in (rows.frame_jacobian, rows.motion_jacobian))
    right, ties = by_frame @ rows.frame_columns, by_motion @ rows.motion_columns
    right[:-1] += ties[:, :6]
    right[1:] += ties[:, 6:]
    blocks, ties = np.zeros((count, 12, 6)), by_motion @ rows.motion_jacobian  # diagonal block over the one below
    blocks[:, :6] = by_frame @ rows.frame_jacobian
    blocks[:-1] += ties[:, :, :6]
    blocks[1:, :6] += ties[:, 6:, 6:]
    # LAPACK's lower banded form: entry (i, j) in row i - j, column j.
    banded = np.zeros((12, count, 6))
    banded[_ROW - _COLUMN, :, _COLUMN] = blocks[:, _ROW, _COLUMN].T
    flat = right.reshape(6 * count, -1)
    try:
        factor = cholesky_banded(banded.reshape(12, -1), lower=True, check_finite=False)
    except LinAlgError:
        return None
    if not (factor[0] ** 2 > _SINGULAR * banded[0].ravel()).all():
        return None
    solution = cho_solve_banded((factor, True), flat, check_finite=False)
    total = sum(np.einsum("nri,nrj->ij", c, c) for c in (rows.frame_columns, rows.motion_columns))
    gram = total - flat.T @ solution
    unseen = np.diag(gram) < _UNSEEN * np.diag(total)
    gram[unseen] = gram[:, unseen] = 0.0
    return solution.reshape(count, 6, -1), gram, factor, float(flat[:, 0] @ solution[:, 0])


_ROW, _COLUMN = (index.ravel() for index in np.indices((12, 6)))
_ROW, _COLUMN = _ROW[_ROW >= _COLUMN], _COLUMN[_ROW >= _COLUMN]


def _covariances(fit: _Fit) -> Array:
    """The diagonal blocks (N, 6, 6) of the inverse normal matrix."""
    size = fit.factor.shape[1]
    inverse = cho_solve_banded((fit.factor, True), np.eye(size), check_finite=False)
    blocks = inverse.reshape(size // 6, 6, size // 6, 6)
    each = np.arange(size // 6)
    return np.asarray(blocks[each, :, each])


def _turn(start: Array, end: Array) -> Array:
    """Rotation vectors (N, 3) of startᵀ end, turns of less than half a revolution."""
    turn = np.swapaxes(start, -1, -2) @ end
    sine = 0.5 * np.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], axis=1
    )
    size = np.linalg.norm(sine, axis=1, keepdims=True)
    angle = np.arctan2(size, 0.5 * (np.trace(turn, axis1=1, axis2=2)[:, None] - 1.0))
    return sine * np.where(size > 1e-9, angle / np.maximum(size, 1e-9), 1.0)


def _cross(v: Array) -> Array:
    """[v]x, (..., 3, 3): its product with w is v x w."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return out - np.swapaxes(out, -1, -2)


def _symmetric(cov: Array) -> Array:
    return 0.5 * (cov + cov.T)


@kernel
def _project_frames_kernel(points, rotations, positions, intrinsics, px, jacobian, depth):  # type: ignore[no-untyped-def]
    """`project_kernel` for each of N frames."""
    for i in range(points.shape[0]):
        project_kernel(points[i], rotations[i], positions[i], intrinsics[i], px[i], jacobian[i], depth[i])
