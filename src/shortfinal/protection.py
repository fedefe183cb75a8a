"""How large an error could still hide? Protection levels: P(|error| > level and the frame was
accepted) ≤ the integrity risk, for each axis by itself, in the worst case over the stated faults.

A fault hypothesis is a set S of features with an arbitrary bias f on their rows. In the whitened
linear model the residual is P (n + A f), with A = L⁻¹ E_S and P = 1 - J J⁺, and an axis with
gradient a errs by s·(n + A f), s = J (JᵀJ)⁻¹ a, independently of the residual and with σ = |s|. Both
methods rest on one number for each set and axis, g² = sᵀA (AᵀPA)⁻¹ Aᵀs. It is the slope of the
error over the root of the statistic's non-centrality in the worst direction of f, and it is the
standard deviation of the separation of the estimates with and without S (Joerger, Chan & Pervan
2014, NAVIGATION 61(4), Solution separation versus residual-based RAIM).

A range goes as one over an angle, so that slopes taken at the estimate are wrong by the share that
the level has of the distance. They are therefore taken a second time, half-way to the truth that an
error of that size would mean: that is right to second order. The equations as coded, the
assumptions and the limits: docs/integrity.md. Frames, axes, units: docs/architecture.md.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, gammainc, gammaln

from shortfinal.errors import InputError
from shortfinal.features import Feature
from shortfinal.geometry import cayley_kernel, copy_kernel, kernel, lines_kernel, product_kernel, project_kernel
from shortfinal.integrity import FALSE_ALARM_RATE, check_rate
from shortfinal.pose import CHUNK, PoseEstimate, PoseEstimateBatch, SolverStatus

Array = NDArray[np.float64]
Value = TypeVar("Value")

INTEGRITY_RISK = 1e-7
FAULT_PRIOR = 1e-4
METHODS = ("residual", "solution-separation")
GLIDE_PATH_ORIGIN_M = 300.0  # past the threshold: where an ILS glide path meets the runway
SENSORS = ("attitude prior", "position prior", "altitude")  # faulty only where a mapping says so
LARGEST_GROWTH = 1.5  # of a level from first to second order; beyond, two orders are not enough
NO_FAULT, TOO_MANY_FAULTS = "no fault", "more faults than max_faults"


class PerAxis(NamedTuple, Generic[Value]):
    """One value for each axis."""

    along_m: Value  # x of the runway frame
    cross_m: Value  # y
    vertical_m: Value  # z
    lateral_deg: Value  # of the camera from the centreline, at a localizer on the runway's far end
    vertical_deg: Value  # of the camera from the horizon, at the glide path's origin


AXES = PerAxis._fields


@dataclass(frozen=True)
class AlertLimits:
    """The largest error that an operation tolerates, per axis; infinite where it does not care.

    Raises InputError for a limit that is not positive.
    """

    along_m: float = math.inf
    cross_m: float = math.inf
    vertical_m: float = math.inf
    lateral_deg: float = math.inf
    vertical_deg: float = math.inf

    def __post_init__(self) -> None:
        for axis in AXES:
            if not getattr(self, axis) > 0:
                raise InputError(f"{axis}: an alert limit of {getattr(self, axis)} is never kept; give a positive one")

    @classmethod
    def lpv200(cls) -> AlertLimits:
        """As for satellite approaches down to 200 ft (LPV-200): 40 m horizontally, 35 m vertically."""
        return cls(along_m=40.0, cross_m=40.0, vertical_m=35.0)


@dataclass(frozen=True)
class Availability:
    """Whether all levels are within their alert limits, and which are not. True as a condition when available."""

    available: bool
    reasons: tuple[str, ...]  # one for each axis that exceeds

    def __bool__(self) -> bool:
        return self.available


@dataclass(frozen=True, eq=False)
class ProtectionLevels:
    """What bounds the error of an accepted frame, and why it is that large.

    A level that cannot be given is infinite, with its reason in words.
    """

    along_m: float
    cross_m: float
    vertical_m: float
    lateral_deg: float
    vertical_deg: float
    first_order: PerAxis[float]  # the levels with the slopes at the estimate alone
    sigma: PerAxis[float]  # standard deviation without a fault, first-order
    driver: PerAxis[str]  # the hypothesis that contributes most
    method: str
    integrity_risk: float
    false_alarm_rate: float
    fault_prior: float | Mapping[str, float]
    max_faults: int
    unmonitored: float  # P(more than max_faults faults), charged to the integrity risk
    hypotheses: tuple[str, ...]  # h sets of faulty features
    slopes: Array  # (h, 5) g, metres and degrees; infinite where a fault can hide
    separations: Array | None  # (h, 5) the estimate less that without the features, metres and degrees
    thresholds: Array | None  # (h, 5) how much of it solution separation tolerates
    passed: bool | None  # solution separation's own monitor; None with "residual", whose is check_integrity

    @cached_property
    def reasons(self) -> tuple[str, ...]:
        """Why levels are infinite, a line for each axis; empty when none is."""
        spent = f"{self.unmonitored:.2g} for more faults at once than max_faults"
        reasons = []
        for axis, level, first, slope in zip(AXES, self.levels, self.first_order, self.slopes.T, strict=True):
            hidden = np.flatnonzero(np.isinf(slope))
            if first < level == math.inf:
                reasons.append(f"{axis}: {first:.3g} to first order, too large a share of the distance to be a bound")
            elif level == math.inf and len(hidden):
                names = ", ".join(self.hypotheses[i] for i in hidden[:3])
                reasons.append(f"{axis}: the risk does not cover {spent} and faults that can hide ({names})")
            elif level == math.inf:
                reasons.append(f"{axis}: the risk does not cover {spent}")
        return tuple(reasons)

    @property
    def levels(self) -> PerAxis[float]:
        """The five levels."""
        return PerAxis(self.along_m, self.cross_m, self.vertical_m, self.lateral_deg, self.vertical_deg)

    def to_dict(self) -> dict[str, float | None]:
        """The levels by name, for JSON, which knows no infinity: None where there is no level."""
        return {axis: level if math.isfinite(level) else None for axis, level in self.levels._asdict().items()}

    def available(self, limits: AlertLimits) -> Availability:
        """Are all levels within the alert limits?"""
        reasons = tuple(
            f"{axis}: level {level:.3g} over the limit {getattr(limits, axis):.3g}, driven by {driver}"
            for axis, level, driver in zip(AXES, self.levels, self.driver, strict=True)
            if not level <= getattr(limits, axis)
        )
        return Availability(not reasons, reasons)


@dataclass(frozen=True, eq=False)
class ProtectionBatch:
    """The levels of N estimates; infinite where there is no estimate, or no level."""

    along_m: Array  # (N,)
    cross_m: Array
    vertical_m: Array
    lateral_deg: Array
    vertical_deg: Array
    first_order: Array  # (N, 5) in the order of AXES, as in ProtectionLevels
    sigma: Array  # (N, 5)
    drivers: NDArray[np.int64]  # (N, 5) index into `hypotheses`; -1 no fault, -2 more faults than max_faults
    hypotheses: tuple[str, ...]
    passed: NDArray[np.bool_] | None  # (N,) solution separation's own monitor; None with "residual"

    def __len__(self) -> int:
        return len(self.along_m)

    @property
    def levels(self) -> Array:
        """The levels (N, 5), in the order of AXES."""
        return np.stack([getattr(self, axis) for axis in AXES], axis=1)

    def available(self, limits: AlertLimits) -> NDArray[np.bool_]:
        """Which estimates (N,) have all levels within the alert limits."""
        return np.asarray((self.levels <= [getattr(limits, axis) for axis in AXES]).all(axis=1))


def protection_levels(
    est: PoseEstimate,
    *,
    integrity_risk: float = INTEGRITY_RISK,
    fault_prior: float | Mapping[str, float] = FAULT_PRIOR,
    false_alarm_rate: float = FALSE_ALARM_RATE,
    method: str = "residual",
    max_faults: int = 1,
) -> ProtectionLevels:
    """Levels with P(|error| > level and the frame was accepted) ≤ `integrity_risk`, per axis.

    `fault_prior` is the probability that a feature is faulty: one for every keypoint and line, or a
    mapping from names of features (others are never faulty). Features fail independently. All sets
    of up to `max_faults` features are protected; the probability of more is charged to the risk. So
    is that of a set whose bias can hide completely, as with four corners that of any two: where the
    risk does not suffice for it, the level is infinite.

    "residual" (default) is the exact worst case of the χ² test, and holds for frames that
    `check_integrity` accepts at `false_alarm_rate`. "solution-separation" holds for frames whose
    `passed` is true; `false_alarm_rate` is then that of the test of one axis.

    Levels are of second order in the errors; where that makes them half again as large as to first
    order, or larger, the series is not trusted and they are infinite. They bound what the stated
    covariance, priors and independence imply, and nothing else.

    Raises InputError for a risk, rate or prior outside (0, 1), a feature or method that does not
    exist, a `max_faults` that is no positive whole number, an estimate without pose or redundancy.
    """
    _check(integrity_risk, false_alarm_rate, method, max_faults, est.dof)
    if est.pose is None:
        raise InputError(f"est: no pose to protect: the solver ended {est.status.value}")
    monitor = _monitor(est.dof, integrity_risk, false_alarm_rate, method)
    plan = _plan(_feature_key(est.features), _prior_key(fault_prior), max_faults)
    details, out = _Details(*np.empty((3, 1, len(plan.names), 5))), np.empty((1, 5, 5))
    layout = _layout(len(est.residual), len(est.points), *plan.hypotheses.rows.shape)
    frames = _Frames(
        # Copies: read-only arrays are another type to the compiler, and would be compiled for anew.
        est.residual[None].copy(),
        est.jacobian[None].copy(),
        est.factor[None].copy(),
        est.pose.position_m[None].copy(),
        est.pose.runway_from_camera[None].copy(),
        est.points[None].copy(),
        _NO_EDGES if est.edges is None else est.edges[None].copy(),
        _NO_LINES if est.lines is None else est.lines.mean[None].copy(),
    )
    _protect_kernel(
        frames, est.camera.intrinsics.copy(), plan.hypotheses, monitor, layout, np.empty(layout[-1]), details, out
    )
    levels, first_order, sigma, drivers, passed = out[0].tolist()
    separation = method == METHODS[1]
    return ProtectionLevels(
        *PerAxis(*levels),
        first_order=PerAxis(*first_order),
        sigma=PerAxis(*sigma),
        driver=PerAxis(*[(*plan.names, TOO_MANY_FAULTS, NO_FAULT)[int(d)] for d in drivers]),
        method=method,
        integrity_risk=integrity_risk,
        false_alarm_rate=false_alarm_rate,
        fault_prior=fault_prior,
        max_faults=max_faults,
        unmonitored=plan.hypotheses.unmonitored,
        hypotheses=plan.names,
        slopes=details.slopes[0],
        separations=details.separations[0] if separation else None,
        thresholds=details.thresholds[0] if separation else None,
        passed=est.status is SolverStatus.CONVERGED and min(passed) > 0 if separation else None,
    )


def protection_levels_batch(
    batch: PoseEstimateBatch,
    *,
    integrity_risk: float = INTEGRITY_RISK,
    fault_prior: float | Mapping[str, float] = FAULT_PRIOR,
    false_alarm_rate: float = FALSE_ALARM_RATE,
    method: str = "residual",
    max_faults: int = 1,
    threads: int | None = None,
) -> ProtectionBatch:
    """`protection_levels` of N estimates, on `threads` threads (default: one per processor).

    An estimate without a pose has infinite levels. Raises as `protection_levels`.
    """
    _check(integrity_risk, false_alarm_rate, method, max_faults, batch.dof)
    monitor = _monitor(batch.dof, integrity_risk, false_alarm_rate, method)
    plan = _plan(_feature_key(batch.features), _prior_key(fault_prior), max_faults)
    layout = _layout(batch.residuals.shape[1], batch.mean_px.shape[1], *plan.hypotheses.rows.shape)
    count, intrinsics, out = len(batch), batch.camera.intrinsics.copy(), np.empty((len(batch), 5, 5))
    frames = _Frames(
        batch.residuals, batch.jacobians, batch.factors, batch.positions, batch.rotations,
        batch.points, batch.edges, batch.line_mean,
    )  # fmt: skip

    def protect(start: int) -> None:
        part = slice(start, start + CHUNK)
        _protect_kernel(
            _Frames(*(np.array(array[part] if len(array) == count else array, order="C") for array in frames)),
            intrinsics,
            plan.hypotheses,
            monitor,
            layout,
            np.empty(layout[-1]),
            _Details(*np.empty((3, 1, len(plan.names), 5))),  # shared by all: scratch
            out[part],
        )

    with ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        list(pool.map(protect, range(0, count, CHUNK)))
    levels, first_order, sigma, drivers, passed = np.swapaxes(out, 0, 1)
    return ProtectionBatch(
        **dict(zip(AXES, levels.T, strict=True)),
        first_order=first_order,
        sigma=sigma,
        drivers=drivers.astype(np.int64),
        hypotheses=plan.names,
        passed=batch.converged & (passed > 0).all(axis=1) if method == METHODS[1] else None,
    )


class _Frames(NamedTuple):
    """N estimates; (1, ...) where all share one."""

    residuals: Any  # (N, n)
    jacobians: Any  # (N, n, 6)
    factors: Any  # (N or 1, n, n)
    positions: Any  # (N, 3)
    rotations: Any  # (N, 3, 3)
    points: Any  # (N or 1, K, 3)
    edges: Any  # (N or 1, L, 2, 3)
    lines: Any  # (N or 1, L, 2) as measured


class _Details(NamedTuple):
    """What the kernel finds per hypothesis and axis, (N or 1, h, 5)."""

    slopes: Any
    separations: Any
    thresholds: Any


class _Monitor(NamedTuple):
    """The risk, and the test that the promise is conditional on."""

    risk: float
    false_alarm_rate: float
    separation: bool  # solution separation instead of the χ² test
    root: float  # of the χ² test's threshold
    acceptance: Array  # see _acceptance


class _Hypotheses(NamedTuple):
    """h sets of faulty features."""

    rows: NDArray[np.int64]  # (h, m) of each set, filled up with -1
    priors: Array  # (h,) P(all of the set are faulty): a little over P(exactly these are)
    fault_free: float  # P(no fault)
    unmonitored: float  # P(more than max_faults)


class _Plan(NamedTuple):
    names: tuple[str, ...]
    hypotheses: _Hypotheses


_NO_EDGES, _NO_LINES = np.empty((1, 0, 2, 3)), np.empty((1, 0, 2))


def _check(integrity_risk: float, false_alarm_rate: float, method: str, max_faults: int, dof: int) -> None:
    check_rate(integrity_risk, "integrity_risk")
    check_rate(false_alarm_rate, "false_alarm_rate")
    if method not in METHODS:
        raise InputError(f"method: {method!r} is unknown; choose {' or '.join(METHODS)}")
    if isinstance(max_faults, bool) or not isinstance(max_faults, (int, np.integer)) or max_faults < 1:
        raise InputError(f"max_faults: {max_faults!r} is no number of faults; give a whole number from 1")
    if dof <= 0:
        raise InputError(f"est: no redundancy ({dof} degrees of freedom): no fault can show; add points or sensors")


@lru_cache(maxsize=256)
def _monitor(dof: int, risk: float, rate: float, method: str) -> _Monitor:
    return _Monitor(risk, rate, method == METHODS[1], math.sqrt(chdtri(dof, rate)), _acceptance(dof, rate))


def _feature_key(features: tuple[Feature, ...]) -> tuple[tuple[str, int, int], ...]:
    return tuple([(name, rows.start, rows.stop) for name, rows in features])


def _prior_key(fault_prior: float | Mapping[str, float]) -> float | tuple[tuple[str, float], ...]:
    if not isinstance(fault_prior, Mapping):
        check_rate(fault_prior, "fault_prior")
        return fault_prior
    for name, value in fault_prior.items():
        check_rate(value, f"fault_prior: {name}")
    return tuple(fault_prior.items())


@lru_cache(maxsize=256)
def _plan(
    features: tuple[tuple[str, int, int], ...], prior: float | tuple[tuple[str, float], ...], max_faults: int
) -> _Plan:
    rows = {name: range(start, stop) for name, start, stop in features}
    priors = dict(prior) if isinstance(prior, tuple) else {name: prior for name in rows if name not in SENSORS}
    for name in priors:
        if name not in rows:
            raise InputError(f"fault_prior: {name!r} was not measured; there are {', '.join(rows)}")
    sets = [s for size in range(1, max_faults + 1) for s in combinations(priors, size)]
    lists = [[row for name in s for row in rows[name]] for s in sets]
    table = np.full((len(sets), max(map(len, lists), default=0)), -1)
    for line, entries in zip(table, lists, strict=True):
        line[: len(entries)] = entries
    counts = np.ones(1)  # P(0, 1, 2, ... faults), Poisson-binomial
    for value in priors.values():
        counts = np.convolve(counts, [1.0 - value, value])
    products = np.array([math.prod(priors[name] for name in s) for s in sets])
    unmonitored = float(counts[max_faults + 1 :].sum())
    return _Plan(tuple(" + ".join(s) for s in sets), _Hypotheses(table, products, float(counts[0]), unmonitored))


_STEP = 0.03  # of the table below: to the fourth power over 384, the error of its logarithm
_REACH = 20.0  # P(N(0, 1) > 20) = 3e-89: too small to count in any risk


@lru_cache(maxsize=64)
def _acceptance(dof: int, rate: float) -> Array:
    """log P(χ²(dof, t²) ≤ threshold) as cubic pieces (cells, 4) over t = 0, _STEP, ...

    A Poisson mixture of central χ²: no term is negative, so that it is exact far out as well.
    """
    half = 0.5 * float(chdtri(dof, rate))
    t = np.arange(0.0, math.sqrt(2.0 * half) + _REACH, _STEP)
    # Terms fall off beyond the larger of half the threshold and t √half / √2, where they are largest.
    largest = t[-1] * math.sqrt(0.5 * half) + half
    j = np.arange(largest + 20.0 * math.sqrt(largest) + 60.0)
    a = 0.5 * dof + j
    with np.errstate(divide="ignore"):  # log 0 far out in j
        poisson = j * np.log(np.maximum(0.5 * t * t, 1e-300))[:, None] - 0.5 * (t * t)[:, None] - gammaln(j + 1.0)
        value = _log_sum(poisson + np.log(gammainc(a, half)))
    # By t²: minus half the density with two more degrees of freedom.
    density = _log_sum(poisson + a * math.log(half) - half - gammaln(a + 1.0) - math.log(2.0))
    slope, rise = -2.0 * t * np.exp(density - value) * _STEP, np.diff(value)
    c2, c3 = 3.0 * rise - 2.0 * slope[:-1] - slope[1:], slope[:-1] + slope[1:] - 2.0 * rise
    return np.stack([value[:-1], slope[:-1], c2, c3], axis=1)


def _log_sum(logs: Array) -> Array:
    """log Σ exp over the last axis."""
    top = logs.max(axis=-1, keepdims=True)
    return np.asarray(top[..., 0] + np.log(np.exp(logs - top).sum(axis=-1)))


# The kernels below are compiled; they work in memory that the caller owns.

_HIDDEN = 1e-8  # of a whitened bias: a smaller visible part is rounding
_TOLERANCE = 1e-3  # of a level: the last step; the error left is a tenth of its square


class _Linear(NamedTuple):
    """The problem linearised somewhere, whitened; n rows. J = Q R by Householder's reflections."""

    mirrors: Any  # (6, n) what each reflects by: 1 - v vᵀ / pivot
    pivots: Any  # (6,)
    root: Any  # (6, 6) R
    null: Any  # (n - 6, n) orthonormal, of what no pose explains: P = Nᵀ N
    visible: Any  # (n, n - 6) row by row, what a unit bias of it shows: N L⁻¹ e
    effect: Any  # (n, 5) what it does to the axes: s L⁻¹ e
    share: Any  # (n,) s
    solved: Any  # (5, 6) R⁻ᵀ a
    sigma: Any  # (5,)


