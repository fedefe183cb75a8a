"""Scenes: a runway and the land around it, drawn exactly through a camera.

Each pixel is cast as a ray onto the ground plane z = 0 of the runway frame, through the same camera
model as everywhere else, and shaded there. Hard edges (paint, pavement, field borders) are averaged
over stratified samples inside the pixel; ground texture is band-limited to the pixel's footprint.
So the runway's corners lie where `project` puts them (tested to 0.05 px), at any resolution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from shortfinal.errors import InputError
from shortfinal.geometry import Camera, Pose, normalise_kernel
from shortfinal.runway import Runway

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_TILE = 256  # side of the tileable noise table
_MOST_STRIPS, _MOST_ROADS = 16, 6  # fixed, so that every scene has one compiled layout

_kernel = njit(cache=True, nogil=True, error_model="numpy", fastmath=True)


class Scene(NamedTuple):
    """Everything a picture of one airfield depends on but the camera. Lengths in metres, colours 0..1."""

    length: float
    width: float
    seed: int
    digits: NDArray[np.float32]  # painted runway number, one 2-D mask per end
    # pavement
    surface: Array  # (3,) colour of the runway
    shoulder: Array  # (3,) colour of the shoulders and the parallel pavements
    shoulder_width: float
    pad: Array  # (2, 6) before and beyond: length, r, g, b, arrows or chevrons (0 none, 1, 2), stripes carried on
    roughness: float  # contrast of the surface's texture
    rubber: Array  # (2, 3) touchdown marks of each end: strength, reach, half width
    # paint
    paint: Array  # (3,)
    wear: float  # 0 fresh, 1 gone
    bars: Array  # (6,) offset, length, stripe width, gap, half of the clear middle, fill of the width
    threshold_line: float  # width of the transverse stripe, 0 for none
    side_stripe: float
    side_dash: float  # period of a broken side stripe, 0 for a full one
    centre_dash: Array  # (3,) dash, gap, width
    aiming: Array  # (4,) offset, length, width, inner half spacing
    touchdown: int  # pairs of touchdown-zone marks
    # surroundings
    strips: Array  # (16, 8) other pavements: x0, y0, x1, y1, half width (0: none), r, g, b
    verge: Array  # (5,) reach, softness, r, g, b of the ground just beside the runway
    airfield: Array  # (6,) half width and margin of the mown field, its colour, blend
    palette: Array  # (6, 3) parcel colours
    parcels: Array  # (5,) heading cosine, sine, size along, size across, row contrast
    roads: Array  # (6, 7) x, y, cosine, sine, half width (0: none), tone, sine wave
    town: Array  # (3,) wavelength, threshold, block size
    forest: Array  # (5,) wavelength, threshold, r, g, b
    water: Array  # (7,) wavelength, threshold, r, g, b, coast x position, coast weight
    relief: float  # contrast of the ground's texture
    # air
    horizon: Array  # (3,)
    zenith: Array  # (3,)
    hills: Array  # (5,) height (rad), wavelength (rad), r, g, b
    haze: Array  # (4,) visibility, r, g, b
    sun: Array  # (4,) gain, r, g, b


@dataclass(frozen=True)
class Sensor:
    """What the camera does to the light: blur, noise and compression."""

    blur_px: float = 0.0  # standard deviation
    noise: float = 0.0  # standard deviation, of 255
    jpeg_quality: int = 0  # 0: not compressed


def random_scene(rng: np.random.Generator, runway: Runway | None = None) -> Scene:
    """A random airfield around `runway` (its length and width; random ones if none is given)."""
    u = rng.uniform
    length = runway.length_m if runway else float(np.exp(u(np.log(900), np.log(4200))))
    width = runway.width_m if runway else float(rng.choice([18, 23, 30, 30, 45, 45, 45, 60]) * u(0.95, 1.05))
    number = int(rng.integers(1, 37))
    tone = u(0.22, 0.72)
    surface = np.clip(tone + rng.normal(0, 0.015, 3) + tone * np.array([0.03, 0.0, -0.03]) * rng.normal(), 0.1, 0.9)
    shoulder = np.clip(surface * u(0.7, 1.15) + rng.normal(0, 0.01, 3), 0.05, 0.9)
    grass = _ground_colour(rng)
    verge = np.clip(grass * u(0.6, 1.2) + rng.normal(0, 0.02, 3), 0.03, 0.9)
    wet = rng.random() < 0.45
    horizon = np.array([u(0.62, 0.8), u(0.74, 0.86), u(0.86, 1.0)]) * u(0.8, 1.05)
    haze = np.clip(0.55 * horizon + 0.45 * np.array([0.35, 0.43, 0.6]) * u(0.7, 1.3), 0, 1)
    heading = u(0, math.pi)
    hill = np.clip(haze * u(0.55, 0.95) + rng.normal(0, 0.02, 3), 0, 1)
    return Scene(
        length=length,
        width=width,
        seed=int(rng.integers(0, 2**31 - 1)),
        digits=_digits(number, (number + 17) % 36 + 1),
        surface=surface,
        shoulder=shoulder,
        shoulder_width=float(rng.choice([0.0, 0.0, u(1, 4), u(4, 9)])),
        pad=np.array([_pad(rng, surface), _pad(rng, surface)]),
        roughness=u(0.01, 0.14),
        rubber=np.array([[u(0, 0.6) * (rng.random() < p), u(250, 900), u(3, 9)] for p in (0.85, 0.6)]),
        paint=np.clip(np.array([1.0, 1.0, u(0.9, 1.0)]) * u(0.75, 1.0), 0, 1),
        wear=u(0.0, 0.5) if rng.random() < 0.8 else u(0.5, 0.9),
        bars=np.array([
            u(0, 7) if rng.random() < 0.7 else 0.5, u(24, 46), u(1.2, 2.4), u(1.0, 2.6), u(0.8, 2.4), u(0.8, 0.97)
        ]) if rng.random() < 0.93 else np.zeros(6),
        threshold_line=u(0.8, 2.4) if rng.random() < 0.4 else 0.0,
        side_stripe=u(0.5, 1.8) if rng.random() < 0.85 else 0.0,
        side_dash=u(8, 60) if rng.random() < 0.2 else 0.0,
        centre_dash=np.array([u(24, 36), u(16, 26), u(0.3, 1.2)]),
        aiming=np.array([u(150, 420), u(30, 65), u(4, 11), u(5, 12)]) if rng.random() < 0.85 else np.zeros(4),
        touchdown=int(rng.integers(0, 7)),
        strips=_strips(rng, length, width, surface),
        verge=np.array([u(0, 25), u(1, 15), *verge]),
        airfield=np.array([u(60, 400), u(40, 500), *grass, u(0.2, 1.0)]),
        palette=np.array([_ground_colour(rng) for _ in range(6)]),
        parcels=np.array([math.cos(heading), math.sin(heading), u(60, 700), u(40, 400), u(0, 0.08)]),
        roads=_roads(rng),
        town=np.array([u(600, 3000), u(0.5, 1.1), u(8, 22)]),
        forest=np.array([u(300, 3000), u(0.45, 1.1), u(0.08, 0.25), u(0.14, 0.32), u(0.07, 0.22)]),
        water=np.array([
            u(800, 5000), u(0.02, 0.4) if wet else -1.0, u(0.02, 0.2), u(0.06, 0.3), u(0.14, 0.42),
            u(-2500, -80) if rng.random() < 0.6 else length + u(60, 2500), u(0.4, 1.5) * (rng.random() < 0.7),
        ]),
        relief=u(0.06, 0.4),
        horizon=horizon,
        zenith=horizon * np.array([u(0.3, 0.7), u(0.55, 0.85), u(0.8, 1.05)]) if rng.random() < 0.8 else horizon * 0.9,
        hills=np.array([u(0, 0.02) * (rng.random() < 0.7), u(0.03, 0.3), *hill]),
        haze=np.array([float(np.exp(u(np.log(5000), np.log(60000)))), *haze]),
        sun=np.array([float(np.exp(u(np.log(0.5), np.log(1.3)))), *(1 + rng.normal(0, 0.035, 3))]),
    )  # fmt: skip


def random_sensor(rng: np.random.Generator) -> Sensor:
    """A random lens and sensor, from clean to poor."""
    blur = abs(rng.normal(0, 0.55)) if rng.random() < 0.85 else rng.uniform(0.8, 2.0)
    noise = abs(rng.normal(0, 2.0)) if rng.random() < 0.88 else rng.uniform(4, 12)
    return Sensor(float(blur), float(noise), int(rng.integers(45, 99)) if rng.random() < 0.8 else 0)


def render(
    scene: Scene, camera: Camera, pose: Pose, sensor: Sensor | None = None, *, samples: int = 4, seed: int = 0
) -> Image:
    """The picture (height, width, 3), RGB, that `camera` at `pose` takes of `scene`.

    To draw a part only, pass `camera.view(window)`. `samples` squared rays go into each pixel that
    touches the airfield. `seed` fixes the sensor's noise.
    """
    if pose.position_m[2] <= 0:
        raise InputError(f"pose: the camera is at a height of {pose.position_m[2]:.1f} m; it must be above the runway")
    out = np.empty((camera.height, camera.width, 3), np.float32)
    rotation = np.ascontiguousarray(pose.runway_from_camera)
    _render_kernel(_packed(scene), camera.intrinsics, rotation, pose.position_m, _noise_table(), samples, out)
    return expose(out, sensor or Sensor(), np.random.default_rng(seed))


def expose(light: NDArray[np.float32], sensor: Sensor, rng: np.random.Generator) -> Image:
    """Light (h, w, 3) in 0..255 to an 8-bit picture through the sensor's blur, noise and compression."""
    if sensor.blur_px > 0.05:
        light = np.asarray(cv2.GaussianBlur(light, (0, 0), sensor.blur_px, borderType=cv2.BORDER_REFLECT), np.float32)
    if sensor.noise > 0:
        light = light + rng.normal(0, sensor.noise, light.shape).astype(np.float32)
    picture = np.clip(light + 0.5, 0, 255).astype(np.uint8)
    if sensor.jpeg_quality:
        _, code = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, sensor.jpeg_quality])
        decoded = np.asarray(cv2.imdecode(code, cv2.IMREAD_COLOR), np.uint8)
        picture = np.ascontiguousarray(decoded[..., ::-1])
    return np.asarray(picture, np.uint8)


