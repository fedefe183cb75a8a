"""A flight: frames in, results out, on time; what is late is counted, what fails is said, and the flight goes on."""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shortfinal.errors import InputError, JobError
from shortfinal.geometry import Pose, project
from shortfinal.keypoints import GaussianKeypoints
from shortfinal.pipeline import FrameResult, LandingPipeline
from shortfinal.protection import AlertLimits
from shortfinal.search import Search
from shortfinal.stream.frames import FrameSource, Mailbox, TimedFrame
from shortfinal.stream.sink import Image, Lasting, Log, Prompt, Sink
from shortfinal.tracker import Tracker

WATCHDOG_S = 0.2  # without a frame, after which the flight is told so
BUDGET_MS = 33.0  # from a frame's coming to its result's going out
QUEUE = 8  # pictures that wait to be written
BACKLOG = 3000  # results that do: when a disk hangs, these are 100 s at 30 frames/s
_GAPS = 20  # gaps between frames that are noted one by one


class Stages:
    """How long each stage took, of every frame: counted in bins 2 % wide, so that an hour takes no more room than a
    second, and a percentile is good to 1 %.
    """

    _FIRST_MS, _RATIO, _BINS = 1e-3, 1.02, 1100  # up to 48 minutes

    def __init__(self) -> None:
        self._counts: dict[str, NDArray[np.int64]] = {}

    def add(self, timings: dict[str, float]) -> None:
        """Those of one frame, ms."""
        for stage, ms in timings.items():
            place = math.log(max(ms, self._FIRST_MS) / self._FIRST_MS) / math.log(self._RATIO)
            counts = self._counts.setdefault(stage, np.zeros(self._BINS, np.int64))
            counts[min(int(place), self._BINS - 1)] += 1

    def summary(self) -> dict[str, dict[str, float]]:
        """p50, p95 and p99 of each stage, ms."""
        return {
            stage: {f"p{q}": round(self._percentile(counts, q), 3) for q in (50, 95, 99)}
            for stage, counts in self._counts.items()
        }

    def _percentile(self, counts: NDArray[np.int64], q: float) -> float:
        """The middle of the bin that holds the smallest time which q % do not exceed."""
        up_to = np.cumsum(counts)
        place = int(np.searchsorted(up_to, up_to[-1] * q / 100))
        return self._FIRST_MS * float(self._RATIO ** (place + 0.5))


