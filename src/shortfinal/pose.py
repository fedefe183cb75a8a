"""The pose that best explains what was measured, with its covariance and an honest status.

The cost is the whitened sum of squares of Valentin et al. 2025 (arXiv 2508.09732, Algorithm 1),
J(pose) = |L⁻¹ (measured - predicted)|² with L Lᵀ = Σ. Measured are keypoints and, where given, edge
lines, an attitude, a position and an altitude, each with its covariance: they are rows like any
other. J is minimised by Gauss-Newton, damped (Levenberg-Marquardt, Marquardt 1963) where that fails,
in the local increment of `Pose.plus`. A plane seen at a grazing angle has two near-optima, so both
solutions of IPPE (Collins & Bartoli 2014) are starts, and the lowest physical optimum is kept.
Frames, axes and units: the table of conventions in docs/architecture.md.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shortfinal.errors import InputError
from shortfinal.features import (
    Altitude,
    AttitudePrior,
    Feature,
    GaussianLines,
    PositionPrior,
    feature_rows,
    given_as,
)
from shortfinal.geometry import (
    Camera,
    Pose,
    as_array,
    cayley_kernel,
    copy_kernel,
    frozen,
    inlined,
    kernel,
    lines_kernel,
    log_kernel,
    nearest_rotation,
    product_kernel,
    project_jacobian,
    project_kernel,
)
from shortfinal.keypoints import GaussianKeypoints
from shortfinal.starts import (
    carve_kernel,
    flatten_kernel,
    further_starts_kernel,
    known_attitude_start_kernel,
    known_position_start_kernel,
    level_start_kernel,
    physical_kernel,
    planar_starts_kernel,
    scratch_size,
    three_point_starts_kernel,
    widest_triple_kernel,
)

Array = NDArray[np.float64]

# A second optimum less than this much worse in χ² cannot be told apart: at 2 ln 1000 the data are
# a thousand times likelier under the first.
AMBIGUITY_CHI2 = 2.0 * math.log(1000.0)
# A position prior and an altitude this many standard deviations apart are not the same flight.
CONTRADICTION_SIGMAS = 6.0
MAX_ITERATIONS = 50
CHUNK = 512  # problems a thread takes at once: some milliseconds of work


class SolverStatus(Enum):
    """How a solve ended. Only the first two come with a pose."""

    CONVERGED = "converged"  # one physical optimum, well determined
    AMBIGUOUS = "ambiguous"  # a second physical optimum explains the measurements about as well
    ILL_CONDITIONED = "ill-conditioned"  # the measurements leave a direction free, or Σ is not positive definite
    BEHIND_CAMERA = "behind-camera"  # every optimum has a point behind, or the camera under ground or upside down
    MAX_ITERATIONS = "max-iterations"  # no start reached an optimum in the iterations allowed
    NON_FINITE = "non-finite"  # NaN or infinity, in the input or (by overflow) in the arithmetic


# The kernels' codes are the positions in the enum; of several failed starts the lowest is reported.
STATUS_OF_CODE = tuple(SolverStatus)
_CONVERGED, _AMBIGUOUS, _ILL_CONDITIONED, _BEHIND_CAMERA, _MAX_ITERATIONS, _NON_FINITE = range(len(STATUS_OF_CODE))


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A pose, how sure it is, and what is left over.

    With a status other than CONVERGED and AMBIGUOUS there is no estimate: `pose` and `cov` are
    None, and `residual`, `jacobian` and `chi2` are NaN. "Whitened" is multiplied by L⁻¹, Σ = L Lᵀ.
    The n rows are those of `features`, in their order.
    """

    pose: Pose | None
    cov: Array | None  # (6, 6) of the local increment, m and rad: (Hᵀ Σ⁻¹ H)⁻¹, the Cramér-Rao bound
    status: SolverStatus
    residual: Array  # (n,) whitened measured minus predicted
    jacobian: Array  # (n, 6) whitened d(predicted) / d(local increment)
    chi2: float  # the cost: sum of squares of the residual
    iterations: int  # steps tried, over all starts
    sharp_rows: int  # rows whose sigma is smaller than the scale of what they measure (see check_integrity)
    relative_sigma: float  # of the position, over the distance to the nearest point
    keypoints: GaussianKeypoints
    points: Array  # (K, 3) m, runway frame
    camera: Camera
    attitude_prior: AttitudePrior | None = None
    position_prior: PositionPrior | None = None
    altitude: Altitude | None = None
    lines: GaussianLines | None = None
    edges: Array | None = None  # (L, 2, 3) m, runway frame

    @property
    def dof(self) -> int:
        """Degrees of freedom left for checking: rows less six."""
        return len(self.residual) - 6

    @cached_property
    def features(self) -> tuple[Feature, ...]:
        """What was measured, in the order of the rows."""
        lines = 0 if self.lines is None else len(self.lines.mean)
        priors = (self.attitude_prior, self.position_prior, self.altitude)
        return feature_rows(len(self.points), lines, *(prior is not None for prior in priors))

    @cached_property
    def factor(self) -> Array:
        """L (n, n), the Cholesky factor of the covariance of all rows: whitening divides by it."""
        covs = list(self._covariances())
        whole = covs[0] if len(covs) == 1 else _block_diagonal([cov[None] for cov in covs])[0]
        return frozen(np.linalg.cholesky(whole))

    @property
    def sigma_position_m(self) -> Array | None:
        """Standard deviations (3,) of x, y, z in the runway frame; None without an estimate."""
        return None if self.cov is None else np.sqrt(np.diag(self.cov)[:3])

    def _covariances(self) -> Iterator[Array]:
        yield self.keypoints.cov_px
        if self.lines is not None:
            yield self.lines.cov
        if self.attitude_prior is not None:
            yield self.attitude_prior.cov_rad2
        if self.position_prior is not None:
            yield self.position_prior.cov_m2
        if self.altitude is not None:
            yield np.array([[self.altitude.sigma_m**2]])


