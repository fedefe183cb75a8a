"""A whole approach, unaided: 1920 x 1080 at 30 frames a second, from 5 km to 100 m before the threshold.

    python benchmarks/flight.py --frames FOLDER [--json]

What it shows: after how many frames the runway is found, the time of every stage, the frames dropped, and how far the
pose is off, filtered and not, with the share within 2 sigma and within the protection level, by distance.

The frames are a camera's: each comes when it is due, and what is not taken in time is lost. A frame every 2.5 % of the
way is rendered; those between are its image under the exact homography of the flat ground, each with noise and JPEG of
its own. They are made once, into FOLDER (some 12 minutes on two cores, 1.1 GB).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

import shortfinal as sf
from shortfinal.demo import RUNWAY, demo_scene
from shortfinal.integrity import Decision
from shortfinal.pipeline import FrameResult
from shortfinal.scene.render import render, seen_from
from shortfinal.stream.fly import BUDGET_MS, Flown, flight_record, fly
from shortfinal.stream.frames import TimedFrame, VideoSource
from shortfinal.stream.sink import Log, Sink
from shortfinal.tracker import Tracker

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

CAMERA = sf.Camera(1920, 1080, 1662.8, 1662.8, 959.5, 539.5)  # 60 degrees wide
START_M, END_M, AIM_M, SPEED_MPS, RATE_HZ, GLIDE_DEG = 5000.0, 100.0, 305.0, 70.0, 30.0, 3.0
COUNT = int((START_M - END_M) / SPEED_MPS * RATE_HZ) + 1
STEP = 0.025  # of the way to the aiming point, from one rendered frame to the next
NOISE = 2.0  # of the sensor, in levels of 255
BINS_M = (100, 300, 600, 1000, 1500, 2500, 3500, 5000)  # along track, before the threshold
AXES = ("along", "cross", "vertical")


def pose_at(frame: float) -> sf.Pose:
    """Down the glide path with a little wander, as a hand-flown aircraft."""
    t = frame / RATE_HZ
    x = -START_M + SPEED_MPS * t
    far = min(1.0, (AIM_M - x) / 3000)
    y = far * (20 * np.sin(0.21 * t + 0.5) + 3 * np.sin(0.9 * t))
    z = (AIM_M - x) * np.tan(np.radians(GLIDE_DEG)) + far * 8 * np.sin(0.17 * t)
    return sf.Pose.from_attitude(
        [x, y, z], 1.5 * np.sin(0.33 * t), -3.5 + 0.7 * np.sin(0.5 * t + 1), 3.0 * np.sin(0.41 * t + 2)
    )


def keys() -> list[int]:
    """The frames that are rendered."""
    way = [AIM_M - float(pose_at(frame).position_m[0]) for frame in range(COUNT)]
    chosen = [0]
    for frame in range(COUNT):
        if way[frame] < (1 - STEP) * way[chosen[-1]]:
            chosen.append(frame)
    return chosen


def make(folder: Path) -> Path:
    """The video of the approach, made if it is not there."""
    video = folder / "approach.avi"
    if video.exists():
        return video
    folder.mkdir(parents=True, exist_ok=True)
    scene, chosen = demo_scene(), keys()

    def rendered(frame: int) -> None:
        path = folder / f"{frame:05d}.png"
        if not path.exists():
            cv2.imwrite(str(path), render(scene, CAMERA, pose_at(frame), samples=3)[..., ::-1])

    with ThreadPoolExecutor() as pool:
        list(track(pool.map(rendered, chosen), "rendering", total=len(chosen)))
    partial = folder / "approach.partial.avi"
    writer = cv2.VideoWriter(
        str(partial), cv2.VideoWriter.fourcc(*"MJPG"), RATE_HZ, (CAMERA.width, CAMERA.height),
        [cv2.VIDEOWRITER_PROP_QUALITY, 92],
    )  # fmt: skip
    noise = np.random.default_rng(0).normal(0, NOISE, (8, CAMERA.height, CAMERA.width, 3)).round().astype(np.int8)
    key, picture = -1, np.empty(0, np.uint8)
    for frame in track(range(COUNT), "frames"):
        nearest = min(chosen, key=lambda n: abs(n - frame))
        if nearest != key:
            key, picture = nearest, cv2.imread(str(folder / f"{nearest:05d}.png"))
        moved = picture
        if frame != key:
            moved = seen_from(picture, CAMERA, pose_at(key), CAMERA, pose_at(frame))
        rng = np.random.default_rng(frame)  # another of the fields, elsewhere, turned round
        field_ = np.roll(noise[rng.integers(8)], tuple(rng.integers(0, 500, 2)), axis=(0, 1))[:: rng.choice([-1, 1])]
        writer.write(cv2.add(moved, field_, dtype=cv2.CV_8U))
    writer.release()
    partial.rename(video)
    return video


class Paced:
    """A video's frames when they are due, as a camera gives them."""

    live = True

    def __init__(self, video: VideoSource) -> None:
        self.video = video

    def __iter__(self) -> Iterator[TimedFrame]:
        start = time.monotonic()
        for frame in self.video:
            time.sleep(max(0.0, start + frame.timestamp_s - time.monotonic()))
            yield frame


