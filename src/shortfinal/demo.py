"""The main job on an embedded approach: a rendered flight, the shipped model, two faults on the way."""

from __future__ import annotations

import io
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shortfinal.detector import KeypointDetector
from shortfinal.files import make_folder, write_png, write_whole
from shortfinal.geometry import Camera, PixelWindow, Pose, project
from shortfinal.integrity import Decision
from shortfinal.keypoints import GaussianKeypoints
from shortfinal.pipeline import FrameResult, LandingPipeline
from shortfinal.pose import PoseEstimate
from shortfinal.runway import Runway
from shortfinal.scene.render import Scene, random_scene, render, seen_from
from shortfinal.scene.sensor import Sensor, expose
from shortfinal.stream.overlay import Notes, contact_sheet, draw_result
from shortfinal.stream.sink import JsonlWriter, VideoWriter

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

CAMERA = Camera(960, 720, 2000.0, 2000.0, 479.5, 359.5)
RUNWAY = Runway(1500.0, 45.0, "DEMO/09")
FRAMES = 100
SPEED_M_S = 70.0
START_M, END_M = 3000.0, 140.0  # distance to the threshold
GLIDE_DEG, AIM_M = 3.0, 305.0
SHORT_M = 184.0  # by how much the paper misplaces the far threshold
_TAXIWAY_EDGE_M = (-1.0, -52.0, 0.0)  # where the scene's taxiway meets the threshold's line
_SEED = 54
# A drawn picture also serves the frames before it that are at most so much farther from the aiming point; pixels
# beside the frame and below it, for these: from farther out more of the ground before the camera is seen.
_FARTHER, _BESIDE, _BELOW = 0.06, 204, 188


class Fault(Enum):
    """What is done to the keypoints on the way."""

    NONE = ""
    FAR_THRESHOLD = "injected: far threshold 184 m short"
    NEAR_CORNER = "injected: near-right corner slid onto the taxiway's edge"


def fault_at(frame: int) -> Fault:
    """The fault of a frame: the far threshold early on, where one frame can't show it; then a corner."""
    if 20 <= frame < 34:
        return Fault.FAR_THRESHOLD
    return Fault.NEAR_CORNER if 46 <= frame < 56 else Fault.NONE


@dataclass(frozen=True, eq=False)
class Flown:
    """A frame of the demo, as flown and as judged."""

    number: int
    fault: Fault
    truth: Pose
    result: FrameResult
    sound: PoseEstimate | None  # from the same frame's keypoints without the fault

    @property
    def error_m(self) -> Array | None:
        """Estimated minus true position (3,), m; None without an estimate."""
        estimate = self.result.estimate
        return None if estimate is None or estimate.pose is None else estimate.pose.position_m - self.truth.position_m

    @property
    def moved_m(self) -> Array | None:
        """What the fault did to the position (3,), m: with it minus without it."""
        estimate = self.result.estimate
        if estimate is None or estimate.pose is None or self.sound is None or self.sound.pose is None:
            return None
        return estimate.pose.position_m - self.sound.pose.position_m


def approach_pose(frame: int) -> Pose:
    """Down the glide path with a little wander, as a hand-flown aircraft."""
    t = frame / (FRAMES - 1)
    x = -START_M + (START_M - END_M) * t
    z = (AIM_M - x) * np.tan(np.radians(GLIDE_DEG))
    sway = np.sin(2 * np.pi * (1.7 * t + 0.1)) * (1 - 0.7 * t)
    heave = np.sin(2 * np.pi * (2.3 * t + 0.4)) * (1 - 0.8 * t)
    roll = 4.0 * np.sin(2 * np.pi * (1.7 * t + 0.3)) * (1 - 0.5 * t)
    return Pose.from_attitude([x, 14 * sway, z + 4 * heave], 1.5 * sway, -4.0 + 0.8 * heave, roll)


def demo_scene() -> Scene:
    """The embedded airfield: a seeded scene, its runway of weathered asphalt, a taxiway at the threshold."""
    scene = random_scene(np.random.default_rng(_SEED), RUNWAY)
    surface, grey = np.array([0.40, 0.40, 0.41]), np.array([0.47, 0.47, 0.46])
    strips = np.zeros_like(scene.airfield.strips)
    strips[0] = [8.0, 0.0, 8.0, -150.0, 9.0, *grey, 1.0]
    strips[1] = [-60.0, -150.0, RUNWAY.length_m + 60, -150.0, 11.0, *grey, 1.0]
    pad = np.array([[60.0, *(0.9 * surface), 2.0, 0.0, 1.0]] * 2)
    airfield = scene.airfield._replace(surface=surface, shoulder=0.9 * surface, wear=0.15, strips=strips, pad=pad)
    return scene._replace(airfield=airfield)