class Writer:
    """Results to the sinks in a thread of its own: what is slow there does not hold up the flight.

    Sinks that are `Prompt` are written at once instead, by whoever gives the result. Of the others' pictures at
    most QUEUE wait. If the flight is `patient` it waits for them; else a picture that finds no room is dropped and
    counted, and its result goes without. A sink that fails is left out, and noted.
    """

    def __init__(self, sinks: Sequence[Sink], *, patient: bool) -> None:
        self.notes: list[str] = []
        self.stages = Stages()
        self.pictures_dropped = self.results_dropped = 0
        self._patient, self._ended = patient, False
        self._prompt: list[Sink] = [sink for sink in sinks if isinstance(sink, Prompt) and sink.prompt]
        self._slow = [sink for sink in sinks if sink not in self._prompt]
        self._losses: dict[int, tuple[int, int]] = {}  # of a lasting sink: the first and the last frame
        self._waiting: deque[tuple[int, FrameResult, Image | None]] = deque()
        self._pictures = 0  # of those that wait
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="sinks", daemon=True)
        self._thread.start()

    def give(self, frame: int, result: FrameResult, image: Image | None) -> float:
        """One frame's result. Returns how long those took that are written at once, ms."""
        start = time.perf_counter()
        self._write(self._prompt, frame, result, image)
        sent_ms = 1e3 * (time.perf_counter() - start)
        with self._changed:
            if self._patient:
                self._changed.wait_for(lambda: len(self._waiting) < QUEUE)
            elif len(self._waiting) >= BACKLOG:
                self.results_dropped += 1
                return sent_ms
            elif image is not None and self._pictures >= QUEUE:
                self.pictures_dropped += 1
                image = None
            self._waiting.append((frame, result, image))
            self._pictures += image is not None
            self._changed.notify_all()
        return sent_ms

    def drain(self) -> None:
        """Write what waits, close the sinks but the log, and say what they lost."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._thread.join()
        for sink in (*self._prompt, *self._slow):
            if isinstance(sink, Lasting) and sink.errors:
                first, last = self._losses.get(id(sink), (-1, -1))
                name = type(sink).__name__
                self.notes.append(f"{name}: {sink.errors} lost, frames {first} to {last}: {sink.note}")
            if not isinstance(sink, Log):
                self._close(sink)
        if self.results_dropped:
            self.notes.append(f"{self.results_dropped} results not written: the sinks were {BACKLOG} behind")

    def finish(self, record: dict[str, Any]) -> None:
        """Close the log with what has become of the flight."""
        for sink in self._slow:
            if isinstance(sink, Log):
                sink.flight |= record
                self._close(sink)

    def _work(self) -> None:
        if sys.platform == "linux":  # there a thread has a priority of its own: pictures must not hold up frames
            with suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._ended)
                if not self._waiting:
                    return
                frame, result, image = self._waiting.popleft()
                self._pictures -= image is not None
                self._changed.notify_all()
            start = time.perf_counter()
            self._write(self._slow, frame, result, image)
            self.stages.add({"write_ms": 1e3 * (time.perf_counter() - start)})

    def _write(self, sinks: list[Sink], frame: int, result: FrameResult, image: Image | None) -> None:
        for sink in list(sinks):
            before = sink.errors if isinstance(sink, Lasting) else 0
            try:
                sink.write(frame, result, image)
            except Exception as error:  # whatever it is, the flight goes on
                self.notes.append(f"frame {frame}: {_words(error)}; left out from here on")
                sinks.remove(sink)
                self._close(sink)
            if isinstance(sink, Lasting) and sink.errors > before:
                self._losses[id(sink)] = (self._losses.get(id(sink), (frame, frame))[0], frame)

    def _close(self, sink: Sink) -> None:
        try:
            sink.close()
        except Exception as error:
            self.notes.append(f"{type(sink).__name__}: {_words(error)}")


def _words(error: Exception) -> str:
    return str(error) if isinstance(error, (InputError, JobError)) else f"{type(error).__name__}: {error}"


@dataclass(frozen=True)
class Flown:
    """What came of a flight."""

    frames: int
    decisions: dict[str, int]
    states: dict[str, int]  # of the track
    dropped: int  # frames that a newer one overtook
    misses: int  # results later than the budget
    pictures_dropped: int  # that the sinks were too slow for
    warm_up_s: float  # before the first frame
    stages: dict[str, dict[str, float]]
    notes: tuple[str, ...]  # what failed on the way


@dataclass
class _Count:
    """What a flight counts."""

    frames: int = 0
    misses: int = 0
    gaps: int = 0  # for which the watchdog barked
    decisions: dict[str, int] = field(default_factory=dict)
    states: dict[str, int] = field(default_factory=dict)

    def add(self, result: FrameResult) -> None:
        decision = result.verdict.decision.value
        self.decisions[decision] = self.decisions.get(decision, 0) + 1
        if result.track is not None:
            state = result.track.state.value
            self.states[state] = self.states.get(state, 0) + 1


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
    newest frame is taken (default: if it is live), and the flight does not wait for the sinks: pictures that they
    are too slow for are dropped, results are not. A sink that fails is left out and noted. Without a frame for
    `watchdog_s` a live flight gets a result that says so, and its track coasts. A frame that cannot be processed is
    a verdict of NOT_MONITORED. Before the first frame all code is run once.

    Raises what the source raises, when all results are written; InputError if the first frame is not of the
    camera's size.
    """
    latest = source.live if newest is None else newest
    warm_up_s = warm_up(pipeline)
    writer, mailbox = Writer(sinks, patient=not latest), Mailbox(source, newest=latest)
    stages, count = Stages(), _Count()
    last = TimedFrame(-1, 0.0, np.zeros((1, 1, 3), np.uint8))
    heard, silent = time.monotonic(), False

    def give(number: int, result: FrameResult, image: Image | None) -> float:
        count.add(result)
        sent_ms = writer.give(number, result, image)
        progress(number, result)
        return sent_ms

    try:
        while True:
            frame = mailbox.take(watchdog_s if source.live else None)
            if frame is None and mailbox.ended:
                break
            quiet_s = time.monotonic() - heard
            if frame is None:
                silent = True
                give(last.number, pipeline.coast(last.timestamp_s + quiet_s, f"no frame for {quiet_s:.1f} s"), None)
                continue
            if silent:
                silent, count.gaps = False, count.gaps + 1
                if count.gaps <= _GAPS:
                    writer.notes.append(f"frame {frame.number}: the first after {quiet_s:.1f} s without any")
            waited_ms, start = mailbox.waited_ms if latest else 0.0, time.perf_counter()
            image: Image | None = frame.image
            try:
                result = pipeline.step(frame.image, frame.timestamp_s, box=box if count.frames == 0 else None)
            except InputError as error:  # of another size, or without a time
                if count.frames == 0:  # it is the camera's file that is wrong
                    raise
                result, image = pipeline.coast(frame.timestamp_s, str(error)), None
            step_ms = 1e3 * (time.perf_counter() - start)
            total_ms = waited_ms + step_ms + give(frame.number, result, image)
            stages.add({**result.timings, "step_ms": step_ms, "total_ms": total_ms})
            count.misses += total_ms > budget_ms
            count.frames, last, heard = count.frames + 1, frame, time.monotonic()
    finally:
        mailbox.close()
        writer.drain()
        if count.gaps > _GAPS:
            writer.notes.append(f"{count.gaps - _GAPS} more gaps between frames")
        summary = stages.summary() | writer.stages.summary()
        writer.finish({
            "stages": summary, "dropped": mailbox.dropped, "misses": count.misses,
            "pictures_dropped": writer.pictures_dropped, "warm_up_s": warm_up_s, "notes": writer.notes,
        })  # fmt: skip
    return Flown(
        count.frames, count.decisions, count.states, mailbox.dropped, count.misses, writer.pictures_dropped, warm_up_s,
        summary, tuple(writer.notes),
    )  # fmt: skip