@dataclass
class Kept:
    """A sink that keeps what there is to say of each frame."""

    results: list[tuple[int, FrameResult]] = field(default_factory=list)

    def write(self, frame: int, result: FrameResult, image: Image | None = None) -> None:
        """Keep it."""
        self.results.append((frame, result))

    def close(self) -> None:
        """Nothing to do."""


def rows_of(kept: Kept) -> list[dict[str, Any]]:
    """By distance: errors (m, root mean square), within 2 sigma, within the protection level; of frames that may be
    used, and of the track.
    """
    rows = []
    for low, high in pairwise(BINS_M):
        here = [
            (pose_at(frame), result)
            for frame, result in kept.results
            if low <= -pose_at(frame).position_m[0] < high and result.timings
        ]
        row: dict[str, Any] = {"from_m": low, "to_m": high, "frames": len(here)}
        alone = [(truth, r) for truth, r in here if r.verdict.decision is Decision.USE]
        row["use"] = len(alone) / max(len(here), 1)
        tracked = [(truth, r.track) for truth, r in here if r.track is not None and r.track.pose is not None]
        row["tracked"] = len(tracked) / max(len(here), 1)
        for axis, name in enumerate(AXES):
            error = np.array([r.estimate.pose.position_m[axis] - t.position_m[axis] for t, r in alone])
            sigma = np.array([np.sqrt(r.estimate.cov[axis, axis]) for _, r in alone])
            level = np.array([getattr(r.protection, f"{name}_m") if r.protection else np.nan for _, r in alone])
            filtered = np.array([k.pose.position_m[axis] - t.position_m[axis] for t, k in tracked])
            spread = np.array([np.sqrt(k.cov[axis, axis]) for _, k in tracked])
            row[name] = {
                "rms_m": _rms(error), "within_2_sigma": _share(np.abs(error) <= 2 * sigma),
                "within_level": _share(np.abs(error) <= level),
                "level_m": float(np.median(level)) if len(level) else None,
                "filtered_rms_m": _rms(filtered), "filtered_within_2_sigma": _share(np.abs(filtered) <= 2 * spread),
            }  # fmt: skip
        rows.append(row)
    return rows


def _rms(values: Array) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def _share(held: NDArray[np.bool_]) -> float | None:
    return float(held.mean()) if len(held) else None


def _cell(value: float | None, digits: str = ".2f") -> str:
    return "–" if value is None or not np.isfinite(value) else f"{value:{digits}}"


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=Path, required=True, help="folder of the frames, made if they are not there")
    parser.add_argument("--model", type=Path, help="model file; the one that ships by default")
    parser.add_argument("--integrity-risk", type=float, default=1e-3, help="of the protection levels")
    parser.add_argument("--out", type=Path, help="folder of the flight's record, for shortfinal view")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    video = make(options.frames)
    detector = sf.KeypointDetector(options.model, shares_cores=True)
    pipeline = sf.LandingPipeline(detector, RUNWAY, CAMERA, tracker=Tracker(), integrity_risk=options.integrity_risk)
    kept = Kept()
    sinks: list[Sink] = [kept]
    if options.out:
        model = {"name": "the model that ships", "sha256": pipeline.detector.sha256}
        sinks.append(Log(options.out, flight_record("approach.avi", pipeline, model, None, BUDGET_MS), every=3))
    flown = fly(Paced(VideoSource(video, None)), pipeline, sinks)
    found = next((n for n, (_, r) in enumerate(kept.results, 1) if r.verdict.decision is Decision.USE), None)
    tracking = next((n for n, (_, r) in enumerate(kept.results, 1) if r.track and r.track.pose is not None), None)
    rows = rows_of(kept)
    if options.json:
        print(
            json.dumps({"found_at_frame": found, "tracking_at_frame": tracking, "flown": _plain(flown), "rows": rows})
        )
        return
    console = Console(width=160)
    console.print(
        f"{flown.frames} frames, {flown.dropped} overtaken by newer ones; found at frame {found}, tracked from frame "
        f"{tracking}; {flown.decisions}; {flown.states}; {flown.misses} results later than 33 ms"
    )
    times = Table("stage", "p50 ms", "p95 ms", "p99 ms")
    for stage, ms in flown.stages.items():
        times.add_row(stage.removesuffix("_ms"), *(f"{ms[q]:.2f}" for q in ("p50", "p95", "p99")))
    console.print(times)
    table = Table(
        "distance m", "USE", "tracked", "axis", "rms m", "2 sigma", "level m", "within", "filtered m", "2 sigma"
    )
    for row in rows:
        for name in AXES:
            cells = row[name]
            table.add_row(
                f"{row['from_m']}-{row['to_m']}" if name == AXES[0] else "",
                _cell(row["use"]) if name == AXES[0] else "", _cell(row["tracked"]) if name == AXES[0] else "", name,
                _cell(cells["rms_m"]), _cell(cells["within_2_sigma"]), _cell(cells["level_m"], ".1f"),
                _cell(cells["within_level"], ".3f"), _cell(cells["filtered_rms_m"]),
                _cell(cells["filtered_within_2_sigma"]),
            )  # fmt: skip
    console.print(table)


def _plain(flown: Flown) -> dict[str, Any]:
    return {name: getattr(flown, name) for name in ("frames", "decisions", "states", "dropped", "misses", "stages")}


if __name__ == "__main__":
    main()
