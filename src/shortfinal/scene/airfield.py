"""The airfield: runway, markings, pads, taxiways, mown ground and lights, as exact shapes in metres.

Markings follow ICAO Annex 14, volume I, chapter 5 (sizes by the runway's width and landing
distance), with the variations that are painted in the world. A corner is where the outer edge of
the side stripe (or of the pavement) meets the threshold, wherever the pavement itself ends.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shortfinal.geometry import Camera, Pose, can_project, project
from shortfinal.runway import Runway, aiming_point_m
from shortfinal.scene.noise import fractal, hash01, noise, packed, shader, smooth_step, turf

Array = NDArray[np.float64]
Light = NDArray[np.float32]

_STRIP_END, _STRIP_SIDE = 60.0, 75.0  # Annex 14, 3.4: of a runway's strip, beyond its ends and beside it
_MOST_STRIPS = 16  # fixed, so that every airfield has one compiled layout
_ARROWS, _CHEVRONS = 1.0, 2.0  # what is painted before a threshold
# Shares of the kinds of pavement before the landing threshold, and beyond the far one (`_pad`).
_BEFORE, _BEYOND = (0.24, 0.41, 0.22, 0.13), (0.44, 0.23, 0.2, 0.13)
_PLAIN, _TAXIWAY = 0.0, 1.0
# Annex 14, 5.2.4.5: width of the runway, number of threshold stripes.
_STRIPES = ((18.0, 4), (23.0, 6), (30.0, 8), (45.0, 12), (60.0, 16))


class Airfield(NamedTuple):
    """What lies on the ground of one airfield. Lengths in metres, colours 0..1."""

    length: float
    width: float
    seed: int
    # pavement
    surface: Array  # (3,) colour of the runway
    shoulder: Array  # (3,) colour of the shoulders
    shoulder_width: float
    pad: Array  # (2, 7) before and beyond: length, r, g, b, paint on it (0 none, 1 arrows, 2 chevrons), stripes, width
    concrete: Array  # (6,) length of the part in concrete at either end, its r, g, b, side of its slabs
    roughness: float  # contrast of the surface's texture
    patches: Array  # (2,) share of repaired patches, their contrast
    rubber: Array  # (2, 4) touchdown marks of each end: strength, reach, half width, distance of the tracks
    # paint
    paint: Array  # (3,)
    wear: float  # 0 fresh, 1 gone
    bars: Array  # (6,) offset, length, stripes on a side (0: none), their pitch, share of it painted, inner half gap
    threshold_line: Array  # (2,) begin, width of the transverse stripe (0: none)
    side_stripe: float
    side_dash: float  # period of a broken side stripe, 0 for a full one
    centre_dash: Array  # (3,) dash, gap, width
    aiming: Array  # (4,) offset, length (0: none), width, inner half spacing
    touchdown: Array  # (2,) pairs of touchdown-zone marks, whether they tell the distance
    number: Array  # (3,) after the bars, height of a figure, width of two
    designator: int  # 1 to 36
    digits: NDArray[np.float32]  # (2, 48, 48) painted designator, one mask per end
    # beside the runway
    other: Array  # (6,) second runway: x, y of its threshold, cosine, sine, length (0: none), width
    strips: Array  # (16, 9) other pavements: x0, y0, x1, y1, half width (0: none), r, g, b, kind
    verge: Array  # (5,) reach, softness, r, g, b of the ground just beside the runway
    grounds: Array  # (6,) half width and margin of the mown field, its colour, blend
    # light
    extent: Array  # (4,) least and greatest x, y of both; filled in by `record`
    lit: Array  # (4,) spacing of the edge lights, length of the approach lights, their crossbars, indicator (0/1) at x


def random_airfield(rng: np.random.Generator, runway: Runway | None, grass: Array) -> Airfield:
    """A random airfield around `runway` (its length and width; random ones if none is given) on `grass` (3,)."""
    u = rng.uniform
    length = runway.length_m if runway else float(np.exp(u(np.log(800), np.log(4300))))
    width = runway.width_m if runway else _random_width(rng, length)
    surface = _pavement_colour(rng)
    stripe = max(0.45, 0.9 if width >= 30 else 0.45) * u(0.8, 1.6) if rng.random() < 0.85 else 0.0
    alike = stripe > 0 and rng.random() < 0.5  # only the stripe tells the shoulder from the runway
    shoulder = surface * u(0.93, 1.07) if alike else _other_colour(rng, surface)
    side = float(rng.choice([-1.0, 1.0]))
    aiming = _aiming(rng, length, width)
    designator = int(rng.integers(1, 37))
    verge = np.clip(grass * u(0.6, 1.2) + rng.normal(0, 0.008, 3), 0.02, 0.9)
    return Airfield(
        length=length,
        width=width,
        seed=int(rng.integers(0, 2**31 - 1)),
        surface=surface,
        shoulder=np.clip(shoulder, 0.04, 0.9),
        shoulder_width=float(rng.choice([0.0, 0.0, u(1.0, 3.0), u(3.0, 7.5), 7.5])),
        pad=np.array([_pad(rng, surface, stripe > 0, shares) for shares in (_BEFORE, _BEYOND)]),
        concrete=_concrete(rng, surface, length),
        roughness=u(0.02, 0.12),
        patches=np.array([u(0, 0.12) * (rng.random() < 0.5), u(0.03, 0.2)]),
        rubber=np.array([
            [u(0.1, 0.65) * (rng.random() < p), u(250, 900), u(1.5, 5), u(2, 6)] for p in (0.85, 0.65)
        ]),
        paint=np.clip(np.array([1.0, u(0.97, 1.0), u(0.85, 1.0)]) * u(0.62, 0.95), 0, 1),
        wear=u(0.0, 0.45) if rng.random() < 0.8 else u(0.45, 0.85),
        bars=_bars(rng, width),
        threshold_line=_threshold_line(rng),
        side_stripe=stripe,
        side_dash=u(8, 60) if rng.random() < 0.2 else 0.0,
        centre_dash=_centre_line(rng),
        aiming=aiming,
        touchdown=np.array([_touchdown_pairs(length) if rng.random() < 0.7 else 0, float(rng.random() < 0.6)]),
        number=np.array([12.0 * u(0.6, 1.4), *_figure(rng)]) if rng.random() < 0.95 else np.zeros(3),
        designator=designator,
        digits=_designators(designator, int(rng.choice([-1, 0, 0, 0, 1, 2]))),
        other=_other_runway(rng, length, width, side),
        strips=_joined(
            # Drawn apart: the rest of a seed's airfield stays what it was before there were any.
            _beside(rng.spawn(1)[0], length, width, surface, stripe > 0), _strips(rng, length, width, surface, side)
        ),
        extent=np.zeros(4),
        verge=np.array([u(0, 25) * (rng.random() < 0.6), u(1, 15), *verge]),
        grounds=np.array([u(60, 300), u(60, 500), *grass, u(0.5, 1.0)]),
        lit=np.array([u(30, 60), rng.choice([0.0, 420.0, 720.0, 900.0]), rng.integers(1, 6), aiming[0]]),
    )  # fmt: skip


def _random_width(rng: np.random.Generator, length: float) -> float:
    """Annex 14, 3.1.10: wider with the length; 18, 23, 30, 45 m; 60 m is found too."""
    widths = [18.0, 23.0, 30.0] if length < 1200 else [30.0, 30.0, 45.0, 45.0] if length < 1800 else [45.0, 45.0, 60.0]
    return float(rng.choice(widths) * rng.uniform(0.96, 1.04))


def _pavement_colour(rng: np.random.Generator) -> Array:
    """Asphalt from fresh (dark) to bleached, concrete, either tinted a little."""
    tone = rng.choice([rng.uniform(0.1, 0.22), rng.uniform(0.22, 0.45), rng.uniform(0.3, 0.5), rng.uniform(0.42, 0.7)])
    warm = rng.normal(0, 0.025) + (0.04 if tone > 0.42 else 0.0)
    return np.asarray(np.clip(tone * np.array([1 + warm, 1.0, 1 - warm]) + rng.normal(0, 0.008, 3), 0.05, 0.9))


def _other_colour(rng: np.random.Generator, surface: Array) -> Array:
    """Another pavement's, visibly lighter or darker."""
    ratio = rng.uniform(0.55, 0.88) if rng.random() < 0.6 else rng.uniform(1.12, 1.5)
    return np.asarray(np.clip(surface * ratio + rng.normal(0, 0.01, 3), 0.04, 0.92))


