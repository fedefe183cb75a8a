"""Pictures from files and bytes."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from shortfinal.errors import InputError

Image = NDArray[np.uint8]


def decode_image(content: bytes, name: str) -> Image:
    """An encoded picture as RGB (h, w, 3) uint8, as stored: labels are in stored pixels, so EXIF does not turn it.

    Raises InputError with the name.
    """
    # libjpeg fills what is missing with grey. Some cameras pad behind the end marker.
    if content.startswith(b"\xff\xd8") and b"\xff\xd9" not in content.rstrip(b"\0")[-64:]:
        raise InputError(f"{name}: truncated JPEG")
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:  # of an empty file, or one that claims too large a picture
        image = None
    if image is None:
        raise InputError(f"{name}: cannot be read as an image")
    return np.ascontiguousarray(image[..., ::-1])


def read_image(path: str | Path) -> Image:
    """An image file, as `decode_image` gives it. Raises InputError if it is missing, no image, or cut off."""
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such image")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read as an image: {error.strerror}") from error
    return decode_image(content, str(path))
