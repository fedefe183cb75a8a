"""A flight: frames in, results out, on time; what is late is counted, what fails is said, and the flight goes on."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from shortfinal.errors import InputError, JobError
from shortfinal.files import make_folder, write_whole
from shortfinal.pipeline import FrameResult, LandingPipeline
from shortfinal.protection import AlertLimits
from shortfinal.stream.frames import FrameSource, Mailbox, TimedFrame

Image = NDArray[np.uint8]

WATCHDOG_S = 0.2  # without a frame, after which the flight is told so
BUDGET_MS = 33.0  # from frame to result
_PICTURE_PX = 960  # longer side of the copies of frames


class Sink(Protocol):
    """Where results go."""

    def write(self, frame: int, result: FrameResult, image: Image | None = None) -> None:
        """One frame's result. Raises InputError or JobError if it cannot be written any more."""

    def close(self) -> None:
        """Finish."""


@dataclass
class Log:
    """What a flight's folder holds: flight.json, frames.jsonl (a line a frame, flushed), and copies of frames.

    Readable at any moment as far as it goes, also after a SIGKILL.
    """

    folder: Path
    flight: dict[str, Any]
    every: int = 1  # of the frames a copy is kept of; 0: none

    def __post_init__(self) -> None:
        make_folder(self.folder)
        if self.every:
            make_folder(self.folder / "frames")
        for old in (self.folder / "frames").glob("*.jpg"):
            old.unlink()
        write_whole(self.folder / "flight.json", json.dumps(self.flight, indent=1) + "\n")
        try:
            self._lines = (self.folder / "frames.jsonl").open("wb", buffering=0)
        except OSError as error:
            raise InputError(f"{self.folder}/frames.jsonl: cannot be written: {error.strerror}") from error

    def write(self, frame: int, result: FrameResult, image: Image | None = None) -> None:
        """Append the line of a frame."""
        record = {"frame": frame, **result.to_dict()}
        try:
            if image is not None and self.every and frame % self.every == 0:
                name = f"frames/{frame:06d}.jpg"
                content, scale = reduced_jpeg(image)
                partial = self.folder / f"{name}.partial"
                partial.write_bytes(content)
                partial.replace(self.folder / name)
                record |= {"image": name, "image_scale": scale}
            line = json.dumps(record, allow_nan=False).encode() + b"\n"
            if self._lines.write(line) != len(line):
                raise OSError(28, "no space left on the device")
        except OSError as error:
            raise JobError(f"{self.folder}: cannot be written: {error.strerror or error}") from error

    def close(self) -> None:
        """Write flight.json as it has become."""
        self._lines.close()
        write_whole(self.folder / "flight.json", json.dumps(self.flight, indent=1) + "\n")


def reduced_jpeg(image: Image) -> tuple[bytes, float]:
    """A copy of a frame (h, w, 3; RGB) as JPEG, and its pixels over the frame's."""
    scale = min(1.0, _PICTURE_PX / max(image.shape[:2]))
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else image
    return cv2.imencode(".jpg", small[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, 80))[1].tobytes(), scale


class Live:
    """The replay page while the flight is on, at `url`."""

    def __init__(self, flight: dict[str, Any]) -> None:
        from shortfinal.view.live import LiveView

        self._view = LiveView(flight)
        self.url = self._view.url

    def write(self, frame: int, result: FrameResult, image: Image | None = None) -> None:
        """Show a frame."""
        jpeg = None if image is None else reduced_jpeg(image)[0]
        self._view.write({"frame": frame, **result.to_dict()}, jpeg)

    def close(self) -> None:
        """End it."""
        self._view.close()


@dataclass
class Stages:
    """How long each stage took, of every frame."""

    times: dict[str, list[float]] = field(default_factory=dict)  # ms

    def add(self, timings: dict[str, float]) -> None:
        """Those of one frame."""
        for stage, ms in timings.items():
            self.times.setdefault(stage, []).append(ms)

    def summary(self) -> dict[str, dict[str, float]]:
        """p50, p95 and p99 of each stage, ms."""
        return {
            stage: {f"p{q}": round(float(np.percentile(ms, q)), 3) for q in (50, 95, 99)}
            for stage, ms in self.times.items()
        }


@dataclass(frozen=True)
class Flown:
    """What came of a flight."""

    frames: int
    decisions: dict[str, int]
    states: dict[str, int]  # of the track
    dropped: int  # frames that a newer one overtook
    misses: int  # results later than the budget
    stages: dict[str, dict[str, float]]
    notes: tuple[str, ...]  # what failed on the way