def _pad(rng: np.random.Generator, surface: Array, striped: bool, shares: tuple[float, ...]) -> Array:
    """Pavement before a threshold: none; a displaced threshold's; a blast pad or stopway; a worn stub."""
    u = rng.uniform
    kind = rng.choice(["none", "displaced", "blast", "stub"], p=shares)
    alike = surface * u(0.95, 1.05)
    if kind == "displaced":
        painted = _ARROWS if rng.random() < 0.75 else 0.0
        stripes = float(striped and rng.random() < 0.75)
        return np.array([np.exp(u(np.log(40), np.log(500))), *alike, painted, stripes, 1.0])
    if kind == "blast":
        colour = alike if rng.random() < 0.5 else _other_colour(rng, surface)
        return np.array([u(20, 120), *colour, _CHEVRONS * (rng.random() < 0.6), 0.0, u(0.85, 1.35)])
    if kind == "stub":
        colour = alike if rng.random() < 0.5 else _other_colour(rng, surface)
        return np.array([u(8, 60), *colour, 0.0, 0.0, u(0.6, 1.4)])
    return np.array([u(0, 4), *alike, 0.0, 0.0, 1.0])


def _concrete(rng: np.random.Generator, surface: Array, length: float) -> Array:
    """Ends in concrete on a runway of asphalt; slabs all along where the surface is bright."""
    if rng.random() < 0.25:
        return np.array([*rng.uniform(60, 400, 2), *_other_colour(rng, surface), rng.uniform(4, 8)])
    slabs = rng.uniform(4, 8) if surface[0] > 0.4 and rng.random() < 0.7 else 0.0
    return np.array([length * (slabs > 0), 0.0, *surface, slabs])