def render_frame(scene: Scene, frame: int) -> Image:
    """The picture (720, 960, 3) of one frame."""
    return render(scene, CAMERA, approach_pose(frame), Sensor(0.5, 2.0, 92), samples=3, seed=frame)


def _blocks() -> list[range]:
    """The frames, those together that one drawn picture serves."""
    way = [AIM_M - float(approach_pose(n).position_m[0]) for n in range(FRAMES)]
    first, blocks = 0, list[range]()
    for n in range(1, FRAMES + 1):
        if n == FRAMES or way[first] > (1 + _FARTHER) * way[n]:
            blocks.append(range(first, n))
            first = n
    return blocks


def _render_ahead(scene: Scene, frames: range) -> list[Image]:
    """The pictures of a block of frames: the last one drawn, the others what is seen of it from farther out."""
    last = frames[-1]
    width, height = CAMERA.width + 2 * _BESIDE, CAMERA.height + _BELOW
    wide = CAMERA.view(PixelWindow(-_BESIDE, 0, width, height, width, height))
    drawn = render(scene, wide, approach_pose(last), samples=3)
    sensor = Sensor(0.5, 2.0, 92)
    return [
        expose(
            seen_from(drawn, wide, approach_pose(last), CAMERA, approach_pose(n)).astype(np.float32),
            sensor, np.random.default_rng(n),
        )
        for n in frames
    ]  # fmt: skip


def inject(fault: Fault, truth: Pose) -> Callable[[GaussianKeypoints], GaussianKeypoints]:
    """What the fault does to the keypoints: the means move to where the wrong thing is seen."""
    if fault is Fault.NONE:
        return lambda keypoints: keypoints
    wrong = RUNWAY.corners.copy()
    if fault is Fault.FAR_THRESHOLD:
        wrong[2:, 0] -= SHORT_M
    else:
        wrong[1] = _TAXIWAY_EDGE_M
    shift = project(CAMERA, truth, wrong) - project(CAMERA, truth, RUNWAY.corners)
    return lambda keypoints: GaussianKeypoints(keypoints.mean_px + shift, keypoints.cov_px)


def _with_fault(pipeline: LandingPipeline, sound: FrameResult, fault: Fault, truth: Pose) -> FrameResult:
    """The frame as it would have been judged with the fault."""
    if fault is Fault.NONE or sound.keypoints is None or sound.estimate is None:
        return sound
    keypoints = inject(fault, truth)(sound.keypoints)
    estimate, verdict, protection = pipeline.judge(keypoints)
    return replace(sound, keypoints=keypoints, estimate=estimate, verdict=verdict, protection=protection)


def fly(detector: KeypointDetector) -> Iterator[tuple[Flown, Image]]:
    """The approach, frame after frame, with the picture; rendering runs ahead in other threads.

    The crop comes from a prior pose as GNSS and INS would give it: the true one, off by some metres
    and tenths of a degree.
    """
    scene, rng = demo_scene(), np.random.default_rng(5)
    pipeline = LandingPipeline(detector, RUNWAY, CAMERA)
    with ThreadPoolExecutor() as pool:
        ahead = deque((frames, pool.submit(_render_ahead, scene, frames)) for frames in _blocks())
        for number, image in _in_turn(ahead):
            truth, fault = approach_pose(number), fault_at(number)
            prior = truth.plus(rng.normal(0, [8, 4, 4, 0.003, 0.003, 0.003]))
            timestamp = number / (FRAMES - 1) * (START_M - END_M) / SPEED_M_S
            sound = pipeline.step(image, timestamp, prior=prior)
            result = _with_fault(pipeline, sound, fault, truth)
            yield Flown(number, fault, truth, result, sound.estimate), image


def _in_turn(ahead: deque[tuple[range, Future[list[Image]]]]) -> Iterator[tuple[int, Image]]:
    """Frame by frame, letting go of each block's pictures after it."""
    while ahead:
        frames, future = ahead.popleft()
        yield from zip(frames, future.result(), strict=True)