@dataclass(frozen=True, eq=False)
class PoseEstimateBatch:
    """N estimates as arrays; the numbers of a problem neither CONVERGED nor AMBIGUOUS are NaN.

    What was measured is kept as given, with one row for all problems where it is shared.
    """

    positions: Array  # (N, 3) m
    rotations: Array  # (N, 3, 3) runway_from_camera
    covs: Array  # (N, 6, 6)
    status_codes: NDArray[np.int64]  # (N,) index into STATUS_OF_CODE
    residuals: Array  # (N, n) whitened
    jacobians: Array  # (N, n, 6) whitened
    chi2: Array  # (N,)
    iterations: NDArray[np.int64]  # (N,)
    sharp_rows: NDArray[np.int64]  # (N,) as in PoseEstimate
    relative_sigma: Array  # (N,)
    mean_px: Array  # (N, K, 2)
    cov_px: Array  # (N or 1, 2K, 2K)
    points: Array  # (N or 1, K, 3)
    camera: Camera
    line_mean: Array  # (N or 1, L, 2), L = 0 without
    line_cov: Array  # (N or 1, 2L, 2L)
    edges: Array  # (N or 1, L, 2, 3)
    attitude: Array  # (N or 1, 1, 18): the prior's rotation and covariance, row by row; (1, 0, 18) without
    position: Array  # (N or 1, 1, 12): likewise
    altitude: Array  # (N or 1, 1, 2): likewise, height and sigma

    def __len__(self) -> int:
        return len(self.chi2)

    def __getitem__(self, i: int) -> PoseEstimate:
        """Problem `i` by itself. Raises InputError if what it was given is no valid measurement."""
        mean, cov, points, line_mean, line_cov, edges, attitude, position, altitude = (
            a[i if len(a) > 1 else 0] for a in self._given()
        )
        given = _Given(
            attitude_prior=AttitudePrior(*_split(attitude, (3, 3))) if len(attitude) else None,
            position_prior=PositionPrior(*_split(position, (3,))) if len(position) else None,
            altitude=Altitude(*altitude[0]) if len(altitude) else None,
            lines=GaussianLines(line_mean, line_cov) if len(line_mean) else None,
            edges=frozen(edges.copy()) if len(edges) else None,
        )
        solved = (self.positions, self.rotations, self.covs, self.residuals, self.jacobians)
        numbers = (self.status_codes, self.chi2, self.iterations, self.sharp_rows, self.relative_sigma)
        return _estimate(
            tuple(array[i].copy() for array in solved),
            [array[i].item() for array in numbers],
            GaussianKeypoints(mean, cov),
            frozen(points.copy()),
            self.camera,
            given,
        )

    @property
    def converged(self) -> NDArray[np.bool_]:
        """Which problems (N,) have status CONVERGED."""
        return np.asarray(self.status_codes == _CONVERGED)

    @property
    def dof(self) -> int:
        """Degrees of freedom left for checking: rows less six."""
        return int(self.residuals.shape[1]) - 6

    @cached_property
    def features(self) -> tuple[Feature, ...]:
        """What was measured, in the order of the rows."""
        sizes = (self.mean_px.shape[1], self.line_mean.shape[1])
        return feature_rows(*sizes, *(bool(a.shape[1]) for a in (self.attitude, self.position, self.altitude)))

    @cached_property
    def factors(self) -> Array:
        """L (N or 1, n, n), the Cholesky factors of the covariance of all rows; NaN where there is none."""
        turns, shifts = (a[:, :, -9:].reshape(len(a), *2 * (3 * a.shape[1],)) for a in (self.attitude, self.position))
        covs = [self.cov_px, self.line_cov, turns, shifts, self.altitude[:, :, 1:] ** 2]
        return frozen(_cholesky(_block_diagonal([cov for cov in covs if cov.shape[1]])))

    def status(self, i: int) -> SolverStatus:
        """The status of problem `i`."""
        return STATUS_OF_CODE[int(self.status_codes[i])]

    def _given(self) -> tuple[Array, ...]:
        return (
            self.mean_px, self.cov_px, self.points, self.line_mean, self.line_cov, self.edges,
            self.attitude, self.position, self.altitude,
        )  # fmt: skip


def estimate_pose(
    keypoints: GaussianKeypoints,
    points: ArrayLike,
    camera: Camera,
    *,
    initial: Pose | None = None,
    attitude_prior: AttitudePrior | Sequence[Any] | None = None,
    position_prior: PositionPrior | Sequence[Any] | None = None,
    altitude: Altitude | Sequence[float] | None = None,
    lines: GaussianLines | Sequence[Any] | None = None,
    edges: ArrayLike | None = None,
    points_sigma_m: float = 0.0,
    max_iterations: int = MAX_ITERATIONS,
) -> PoseEstimate:
    """The most likely pose of `camera`, given where it sees `points` (K, 3; metres, runway frame).

    K is three or more. Further measurements, each a type of `shortfinal.features` or the pair it
    holds: an attitude, a position, an altitude, and image lines of straight `edges` (L, 2, 3; both
    ends in metres). A prior as sharp as 1e-9 rad makes the attitude known.

    `points_sigma_m`: how well it is known where the points are, a sigma for each axis of each by itself. It is
    added to the keypoints' covariance as seen from the pose that they give without it, and the estimate's own
    keypoints have it. What all points have in common (a runway surveyed whole, but elsewhere) no picture shows.

    `initial` is one more start beside the solver's own; `max_iterations` holds for each start.
    A physical optimum has every point in front of the camera, the camera above z = 0, and the top
    of the image upwards. Hopeless geometry is a status. Raises InputError for fewer than three
    points, for what does not match in number, for a covariance that is none, for a `points_sigma_m` that is
    no number of 0 or more, and for a position prior and an altitude that contradict each other
    (CONTRADICTION_SIGMAS).
    """
    _check_doubt(points_sigma_m)
    world = _as_points(points)
    count = len(world)
    _check_counts(len(keypoints.mean_px), count)
    given = _NOTHING
    if not (attitude_prior is None and position_prior is None and altitude is None and lines is edges is None):
        given = _check_given(attitude_prior, position_prior, altitude, lines, edges)
    arrays = _ABSENT if given is _NOTHING else given.arrays()
    rows = 2 * (count + len(arrays[2])) + 3 * (len(arrays[3]) + len(arrays[4])) + len(arrays[5])
    summary = np.empty(_SUMMARY)
    solved = (np.empty(3), np.empty((3, 3)), np.empty((6, 6)), np.empty(rows), np.empty((rows, 6)))
    work = np.empty(_work_size(count, len(arrays[2]), rows))
    _solve_kernel(
        keypoints.mean_px, keypoints.cov_px, world, *arrays, _start(initial), camera.intrinsics, max_iterations, work,
        *solved, summary,
    )  # fmt: skip
    if summary[0] == _NON_FINITE:
        as_array(world, (None, 3), "points")
    estimate = _estimate(solved, summary.tolist(), keypoints, world, camera, given)
    if points_sigma_m == 0 or estimate.pose is None:
        return estimate
    return estimate_pose(
        keypoints.widened(_seen_cov(camera, estimate.pose, world, points_sigma_m)), world, camera,
        initial=estimate.pose, attitude_prior=attitude_prior, position_prior=position_prior, altitude=altitude,
        lines=lines, edges=edges, max_iterations=max_iterations,
    )  # fmt: skip


def _seen_cov(camera: Camera, pose: Pose, points: Array, sigma_m: float) -> Array:
    """What a sigma of each point by itself looks like from a pose: a covariance (2K, 2K), px²."""
    moved = project_jacobian(camera, pose, points)[:, :3].reshape(-1, 2, 3)  # of the camera: of a point, its negative
    cov, k = np.zeros((len(points), 2, len(points), 2)), np.arange(len(points))
    cov[k, :, k] = sigma_m**2 * moved @ moved.transpose(0, 2, 1)
    return cov.reshape(2 * len(points), -1)