def _ground_colour(rng: np.random.Generator) -> Array:
    kinds = np.array([
        [0.25, 0.34, 0.16], [0.36, 0.40, 0.24], [0.46, 0.40, 0.28], [0.33, 0.28, 0.22],
        [0.17, 0.24, 0.13], [0.55, 0.49, 0.36], [0.42, 0.36, 0.31], [0.30, 0.32, 0.30],
    ])  # fmt: skip
    colour = kinds[rng.integers(len(kinds))] * rng.uniform(0.7, 1.35) + rng.normal(0, 0.03, 3)
    return np.asarray(np.clip(colour, 0.02, 0.9))


def _pad(rng: np.random.Generator, surface: Array) -> Array:
    long = rng.uniform(20, 350) if rng.random() < 0.7 else rng.uniform(0, 10)
    alike = rng.random() < 0.5
    colour = surface if alike else np.clip(surface * rng.uniform(0.6, 1.35) + rng.normal(0, 0.02, 3), 0.05, 0.95)
    return np.array([long, *colour, float(rng.integers(0, 3)), float(rng.random() < 0.5)])


def _strips(rng: np.random.Generator, length: float, width: float, surface: Array) -> Array:
    """Taxiways, aprons, a second runway: straight strips of pavement."""
    strips = []

    def add(x0: float, y0: float, x1: float, y1: float, half: float) -> None:
        colour = np.clip(surface * rng.uniform(0.65, 1.3) + rng.normal(0, 0.02, 3), 0.05, 0.95)
        strips.append([x0, y0, x1, y1, half, *colour])

    side = float(rng.choice([-1, 1]))
    if rng.random() < 0.7:
        offset, half = side * rng.uniform(70, 260), rng.uniform(5, 14)
        add(rng.uniform(-60, 0.3 * length), offset, rng.uniform(0.5 * length, length + 60), offset, half)
        for x in rng.uniform(-30, length + 30, rng.integers(1, 6)):
            add(x + rng.uniform(-150, 150), offset, x, 0, rng.uniform(6, 16))
        for x in (-8.0, length - rng.uniform(0, 30)):
            if rng.random() < 0.5:
                add(x + rng.uniform(0, 30), offset, x + rng.uniform(10, 30), 0, rng.uniform(8, 18))
    for _ in range(rng.integers(0, 4)):  # stubs and crossings
        x, slant = rng.uniform(-200, length + 200), rng.uniform(-400, 400)
        reach = [-1, 1] if rng.random() < 0.4 else [0, float(rng.choice([-1, 1]))]
        add(x - slant, 500 * reach[0], x + slant, 500 * reach[1], rng.uniform(4, 20))
    if rng.random() < 0.3:  # another runway
        angle = rng.normal(0, 0.02) if rng.random() < 0.5 else rng.uniform(0.3, 2.8)
        centre = np.array([rng.uniform(0, length), side * rng.uniform(2.5 * width, 900)])
        arm = rng.uniform(500, 1600) * np.array([math.cos(angle), math.sin(angle)])
        (x0, y0), (x1, y1) = centre - arm, centre + arm
        add(x0, y0, x1, y1, rng.uniform(10, 30))
    if rng.random() < 0.5:  # apron
        x, y = rng.uniform(0, length), side * rng.uniform(150, 500)
        add(x, y, x + rng.uniform(100, 600), y, rng.uniform(40, 100))
    return np.array((strips + [[0.0] * 8] * _MOST_STRIPS)[:_MOST_STRIPS])


