"""The trials of a campaign: drawn, solved, doubted and counted, a chunk at a time.

A chunk is a function of (scenario, seed, its number) and nothing else, so that any worker, on any
machine, today or after a restart, counts the same. Frames, axes and units: the table of conventions
in docs/architecture.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shortfinal.campaign.config import Monitor, Range, Scenario
from shortfinal.errors import InputError, JobError
from shortfinal.geometry import BODY_FROM_CAMERA, Camera, kernel, project_kernel
from shortfinal.integrity import IntegrityBatch, check_integrity_batch
from shortfinal.keypoints import CORNER_NAMES
from shortfinal.pose import PoseEstimateBatch, estimate_pose_batch
from shortfinal.protection import protection_levels_batch
from shortfinal.runway import Runway

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

CHUNK = 20_000  # trials: a fraction of a second of work, some 30 MB
AXES = ("along", "cross", "vertical")
TAIL_RATES = (0.1, 0.05, 0.01, 1e-3, 1e-4)  # false-alarm rates that are counted beside the scenario's own
Z95 = 1.959963984540054  # within so many sigma lie 95 % of a normal variable
COUNTERS = (
    "trials",
    "solved",  # the solver converged
    "monitored",  # and the estimate could be checked
    "refused",  # monitored, and the monitor's test rejects: a false alarm, or a fault detected
    "accepted",  # monitored, and the test does not reject
    *(f"p_below_{rate:g}" for rate in TAIL_RATES),  # monitored, p-value below
    *(f"within_95_{axis}" for axis in AXES),  # monitored, error within 1.96 of its stated sigma
    *(f"over_level_{axis}" for axis in AXES),  # accepted, error over its protection level
    "over_level",  # on any axis
    *(f"over_limit_{axis}" for axis in AXES),  # accepted, error over its alert limit
    "over_limit",
    "available",  # accepted, every protection level within its alert limit
    "hazardous",  # available, error over an alert limit
)

DISTANCE_CELLS, GLIDE_CELLS = 12, 8  # of a map
P_BINS = 20  # equal
# Of errors and levels: logarithmic, from 1 cm to 100 km; those outside are in the first or last.
BINS_A_DECADE, LOWEST_EXPONENT, DECADES = 100, -2, 7
BINS = BINS_A_DECADE * DECADES

_FEWEST_IN_FRAME = 0.01  # of random poses; fewer, and the sections contradict one another
_ROUNDS = 2000


class Views(NamedTuple):
    """N true poses, and what they see."""

    distance_m: Array  # (N,)
    glide_deg: Array  # (N,)
    positions: Array  # (N, 3)
    rotations: Array  # (N, 3, 3) runway_from_camera
    points: Array  # (N, K, 3) as the solver is told them
    px: Array  # (N, K, 2) without noise


class Measured(NamedTuple):
    """What the solver is given of N views."""

    mean_px: Array  # (N, K, 2)
    cov_px: Array  # (N, 2K, 2K), or (2K, 2K) when shared
    priors: dict[str, Any]  # keywords of estimate_pose_batch


@dataclass(frozen=True, eq=False)
class Counts:
    """What a chunk, or any number of them, came to: integers, and sums that `math.fsum` adds up exactly."""

    cells: NDArray[np.int64]  # (DISTANCE_CELLS * GLIDE_CELLS, len(COUNTERS))
    p_values: NDArray[np.int64]  # (P_BINS,) of the monitored
    errors: NDArray[np.int64]  # (3, BINS) of the accepted
    levels: NDArray[np.int64]  # (3, BINS) of the monitored
    squares: Array  # (4,) squared error of the accepted along, cross, vertical, m²; NEES of the monitored

    def to_dict(self) -> dict[str, Any]:
        """As JSON takes it."""
        return {f.name: getattr(self, f.name).tolist() for f in fields(self)}

    @classmethod
    def from_dict(cls, record: dict[str, Any]) -> Counts:
        """The inverse of `to_dict`; JSON keeps every bit of a float."""
        kinds: dict[str, Any] = {"squares": np.float64}
        return cls(**{f.name: np.array(record[f.name], kinds.get(f.name, np.int64)) for f in fields(cls)})


def count_chunk(scenario: Scenario, seed: int, index: int, number: int, trials: int) -> dict[str, Any]:
    """Count `trials` trials: chunk `number` of the scenario at `index` of its campaign; `Counts.to_dict`."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index, number)))
    views = draw_views(rng, scenario, trials)
    measured = measure(rng, scenario, views)
    batch = estimate_pose_batch(
        measured.mean_px, measured.cov_px, views.points, scenario.camera, threads=1, **measured.priors
    )
    return count_trials(scenario, views, batch).to_dict()