class _Shown(NamedTuple):
    """What a set of faulty features can show; up to m rows."""

    basis: Any  # (m, n - 6) orthonormal: N A = U T, here Uᵀ
    triangle: Any  # (m, m) T
    weights: Any  # (m,) z of Tᵀ z = Aᵀ s: g = |z|


class _Elsewhere(NamedTuple):
    """The measurements linearised at another pose."""

    jacobian: Any  # (n, 6)
    predicted: Any  # (n,) of points and lines
    depth: Any  # (K,)
    position: Any  # (3,)
    rotation: Any  # (3, 3)
    turn: Any  # (3, 3)
    increment: Any  # (6,)


class _Worst(NamedTuple):
    """The worst faults, kept from one Newton step to the next."""

    bias: Any  # (h,) root of the non-centrality
    drift: Any  # (h,) its derivative by the level


class _Scratch(NamedTuple):
    """Where one estimate is worked out."""

    unit: Any  # (n, n) row by row, a unit bias of it whitened: L⁻¹ e; set from the diagonal on
    size: Any  # (n,) |L⁻¹ e|
    left: Any  # (n - 6,) the residual: N r
    gradients: Any  # (5, 3) of the axes, by the position
    directions: Any  # (5, 6) increment of the pose for a unit error of an axis
    weights: Any  # (5, h) derivative of an axis' level by the slopes
    linear: Any
    shown: Any
    elsewhere: Any
    worst: Any


