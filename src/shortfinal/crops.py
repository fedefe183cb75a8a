"""Where to look: the crop around a runway, for training and for use."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shortfinal.errors import InputError
from shortfinal.geometry import PixelWindow, as_array

Array = NDArray[np.float64]


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


def bogo_crop(box: ArrayLike, margin: float, size: int, rng: np.random.Generator, slack: float = 0.0) -> PixelWindow:
    """A square window of the same size, placed uniformly among all that contain the box.

    The paper draws crops until one contains the runway (its "bogo" crop); given that it
    does, the crop is uniform over the positions that do, and those form a rectangle: so it is
    sampled there directly. `slack` keeps the box that fraction of the side away from the borders.
    """
    left, top, side = _square(box, margin)
    bounds = as_array(box, (4,), "box") + 0.5
    keep = slack * side
    lowest, highest = bounds[2:] - side + keep, bounds[:2] - keep
    corner = np.where(
        lowest < highest, rng.uniform(np.minimum(lowest, highest), np.maximum(lowest, highest)), [left, top]
    )
    return PixelWindow(float(corner[0]), float(corner[1]), side, side, size, size)


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