def warm_up(pipeline: LandingPipeline) -> float:
    """Run what a flight runs once, on a picture of noise and on a runway that is seen, so that no frame pays for what
    is compiled, loaded or allocated at first use. The pipeline itself stays as it is. Returns the seconds it took.
    """
    start = time.perf_counter()
    camera, detector = pipeline.camera, pipeline.detector
    tracker = None if pipeline.tracker is None else Tracker()
    other = LandingPipeline(detector, pipeline.runway, camera, further_points=pipeline.points[4:], tracker=tracker)
    with suppress(InputError):  # a camera that cannot see it from there
        pose = Pose.from_attitude([-1500.0, 0.0, 80.0], pitch_deg=-3.0)
        keypoints = GaussianKeypoints.from_sigma(project(camera, pose, other.points), 0.5)
        for frame in range(10):  # enough for a track
            estimate, verdict, _ = other.judge(keypoints, points=other.points)
            if other.tracker is not None:
                other.tracker.update(frame / 30, estimate, verdict)
    noise = np.random.default_rng(0).integers(0, 256, (camera.height, camera.width, 3), np.uint8)
    size = np.array([camera.width, camera.height])
    middle = np.concatenate([0.4 * size, 0.6 * size])
    for box in (None, middle):
        other.step(noise, 1.0, box=box)
    with suppress(InputError):  # a network that cannot search, or makes nothing of noise
        Search(camera.width, camera.height, detector.info.size).look(detector, noise)
    with suppress(InputError):  # or look at corners
        detector.sharpened(noise, GaussianKeypoints.from_sigma(middle[[[0, 3], [2, 3], [2, 1], [0, 1]]], 1.0))
    return time.perf_counter() - start


def flight_record(
    source: str, pipeline: LandingPipeline, model: dict[str, str], limits: AlertLimits | None, budget_ms: float
) -> dict[str, Any]:
    """The content of flight.json before a flight (docs/view.md)."""
    bounds = None if limits is None else {k: v if math.isfinite(v) else None for k, v in asdict(limits).items()}
    return {
        "format": 1, "source": source, "camera": asdict(pipeline.camera),
        "runway": {
            "ident": pipeline.runway.ident, "length_m": pipeline.runway.length_m, "width_m": pipeline.runway.width_m,
            "corners_m": pipeline.runway.corners.tolist(), "survey_sigma_m": pipeline.runway.survey_sigma_m,
        },
        "model": model,
        "settings": {
            "false_alarm_rate": pipeline.false_alarm_rate, "integrity_risk": pipeline.integrity_risk,
            "fault_prior": pipeline.fault_prior,
        },
        "alert_limits": bounds, "stages": None, "dropped": 0, "budget_ms": budget_ms, "misses": 0,
        "pictures_dropped": 0, "warm_up_s": None, "notes": [],
    }  # fmt: skip
