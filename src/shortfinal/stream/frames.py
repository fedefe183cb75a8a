"""Frames in the order of time: from a video, a camera, a network stream, a folder, or a pipe."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from shortfinal.data.image import read_image
from shortfinal.data.labelled import IMAGE_SUFFIXES
from shortfinal.errors import InputError, JobError
from shortfinal.geometry import Camera

Image = NDArray[np.uint8]

FPS = 30.0  # of a source that does not say
RETRY_S = 0.25  # between attempts to open a camera or stream again that is gone
SILENT_MS = 500  # after which a stream that sends nothing counts as gone: its connection may be dead
OPEN_MS = 3000  # a stream may take to open; it has to come to a whole picture


@dataclass(frozen=True, eq=False)
class TimedFrame:
    """A picture and when it was taken."""

    number: int  # in the source, from 0; frames that were dropped have theirs
    timestamp_s: float  # of a live source: when it came in, on the monotonic clock, from the start
    image: Image  # (h, w, 3) RGB; not written to again


class FrameSource(Protocol):
    """Frames in the order of time."""

    live: bool  # it does not wait: what is not taken in time is lost

    def __iter__(self) -> Iterator[TimedFrame]:
        """The frames; raises JobError when the source fails for good."""


def open_source(text: str, camera: Camera, fps: float | None = None) -> FrameSource:
    """A folder of images (by name), a video file, `camera:0`, a stream's address (rtsp://, http://), or `-`: raw RGB
    frames of the camera's size on standard input.

    `fps` times the frames of a folder, or of a video that does not say; 30 if not given. Raises InputError for a
    source that cannot be opened.
    """
    check_source(text)
    if fps is not None and not 0 < fps <= 1000:
        raise InputError(f"--fps: {fps:g}; expected a number of frames a second up to 1000")
    if text == "-":
        return PipeSource(sys.stdin.buffer, camera)
    if text.startswith("camera:") or "://" in text:
        return LiveSource(text)
    path = Path(text)
    return FolderSource(path, fps or FPS) if path.is_dir() else VideoSource(path, fps)


def check_source(text: str) -> None:
    """Raises InputError for a folder or video that is not there."""
    if text != "-" and not text.startswith("camera:") and "://" not in text and not Path(text).exists():
        raise InputError(f"{text}: no such folder or video; also camera:0, rtsp://..., or - for a pipe")


class FolderSource:
    """The images of a folder, sorted by name, at a steady rate."""

    live = False

    def __init__(self, folder: Path, fps: float) -> None:
        self.paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
        self.fps, self.count = fps, len(self.paths)
        if not self.paths:
            raise InputError(f"{folder}: no image in it; expected {', '.join(IMAGE_SUFFIXES)}")

    def __iter__(self) -> Iterator[TimedFrame]:
        for number, path in enumerate(self.paths):
            yield TimedFrame(number, number / self.fps, read_image(path))


class VideoSource:
    """A video file, by its own times."""

    live = False

    def __init__(self, path: Path, fps: float | None) -> None:
        self.path = path
        self._video = cv2.VideoCapture(str(path))
        if not self._video.isOpened():
            raise InputError(f"{path}: not a video that OpenCV can read")
        told = float(self._video.get(cv2.CAP_PROP_FPS))
        self._own_times = fps is None and 0 < told <= 1000
        self.fps = fps or (told if self._own_times else FPS)
        frames = int(self._video.get(cv2.CAP_PROP_FRAME_COUNT))
        self.count = frames if frames > 0 else None  # as the file says

    def __iter__(self) -> Iterator[TimedFrame]:
        number, before = 0, -1.0
        while True:
            good, picture = self._video.read()
            if not good:
                break
            at = float(self._video.get(cv2.CAP_PROP_POS_MSEC)) / 1e3 if self._own_times else number / self.fps
            if not at > before:  # some containers give no times
                at = before + 1 / self.fps if before >= 0 else 0.0
            yield TimedFrame(number, at, _rgb(picture))
            number, before = number + 1, at
        if number == 0:
            raise InputError(f"{self.path}: a video without a single readable frame")


class LiveSource:
    """A camera or a stream. One that is gone, or silent, is opened again until it is back; `stop` ends it."""

    live = True

    def __init__(self, text: str) -> None:
        self.text = text
        name = text.removeprefix("camera:")
        if text.startswith("camera:") and not name.isdecimal():
            raise InputError(f"{text}: expected the camera's number, e.g. camera:0")
        self._name: int | str = int(name) if text.startswith("camera:") else text
        self._stopped = threading.Event()
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # each attempt in vain would be reported on stderr
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
        self._video = self._open()
        if self._video is None:
            raise InputError(f"{text}: cannot be opened; is it there, and free?")

    def stop(self) -> None:
        """End it from another thread."""
        self._stopped.set()

    def _open(self) -> cv2.VideoCapture | None:
        if isinstance(self._name, int):
            video = cv2.VideoCapture(self._name)
        else:
            waits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, OPEN_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, SILENT_MS]
            # More than one thread would hold back a picture for each.
            video = cv2.VideoCapture(self._name, cv2.CAP_FFMPEG, [*waits, cv2.CAP_PROP_N_THREADS, 1])
        return video if video.isOpened() else None

    def __iter__(self) -> Iterator[TimedFrame]:
        start, number = time.monotonic(), 0
        while not self._stopped.is_set():
            good, picture = self._video.read() if self._video is not None else (False, None)
            if good and picture is not None:
                yield TimedFrame(number, time.monotonic() - start, _rgb(picture))
                number += 1
                continue
            self._video = None
            self._stopped.wait(RETRY_S)
            self._video = self._open()


class PipeSource:
    """Raw RGB frames, 8 bits, of the camera's size, one after the other."""

    live = True

    def __init__(self, pipe: BinaryIO, camera: Camera) -> None:
        self.pipe, self.shape = pipe, (camera.height, camera.width, 3)

    def __iter__(self) -> Iterator[TimedFrame]:
        start, number, size = time.monotonic(), 0, int(np.prod(self.shape))
        while len(content := self.pipe.read(size)) == size:
            yield TimedFrame(number, time.monotonic() - start, np.frombuffer(content, np.uint8).reshape(self.shape))
            number += 1
        if content:
            raise JobError(f"-: the last frame has {len(content)} of {size} bytes; is it RGB of the camera's size?")