def estimate_pose_batch(
    mean_px: ArrayLike,
    cov_px: ArrayLike,
    points: ArrayLike,
    camera: Camera,
    *,
    attitude_prior: Sequence[ArrayLike] | None = None,
    position_prior: Sequence[ArrayLike] | None = None,
    altitude: Sequence[ArrayLike] | None = None,
    lines: Sequence[ArrayLike] | None = None,
    edges: ArrayLike | None = None,
    points_sigma_m: float = 0.0,
    max_iterations: int = MAX_ITERATIONS,
    threads: int | None = None,
) -> PoseEstimateBatch:
    """`estimate_pose` for N problems, on `threads` threads (default: one per processor).

    Each array has a leading axis of N, or lacks it and is shared: keypoints (N, K, 2), which are
    never shared, covariance (2K, 2K), points (K, 3); attitude_prior: rotations (3, 3) and covariance
    (3, 3); position_prior: positions (3,) and covariance (3, 3); altitude: heights and sigmas, each a
    number; lines: mean (L, 2) and covariance (2L, 2L), with edges (L, 2, 3).

    The numbers are not refused but answered: a NaN gives its problem NON_FINITE, a covariance that
    is not positive definite or a rotation that is none ILL_CONDITIONED; priors that contradict one
    another leave a large residual. Raises InputError for shapes that do not match, and for a `points_sigma_m` that
    is no number of 0 or more.
    """
    _check_doubt(points_sigma_m)
    mean = _numbers(mean_px, "mean_px")
    if mean.ndim != 3 or mean.shape[2] != 2 or len(mean) == 0:
        raise InputError(f"mean_px: expected shape (N, K, 2) with N > 0, got {mean.shape}")
    count, k = mean.shape[:2]
    world = _shared(points, (k, 3), count, "points")
    _check_counts(k, world.shape[1])
    if (lines is None) != (edges is None):
        raise InputError("lines and edges: give both, or neither")
    ends = _numbers(np.empty((0, 2, 3)) if edges is None else edges, "edges")
    if ends.ndim < 3:
        raise InputError(f"edges: expected shape (L, 2, 3) or (N, L, 2, 3), got {ends.shape}")
    many = ends.shape[-3]
    line_mean, line_cov = _pair(lines, (many, 2), (2 * many, 2 * many), count, "lines")
    given = (
        mean,
        _shared(cov_px, (2 * k, 2 * k), count, "cov_px"),
        world,
        line_mean,
        line_cov,
        _shared(ends, (many, 2, 3), count, "edges"),
        _packed(attitude_prior, (3, 3), (3, 3), count, "attitude_prior"),
        _packed(position_prior, (3,), (3, 3), count, "position_prior"),
        _packed(altitude, (), (), count, "altitude"),
    )
    rows = 2 * k + 2 * many + sum(size * a.shape[1] for size, a in zip((3, 3, 1), given[6:], strict=True))
    shapes = ((3,), (3, 3), (6, 6), (rows,), (rows, 6), (_SUMMARY,))
    out = [np.empty((count, *shape)) for shape in shapes]

    def solve(start: int) -> None:
        part = slice(start, start + CHUNK)
        _solve_many_kernel(
            *(array[part] if len(array) == count else array for array in given),
            _NO_START,
            camera.intrinsics,
            max_iterations,
            np.empty(_work_size(k, many, rows)),
            *(array[part] for array in out),
        )

    with ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        list(pool.map(solve, range(0, count, CHUNK)))
    *solved, summary = out
    codes, chi2, iterations, sharp, relative = summary.T
    whole = (a.astype(np.int64) for a in (codes, iterations, sharp))
    status_codes, steps, sharp_rows = whole
    positions, rotations, covs, residuals, jacobians = solved
    mean, cov, world, line_mean, line_cov, ends, attitude, position, height = given
    batch = PoseEstimateBatch(
        positions, rotations, covs, status_codes, residuals, jacobians, chi2.copy(), steps, sharp_rows,
        relative.copy(), mean, cov, world, camera, line_mean, line_cov, ends, attitude, position, height,
    )  # fmt: skip
    seen = np.flatnonzero(np.isfinite(positions).all(axis=1)) if points_sigma_m > 0 else ()
    if len(seen) == 0:
        return batch
    widened = np.array(np.broadcast_to(cov, (count, 2 * k, 2 * k)))
    for i in seen:
        pose = Pose.trusted(positions[i], rotations[i])
        widened[i] += _seen_cov(camera, pose, world[i if len(world) == count else 0], points_sigma_m)
    return estimate_pose_batch(
        mean, widened, points, camera, attitude_prior=attitude_prior, position_prior=position_prior, altitude=altitude,
        lines=lines, edges=edges, max_iterations=max_iterations, threads=threads,
    )  # fmt: skip


def pose_costs(est: PoseEstimate, positions: Array, rotations: Array) -> Array:
    """The solver's cost J (N,) at poses (N, 3), (N, 3, 3), of what `est` was estimated from; infinite
    where a point lies behind the camera.
    """
    given = _Given(est.attitude_prior, est.position_prior, est.altitude, est.lines, est.edges).arrays()
    rows, out = len(est.residual), np.empty(len(positions))
    work = np.empty(_work_size(len(est.points), len(given[2]), rows))
    _costs_kernel(
        est.keypoints.mean_px, est.keypoints.cov_px, est.points, *given, _NO_START, est.camera.intrinsics, rows,
        *(frozen(np.array(a, np.float64, order="C")) for a in (positions, rotations)), work, out,
    )  # fmt: skip
    return out


_ABSENT = tuple(frozen(np.empty(shape)) for shape in ((0, 2), (0, 0), (0, 2, 3), (0, 18), (0, 12), (0, 2)))
_NO_START = frozen(np.empty((0, 12)))
_SUMMARY = 5  # status, χ², iterations, sharp rows, relative sigma


class _Given(NamedTuple):
    """What was measured beside the keypoints."""

    attitude_prior: AttitudePrior | None = None
    position_prior: PositionPrior | None = None
    altitude: Altitude | None = None
    lines: GaussianLines | None = None
    edges: Array | None = None

    def arrays(self) -> tuple[Array, ...]:
        """As the kernel takes them; what is absent has no rows."""
        line_mean, line_cov, edges, attitude, position, altitude = _ABSENT
        if self.lines is not None and self.edges is not None:
            line_mean, line_cov, edges = self.lines.mean, self.lines.cov, self.edges
        if self.attitude_prior is not None:
            attitude = _joined(self.attitude_prior.runway_from_camera, self.attitude_prior.cov_rad2)
        if self.position_prior is not None:
            position = _joined(self.position_prior.position_m, self.position_prior.cov_m2)
        if self.altitude is not None:
            altitude = _joined(self.altitude.height_m, self.altitude.sigma_m)
        return line_mean, line_cov, edges, attitude, position, altitude


_NOTHING = _Given()


def _check_given(attitude: Any, position: Any, altitude: Any, lines: Any, edges: ArrayLike | None) -> _Given:
    if (lines is None) != (edges is None):
        raise InputError("lines and edges: give both, or neither")
    given = _Given(
        None if attitude is None else given_as(AttitudePrior, attitude, "attitude_prior"),
        None if position is None else given_as(PositionPrior, position, "position_prior"),
        None if altitude is None else given_as(Altitude, altitude, "altitude"),
        None if lines is None else given_as(GaussianLines, lines, "lines"),
        None if edges is None else as_array(edges, (None, 2, 3), "edges"),
    )
    if given.lines is not None and given.edges is not None and len(given.lines.mean) != len(given.edges):
        raise InputError(f"edges: {len(given.edges)} edges for {len(given.lines.mean)} lines; give one edge per line")
    if given.position_prior is not None and given.altitude is not None:
        _check_heights(given.position_prior, given.altitude)
    return given


def _check_heights(prior: PositionPrior, altitude: Altitude) -> None:
    apart = abs(float(prior.position_m[2]) - altitude.height_m)
    sigma = math.sqrt(float(prior.cov_m2[2, 2]) + altitude.sigma_m**2)
    if apart > CONTRADICTION_SIGMAS * sigma:
        raise InputError(
            f"position_prior and altitude: heights of {prior.position_m[2]:.4g} m and {altitude.height_m:.4g} m are "
            f"{apart / sigma:.1f} standard deviations apart; one of them is wrong, or less certain than stated"
        )


def _check_doubt(points_sigma_m: float) -> None:
    if not 0 <= points_sigma_m < math.inf:
        raise InputError(f"points_sigma_m: {points_sigma_m}; it must be 0 or more, in metres")


