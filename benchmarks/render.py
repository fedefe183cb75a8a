"""How fast is the renderer? Training pictures a minute, as `data render` draws them, and whole frames a second.

python benchmarks/render.py [--count 200] [--threads 2] [--json]
"""

import argparse
import json
import os
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from shortfinal.data.dataset import plan_shot, random_approach
from shortfinal.geometry import Camera
from shortfinal.scene.render import random_scene, render

CAMERA = Camera(640, 640, 889.3, 822.1, 319.5, 319.5)  # LARD's Earth Studio camera, at 640 x 640


def frame(seed: int) -> None:
    rng = np.random.default_rng([78, seed])
    render(random_scene(rng), CAMERA, random_approach(rng), samples=3)


def per_second(draw, count: int, threads: int) -> float:
    """Pictures a second: each of another scene, drawn, not written."""
    with ThreadPoolExecutor(threads) as pool:
        start = time.perf_counter()
        list(pool.map(draw, range(count)))
    return count / (time.perf_counter() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    start = time.perf_counter()
    frame(0)
    figures = {
        "threads": options.threads,
        "first_frame_s": round(time.perf_counter() - start, 1),  # compiles, unless that was done
        "training_pictures_per_minute": round(
            60 * per_second(lambda n: plan_shot(77, n).render(), options.count, options.threads)
        ),
        "frames_640x640_per_second": round(per_second(frame, max(8, options.count // 5), options.threads), 2),
    }
    print(json.dumps(figures) if options.json else "\n".join(f"{k}: {v}" for k, v in figures.items()))


if __name__ == "__main__":
    main()