def _bars(rng: np.random.Generator, width: float) -> Array:
    """Threshold stripes, Annex 14, 5.2.4: 30 m long, to 3 m from the edge or 27 m from the centre line, 6 m on."""
    if rng.random() < 0.06:
        return np.zeros(6)
    offset = rng.uniform(0, 1.5) if rng.random() < 0.6 else rng.uniform(1.5, 7)
    number = min(_STRIPES, key=lambda row: abs(row[0] - width))[1]
    half = min(width / 2 - rng.uniform(0.5, 3.0), 27.0)
    # n/2 stripes and n/2 - 1 gaps a side of equal width, and half a double gap in the middle: n widths in all.
    inner = half / number * rng.uniform(0.7, 1.2)
    painted = rng.uniform(0.42, 0.58)
    pitch = (half - inner) / (number / 2 - 1 + painted)
    long = rng.choice([30.0, 30.0, 45.0, rng.uniform(20, 50)])
    return np.array([offset, long, number / 2, pitch, painted, inner])


def _threshold_line(rng: np.random.Generator) -> Array:
    """The transverse stripe, Annex 14, 5.2.4.8, at least 1.8 m: it ends at the threshold, or begins there."""
    wide = rng.uniform(1.0, 3.0) if rng.random() < 0.35 else 0.0
    return np.array([0.0 if rng.random() < 0.5 else -wide, wide])


def _centre_line(rng: np.random.Generator) -> Array:
    """Annex 14, 5.2.3: stripe and gap together 50 to 75 m, 0.3 to 0.9 m wide."""
    dash = rng.uniform(28, 40)
    return np.array([dash, rng.uniform(20, 35), rng.choice([0.3, 0.45, 0.9, rng.uniform(0.3, 1.2)])])


def _aiming(rng: np.random.Generator, length: float, width: float) -> Array:
    """Annex 14, Table 5-1, or where it happens to be painted."""
    if rng.random() < 0.12:
        return np.zeros(4)
    begin, stripe, space = aiming_point_m(length)
    if rng.random() < 0.4:
        begin, stripe = begin * rng.uniform(0.7, 1.3), stripe * rng.uniform(0.8, 1.6)
    longest = rng.uniform(30, 45) if length < 1200 else rng.uniform(45, 60)
    inner = min(space / 2 * rng.uniform(0.9, 1.25), width / 2 - 5.0)
    return np.array([begin, longest, stripe, inner])


def _touchdown_pairs(length: float) -> int:
    """Annex 14, 5.2.6.3: pairs of marks by the landing distance, the aiming point among them."""
    return int(np.searchsorted([900.0, 1200.0, 1500.0, 2400.0], length, side="right")) + 1 + (length >= 2400.0)


def _figure(rng: np.random.Generator) -> tuple[float, float]:
    """Height of the designator's figures, Annex 14 (9 m) to what is common elsewhere (18 m), and width of two."""
    height = rng.choice([9.0, rng.uniform(9, 13), 18.3])
    return float(height), float(height * rng.uniform(0.8, 1.3))


def _other_runway(rng: np.random.Generator, length: float, width: float, side: float) -> Array:
    """A parallel or crossing runway, in one airfield of four."""
    if rng.random() > 0.25:
        return np.array([0, 0, 1.0, 0, 0, 0])
    size = [rng.uniform(700, 3000), float(rng.choice([18.0, 30.0, 45.0, width]))]
    if rng.random() < 0.5:
        return np.array([rng.uniform(-800, 0.6 * length), side * rng.uniform(110, 900), 1.0, 0.0, *size])
    angle = rng.uniform(0.35, math.pi - 0.35)
    crossing = np.array([rng.uniform(-0.2, 1.2) * length, 0.0])
    start = crossing - rng.uniform(0.1, 0.9) * size[0] * np.array([math.cos(angle), math.sin(angle)])
    return np.array([*start, math.cos(angle), math.sin(angle), *size])