def _roads(rng: np.random.Generator) -> Array:
    angle = rng.uniform(0, math.pi, _MOST_ROADS)
    far = rng.uniform(-6000, 6000, (_MOST_ROADS, 2))
    half = rng.uniform(2, 9, _MOST_ROADS) * (rng.random(_MOST_ROADS) < 0.5)
    tone, wave = rng.uniform(0.2, 0.8, _MOST_ROADS), rng.uniform(0, 200, _MOST_ROADS)
    return np.column_stack([far, np.cos(angle), np.sin(angle), half, tone, wave])


def _digits(*numbers: int) -> NDArray[np.float32]:
    """Masks (2, 40, 64) of the runway numbers as painted: row 0 is the top of the figures."""
    masks = []
    for number in numbers:
        mask = np.zeros((40, 64), np.uint8)
        cv2.putText(mask, f"{number:02d}", (8, 37), cv2.FONT_HERSHEY_SIMPLEX, 1.25, 255, 5, cv2.LINE_AA)
        masks.append(mask)
    return np.stack(masks).astype(np.float32) / np.float32(255)


def _packed(scene: Scene) -> NDArray[np.void]:
    """The scene as one record (1,), which compiled functions pass on as a pointer."""
    fields = {name: np.asarray(value) for name, value in scene._asdict().items()}
    layout = np.dtype([(name, value.dtype, value.shape) for name, value in fields.items()], align=True)
    record = np.zeros(1, layout)
    for name, value in fields.items():
        record[name] = value
    return record


