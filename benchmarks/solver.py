"""The pose solver beside OpenCV's and scipy's: time, and accuracy on the same noisy keypoints.

Every solver sees the same problems in one process, interleaved with the others in random order: in
turns of 50 problems, and again call by call, where each finds the caches as the others left them.
Medians are over problems and repeats. Accuracy is the root mean square error along, across and vertical,
each over its Cramér-Rao bound: 1 is the best any unbiased solver can do. σ is log-normal over the
keypoints (spread 0.6), as a network's is; OpenCV's solvers know nothing of it. Our call includes the
start, the covariance and the χ² verdict; the second row five protection levels as well. The second
table shows where the bound ends: far out and with blurred keypoints range errors are skewed, and no
estimator reaches it.

    python benchmarks/solver.py [--problems 1000] [--repeats 5] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.optimize import least_squares

import shortfinal as sf
from shortfinal.integrity import check_integrity_batch
from shortfinal.pose import estimate_pose_batch

Array = NDArray[np.float64]

CAMERA = sf.Camera(2448, 2648, 3401.6, 3401.6, 1223.5, 1323.5)  # LARD's
AXES = ("along", "cross", "vertical")
DISTANCES_M = (500.0, 1000.0, 2000.0, 4000.0, 8000.0)
SIGMAS_PX = (0.1, 0.5, 2.0, 8.0)


class Problem(NamedTuple):
    """Noisy corners of a runway, and the truth."""

    truth: sf.Pose
    points: Array  # (4, 3)
    keypoints: sf.GaussianKeypoints
    start: sf.Pose  # for the solver that has none of its own
    bound: Array  # (3,) Cramér-Rao bound of x, y, z: standard deviations, m


def problems(count: int, seed: int = 0, distances_m: tuple[float, float] = (500.0, 2500.0)) -> list[Problem]:
    """Approaches of 0.5 to 2.5 km, σ about 0.5 px: the bound is meaningful, as the error is near Gaussian."""
    rng = np.random.default_rng(seed)
    return [_problem(rng, distances_m, 0.5) for _ in range(count)]


def _problem(rng: np.random.Generator, distances_m: tuple[float, float], sigma_px: float) -> Problem:
    while True:
        distance, lateral, glide = rng.uniform(*distances_m), *np.radians([rng.uniform(-4, 4), rng.uniform(2.2, 3.8)])
        position = distance * np.array([-1.0, np.tan(lateral), np.tan(glide)])
        truth = sf.Pose.from_attitude(position, *rng.uniform([-10, -8, -10], [10, 0, 10]))
        runway = sf.Runway(rng.uniform(1500, 3500), rng.uniform(30, 60))
        px = sf.project(CAMERA, truth, runway.corners)
        if (px >= 0).all() and (px <= [CAMERA.width - 1, CAMERA.height - 1]).all():
            break
    sigma = sigma_px * np.exp(0.6 * rng.normal(size=(4, 2)))
    keypoints = sf.GaussianKeypoints.from_sigma(px + sigma * rng.normal(size=(4, 2)), sigma)
    jacobian = keypoints.whitening @ sf.project_jacobian(CAMERA, truth, runway.corners)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    start = truth.plus(np.linalg.cholesky(covariance) @ (3 * rng.normal(size=6)))
    return Problem(truth, runway.corners, keypoints, start, np.sqrt(np.diag(covariance)[:3]))


def ours(problem: Problem) -> Array | None:
    estimate = sf.estimate_pose(problem.keypoints, problem.points, CAMERA)
    sf.check_integrity(estimate)
    return None if estimate.pose is None else estimate.pose.position_m


def ours_with_levels(problem: Problem) -> Array | None:
    estimate = sf.estimate_pose(problem.keypoints, problem.points, CAMERA)
    sf.check_integrity(estimate)
    sf.protection_levels(estimate)
    return None if estimate.pose is None else estimate.pose.position_m


def opencv(flag: int, refine: bool = False) -> Callable[[Problem], Array | None]:
    """OpenCV's solver `flag`; of two poses the first that is above the ground and upright."""

    def solve(problem: Problem) -> Array | None:
        px = problem.keypoints.mean_px
        _, turns, shifts, _ = cv2.solvePnPGeneric(problem.points, px, MATRIX, None, flags=flag)
        for turn, shift in zip(turns, shifts, strict=True):
            if refine:
                turn, shift = cv2.solvePnPRefineLM(problem.points, px, MATRIX, None, turn, shift)
            rotation = cv2.Rodrigues(turn)[0]
            position = -rotation.T @ shift.ravel()
            if position[2] > 0 and rotation[1, 2] < 0:
                return position
        return None

    return solve


