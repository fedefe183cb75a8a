"""The pose solver beside OpenCV's and scipy's: time, and accuracy on the same noisy keypoints.

Every solver sees the same problems in turn, in one process; medians are over problems. Accuracy is
the root mean square of the position error in the metric of the Cramér-Rao bound, sqrt(eᵀ C⁻¹ e / 3):
1 is the best any unbiased solver can do. σ is log-normal over the keypoints (spread 0.6), as a
network's is; OpenCV's solvers know nothing of it.

    python benchmarks/solver.py [--problems 300] [--repeats 5] [--json]
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.optimize import least_squares

import shortfinal as sf
from shortfinal.pose import estimate_pose_batch

Array = NDArray[np.float64]

CAMERA = sf.Camera(2448, 2648, 3401.6, 3401.6, 1223.5, 1323.5)  # LARD's


class Problem(NamedTuple):
    """Noisy corners of a runway, and the truth."""

    truth: sf.Pose
    points: Array  # (4, 3)
    keypoints: sf.GaussianKeypoints
    start: sf.Pose  # for the solver that has none of its own
    bound: Array  # (3, 3) Cramér-Rao bound of the position


def problems(count: int, seed: int = 0) -> list[Problem]:
    """Approaches of 0.5 to 2.5 km, where the bound is meaningful: the error is near Gaussian."""
    rng = np.random.default_rng(seed)
    return [_problem(rng) for _ in range(count)]


def _problem(rng: np.random.Generator) -> Problem:
    while True:
        distance, lateral, glide = rng.uniform(500, 2500), *np.radians([rng.uniform(-4, 4), rng.uniform(2.2, 3.8)])
        position = distance * np.array([-1.0, np.tan(lateral), np.tan(glide)])
        truth = sf.Pose.from_attitude(position, *rng.uniform([-10, -8, -10], [10, 0, 10]))
        points = sf.Runway(rng.uniform(1500, 3500), rng.uniform(30, 60)).corners
        px = sf.project(CAMERA, truth, points)
        if (px >= 0).all() and (px <= [CAMERA.width - 1, CAMERA.height - 1]).all():
            break
    sigma = 0.5 * np.exp(0.6 * rng.normal(size=(4, 2)))
    keypoints = sf.GaussianKeypoints.from_sigma(px + sigma * rng.normal(size=(4, 2)), sigma)
    jacobian = keypoints.whitening @ sf.project_jacobian(CAMERA, truth, points)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    start = truth.plus(np.linalg.cholesky(covariance) @ (3 * rng.normal(size=6)))
    return Problem(truth, points, keypoints, start, covariance[:3, :3])


def ours(problem: Problem) -> Array | None:
    estimate = sf.estimate_pose(problem.keypoints, problem.points, CAMERA)
    return None if estimate.pose is None else estimate.pose.position_m


def opencv(flag: int, refine: bool = False) -> Callable[[Problem], Array | None]:
    """OpenCV's solver `flag`; of two poses the first that is above the ground and upright."""
    matrix = CAMERA.matrix

    def solve(problem: Problem) -> Array | None:
        px = np.ascontiguousarray(problem.keypoints.mean_px)
        _, turns, shifts, _ = cv2.solvePnPGeneric(problem.points, px, matrix, None, flags=flag)
        for turn, shift in zip(turns, shifts, strict=True):
            if refine:
                turn, shift = cv2.solvePnPRefineLM(problem.points, px, matrix, None, turn, shift)
            rotation = cv2.Rodrigues(turn)[0]
            position = -rotation.T @ shift.ravel()
            if position[2] > 0 and rotation[1, 2] < 0:
                return position
        return None

    return solve