@cache
def _noise_table() -> NDArray[np.float32]:
    return np.random.default_rng(20).random((_TILE, _TILE)).astype(np.float32)


@_kernel
def _hash(i: Any, j: Any, seed: Any) -> Any:
    """A number in [0, 1) from a lattice point."""
    h = (np.int64(i) * 73856093) ^ (np.int64(j) * 19349663) ^ (np.int64(seed) * 83492791)
    h = (h ^ (h >> 13)) * 1274126177
    return ((h ^ (h >> 16)) & 0xFFFFFF) / 16777216.0


@_kernel
def _noise(table: Any, x: Any, y: Any) -> Any:
    """Smooth value noise in 0..1, period 256."""
    i, j = math.floor(x), math.floor(y)
    a, b = x - i, y - j
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    i0, j0 = int(i) & 255, int(j) & 255
    i1, j1 = (i0 + 1) & 255, (j0 + 1) & 255
    top = table[i0, j0] * (1 - a) + table[i1, j0] * a
    return top * (1 - b) + (table[i0, j1] * (1 - a) + table[i1, j1] * a) * b


@_kernel
def _fractal(table: Any, x: Any, y: Any, wavelength: Any, octaves: Any, footprint: Any) -> Any:
    """Zero-mean noise; octaves finer than the footprint are faded out rather than aliased."""
    total, amplitude = 0.0, 1.0
    for k in range(octaves):
        keep = min(1.0, max(0.0, wavelength / (1.5 * footprint) - 0.6))
        if keep <= 0.0:
            break
        total += keep * amplitude * (_noise(table, x / wavelength + 17.3 * k, y / wavelength + 5.1 * k) - 0.5)
        wavelength *= 0.47
        amplitude *= 0.75
    return total


