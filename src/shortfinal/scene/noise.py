"""Noise, hashes and records that the scene's compiled functions share."""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

_TILE = 256  # side of the tileable noise table

shader: Any = njit(cache=True, nogil=True, error_model="numpy", fastmath=True)


def packed(parts: NamedTuple) -> NDArray[np.void]:
    """A named tuple of numbers and arrays as one record (1,), which compiled functions pass on as a pointer."""
    fields = {name: np.asarray(value) for name, value in parts._asdict().items()}
    layout = np.dtype([(name, value.dtype, value.shape) for name, value in fields.items()], align=True)
    record = np.zeros(1, layout)
    for name, value in fields.items():
        record[name] = value
    return record


@cache
def noise_table() -> NDArray[np.float32]:
    """Random numbers (256, 256) in 0..1 that all the noise is made of."""
    return np.random.default_rng(20).random((_TILE, _TILE)).astype(np.float32)


@shader
def hash01(i: Any, j: Any, seed: Any) -> Any:
    """A number in [0, 1) from a lattice point."""
    h = (np.int64(i) * 73856093) ^ (np.int64(j) * 19349663) ^ (np.int64(seed) * 83492791)
    h = (h ^ (h >> 13)) * 1274126177
    return ((h ^ (h >> 16)) & 0xFFFFFF) / 16777216.0


@shader
def noise(table: Any, x: Any, y: Any) -> Any:
    """Smooth value noise in 0..1, period 256."""
    i, j = math.floor(x), math.floor(y)
    a, b = x - i, y - j
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    i0, j0 = int(i) & 255, int(j) & 255
    i1, j1 = (i0 + 1) & 255, (j0 + 1) & 255
    top = table[i0, j0] * (1 - a) + table[i1, j0] * a
    return top * (1 - b) + (table[i0, j1] * (1 - a) + table[i1, j1] * a) * b


@shader
def fractal(table: Any, x: Any, y: Any, wavelength: Any, octaves: Any, footprint: Any) -> Any:
    """Zero-mean noise; octaves finer than the footprint are faded out rather than aliased."""
    total, amplitude = 0.0, 1.0
    for k in range(octaves):
        keep = min(1.0, max(0.0, wavelength / (1.5 * footprint) - 0.6))
        if keep <= 0.0:
            break
        total += keep * amplitude * (noise(table, x / wavelength + 17.3 * k, y / wavelength + 5.1 * k) - 0.5)
        wavelength *= 0.47
        amplitude *= 0.75
    return total


@shader
def outline(table: Any, x: Any, y: Any, wavelength: Any, octaves: Any, footprint: Any, level: Any) -> Any:
    """Fractal noise above `level`: its zero line is a ragged outline, as of coasts and woods.

    Each octave has half the wavelength and half the amplitude (so at most the sum left over), and is
    turned, lest the lattice shows. Once the sign is sure the rest is left out.
    """
    total, amplitude = -level, 1.0
    x, y = x / wavelength, y / wavelength
    for _ in range(octaves):
        keep = min(1.0, max(0.0, wavelength / (1.5 * footprint) - 0.6))
        if keep <= 0.0 or abs(total) > amplitude + 0.1:
            break
        total += keep * amplitude * (noise(table, x, y) - 0.5)
        x, y = 1.6 * x - 1.2 * y + 11.3, 1.2 * x + 1.6 * y + 7.9
        wavelength *= 0.5
        amplitude *= 0.5
    return total


@shader
def turf(table: Any, x: Any, y: Any, footprint: Any) -> Any:
    """Texture of grown ground, about -1 to 1: broad patches, ragged spots with an edge, tussocks."""
    broad = outline(table, x, y, 310.0, 6, footprint, 0.0)
    spots = outline(table, y, x, 85.0, 6, footprint, 0.04 + 0.3 * broad)
    spots = min(0.3, max(-0.3, 6.0 * spots))
    return 0.7 * broad + spots + 0.8 * fractal(table, x, y, 36.0, 5, footprint)


@shader
def smooth_step(x: Any) -> Any:
    """0 up to 0, 1 from 1, level at both."""
    x = min(1.0, max(0.0, x))
    return x * x * (3 - 2 * x)