def _rgb(picture: Any) -> Image:
    # By OpenCV, which lets other threads run: numpy would keep the interpreter from the pipeline for 10 ms.
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8)


class Mailbox:
    """Frames from a source read in a thread of its own; of a live one the newest is kept, and the others counted."""

    def __init__(self, source: FrameSource, *, newest: bool) -> None:
        self._source, self._newest = source, newest
        self._frame: TimedFrame | None = None
        self._error: BaseException | None = None
        self._ended = self._stopped = False
        self._came_s = self.waited_ms = 0.0  # when the frame came; how long the last one that was taken had lain here
        self._ready = threading.Condition()
        self.dropped = 0
        self._thread = threading.Thread(target=self._read, name="frames", daemon=True)
        self._thread.start()

    def take(self, timeout_s: float | None) -> TimedFrame | None:
        """The next frame, or None if none comes in time or the source has ended (`ended`); what it raised is raised."""
        with self._ready:
            self._ready.wait_for(lambda: self._frame is not None or self._ended, timeout_s)
            frame, self._frame = self._frame, None
            self.waited_ms = 1e3 * (time.monotonic() - self._came_s)
            self._ready.notify_all()
            if frame is None and self._error is not None:
                error, self._error = self._error, None
                raise error
            return frame

    @property
    def ended(self) -> bool:
        """Whether there will be no further frame."""
        with self._ready:
            return self._ended and self._frame is None and self._error is None

    def close(self) -> None:
        """Read no further."""
        with self._ready:
            self._stopped = True
            self._ready.notify_all()
        if isinstance(self._source, LiveSource):
            self._source.stop()

    def _read(self) -> None:
        try:
            for frame in self._source:
                with self._ready:
                    if not self._newest:
                        self._ready.wait_for(lambda: self._frame is None or self._stopped)
                    if self._stopped:
                        return
                    self.dropped += self._frame is not None
                    self._frame, self._came_s = frame, time.monotonic()
                    self._ready.notify_all()
        except BaseException as error:
            self._error = error
        finally:
            with self._ready:
                self._ended = True
                self._ready.notify_all()
