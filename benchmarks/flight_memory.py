"""Does a flight's memory stay flat? Frames through the whole of it, with a results folder, for as long as you like.

A few rendered pictures of 1920 x 1080 of an approach, as raw arrays, come in turn: nothing is decoded. The real
pipeline with its track, its writer, frames.jsonl with a line a frame, and a copy of each `--copies`th frame.
Resident memory is read every so many frames; the first quarter is left to caches and pools to fill. Flat means: the
straight line through the rest rises by less over all of it than what it leaves unexplained, 2 sigma, or by less than
1 MB.

    python benchmarks/flight_memory.py [--frames 20000] [--every 1000] [--copies 30] [--video] [--out FOLDER]
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import shortfinal as sf
from shortfinal.demo import RUNWAY, approach_pose, demo_scene
from shortfinal.scene.render import render
from shortfinal.scene.sensor import Sensor
from shortfinal.stream.fly import BUDGET_MS, flight_record, fly
from shortfinal.stream.frames import TimedFrame
from shortfinal.stream.sink import AnnotatedVideo, Log, Sink

CAMERA = sf.Camera(1920, 1080, 4000.0, 4000.0, 959.5, 539.5)
PICTURES = 8
RATE = 30.0  # frames a second, by their timestamps
FLAT_MB = 1.0


@dataclass
class Pictures:
    """The same pictures forth and back, again and again: an approach that swings."""

    pictures: list[NDArray[np.uint8]]
    frames: int
    live: bool = False

    def __iter__(self) -> Iterator[TimedFrame]:
        turn = [*range(len(self.pictures)), *range(len(self.pictures) - 2, 0, -1)]
        for number in range(self.frames):
            yield TimedFrame(number, number / RATE, self.pictures[turn[number % len(turn)]])


def resident_mb() -> float:
    """Of this process, now."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:  # no Linux: the largest so far
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def verdict(frames: NDArray[np.int64], megabytes: NDArray[np.float64]) -> dict[str, Any]:
    """The rise over the frames after the first quarter, its standard deviation, and whether that is flat."""
    late = frames > frames[-1] / 4
    x, y = frames[late] - frames[late].mean(), megabytes[late]
    slope = float(x @ y / (x @ x))
    rest = y - y.mean() - slope * x
    sigma = float(np.sqrt(rest @ rest / max(len(y) - 2, 1) / (x @ x)))
    span = float(np.ptp(frames[late]))
    rise, doubt = slope * span, 2 * sigma * span
    return {"rise_mb": rise, "two_sigma_mb": doubt, "over_frames": int(span), "flat": rise < max(doubt, FLAT_MB)}


def measure(frames: int, every: int, copies: int, out: Path, *, video: bool = False) -> dict[str, Any]:
    """Fly, and read the memory at each `every`th frame."""
    scene = demo_scene()
    poses = [approach_pose(40 + k) for k in range(PICTURES)]
    pictures = [render(scene, CAMERA, pose, Sensor(0.5, 2.0, 92), samples=1, seed=k) for k, pose in enumerate(poses)]
    corners = sf.project(CAMERA, poses[0], RUNWAY.corners)
    pipeline = sf.LandingPipeline(sf.KeypointDetector(), RUNWAY, CAMERA, tracker=sf.Tracker())
    sinks: list[Sink] = [Log(out, flight_record("pictures", pipeline, {}, None, BUDGET_MS), copies)]
    if video:
        sinks.append(AnnotatedVideo(out / "flight.mp4", CAMERA, RUNWAY, RATE))
    at: list[int] = []
    megabytes: list[float] = []

    def seen(frame: int, result: sf.FrameResult) -> None:
        if frame % every == every - 1:
            at.append(frame + 1)
            megabytes.append(resident_mb())
            print(f"frame {at[-1]:6d}: {megabytes[-1]:7.1f} MB, {result.verdict.decision.value}", flush=True)

    start = time.perf_counter()
    box = [*corners.min(axis=0), *corners.max(axis=0)]
    flown = fly(Pictures(pictures, frames), pipeline, sinks, box=box, progress=seen)
    seconds = time.perf_counter() - start
    found = verdict(np.array(at), np.array(megabytes))
    return {**found, "frames": at, "mb": megabytes, "seconds": seconds, "decisions": flown.decisions,
            "states": flown.states, "stages": flown.stages, "notes": flown.notes}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--every", type=int, default=1_000)
    parser.add_argument("--copies", type=int, default=30)
    parser.add_argument("--video", action="store_true", help="an annotated video, too")
    parser.add_argument("--out", type=Path, help="folder for the results; a temporary one if not given")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = measure(options.frames, options.every, options.copies, options.out or Path(folder), video=options.video)
    print(json.dumps({k: found[k] for k in ("decisions", "states", "stages", "notes", "seconds")}))
    words = "flat" if found["flat"] else "NOT flat"
    print(f"{words}: {found['rise_mb']:+.2f} ± {found['two_sigma_mb']:.2f} MB (2 sigma) over the last "
          f"{found['over_frames']} frames")  # fmt: skip


if __name__ == "__main__":
    main()