def _check_counts(keypoints: int, points: int) -> None:
    if keypoints != points:
        raise InputError(f"points: {points} points for {keypoints} keypoints; give one point per keypoint")
    if points < 3:
        raise InputError(f"points: got {points}; a pose needs at least three, and a fourth to choose and check it")


def _as_points(points: ArrayLike) -> Array:
    """(K, 3); an array that is read-only and its own is used as it is, and the kernel looks for NaN in it."""
    if type(points) is np.ndarray and points.dtype == np.float64 and points.ndim == 2 and points.shape[1] == 3:
        flags = points.flags
        if not flags.writeable and flags.c_contiguous and points.base is None:
            return points
    return as_array(points, (None, 3), "points")


def _numbers(value: ArrayLike, name: str) -> Array:
    try:
        return frozen(np.array(value, np.float64, order="C"))
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected numbers, got {' '.join(repr(value).split()):.80}") from error


def _shared(value: ArrayLike, shape: tuple[int, ...], count: int, name: str) -> Array:
    """`value` with a leading axis: of `count`, or of 1 where all problems share it."""
    array = _numbers(value, name)
    if array.shape == shape:
        return array[None]
    if array.shape != (count, *shape) and array.shape != (1, *shape):
        raise InputError(f"{name}: expected shape {shape} or {(count, *shape)}, got {array.shape}")
    return array


def _pair(
    pair: Sequence[ArrayLike] | None, first: tuple[int, ...], second: tuple[int, ...], count: int, name: str
) -> tuple[Array, Array]:
    if pair is None:
        return np.empty((1, *first)), np.empty((1, *second))
    if not isinstance(pair, (tuple, list)) or len(pair) != 2:
        raise InputError(f"{name}: expected a pair, the values and their covariance")
    return _shared(pair[0], first, count, name), _shared(pair[1], second, count, f"{name}: covariance")


def _packed(
    pair: Sequence[ArrayLike] | None, first: tuple[int, ...], second: tuple[int, ...], count: int, name: str
) -> Array:
    """A prior as the kernel takes it: (N or 1, 1, its numbers in a row), (1, 0, numbers) if there is none."""
    parts = [a.reshape(len(a), -1) for a in _pair(pair, first, second, count, name)]
    most = max(len(a) for a in parts)
    packed = np.concatenate([np.broadcast_to(a, (most, a.shape[1])) for a in parts], axis=1)[:, None]
    return frozen(packed[:, :0].copy() if pair is None else packed)


def _joined(*parts: ArrayLike) -> Array:
    return frozen(np.concatenate([np.ravel(part) for part in parts])[None])


