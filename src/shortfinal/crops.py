"""Where to look: the crop around a runway, for training and for use.

Boxes (4,) are left, top, right, bottom in pixels, corners of the runway at their pixel centres; the
windows count from pixel edges (`PixelWindow`), which lie half a pixel further.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shortfinal.errors import InputError
from shortfinal.geometry import PixelWindow, as_array

Array = NDArray[np.float64]
Crop = Literal["framed", "native", "tile"]  # ways to cut training pictures: data/augment.py

PATCH_PX = 48  # side of the patch that shows one corner
_ACROSS, _ALONG = (1, 0, 3, 2), (3, 2, 1, 0)  # each corner's neighbour at the same end, and on the same side
_HALF_PX = 24.0  # of a patch: so many pixels of the image to either side, less where the end is not as wide,
_OF_WIDTH = 0.25  # more where this share of its width is more,
_SIGMAS = 5.0  # or so many sigma of where the corner is
_NARROWEST = math.sin(math.radians(25.0))  # between a patch's axes: flatter ones would show next to nothing


def box_around(px: ArrayLike) -> Array:
    """The box (4,) left, top, right, bottom in pixels that holds keypoints (K, 2)."""
    points = as_array(px, (None, 2), "px")
    return np.concatenate([points.min(axis=0), points.max(axis=0)])


def centre_crop(box: ArrayLike, margin: float, size: int) -> PixelWindow:
    """The square window centred on a box (4,), `margin` times its longer side, resampled to `size`.

    Raises InputError if the box is empty or turned inside out.
    """
    left, top, side = _square(box, margin)
    return PixelWindow(left, top, side, side, size, size)


def bogo_crop(
    box: ArrayLike,
    margin: float,
    size: int,
    rng: np.random.Generator,
    slack: float = 0.0,
    image_size: tuple[int, int] | None = None,
) -> PixelWindow:
    """A square window `margin` times the box's longer side, placed uniformly among all that contain the box.

    The paper draws crops until one contains the runway (its "bogo" crop); given that it
    does, the crop is uniform over the positions that do, and those form a rectangle: so it is
    sampled there directly. `slack` keeps the box that fraction of the side away from the borders.
    With `image_size` (width, height) the window lies within the image, or the image within the window
    where it is the smaller; without, it may hang over. Raises InputError if the box is empty.
    """
    left, top, side = _square(box, margin)
    bounds = as_array(box, (4,), "box") + 0.5
    corner = []
    for axis, centred in enumerate((left, top)):
        extent = image_size[axis] if image_size else None
        lowest, highest = _positions(bounds[axis], bounds[axis + 2], slack * side, side, extent)
        room = highest - lowest
        corner.append(lowest + float(rng.uniform(0, max(0.0, room))) if room > -1e-9 else centred)
    return PixelWindow(corner[0], corner[1], side, side, size, size)


def native_crop(
    box: ArrayLike, image_size: tuple[int, int], rng: np.random.Generator, size: int = 224, margin_px: float = 8.0
) -> PixelWindow:
    """The paper's crop: `size` pixels square, at the image's own resolution or a power of one half of it.

    The image is halved (area average) until the runway's box fits, `margin_px` pixels of the crop
    away from each border. Then crops at whole pixels of the halved image are drawn until one contains
    it: uniform over a grid of positions, which is sampled directly. Crops lie within the halved image
    (an odd last row or column, which has no partner to average with, is no part of it), or the image
    within the crop where it is the smaller. The margin ends at the image's border. Source: arXiv
    2508.09732, training data.

    Raises InputError if the box is empty, reaches beyond the image, or cannot fit at any scale.
    """
    bounds = as_array(box, (4,), "box")
    extent = np.array(image_size, float)
    if not (bounds[:2] < bounds[2:]).all():
        raise InputError(f"box: {bounds.tolist()} is not left < right, top < bottom")
    if (bounds[:2] < -0.5).any() or (bounds[2:] > extent - 0.5).any():
        raise InputError(f"box: {bounds.tolist()} reaches beyond the image of {image_size[0]} x {image_size[1]}")
    if not 0 <= margin_px <= size / 2 - 1:
        raise InputError(f"margin_px: {margin_px}; between 0 and {size / 2 - 1:g} for a crop of {size}")
    factor = 1
    while True:
        edges = (bounds + 0.5) / factor
        ranges = [
            _positions(edges[axis], edges[axis + 2], margin_px, size, math.floor(extent[axis] / factor))
            for axis in range(2)
        ]
        whole = [(math.ceil(lowest), math.floor(highest)) for lowest, highest in ranges]
        if all(lowest <= highest for lowest, highest in whole):
            left, top = (factor * int(rng.integers(lowest, highest + 1)) for lowest, highest in whole)
            return PixelWindow(left, top, size * factor, size * factor, size, size)
        factor *= 2


def random_margin(box: ArrayLike, image_size: tuple[int, int], rng: np.random.Generator) -> float:
    """How many times the box's longer side a training crop is long: 1.15 to 1.9, less in a small image.

    One in four is wider where the image has room, for the first look, which knows no better.
    """
    _, _, side = _square(box, 1.0)
    most = min(image_size) / side
    if most > 1.9 and rng.random() < 0.25:
        return float(np.exp(rng.uniform(np.log(1.9), np.log(min(most, 8.0)))))
    return float(rng.uniform(1.15, max(1.2, min(1.9, most))))


def search_crop(box: Array | None, image_size: tuple[int, int], size: int, rng: np.random.Generator) -> PixelWindow:
    """A window as the search lays them over a frame (`search.search_windows`), for training.

    A runway's box (4,) is 0.03 to 0.75 of its side (log-uniform), as far as the image (width, height) and twice its
    resolution allow; three in four hold the box's centre. Without a box: of any scale, anywhere.
    """
    largest = 1.15 * max(image_size)
    smallest = min(size / 2.2, largest)
    if box is None:
        side = float(np.exp(rng.uniform(np.log(smallest), np.log(largest))))
    else:
        length = float((box[2:] - box[:2]).max())
        side = float(np.clip(length / np.exp(rng.uniform(np.log(0.03), np.log(0.75))), smallest, largest))
    if box is not None and rng.random() < 0.75:
        left, top = (box[:2] + box[2:]) / 2 + 0.5 - rng.uniform(0.05, 0.95, 2) * side
    else:
        left, top = (rng.uniform(min(0.0, extent - side), max(0.0, extent - side)) for extent in image_size)
    return PixelWindow(float(left), float(top), side, side, size, size)


def inverse_crop(
    box: ArrayLike, image_size: tuple[int, int], size: int, rng: np.random.Generator, clearance: float = 0.05
) -> PixelWindow | None:
    """A window of a training crop's scale without the runway: within the image, apart from its box (4,).

    For the out-of-scope monitor. `clearance`: least distance from the box, as a fraction of the
    window's side. Uniform over all such positions: they are the image less a rectangle, which is cut
    into four that do not overlap. None where there is no room for a window of the drawn scale.
    """
    _, _, side = _square(box, random_margin(box, image_size, rng))
    bounds = as_array(box, (4,), "box") + 0.5
    right, bottom = image_size[0] - side, image_size[1] - side  # the furthest a window may begin
    if min(right, bottom) < 0:
        return None
    keep = clearance * side
    x0, x1 = np.clip([bounds[0] - keep - side, bounds[2] + keep], 0, right)  # between these it may touch the box
    y0, y1 = np.clip([bounds[1] - keep - side, bounds[3] + keep], 0, bottom)
    rooms = np.array([[0, 0, x0, bottom], [x1, 0, right, bottom], [x0, 0, x1, y0], [x0, y1, x1, bottom]])
    areas = np.prod(rooms[:, 2:] - rooms[:, :2], axis=1)
    if not areas.sum() > 0:
        return None
    room = rooms[rng.choice(4, p=areas / areas.sum())]
    left, top = rng.uniform(room[:2], room[2:])
    return PixelWindow(float(left), float(top), side, side, size, size)


def corner_patches(corners_px: ArrayLike, sigma_px: ArrayLike) -> Array:
    """Where to look for each corner by itself: affine maps (4, 2, 3) from a patch's pixels (u, v, 1) to the image's.

    A patch is centred on where a first look puts the corner (4, 2), give or take `sigma_px` (4, 2). Its x axis runs
    along the end, towards the other corner there, its y axis along the edge, towards the other end: a corner looks
    alike from wherever it is seen, left or right, near or far, the runway always in the same quadrant.
    """
    corners, sigma = as_array(corners_px, (4, 2), "corners_px"), as_array(sigma_px, (4, 2), "sigma_px")
    maps = np.empty((4, 2, 3))
    for corner, (across, along) in enumerate(zip(_ACROSS, _ALONG, strict=True)):
        here = corners[corner]
        x, width = _direction(corners[across] - here)
        y, _ = _direction(corners[along] - here)
        turn = x[0] * y[1] - x[1] * y[0]
        if abs(turn) < _NARROWEST:
            normal = np.array([-x[1], x[0]]) * (1 if turn >= 0 else -1)
            y = (1 if x @ y >= 0 else -1) * math.sqrt(1 - _NARROWEST**2) * x + _NARROWEST * normal
        half = max(min(_HALF_PX, width), _OF_WIDTH * width, _SIGMAS * float(sigma[corner].max()), 2.0)
        axes = np.column_stack([x, y]) * (half / (PATCH_PX / 2))
        maps[corner] = np.column_stack([axes, here - axes @ np.full(2, (PATCH_PX - 1) / 2)])
    return maps


def _direction(vector: Array) -> tuple[Array, float]:
    """A vector (2,) as one of length 1, and its length; to the right, if it has none."""
    length = float(np.hypot(*vector))
    return (vector / length, length) if length > 0 else (np.array([1.0, 0.0]), 0.0)


def _positions(low: float, high: float, keep: float, side: float, extent: float | None) -> tuple[float, float]:
    """From where to where a window may begin, along one axis, to hold low .. high (edges) and `keep` around it.

    With an `extent` it lies within an image 0 .. extent, or holds all of it; the image is taken to
    reach as far as the box does, and `keep` is wanted only within it. Empty (lowest > highest) if it
    cannot be.
    """
    if extent is None:
        return high + keep - side, low - keep
    start, end = min(0.0, low), max(extent, high)
    first, last = sorted((start, end - side))
    return max(min(high + keep, end) - side, first), min(max(low - keep, start), last)


def _square(box: ArrayLike, margin: float) -> tuple[float, float, float]:
    bounds = as_array(box, (4,), "box")
    extent = bounds[2:] - bounds[:2]
    if (extent < 0).any() or extent.max() <= 0:
        raise InputError(f"box: {bounds.tolist()} is not left < right, top < bottom")
    if not margin >= 1:
        raise InputError(f"margin: {margin}; the crop must be at least as large as the box")
    side = float(extent.max() * margin)
    centre = (bounds[:2] + bounds[2:]) / 2 + 0.5
    return float(centre[0] - side / 2), float(centre[1] - side / 2), side
