"""How often do the intervals of `sample_pose` hold the truth? Along, cross and vertical, by method.

Two designs, as the question has two meanings. "truth in zone": the truth is drawn evenly over
distance and angles of a zone, and the noise afresh, so that the coverage is that of a confidence
interval, averaged over the zone. "estimate in zone": the truth is drawn from the flat prior that the
posterior assumes (evenly over a volume much wider than the zone), and the frame is kept if its
*estimate* lies in the zone; only so is a posterior interval exact. σ is told to all methods.

    python benchmarks/distribution.py [--problems 400] [--samples 1000] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom

import shortfinal as sf
from shortfinal.distribution import METHODS, sample_pose

Array = NDArray[np.float64]

CAMERA = sf.Camera(2448, 2648, 3401.6, 3401.6, 1223.5, 1323.5)  # LARD's
LEVELS = (0.68, 0.95, 0.99)
AXES = ("along", "cross", "vertical")
DESIGNS = ("truth in zone", "estimate in zone")
LATERAL_DEG = 4.0  # either side of the centreline


@dataclass(frozen=True)
class Zone:
    """Where the frames are taken, and how sharp they are. Distance is along the runway's axis."""

    distance_m: tuple[float, float]
    glide_deg: tuple[float, float]
    sigma_px: tuple[float, float]

    def holds(self, position: Array) -> bool:
        """Whether `position` (3,), metres in the runway frame, lies in the zone."""
        distance = -position[0]
        lateral, glide = np.degrees(np.arctan2(position[1:], distance))
        inside = self.distance_m[0] <= distance <= self.distance_m[1] and abs(lateral) <= LATERAL_DEG
        return bool(inside and self.glide_deg[0] <= glide <= self.glide_deg[1])


ZONES = {
    "ordinary": Zone((800.0, 1200.0), (2.2, 3.8), (0.5, 0.5)),
    "low": Zone((2000.0, 3000.0), (0.5, 1.0), (0.5, 1.0)),
    "far": Zone((4000.0, 8000.0), (2.2, 3.8), (1.0, 2.0)),
}


@dataclass(frozen=True)
class Row:
    """Coverage of one method in one zone: counts of the frames it answered, by axis and level."""

    zone: str
    design: str
    method: str
    problems: int
    refused: int  # frames of these that the method gave no interval for
    covered: dict[str, list[int]]  # axis -> count for each of LEVELS
    milliseconds: float  # median of a call

    @property
    def answered(self) -> int:
        """Frames with an interval."""
        return self.problems - self.refused

    def agrees(self, axis: str, level: int) -> bool:
        """Whether the count is one that a true LEVELS[level] yields in 99 % of samples."""
        low, high = binom.interval(0.99, self.answered, LEVELS[level])
        return bool(low <= self.covered[axis][level] <= high)


def frames(zone: Zone, design: str, count: int, seed: int) -> Iterator[tuple[sf.Pose, sf.PoseEstimate]]:
    """Truths and estimates of frames that show the whole runway."""
    rng = np.random.default_rng(seed)
    draw = _in_zone if design == DESIGNS[0] else _around_zone
    while count:
        truth = sf.Pose.from_attitude(draw(zone, rng), *rng.uniform([-10, -8, -10], [10, 0, 10]))
        runway = sf.Runway(rng.uniform(1500, 3500), rng.uniform(30, 60))
        px, sigma = sf.project(CAMERA, truth, runway.corners), rng.uniform(*zone.sigma_px)
        if not ((px > 0).all() and (px < [CAMERA.width - 1, CAMERA.height - 1]).all()):
            continue
        keypoints = sf.GaussianKeypoints.from_sigma(px + sigma * rng.normal(size=px.shape), sigma)
        est = sf.estimate_pose(keypoints, runway.corners, CAMERA)
        if est.pose is None or (design == DESIGNS[1] and not zone.holds(est.pose.position_m)):
            continue
        count -= 1
        yield truth, est


def _in_zone(zone: Zone, rng: np.random.Generator) -> Array:
    angles = np.radians([rng.uniform(-LATERAL_DEG, LATERAL_DEG), rng.uniform(*zone.glide_deg)])
    return rng.uniform(*zone.distance_m) * np.array([-1.0, *np.tan(angles)])


def _around_zone(zone: Zone, rng: np.random.Generator) -> Array:
    """Flat over the volume of a wedge that reaches several standard deviations beyond the zone."""
    near, far = 0.5 * zone.distance_m[0], 2.0 * zone.distance_m[1]
    side, top = np.tan(np.radians([1.5 * LATERAL_DEG, 1.75 * zone.glide_deg[1]]))
    distance = rng.uniform(near**3, far**3) ** (1 / 3)
    return distance * np.array([-1.0, rng.uniform(-side, side), rng.uniform(0.0, top)])


def _held(case: tuple[int, tuple[sf.Pose, sf.PoseEstimate]], method: str, samples: int) -> tuple[Array | None, float]:
    """Which intervals (levels, axes) hold the truth, and the seconds that sampling took."""
    seed, (truth, est) = case
    begin = time.perf_counter()
    try:
        drawn = sample_pose(est, samples, method, seed)
    except sf.InputError:
        return None, time.perf_counter() - begin
    elapsed = time.perf_counter() - begin
    ends = np.array([drawn.interval(level) for level in LEVELS])
    return (ends[..., 0] <= truth.position_m) & (truth.position_m <= ends[..., 1]), elapsed


def coverage(zone: str, design: str, method: str, problems: int, samples: int = 1000, seed: int = 0) -> Row:
    """Count over `problems` frames, on all processors: the kernels leave the interpreter to others."""
    cases = list(enumerate(frames(ZONES[zone], design, problems, seed)))
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        answers = list(pool.map(partial(_held, method=method, samples=samples), cases))
    held = [answer for answer, _ in answers if answer is not None]
    counts = np.sum(held, axis=0).astype(int) if held else np.zeros((len(LEVELS), 3), int)
    covered = {axis: counts[:, a].tolist() for a, axis in enumerate(AXES)}
    milliseconds = 1e3 * float(np.median([seconds for _, seconds in answers]))
    return Row(zone, design, method, problems, problems - len(held), covered, milliseconds)


def main() -> None:
    from rich.console import Console
    from rich.table import Table

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--problems", type=int, default=400, help="frames a row")
    parser.add_argument("--samples", type=int, default=1000, help="draws an interval is taken from")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    options = parser.parse_args()
    kinds = [(zone, design, method) for zone in ZONES for design in DESIGNS for method in METHODS]
    rows = [coverage(*kind, options.problems, options.samples) for kind in kinds]
    if options.json:
        print(json.dumps([asdict(row) for row in rows], indent=1))
        return
    levels = " / ".join(f"{100 * level:.0f}" for level in LEVELS)
    table = Table("zone", "design", "method", *(f"{axis} {levels}" for axis in AXES), "refused", "ms")
    for row in rows:
        cells = [
            " / ".join(
                f"{100 * count / max(row.answered, 1):.1f}{'' if row.agrees(axis, level) else '!'}"
                for level, count in enumerate(row.covered[axis])
            )
            for axis in AXES
        ]
        table.add_row(row.zone, row.design, row.method, *cells, str(row.refused), f"{row.milliseconds:.1f}")
    Console(width=140).print(table)
    print("% of the frames answered whose interval holds the truth; !: a true rate yields such a count in under 1 %")


if __name__ == "__main__":
    main()
