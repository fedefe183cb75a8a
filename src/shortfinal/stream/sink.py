"""Where results go: a flight's folder, its video, the live page; files that are renamed when whole."""

from __future__ import annotations

import json
import math
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

from shortfinal.errors import InputError, JobError
from shortfinal.files import make_folder, partial_of, write_whole
from shortfinal.geometry import Camera
from shortfinal.integrity import Decision
from shortfinal.pipeline import FrameResult
from shortfinal.protection import AlertLimits
from shortfinal.runway import Runway
from shortfinal.stream.overlay import Notes, draw_result

Image = NDArray[np.uint8]

_PICTURE_PX = 960  # longer side of the copies of frames


class Sink(Protocol):
    """Where results go."""

    def write(self, frame: int, result: FrameResult, image: Image | None = None) -> None:
        """One frame's result. Raises InputError or JobError if it cannot be written any more."""

    def close(self) -> None:
        """Finish."""


@runtime_checkable
class Lasting(Sink, Protocol):
    """A sink that outlasts its failures: it counts what it lost, says why, and goes on with the next frame."""

    errors: int  # what was lost: messages or frames
    note: str  # the last reason


@runtime_checkable
class Prompt(Lasting, Protocol):
    """A sink that never waits, and whose results must not: written first, in the flight's own thread."""

    prompt: bool


@dataclass
class Log:
    """What a flight's folder holds: flight.json, frames.jsonl (a line a frame, flushed), and copies of frames.

    Readable at any moment as far as it goes, also after a SIGKILL. A line that finds no room is taken back whole;
    the log goes on once there is room again.
    """

    folder: Path
    flight: dict[str, Any]
    every: int = 1  # of the frames a copy is kept of; 0: none
    errors: int = field(default=0, init=False)  # frames whose line or copy is missing
    note: str = field(default="", init=False)

    def __post_init__(self) -> None:
        make_folder(self.folder)
        if self.every:
            make_folder(self.folder / "frames")
        for old in (self.folder / "frames").glob("*.jpg"):
            old.unlink()
        write_whole(self.folder / "flight.json", json.dumps(self.flight, indent=1) + "\n")
        self._limits = limits_of(self.flight)
        self._size = 0  # of the whole lines, bytes
        try:
            self._lines = (self.folder / "frames.jsonl").open("wb", buffering=0)
        except OSError as error:
            raise InputError(f"{self.folder}/frames.jsonl: cannot be written: {error.strerror}") from error

    def write(self, frame: int, result: FrameResult, image: Image | None = None) -> None:
        """Append the line of a frame."""
        record = record_of(frame, result, self._limits)
        failure: OSError | ValueError | None = None
        if image is not None and self.every and frame % self.every == 0:
            try:
                record |= self._copied(f"frames/{frame:06d}.jpg", image)
            except OSError as error:
                failure = error
        try:
            self._append(json.dumps(record, allow_nan=False).encode() + b"\n")
        except (OSError, ValueError) as error:  # no room, or a number that is none
            failure = error
        if failure is not None:
            reason = failure.strerror if isinstance(failure, OSError) else None
            self.errors, self.note = self.errors + 1, f"{self.folder}: cannot be written: {reason or failure}"

    def close(self) -> None:
        """Write flight.json as it has become."""
        self._lines.close()
        write_whole(self.folder / "flight.json", json.dumps(self.flight, indent=1) + "\n")

    def _copied(self, name: str, image: Image) -> dict[str, Any]:
        content, scale = reduced_jpeg(image)
        partial = self.folder / f"{name}.partial"
        try:
            partial.write_bytes(content)
            partial.replace(self.folder / name)
        except OSError:
            with suppress(OSError):
                partial.unlink()
            raise
        return {"image": name, "image_scale": scale}

    def _append(self, line: bytes) -> None:
        rest = line
        try:
            while rest:  # what is cut off for want of room fails the second time
                rest = rest[self._lines.write(rest) :]
        except OSError:
            self._lines.seek(self._size)
            with suppress(OSError):
                self._lines.truncate()
            raise
        self._size += len(line)


class Live:
    """The replay page while the flight is on, at `url`."""

    def __init__(self, flight: dict[str, Any]) -> None:
        from shortfinal.view.live import LiveView

        self._view, self._limits = LiveView(flight), limits_of(flight)
        self.url = self._view.url

    def write(self, frame: int, result: FrameResult, image: Image | None = None) -> None:
        """Show a frame."""
        jpeg = None if image is None else reduced_jpeg(image)[0]
        self._view.write(record_of(frame, result, self._limits), jpeg)

    def close(self) -> None:
        """End it."""
        self._view.close()


