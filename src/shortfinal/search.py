"""Where is the runway? Coarse to fine over the frame, a share of it with each frame, with the network that finds its
corners.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from shortfinal.detector import Image, KeypointDetector, Spot
from shortfinal.geometry import PixelWindow

STEP = 0.75  # of a window's side, from one to the next: what is a quarter of it long is whole in one of them
FINER = 2.0  # from one scale of windows to the next
FINEST = 4.0  # windows along the frame's longer side, at the last scale: some 900 pixels of the network's for it
WINDOWS = 12  # that are looked at with one frame: what a budget of 33 ms allows on two cores
AROUND = (8.0, 24.0)  # times a runway's length: windows around it, to see whether there is another beside it


class Search:
    """A search of frames of one size, that goes on from frame to frame; a whole one takes up to `frames`.

    Windows cover the frame at each of three scales, the whole of it first. What is found is a `Spot`: a place to look
    at closely, no more.
    """

    def __init__(self, width: int, height: int, size: int) -> None:
        """Of frames of `width` x `height`, with windows of `size` pixels of the network."""
        self.windows = search_windows(width, height, size)
        self.frames = math.ceil(len(self.windows) / WINDOWS)
        self._next = 0  # window

    def look(self, detector: KeypointDetector, frame: Image) -> list[Spot]:
        """The spots in the next windows of a frame (h, w, 3; RGB), likeliest first, each place once.

        Raises InputError as `KeypointDetector.spots`.
        """
        ahead = self.windows[self._next : self._next + WINDOWS]
        self._next = (self._next + len(ahead)) % len(self.windows)
        return distinct(detector.spots(frame, ahead))

    @property
    def progress(self) -> str:
        """How far it has come, in words."""
        done = self._next or len(self.windows)
        return f"{done} of {len(self.windows)} windows of the frame looked at"

    def again(self) -> None:
        """Begin anew."""
        self._next = 0


def search_windows(width: int, height: int, size: int) -> list[PixelWindow]:
    """Square windows that cover a frame, overlapping, scale by scale from the whole of it to `FINEST`."""
    longest, scale = float(max(width, height)), 1.0
    windows: list[PixelWindow] = []
    while scale <= FINEST:
        side = longest / scale
        windows += [
            PixelWindow(left, top, side, side, size, size)
            for top in _starts(height, side)
            for left in _starts(width, side)
        ]
        scale *= FINER
    return windows


def windows_around(spot: Spot, size: int) -> list[PixelWindow]:
    """Windows centred on a spot in which another runway beside it would show."""
    u, v = spot.centre_px
    sides = [times * spot.side_px for times in AROUND]
    return [PixelWindow(u + 0.5 - side / 2, v + 0.5 - side / 2, side, side, size, size) for side in sides]


def distinct(spots: Sequence[Spot]) -> list[Spot]:
    """Each place once: of those of which one lies within the other's box, the likeliest; likeliest first."""
    kept: list[Spot] = []
    for spot in sorted(spots, reverse=True):
        if not any(spot.overlaps(other) for other in kept):
            kept.append(spot)
    return kept


def _starts(extent: int, side: float) -> list[float]:
    """Where windows of a side begin, so that they cover 0 .. extent, the last ending with it."""
    if side >= extent:
        return [(extent - side) / 2]
    count = math.ceil((extent - side) / (STEP * side)) + 1
    return [float(start) for start in np.linspace(0, extent - side, count)]