@lru_cache(maxsize=64)
def _layout(n: int, k: int, h: int, m: int) -> NDArray[np.int64]:
    """Where the arrays of the scratch begin and end in one piece of memory; h sets of up to m rows."""
    sizes = (
        n * n, n, n - 6, 5 * 3, 5 * 6, 5 * h,
        6 * n, 6, 6 * 6, (n - 6) * n, n * (n - 6), 5 * n, n, 5 * 6, 5,
        m * (n - 6), m * m, m,
        6 * n, n, k, 3, 3 * 3, 3 * 3, 6,
        h, h,
    )  # fmt: skip
    return np.cumsum((0, *sizes))


@kernel
def _scratch_kernel(work, e, n, h, m):  # type: ignore[no-untyped-def]
    """The scratch, cut from `work` at the ends `e`."""
    return _Scratch(
        work[e[0] : e[1]].reshape(n, n), work[e[1] : e[2]], work[e[2] : e[3]], work[e[3] : e[4]].reshape(5, 3),
        work[e[4] : e[5]].reshape(5, 6), work[e[5] : e[6]].reshape(5, h),
        _Linear(
            work[e[6] : e[7]].reshape(6, n), work[e[7] : e[8]], work[e[8] : e[9]].reshape(6, 6),
            work[e[9] : e[10]].reshape(n - 6, n), work[e[10] : e[11]].reshape(n, n - 6),
            work[e[11] : e[12]].reshape(n, 5), work[e[12] : e[13]], work[e[13] : e[14]].reshape(5, 6),
            work[e[14] : e[15]],
        ),
        _Shown(work[e[15] : e[16]].reshape(m, n - 6), work[e[16] : e[17]].reshape(m, m), work[e[17] : e[18]]),
        _Elsewhere(
            work[e[18] : e[19]].reshape(n, 6), work[e[19] : e[20]], work[e[20] : e[21]], work[e[21] : e[22]],
            work[e[22] : e[23]].reshape(3, 3), work[e[23] : e[24]].reshape(3, 3), work[e[24] : e[25]],
        ),
        _Worst(work[e[25] : e[26]], work[e[26] : e[27]]),
    )  # fmt: skip