def run_demo(
    out: str | Path, seen: Callable[[Flown], None] | None = None, model: str | Path | None = None
) -> list[Flown]:
    """Fly, judge, and write approach.mp4, contact_sheet.png, timeline.png and frames.jsonl into `out`.

    `seen` is called with each frame. Raises InputError for a bad model or output folder.
    """
    folder = make_folder(out)
    detector = KeypointDetector(model)
    flown, pictures = [], []
    with VideoWriter(folder / "approach.mp4", fps=10) as video, JsonlWriter(folder / "frames.jsonl") as lines:
        for frame, image in fly(detector):
            notes = Notes(f"{RUNWAY.ident}   frame {frame.number:3d}   t = {frame.result.timestamp_s:4.1f} s",
                          frame.fault.value, frame.truth.position_m)  # fmt: skip
            picture = draw_result(image, frame.result, notes)
            video.write(picture)
            lines.write(_record(frame))
            if frame.number in _SHOWN:
                pictures.append(picture)
            flown.append(frame)
            if seen:
                seen(frame)
    write_png(folder / "contact_sheet.png", contact_sheet(pictures, columns=3, width=640))
    _draw_timeline(flown, folder / "timeline.png")
    return flown


_SHOWN = (0, 12, 22, 30, 40, 48, 53, 62, 72, 82, 92, 99)


def _record(frame: Flown) -> dict[str, object]:
    record: dict[str, object] = {"frame": frame.number, "fault": frame.fault.name, **frame.result.to_dict()}
    record["moved_by_fault_m"] = None if frame.moved_m is None else frame.moved_m.tolist()
    record["true_position_m"] = frame.truth.position_m.tolist()
    record["true_attitude_deg"] = list(frame.truth.attitude)
    return record


def _draw_timeline(flown: list[Flown], path: Path) -> None:
    """Position errors within their 2 sigma and protection levels, and the test's p-value, over the distance to go."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 8), dpi=110, layout="constrained")
    axes = figure.subplots(4, 1, sharex=True)
    distance = np.array([-f.truth.position_m[0] for f in flown])
    error = np.array([f.error_m if f.error_m is not None else np.full(3, np.nan) for f in flown])
    sigma, level = np.array([_sigma(f) for f in flown]), np.array([_level(f) for f in flown])
    for axis, (name, ax) in enumerate(zip(("along-track", "cross-track", "vertical"), axes[:3], strict=True)):
        ax.fill_between(
            distance, -2 * sigma[:, axis], 2 * sigma[:, axis], color="#4c9be8", alpha=0.3, lw=0, label="± 2σ"
        )
        for decision, colour in (
            (Decision.USE, "#1f9d4d"),
            (Decision.DO_NOT_USE, "#d93025"),
            (Decision.NOT_MONITORED, "#e8a020"),
        ):
            mine = np.array([f.result.verdict.decision is decision for f in flown])
            ax.plot(distance[mine], error[mine, axis], ".", color=colour, label=decision.value)
        for side in (-1, 1):
            ax.plot(distance, side * level[:, axis], "k--", lw=0.8, label="protection level" if side > 0 else None)
        ax.set_ylabel(f"{name} error (m)")
        ax.set_yscale("symlog", linthresh=(100, 10, 10)[axis])
        ax.axhline(0, color="k", lw=0.5)
    axes[0].legend(ncol=5, fontsize=8, loc="lower left")
    p = np.array([f.result.verdict.p_value if f.result.verdict.p_value is not None else np.nan for f in flown])
    axes[3].semilogy(distance, np.maximum(p, 1e-16), "k.-", lw=0.7)
    axes[3].axhline(1e-3, color="#d93025", ls="--", lw=1, label="false-alarm rate 10⁻³")
    axes[3].set_ylabel("p-value")
    axes[3].legend(fontsize=8, loc="lower left")
    axes[3].set_xlabel("distance to the threshold (m)")
    axes[3].invert_xaxis()
    for fault, colour in ((Fault.FAR_THRESHOLD, "#f4c95d"), (Fault.NEAR_CORNER, "#f28b82")):
        span = [d for d, f in zip(distance, flown, strict=True) if f.fault is fault]
        for ax in axes:
            ax.axvspan(min(span), max(span), color=colour, alpha=0.35, lw=0)
        axes[0].text(np.mean(span), 1.02, fault.value.removeprefix("injected: "), ha="center", va="bottom", fontsize=8,
                     transform=axes[0].get_xaxis_transform())  # fmt: skip
    picture = io.BytesIO()
    figure.savefig(picture, format="png")
    write_whole(path, picture.getvalue())


def _sigma(frame: Flown) -> Array:
    estimate = frame.result.estimate
    sigma = None if estimate is None else estimate.sigma_position_m
    return np.full(3, np.nan) if sigma is None else sigma


def _level(frame: Flown) -> Array:
    """Along, cross and vertical protection levels (3,), m; NaN where there is none to draw."""
    levels = np.full(3, np.inf) if frame.result.protection is None else np.array(frame.result.protection.levels[:3])
    return np.where(np.isfinite(levels), levels, np.nan)