def record_of(frame: int, result: FrameResult, limits: AlertLimits | None) -> dict[str, Any]:
    """A line of frames.jsonl. With alert limits, `available` says whether the frame may be used and all its levels
    are within them.
    """
    record = {"frame": frame, **result.to_dict()}
    if limits is not None:
        levels = result.protection if result.verdict.decision is Decision.USE else None
        record["available"] = levels is not None and levels.available(limits).available
    return record


def limits_of(flight: dict[str, Any]) -> AlertLimits | None:
    """The alert limits that flight.json names; None: it names none."""
    named = flight.get("alert_limits")
    return None if named is None else AlertLimits(**{k: math.inf if v is None else v for k, v in named.items()})


def reduced_jpeg(image: Image) -> tuple[bytes, float]:
    """A copy of a frame (h, w, 3; RGB) as JPEG, and its pixels over the frame's."""
    scale = min(1.0, _PICTURE_PX / max(image.shape[:2]))
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else image
    jpeg = cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), (cv2.IMWRITE_JPEG_QUALITY, 80))[1]
    return jpeg.tobytes(), scale


class _Partial:
    """A file that appears under its name only when the block ends without an error."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.partial = partial_of(self.path)
        if self.path.is_dir():
            raise InputError(f"{self.path}: cannot be written: Is a directory")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        try:
            self.close()
            if kind is None and self.partial.exists():
                self.partial.replace(self.path)
        except OSError as problem:
            raise self._refusal(problem) from problem
        finally:
            with suppress(OSError):
                self.partial.unlink(missing_ok=True)

    def close(self) -> None:
        """Flush what was written."""

    def _refusal(self, error: OSError) -> InputError:
        return InputError(f"{self.path}: cannot be written: {error.strerror}")


class JsonlWriter(_Partial):
    """One JSON object a line."""

    def __init__(self, path: str | Path) -> None:
        super().__init__(path)
        try:
            self._file = self.partial.open("w", encoding="utf-8")
        except OSError as error:
            raise self._refusal(error) from error

    def write(self, record: dict[str, Any]) -> None:
        """Append one record. NaN and infinity are no JSON, and an error."""
        line = json.dumps(record, allow_nan=False) + "\n"
        try:
            self._file.write(line)
        except OSError as error:
            raise self._refusal(error) from error

    def close(self) -> None:
        """Flush the lines."""
        self._file.close()


class VideoWriter(_Partial):
    """An MP4 of RGB pictures of one size, which must be even."""

    def __init__(self, path: str | Path, fps: float) -> None:
        super().__init__(path)
        self._fps, self._writer, self._written = fps, cv2.VideoWriter(), 0
        try:
            self.partial.open("wb").close()
        except OSError as error:
            raise self._refusal(error) from error

    def write(self, picture: Image) -> None:
        """Append one picture (h, w, 3) RGB."""
        if not self._writer.isOpened():
            size = (picture.shape[1], picture.shape[0])
            # MPEG-4: OpenCV's own builds come without H.264, and VP9 takes half a second a frame.
            if not self._writer.open(
                str(self.partial), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), self._fps, size
            ):
                raise JobError(f"{self.path}: this build of OpenCV cannot write MPEG-4 video there")
        self._writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
        self._written += 1

    def close(self) -> None:
        """Write the index. Raises JobError if the file lacks pictures: OpenCV does not say when a disk is full."""
        self._writer.release()
        if not self._written:
            self.partial.unlink(missing_ok=True)
        elif cv2.VideoCapture(str(self.partial)).get(cv2.CAP_PROP_FRAME_COUNT) != self._written:
            raise JobError(f"{self.path}: the video could not be written whole; is the disk full?")


class AnnotatedVideo:
    """A flight as an MP4: each frame with its result drawn over it, the verdict, the track's state, and the reasons.

    One picture a result at a steady `fps`. The file appears when it is closed: a kill loses it.
    """

    def __init__(self, path: str | Path, camera: Camera, runway: Runway, fps: float) -> None:
        """Raises InputError for a path that cannot be written."""
        self._video, self._finish = VideoWriter(path, fps), ExitStack()
        self._finish.enter_context(self._video)
        self._blank = np.zeros((camera.height, camera.width, 3), np.uint8)
        self._title = runway.ident
        self._frame = -1  # the last that was seen

    def write(self, frame: int, result: FrameResult, image: Image | None = None) -> None:
        """Append a frame. One whose picture was not kept is left out; where there was none, it is black."""
        if image is None and frame != self._frame:
            return
        self._frame = frame
        notes = Notes(f"{self._title}   frame {frame:3d}   t = {result.timestamp_s:4.1f} s".lstrip())
        self._video.write(draw_result(self._blank if image is None else image, result, notes))

    def close(self) -> None:
        """Finish the file."""
        self._finish.close()