def _split(packed: Array, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """The inverse of `_joined` for a value of `shape` and a covariance (3, 3)."""
    return packed[0, :-9].reshape(shape), packed[0, -9:].reshape(3, 3)


def _start(initial: Pose | None) -> Array:
    """A given start as the kernel takes it: (S, 12) rotation and position, S = 0 or 1."""
    return _NO_START if initial is None else _joined(nearest_rotation(initial.runway_from_camera), initial.position_m)


def _estimate(
    arrays: tuple[Array, ...],
    numbers: list[float],
    keypoints: GaussianKeypoints,
    points: Array,
    camera: Camera,
    given: _Given,
) -> PoseEstimate:
    """What the kernel wrote, as an estimate; the arrays become its own."""
    for array in arrays:
        array.setflags(write=False)
    position, rotation, cov, residual, jacobian = arrays
    code, chi2, iterations, sharp_rows, relative_sigma = numbers
    solved = code <= _AMBIGUOUS
    estimate = object.__new__(PoseEstimate)  # as its constructor, at a third of the time
    estimate.__dict__.update(
        pose=Pose.trusted(position, rotation) if solved else None,
        cov=cov if solved else None,
        status=STATUS_OF_CODE[int(code)],
        residual=residual,
        jacobian=jacobian,
        chi2=chi2,
        iterations=int(iterations),
        sharp_rows=int(sharp_rows),
        relative_sigma=relative_sigma,
        keypoints=keypoints,
        points=points,
        camera=camera,
        attitude_prior=given.attitude_prior,
        position_prior=given.position_prior,
        altitude=given.altitude,
        lines=given.lines,
        edges=given.edges,
    )
    return estimate


def _block_diagonal(blocks: Sequence[Array]) -> Array:
    """Covariances (N or 1, m, m) as one (N or 1, n, n)."""
    count, size = max(len(b) for b in blocks), sum(b.shape[1] for b in blocks)
    whole, end = np.zeros((count, size, size)), 0
    for block in blocks:
        begin, end = end, end + block.shape[1]
        whole[:, begin:end, begin:end] = block
    return whole


def _cholesky(covs: Array) -> Array:
    """Lower Cholesky factors of (N, n, n); NaN for what is not positive definite."""
    try:
        return np.asarray(np.linalg.cholesky(covs))
    except np.linalg.LinAlgError:
        if len(covs) == 1:
            return np.full_like(covs, np.nan)
        return np.concatenate([_cholesky(covs[i : i + 1]) for i in range(len(covs))])


# The kernels below are compiled. They work in memory the caller owns or in one block for the whole
# call: nothing is allocated per problem, and the interpreter's lock is released for the whole of a
# chunk. Arrays given to them are read-only, those they fill are not: one type of call to compile.

# Scaled pivot (see _cholesky_kernel). Points on a line leave 1e-15, a 300 m runway at 60 km 1e-6.
_SINGULAR = 1e-12
# The last step, or what the shrinking of the steps predicts for the next one, is below a millionth
# of a standard deviation: δᵀJᵀJδ under this.
_STEP_TOLERANCE = 1e-12
_FIRST_DAMPING = 1e-3
# A position known no better than to three times the distance, or an attitude to 0.7 rad, is free:
# the cost levels out towards infinity, and so flat an optimum has others about it.
_FREE_SHARE = 3.0
_FREE_TURN = 0.7
# Attitude known to this (rad, 1σ) rules out an optimum that hangs upside down. Measured: of 80,000
# noisy runways none with a second optimum was known to better than 0.14 rad.
_SURE_TURN = 0.05
# A cost that noise exceeds once in e^16 = 9 million times (see _settled_kernel) asks for more starts.
_IMPLAUSIBLE = 16.0
_LOWEST, _RIVAL, _STATUS, _STEPS, _SURE = range(5)  # of the tally of a search
_TALLY = 5
# Kinds of starts, in the order of their turns; those after _PLANE are for three points and for doubts.
_GIVEN, _ATTITUDE, _PLANE, _TRIANGLE, _WITHOUT_LINES, _POSITION, _LEVEL, _FURTHER = range(8)
_KINDS = 8


class _Problem(NamedTuple):
    """One problem; refilled for each. The kernels' tuples are small: passing one costs its length."""

    points: Any  # (K, 3)
    edges: Any  # (L, 2, 3)
    lens: Any  # (12,)
    priors: Any  # 0 or 1 of each: attitude, position, altitude
    measured: Any  # (n,) pixels, lines, zeros for the attitude, position, height
    keypoint_factor: Any  # (2K, 2K) of the covariance, as _cholesky_kernel leaves it
    line_factor: Any  # (2L, 2L)
    attitude_factor: Any  # (3, 3)
    position_factor: Any  # (3, 3)
    attitude: Any  # (3, 3) runway_from_camera of the prior
    numbers: Any  # (3,) 1 / sigma of the altitude; whether the pixels are independent, and the lines count
    turn: Any  # (3, 3) scratch
    depth: Any  # (K,) scratch


class _State(NamedTuple):
    """A pose, the whitened residual and Jacobian there, and what follows from them."""

    whole: Any  # all numbers
    rows: Any  # those of the next four fields
    rotation: Any  # (3, 3)
    position: Any  # (3,)
    residual: Any  # (n,)
    jacobian: Any  # (n, 6)
    normal: Any  # (6, 6) JᵀJ, lower triangle
    gradient: Any  # (6,) Jᵀr
    factor: Any  # (6, 6) of JᵀJ, damped or not, as _cholesky_kernel leaves it
    inverse: Any  # (6, 6) L⁻¹ of the last factor
    step: Any  # (6,)


def _work_size(k: int, lines: int, rows: int) -> int:
    """Numbers that `_solve_kernel` works in."""
    problem = rows + 4 * k * k + 4 * lines * lines + 9 + 9 + 9 + 3 + 9 + k
    return problem + 3 * (132 + 7 * rows) + scratch_size(k) + _TALLY


@inlined
def _problem_kernel(points, edges, lens, priors, rows, work):  # type: ignore[no-untyped-def]
    """A problem in the first part of `work`, and where that part ends."""
    k, lines = points.shape[0], edges.shape[0]
    a = rows + 4 * k * k
    b = a + 4 * lines * lines
    end = b + 39 + k
    return _Problem(
        points, edges, lens, priors, work[:rows], work[rows:a].reshape(2 * k, 2 * k),
        work[a:b].reshape(2 * lines, 2 * lines), work[b : b + 9].reshape(3, 3), work[b + 9 : b + 18].reshape(3, 3),
        work[b + 18 : b + 27].reshape(3, 3), work[b + 27 : b + 30], work[b + 30 : b + 39].reshape(3, 3),
        work[b + 39 : end],
    ), end  # fmt: skip


@inlined
def _state_kernel(work, start, rows):  # type: ignore[no-untyped-def]
    """A state in `work` from `start` on, and where it ends."""
    a = start + 12
    b = a + rows
    c = b + 6 * rows
    end = c + 120
    return _State(
        work[start:end], work[start:c], work[start : start + 9].reshape(3, 3), work[start + 9 : a],
        work[a:b], work[b:c].reshape(rows, 6), work[c : c + 36].reshape(6, 6), work[c + 36 : c + 42],
        work[c + 42 : c + 78].reshape(6, 6), work[c + 78 : c + 114].reshape(6, 6), work[c + 114 : end],
    ), end  # fmt: skip


@kernel
def _solve_many_kernel(  # type: ignore[no-untyped-def]
    mean, cov, points, line_mean, line_cov, edges, attitude, position, altitude, initial, lens, max_iterations, work,
    positions, rotations, covs, residuals, jacobians, summaries,
):  # fmt: skip
    """N problems; what was measured has N rows or a single one, shared."""
    for i in range(mean.shape[0]):
        _solve_kernel(
            mean[i], cov[_row_kernel(i, cov)], points[_row_kernel(i, points)], line_mean[_row_kernel(i, line_mean)],
            line_cov[_row_kernel(i, line_cov)], edges[_row_kernel(i, edges)], attitude[_row_kernel(i, attitude)],
            position[_row_kernel(i, position)], altitude[_row_kernel(i, altitude)], initial, lens, max_iterations, work,
            positions[i], rotations[i], covs[i], residuals[i], jacobians[i], summaries[i],
        )  # fmt: skip


@kernel
def _row_kernel(i, array):  # type: ignore[no-untyped-def]
    return i if array.shape[0] > 1 else 0


@kernel
def _solve_kernel(  # type: ignore[no-untyped-def]
    mean, cov, points, line_mean, line_cov, edges, attitude, position, altitude, initial, lens, max_iterations, work,
    position_out, rotation_out, cov_out, residual_out, jacobian_out, summary,
):  # fmt: skip
    """One problem. The priors, and the start `initial` (0 or 1, 12), are numbers in a row; absent ones have no rows."""
    rows = residual_out.shape[0]
    priors = (attitude.shape[0], position.shape[0], altitude.shape[0])
    problem, end = _problem_kernel(points, edges, lens, priors, rows, work)
    best, end = _state_kernel(work, end, rows)
    current, end = _state_kernel(work, end, rows)
    trial, end = _state_kernel(work, end, rows)
    scratch, end = carve_kernel(work, end, points.shape[0])
    tally = work[end : end + _TALLY]
    tally[_LOWEST], tally[_RIVAL], tally[_STATUS], tally[_STEPS], tally[_SURE] = math.inf, math.inf, 0.0, 0.0, 0.0
    tally[_STATUS] = _admit_kernel(problem, mean, cov, line_mean, line_cov, attitude, position, altitude, initial)
    if tally[_STATUS] == _CONVERGED:
        _search_kernel(problem, position, initial, max_iterations, scratch, best, current, trial, tally)
    summary[0], summary[1], summary[2] = tally[_STATUS], tally[_LOWEST], tally[_STEPS]
    if tally[_STATUS] <= _AMBIGUOUS:
        copy_kernel(best.position, position_out)
        copy_kernel(best.rotation.reshape(9), rotation_out.reshape(9))
        copy_kernel(best.residual, residual_out)
        copy_kernel(best.jacobian.reshape(6 * rows), jacobian_out.reshape(6 * rows))
        _covariance_kernel(best.inverse, cov_out)
        summary[3], summary[4] = _sharpness_kernel(problem, best.position, cov_out, cov, line_cov, attitude, position)
    else:
        position_out[:] = math.nan
        rotation_out[:] = math.nan
        residual_out[:] = math.nan
        jacobian_out[:] = math.nan
        cov_out[:] = math.nan
        summary[1], summary[3], summary[4] = math.nan, 0.0, math.nan


@kernel
def _costs_kernel(  # type: ignore[no-untyped-def]
    mean, cov, points, line_mean, line_cov, edges, attitude, position, altitude, initial, lens, rows, positions,
    rotations, work, out,
):  # fmt: skip
    priors = (attitude.shape[0], position.shape[0], altitude.shape[0])
    problem, end = _problem_kernel(points, edges, lens, priors, rows, work)
    state, end = _state_kernel(work, end, rows)
    _admit_kernel(problem, mean, cov, line_mean, line_cov, attitude, position, altitude, initial)
    for i in range(out.shape[0]):
        copy_kernel(positions[i], state.position)
        copy_kernel(rotations[i].reshape(9), state.rotation.reshape(9))
        out[i] = _evaluate_kernel(problem, state)


@inlined
def _admit_kernel(problem, mean, cov, line_mean, line_cov, attitude, position, altitude, initial):  # type: ignore[no-untyped-def]
    """Take in what was measured, and factor its covariances; refuse NaN, infinity and what is no covariance."""
    measured, row = problem.measured, 2 * (mean.shape[0] + line_mean.shape[0])
    copy_kernel(mean.reshape(mean.size), measured)
    copy_kernel(line_mean.reshape(line_mean.size), measured[2 * mean.shape[0] :])
    good, independent = _factor_kernel(cov, problem.keypoint_factor)
    problem.numbers[1], problem.numbers[2] = independent, 1.0
    finite = (
        _finite_kernel(cov) and _finite_kernel(line_cov) and _finite_kernel(problem.points) and _finite_kernel(initial)
    )
    finite = finite and _finite_kernel(problem.edges.reshape(2 * line_mean.shape[0], 3))
    good = good and _factor_kernel(line_cov, problem.line_factor)[0]
    if attitude.shape[0] > 0:
        measured[row : row + 3] = 0.0
        row += 3
        finite = finite and _finite_kernel(attitude)
        copy_kernel(attitude[0, :9], problem.attitude.reshape(9))
        good = good and _factor_kernel(attitude[0, 9:].reshape(3, 3), problem.attitude_factor)[0]
        good = good and _is_rotation_kernel(problem.attitude)
    if position.shape[0] > 0:
        copy_kernel(position[0, :3], measured[row:])
        row += 3
        finite = finite and _finite_kernel(position)
        good = good and _factor_kernel(position[0, 3:].reshape(3, 3), problem.position_factor)[0]
    if altitude.shape[0] > 0:
        measured[row], problem.numbers[0] = altitude[0, 0], 1.0 / altitude[0, 1]
        finite = finite and _finite_kernel(altitude)
        good = good and altitude[0, 1] > 0.0
    finite = finite and _finite_kernel(measured.reshape(1, measured.size))
    if not finite:
        return _NON_FINITE
    return _CONVERGED if good else _ILL_CONDITIONED


@kernel
def _finite_kernel(rows):  # type: ignore[no-untyped-def]
    bad = 0
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            bad += not abs(rows[i, j]) < math.inf
    return bad == 0


@kernel
def _factor_kernel(cov, factor):  # type: ignore[no-untyped-def]
    """The Cholesky factor of a covariance: whether there is one, and whether it is diagonal."""
    independent = True
    for i in range(cov.shape[0]):
        for j in range(i):
            skew = cov[i, j] - cov[j, i]
            if skew != 0.0 and not skew * skew <= 1e-16 * abs(cov[i, i] * cov[j, j]):
                return False, False
            independent = independent and cov[i, j] == 0.0
            factor[i, j] = cov[i, j]
        factor[i, i] = cov[i, i]
    if not independent:
        return _cholesky_kernel(factor, _SINGULAR), False
    for i in range(cov.shape[0]):
        if not cov[i, i] > 0.0:
            return False, True
        factor[i, i] = 1.0 / math.sqrt(cov[i, i])
    return True, True


@kernel
def _is_rotation_kernel(r):  # type: ignore[no-untyped-def]
    """Whether the columns are orthonormal to 1e-6, and right-handed."""
    for i in range(3):
        for j in range(i + 1):
            off = r[0, i] * r[0, j] + r[1, i] * r[1, j] + r[2, i] * r[2, j] - (1.0 if i == j else 0.0)
            if not abs(off) < 1e-6:
                return False
    x, y, z = (
        r[1, 0] * r[2, 1] - r[2, 0] * r[1, 1],
        r[2, 0] * r[0, 1] - r[0, 0] * r[2, 1],
        r[0, 0] * r[1, 1] - r[1, 0] * r[0, 1],
    )
    return x * r[0, 2] + y * r[1, 2] + z * r[2, 2] > 0.0


@inlined
def _search_kernel(problem, position, initial, max_iterations, scratch, best, current, trial, tally):  # type: ignore[no-untyped-def]
    """Refine start after start, until the matter is settled; the lowest physical optimum is in `best`.

    One loop, so that the refinement is compiled into one place only.
    """
    tally[_STATUS] = _NON_FINITE
    seen = flatten_kernel(problem.measured, problem.lens, scratch.image)
    for kind in range(_KINDS):
        # Three points may have four poses, all of which fit.
        if (
            kind > _PLANE
            and not (kind == _TRIANGLE and problem.points.shape[0] == 3)
            and _settled_kernel(tally, problem)
        ):
            break
        count = _starts_kernel(kind, problem, position, initial, seen, scratch, best, tally)
        _try_kernel(kind, count, problem, max_iterations, scratch, best, current, trial, tally)
    if tally[_STATUS] == _CONVERGED and tally[_RIVAL] - tally[_LOWEST] < AMBIGUITY_CHI2:
        tally[_STATUS] = _AMBIGUOUS


@kernel
def _starts_kernel(kind, problem, position, initial, seen, scratch, best, tally):  # type: ignore[no-untyped-def]
    """Starts of one kind into `scratch`; how many."""
    points, rotations, positions = problem.points, scratch.rotations, scratch.positions
    if kind == _GIVEN and initial.shape[0] > 0:
        copy_kernel(initial[0, :9], rotations[0].reshape(9))
        copy_kernel(initial[0, 9:], positions[0])
        return 1
    if kind == _LEVEL:
        return level_start_kernel(points, math.tan(math.radians(3.0)), scratch, rotations, positions)
    if kind == _FURTHER and tally[_STATUS] == _CONVERGED:
        return further_starts_kernel(points, best.rotation, best.position, rotations, positions)
    if not seen:  # by this lens
        return 0
    if kind == _ATTITUDE and problem.priors[0] > 0:
        return known_attitude_start_kernel(points, problem.attitude, scratch, rotations, positions)
    if (kind == _PLANE or (kind == _WITHOUT_LINES and problem.edges.shape[0] > 0)) and points.shape[0] > 3:
        return planar_starts_kernel(points, scratch, rotations, positions)
    if kind == _TRIANGLE:
        i, j, k = widest_triple_kernel(points)
        return three_point_starts_kernel(points, i, j, k, scratch, rotations, positions) if k != i else 0
    if kind == _POSITION and problem.priors[1] > 0:
        return known_position_start_kernel(points, position[0, :3], scratch, rotations, positions)
    return 0


@kernel
def _settled_kernel(tally, problem):  # type: ignore[no-untyped-def]
    """Whether an optimum is found that leaves no doubt: attitude well known, cost as noise explains it.

    P(χ²(m) > m + 2 sqrt(m t) + 2 t) <= exp(-t) (Laurent & Massart 2000, Lemma 1).
    """
    dof = problem.measured.shape[0] - 6
    most = dof + 2.0 * math.sqrt(dof * _IMPLAUSIBLE) + 2.0 * _IMPLAUSIBLE
    return tally[_STATUS] == _CONVERGED and tally[_SURE] > 0.0 and tally[_LOWEST] < most


@inlined
def _try_kernel(kind, count, problem, max_iterations, scratch, best, current, trial, tally):  # type: ignore[no-untyped-def]
    """Refine the first `count` starts of `scratch`.

    IPPE's second start is, for a runway, an upside-down view, and slow to refine. Once the first
    has led to a physical optimum with well-known attitude the other cannot lead to one as well.

    Lines mislead from far off: where a line turns by 90° against the one measured the cost has a
    jump, and optima behind it. Starts of the kind _WITHOUT_LINES are refined by all else first.
    """
    outcome, cost, steps = _NON_FINITE, math.nan, 0
    for s in range(count):
        if tally[_SURE] > 0.0 and not physical_kernel(scratch.rotations[s], scratch.positions[s]):
            continue
        copy_kernel(scratch.rotations[s].reshape(9), current.rotation.reshape(9))
        copy_kernel(scratch.positions[s], current.position)
        for lines in range(0 if kind == _WITHOUT_LINES else 1, 2):
            problem.numbers[2] = lines
            outcome, cost, steps = _refine_kernel(problem, current, trial, max_iterations)
        tally[_STATUS], tally[_STEPS] = min(tally[_STATUS], outcome), tally[_STEPS] + steps
        if outcome != _CONVERGED:
            continue
        distinct = tally[_LOWEST] < math.inf and _separation_kernel(current, best) > 1.0
        if cost < tally[_LOWEST]:
            if distinct:
                tally[_RIVAL] = tally[_LOWEST]
            tally[_LOWEST] = cost
            tally[_SURE] = 1.0 if _variance_kernel(current.inverse, 3) < _SURE_TURN**2 else 0.0
            copy_kernel(current.whole, best.whole)
        elif distinct:
            tally[_RIVAL] = min(tally[_RIVAL], cost)


@kernel
def _variance_kernel(inverse, first):  # type: ignore[no-untyped-def]
    """Sum of three variances from the `first` on: of the columns of L⁻¹, the squares."""
    total = 0.0
    for i in range(first, 6):
        for j in range(first, first + 3):
            total += inverse[i, j] ** 2
    return total


@kernel
def _separation_kernel(one, other):  # type: ignore[no-untyped-def]
    """Squared distance of two poses, each axis in the standard deviations it has by itself."""
    total = 0.0
    for a in range(3):
        total += one.normal[a, a] * (one.position[a] - other.position[a]) ** 2
        for b in range(3):  # |R1 - R2|² / 2 is the angle squared, for small angles
            total += 0.5 * one.normal[3 + a, 3 + a] * (one.rotation[b, a] - other.rotation[b, a]) ** 2
    return total


@kernel
def _invert_kernel(factor, inverse):  # type: ignore[no-untyped-def]
    """L⁻¹ of a factor (6, 6), as _cholesky_kernel leaves it; zero above the diagonal."""
    for j in range(6):
        for i in range(j):
            inverse[i, j] = 0.0
        inverse[j, j] = factor[j, j]
        for i in range(j + 1, 6):
            total = 0.0
            for k in range(j, i):
                total -= factor[i, k] * inverse[k, j]
            inverse[i, j] = total * factor[i, i]


@kernel
def _covariance_kernel(inverse, out):  # type: ignore[no-untyped-def]
    """(JᵀJ)⁻¹ = L⁻ᵀ L⁻¹."""
    for i in range(6):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, 6):
                total += inverse[k, i] * inverse[k, j]
            out[i, j] = total
            out[j, i] = total


