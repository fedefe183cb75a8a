"""Pictures of results: the frame with the runway outlined, a close look at the corners, the figures."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont

from shortfinal.detector import crop_image
from shortfinal.geometry import PixelWindow
from shortfinal.integrity import Decision
from shortfinal.keypoints import GaussianKeypoints
from shortfinal.pipeline import FrameResult

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Colour = tuple[int, int, int]

COLOURS: dict[Decision, Colour] = {
    Decision.USE: (64, 220, 110),
    Decision.DO_NOT_USE: (255, 72, 60),
    Decision.NOT_MONITORED: (255, 178, 44),
}
WORDS = {Decision.USE: "USE", Decision.DO_NOT_USE: "DO NOT USE", Decision.NOT_MONITORED: "NOT MONITORED"}

_VIEW, _PANEL, _GAP = (960, 720), 336, 8  # px
_PAPER: Colour = (16, 20, 27)
_INK: Colour = (232, 236, 242)
_DIM: Colour = (142, 152, 166)
_AMBER: Colour = (255, 196, 84)
_ELLIPSE: Colour = (255, 236, 110)
_TRUTH: Colour = (255, 80, 255)
_SHIFT = 4  # OpenCV draws at 1/16 px
_FARTHEST = 10**6  # of a coordinate that it is given


@dataclass(frozen=True)
class Notes:
    """What is written beside a picture, besides the result itself."""

    title: str
    fault: str = ""  # what was injected
    truth_m: Array | None = None  # (3,) true position, where it is known


def draw_result(frame: Image, result: FrameResult, notes: Notes) -> Image:
    """The frame (h, w, 3) with its result drawn over it, and a panel beside it: (720, 1304, 3) RGB."""
    height, width = frame.shape[:2]
    scale = min(_VIEW[0] / width, _VIEW[1] / height)
    size = (round(width * scale), round(height * scale))
    whole = PixelWindow.resize(width, height, *size)
    view = crop_image(frame, whole)
    draw_keypoints(view, result.keypoints, whole, COLOURS[result.verdict.decision])
    canvas = np.full((_VIEW[1], _VIEW[0] + _PANEL + _GAP, 3), _PAPER, np.uint8)
    top, left = (_VIEW[1] - size[1]) // 2, (_VIEW[0] - size[0]) // 2
    canvas[top : top + size[1], left : left + size[0]] = view
    if result.crop is not None:
        canvas[:_PANEL, -_PANEL:] = _seen(frame, result, result.crop, _PANEL)[0]
    return _draw_text(canvas, result, notes)


def draw_keypoints(
    view: Image, keypoints: GaussianKeypoints | None, window: PixelWindow, colour: Colour | None
) -> None:
    """Outline, if it has a colour, and 2-sigma ellipses, drawn in place into a view of the frame through `window`."""
    if keypoints is None:
        return
    if colour is not None:
        draw_outline(view, keypoints.mean_px, window, colour)
    for k, mean in enumerate(keypoints.mean_px):
        draw_outline(view, ellipse(mean, keypoints.block(k), 2.0), window, _ELLIPSE)


def draw_outline(view: Image, px: ArrayLike, window: PixelWindow, colour: Colour) -> None:
    """A closed line through points (n, 2) of the frame, drawn in place into a view of it through `window`."""
    fixed = np.clip(np.round(window.apply(px) * 2**_SHIFT), -_FARTHEST, _FARTHEST).astype(np.int32)
    cv2.polylines(view, [fixed.reshape(-1, 1, 2)], True, colour, 1, cv2.LINE_AA, _SHIFT)


def draw_truth(view: Image, truth_px: ArrayLike, window: PixelWindow) -> None:
    """Labelled corners (n, 2) of the frame as crosses, drawn in place into a view of it through `window`."""
    for u, v in np.clip(np.round(window.apply(truth_px)), -_FARTHEST, _FARTHEST).astype(int).tolist():
        cv2.drawMarker(view, (u, v), _TRUTH, cv2.MARKER_TILTED_CROSS, 9, 1, cv2.LINE_AA)


def ellipse(mean: ArrayLike, cov: ArrayLike, sigmas: float, points: int = 48) -> Array:
    """Outline (points, 2) of the set whose Mahalanobis distance from `mean` (2,) is `sigmas`."""
    angle = np.linspace(0, 2 * np.pi, points, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return np.asarray(np.asarray(mean, float) + sigmas * (np.linalg.cholesky(np.asarray(cov, float)) @ circle).T)


def draw_close_up(
    frame: Image, result: FrameResult, title: str, truth_px: Array | None = None, size: int = 336
) -> Image:
    """The crop the detector saw, magnified to (size, size, 3), framed in the verdict's colour.

    `truth_px` (4, 2): labelled corners, drawn as crosses.
    """
    tile = np.full((size, size, 3), _PAPER, np.uint8)
    if result.crop is not None:
        tile, window = _seen(frame, result, result.crop, size)
        if truth_px is not None:
            draw_truth(tile, truth_px, window)
    return framed(tile, title, COLOURS[result.verdict.decision])


def framed(tile: Image, title: str, colour: Colour) -> Image:
    """The tile (h, w, 3) with a frame and a line of text."""
    cv2.rectangle(tile, (0, 0), (tile.shape[1] - 1, tile.shape[0] - 1), colour, 3)
    return write_labelled(tile, title)


def contact_sheet(pictures: Sequence[Image], columns: int, width: int = 420) -> Image:
    """Pictures of one shape (h, w, 3) side by side, each `width` pixels wide."""
    height = round(pictures[0].shape[0] * width / pictures[0].shape[1])
    tiles = [np.asarray(cv2.resize(p, (width, height), interpolation=cv2.INTER_AREA), np.uint8) for p in pictures]
    blank = np.full_like(tiles[0], _PAPER)
    tiles += [blank] * (-len(tiles) % columns)
    return np.vstack([np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)])


def write_labelled(picture: Image, text: str, colour: Colour = _INK, size: int = 13) -> Image:
    """The picture with a line of text in its top left corner."""
    image = Pillow.fromarray(picture)
    draw = ImageDraw.Draw(image)
    draw.rectangle(draw.textbbox((6, 5), text, font=_font(size)), fill=_PAPER)
    draw.text((6, 5), text, fill=colour, font=_font(size))
    return np.asarray(image, np.uint8)


def _seen(frame: Image, result: FrameResult, crop: PixelWindow, size: int) -> tuple[Image, PixelWindow]:
    """The crop magnified, with the keypoints drawn, and its window."""
    window = PixelWindow(crop.left, crop.top, crop.width, crop.height, size, size)
    view = crop_image(frame, window)
    draw_keypoints(view, result.keypoints, window, COLOURS[result.verdict.decision])
    return view, window


def _draw_text(canvas: Image, result: FrameResult, notes: Notes) -> Image:
    image = Pillow.fromarray(canvas)
    draw = ImageDraw.Draw(image)
    colour = COLOURS[result.verdict.decision]
    x, y = _VIEW[0] + _GAP, _PANEL + 12
    draw.rectangle((x, y, x + _PANEL, y + 46), fill=colour)
    draw.text((x + 12, y + 9), WORDS[result.verdict.decision], fill=_PAPER, font=_font(22, bold=True))
    y += 56
    for line in textwrap.wrap("; ".join(result.verdict.reasons), 46)[:3]:
        draw.text((x, y), line, fill=_INK, font=_font(12))
        y += 17
    y = _PANEL + 132
    for name, value, error in _figures(result, notes):
        draw.text((x, y), name, fill=_DIM, font=_font(14))
        draw.text((x + 72, y), value, fill=_INK, font=_font(14, bold=True))
        draw.text((x + _PANEL - 4, y), error, fill=_DIM, font=_font(13), anchor="ra")
        y += 24
    if result.track is not None:
        draw.text((x, y + 6), f"track: {result.track.state.value}", fill=_INK, font=_font(14, bold=True))
        for line in textwrap.wrap(result.track.reason, 46)[:2]:
            y += 18
            draw.text((x, y + 6), line, fill=_DIM, font=_font(12))
        y += 22
    for line in textwrap.wrap(notes.fault, 42):
        draw.text((x, y + 6), line, fill=_AMBER, font=_font(13, bold=True))
        y += 19
    draw.text((x, _VIEW[1] - 24), notes.title, fill=_DIM, font=_font(13))
    return np.asarray(image, np.uint8)


def _figures(result: FrameResult, notes: Notes) -> list[tuple[str, str, str]]:
    """(name, value with its 2 sigma, true error) for the panel."""
    lines = []
    estimate = result.estimate
    sigma = None if estimate is None else estimate.sigma_position_m
    if estimate is not None and estimate.pose is not None and sigma is not None:
        position = estimate.pose.position_m
        named = (("distance", 0, -1.0), ("left", 1, 1.0), ("height", 2, 1.0))
        for name, axis, sign in named:
            value = f"{sign * position[axis]:.1f} ± {2 * sigma[axis]:.1f} m"
            error = "" if notes.truth_m is None else f"error {sign * (position[axis] - notes.truth_m[axis]):+.1f}"
            lines.append((name, value, error))
    if result.protection is not None:
        levels = result.protection
        each = " / ".join("none" if level == math.inf else f"{level:.0f}" for level in levels.levels[:3])
        lines.append(("level", f"{each} m", f"risk {levels.integrity_risk:.0e}"))
    if result.keypoints is not None:
        sigma_px = result.keypoints.sigma_px
        lines.append(("σ near", f"{sigma_px[:2].mean():.2f} px", f"far {sigma_px[2:].mean():.2f} px"))
    return lines


@cache
def _font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    import matplotlib

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), size)