@_kernel
def _painted(s: Any, x: Any, y: Any, end: Any) -> Any:
    """How much paint (0..1) lies at (x, y), measured from one end's threshold (x along, y left)."""
    half = 0.5 * s.width
    a = abs(y)
    if s.threshold_line > 0.0 and -s.threshold_line <= x < 0.0 and a < half:
        return 1.0
    if x < 0.0:
        return 0.0
    if s.bars[1] > 0.0 and s.bars[0] <= x < s.bars[0] + s.bars[1] and a < half * s.bars[5]:
        pitch = s.bars[2] + s.bars[3]
        return 1.0 if a >= s.bars[4] and (a - s.bars[4]) % pitch < s.bars[2] else 0.0
    start = s.bars[0] + s.bars[1] + 12.0
    if start <= x < start + 10.0:  # the number, 10 m tall, read from the approach
        rows, columns = s.digits.shape[1], s.digits.shape[2]
        column = int((0.5 - y / 16.0) * columns)
        if 0 <= column < columns:
            return s.digits[end, rows - 1 - min(rows - 1, int((x - start) / 10.0 * rows)), column]
        return 0.0
    if s.aiming[1] > 0.0:
        if s.aiming[0] <= x < s.aiming[0] + s.aiming[1]:
            return 1.0 if s.aiming[3] <= a < min(s.aiming[3] + s.aiming[2], half - 2.0) else 0.0
        for k in range(s.touchdown):
            at = 150.0 * (k + 1)
            if at <= x < at + 22.5 and abs(at - s.aiming[0]) > 50.0:
                stripes = 3 - k // 2
                for n in range(stripes):
                    inner = s.aiming[3] + 3.3 * n
                    if inner <= a < min(inner + 1.8, half - 1.0):
                        return 1.0
    return 0.0


@_kernel
def _pad_paint(s: Any, before: Any, y: Any, end: Any) -> Any:
    """Paint on the pavement before a threshold, `before` metres ahead of it."""
    kind, half, a = s.pad[end, 4], 0.5 * s.width, abs(y)
    if kind == 1.0:  # arrows to a displaced threshold
        within = before % 50.0
        if a < 0.4 and within < 30.0:
            return 1.0
        return 1.0 if 2.0 <= within < 10.0 and a < 0.35 * (within - 2.0) and a > 0.35 * (within - 2.0) - 1.2 else 0.0
    if kind == 2.0:  # chevrons: not for use
        return 0.8 if (before + a) % 30.0 < 0.9 and a < half - 2.0 else 0.0
    return 0.0