def fly(
    source: FrameSource,
    pipeline: LandingPipeline,
    sinks: Sequence[Sink],
    *,
    box: Sequence[float] | None = None,
    newest: bool | None = None,
    budget_ms: float = BUDGET_MS,
    watchdog_s: float = WATCHDOG_S,
    progress: Callable[[int, FrameResult], None] = lambda frame, result: None,
) -> Flown:
    """Every frame of a source through the pipeline, its results to the sinks.

    `box`: where the runway is in the first frame, if known. `newest`: of a source that does not wait, only the
    newest frame is taken (default: if it is live). A sink that fails is left out and noted. Without a frame for
    `watchdog_s` a live flight gets a result that says so, and its track coasts. A frame that cannot be processed is
    a verdict of NOT_MONITORED, but for the first one, of another size than the camera's, which is refused. Raises
    what the source raises.
    """
    mailbox = Mailbox(source, newest=source.live if newest is None else newest)
    open_sinks, stages, notes = list(sinks), Stages(), []
    decisions: dict[str, int] = {}
    states: dict[str, int] = {}
    frames = misses = 0
    last = TimedFrame(-1, 0.0, np.zeros((1, 1, 3), np.uint8))
    heard = time.monotonic()

    def give(number: int, result: FrameResult, image: Image | None) -> None:
        decisions[result.verdict.decision.value] = decisions.get(result.verdict.decision.value, 0) + 1
        if result.track is not None:
            states[result.track.state.value] = states.get(result.track.state.value, 0) + 1
        for sink in list(open_sinks):
            try:
                sink.write(number, result, image)
            except (InputError, JobError) as error:
                notes.append(f"frame {number}: {error}; left out from here on")
                open_sinks.remove(sink)
                with suppress(InputError, JobError, OSError):
                    sink.close()
        progress(number, result)

    try:
        while True:
            frame = mailbox.take(watchdog_s if source.live else None)
            if frame is None and mailbox.ended:
                break
            if frame is None:
                silent = time.monotonic() - heard
                give(last.number, pipeline.coast(last.timestamp_s + silent, f"no frame for {silent:.1f} s"), None)
                continue
            start = time.perf_counter()
            image: Image | None = frame.image
            try:
                result = pipeline.step(frame.image, frame.timestamp_s, box=box if frames == 0 else None)
            except InputError as error:
                if frames == 0:  # then it is the camera's file that is wrong
                    raise
                result, image = pipeline.coast(frame.timestamp_s, str(error)), None
            elapsed_ms = 1e3 * (time.perf_counter() - start)
            stages.add({**result.timings, "step_ms": elapsed_ms})
            give(frame.number, result, image)
            stages.add({"write_ms": 1e3 * (time.perf_counter() - start) - elapsed_ms})
            misses += elapsed_ms > budget_ms
            frames, last, heard = frames + 1, frame, time.monotonic()
    finally:
        mailbox.close()
        summary = stages.summary()
        for sink in open_sinks:
            if isinstance(sink, Log):
                sink.flight |= {"stages": summary, "dropped": mailbox.dropped, "misses": misses, "notes": notes}
            with suppress(OSError):
                sink.close()
    return Flown(frames, decisions, states, mailbox.dropped, misses, summary, tuple(notes))


def flight_record(
    source: str, pipeline: LandingPipeline, model: dict[str, str], limits: AlertLimits | None, budget_ms: float
) -> dict[str, Any]:
    """The content of flight.json before a flight (docs/view.md)."""
    bounds = None if limits is None else {k: v if math.isfinite(v) else None for k, v in asdict(limits).items()}
    return {
        "format": 1, "source": source, "camera": asdict(pipeline.camera),
        "runway": {
            "ident": pipeline.runway.ident, "length_m": pipeline.runway.length_m, "width_m": pipeline.runway.width_m,
            "corners_m": pipeline.runway.corners.tolist(),
        },
        "model": model,
        "settings": {
            "false_alarm_rate": pipeline.false_alarm_rate, "integrity_risk": pipeline.integrity_risk,
            "fault_prior": pipeline.fault_prior,
        },
        "alert_limits": bounds, "stages": None, "dropped": 0, "budget_ms": budget_ms, "misses": 0,
    }  # fmt: skip