@kernel
def _sharpness_kernel(problem, position, cov, keypoint_cov, line_cov, attitude, position_prior):  # type: ignore[no-untyped-def]
    """How many rows are known better than the scale of what they measure, and the position's relative sigma.

    The scale is the extent of the keypoints in the image, a radian, and the distance to the nearest point.
    """
    points, measured = problem.points, problem.measured
    least_u = least_v = nearest = math.inf
    most_u = most_v = -math.inf
    for i in range(points.shape[0]):
        u, v = measured[2 * i], measured[2 * i + 1]
        least_u, most_u, least_v, most_v = min(least_u, u), max(most_u, u), min(least_v, v), max(most_v, v)
        x, y, z = points[i, 0] - position[0], points[i, 1] - position[1], points[i, 2] - position[2]
        nearest = min(nearest, x * x + y * y + z * z)
    extent = max(most_u - least_u, most_v - least_v) ** 2
    sharp = 0
    for i in range(2 * points.shape[0]):
        sharp += keypoint_cov[i, i] < extent
    for i in range(line_cov.shape[0]):
        sharp += line_cov[i, i] < (extent if i % 2 == 0 else 1.0)
    for a in range(3):
        sharp += problem.priors[0] > 0 and attitude[0, 9 + 4 * a] < 1.0
        sharp += problem.priors[1] > 0 and position_prior[0, 3 + 4 * a] < nearest
    sharp += problem.priors[2] > 0 and problem.numbers[0] ** 2 * nearest > 1.0
    return sharp, math.sqrt((cov[0, 0] + cov[1, 1] + cov[2, 2]) / nearest)