@_kernel
def _shade_pavement(s: Any, table: Any, x: Any, y: Any, grain: Any, rgb: Any) -> Any:
    """Colour at (x, y) if it lies on the runway, its pads or its shoulders; whether it does."""
    half = 0.5 * s.width
    a = abs(y)
    if a > half + s.shoulder_width or x < -s.pad[0, 0] or x > s.length + s.pad[1, 0]:
        return False
    end = 0 if x < 0.5 * s.length else 1
    along = x if end == 0 else s.length - x
    across = y if end == 0 else -y
    paint, gain = 0.0, 1.0 + grain
    if along >= 0.0:
        r, g, b = s.surface[0], s.surface[1], s.surface[2]
        strength = s.rubber[end, 0]
        if strength > 0.0:
            u = (along - 0.45 * s.rubber[end, 1]) / (0.5 * s.rubber[end, 1])
            v = a / s.rubber[end, 2]
            gain *= 1.0 - strength * math.exp(-u * u - v * v)
    else:
        r, g, b = s.pad[end, 1], s.pad[end, 2], s.pad[end, 3]
    if a > half:
        r, g, b = s.shoulder[0], s.shoulder[1], s.shoulder[2]
    else:
        carried = along >= 0.0 or s.pad[end, 5] > 0.0
        if s.side_stripe > 0.0 and carried and a > half - s.side_stripe:
            paint = 1.0 if s.side_dash == 0.0 or x % s.side_dash < 0.6 * s.side_dash else 0.0
        elif along >= 0.0 or s.threshold_line > 0.0:
            paint = _painted(s, along, across, end)
            if paint == 0.0 and along > 60.0 and a < 0.5 * s.centre_dash[2]:
                paint = 1.0 if (along - 60.0) % (s.centre_dash[0] + s.centre_dash[1]) < s.centre_dash[0] else 0.0
        if paint == 0.0 and along < 0.0:
            paint = _pad_paint(s, -along, across, end)
    if paint > 0.0:
        paint *= max(0.0, 1.0 - s.wear * (0.5 + 1.2 * _noise(table, x * 0.31, y * 0.31)))
    rgb[0] = (r * (1 - paint) + s.paint[0] * paint) * gain
    rgb[1] = (g * (1 - paint) + s.paint[1] * paint) * gain
    rgb[2] = (b * (1 - paint) + s.paint[2] * paint) * gain
    return True


@_kernel
def _shade_strips(s: Any, x: Any, y: Any, grain: Any, rgb: Any) -> Any:
    for n in range(s.strips.shape[0]):
        x0, y0, half = s.strips[n, 0], s.strips[n, 1], s.strips[n, 4]
        if half == 0.0:
            break
        dx, dy = s.strips[n, 2] - x0, s.strips[n, 3] - y0
        length2 = dx * dx + dy * dy
        t = ((x - x0) * dx + (y - y0) * dy) / length2
        if 0.0 <= t <= 1.0:
            off = abs((x - x0) * dy - (y - y0) * dx) / math.sqrt(length2)
            if off < half:
                line = 0.85 if off < 0.3 else 1.0  # a taxiway's centreline
                for c in range(3):
                    rgb[c] = s.strips[n, 5 + c] * (1.0 + grain) * line
                return True
    return False


@_kernel
def _shade_land(s: Any, table: Any, x: Any, y: Any, footprint: Any, rgb: Any) -> None:
    """Parcels, roads: what has hard edges away from the airfield."""
    u, v = s.parcels[0] * x + s.parcels[1] * y, -s.parcels[1] * x + s.parcels[0] * y
    warp = 60.0 * (_noise(table, x / 900.0, y / 900.0) - 0.5)
    u, v = u + warp, v + warp
    row = math.floor(v / s.parcels[3])
    column = math.floor(u / s.parcels[2] + _hash(row, 3, s.seed))
    pick = _hash(column, row, s.seed)
    index = int(pick * s.palette.shape[0])
    tone = 0.8 + 0.4 * _hash(column, row, s.seed + 1)
    rows = s.parcels[4] * (1.0 - 0.5 * footprint)
    if rows > 0.0:
        tone *= 1.0 + rows * math.sin(v * (0.6 + pick))
    far = min(1.0, footprint / s.parcels[3])  # parcels smaller than the footprint melt together
    for c in range(3):
        rgb[c] = s.palette[index, c] * tone * (1 - far) + s.palette[0, c] * far
    for n in range(s.roads.shape[0]):
        if s.roads[n, 4] == 0.0:
            continue
        dx, dy = x - s.roads[n, 0], y - s.roads[n, 1]
        along = dx * s.roads[n, 2] + dy * s.roads[n, 3]
        off = -dx * s.roads[n, 3] + dy * s.roads[n, 2] + s.roads[n, 6] * math.sin(along / 700.0)
        if abs(off) < s.roads[n, 4]:
            for c in range(3):
                rgb[c] = s.roads[n, 5]


