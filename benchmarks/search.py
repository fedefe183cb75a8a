"""Finding the runway unaided: in labelled pictures, and in frames that show none.

    python benchmarks/search.py --data ../shared/data/lard_sample --runways ../shared/data/lard_runways.json \\
        --empty FOLDER [--count 500] [--json]

Each picture is given to a new pipeline as three frames. Found: a verdict of USE, or a crop to look at, with the crop's
centre inside the runway's box. Frames without a runway (LARD's camera, turned away from the airfield, scenes of a seed
that no training used) are rendered once, into the folder: some three minutes on two cores. A false find is a frame with
a crop; beside it, those whose verdict is USE.
"""

from __future__ import annotations

import argparse
import json
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

import shortfinal as sf
from shortfinal.crops import box_around
from shortfinal.data.dataset import random_approach
from shortfinal.data.image import read_image
from shortfinal.data.lard import NAUTICAL_MILE_M
from shortfinal.evaluate.truth import read_truth
from shortfinal.files import write_png
from shortfinal.integrity import Decision
from shortfinal.pipeline import FrameResult
from shortfinal.scene.render import random_scene, render
from shortfinal.scene.sensor import random_sensor
from shortfinal.stream.source import read_camera

FRAMES, SEED = 3, 33
CAMERA = Path(__file__).parents[1] / "examples" / "lard640.toml"
NEAR_M = 2 * NAUTICAL_MILE_M


def empty_frames(folder: Path, count: int) -> list[Path]:
    """So many frames without a runway, rendered where they are not there yet."""
    folder.mkdir(parents=True, exist_ok=True)
    camera = read_camera(CAMERA)

    def one(index: int) -> Path:
        path = folder / f"{index:05d}.png"
        if not path.exists():
            rng = np.random.default_rng([SEED, index])
            scene = random_scene(rng)
            scene = scene._replace(airfield=scene.airfield._replace(other=np.zeros(6)))
            pose = random_approach(rng, scene.sky.visibility_m)
            yaw, pitch, roll = pose.attitude
            away = sf.Pose.from_attitude(pose.position_m, yaw + rng.uniform(60, 300), pitch, roll)
            write_png(path, render(scene, camera, away, random_sensor(rng), samples=3, seed=int(rng.integers(2**31))))
        return path

    with ThreadPoolExecutor() as pool:
        return list(track(pool.map(one, range(count)), "rendering", total=count))


def searched(pipeline: sf.LandingPipeline, picture: Any, times_ms: list[float]) -> FrameResult:
    """The first of three frames of the same picture that gives a crop, or the last."""
    for _ in range(FRAMES):  # at one time: the same picture later would be a frozen camera's
        start = time.perf_counter()
        result = pipeline.step(picture)
        times_ms.append(1e3 * (time.perf_counter() - start))
        if result.crop is not None:
            break
    return result


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, help="model file; the one that ships by default")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--runways", type=Path)
    parser.add_argument("--empty", type=Path, required=True, help="folder of the frames without a runway")
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    detector, times = sf.KeypointDetector(options.model), list[float]()
    told: dict[str, dict[str, Any]] = {}
    for known in track(read_truth(options.data, runways=options.runways).known, "pictures"):
        if known.camera is None or known.runway is None or known.pose is None:
            continue
        pipeline = sf.LandingPipeline(detector, known.runway, known.camera)
        result = searched(pipeline, read_image(known.target.picture.path), times)
        box, good = box_around(known.target.truth_px), False
        if result.crop is not None:
            centre = [result.crop.left + result.crop.width / 2 - 0.5, result.crop.top + result.crop.height / 2 - 0.5]
            good = bool((centre >= box[:2]).all() and (centre <= box[2:]).all())
        near = -known.pose.position_m[0] < NEAR_M
        counts = told.setdefault("nearer than 2 NM" if near else "farther", {"count": 0, "found": 0, "elsewhere": 0})
        counts["count"] += 1
        counts["found"] += good
        counts["elsewhere"] += result.crop is not None and not good
    finds = used = 0
    runway, camera = sf.Runway(2500.0, 45.0), read_camera(CAMERA)
    paths = empty_frames(options.empty, options.count)
    for path in track(paths, "empty frames"):
        result = searched(sf.LandingPipeline(detector, runway, camera), read_image(path), times)
        finds += result.crop is not None
        used += result.verdict.decision is Decision.USE
    told["no runway"] = {"count": len(paths), "found": finds, "use": used}
    p50, p99 = np.percentile(times, [50, 99])
    if options.json:
        print(json.dumps(told | {"step_ms": {"p50": p50, "p99": p99}}))
        return
    console = Console()
    for name, counts in told.items():
        console.print(f"{name}: " + ", ".join(f"{key} {value}" for key, value in counts.items()))
    console.print(f"a frame's search: {p50:.1f} ms median, {p99:.1f} ms p99")


if __name__ == "__main__":
    main()
