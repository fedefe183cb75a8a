"""The pose that best explains Gaussian keypoints, with its covariance and an honest status.

The cost is the whitened sum of squares of Valentin et al. 2025 (arXiv 2508.09732, Algorithm 1),
J(pose) = |L⁻¹ (keypoints - projection)|² with L Lᵀ = Σ, minimised by Levenberg-Marquardt
(Marquardt 1963) in the local increment of `Pose.plus`. A plane seen at a grazing angle has two
near-optima, so both solutions of IPPE (Collins & Bartoli 2014) are starts, and the lowest physical
optimum is kept. Frames, axes and units: the table of conventions in docs/architecture.md.
"""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from shortfinal.errors import InputError
from shortfinal.geometry import (
    BODY_FROM_CAMERA,
    Camera,
    Pose,
    as_array,
    exp_kernel,
    normalise_kernel,
    project_kernel,
)
from shortfinal.keypoints import CORNER_NAMES, GaussianKeypoints

Array = NDArray[np.float64]

# A second optimum less than this much worse in χ² cannot be told apart: at 2 ln 1000 the data are
# a thousand times likelier under the first.
AMBIGUITY_CHI2 = 2.0 * math.log(1000.0)
MAX_ITERATIONS = 50
CHUNK = 512  # problems a thread takes at once: some milliseconds of work


class SolverStatus(Enum):
    """How a solve ended. Only the first two come with a pose."""

    CONVERGED = "converged"  # one physical optimum, well determined
    AMBIGUOUS = "ambiguous"  # a second physical optimum explains the keypoints about as well
    ILL_CONDITIONED = "ill-conditioned"  # the points leave a direction free, or Σ is not positive definite
    BEHIND_CAMERA = "behind-camera"  # every optimum has a point behind, or the camera under ground or upside down
    MAX_ITERATIONS = "max-iterations"  # no start reached an optimum in the iterations allowed
    NON_FINITE = "non-finite"  # NaN or infinity, in the input or (by overflow) in the arithmetic


# The kernels' codes are the positions in the enum; of several failed starts the lowest is reported.
STATUS_OF_CODE = tuple(SolverStatus)
_CONVERGED, _AMBIGUOUS, _ILL_CONDITIONED, _BEHIND_CAMERA, _MAX_ITERATIONS, _NON_FINITE = range(len(STATUS_OF_CODE))