@kernel
def _protect_kernel(frames, intrinsics, hypotheses, monitor, layout, work, details, out):  # type: ignore[no-untyped-def]
    """N estimates into `out` (N, 5, 5): level, first-order level, sigma, driver, passed."""
    w = _scratch_kernel(work, layout, frames.jacobians.shape[1], *hypotheses.rows.shape)
    for i in range(frames.jacobians.shape[0]):
        for a in range(5):
            out[i, 0, a] = out[i, 1, a] = out[i, 2, a] = math.inf
            out[i, 3, a], out[i, 4, a] = -1.0, 0.0
        frame = _frame_kernel(frames, i)
        _units_kernel(frame.factors, w.unit, w.size)
        _gradients_kernel(frame.positions, frame.points, w.gradients)
        if _project_kernel(frame.jacobians, w.gradients, w.unit, 0, 5, w.linear):
            j = min(i, details.slopes.shape[0] - 1)
            slopes, separations, thresholds = details.slopes[j], details.separations[j], details.thresholds[j]
            _first_levels_kernel(frame.residuals, hypotheses, monitor, w, slopes, separations, thresholds, out[i])
            for a in range(5):
                out[i, 0, a] = _second_level_kernel(
                    frame, intrinsics, hypotheses.rows, w, a, slopes[:, a], out[i, 1, a], out[i, 2, a]
                )