MATRIX = CAMERA.matrix


def sqpnp_alone(problem: Problem) -> None:
    """The bare call of OpenCV, without choosing a pose and turning it into a position."""
    cv2.solvePnPGeneric(problem.points, problem.keypoints.mean_px, MATRIX, None, flags=cv2.SOLVEPNP_SQPNP)


def scipy_whitened(problem: Problem) -> Array | None:
    """The same whitened cost, from a start three standard deviations from the truth."""
    whitening, mean = problem.keypoints.whitening, problem.keypoints.mean_px
    # In units of the standard deviations, or the steps are lost between metres and radians.
    scale = np.array([*np.full(3, problem.bound.max()), 1e-2, 1e-2, 1e-2])

    def residual(step: Array) -> Array:
        return whitening @ (sf.project(CAMERA, problem.start.plus(step * scale), problem.points) - mean).ravel()

    found = least_squares(residual, np.zeros(6), method="lm")
    return problem.start.plus(found.x * scale).position_m


OURS, BARE, SCIPY = "shortfinal, one call with verdict", "OpenCV SQPNP, the bare call", "scipy least_squares, whitened"
SOLVERS: dict[str, Callable[[Problem], Array | None]] = {
    OURS: ours,
    "shortfinal, with protection levels": ours_with_levels,
    BARE: sqpnp_alone,
    "OpenCV SQPNP": opencv(cv2.SOLVEPNP_SQPNP),
    "OpenCV IPPE": opencv(cv2.SOLVEPNP_IPPE),
    "OpenCV IPPE + refineLM": opencv(cv2.SOLVEPNP_IPPE, refine=True),
    "OpenCV ITERATIVE": opencv(cv2.SOLVEPNP_ITERATIVE),
}
TURNS = {"microseconds": 50, "microseconds_cold": 1}  # problems that a solver has before the next has its turn


def measure(count: int, repeats: int) -> list[dict[str, Any]]:
    """Median time and accuracy of every solver, in turns and call by call.

    scipy has its turns apart: it takes a hundred times as long, and would leave cold caches to
    whoever comes next in either case.
    """
    cases, order = problems(count), np.random.default_rng(1)
    for solve in (*SOLVERS.values(), scipy_whitened):
        solve(cases[0])  # compilation and first-use costs are not the solver's
    rows: dict[str, dict[str, Any]] = {}
    for column, turn in TURNS.items():
        for name, (seconds, found) in _interleaved(SOLVERS, cases, turn, repeats, order).items():
            row = rows.setdefault(name, {"solver": name} | _accuracy(name, cases, found))
            row[column] = 1e6 * seconds
    seconds, found = _interleaved({SCIPY: scipy_whitened}, cases, count, 1, order)[SCIPY]
    rows[SCIPY] = {"solver": SCIPY, "microseconds": 1e6 * seconds} | _accuracy(SCIPY, cases, found)
    batches = [_batch(cases, threads, max(repeats, 5)) for threads in dict.fromkeys((1, os.cpu_count() or 1))]
    table = [*rows.values(), *batches]
    for row in table:
        row["times_ours"] = row["microseconds"] / rows[OURS]["microseconds"]
    return table


def _interleaved(
    solvers: dict[str, Callable[[Problem], Array | None]],
    cases: list[Problem],
    turn: int,
    repeats: int,
    order: np.random.Generator,
) -> dict[str, tuple[float, list[Array | None]]]:
    """Median seconds of each solver, and the positions that it found."""
    times: dict[str, list[float]] = {name: [] for name in solvers}
    found: dict[str, list[Array | None]] = {name: [] for name in solvers}
    for repeat in range(repeats):
        for start in range(0, len(cases), turn):
            for name in order.permutation(list(solvers)):
                for problem in cases[start : start + turn]:
                    begin = time.perf_counter()
                    position = solvers[name](problem)
                    times[name].append(time.perf_counter() - begin)
                    if repeat == 0:
                        found[name].append(position)
    return {name: (float(np.median(times[name])), found[name]) for name in solvers}