class Feature(NamedTuple):
    """One thing measured: its name, and its rows in the residual, the Jacobian and the factor."""

    name: str
    rows: slice


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A pose, how sure it is, and what is left over.

    With a status other than CONVERGED and AMBIGUOUS there is no estimate: `pose` and `cov` are
    None, and `residual`, `jacobian` and `chi2` are NaN. "Whitened" is multiplied by L⁻¹, Σ = L Lᵀ.
    """

    pose: Pose | None
    cov: Array | None  # (6, 6) of the local increment, m and rad: (Hᵀ Σ⁻¹ H)⁻¹, the Cramér-Rao bound
    status: SolverStatus
    residual: Array  # (2K,) whitened keypoints minus projection
    jacobian: Array  # (2K, 6) whitened d(projection) / d(local increment)
    chi2: float  # the cost: sum of squares of the residual
    iterations: int  # Levenberg-Marquardt steps tried, over all starts
    keypoints: GaussianKeypoints
    points: Array  # (K, 3) m, runway frame
    camera: Camera

    @property
    def dof(self) -> int:
        """Degrees of freedom left for checking: 2K - 6."""
        return len(self.residual) - 6

    @cached_property
    def features(self) -> tuple[Feature, ...]:
        """What was measured, in the order of the rows."""
        return keypoint_features(len(self.points))

    @cached_property
    def factor(self) -> Array:
        """L (n, n), the Cholesky factor of the covariance of all rows: whitening divides by it."""
        return np.asarray(np.linalg.cholesky(self.keypoints.cov_px))

    @property
    def sigma_position_m(self) -> Array | None:
        """Standard deviations (3,) of x, y, z in the runway frame; None without an estimate."""
        return None if self.cov is None else np.sqrt(np.diag(self.cov)[:3])


@dataclass(frozen=True, eq=False)
class PoseEstimateBatch:
    """N estimates as arrays; the numbers of a problem neither CONVERGED nor AMBIGUOUS are NaN."""

    positions: Array  # (N, 3) m
    rotations: Array  # (N, 3, 3) runway_from_camera
    covs: Array  # (N, 6, 6)
    status_codes: NDArray[np.int64]  # (N,) index into STATUS_OF_CODE
    residuals: Array  # (N, 2K) whitened
    jacobians: Array  # (N, 2K, 6) whitened
    chi2: Array  # (N,)
    iterations: NDArray[np.int64]  # (N,)
    mean_px: Array  # (N, K, 2)
    cov_px: Array  # (N, 2K, 2K), or (1, 2K, 2K) when shared
    points: Array  # (N, K, 3), or (1, K, 3) when shared
    camera: Camera

    def __len__(self) -> int:
        return len(self.chi2)

    def __getitem__(self, i: int) -> PoseEstimate:
        """Problem `i` by itself. Raises InputError if its keypoints are no valid Gaussian."""
        mean, cov, points = (a[i if len(a) > 1 else 0] for a in (self.mean_px, self.cov_px, self.points))
        return _estimate(self._kernel_arrays(), i, GaussianKeypoints(mean, cov), points, self.camera)

    @property
    def converged(self) -> NDArray[np.bool_]:
        """Which problems (N,) have status CONVERGED."""
        return np.asarray(self.status_codes == _CONVERGED)

    @property
    def dof(self) -> int:
        """Degrees of freedom left for checking: 2K - 6."""
        return int(self.residuals.shape[1]) - 6

    def status(self, i: int) -> SolverStatus:
        """The status of problem `i`."""
        return STATUS_OF_CODE[int(self.status_codes[i])]

    def _kernel_arrays(self) -> _Result:
        return _Result(*(getattr(self, name) for name in _Result._fields))


def estimate_pose(
    keypoints: GaussianKeypoints,
    points: ArrayLike,
    camera: Camera,
    *,
    initial: Pose | None = None,
    max_iterations: int = MAX_ITERATIONS,
) -> PoseEstimate:
    """The most likely pose of `camera`, given where it sees `points` (K, 3; metres, runway frame).

    `initial` is one more start beside the solver's own; `max_iterations` holds for each start.
    A physical optimum has every point in front of the camera, the camera above z = 0, and the top
    of the image upwards. Hopeless geometry is a status. Raises InputError for fewer than four
    points, or points that do not match the keypoints.
    """
    world = as_array(points, (None, 3), "points")
    _check_counts(len(keypoints.mean_px), len(world))
    result = _allocate(1, len(world))
    _solve_kernel(
        # Copies: read-only arrays are another type to the compiler, and would be compiled for anew.
        keypoints.mean_px.reshape(1, -1).copy(),
        keypoints.cov_px[None].copy(),
        world[None].copy(),
        camera.intrinsics,
        *_starts(initial),
        max_iterations,
        result,
    )
    return _estimate(result, 0, keypoints, world, camera)


def estimate_pose_batch(
    mean_px: ArrayLike,
    cov_px: ArrayLike,
    points: ArrayLike,
    camera: Camera,
    *,
    max_iterations: int = MAX_ITERATIONS,
    threads: int | None = None,
) -> PoseEstimateBatch:
    """`estimate_pose` for N problems: keypoints (N, K, 2), covariance (N, 2K, 2K) or one (2K, 2K),
    points (N, K, 3) or one (K, 3); on `threads` threads (default: one per processor).

    The numbers are not refused but answered: a NaN gives its problem NON_FINITE, a covariance that
    is not positive definite ILL_CONDITIONED. Raises InputError for shapes that do not match.
    """
    mean, cov, world = (np.array(a, np.float64, order="C") for a in (mean_px, cov_px, points))
    cov, world = (a[None] if a.ndim == 2 else a for a in (cov, world))
    _check_shapes(mean, cov, world)
    count, k = mean.shape[:2]
    result, flat = _allocate(count, k), mean.reshape(count, 2 * k)

    def solve(start: int) -> None:
        part = slice(start, start + CHUNK)
        _solve_kernel(
            flat[part],
            cov[part] if len(cov) == count else cov,
            world[part] if len(world) == count else world,
            camera.intrinsics,
            *_starts(None),
            max_iterations,
            _Result(*(array[part] for array in result)),
        )

    with ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        list(pool.map(solve, range(0, count, CHUNK)))
    return PoseEstimateBatch(**result._asdict(), mean_px=mean, cov_px=cov, points=world, camera=camera)


class _Result(NamedTuple):
    """What the kernel writes, one row a problem; the fields are those of PoseEstimateBatch."""

    positions: Any
    rotations: Any
    covs: Any
    residuals: Any
    jacobians: Any
    chi2: Any
    status_codes: Any
    iterations: Any


class _Problem(NamedTuple):
    """One problem; refilled for each. The kernels' tuples are small: passing one costs its length."""

    mean: Any  # (2K,) px
    whitener: Any  # (2K, 2K) Cholesky factor L of the covariance
    points: Any  # (K, 3)
    intrinsics: Any  # (12,)
    depth: Any  # (K,) scratch