def _strips(rng: np.random.Generator, length: float, width: float, surface: Array, side: float) -> Array:
    """A parallel taxiway with its exits, entries at the ends, stubs, an apron."""
    strips: list[list[float]] = []
    tone = _other_colour(rng, surface) if rng.random() < 0.6 else surface * rng.uniform(0.94, 1.06)

    def add(x0: float, y0: float, x1: float, y1: float, half: float, kind: float = _TAXIWAY) -> None:
        colour = np.clip(tone * rng.uniform(0.92, 1.08) + rng.normal(0, 0.006, 3), 0.04, 0.92)
        strips.append([x0, y0, x1, y1, half, *colour, kind])

    half = rng.uniform(5.0, 11.5)
    if rng.random() < 0.7:
        offset = side * rng.uniform(90, 240)
        begin = rng.uniform(-60, 0.3 * length)
        add(begin, offset, rng.uniform(0.55 * length, length + 60), offset, half)
        for x in rng.uniform(0, length, rng.integers(1, 5)):  # square or rapid exits
            slant = rng.choice([0.0, rng.uniform(40, 220)]) * rng.choice([-1, 1])
            add(x + slant, offset, x, 0.0, half * rng.uniform(0.9, 1.3))
        for x in (rng.uniform(-30, 60), length + rng.uniform(-60, 30)):
            if rng.random() < 0.6:
                add(x, offset, x, 0.0, half * rng.uniform(1.0, 1.6))
        if rng.random() < 0.6:  # the apron
            x, deep = rng.uniform(0, length), rng.uniform(30, 90)
            away_from = offset + side * (deep + rng.uniform(10, 120))
            add(x, away_from, x + rng.uniform(120, 700), away_from, deep, _PLAIN)
            add(x + 60, offset, x + 60, away_from, half)
    for _ in range(rng.integers(0, 3)):
        x = rng.uniform(-100, length + 100)
        reach = rng.uniform(60, 700) * rng.choice([-1, 1])
        add(x, 0.0, x + rng.uniform(-150, 150), reach, rng.uniform(3, 9), rng.choice([_PLAIN, _TAXIWAY]))
    if rng.random() < 0.3:  # a perimeter road
        y = rng.choice([-1, 1]) * rng.uniform(60, 180)
        add(
            -rng.uniform(50, 300),
            y,
            length + rng.uniform(50, 300),
            y * rng.uniform(0.8, 1.2),
            rng.uniform(2, 3.5),
            _PLAIN,
        )
    return np.array(strips).reshape(-1, 9)


def _beside(rng: np.random.Generator, length: float, width: float, surface: Array, striped: bool) -> Array:
    """Pavement right along the runway's edge: turn pads (Annex 14, 3.3) at its ends, and aprons.

    Seen from afar its outer edge passes for the runway's. Of the runway's own colour only where a side stripe tells.
    """
    u, strips = rng.uniform, []
    for end, inward in ((0.0, 1.0), (length, -1.0)):
        for side in (-1.0, 1.0):
            if rng.random() > 0.15:
                continue
            half, long = (u(5, 15), u(40, 110)) if rng.random() < 0.5 else (u(8, 60), u(60, 500))
            begin = u(-0.3, 0.3) * half if rng.random() < 0.6 else u(-1.0, 1.0) * long
            y = side * (width / 2 + half - 1.0)
            tone = surface * u(0.94, 1.06) if striped and rng.random() < 0.6 else _other_colour(rng, surface)
            kind = rng.choice([_PLAIN, _TAXIWAY])
            strips.append(
                [end + inward * begin, y, end + inward * (begin + long), y, half, *np.clip(tone, 0.04, 0.92), kind]
            )
    return np.array(strips).reshape(-1, 9)


def _joined(*strips: Array) -> Array:
    """So many of them as an airfield may have, the first before the last."""
    return np.vstack([*strips, np.zeros((_MOST_STRIPS, 9))])[:_MOST_STRIPS]


@cache
def _designators(number: int, suffix: int) -> NDArray[np.float32]:
    """Masks (2, 48, 48) of both designators as read on the approach: figures above, the letter (L, C, R) below."""
    letters = "" if suffix < 0 else "LCR"[suffix]
    opposite = "" if suffix < 0 else "RCL"[suffix]
    masks = []
    for name, letter in ((number, letters), ((number + 17) % 36 + 1, opposite)):
        mask = np.zeros((48, 48), np.uint8)
        scale = 0.85 if letter else 1.1
        cv2.putText(mask, f"{name:02d}", (4 if scale > 1 else 8, 20 if letter else 36), 0, scale, 255, 3, cv2.LINE_AA)
        if letter:
            cv2.putText(mask, letter, (16, 46), 0, scale, 255, 3, cv2.LINE_AA)
        masks.append(mask)
    return np.stack(masks).astype(np.float32) / np.float32(255)