@kernel
def _frame_kernel(frames, i):  # type: ignore[no-untyped-def]
    """Estimate `i` of N."""
    return _Frames(
        frames.residuals[i],
        frames.jacobians[i],
        frames.factors[min(i, frames.factors.shape[0] - 1)],
        frames.positions[i],
        frames.rotations[i],
        frames.points[min(i, frames.points.shape[0] - 1)],
        frames.edges[min(i, frames.edges.shape[0] - 1)],
        frames.lines[min(i, frames.lines.shape[0] - 1)],
    )


@kernel
def _first_levels_kernel(residual, hypotheses, monitor, w, slopes, separations, thresholds, out):  # type: ignore[no-untyped-def]
    """Slopes and levels of all axes, linearised at the estimate, and where each axis' error would lead."""
    rows = hypotheses.rows
    for d in range(w.left.shape[0]):
        w.left[d] = _dot_kernel(w.linear.null[d], residual)
    for s in range(rows.shape[0]):
        _show_kernel(rows[s], w.size, w.linear.visible, w.shown)
        for a in range(5):
            slopes[s, a] = _slope_kernel(rows[s], a, w.size, w.linear, w.shown)
            separations[s, a] = _separation_kernel(w.left, slopes[s, a], w.shown)
    for a in range(5):
        sigma = w.linear.sigma[a]
        level, driver = _level_kernel(slopes[:, a], sigma, hypotheses, monitor, w.worst, w.weights[a])
        passed = not monitor.separation or _passed_kernel(slopes[:, a], separations[:, a], monitor, thresholds[:, a])
        out[1, a], out[2, a], out[3, a], out[4, a] = level, sigma, driver, passed
        copy_kernel(w.linear.solved[a], w.directions[a])
        scale = sigma * sigma
        if driver >= 0:
            _show_kernel(rows[driver], w.size, w.linear.visible, w.shown)
            scale += _slope_kernel(rows[driver], a, w.size, w.linear, w.shown) ** 2
            _add_bias_kernel(rows[driver], w.unit, w.linear, w.shown, w.directions[a])
        _back_kernel(w.linear.root, scale, w.directions[a])


@kernel
def _dot_kernel(x, y):  # type: ignore[no-untyped-def]
    total = 0.0
    for i in range(x.shape[0]):
        total += x[i] * y[i]
    return total


@kernel
def _subtract_kernel(x, unit):  # type: ignore[no-untyped-def]
    """Take from x its part along `unit`; how much that was."""
    along = _dot_kernel(x, unit)
    for i in range(x.shape[0]):
        x[i] -= along * unit[i]
    return along


@kernel
def _orthogonalise_kernel(vectors, c, triangle):  # type: ignore[no-untyped-def]
    """Make vector c orthonormal to those before it (Gram-Schmidt, twice); its length before scaling."""
    x = vectors[c]
    for b in range(c):
        triangle[b, c] = _subtract_kernel(x, vectors[b])
    for b in range(c):
        triangle[b, c] += _subtract_kernel(x, vectors[b])
    length = math.sqrt(_dot_kernel(x, x))
    triangle[c, c] = length
    for i in range(x.shape[0]):
        x[i] /= length
    return length


@kernel
def _gradients_kernel(position, points, out):  # type: ignore[no-untyped-def]
    """The axes' derivatives (5, 3) by the position; the angles' in degrees a metre.

    Lateral: atan2(y, far end - x). Vertical: atan2(z, horizontal distance to the glide path's origin).
    """
    degrees = 180.0 / math.pi
    x, y, z = position[0], position[1], position[2]
    end = points[0, 0]
    for k in range(1, points.shape[0]):
        end = max(end, points[k, 0])
    for a in range(5):
        for b in range(3):
            out[a, b] = 1.0 if a == b else 0.0
    ahead = end - x
    square = ahead * ahead + y * y
    out[3, 0], out[3, 1] = degrees * y / square, degrees * ahead / square
    dx = x - GLIDE_PATH_ORIGIN_M
    level = math.sqrt(dx * dx + y * y)
    square = level * level + z * z
    out[4, 0], out[4, 1] = -degrees * z * dx / (level * square), -degrees * z * y / (level * square)
    out[4, 2] = degrees * level / square


@kernel
def _units_kernel(factor, unit, size):  # type: ignore[no-untyped-def]
    """L⁻¹ e of every row r from its entry r on, by forward substitution, and its length."""
    n = factor.shape[0]
    for r in range(n):
        for i in range(r, n):
            total = 1.0 if i == r else 0.0
            for j in range(r, i):
                total -= factor[i, j] * unit[r, j]
            unit[r, i] = total / factor[i, i]
        size[r] = math.sqrt(_dot_kernel(unit[r, r:], unit[r, r:]))


@kernel
def _mirror_kernel(linear, c, x):  # type: ignore[no-untyped-def]
    """Reflect x by mirror c, which is zero before row c."""
    v, total = linear.mirrors[c], 0.0
    for i in range(c, x.shape[0]):
        total += v[i] * x[i]
    total /= linear.pivots[c]
    for i in range(c, x.shape[0]):
        x[i] -= total * v[i]