@inlined
def _refine_kernel(problem, current, trial, max_iterations):  # type: ignore[no-untyped-def]
    """Gauss-Newton from the current pose, damped where it does not descend: outcome, cost, steps."""
    cost = _evaluate_kernel(problem, current)
    if not cost < math.inf:
        return (_BEHIND_CAMERA if cost == math.inf else _NON_FINITE), cost, 0
    _normal_kernel(current)
    damping, outcome, iteration, last = 0.0, _MAX_ITERATIONS, 0, 0.0
    while outcome == _MAX_ITERATIONS and iteration < max_iterations:
        iteration += 1
        size = _step_kernel(current, damping)
        _move_kernel(current, trial, problem.turn)
        tried = _evaluate_kernel(problem, trial)
        # The second term: below the rounding of the cost no decrease can be seen. A step that damping
        # has made short proves nothing.
        if damping < 1.0 and size < _STEP_TOLERANCE + 1e-15 * cost:
            outcome = _CONVERGED
        if tried < cost:
            if size * size < _STEP_TOLERANCE * last:  # sizes are squares: the next is about size² / last
                outcome = _CONVERGED
            last = size if damping == 0.0 else 0.0
            cost, damping = tried, (0.1 * damping if damping > _FIRST_DAMPING else 0.0)
            copy_kernel(trial.rows, current.rows)
            _normal_kernel(current)
        else:
            last, damping = 0.0, max(10.0 * damping, _FIRST_DAMPING)
    return _judge_kernel(problem, current, outcome), cost, iteration


@inlined
def _judge_kernel(problem, current, outcome):  # type: ignore[no-untyped-def]
    """What the end of a refinement is worth: is it determined, and is it physical?"""
    copy_kernel(current.normal.reshape(36), current.factor.reshape(36))
    if not _cholesky_kernel(current.factor, _SINGULAR):
        return _ILL_CONDITIONED
    square = 0.0
    for a in range(3):
        square += (problem.points[0, a] - current.position[a]) ** 2
    _invert_kernel(current.factor, current.inverse)
    if not _variance_kernel(current.inverse, 0) < _FREE_SHARE**2 * square:
        return _ILL_CONDITIONED
    if not _variance_kernel(current.inverse, 3) < _FREE_TURN**2:
        return _ILL_CONDITIONED
    if outcome == _CONVERGED and not physical_kernel(current.rotation, current.position):
        return _BEHIND_CAMERA
    return outcome


@inlined
def _step_kernel(state, damping):  # type: ignore[no-untyped-def]
    """Solve (JᵀJ + damping diag JᵀJ) δ = Jᵀr (Marquardt 1963); returns δᵀJᵀJδ."""
    normal, factor, gradient, step = state.normal, state.factor, state.gradient, state.step
    for a in range(6):
        for b in range(a):
            factor[a, b] = normal[a, b]
        factor[a, a] = (1.0 + damping) * normal[a, a]
        step[a] = gradient[a]
    if not _cholesky_kernel(factor, 0.0):
        step[:] = math.nan  # the trial fails and the damping grows
        return math.nan
    _solve_factored_kernel(factor, step)
    size = 0.0
    for a in range(6):  # δᵀJᵀJδ = δᵀ(Jᵀr - damping diag(JᵀJ) δ)
        size += step[a] * (gradient[a] - damping * normal[a, a] * step[a])
    return size


@inlined
def _move_kernel(current, trial, turn):  # type: ignore[no-untyped-def]
    """The pose moved by the step: p + δp, and R exp(δθ) to second order."""
    cayley_kernel(current.step[3:], turn)
    product_kernel(current.rotation, turn, trial.rotation)
    for a in range(3):
        trial.position[a] = current.position[a] + current.step[a]