def lights(airfield: Airfield, position_m: Array) -> Array:
    """The ground lights (N, 7) as seen from a camera: x, y, z (m), r, g, b, strength.

    Annex 14, 5.3: edge lights (5.3.9), yellow over the last 600 m; threshold green, end red
    (5.3.10, 5.3.11); approach lights in rows of five every 30 m with crossbars (5.3.4); and a PAPI of
    four units beside the aiming point, each white from above its angle and red from below (5.3.5).
    """
    length, half, spacing = airfield.length, airfield.width / 2 + 1.5, airfield.lit[0]
    along = np.linspace(0, length, math.ceil(length / spacing) + 1)
    caution = (length - along < min(600.0, length / 3))[:, None]
    edge = np.where(caution, [1.0, 0.75, 0.2], [1.0, 0.95, 0.8])
    across = np.arange(-half, half + 0.1, 3.0)
    rows = [_row(along, y, edge, 1.0) for y in (-half, half)]
    rows += [_row(-1.0, across, [0.1, 1.0, 0.3], 1.0), _row(length + 1.0, across, [1.0, 0.1, 0.05], 0.6)]
    before = np.arange(30.0, airfield.lit[1] + 1, 30.0)
    for offset in (-2.0, -1.0, 0.0, 1.0, 2.0):
        rows.append(_row(-before, offset, [1.0, 0.97, 0.9], 0.8))
    for bar in range(1, int(airfield.lit[2]) + 1):
        if 150.0 * bar <= airfield.lit[1]:
            rows.append(_row(-150.0 * bar, np.arange(-15.0, 15.1, 2.5), [1.0, 0.97, 0.9], 1.2))
    if airfield.lit[3] > 0:
        rows.append(_indicator(airfield, position_m))
    return np.vstack(rows)


def _row(x: Array | float, y: Array | float, colour: Any, strength: float) -> Array:
    x, y = (np.asarray(v, float) for v in np.broadcast_arrays(x, y))
    rgb = np.broadcast_to(colour, (x.size, 3))
    return np.column_stack([x, y, np.full(x.size, 0.4), rgb, np.full(x.size, strength)])


def _indicator(airfield: Airfield, position_m: Array) -> Array:
    """The PAPI, Annex 14, 5.3.5.24 to 35: 15 m off the edge, units 9 m apart, 20' between their angles."""
    units = np.array([[airfield.lit[3], airfield.width / 2 + 15.0 + 9.0 * n, 0.5] for n in range(4)])
    ahead = np.maximum(1.0, units[:, 0] - position_m[0])
    angle = np.degrees(np.arctan2(position_m[2] - units[:, 2], ahead))
    white = (angle > 3.0 + np.array([0.5, 1 / 6, -1 / 6, -0.5]))[:, None]
    return np.column_stack([units, np.where(white, [1.0, 0.95, 0.9], [1.0, 0.08, 0.04]), np.full(4, 6.0)])


def add_lights(
    light: Light, airfield: Airfield, camera: Camera, pose: Pose, darkness: float, visibility_m: float
) -> None:
    """Add the ground lights to the light image (h, w, 3; 0 to 255) that the camera at `pose` takes.

    `darkness`: 0 by day, when next to nothing of them shows, to 1 at night, when the exposure is for them.
    """
    rows = lights(airfield, pose.position_m)
    towards = rows[:, :3] - pose.position_m
    distance = np.linalg.norm(towards, axis=1)
    rows = rows[(towards @ pose.runway_from_camera[:, 2] > 0.2 * distance) & can_project(camera, pose, rows[:, :3])]
    distance = np.linalg.norm(rows[:, :3] - pose.position_m, axis=1)
    shown = (
        (camera.fx * camera.fy) * (0.02 + 5.0 * darkness**2) / distance**2 * np.exp(-3.912 * distance / visibility_m)
    )
    energy = 255.0 * rows[:, 6] * shown  # the sum over the pixels
    sigma = np.minimum(0.6 + 0.12 * np.sqrt(energy / 255.0), 8.0)
    for (u, v), e, s, rgb in zip(project(camera, pose, rows[:, :3]), energy, sigma, rows[:, 3:6], strict=True):
        reach = 3.0 * s + 1.0
        u0, u1 = max(0, math.floor(u - reach)), min(camera.width, math.ceil(u + reach) + 1)
        v0, v1 = max(0, math.floor(v - reach)), min(camera.height, math.ceil(v + reach) + 1)
        if e < 0.5 or u0 >= u1 or v0 >= v1:
            continue
        across, down = (
            np.exp(-0.5 * ((np.arange(*span) - at) / s) ** 2) for span, at in (((u0, u1), u), ((v0, v1), v))
        )
        spot = (e / (2 * math.pi * s * s)) * down[:, None] * across
        light[v0:v1, u0:u1] += np.minimum(spot[..., None] * rgb, 400.0).astype(np.float32)


def record(airfield: Airfield) -> NDArray[np.void]:
    """What the kernels take."""
    other, used = airfield.other, airfield.strips[airfield.strips[:, 4] > 0]
    points = np.vstack([other[:2], other[:2] + other[2:4] * other[4], used[:, :2], used[:, 2:4]])
    around = max(other[5] / 2, used[:, 4].max(initial=0.0) + 25.0)
    low, high = points.min(axis=0) - around, points.max(axis=0) + around
    return packed(airfield._replace(extent=np.array([low[0], high[0], low[1], high[1]])))