def _accuracy(name: str, cases: list[Problem], found: list[Array | None]) -> dict[str, Any]:
    """RMS error over the bound for each axis, and how many problems were not solved."""
    if name == BARE:
        return {}
    solved = [(p, x) for p, x in zip(cases, found, strict=True) if x is not None and np.isfinite(x).all()]
    errors = np.array([(x - p.truth.position_m) / p.bound for p, x in solved])
    rms = np.sqrt(np.mean(errors**2, axis=0))
    return dict(zip(AXES, rms.tolist(), strict=True)) | {"unsolved": len(cases) - len(solved)}


def _batch(cases: list[Problem], threads: int, repeats: int) -> dict[str, Any]:
    """Problems with their verdicts at once; enough of them to fill a second or so."""
    copies = max(1, 20_000 // len(cases))
    mean, cov, points = (
        np.concatenate([np.array(arrays)] * copies)
        for arrays in (
            [p.keypoints.mean_px for p in cases],
            [p.keypoints.cov_px for p in cases],
            [p.points for p in cases],
        )
    )
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        batch = estimate_pose_batch(mean, cov, points, CAMERA, threads=threads)
        check_integrity_batch(batch)
        seconds.append((time.perf_counter() - begin) / len(mean))
    found = [x if np.isfinite(x).all() else None for x in batch.positions[: len(cases)]]
    name = f"shortfinal, batch, {threads} thread{'s' if threads > 1 else ''}"
    return {"solver": name, "microseconds": 1e6 * float(np.median(seconds))} | _accuracy(name, cases, found)


def reach(count: int) -> list[dict[str, Any]]:
    """RMS error over the bound for each distance and σ: where it is attained, and where that ends."""
    return [_reach(d, s, count) for d in DISTANCES_M for s in SIGMAS_PX]


def _reach(distance_m: float, sigma_px: float, count: int) -> dict[str, Any]:
    rng = np.random.default_rng([int(distance_m), int(10 * sigma_px)])
    cases = [_problem(rng, (0.98 * distance_m, 1.02 * distance_m), sigma_px) for _ in range(count)]
    mean, cov = np.array([p.keypoints.mean_px for p in cases]), np.array([p.keypoints.cov_px for p in cases])
    batch = estimate_pose_batch(mean, cov, np.array([p.points for p in cases]), CAMERA)
    good = batch.converged
    errors = (batch.positions - [p.truth.position_m for p in cases])[good] / np.array([p.bound for p in cases])[good]
    rms = np.sqrt(np.mean(errors**2, axis=0)).tolist()
    # The bound over the distance: how far from a point the error reaches, and so how curved the problem is.
    relative = float(np.median([p.bound[0] / np.linalg.norm(p.truth.position_m) for p in cases]))
    row = {"distance_m": distance_m, "sigma_px": sigma_px, "relative_bound": relative}
    return row | dict(zip(AXES, rms, strict=True)) | {"unsolved": int((~good).sum())}


def _print(rows: list[dict[str, Any]], reached: list[dict[str, Any]]) -> None:
    table = Table("solver", "µs", "times ours", "µs, cold", *(f"{axis} / bound" for axis in AXES), "unsolved")
    for row in rows:
        figures = [f"{row[axis]:.3f}" if axis in row else "" for axis in AXES]
        table.add_row(
            row["solver"],
            f"{row['microseconds']:.1f}",
            f"{row['times_ours']:.2f}",
            f"{row['microseconds_cold']:.1f}" if "microseconds_cold" in row else "",
            *figures,
            str(row.get("unsolved", "")),
        )
    Console(width=120).print(table)
    table = Table("km", "σ px", "bound / distance", *(f"{axis} / bound" for axis in AXES), "unsolved")
    for row in reached:
        figures = [f"{row[axis]:.3f}" for axis in AXES]
        place = (f"{row['distance_m'] / 1000:g}", f"{row['sigma_px']:g}", f"{row['relative_bound']:.2%}")
        table.add_row(*place, *figures, str(row["unsolved"]))
    Console(width=120).print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--problems", type=int, default=1000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")
    options = parser.parse_args()
    rows, reached = measure(options.problems, options.repeats), reach(4 * options.problems)
    if options.json:
        print(json.dumps({"solvers": rows, "reach": reached}, indent=1))
    else:
        _print(rows, reached)


if __name__ == "__main__":
    main()
