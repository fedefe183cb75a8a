"""Labelled pictures in our conventions, whatever format they came from.

Frames, axes and the pixel centre: the table of conventions in docs/architecture.md.

Formats count pixels from two origins. Labelling tools (CVAT, Label Studio, Roboflow), YOLO and COCO's
own boxes count from the image's corner, where the first pixel's centre is (0.5, 0.5). COCO's own
keypoints are indices of pixels, so that the first pixel's centre is (0, 0), as it is here. The two
differ by half a pixel, and nothing in a file tells them apart. `corner_window` is the one place
where one becomes the other.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from shortfinal.data.lard import RunwayLabel
from shortfinal.errors import InputError
from shortfinal.geometry import Camera, PixelWindow, Pose, frozen
from shortfinal.keypoints import CORNER_NAMES
from shortfinal.runway import Runway

Array = NDArray[np.float64]
Flags = NDArray[np.int8]
Origin = Literal["corner", "centre"]

SPLITS = ("train", "val", "test")
LARGEST_PX = 100_000  # beyond it nothing is a pixel of any image
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")

_ALIASES = (
    {"nearleft", "leftnear", "bottomleft", "leftbottom", "bl", "nl"},
    {"nearright", "rightnear", "bottomright", "rightbottom", "br", "nr"},
    {"farright", "rightfar", "topright", "righttop", "tr", "fr"},
    {"farleft", "leftfar", "topleft", "lefttop", "tl", "fl"},
)
_SPLIT_WORDS = {
    "train": "train", "training": "train", "val": "val", "valid": "val", "validation": "val", "test": "test",
    "testing": "test",
}  # fmt: skip


@dataclass(frozen=True)
class Problem:
    """One thing wrong with a data set: where, what, and how to mend it."""

    kind: str  # one word or two, to count by
    file: str
    row: str  # "line 3", "annotation 17"; nothing where it is of the whole file
    field: str
    what: str
    mend: str
    picture: str = ""  # the name of the picture concerned
    serious: bool = True  # False: worth knowing, and no fault

    def __str__(self) -> str:
        field = "" if self.what.startswith(f"{self.field} is ") else self.field
        place = ": ".join(part for part in (self.file, self.row, field) if part)
        return f"{place}: {self.what}" + (f"; {self.mend}" if self.mend else "")


def refused(error: InputError, file: str | Path, row: str = "", picture: str = "") -> Problem:
    """The Problem that an InputError "file: row: field is 'x'; mend" tells of."""
    text = str(error)
    for place in (str(file), row):
        text = text.removeprefix(f"{place}: ") if place else text
    what, _, mend = text.partition("; ")
    named = re.match(r"(\w+) is ", what)
    return Problem("label", str(file), row, named[1] if named else "", what, mend, picture)


@dataclass(frozen=True, eq=False)
class Label:
    """One runway in one picture."""

    file: str  # where the label stands
    row: str  # "line 3", "annotation 17"
    names: tuple[str, ...]  # of the K keypoints: the four corners in keypoint order, further ones behind them
    keypoints_px: Array  # (K, 2) in an image of the picture's `size`; NaN where not labelled
    visible: Flags  # (K,) as in COCO: 0 not labelled, 1 labelled but hidden, 2 seen
    ident: str = ""  # airport and landing direction, "LFPO/24"; "": the file does not say
    scenario: str = ""  # the approach or scene it was taken in; "": the file does not say
    runway: Runway | None = None  # where the file gives its size
    camera: Camera | None = None  # of the picture's `size`
    pose: Pose | None = None  # recorded
    recorded: RunwayLabel | None = None  # the row as LARD has it

    @property
    def corners_px(self) -> Array | None:
        """Corners (4, 2) in keypoint order; None unless all four are labelled."""
        return self.keypoints_px[:4] if (self.visible[:4] > 0).all() else None

    @property
    def airport(self) -> str:
        """The part of `ident` before the slash."""
        return self.ident.partition("/")[0]


@dataclass(frozen=True, eq=False)
class Picture:
    """An image file and the labels made on it."""

    path: Path
    name: str  # as the data set has it
    split: str  # train, val or test; "": none
    size: tuple[int, int] | None  # width and height of the image the labels were made on; None: the file's own
    labels: tuple[Label, ...]
    resampled: bool = False  # the file may be a resized copy of that image

    def window(self, width: int, height: int) -> PixelWindow:
        """From pixels of the labels to those of the file, which is `width` x `height`."""
        return PixelWindow.resize(*(self.size or (width, height)), width, height)

    def wrong_size(self, width: int, height: int) -> bool:
        """Whether the file has another size than its labels say, with no reason to."""
        return self.size is not None and not self.resampled and self.size != (width, height)


@dataclass(frozen=True, eq=False)
class LabelledPictures:
    """A data set: its pictures, and what could not be read of it."""

    source: str
    format: str  # shortfinal, LARD, COCO or YOLO
    pictures: tuple[Picture, ...]
    refused: tuple[Problem, ...] = ()
    notes: tuple[str, ...] = ()  # what a reader should know


def corner_window(width: int, height: int, out_width: int, out_height: int) -> PixelWindow:
    """From our pixels to coordinates counted from the image's corner, the image `out_width` by `out_height`.

    With the image's own size these are pixels from the corner; with 1 by 1, shares of width and height.
    """
    return PixelWindow(-width / (2 * out_width), -height / (2 * out_height), width, height, out_width, out_height)


def corner_order(names: Sequence[str], corners: Sequence[str], where: str) -> list[int]:
    """Indices that bring keypoints into our order: the four corners, then the others as they stand.

    `corners` are the file's names for near-left, near-right, far-right, far-left; given none, they are
    known by their usual names (near_left, BL, bottom-left ...). Raises InputError if one is not there.
    """
    if corners and len(corners) != 4:
        raise InputError(f"--corners: {len(corners)} names; expected four, for {', '.join(CORNER_NAMES)}")
    order = [_only(names, {name}) for name in corners] or [_only(map(_plain, names), alias) for alias in _ALIASES]
    if None in order or len(set(order)) != 4:
        missing = [CORNER_NAMES[k] for k, index in enumerate(order) if index is None]
        lacks = f"none is the {missing[0]} corner" if missing else "two corners have the same name"
        raise InputError(
            f"{where}: keypoints {', '.join(names) or 'without names'}: {lacks}; "
            "name them with --corners, the names of near-left, near-right, far-right, far-left in this order"
        )
    first = [index for index in order if index is not None]
    return first + [k for k in range(len(names)) if k not in first]


def _only(names: Iterable[str], wanted: set[str]) -> int | None:
    """The index of the one name among those wanted; None if there is none or more than one."""
    found = [k for k, name in enumerate(names) if name in wanted]
    return found[0] if len(found) == 1 else None


def _plain(name: str) -> str:
    return re.sub(r"[^a-z]", "", name.lower())


def keypoint_names(names: Sequence[str], order: Sequence[int]) -> tuple[str, ...]:
    """Our names of keypoints brought into `order`: ours for the corners, the file's for the others."""
    return (*CORNER_NAMES, *(names[k] for k in order[4:]))


def make_keypoints(px: Array, visible: Flags, order: Sequence[int]) -> tuple[Array, Flags]:
    """Keypoints (K, 2) and flags (K,) in our order; what is not labelled becomes NaN."""
    px, visible = px[list(order)].copy(), visible[list(order)]
    px[visible == 0] = np.nan
    return frozen(px), visible


def split_named(*names: str) -> str:
    """The split that the first of these file or folder names speaks of; "" if none does."""
    for name in names:
        for word in re.split(r"[^a-z]+", Path(name).stem.lower()):
            if word in _SPLIT_WORDS:
                return _SPLIT_WORDS[word]
    return ""


def find_image(name: str, folders: Iterable[Path]) -> Path:
    """The image of that name, or of its last part, in the first folder that has it; else where it should be."""
    parts = dict.fromkeys((name, os.path.basename(name)))
    candidates = [os.path.join(folder, part) for folder in folders for part in parts]
    return Path(next((path for path in candidates if os.path.isfile(path)), candidates[0]))


def read_text(path: Path, what: str) -> str:
    """A text file, UTF-8. Raises InputError naming it."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"{path}: cannot read the {what}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file (UTF-8); save the {what} as text") from error