class _State(NamedTuple):
    """A pose, and the whitened residual and Jacobian there."""

    rotation: Any  # (3, 3)
    position: Any  # (3,)
    residual: Any  # (2K,)
    jacobian: Any  # (2K, 6)


class _System(NamedTuple):
    """The normal equations of a step."""

    normal: Any  # (6, 6) JᵀJ
    gradient: Any  # (6,) Jᵀr
    factor: Any  # (6, 6) Cholesky factor, damped or not
    step: Any  # (6,)
    turn: Any  # (3, 3)


class _Planar(NamedTuple):
    """Where the planar starts are worked out."""

    flat: Any  # (K, 4) coordinates in the plane, undistorted image coordinates
    runway_from_plane: Any  # (3, 3)
    centre: Any  # (3,) of the points
    normal: Any  # (8, 8) of the homography
    coefficients: Any  # (8,)
    turn: Any  # (3, 3)
    tilt: Any  # (3, 3)
    camera_from_plane: Any  # (3, 3)


def keypoint_features(count: int) -> tuple[Feature, ...]:
    """The features of `count` keypoints: the corners by name, further ones by number."""
    names = [*CORNER_NAMES, *(f"point {k}" for k in range(len(CORNER_NAMES), count))][:count]
    return tuple(Feature(name, slice(2 * k, 2 * k + 2)) for k, name in enumerate(names))


def _check_counts(keypoints: int, points: int) -> None:
    if keypoints != points:
        raise InputError(f"points: {points} points for {keypoints} keypoints; give one point per keypoint")
    if points < 4:
        raise InputError(
            f"points: got {points}; three points give six equations for six unknowns and up to four poses, "
            "with nothing left to choose or check; give at least four"
        )


def _check_shapes(mean: Array, cov: Array, world: Array) -> None:
    if mean.ndim != 3 or mean.shape[2] != 2 or len(mean) == 0:
        raise InputError(f"mean_px: expected shape (N, K, 2) with N > 0, got {mean.shape}")
    count, k = mean.shape[:2]
    for array, name, shape in ((cov, "cov_px", (2 * k, 2 * k)), (world, "points", (k, 3))):
        if array.shape not in ((1, *shape), (count, *shape)):
            raise InputError(f"{name}: expected shape {shape} or {(count, *shape)}, got {array.shape}")
    _check_counts(k, world.shape[1])


def _allocate(count: int, k: int) -> _Result:
    shapes = ((3,), (3, 3), (6, 6), (2 * k,), (2 * k, 6), ())
    numbers = [np.full((count, *shape), np.nan) for shape in shapes]
    codes = [np.zeros(count, np.int64) for _ in range(2)]
    return _Result(*numbers, *codes)


def _starts(initial: Pose | None) -> tuple[Array, Array]:
    """Given starts as arrays: rotations (S, 3, 3) and positions (S, 3), S = 0 or 1."""
    if initial is None:
        return np.empty((0, 3, 3)), np.empty((0, 3))
    return np.array([initial.runway_from_camera]), np.array([initial.position_m])


def _estimate(result: _Result, i: int, keypoints: GaussianKeypoints, points: Array, camera: Camera) -> PoseEstimate:
    status = STATUS_OF_CODE[result.status_codes[i]]
    solved = status in (SolverStatus.CONVERGED, SolverStatus.AMBIGUOUS)
    return PoseEstimate(
        pose=Pose(result.positions[i], result.rotations[i]) if solved else None,
        cov=_frozen(result.covs[i]) if solved else None,
        status=status,
        residual=_frozen(result.residuals[i]),
        jacobian=_frozen(result.jacobians[i]),
        chi2=float(result.chi2[i]),
        iterations=int(result.iterations[i]),
        keypoints=keypoints,
        points=points,
        camera=camera,
    )


def _frozen(array: Array) -> Array:
    copy = array.copy()
    copy.setflags(write=False)
    return copy


# The kernels below are compiled. They work in memory the caller owns: nothing is allocated per
# problem, and the interpreter's lock is released for the whole of a chunk.

