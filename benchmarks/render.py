"""How many different scenes a minute? Training pictures as `shortfinal data render` draws them.

python benchmarks/render.py [--count 200] [--json]
"""

import argparse
import json
import os
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from shortfinal.data.dataset import plan_shot
from shortfinal.data.scene import random_scene, render
from shortfinal.demo import CAMERA, RUNWAY, approach_pose


def training_pictures(count: int, threads: int) -> float:
    """Pictures a minute, drawn, not written."""
    with ThreadPoolExecutor(threads) as pool:
        start = time.perf_counter()
        list(pool.map(lambda n: plan_shot(77, n).render(), range(count)))
    return 60 * count / (time.perf_counter() - start)


def whole_frames(count: int, threads: int) -> float:
    """960 x 720 frames a minute of random scenes along the demo's approach."""
    scenes = [random_scene(np.random.default_rng(n), RUNWAY) for n in range(count)]
    with ThreadPoolExecutor(threads) as pool:
        start = time.perf_counter()
        list(pool.map(lambda n: render(scenes[n], CAMERA, approach_pose(97 * n % 100), samples=3), range(count)))
    return 60 * count / (time.perf_counter() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    threads = os.cpu_count() or 1
    training_pictures(4, threads)  # compiles
    figures = {
        "threads": threads,
        "training_pictures_per_minute": round(training_pictures(options.count, threads)),
        "frames_960x720_per_minute": round(whole_frames(max(4, options.count // 10), threads)),
    }
    print(json.dumps(figures) if options.json else "\n".join(f"{k}: {v}" for k, v in figures.items()))


if __name__ == "__main__":
    main()