# What is seen at a point of the ground. `a` is the airfield's record; colours go in and out by `rgb`.


@shader
def _on_other(a: Any, x: Any, y: Any) -> Any:
    """(x, y) along and across the second runway, from its threshold."""
    dx, dy = x - a.other[0], y - a.other[1]
    return a.other[2] * dx + a.other[3] * dy, a.other[2] * dy - a.other[3] * dx


@shader
def away(a: Any, x: Any, y: Any) -> Any:
    """How far (x, y) lies outside the airfield's grounds, metres; 0 inside. They reach around both runways."""
    ahead = max(0.0, max(-x, x - a.length) - a.grounds[1])
    beside = max(0.0, abs(y) - a.grounds[0])
    least = math.sqrt(ahead * ahead + beside * beside)
    if a.other[4] > 0.0:
        along, across = _on_other(a, x, y)
        ahead = max(0.0, max(-along, along - a.other[4]) - _STRIP_END)
        beside = max(0.0, abs(across) - 0.5 * a.other[5] - _STRIP_SIDE)
        least = min(least, math.sqrt(ahead * ahead + beside * beside))
    return least


@shader
def near_pavement(a: Any, x: Any, y: Any, margin_x: Any, margin_y: Any) -> Any:
    """What may lie within the margins (m) of (x, y): 2 the runway, its pads or verge, 1 other pavement, 0 none."""
    across = 0.5 * a.width * max(1.0, max(a.pad[0, 6], a.pad[1, 6])) + a.shoulder_width + 60.0
    ahead, beyond = a.pad[0, 0] + 60.0, a.pad[1, 0] + 60.0
    if abs(y) < across + margin_y and -ahead - margin_x < x < a.length + beyond + margin_x:
        return 2
    box = a.extent
    return 1 if box[0] - margin_x < x < box[1] + margin_x and box[2] - margin_y < y < box[3] + margin_y else 0


@shader
def ground(a: Any, table: Any, x: Any, y: Any, footprint: Any, rgb: Any) -> None:
    """The mown field, blended over the land's colour in `rgb`: smooth, so once a pixel is enough."""
    edge = away(a, x, y) / 60.0 + 1.5 * (noise(table, x / 130.0, y / 130.0) - 0.5)
    mown = a.grounds[5] * (1.0 - smooth_step(edge))
    if mown <= 0.0:
        return
    shift = 0.11 * (a.seed % 991)
    patchy = 1.0 + 0.3 * turf(table, x + shift, y - shift, footprint)
    dry = 0.16 * fractal(table, x - shift, y + shift, 420.0, 3, footprint)
    for c in range(3):
        rgb[c] += mown * (a.grounds[2 + c] * patchy * (1.0 + (1 - c) * dry) - rgb[c])


@shader
def grain(a: Any, table: Any, x: Any, y: Any, footprint: Any) -> Any:
    """The surface's texture as a relative change of brightness; once a pixel is enough."""
    streaks = fractal(table, 0.12 * x, y, 24.0, 6, 0.4 * footprint)
    lanes = 0.5 * noise(table, 0.004 * x, 0.2 * y + a.seed % 97) - 0.25
    return a.roughness * 2.0 * (streaks + lanes)


@shader
def paved(a: Any, table: Any, x: Any, y: Any, texture: Any, rgb: Any) -> Any:
    """Hard-edged: the colour in `rgb` replaced where pavement or paint lies at (x, y), the verge blended in beside it.

    `texture` is `grain` at the pixel's centre. For each sample inside a pixel; returns whether it is paved.
    """
    if near_pavement(a, x, y, 0.0, 0.0) == 2 and _runway(a, table, x, y, texture, rgb):
        return True
    if a.other[4] > 0.0:
        along, across = _on_other(a, x, y)
        if 0.0 <= along <= a.other[4] and abs(across) <= 0.5 * a.other[5]:
            _surface(a, table, along, across, a.other[4], rgb)
            end = 0 if along < 0.5 * a.other[4] else 1
            inward = along if end == 0 else a.other[4] - along
            paint = _marking(a, inward, across if end == 0 else -across, end, a.other[4], a.other[5])
            _apply(a, table, x, y, 0.7 * paint, texture, rgb)
            return True
    if _taxiways(a, x, y, texture, rgb):
        return True
    _verge(a, table, x, y, rgb)
    return False