# Scaled pivot (see _cholesky_kernel). Points on a line leave 1e-15, a 300 m runway at 60 km 1e-6.
_SINGULAR = 1e-12
_STEP_TOLERANCE = 1e-12  # δᵀJᵀJδ: the last step is below a millionth of a standard deviation
_FIRST_DAMPING = 1e-4
# Attitude known to this (rad, 1σ) rules out an optimum that hangs upside down. Measured: of 80,000
# noisy runways none with a second optimum was known to better than 0.14 rad.
_SURE_TURN = 0.05


@njit(cache=True, nogil=True, error_model="numpy")
def _solve_kernel(mean, cov, points, intrinsics, rotations, positions, max_iterations, out):  # type: ignore[no-untyped-def]
    """N problems into `out`; `cov` and `points` have N rows or a single one, shared."""
    k, given = points.shape[1], rotations.shape[0]
    problem = _Problem(np.empty(2 * k), np.empty((2 * k, 2 * k)), np.empty((k, 3)), intrinsics, np.empty(k))
    best, current, trial = _state_kernel(k), _state_kernel(k), _state_kernel(k)
    system = _System(np.empty((6, 6)), np.empty(6), np.empty((6, 6)), np.empty(6), np.empty((3, 3)))
    planar = _planar_kernel(k)
    all_rotations, all_positions = np.empty((given + 2, 3, 3)), np.empty((given + 2, 3))
    all_rotations[:given] = rotations
    all_positions[:given] = positions
    for i in range(mean.shape[0]):
        problem.mean[:] = mean[i]
        problem.points[:] = points[min(i, points.shape[0] - 1)]
        problem.whitener[:] = cov[min(i, cov.shape[0] - 1)]
        status, iterations = _admit_kernel(problem), 0
        if status == _CONVERGED:
            starts = given + _planar_starts_kernel(problem, planar, all_rotations[given:], all_positions[given:])
            status, iterations = _search_kernel(
                problem, all_rotations[:starts], all_positions[:starts], best, current, trial, system, max_iterations
            )
        out.status_codes[i], out.iterations[i] = status, iterations
        if status <= _AMBIGUOUS:
            _write_kernel(problem, best, system, i, out)


@njit(cache=True, nogil=True, error_model="numpy")
def _state_kernel(k):  # type: ignore[no-untyped-def]
    return _State(np.empty((3, 3)), np.empty(3), np.empty(2 * k), np.empty((2 * k, 6)))