def check_scenario(scenario: Scenario, tries: int = 2000) -> None:
    """Try it on two trials, which also compiles what it needs.

    Raises InputError if hardly any random pose shows the whole runway, or its options contradict.
    """
    shown = int(_look(np.random.default_rng(0), scenario, tries)[1].sum())
    if shown < _FEWEST_IN_FRAME * tries:
        raise InputError(
            f"{scenario.name}: of {tries} random poses {shown} have every point in the frame; "
            "narrow poses, or widen the camera"
        )
    try:
        count_chunk(scenario, 0, 0, 0, 2)
    except InputError as error:
        raise InputError(f"{scenario.name}: {error}") from error


def draw_views(rng: np.random.Generator, scenario: Scenario, count: int) -> Views:
    """`count` poses that have every point in the frame, by rejection."""
    kept: list[Views] = []
    missing = count
    for _ in range(_ROUNDS):
        views, shown = _look(rng, scenario, max(missing, count // 4))
        kept.append(Views(*(array[shown] for array in views)))
        missing -= int(shown.sum())
        if missing <= 0:
            return Views(*(np.concatenate(arrays)[:count] for arrays in zip(*kept, strict=True)))
    raise JobError(f"{scenario.name}: no pose with every point in the frame in {_ROUNDS} rounds of drawing")


def _look(rng: np.random.Generator, scenario: Scenario, count: int) -> tuple[Views, Flags]:
    """`count` views, and which (N,) have every point in the frame."""
    poses = scenario.poses
    distance, glide, lateral, yaw, pitch, roll = (
        _uniform(rng, r, count)
        for r in (poses.distance_m, poses.glide_deg, poses.lateral_deg, poses.yaw_deg, poses.pitch_deg, poses.roll_deg)
    )
    slopes = (-np.ones(count), np.tan(np.radians(lateral)), np.tan(np.radians(glide)))
    positions = np.column_stack([distance * slope for slope in slopes])
    points = _points(rng, scenario, count)
    seen = points
    if scenario.fault.far_off_m is not None:
        seen = points.copy()
        seen[:, 2:4, 0] += scenario.fault.far_off_m
    rotations = camera_rotations(yaw, pitch, roll)
    px, _, depth = project_batch(scenario.camera, positions, rotations, seen)
    inside = (px >= 0).all(axis=2) & (px <= [scenario.camera.width - 1, scenario.camera.height - 1]).all(axis=2)
    return Views(distance, glide, positions, rotations, points, px), np.asarray((inside & (depth > 0)).all(axis=1))


def _uniform(rng: np.random.Generator, ends: Range, count: int) -> Array:
    return ends[0] + (ends[1] - ends[0]) * rng.random(count)


def _points(rng: np.random.Generator, scenario: Scenario, count: int) -> Array:
    """Corners and named points (N, K, 3) as the solver is told them."""
    extra = np.array(scenario.runway.points_m).reshape(-1, 3)
    unit = np.vstack([Runway(1.0, 1.0).corners, extra])
    points = np.tile(unit, (count, 1, 1))
    points[:, :4, 0] *= _uniform(rng, scenario.runway.length_m, count)[:, None]
    points[:, :4, 1] *= _uniform(rng, scenario.runway.width_m, count)[:, None]
    return points


def camera_rotations(yaw_deg: Array, pitch_deg: Array, roll_deg: Array) -> Array:
    """runway_from_camera (N, 3, 3), as `Pose.from_attitude` has it."""
    turns = Rotation.from_euler("ZYX", np.column_stack([-yaw_deg, -pitch_deg, roll_deg]), degrees=True)
    return np.asarray(turns.as_matrix() @ BODY_FROM_CAMERA)


def project_batch(camera: Camera, positions: Array, rotations: Array, points: Array) -> tuple[Array, Array, Array]:
    """Pixels (N, K, 2), their Jacobian (N, 2K, 6) in the local increment, depths (N, K): N poses, each its points."""
    count, k = points.shape[:2]
    px, jacobian, depth = np.empty((count, 2 * k)), np.empty((count, 2 * k, 6)), np.empty((count, k))
    _project_batch_kernel(points, rotations, positions, camera.intrinsics, px, jacobian, depth)
    return px.reshape(count, k, 2), jacobian, depth


@kernel
def _project_batch_kernel(points, rotations, positions, intrinsics, px, jacobian, depth):  # type: ignore[no-untyped-def]
    for i in range(points.shape[0]):
        project_kernel(points[i], rotations[i], positions[i], intrinsics, px[i], jacobian[i], depth[i])


def measure(rng: np.random.Generator, scenario: Scenario, views: Views) -> Measured:
    """Keypoints with their noise and fault, the covariance that is told, and the priors with their noise."""
    sigma = _sigmas(rng, scenario, views.px.shape)
    noise = rng.standard_normal(views.px.shape)
    rho = scenario.correlation.rho
    if rho > 0:
        # One error shared by all keypoints and one of each: correlation rho between any two.
        shared = rng.standard_normal((len(noise), 1, 2))
        noise = math.sqrt(1 - rho) * noise + math.sqrt(rho) * shared
    mean = views.px + sigma * noise
    cov = _covariance(sigma, rho if scenario.correlation.told else 0.0)
    priors = _priors(rng, scenario, views)
    if scenario.fault.kind == "corner":
        _shift_corner(rng, scenario, views, sigma, cov, mean)
    return Measured(mean, cov, priors)


def _sigmas(rng: np.random.Generator, scenario: Scenario, shape: tuple[int, ...]) -> Array:
    """Of each coordinate (N, K, 2), or (1, K, 2) when all trials share them."""
    stated = scenario.sigma
    if stated.spread > 0:
        sigma = stated.px * np.exp(stated.spread * rng.standard_normal(shape))
    else:
        sigma = np.full((1, *shape[1:]), stated.px)
    sigma[:, 2:4] *= stated.far_ratio
    return np.maximum(sigma, stated.floor_px)


def _covariance(sigma: Array, rho: float) -> Array:
    """(N, 2K, 2K), or (2K, 2K) when shared: u correlated with u by `rho`, and v with v."""
    k = sigma.shape[1]
    flat = sigma.reshape(-1, 2 * k)
    correlation = np.kron(np.full((k, k), rho) + (1 - rho) * np.eye(k), np.eye(2))
    cov = flat[:, :, None] * flat[:, None, :] * correlation
    return np.asarray(cov if len(cov) > 1 else cov[0])


def _priors(rng: np.random.Generator, scenario: Scenario, views: Views) -> dict[str, Any]:
    given, count = scenario.priors, len(views.positions)
    priors: dict[str, Any] = {}
    if given.attitude_deg is not None:
        sigma = math.radians(given.attitude_deg)
        turns = Rotation.from_rotvec(sigma * rng.standard_normal((count, 3))).as_matrix()
        priors["attitude_prior"] = (views.rotations @ turns, sigma**2 * np.eye(3))
    if given.position_m is not None:
        off = given.position_m * rng.standard_normal((count, 3))
        priors["position_prior"] = (views.positions + off, given.position_m**2 * np.eye(3))
    if given.altitude_m is not None:
        heights = views.positions[:, 2] + given.altitude_m * rng.standard_normal(count)
        priors["altitude"] = (heights, given.altitude_m)
    return priors


_CORNERS = {"any": (0, 1, 2, 3), "near": (0, 1), "far": (2, 3)} | {n: (k,) for k, n in enumerate(CORNER_NAMES)}


def _shift_corner(
    rng: np.random.Generator, scenario: Scenario, views: Views, sigma: Array, cov: Array, mean: Array
) -> None:
    """Move one keypoint of each trial, in place."""
    fault, count = scenario.fault, len(mean)
    which = rng.choice(_CORNERS[fault.corner], count)
    trial = np.arange(count)
    if fault.shift_px is not None:
        unit, size = np.ones((count, 2)), fault.shift_px
    else:
        unit, size = np.broadcast_to(sigma, mean.shape)[trial, which], fault.shift_sigma or 0.0
    angle = 2 * math.pi * rng.random(count)
    if fault.direction == "worst":
        # Either end of the line that hides it best: chance has the sign.
        angle = _hiding_angle(scenario, views, cov, which, unit) + math.pi * (angle < math.pi)
    mean[trial, which] += size * unit * np.column_stack([np.cos(angle), np.sin(angle)])


def _hiding_angle(scenario: Scenario, views: Views, cov: Array, which: NDArray[np.int64], unit: Array) -> Array:
    """The angle (N,) at which a shift of keypoint `which`, in `unit` (N, 2), leaves the smallest residual.

    A shift b leaves λ = bᵀ (Σ⁻¹ - Σ⁻¹H (HᵀΣ⁻¹H + P)⁻¹ HᵀΣ⁻¹) b, P the information of the priors.
    """
    _, jacobian, _ = project_batch(scenario.camera, views.positions, views.rotations, views.points)
    weight = np.linalg.inv(cov if cov.ndim == 3 else cov[None])
    weighted = weight @ jacobian  # Σ⁻¹H
    information = np.swapaxes(jacobian, 1, 2) @ weighted + _prior_information(scenario)
    trial = np.arange(len(which))
    rows = 2 * which[:, None] + np.arange(2)
    mine = weighted[trial[:, None], rows]  # (N, 2, 6)
    of = np.minimum(trial, len(weight) - 1)  # the one they share, or each its own
    own = weight[of[:, None, None], rows[:, :, None], rows[:, None]]
    left = own - mine @ np.linalg.solve(information, np.swapaxes(mine, 1, 2))
    left = left * unit[:, :, None] * unit[:, None, :]
    # Of a symmetric 2 x 2 matrix: the larger eigenvalue's angle, and a right angle more.
    steep = 0.5 * np.arctan2(2 * left[:, 0, 1], left[:, 0, 0] - left[:, 1, 1])
    return np.asarray(steep + math.pi / 2)


def _prior_information(scenario: Scenario) -> Array:
    """What the priors add to the information (6, 6), of the local increment."""
    given, information = scenario.priors, np.zeros(6)
    if given.position_m is not None:
        information[:3] += given.position_m**-2
    if given.altitude_m is not None:
        information[2] += given.altitude_m**-2
    if given.attitude_deg is not None:
        information[3:] += math.radians(given.attitude_deg) ** -2
    return np.diag(information)


def count_trials(scenario: Scenario, views: Views, batch: PoseEstimateBatch) -> Counts:
    """What the solved trials came to."""
    verdict = check_integrity_batch(batch, scenario.monitor.false_alarm_rate)
    monitored, accepted, p_value = verdict.monitored, verdict.usable, verdict.p_value
    error, level = np.abs(batch.positions - views.positions), None
    if scenario.monitor.protection:
        level, passed = _protection(scenario.monitor, batch)
        accepted = accepted if passed is None else monitored & passed
    flags = _checked(batch, verdict, error) | _judged(scenario.monitor, monitored, accepted, error, level)
    p_bins = np.minimum((p_value[monitored] * P_BINS).astype(np.int64), P_BINS - 1)
    squares = [*(error[accepted] ** 2).sum(axis=0), _nees(views, batch)[monitored].sum()]
    return Counts(
        cells=_by_cell(_cells(scenario, views), flags),
        p_values=np.bincount(p_bins, minlength=P_BINS),
        errors=_histogram(error[accepted]),
        levels=_histogram(np.empty((0, 3)) if level is None else level[monitored]),
        squares=np.array(squares),
    )


def _checked(batch: PoseEstimateBatch, verdict: IntegrityBatch, error: Array) -> dict[str, Flags]:
    """Whether the residuals, and the errors, are as large as stated."""
    sigma = np.sqrt(np.diagonal(batch.covs, axis1=1, axis2=2)[:, :3])
    return {
        "trials": np.ones(len(batch), bool),
        "solved": batch.converged,
        **{f"p_below_{rate:g}": verdict.monitored & (verdict.p_value < rate) for rate in TAIL_RATES},
        **_by_axis("within_95", verdict.monitored[:, None] & (error <= Z95 * sigma)),
    }


def _judged(monitor: Monitor, monitored: Flags, accepted: Flags, error: Array, level: Array | None) -> dict[str, Flags]:
    """Which trials were accepted, and which of those were further off than was promised, or than is allowed."""
    limits = np.array(monitor.limits_m)
    over_limit = accepted[:, None] & (error > limits)
    flags = {"monitored": monitored, "refused": monitored & ~accepted, "accepted": accepted}
    flags |= {**_by_axis("over_limit", over_limit), "over_limit": _any(over_limit)}
    if level is not None:
        over_level = accepted[:, None] & ~(error <= level)  # a level that is NaN promised nothing
        available = accepted & ~_any(~(level <= limits)) & ~_any(~np.isfinite(level))
        flags |= {**_by_axis("over_level", over_level), "over_level": _any(over_level)}
        flags |= {"available": available, "hazardous": available & _any(over_limit)}
    return flags


def _any(flags: Flags) -> Flags:
    return np.asarray(flags.any(axis=1))


def _by_axis(name: str, flags: Flags) -> dict[str, Flags]:
    return {f"{name}_{axis}": flags[:, n] for n, axis in enumerate(AXES)}


def _protection(monitor: Monitor, batch: PoseEstimateBatch) -> tuple[Array, Flags | None]:
    """Protection levels (N, 3) along, cross and vertical, m; and what solution separation's own test accepts."""
    levels = protection_levels_batch(
        batch, integrity_risk=monitor.integrity_risk, fault_prior=monitor.fault_prior,
        false_alarm_rate=monitor.false_alarm_rate, method=monitor.method, threads=1,
    )  # fmt: skip
    return np.column_stack([levels.along_m, levels.cross_m, levels.vertical_m]), levels.passed


def _nees(views: Views, batch: PoseEstimateBatch) -> Array:
    """Normalised estimation error squared (N,): δᵀ P⁻¹ δ = |H_w δ|², δ the increment from estimate to truth."""
    # NaN, where there is no estimate, is no rotation.
    turns = np.where(batch.converged[:, None, None], np.swapaxes(batch.rotations, 1, 2) @ views.rotations, np.eye(3))
    moved = views.positions - batch.positions
    increment = np.concatenate([moved, Rotation.from_matrix(turns).as_rotvec()], axis=1)
    return np.asarray(np.sum(np.einsum("nij,nj->ni", batch.jacobians, increment) ** 2, axis=1))


def _cells(scenario: Scenario, views: Views) -> NDArray[np.int64]:
    """The map's cell (N,) of each trial: distance times GLIDE_CELLS plus glide angle."""
    poses = scenario.poses
    along = _cell(views.distance_m, poses.distance_m, DISTANCE_CELLS)
    return along * GLIDE_CELLS + _cell(views.glide_deg, poses.glide_deg, GLIDE_CELLS)


def _cell(values: Array, ends: Range, cells: int) -> NDArray[np.int64]:
    width = (ends[1] - ends[0]) or 1.0
    return np.minimum((cells * (values - ends[0]) / width).astype(np.int64), cells - 1)


def _by_cell(cell: NDArray[np.int64], flags: dict[str, Flags]) -> NDArray[np.int64]:
    counts = np.zeros((DISTANCE_CELLS * GLIDE_CELLS, len(COUNTERS)), np.int64)
    for column, name in enumerate(COUNTERS):
        if name in flags:
            counts[:, column] = np.bincount(cell[flags[name]], minlength=len(counts))
    return counts


def _histogram(values: Array) -> NDArray[np.int64]:
    """Logarithmic histograms (3, BINS) of the columns of `values` (N, 3); NaN is left out."""
    low, high = 10.0**LOWEST_EXPONENT, 10.0 ** (LOWEST_EXPONENT + DECADES)
    counts = []
    for column in values.T:
        known = np.clip(column[~np.isnan(column)], low, high)
        bins = (BINS_A_DECADE * (np.log10(known) - LOWEST_EXPONENT)).astype(np.int64)
        counts.append(np.bincount(np.minimum(bins, BINS - 1), minlength=BINS))
    return np.array(counts)
