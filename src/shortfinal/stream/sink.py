"""Results on disk. Every file is written beside its name and renamed when whole."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from shortfinal.errors import InputError, JobError
from shortfinal.files import partial_of

Image = NDArray[np.uint8]


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
        self._fps, self._writer = fps, cv2.VideoWriter()

    def write(self, picture: Image) -> None:
        """Append one picture (h, w, 3) RGB."""
        if not self._writer.isOpened():
            size = (picture.shape[1], picture.shape[0])
            # MPEG-4: OpenCV's own builds come without H.264, and VP9 takes half a second a frame.
            if not self._writer.open(
                str(self.partial), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), self._fps, size
            ):
                raise JobError(f"{self.path}: this build of OpenCV cannot write MPEG-4 video there")
        self._writer.write(np.ascontiguousarray(picture[..., ::-1]))

    def close(self) -> None:
        """Write the index."""
        self._writer.release()