def scipy_whitened(problem: Problem) -> Array | None:
    """The same whitened cost, from a start three standard deviations from the truth."""
    whitening, mean = problem.keypoints.whitening, problem.keypoints.mean_px
    # In units of the standard deviations, or the steps are lost between metres and radians.
    root = np.sqrt(np.diag(problem.bound).max())
    scale = np.array([root, root, root, 1e-2, 1e-2, 1e-2])

    def residual(step: Array) -> Array:
        return whitening @ (sf.project(CAMERA, problem.start.plus(step * scale), problem.points) - mean).ravel()

    found = least_squares(residual, np.zeros(6), method="lm")
    return problem.start.plus(found.x * scale).position_m


SOLVERS: dict[str, Callable[[Problem], Array | None]] = {
    "shortfinal, one call": ours,
    "OpenCV SQPNP": opencv(cv2.SOLVEPNP_SQPNP),
    "OpenCV IPPE": opencv(cv2.SOLVEPNP_IPPE),
    "OpenCV IPPE + refineLM": opencv(cv2.SOLVEPNP_IPPE, refine=True),
    "OpenCV ITERATIVE": opencv(cv2.SOLVEPNP_ITERATIVE),
    "scipy least_squares, whitened": scipy_whitened,
}
BATCH = "shortfinal, batch, one thread"


def measure(count: int, repeats: int) -> list[dict[str, float | str]]:
    """Median time and accuracy of every solver."""
    cases = problems(count)
    times: dict[str, list[float]] = {name: [] for name in (BATCH, *SOLVERS)}
    errors: dict[str, list[float]] = {name: [] for name in (BATCH, *SOLVERS)}
    for solve in SOLVERS.values():
        solve(cases[0])  # compilation and first-use costs are not the solver's
    _batch(cases)
    for repeat in range(repeats):
        for problem in cases:
            for name, solve in SOLVERS.items():
                begin = time.perf_counter()
                position = solve(problem)
                times[name].append(time.perf_counter() - begin)
                if repeat == 0:
                    errors[name].append(_error(problem, position))
        elapsed, positions = _batch(cases)
        times[BATCH].append(elapsed / count)
        if repeat == 0:
            errors[BATCH] = [_error(p, x) for p, x in zip(cases, positions, strict=True)]
    best = float(np.median(times["shortfinal, one call"]))
    return [_row(name, float(np.median(times[name])), best, np.array(errors[name])) for name in times]


def _row(name: str, seconds: float, ours_seconds: float, errors: Array) -> dict[str, float | str]:
    solved = np.isfinite(errors)
    return {
        "solver": name,
        "microseconds": 1e6 * seconds,
        "times_ours": seconds / ours_seconds,
        "rms_over_bound": float(np.sqrt(np.mean(errors[solved] ** 2))),
        "median_over_bound": float(np.median(errors[solved])),
        "unsolved": int((~solved).sum()),
    }


def _error(problem: Problem, position: Array | None) -> float:
    if position is None or not np.isfinite(position).all():
        return np.nan
    e = position - problem.truth.position_m
    return float(np.sqrt(e @ np.linalg.solve(problem.bound, e) / 3))


def _batch(cases: list[Problem]) -> tuple[float, Array]:
    mean = np.array([p.keypoints.mean_px for p in cases])
    cov = np.array([p.keypoints.cov_px for p in cases])
    points = np.array([p.points for p in cases])
    begin = time.perf_counter()
    batch = estimate_pose_batch(mean, cov, points, CAMERA, threads=1)
    return time.perf_counter() - begin, batch.positions


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--problems", type=int, default=300)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    options = parser.parse_args()
    rows = measure(options.problems, options.repeats)
    if options.json:
        print(json.dumps(rows, indent=1))
        return
    table = Table("solver", "µs", "times ours", "RMS error / bound", "median error / bound", "unsolved")
    for row in rows:
        figures = [f"{row[k]:.2f}" for k in ("times_ours", "rms_over_bound", "median_over_bound")]
        table.add_row(str(row["solver"]), f"{row['microseconds']:.1f}", *figures, str(row["unsolved"]))
    Console().print(table)


if __name__ == "__main__":
    main()