@shader
def _runway(a: Any, table: Any, x: Any, y: Any, texture: Any, rgb: Any) -> Any:
    """The runway with its pads and shoulders; whether (x, y) lies on them."""
    end = 0 if x < 0.5 * a.length else 1
    along = x if end == 0 else a.length - x
    across, off, half = (y if end == 0 else -y), abs(y), 0.5 * a.width
    if along < 0.0:
        wide = half * a.pad[end, 6]
        if along < -a.pad[end, 0] or off > max(wide, half * a.pad[end, 5]) + a.shoulder_width * a.pad[end, 5]:
            return False
        if off <= wide:
            for c in range(3):
                rgb[c] = a.pad[end, 1 + c]
            _apply(a, table, x, y, _before(a, -along, off, end), texture, rgb)
            return True
    elif off <= half:
        _surface(a, table, x, y, a.length, rgb)
        _apply(a, table, x, y, _marking(a, along, across, end, a.length, a.width), texture, rgb)
        return True
    elif off > half + a.shoulder_width:
        return False
    for c in range(3):
        rgb[c] = a.shoulder[c] * (1.0 + texture)
    return True


@shader
def _surface(a: Any, table: Any, x: Any, y: Any, length: Any, rgb: Any) -> None:
    """Asphalt or concrete with its slabs, patches and tyre marks."""
    begin, side = min(x, length - x), a.concrete[5]
    in_concrete = side > 0.0 and begin < (
        a.concrete[0] if x < 0.5 * length else max(a.concrete[1], a.concrete[0] - length)
    )
    gain = 1.0
    if in_concrete:
        i, j = math.floor(x / side), math.floor(y / side)
        gain += 0.12 * a.roughness / 0.07 * (hash01(i, j, a.seed) - 0.5)
        if x - i * side < 0.12 or y - j * side < 0.12:
            gain *= 0.8
    if a.patches[0] > 0.0:
        i, j = math.floor(x / 31.0), math.floor((y + 500.0) / 6.5)
        if hash01(i, j, a.seed + 1) < a.patches[0]:
            gain *= 1.0 - a.patches[1]
    end = 0 if x < 0.5 * length else 1
    strength = a.rubber[end, 0]
    if strength > 0.0:
        u = (begin - 0.55 * a.rubber[end, 1]) / (0.42 * a.rubber[end, 1])
        v = (abs(y) - a.rubber[end, 3]) / a.rubber[end, 2]
        ragged = 0.7 + 0.6 * noise(table, 0.02 * x, 1.7 * y)
        gain *= 1.0 - min(0.85, strength * ragged * math.exp(-u * u - v * v))
    for c in range(3):
        rgb[c] = (a.concrete[2 + c] if in_concrete else a.surface[c]) * gain


@shader
def _apply(a: Any, table: Any, x: Any, y: Any, paint: Any, texture: Any, rgb: Any) -> None:
    """Paint of a strength (negative: yellow), worn, over the pavement in `rgb`; then the texture of both."""
    strength = abs(paint)
    if strength > 0.0:
        strength *= max(0.0, 1.0 - a.wear * (0.4 + 1.2 * noise(table, x * 0.31, y * 0.31)))
    for c in range(3):
        colour = a.paint[c] * (1.0, 0.81, 0.2)[c] if paint < 0.0 else a.paint[c]
        rgb[c] = (rgb[c] * (1 - strength) + colour * strength) * (1.0 + texture)


@shader
def _marking(a: Any, x: Any, y: Any, end: Any, length: Any, width: Any) -> Any:
    """How much paint (0..1) lies at (x, y) of a runway, from one end's threshold: x along (>= 0), y left."""
    off, half = abs(y), 0.5 * width
    if a.side_stripe > 0.0 and off > min(half, 30.0 + a.side_stripe) - a.side_stripe:
        return 1.0 if a.side_dash == 0.0 or x % a.side_dash < 0.6 * a.side_dash else 0.0
    if a.threshold_line[0] <= x < a.threshold_line[0] + a.threshold_line[1]:
        return 1.0
    bars_end = a.bars[0] + a.bars[1]
    if x < bars_end:
        if x < a.bars[0] or a.bars[2] == 0.0 or off < a.bars[5]:
            return 0.0
        pitch = a.bars[3]
        if width != a.width:  # the second runway's stripes fill its own width
            pitch = (min(half - 0.5, 27.0) - a.bars[5]) / (a.bars[2] - 1.0 + a.bars[4])
        n = math.floor((off - a.bars[5]) / pitch)
        return 1.0 if n < a.bars[2] and off - a.bars[5] - n * pitch < a.bars[4] * pitch else 0.0
    begin, tall = bars_end + a.number[0], a.number[1]
    if tall > 0.0 and begin <= x < begin + tall:
        rows, columns = a.digits.shape[1], a.digits.shape[2]
        column = math.floor((0.5 - y / a.number[2]) * columns)
        if 0 <= column < columns:
            return a.digits[end, rows - 1 - min(rows - 1, int((x - begin) / tall * rows)), column]
        return 0.0
    if off < 0.5 * a.centre_dash[2]:
        start = begin + tall + 12.0
        middle = x < 0.5 * length
        return (
            1.0
            if middle and x > start and (x - start) % (a.centre_dash[0] + a.centre_dash[1]) < a.centre_dash[0]
            else 0.0
        )
    return _zone(a, x, off, half)