@kernel
def _decompose_kernel(jacobian, linear):  # type: ignore[no-untyped-def]
    """J = Q R, and the basis of what is orthogonal to J; False for NaN, or columns that depend on one another."""
    mirrors, n = linear.mirrors, jacobian.shape[0]
    for c in range(6):
        v, square = mirrors[c], 0.0
        for i in range(n):
            v[i] = jacobian[i, c]
        for b in range(c):
            _mirror_kernel(linear, b, v)
            linear.root[b, c] = v[b]
            v[b] = 0.0
        for i in range(c, n):
            square += v[i] * v[i]
        if not square > 0.0:
            return False
        diagonal = -math.copysign(math.sqrt(square), v[c])
        v[c] -= diagonal
        linear.root[c, c], linear.pivots[c] = diagonal, -diagonal * v[c]
    for d in range(n - 6):
        x = linear.null[d]
        for i in range(n):
            x[i] = 1.0 if i == 6 + d else 0.0
        for c in range(5, -1, -1):
            _mirror_kernel(linear, c, x)
    return True


@kernel
def _project_kernel(jacobian, gradients, unit, first, last, linear):  # type: ignore[no-untyped-def]
    """What a bias of each row shows, and does to the axes from `first` to `last`; False without an estimate."""
    if not _decompose_kernel(jacobian, linear):
        return False
    share, n = linear.share, jacobian.shape[0]
    for a in range(first, last):
        solved, square = linear.solved[a], 0.0
        for i in range(n):
            share[i] = 0.0
        for c in range(6):
            total = gradients[a, c] if c < 3 else 0.0
            for b in range(c):
                total -= linear.root[b, c] * solved[b]
            solved[c] = share[c] = total / linear.root[c, c]
            square += solved[c] * solved[c]
        linear.sigma[a] = math.sqrt(square)
        for c in range(5, -1, -1):
            _mirror_kernel(linear, c, share)
        for r in range(n):
            linear.effect[r, a] = _dot_kernel(unit[r, r:], share[r:])
    for r in range(n):
        for d in range(n - 6):
            linear.visible[r, d] = _dot_kernel(unit[r, r:], linear.null[d, r:])
    return True


@kernel
def _show_kernel(rows, size, visible, shown):  # type: ignore[no-untyped-def]
    """N A = U T of a set: what its biases can show. A direction that cannot gets zeros."""
    for j in range(rows.shape[0]):
        row = rows[j]
        if row >= 0:
            copy_kernel(visible[row], shown.basis[j])
            if not _orthogonalise_kernel(shown.basis, j, shown.triangle) > _HIDDEN * size[row]:
                shown.triangle[j, j] = 0.0
                for i in range(visible.shape[1]):
                    shown.basis[j, i] = 0.0


@kernel
def _slope_kernel(rows, a, size, linear, shown):  # type: ignore[no-untyped-def]
    """g of the set shown last: Tᵀ z = Aᵀ s, g = |z|. Infinite where what does not show moves the axis."""
    z, square = shown.weights, 0.0
    for j in range(rows.shape[0]):
        row, z[j] = rows[j], 0.0
        if row >= 0:
            total = linear.effect[row, a]
            for b in range(j):
                total -= shown.triangle[b, j] * z[b]
            if shown.triangle[j, j] > 0.0:
                z[j] = total / shown.triangle[j, j]
            elif abs(total) > _HIDDEN * size[row] * linear.sigma[a]:
                square = math.inf
            square += z[j] * z[j]
    return math.sqrt(square)


@kernel
def _separation_kernel(left, slope, shown):  # type: ignore[no-untyped-def]
    """The estimate less that without the set, along the axis: z·Uᵀ N r; infinite as the slope is."""
    separation = 0.0 if slope < math.inf else math.inf
    for j in range(shown.weights.shape[0]):
        if shown.weights[j] != 0.0:
            separation += shown.weights[j] * _dot_kernel(shown.basis[j], left)
    return separation


# How the estimate without the driver errs when it errs by one unit along an axis: C a / aᵀC a, with
# C = (JᵀJ)⁻¹ + J⁺ A (AᵀPA)⁻¹ Aᵀ J⁺ᵀ, so that C a = R⁻¹ (R⁻ᵀ a + Qᵀ A T⁻¹ z) and aᵀC a = σ² + g².


@kernel
def _add_bias_kernel(rows, unit, linear, shown, out):  # type: ignore[no-untyped-def]
    """Add Qᵀ A T⁻¹ z."""
    triangle, z, bias = shown.triangle, shown.weights, linear.share
    bias[:] = 0.0
    for j in range(rows.shape[0] - 1, -1, -1):
        if rows[j] >= 0 and triangle[j, j] > 0.0:
            z[j] /= triangle[j, j]
            for b in range(j):
                z[b] -= triangle[b, j] * z[j]
            for i in range(rows[j], bias.shape[0]):
                bias[i] += z[j] * unit[rows[j], i]
    for c in range(6):
        _mirror_kernel(linear, c, bias)
        out[c] += bias[c]


@kernel
def _back_kernel(root, scale, out):  # type: ignore[no-untyped-def]
    """R⁻¹ of `out`, over `scale`."""
    for c in range(5, -1, -1):
        for b in range(c + 1, 6):
            out[c] -= root[c, b] * out[b]
        out[c] /= root[c, c]
    for c in range(6):
        out[c] /= scale


@kernel
def _second_level_kernel(frame, intrinsics, rows, w, a, slopes, level, sigma):  # type: ignore[no-untyped-def]
    """The level of axis a with slopes from half-way between the estimate and the truth.

    A level is homogeneous in sigma and the slopes: it is their sum weighted with its derivatives
    (Euler), and with other slopes it is that sum to first order. Then one secant step, to the level
    that is consistent with the slopes half of it away.
    """
    if not 0.0 < level < math.inf:
        return level
    elsewhere = w.elsewhere
    _move_kernel(frame, 0.5 * level, w.directions[a], elsewhere)
    _gradients_kernel(elsewhere.position, frame.points, w.gradients)
    if not (
        _linearise_kernel(frame, intrinsics, elsewhere)
        and _project_kernel(elsewhere.jacobian, w.gradients, w.unit, a, a + 1, w.linear)
    ):
        return math.inf
    # The truth may lie on the other side: to this order the change there is the opposite. Where the
    # worst error is beyond the level in the mean, a wider one exceeds it less; that is not relied on.
    bent, rest = 0.0, level
    for s in range(rows.shape[0]):
        if w.weights[a, s] > 0.0:
            _show_kernel(rows[s], w.size, w.linear.visible, w.shown)
            slope = _slope_kernel(rows[s], a, w.size, w.linear, w.shown)
            bent += w.weights[a, s] * (slopes[s] + abs(slope - slopes[s]))
            rest -= w.weights[a, s] * slopes[s]
    bent += rest + max(rest, 0.0) * abs(w.linear.sigma[a] / sigma - 1.0)
    growth = 1.0 / (2.0 - bent / level) if bent < 2.0 * level else math.inf
    return level * growth if growth < LARGEST_GROWTH else math.inf