@inlined
def _evaluate_kernel(problem, state):  # type: ignore[no-untyped-def]
    """Whitened residual and Jacobian at the pose; the cost, infinite with a point behind the camera."""
    rotation, position, residual, jacobian = state.rotation, state.position, state.residual, state.jacobian
    project_kernel(problem.points, rotation, position, problem.lens, residual, jacobian, problem.depth)
    for i in range(problem.depth.shape[0]):
        if not problem.depth[i] > 0.0:  # behind, or NaN: beyond the range of the distortion
            return math.inf
    row = 2 * problem.points.shape[0]
    if problem.numbers[1] > 0.0:
        _scale_kernel(problem.keypoint_factor, problem.measured, residual, jacobian)
    else:
        _whiten_kernel(problem.keypoint_factor, problem.measured, 0, residual, jacobian)
    if row < residual.shape[0]:
        _evaluate_more_kernel(problem, state, row)
    cost = 0.0
    for i in range(residual.shape[0]):
        cost += residual[i] * residual[i]
    return cost if math.isfinite(cost) else math.nan


@kernel
def _evaluate_more_kernel(problem, state, row):  # type: ignore[no-untyped-def]
    """The rows of lines and priors, from `row` on."""
    measured, residual, jacobian = problem.measured, state.residual, state.jacobian
    if problem.edges.shape[0] > 0:
        end = row + 2 * problem.edges.shape[0]
        if problem.numbers[2] > 0.0:
            for i in range(row, end):
                residual[i] = measured[i]
            lines_kernel(problem.edges, state.rotation, state.position, problem.lens, row, residual, jacobian)
            _whiten_kernel(problem.line_factor, measured, row, residual, jacobian)
        else:
            residual[row:end] = 0.0
            jacobian[row:end] = 0.0
        row = end
    jacobian[row:] = 0.0
    if problem.priors[0] > 0:
        _attitude_rows_kernel(problem, state.rotation, residual[row:], jacobian[row:])
        _whiten_kernel(problem.attitude_factor, measured, row, residual, jacobian)
        row += 3
    if problem.priors[1] > 0:
        for a in range(3):
            residual[row + a], jacobian[row + a, a] = state.position[a], 1.0
        _whiten_kernel(problem.position_factor, measured, row, residual, jacobian)
        row += 3
    if problem.priors[2] > 0:
        residual[row] = (measured[row] - state.position[2]) * problem.numbers[0]
        jacobian[row, 2] = problem.numbers[0]


@kernel
def _attitude_rows_kernel(problem, rotation, predicted, jacobian):  # type: ignore[no-untyped-def]
    """The rotation vector from the prior's attitude to this one, w = Log(R_priorᵀ R), and its Jacobian.

    That is the inverse of the right Jacobian of SO(3) at w (Forster et al. 2017, eq. 9):
    1 + [w]x / 2 + c [w]x², c = (1 - (t/2) / tan(t/2)) / t², t = |w|.
    """
    turn = problem.turn
    for i in range(3):
        for j in range(3):
            total = 0.0
            for a in range(3):
                total += problem.attitude[a, i] * rotation[a, j]
            turn[i, j] = total
    log_kernel(turn, predicted)
    x, y, z = predicted[0], predicted[1], predicted[2]
    t2 = x * x + y * y + z * z
    t = math.sqrt(t2)
    c = 1.0 / 12.0 + t2 / 720.0 if t < 1e-2 else (1.0 - 0.5 * t / math.tan(0.5 * t)) / t2
    # [w]x² = w wt - t² 1
    jacobian[0, 3], jacobian[0, 4], jacobian[0, 5] = 1.0 + c * (x * x - t2), c * x * y - 0.5 * z, c * x * z + 0.5 * y
    jacobian[1, 3], jacobian[1, 4], jacobian[1, 5] = c * x * y + 0.5 * z, 1.0 + c * (y * y - t2), c * y * z - 0.5 * x
    jacobian[2, 3], jacobian[2, 4], jacobian[2, 5] = c * x * z - 0.5 * y, c * y * z + 0.5 * x, 1.0 + c * (z * z - t2)


@kernel
def _scale_kernel(factor, measured, residual, jacobian):  # type: ignore[no-untyped-def]
    """_whiten_kernel for a diagonal factor, from the first row on."""
    for i in range(factor.shape[0]):
        scale = factor[i, i]
        residual[i] = (measured[i] - residual[i]) * scale
        for c in range(6):
            jacobian[i, c] *= scale


@kernel
def _whiten_kernel(factor, measured, first, residual, jacobian):  # type: ignore[no-untyped-def]
    """L⁻¹ (measured - residual) and L⁻¹ jacobian in place, rows from `first` on, by forward substitution."""
    for i in range(factor.shape[0]):
        row = first + i
        # Sums in scalars: the compiler cannot tell that rows of one array do not overlap.
        r, scale = measured[row] - residual[row], factor[i, i]
        a, b, c = jacobian[row, 0], jacobian[row, 1], jacobian[row, 2]
        d, e, f = jacobian[row, 3], jacobian[row, 4], jacobian[row, 5]
        for j in range(i):
            entry, above = factor[i, j], first + j
            r -= entry * residual[above]
            a -= entry * jacobian[above, 0]
            b -= entry * jacobian[above, 1]
            c -= entry * jacobian[above, 2]
            d -= entry * jacobian[above, 3]
            e -= entry * jacobian[above, 4]
            f -= entry * jacobian[above, 5]
        residual[row] = r * scale
        jacobian[row, 0], jacobian[row, 1], jacobian[row, 2] = a * scale, b * scale, c * scale
        jacobian[row, 3], jacobian[row, 4], jacobian[row, 5] = d * scale, e * scale, f * scale


@inlined
def _normal_kernel(state):  # type: ignore[no-untyped-def]
    """JᵀJ and Jᵀr."""
    jacobian, residual = state.jacobian, state.residual
    for row in range(6):
        a = b = c = d = e = f = g = 0.0
        for i in range(residual.shape[0]):
            value = jacobian[i, row]
            a += value * jacobian[i, 0]
            b += value * jacobian[i, 1]
            c += value * jacobian[i, 2]
            d += value * jacobian[i, 3]
            e += value * jacobian[i, 4]
            f += value * jacobian[i, 5]
            g += value * residual[i]
        normal = state.normal
        normal[row, 0], normal[row, 1], normal[row, 2] = a, b, c
        normal[row, 3], normal[row, 4], normal[row, 5] = d, e, f
        state.gradient[row] = g


@kernel
def _cholesky_kernel(a, least):  # type: ignore[no-untyped-def]
    """Lower Cholesky factor in place, with 1 / its diagonal on the diagonal; False where there is none.

    None, too, where a scaled pivot is `least` or under. A pivot over its diagonal entry is 1 - R², R
    the multiple correlation of that unknown with those before it: it has no unit, and equals the
    pivot of the matrix scaled to a unit diagonal.
    """
    for i in range(a.shape[0]):
        pivot = a[i, i]
        for j in range(i):
            total = a[i, j]
            for k in range(j):
                total -= a[i, k] * a[j, k]
            total *= a[j, j]
            a[i, j] = total
            pivot -= total * total
        if not (pivot > 0.0 and pivot > least * a[i, i]):
            return False
        a[i, i] = 1.0 / math.sqrt(pivot)
    return True


@kernel
def _solve_factored_kernel(factor, x):  # type: ignore[no-untyped-def]
    """Solve L Lᵀ x = b in place, for six unknowns."""
    for i in range(6):
        total = x[i]
        for j in range(i):
            total -= factor[i, j] * x[j]
        x[i] = total * factor[i, i]
    for i in range(5, -1, -1):
        total = x[i]
        for j in range(i + 1, 6):
            total -= factor[j, i] * x[j]
        x[i] = total * factor[i, i]