@njit(cache=True, nogil=True, error_model="numpy")
def _planar_kernel(k):  # type: ignore[no-untyped-def]
    square = (3, 3)
    return _Planar(
        np.empty((k, 4)), np.empty(square), np.empty(3), np.empty((8, 8)), np.empty(8),
        np.empty(square), np.empty(square), np.empty(square),
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _admit_kernel(problem):  # type: ignore[no-untyped-def]
    """Refuse NaN, infinity and a skew covariance; replace the covariance by its Cholesky factor."""
    for array in (problem.mean, problem.points.ravel(), problem.whitener.ravel()):
        for value in array:
            if not math.isfinite(value):
                return _NON_FINITE
    cov = problem.whitener
    for i in range(cov.shape[0]):
        for j in range(i):
            if abs(cov[i, j] - cov[j, i]) > 1e-8 * math.sqrt(abs(cov[i, i] * cov[j, j])):
                return _ILL_CONDITIONED
    return _CONVERGED if _cholesky_kernel(problem.whitener) > _SINGULAR else _ILL_CONDITIONED


@njit(cache=True, nogil=True, error_model="numpy")
def _search_kernel(problem, rotations, positions, best, current, trial, system, max_iterations):  # type: ignore[no-untyped-def]
    """Refine the starts; the status and the iterations, with the lowest physical optimum in `best`.

    IPPE's second start is, for a runway, an upside-down view, and slow to refine. Once the first
    has led to a physical optimum with well-known attitude the other cannot lead to one as well.
    """
    status, iterations, lowest, rival, sure = _NON_FINITE, 0, math.inf, math.inf, False
    starts = rotations.shape[0]
    for s in range(starts + 1):
        if s == starts:
            if status == _CONVERGED:
                break
            _level_start_kernel(problem, current)
        elif sure and not _physical_kernel(rotations[s], positions[s]):
            continue
        else:
            current.rotation[:] = rotations[s]
            current.position[:] = positions[s]
        outcome, cost, steps = _refine_kernel(problem, current, trial, system, max_iterations)
        status, iterations = min(status, outcome), iterations + steps
        if outcome != _CONVERGED:
            continue
        distinct = lowest < math.inf and _separation_kernel(system.normal, current, best) > 1.0
        if cost < lowest:
            rival = lowest if distinct else rival
            lowest, sure = cost, _turn_variance_kernel(system.factor) < _SURE_TURN**2
            best.rotation[:] = current.rotation
            best.position[:] = current.position
        elif distinct:
            rival = min(rival, cost)
    if status == _CONVERGED and rival - lowest < AMBIGUITY_CHI2:
        status = _AMBIGUOUS
    return status, iterations


@njit(cache=True, nogil=True, error_model="numpy")
def _turn_variance_kernel(factor):  # type: ignore[no-untyped-def]
    """Sum of the three variances of the rotation, rad².

    The last rows of the factor of JᵀJ are the factor of the rotation's marginal information.
    """
    a, b, c = factor[3, 3], factor[4, 3], factor[4, 4]
    d, e, f = factor[5, 3], factor[5, 4], factor[5, 5]
    off = (b / (a * c)) ** 2 + (e / (c * f)) ** 2 + ((b * e - c * d) / (a * c * f)) ** 2
    return 1.0 / a**2 + 1.0 / c**2 + 1.0 / f**2 + off


@njit(cache=True, nogil=True, error_model="numpy")
def _separation_kernel(normal, one, other):  # type: ignore[no-untyped-def]
    """Squared distance of two poses, each axis in the standard deviations it has by itself."""
    total = 0.0
    for a in range(3):
        total += normal[a, a] * (one.position[a] - other.position[a]) ** 2
        for b in range(3):  # |R1 - R2|² / 2 is the angle squared, for small angles
            total += 0.5 * normal[3 + a, 3 + a] * (one.rotation[b, a] - other.rotation[b, a]) ** 2
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _write_kernel(problem, best, system, i, out):  # type: ignore[no-untyped-def]
    """The best optimum, with everything that belongs to it, into row `i`."""
    out.chi2[i] = _evaluate_kernel(problem, best)
    out.positions[i] = best.position
    out.rotations[i] = best.rotation
    out.residuals[i] = best.residual
    out.jacobians[i] = best.jacobian
    _normal_kernel(best.jacobian, best.residual, system.normal, system.gradient)
    _cholesky_kernel(system.normal)
    for column in range(6):
        out.covs[i, column] = 0.0
        out.covs[i, column, column] = 1.0
        _solve_factored_kernel(system.normal, out.covs[i, column])


@njit(cache=True, nogil=True, error_model="numpy")
def _refine_kernel(problem, current, trial, system, max_iterations):  # type: ignore[no-untyped-def]
    """Levenberg-Marquardt from the current pose, in place: outcome, cost, iterations."""
    cost = _evaluate_kernel(problem, current)
    if not cost < math.inf:
        return (_BEHIND_CAMERA if cost == math.inf else _NON_FINITE), cost, 0
    _normal_kernel(current.jacobian, current.residual, system.normal, system.gradient)
    damping, outcome, iteration = _FIRST_DAMPING, _MAX_ITERATIONS, 0
    while outcome == _MAX_ITERATIONS and iteration < max_iterations:
        iteration += 1
        size = _step_kernel(system, damping)
        _move_kernel(current, system, trial)
        tried = _evaluate_kernel(problem, trial)
        # The second term: below the rounding of the cost no decrease can be seen.
        if size < _STEP_TOLERANCE + 1e-15 * cost:
            outcome = _CONVERGED
        if tried < cost:
            cost, damping = tried, 0.1 * damping
            current.rotation[:] = trial.rotation
            current.position[:] = trial.position
            _normal_kernel(trial.jacobian, trial.residual, system.normal, system.gradient)
        else:
            damping = 10.0 * damping
    return _judge_kernel(current, system, outcome), cost, iteration


@njit(cache=True, nogil=True, error_model="numpy")
def _judge_kernel(current, system, outcome):  # type: ignore[no-untyped-def]
    """What the end of a refinement is worth: is it determined, and is it physical?"""
    system.factor[:] = system.normal
    if not _cholesky_kernel(system.factor) > _SINGULAR:
        return _ILL_CONDITIONED
    if outcome == _CONVERGED and not _physical_kernel(current.rotation, current.position):
        return _BEHIND_CAMERA
    return outcome


@njit(cache=True, nogil=True, error_model="numpy")
def _physical_kernel(rotation, position):  # type: ignore[no-untyped-def]
    """Above the ground and upright: the image's y axis points down."""
    return position[2] > 0.0 and rotation[2, 1] < 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _step_kernel(system, damping):  # type: ignore[no-untyped-def]
    """Solve (JᵀJ + damping diag JᵀJ) δ = Jᵀr (Marquardt 1963); returns δᵀJᵀJδ."""
    normal, factor, gradient, step = system.normal, system.factor, system.gradient, system.step
    factor[:] = normal
    step[:] = gradient
    for a in range(6):
        factor[a, a] *= 1.0 + damping
    if not _cholesky_kernel(factor) > 0.0:
        step[:] = math.nan  # the trial fails and the damping grows
    _solve_factored_kernel(factor, step)
    size = 0.0
    for a in range(6):  # δᵀJᵀJδ = δᵀ(Jᵀr - damping diag(JᵀJ) δ)
        size += step[a] * (gradient[a] - damping * normal[a, a] * step[a])
    return size


@njit(cache=True, nogil=True, error_model="numpy")
def _move_kernel(current, system, trial):  # type: ignore[no-untyped-def]
    """The pose moved by the step: p + δp, R exp(δθ)."""
    exp_kernel(system.step[3:], system.turn)
    _product_kernel(current.rotation, system.turn, trial.rotation)
    for a in range(3):
        trial.position[a] = current.position[a] + system.step[a]


@njit(cache=True, nogil=True, error_model="numpy")
def _evaluate_kernel(problem, state):  # type: ignore[no-untyped-def]
    """Whitened residual and Jacobian at the pose; the cost, infinite with a point behind the camera."""
    project_kernel(
        problem.points,
        state.rotation,
        state.position,
        problem.intrinsics,
        state.residual,
        state.jacobian,
        problem.depth,
    )
    for depth in problem.depth:
        if not depth > 0.0:  # behind, or NaN: beyond the range of the distortion
            return math.inf
    return _whiten_kernel(problem.whitener, problem.mean, state.residual, state.jacobian)


@njit(cache=True, nogil=True, error_model="numpy")
def _whiten_kernel(whitener, mean, residual, jacobian):  # type: ignore[no-untyped-def]
    """L⁻¹ (mean - residual) and L⁻¹ jacobian in place, by forward substitution; the cost."""
    cost = 0.0
    for i in range(residual.shape[0]):
        value = mean[i] - residual[i]
        for j in range(i):
            entry = whitener[i, j]
            if entry != 0.0:  # mostly zero when the keypoints are independent
                value -= entry * residual[j]
                for c in range(6):
                    jacobian[i, c] -= entry * jacobian[j, c]
        scale = 1.0 / whitener[i, i]
        residual[i] = value * scale
        for c in range(6):
            jacobian[i, c] *= scale
        cost += residual[i] * residual[i]
    return cost if math.isfinite(cost) else math.nan


@njit(cache=True, nogil=True, error_model="numpy")
def _normal_kernel(jacobian, residual, normal, gradient):  # type: ignore[no-untyped-def]
    """JᵀJ and Jᵀr."""
    for a in range(normal.shape[0]):
        total = 0.0
        for i in range(residual.shape[0]):
            total += jacobian[i, a] * residual[i]
        gradient[a] = total
        for b in range(a + 1):
            total = 0.0
            for i in range(residual.shape[0]):
                total += jacobian[i, a] * jacobian[i, b]
            normal[a, b] = total
            normal[b, a] = total


@njit(cache=True, nogil=True, error_model="numpy")
def _cholesky_kernel(a):  # type: ignore[no-untyped-def]
    """Lower Cholesky factor in place; the smallest scaled pivot, or -1 where there is none.

    A pivot over its diagonal entry is 1 - R², R the multiple correlation of that unknown with those
    before it: it has no unit, and equals the pivot of the matrix scaled to a unit diagonal.
    """
    smallest = 1.0
    for j in range(a.shape[0]):
        diagonal = a[j, j]
        for i in range(j, a.shape[0]):
            total = a[i, j]
            for k in range(j):
                total -= a[i, k] * a[j, k]
            if i == j:
                if not total > 0.0:
                    return -1.0
                smallest = min(smallest, total / diagonal)
                a[j, j] = math.sqrt(total)
            else:
                a[i, j] = total / a[j, j]
        for i in range(j):
            a[i, j] = 0.0
    return smallest


@njit(cache=True, nogil=True, error_model="numpy")
def _solve_factored_kernel(factor, x):  # type: ignore[no-untyped-def]
    """Solve L Lᵀ x = b in place."""
    n = x.shape[0]
    for i in range(n):
        for j in range(i):
            x[i] -= factor[i, j] * x[j]
        x[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            x[i] -= factor[j, i] * x[j]
        x[i] /= factor[i, i]


@njit(cache=True, nogil=True, error_model="numpy")
def _product_kernel(a, b, out):  # type: ignore[no-untyped-def]
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _level_start_kernel(problem, state):  # type: ignore[no-untyped-def]
    """The last resort: level, on a 3° glide path, as far off as the points' width in view tells."""
    points, mean = problem.points, problem.mean
    slope = math.tan(math.radians(3.0))
    across = np.std(points[:, 1]) + slope * np.std(points[:, 0])
    in_view = (np.std(mean[0::2]) + np.std(mean[1::2])) / problem.intrinsics[0]
    distance = min(max(across / max(in_view, 1e-9), 1.0), 1e5)
    state.rotation[:] = BODY_FROM_CAMERA
    state.position[0] = points[:, 0].min() - distance
    state.position[1] = points[:, 1].mean()
    state.position[2] = points[:, 2].mean() + distance * slope


@njit(cache=True, nogil=True, error_model="numpy")
def _planar_starts_kernel(problem, w, rotations, positions):  # type: ignore[no-untyped-def]
    """IPPE's two poses of the points' plane (Collins & Bartoli 2014) as starts; how many (0 or 2).

    From the homography's value (p, q) and Jacobian at the centre: turn the optical axis on to the
    ray to the centre, and what is left of the Jacobian is a scaled 2 x 2 block of a rotation, which
    has two completions.
    """
    if not (_plane_kernel(problem.points, w) and _flatten_kernel(problem, w.flat)):
        return 0
    p, q, j00, j01, j10, j11 = _homography_kernel(w.flat, w.normal, w.coefficients)
    _ray_kernel(p, q, w.turn)
    b00, b01 = w.turn[0, 0] - p * w.turn[2, 0], w.turn[0, 1] - p * w.turn[2, 1]
    b10, b11 = w.turn[1, 0] - q * w.turn[2, 0], w.turn[1, 1] - q * w.turn[2, 1]
    det = b00 * b11 - b01 * b10
    a00, a01 = (b11 * j00 - b01 * j10) / det, (b11 * j01 - b01 * j11) / det
    a10, a11 = (b00 * j10 - b10 * j00) / det, (b00 * j11 - b10 * j01) / det
    square = a00 * a00 + a01 * a01 + a10 * a10 + a11 * a11
    spread = math.sqrt(max(square * square - 4.0 * (a00 * a11 - a01 * a10) ** 2, 0.0))
    gain = math.sqrt(0.5 * (square + spread))  # largest singular value: 1 / depth of the centre
    if not 0.0 < gain < math.inf:
        return 0
    a00, a01, a10, a11 = a00 / gain, a01 / gain, a10 / gain, a11 / gain
    z0 = math.sqrt(max(1.0 - a00 * a00 - a10 * a10, 0.0))
    z1 = math.copysign(math.sqrt(max(1.0 - a01 * a01 - a11 * a11, 0.0)), -(a00 * a01 + a10 * a11))
    for s, sign in ((0, 1.0), (1, -1.0)):
        _basis_kernel(a00, a10, sign * z0, a01, a11, sign * z1, w.tilt)
        _product_kernel(w.turn, w.tilt, w.camera_from_plane)
        _product_kernel(w.runway_from_plane, w.camera_from_plane.T, rotations[s])
        for a in range(3):
            centre = rotations[s, a, 0] * p + rotations[s, a, 1] * q + rotations[s, a, 2]
            positions[s, a] = w.centre[a] - centre / gain
    if _physical_kernel(rotations[1], positions[1]):  # the physical one first
        for a in range(3):
            positions[0, a], positions[1, a] = positions[1, a], positions[0, a]
            for b in range(3):
                rotations[0, a, b], rotations[1, a, b] = rotations[1, a, b], rotations[0, a, b]
    return 2


@njit(cache=True, nogil=True, error_model="numpy")
def _ray_kernel(p, q, out):  # type: ignore[no-untyped-def]
    """The smallest turn that takes (0, 0, 1) to the direction of (p, q, 1), smooth at p = q = 0."""
    z = 1.0 / math.sqrt(1.0 + p * p + q * q)
    x, y = p * z, q * z
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - x * x / (1.0 + z), -x * y / (1.0 + z), x
    out[1, 0], out[1, 1], out[1, 2] = -x * y / (1.0 + z), 1.0 - y * y / (1.0 + z), y
    out[2, 0], out[2, 1], out[2, 2] = -x, -y, z


@njit(cache=True, nogil=True, error_model="numpy")
def _plane_kernel(points, w):  # type: ignore[no-untyped-def]
    """The plane z = a x + b y + c nearest the points: centre, axes, coordinates. False for a line."""
    centre, axes = w.centre, w.runway_from_plane
    sxx = sxy = syy = sxz = syz = 0.0
    for a in range(3):
        centre[a] = points[:, a].mean()
    for i in range(points.shape[0]):
        x, y, z = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
        sxx, sxy, syy, sxz, syz = sxx + x * x, sxy + x * y, syy + y * y, sxz + x * z, syz + y * z
    det = sxx * syy - sxy * sxy
    if not det > 1e-10 * sxx * syy:
        return False
    _basis_kernel(1.0, 0.0, (syy * sxz - sxy * syz) / det, 0.0, 1.0, (sxx * syz - sxy * sxz) / det, axes)
    for i in range(points.shape[0]):
        for column in range(2):
            total = 0.0
            for a in range(3):
                total += axes[a, column] * (points[i, a] - centre[a])
            w.flat[i, column] = total
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _basis_kernel(x0, x1, x2, y0, y1, y2, out):  # type: ignore[no-untyped-def]
    """A right-handed orthonormal basis as columns: the first along x, the second towards y."""
    n = 1.0 / math.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
    x0, x1, x2 = x0 * n, x1 * n, x2 * n
    z0, z1, z2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    n = 1.0 / math.sqrt(z0 * z0 + z1 * z1 + z2 * z2)
    z0, z1, z2 = z0 * n, z1 * n, z2 * n
    out[0, 0], out[1, 0], out[2, 0] = x0, x1, x2
    out[0, 1], out[1, 1], out[2, 1] = z1 * x2 - z2 * x1, z2 * x0 - z0 * x2, z0 * x1 - z1 * x0
    out[0, 2], out[1, 2], out[2, 2] = z0, z1, z2


@njit(cache=True, nogil=True, error_model="numpy")
def _flatten_kernel(problem, flat):  # type: ignore[no-untyped-def]
    """Undistorted image coordinates of the keypoints; False where the lens model has none."""
    for i in range(flat.shape[0]):
        x, y, ok = normalise_kernel(problem.mean[2 * i], problem.mean[2 * i + 1], problem.intrinsics)
        if not ok:
            return False
        flat[i, 2], flat[i, 3] = x, y
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _homography_kernel(flat, a, h):  # type: ignore[no-untyped-def]
    """Plane to image, by least squares: its value (p, q) and Jacobian (4 entries) at the centre.

    Coordinates are scaled to unit size first, and the image's are centred: a runway is a hundred
    times longer than wide, and normal equations square such numbers. The ninth entry is set to 1;
    it is the depth of the centre, which no camera that sees the points has at 0.
    """
    s, t, u, v = _size_kernel(flat[:, 0]), _size_kernel(flat[:, 1]), _size_kernel(flat[:, 2]), _size_kernel(flat[:, 3])
    u0, v0 = flat[:, 2].mean(), flat[:, 3].mean()
    a[:] = 0.0
    h[:] = 0.0
    for i in range(2 * flat.shape[0]):
        point, axis = flat[i // 2], i % 2
        x, y = point[0] / s, point[1] / t
        value = (point[3] - v0) / v if axis else (point[2] - u0) / u
        # One equation: (x, y, 1) in its axis' columns, then (-value x, -value y).
        columns = (3 * axis, 3 * axis + 1, 3 * axis + 2, 6, 7)
        entries = (x, y, 1.0, -value * x, -value * y)
        for m in range(5):
            h[columns[m]] += entries[m] * value
            for n in range(m + 1):
                a[columns[m], columns[n]] += entries[m] * entries[n]
    if not _cholesky_kernel(a) > 0.0:
        h[:] = math.nan
    _solve_factored_kernel(a, h)
    j00, j01 = (h[0] - h[2] * h[6]) * u / s, (h[1] - h[2] * h[7]) * u / t
    j10, j11 = (h[3] - h[5] * h[6]) * v / s, (h[4] - h[5] * h[7]) * v / t
    return u0 + u * h[2], v0 + v * h[5], j00, j01, j10, j11


@njit(cache=True, nogil=True, error_model="numpy")
def _size_kernel(x):  # type: ignore[no-untyped-def]
    """Standard deviation, kept from zero."""
    mean, total = x.mean(), 0.0
    for value in x:
        total += (value - mean) ** 2
    return max(math.sqrt(total / x.shape[0]), 1e-12)