@kernel
def _move_kernel(frame, size, direction, elsewhere):  # type: ignore[no-untyped-def]
    """The pose moved by `size` along `direction`, or against it: away from the points."""
    points, position, away = frame.points, frame.positions, 0.0
    for k in range(points.shape[0]):
        for a in range(3):
            away += direction[a] * (position[a] - points[k, a])
    size = math.copysign(size, away)
    for c in range(6):
        elsewhere.increment[c] = size * direction[c]
    for a in range(3):
        elsewhere.position[a] = position[a] + elsewhere.increment[a]
    cayley_kernel(elsewhere.increment[3:], elsewhere.turn)
    product_kernel(frame.rotations, elsewhere.turn, elsewhere.rotation)


@kernel
def _linearise_kernel(frame, intrinsics, elsewhere):  # type: ignore[no-untyped-def]
    """The whitened Jacobian at the moved pose; False where a point is not in view."""
    jacobian, predicted, factor = elsewhere.jacobian, elsewhere.predicted, frame.factors
    n, first, lines = jacobian.shape[0], 2 * frame.points.shape[0], frame.edges.shape[0]
    project_kernel(
        frame.points, elsewhere.rotation, elsewhere.position, intrinsics, predicted, jacobian, elsewhere.depth
    )
    for k in range(elsewhere.depth.shape[0]):
        if not elsewhere.depth[k] > 0.0:
            return False
    for k in range(lines):  # of the two forms of a line, the measured one
        predicted[first + 2 * k], predicted[first + 2 * k + 1] = frame.lines[k, 0], frame.lines[k, 1]
    lines_kernel(frame.edges, elsewhere.rotation, elsewhere.position, intrinsics, first, predicted, jacobian)
    for i in range(n):
        for c in range(6):
            if i < first + 2 * lines:
                total = jacobian[i, c]
                for j in range(i):
                    total -= factor[i, j] * jacobian[j, c]
                jacobian[i, c] = total / factor[i, i]
            else:  # what sensors say is linear in the pose
                jacobian[i, c] = frame.jacobians[i, c]
    return True


@kernel
def _passed_kernel(slopes, separations, monitor, thresholds):  # type: ignore[no-untyped-def]
    """Solution separation's test of one axis: |separation| ≤ K g; the false alarms in equal parts."""
    monitored, passed = 0, True
    for s in range(slopes.shape[0]):
        monitored += slopes[s] < math.inf
    factor = _quantile_kernel(monitor.false_alarm_rate / max(monitored, 1))
    for s in range(slopes.shape[0]):
        thresholds[s] = factor * slopes[s]
        passed = passed and abs(separations[s]) <= thresholds[s]
    return passed


@kernel
def _level_kernel(slopes, sigma, hypotheses, monitor, worst, weights):  # type: ignore[no-untyped-def]
    """The level of one axis and its driver, once the faults that can hide are charged to the risk.

    `weights` (h,) gets its derivatives by the slopes.
    """
    risk, monitored = monitor.risk - hypotheses.unmonitored, 0
    driver, most = -2, hypotheses.unmonitored
    for s in range(slopes.shape[0]):
        weights[s] = 0.0
        if slopes[s] < math.inf:
            monitored += 1
        else:
            risk -= hypotheses.priors[s]
            if hypotheses.priors[s] > most:
                driver, most = s, hypotheses.priors[s]
    if not risk > 0.0:
        return math.inf, driver
    if monitor.separation:
        return _separation_level_kernel(slopes, sigma, hypotheses, monitor, risk, monitored, weights)
    return _residual_level_kernel(slopes, sigma, hypotheses, monitor, risk, worst, weights)


@kernel
def _separation_level_kernel(slopes, sigma, hypotheses, monitor, risk, monitored, weights):  # type: ignore[no-untyped-def]
    """Solution separation: the largest of K sigma over the hypotheses; the risk in equal parts."""
    share = risk / (monitored + 1)
    tolerated = _quantile_kernel(monitor.false_alarm_rate / max(monitored, 1))
    level, driver = _quantile_kernel(share / hypotheses.fault_free) * sigma, -1
    for s in range(slopes.shape[0]):
        if slopes[s] < math.inf and hypotheses.priors[s] > share:
            without = math.sqrt(sigma * sigma + slopes[s] * slopes[s])
            missed = _quantile_kernel(share / hypotheses.priors[s])
            bound = tolerated * slopes[s] + missed * without
            if bound > level:
                if driver >= 0:
                    weights[driver] = 0.0
                level, driver, weights[s] = bound, s, tolerated + missed * slopes[s] / without
    return level, driver


@kernel
def _residual_level_kernel(slopes, sigma, hypotheses, monitor, risk, worst, weights):  # type: ignore[no-untyped-def]
    """The level at which the χ² test's missed errors take up the risk.

    In units of sigma, k = g / sigma, F(t) = P(accepted): P(no fault) (1 - rate) 2Q(x)
    + Σ p max over t of P(|N(k t, 1)| > x) F(t) = risk. By the envelope theorem the worst t may be
    held in the derivative by x.
    """
    nominal = hypotheses.fault_free * (1.0 - monitor.false_alarm_rate)
    high, x = _guess_kernel(slopes, sigma, hypotheses, monitor, risk, nominal)
    low = 0.0
    worst.bias[:] = math.nan
    driver = -1
    for _ in range(200):
        tail, density = _tail_kernel(x)
        total, fall = 2.0 * nominal * tail, 2.0 * nominal * density
        driver, most, scale = -1, total, nominal
        for s in range(slopes.shape[0]):
            if slopes[s] < math.inf:
                chance, rate, pull = _worst_kernel(x, slopes[s] / sigma, monitor.root, monitor.acceptance, worst, s)
                prior = hypotheses.priors[s]
                total, fall, weights[s] = total + prior * chance, fall + prior * rate, prior * pull
                if prior * chance > most:
                    driver, most, scale = s, prior * chance, prior
        if total > risk:
            low = x
        else:
            high = x
        new = x + _step_kernel(total, fall, scale * total / most, risk)
        if not low < new < high:
            new = 0.5 * (low + high)
        step = new - x
        x = new
        if abs(step) <= _TOLERANCE * x:
            break
        for s in range(slopes.shape[0]):
            worst.bias[s] += worst.drift[s] * step
    for s in range(slopes.shape[0]):
        weights[s] /= fall
    return x * sigma, driver