@_kernel
def _step(x: Any) -> Any:
    x = min(1.0, max(0.0, x))
    return x * x * (3 - 2 * x)


@_kernel
def _cover(s: Any, table: Any, x: Any, y: Any, footprint: Any, rgb: Any) -> None:
    """Forest, town, the mown airfield, water, and the texture over it all; smooth-edged."""
    shift = 0.37 * (s.seed % 997)
    edge = max(0.02, 2.0 * footprint / s.forest[0])
    wood = _step((_noise(table, x / s.forest[0] + shift, y / s.forest[0]) - s.forest[1]) / edge)
    speckle = _fractal(table, x, y, 22.0, 2, footprint)
    for c in range(3):
        rgb[c] += wood * (s.forest[2 + c] * (1.0 + 1.2 * speckle) - rgb[c])
    built = _noise(table, x / s.town[0] - shift, y / s.town[0] + 40.0) - s.town[1]
    if built > 0.0:
        i, j = math.floor(x / s.town[2]), math.floor(y / s.town[2])
        sharp = min(1.0, s.town[2] / (1.2 * footprint))
        for c in range(3):
            roof = _hash(i, j, s.seed + 5)  # half of the blocks are gardens
            block = (
                0.3 + 1.0 * (roof - 0.5) + 0.08 * _hash(i, j, s.seed + 6 + c) if roof > 0.5 else s.forest[2 + c] + 0.1
            )
            rgb[c] += min(1.0, 12.0 * built) * (sharp * block + (1 - sharp) * 0.38 - rgb[c])
    ahead = max(0.0, max(-x, x - s.length) - s.airfield[1])
    beside = max(0.0, abs(y) - s.airfield[0])
    away = math.sqrt(ahead * ahead + beside * beside)
    mown = s.airfield[5] * (1.0 - _step(away / 60.0 + 1.5 * (_noise(table, x / 130.0, y / 130.0) - 0.5)))
    texture = s.relief * _fractal(table, x + 31.0 * shift, y, 340.0, 8, footprint)
    tint = 0.25 * s.relief * _fractal(table, x, y + 13.0 * shift, 500.0, 4, footprint)
    for c in range(3):
        rgb[c] += mown * (s.airfield[2 + c] - rgb[c])
        rgb[c] *= max(0.1, 1.0 + texture + (c - 1) * tint)
    if s.water[1] > 0.0:
        coast = (x - s.water[5]) if s.water[5] < 0.0 else (s.water[5] - x)  # metres on the airfield's side
        field = _noise(table, x / s.water[0] + 7.0, y / s.water[0] + shift) + s.water[6] * coast / 3000.0
        field += 0.1 * _fractal(table, x, y, 400.0, 5, footprint)
        dry = 8.0 * max(0.0, 1.0 - away / 150.0)  # the airfield itself is never flooded
        wet = _step((s.water[1] - field - dry) / max(0.01, footprint / s.water[0]))
        for c in range(3):
            rgb[c] += wet * (s.water[2 + c] - rgb[c])


@_kernel
def _shade_verge(s: Any, table: Any, x: Any, y: Any, rgb: Any) -> None:
    """The worn ground right beside the pavement."""
    out_x = max(0.0, max(-x - s.pad[0, 0], x - s.length - s.pad[1, 0]))
    out = max(out_x, abs(y) - 0.5 * s.width - s.shoulder_width)
    near = 1.0 - _step((out - s.verge[0] * (0.4 + 1.2 * _noise(table, x / 60.0, y / 30.0))) / s.verge[1])
    for c in range(3):
        rgb[c] += near * (s.verge[2 + c] - rgb[c])


@_kernel
def _sky(s: Any, table: Any, azimuth: Any, elevation: Any, rgb: Any) -> None:
    ridge = s.hills[0] * (0.3 + 1.4 * _noise(table, azimuth / s.hills[1], 0.5 + 0.001 * (s.seed % 251)))
    ridge += 0.15 * s.hills[0] * (_noise(table, 6.0 * azimuth / s.hills[1], 3.5) - 0.5)
    blend = _step(elevation / 0.35)
    hill = _step((ridge - elevation) / 0.0008) if s.hills[0] > 0.0 else 0.0
    for c in range(3):
        air = s.horizon[c] * (1 - blend) + s.zenith[c] * blend
        rgb[c] = air * (1 - hill) + s.hills[2 + c] * hill