@shader
def _zone(a: Any, x: Any, off: Any, half: Any) -> Any:
    """Aiming point and touchdown zone."""
    if a.aiming[1] > 0.0 and a.aiming[0] <= x < a.aiming[0] + a.aiming[1]:
        return 1.0 if a.aiming[3] <= off < min(a.aiming[3] + a.aiming[2], half - 2.0) else 0.0
    pair = math.floor(x / 150.0)
    at = 150.0 * pair
    if pair < 1 or pair > a.touchdown[0] or x - at >= 22.5 or abs(at - a.aiming[0]) < 50.0:
        return 0.0
    if a.touchdown[1] == 0.0:  # Annex 14, figure 5-5 (A)
        return 1.0 if a.aiming[3] <= off < a.aiming[3] + 3.0 else 0.0
    stripes = 3 if pair == 1 else 2 if pair <= 4 else 1  # figure 5-5 (B)
    within = off - a.aiming[3]
    return 1.0 if within >= 0.0 and within < 3.3 * stripes - 1.5 and within % 3.3 < 1.8 and off < half - 1.0 else 0.0


@shader
def _before(a: Any, before: Any, off: Any, end: Any) -> Any:
    """Paint on the pavement `before` metres ahead of a threshold; negative for yellow."""
    line = a.threshold_line[0] + a.threshold_line[1]
    half = 0.5 * a.width
    if a.threshold_line[1] > 0.0 and line <= 0.0 and before <= a.threshold_line[1] and off <= half:
        return 1.0
    if a.pad[end, 5] > 0.0 and a.side_stripe > 0.0 and half - a.side_stripe < off <= half:
        return 1.0
    if a.pad[end, 4] == _ARROWS:  # Annex 14, 5.2.4.10: along the centre line, and a row of heads at the threshold
        within = before % 60.0
        if off < 0.45 and 2.0 <= within < 30.0:
            return 1.0
        slope = 0.24 * (within - 2.0)
        if 2.0 <= within < 11.0 and slope - 1.4 < off < slope:
            return 1.0
        if before < 8.0 and a.touchdown[1] > 0.0 and half > 12.0:
            spread = abs(off % 8.0 - 4.0)
            return 1.0 if abs(spread - 0.4 * before) < 0.6 else 0.0
        return 0.0
    if a.pad[end, 4] == _CHEVRONS:  # 5.2.18: not for use
        return -0.9 if (before + off) % 30.0 < 1.3 and off < half - 1.0 else 0.0
    return 0.0


@shader
def _taxiways(a: Any, x: Any, y: Any, texture: Any, rgb: Any) -> Any:
    for n in range(a.strips.shape[0]):
        half = a.strips[n, 4]
        if half == 0.0:
            break
        x0, y0 = a.strips[n, 0], a.strips[n, 1]
        dx, dy = a.strips[n, 2] - x0, a.strips[n, 3] - y0
        length = math.sqrt(dx * dx + dy * dy)
        along = ((x - x0) * dx + (y - y0) * dy) / length
        off = abs((x - x0) * dy - (y - y0) * dx) / length
        radius = 25.0 if a.strips[n, 8] == _TAXIWAY else 0.0
        if off > half + radius or along < -half or along > length + half:
            continue
        # Rounded where it meets the runway.
        gap = abs(y) - 0.5 * a.width
        fillet = 0.0
        if radius > 0.0 and 0.0 <= gap < radius and y0 * a.strips[n, 3] <= 0.0:
            fillet = radius - math.sqrt(radius * radius - (radius - gap) * (radius - gap))
        ends = max(-along, along - length)
        if off < half + fillet and (ends <= 0.0 or ends * ends + off * off < half * half):
            paint = 0.6 if a.strips[n, 8] == _TAXIWAY and off < 0.25 else 0.0
            for c in range(3):
                yellow = (0.62, 0.5, 0.12)[c]
                rgb[c] = (a.strips[n, 5 + c] * (1 - paint) + yellow * paint) * (1.0 + texture)
            return True
    return False


@shader
def _verge(a: Any, table: Any, x: Any, y: Any, rgb: Any) -> None:
    """The worn ground right beside the pavement."""
    if a.verge[0] == 0.0:
        return
    out_x = max(0.0, max(-x - a.pad[0, 0], x - a.length - a.pad[1, 0]))
    out = max(out_x, abs(y) - 0.5 * a.width - a.shoulder_width)
    near = 1.0 - smooth_step((out - a.verge[0] * (0.4 + 1.2 * noise(table, x / 60.0, y / 30.0))) / a.verge[1])
    for c in range(3):
        rgb[c] += near * (a.verge[2 + c] - rgb[c])