@kernel
def _guess_kernel(slopes, sigma, hypotheses, monitor, risk, nominal):  # type: ignore[no-untyped-def]
    """A bound of the level and a guess at it, in units of sigma.

    As Q(z) ≤ exp(-z²/2) / 2 and F(t) ≤ Q(t - root of the threshold), beyond the bound no term
    exceeds its equal share of the risk.
    """
    high, guess, share = 0.0, 0.0, risk / (slopes.shape[0] + 1)
    for s in range(-1, slopes.shape[0]):
        prior, k = (hypotheses.priors[s], slopes[s] / sigma) if s >= 0 else (nominal, 0.0)
        if k < math.inf and share < prior:
            reach = math.sqrt(2.0 * math.log(2.0 * prior / share))
            high = max(high, k * (monitor.root + reach) + reach)
            guess = max(guess, k * monitor.root + 0.8 * reach * math.sqrt(1.0 + k * k))
    return high, guess


@kernel
def _step_kernel(total, fall, scale, target):  # type: ignore[no-untyped-def]
    """Newton's step for total(x) = target, -fall its derivative, on the root of log(scale / total).

    Of a Gaussian tail that root is nearly straight. Scale and total may not be less than target and 0.
    """
    height = math.sqrt(2.0 * math.log(scale / total))
    return (math.sqrt(2.0 * math.log(max(scale / target, 1.0))) - height) * height * total / fall


@kernel
def _worst_kernel(x, k, root, acceptance, worst, s):  # type: ignore[no-untyped-def]
    """max over t of P(|N(k t, 1)| > x) F(t), minus its derivative by x, and that by k; t and dt/dx into row s.

    Both factors are log-concave in t² (Sun, Baricz & Zhou 2010), so that there is one maximum.
    """
    low, high = 0.0, _STEP * (acceptance.shape[0] - 1)
    if x - k * high > _REACH:  # does not count, whatever t
        return 0.0, 0.0, 0.0
    log_accepted, _, bow = _accept_kernel(0.0, acceptance)
    if k * k * x * x + bow <= 0.0:  # else it pays to show, as density / tail > x
        tail, density = _tail_kernel(x)
        if k * k * x * density / tail + bow <= 0.0:
            worst.bias[s] = math.nan
            accepted = 2.0 * math.exp(log_accepted)
            return tail * accepted, density * accepted, 0.0
    t = worst.bias[s]
    if not 0.0 < t < high:
        t = min((root + k * x) / (1.0 + k * k), 0.5 * high)
    for _ in range(100):
        chance, density, rise, bend = _exceed_kernel(x, k * t)
        log_accepted, fall, bow = _accept_kernel(t, acceptance)
        gradient, curvature = k * rise + fall, k * k * bend + bow
        step = -gradient / curvature
        if curvature < 0.0 and step * gradient < 1e-8:
            break
        if gradient > 0.0:
            low = t
        else:
            high = t
        t = t + step if curvature < 0.0 and low < t + step < high else 0.5 * (low + high)
    worst.bias[s], worst.drift[s] = t + step, k * bend / curvature
    accepted = math.exp(log_accepted + 0.5 * step * gradient)  # with what the last step still brings
    return chance * accepted, density * accepted, t * rise * chance * accepted


@kernel
def _accept_kernel(t, acceptance):  # type: ignore[no-untyped-def]
    """log F, its first and its second derivative."""
    cell = min(int(t / _STEP), acceptance.shape[0] - 1)
    u = t / _STEP - cell
    c0, c1, c2, c3 = acceptance[cell, 0], acceptance[cell, 1], acceptance[cell, 2], acceptance[cell, 3]
    value = c0 + u * (c1 + u * (c2 + u * c3))
    return value, (c1 + u * (2.0 * c2 + 3.0 * u * c3)) / _STEP, (2.0 * c2 + 6.0 * u * c3) / (_STEP * _STEP)


@kernel
def _exceed_kernel(x, u):  # type: ignore[no-untyped-def]
    """P(|N(u, 1)| > x), minus its derivative by x, and two derivatives of its logarithm by u."""
    z = x - u
    total, density = _tail_kernel(z)
    if z > 30.0:  # density / total as a series: soon neither is a number
        rise = z + 1.0 / z - 2.0 / z**3
        return total, density, rise, rise * (z - rise)
    rise, bend = density, z * density
    if x * u < 20.0:  # else the other tail is less than e^-40 of this one
        tail, other = _tail_kernel(x + u)
        total, density, rise, bend = total + tail, density + other, rise - other, bend + (x + u) * other
    rise, bend = rise / total, bend / total
    return total, density, rise, bend - rise * rise


@kernel
def _tail_kernel(z):  # type: ignore[no-untyped-def]
    """P(N(0, 1) > z) and the density there."""
    return 0.5 * math.erfc(z * math.sqrt(0.5)), math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)


@kernel
def _quantile_kernel(probability):  # type: ignore[no-untyped-def]
    """k ≥ 0 with P(|N(0, 1)| > k) = probability; 0 from a probability of 1 on."""
    if not probability < 1.0:
        return 0.0
    k = math.sqrt(-2.0 * math.log(probability))
    for _ in range(50):
        tail, density = _tail_kernel(k)
        step = _step_kernel(2.0 * tail, 2.0 * density, 1.0, probability)
        k += step
        if abs(step) <= 1e-7 * k:  # its square is left
            break
    return k
