"""How long does an evaluation of many predictions take, and how much memory? Made elsewhere, from a CSV file.

Labels and predictions are made up: approaches of LARD's cone to runways of a few airports, seen by LARD's
camera, corners with log-normal sigmas. There are no pictures, so that the data set is what is measured.

    python benchmarks/evaluation.py [--count 100000] [--out FOLDER]
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from shortfinal.data.dataset import COLUMNS, LARD_CONE, random_approach
from shortfinal.data.formats import CORNER_COLUMNS
from shortfinal.data.predictions import SIGMA_COLUMNS
from shortfinal.geometry import Camera, project
from shortfinal.runway import Runway

CAMERA = Camera(2448, 2648, 3401.6, 3401.6, 1223.5, 1323.5)


def make(folder: Path, count: int, seed: int = 0) -> tuple[Path, Path]:
    """Label and prediction files of `count` runways; the pictures are named and not there."""
    rng = np.random.default_rng(seed)
    runways = [Runway(rng.uniform(1200, 3500), rng.choice([30.0, 45.0, 60.0]), f"AP{k:02d}/09") for k in range(20)]
    camera = f"{CAMERA.width},{CAMERA.height},{CAMERA.fx},{CAMERA.fy},{CAMERA.cx},{CAMERA.cy},"
    labels, predictions = folder / "labels.csv", folder / "predictions.csv"
    with labels.open("w") as truth, predictions.open("w") as found:
        names = COLUMNS[: COLUMNS.index("far_left_v") + 1]
        truth.write(",".join(names) + "\n")
        found.write(",".join(("image", *CORNER_COLUMNS, *SIGMA_COLUMNS)) + "\n")
        for n in range(count):
            runway, pose = runways[n % 20], random_approach(rng, cone=LARD_CONE)
            px = project(CAMERA, pose, runway.corners)
            sigma = np.exp(rng.normal(np.log(0.5), 0.4, (4, 2)))
            seen = px + sigma * rng.standard_normal((4, 2))
            numbers = (runway.length_m, runway.width_m, *pose.position_m, *pose.attitude, *px.ravel())
            truth.write(f"{n:06d}.png,{runway.ident},{camera}," + ",".join(f"{v:.7g}" for v in numbers) + "\n")
            cells = (*seen.ravel(), *sigma.ravel())
            found.write(f"{n:06d}.png," + ",".join(f"{v:.6g}" for v in cells) + "\n")
    return labels, predictions


def main() -> None:
    """Make the files, evaluate them in a process of its own, print seconds and megabytes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.out or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        labels, predictions = make(folder, options.count)
        command = [sys.executable, "-m", "shortfinal.cli", "evaluate", str(predictions), "--data", str(labels)]
        start = time.perf_counter()
        subprocess.run([*command, "--out", str(folder / "report")], check=True)
        seconds = time.perf_counter() - start
        peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
        size = (folder / "report" / "report.html").stat().st_size / 1e6
    print(f"{options.count:,} predictions: {seconds:.1f} s, at most {peak:.0f} MB, report {size:.1f} MB")


if __name__ == "__main__":
    main()