@_kernel
def _render_kernel(
    packed: Any, intrinsics: Any, rotation: Any, position: Any, table: Any, samples: Any, out: Any
) -> None:
    s = packed[0]
    height, width = out.shape[0], out.shape[1]
    base, rgb, total, haze = np.empty(3), np.empty(3), np.empty(3), s.haze
    pixel = 1.0 / math.sqrt(intrinsics[0] * intrinsics[1])  # radians
    reach = 0.5 * s.width + s.shoulder_width
    for v in range(height):
        for u in range(width):
            total[:] = 0.0
            # The centre ray decides how this pixel is treated.
            wx, wy, wz = _ray(u, v, intrinsics, rotation)
            grazing = -wz
            if grazing <= 1e-4:
                _sky(s, table, math.atan2(wy, wx), math.asin(max(-1.0, min(1.0, wz))), total)
            else:
                distance = position[2] / grazing
                x, y = position[0] + wx * distance, position[1] + wy * distance
                short, long = distance * pixel, distance * pixel / grazing
                footprint = math.sqrt(short * long)
                near_airfield = (
                    abs(y) < reach + 60.0 + 2.0 * long * abs(wy) + 2.0 * short
                    and x > -s.pad[0, 0] - 60.0 - long
                    and x < s.length + s.pad[1, 0] + 60.0 + long
                )
                count = samples if near_airfield else max(1, min(2, samples))
                grain = s.roughness * 2.0 * (
                    _fractal(table, 0.15 * x, y, 24.0, 6, 0.4 * footprint)
                    + 0.5 * _noise(table, 0.004 * x, 0.2 * y) - 0.25
                )  # fmt: skip
                # The smooth cover is added once, as what it changes at the pixel's centre.
                _shade_land(s, table, x, y, footprint, base)
                _cover(s, table, x, y, footprint, base)
                for a in range(count):
                    for b in range(count):
                        _sample(s, table, u - 0.5 + (a + 0.5) / count, v - 0.5 + (b + 0.5) / count, intrinsics,
                                rotation, position, base, grain, near_airfield, rgb)  # fmt: skip
                        for c in range(3):
                            total[c] += rgb[c]
                clear = math.exp(-distance / haze[0])
                for c in range(3):
                    total[c] = total[c] / (count * count) * clear + haze[1 + c] * (1.0 - clear)
            for c in range(3):
                out[v, u, c] = 255.0 * min(1.0, max(0.0, total[c] * s.sun[0] * s.sun[1 + c]))


@_kernel
def _ray(u: Any, v: Any, intrinsics: Any, rotation: Any) -> Any:
    """Unit direction in the runway frame of the ray through a pixel."""
    x, y, _ = normalise_kernel(u, v, intrinsics)
    scale = 1.0 / math.sqrt(x * x + y * y + 1.0)
    wx = (rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2]) * scale
    wy = (rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2]) * scale
    wz = (rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2]) * scale
    return wx, wy, wz


@_kernel
def _sample(
    s: Any, table: Any, u: Any, v: Any, intrinsics: Any, rotation: Any, position: Any,
    base: Any, grain: Any, near_airfield: Any, rgb: Any,
) -> None:  # fmt: skip
    wx, wy, wz = _ray(u, v, intrinsics, rotation)
    if wz >= -1e-4:
        _sky(s, table, math.atan2(wy, wx), 0.0, rgb)
        return
    t = -position[2] / wz
    x, y = position[0] + wx * t, position[1] + wy * t
    if near_airfield and _shade_pavement(s, table, x, y, grain, rgb):
        return
    for c in range(3):
        rgb[c] = base[c]
    if _shade_strips(s, x, y, grain, rgb):
        return
    if near_airfield:
        _shade_verge(s, table, x, y, rgb)
