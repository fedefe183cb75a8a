"""Above and between: light, haze, sky, clouds, and the relief at the horizon.

Colours are those of the picture, 0..1. What lies at distance d is seen after Koschmieder (1924):
object exp(-beta d) + airlight (1 - exp(-beta d)), beta = 3.912 / visibility at a contrast of 2 %.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shortfinal.scene.noise import fractal, outline, shader, smooth_step

Array = NDArray[np.float64]

_MOST_RIDGES = 5
_TWICE_EARTH_M = 2.0 * 6.371e6


class Sky(NamedTuple):
    """Light, air and what stands against the sky. Lengths in metres, directions in the runway frame."""

    seed: int
    sun: Array  # (3,) unit vector towards it
    ambient: Array  # (3,) light on the ground from the whole sky
    direct: Array  # (3,) light on the ground from the sun
    shade: float  # ambient over all light: how dark a shadow is
    darkness: float  # 0 by day, 1 at night: how far lamps outshine the daylight; -1: they are off
    horizon: Array  # (3,)
    zenith: Array  # (3,)
    scale: float  # rad, elevation over which the one turns into the other
    airlight: Array  # (3,) colour of endless air over ground
    glow: Array  # (4,) added towards the sun: r, g, b; width, rad
    visibility_m: float
    beta: Array  # (3,) extinction by colour, 1/m
    clouds: Array  # (5,) base, wavelength, cover (-1 none to 1 all), opacity, contrast
    cloud_rgb: Array  # (2, 3) sunlit and shaded
    veil: Array  # (2,) strength of high cloud, stretch
    ridges: Array  # (5, 5) nearest first: radius about the runway's middle (0: none), height, wavelength, peaks, side
    rock: Array  # (2, 3) colours of the relief
    snow_line: float
    middle: float  # x of the runway's middle


def random_sky(rng: np.random.Generator, length: float, rock: Array, snow_line: float) -> Sky:
    """Random light and air; relief of the colours `rock` (2, 3) around a runway of `length` m.

    Clear day 69 %, haze 11 %, overcast 9 %, dusk 6 %, night 5 %.
    """
    u = rng.uniform
    kind = str(rng.choice(["clear", "haze", "overcast", "dusk", "night"], p=[0.69, 0.11, 0.09, 0.06, 0.05]))
    elevation = math.radians(u(-3, 9) if kind == "dusk" else 18 + 52 * rng.beta(1.3, 1.2))
    bearing = u(0, 2 * math.pi)
    height = max(math.sin(elevation), 0.05)
    flat = math.sqrt(1 - height * height)
    visibility = math.exp(u(*np.log({"clear": (16e3, 120e3), "haze": (3e3, 16e3)}.get(kind, (6e3, 70e3)))))
    horizon, zenith, ambient, direct, glow = _light(rng, kind)
    pure = np.clip(math.log(visibility / 4e3) / math.log(15), 0, 1)  # clean air scatters blue, haze all colours
    blue = np.array([0.52, 0.62, 0.84]) * np.array([u(0.85, 1.2), u(0.92, 1.12), u(0.95, 1.08)])
    airlight = horizon * (1 - pure * u(0.3, 1.0) * (1 - blue))
    if kind == "haze":
        zenith = zenith + u(0.1, 0.7) * (horizon - zenith)
    cumulus = kind in ("clear", "dusk") and rng.random() < 0.22
    lit = np.clip(horizon * u(1.0, 1.25) + (0.1 if kind == "clear" else 0.0), 0, 1)
    return Sky(
        seed=int(rng.integers(0, 2**31 - 1)),
        sun=np.array([flat * math.cos(bearing), flat * math.sin(bearing), height]),
        ambient=ambient,
        direct=direct,
        shade=float(ambient.sum() / (ambient + direct).sum()),
        darkness={"night": 1.0, "dusk": u(0.2, 0.8)}.get(kind, float(rng.choice([0.0, -1.0]))),
        horizon=horizon,
        zenith=zenith,
        scale=math.radians(u(7, 18)),
        airlight=airlight,
        glow=np.array([*glow, u(0.15, 0.5)]),
        visibility_m=visibility,
        beta=3.912 / visibility * (1 + pure * u(0.2, 1.0) * np.array([-0.3, 0.0, 0.4])),
        clouds=np.array([
            u(900, 2600), u(700, 3000), u(-0.25, 0.1) if cumulus else (1.0 if kind == "overcast" else -1.0),
            u(0.6, 1.0), u(0.1, 0.9) if kind == "overcast" else u(0.4, 1.0),
        ]),
        cloud_rgb=np.array([lit, lit * np.array([0.62, 0.67, 0.76]) * u(0.85, 1.15)]),
        veil=np.array([u(0, 0.45) * (rng.random() < 0.15), u(1, 5)]),
        ridges=_ridges(rng, length),
        rock=rock,
        snow_line=snow_line,
        middle=0.5 * length,
    )  # fmt: skip


def _light(rng: np.random.Generator, kind: str) -> tuple[Array, Array, Array, Array, Array]:
    """Colours of horizon and zenith, ambient and direct light, and the sun's glow."""
    u, gain = rng.uniform, float(np.exp(rng.normal(0, 0.14)))
    share = u(0.26, 0.5)  # of the sky in a clear day's light
    day, white = np.array([0.9, 1.0, 1.14]), np.array([1.02, 1.0, 0.96])
    if kind == "clear":
        pale, deep = u(), u() ** 1.5
        horizon = (
            np.array([0.70, 0.83, 0.95]) * (1 - pale) + np.array([0.86, 0.93, 1.0]) * pale + rng.normal(0, 0.012, 3)
        )
        zenith = (
            np.array([0.33, 0.48, 0.82]) * (1 - deep) + np.array([0.15, 0.29, 0.62]) * deep + rng.normal(0, 0.012, 3)
        )
        return horizon, zenith, gain * share * day, gain * (1 - share) * white, np.array([0.25, 0.2, 0.1]) * u(0, 1)
    if kind == "haze":
        horizon = u(0.62, 0.92) * np.array([u(0.93, 1.03), 1.0, u(0.98, 1.08)])
        zenith = np.array([0.34, 0.46, 0.66]) * u(0.8, 1.3)
        return horizon, zenith, gain * 0.6 * day, gain * 0.4 * white, np.array([0.2, 0.17, 0.1]) * u(0, 1)
    if kind == "overcast":
        horizon = u(0.55, 0.88) * np.array([u(0.95, 1.0), 1.0, u(1.0, 1.06)])
        return horizon, horizon * u(0.6, 0.95), gain * u(0.55, 0.85) * day, np.zeros(3), np.zeros(3)
    if kind == "dusk":
        dim = u(0.35, 0.9)
        pink = u()
        horizon = dim * (np.array([1.0, 0.66, 0.42]) * (1 - pink) + np.array([0.86, 0.66, 0.70]) * pink)
        zenith = dim * np.array([0.32, 0.40, 0.58]) * u(0.75, 1.25)
        sun = dim * u(0.1, 0.6) * np.array([1.25, 0.95, 0.65])
        return horizon, zenith, dim * u(0.35, 0.6) * day, sun, dim * np.array([0.5, 0.28, 0.08])
    horizon = u(0.03, 0.2) * u([0.7, 0.7, 0.7], [1.4, 1.1, 1.3])
    return horizon, horizon * u(0.2, 0.7), u(0.04, 0.16) * np.array([0.85, 0.95, 1.2]), np.zeros(3), np.zeros(3)


def _ridges(rng: np.random.Generator, length: float) -> Array:
    """Rings of relief. Those nearer than any approach begins rise only beyond the runway."""
    ridges = np.zeros((_MOST_RIDGES, 5))
    grand = rng.choice([0.0, 0.15, 0.5, 1.0], p=[0.2, 0.35, 0.25, 0.2])  # from a plain to high mountains
    if grand == 0.0:
        return ridges
    near = 0.5 * length + 4500.0
    radii = np.sort(np.exp(rng.uniform(np.log(near), np.log(60e3), rng.integers(1, _MOST_RIDGES + 1))))
    for n, radius in enumerate(radii):
        height = grand * rng.uniform(0.008, 0.07) * radius * min(1.0, radius / 20e3) ** 0.5
        wavelength = height * rng.uniform(6, 16) + 500.0
        ridges[n] = radius, height, wavelength, rng.uniform(0, 1), float(radius < 0.5 * length + 12e3)
    return ridges


@shader
def air_towards(k: Any, wx: Any, wy: Any, wz: Any, low: Any, rgb: Any) -> None:
    """Colour of endless air in a direction: over ground (`low` 1), or of the sky above it (0)."""
    rise = 1.0 - math.exp(-max(0.0, wz) / k.scale)
    turn = 1.0 - (wx * k.sun[0] + wy * k.sun[1] + wz * k.sun[2])  # half the squared angle from the sun
    sun = math.exp(-2.0 * turn / (k.glow[3] * k.glow[3]))
    for c in range(3):
        above = k.horizon[c] + rise * (k.zenith[c] - k.horizon[c])
        rgb[c] = above + low * (k.airlight[c] - above) + sun * k.glow[c]


@shader
def haze(k: Any, distance: Any, air: Any, rgb: Any) -> None:
    """`rgb` seen through `distance` m of air of the colour `air`."""
    for c in range(3):
        clear = math.exp(-k.beta[c] * distance)
        rgb[c] = rgb[c] * clear + air[c] * (1.0 - clear)


@shader
def cloud(k: Any, table: Any, x: Any, y: Any, footprint: Any) -> Any:
    """Thickness of the cloud above (x, y) at its base, 0..1."""
    if k.clouds[2] <= -1.0:
        return 0.0
    shift = 0.61 * (k.seed % 1009)
    wavelength = k.clouds[1]
    return smooth_step(
        4.0 * outline(table, x + shift * wavelength, y, wavelength, 7, footprint, -k.clouds[2]) + 0.1 * k.clouds[2]
    )


@shader
def sunlit(k: Any, table: Any, x: Any, y: Any, footprint: Any) -> Any:
    """Share of the sun's light that passes the clouds to the ground at (x, y)."""
    if k.clouds[2] <= -1.0 or k.clouds[2] >= 1.0:
        return 1.0
    reach = k.clouds[0] / max(0.15, k.sun[2])
    return 1.0 - k.clouds[3] * cloud(k, table, x + reach * k.sun[0], y + reach * k.sun[1], footprint)


@shader
def shade_sky(k: Any, table: Any, origin: Any, wx: Any, wy: Any, wz: Any, pixel: Any, air: Any, rgb: Any) -> None:
    """The sky's colour in a direction above the horizon, with its clouds; `air` is scratch (3,)."""
    air_towards(k, wx, wy, wz, 0.0, rgb)
    flat = wz + 0.04
    if k.veil[0] > 0.0:
        high = fractal(table, wx / flat + 0.37 * (k.seed % 997), k.veil[1] * wy / flat, 3.0, 6, pixel / flat)
        high = k.veil[0] * smooth_step(0.35 + 0.7 * high) * smooth_step(8.0 * wz)
        for c in range(3):
            rgb[c] += high * (k.cloud_rgb[0, c] - rgb[c])
    if k.clouds[2] > -1.0 and wz > 0.002:
        along = max(100.0, k.clouds[0] - origin[2]) / wz
        x, y, footprint = origin[0] + along * wx, origin[1] + along * wy, along * pixel / math.sqrt(wz)
        thick = cloud(k, table, x, y, footprint)
        if thick > 0.0:
            body = fractal(table, x, y, 0.5 * k.clouds[1], 5, footprint)
            dark = min(1.0, max(0.0, k.clouds[4] * (0.35 * thick + 0.9 * body + 0.1)))
            for c in range(3):
                air[c] = rgb[c]
            cover = k.clouds[3] * thick
            for c in range(3):
                white = k.cloud_rgb[0, c] + dark * (k.cloud_rgb[1, c] - k.cloud_rgb[0, c])
                clear = math.exp(-0.5 * k.beta[c] * along)  # most of the way lies above the thick air
                rgb[c] += cover * clear * (white - rgb[c])


@shader
def shade_relief(
    k: Any, table: Any, origin: Any, wx: Any, wy: Any, wz: Any, reach: Any, pixel: Any, air: Any, rgb: Any
) -> None:
    """Ridges blended over `rgb` where they stand nearer than `reach` m; `air` is scratch (6,)."""
    level = math.sqrt(wx * wx + wy * wy)
    if k.ridges[0, 0] == 0.0 or level < 0.5:
        return
    hx, hy, slope = wx / level, wy / level, wz / level
    px, py = origin[0] - k.middle, origin[1]
    along, inside = px * hx + py * hy, px * px + py * py
    for back in range(_MOST_RIDGES):
        n = _MOST_RIDGES - 1 - back  # the farthest first
        radius, height = k.ridges[n, 0], k.ridges[n, 1]
        square = along * along - inside + radius * radius
        if radius == 0.0 or square <= 0.0:
            continue
        s = math.sqrt(square) - along
        z = origin[2] + s * slope
        if s <= 0.0 or s >= reach or z > 1.3 * height or z < 0.0:
            continue
        x, y = px + s * hx, py + s * hy
        # Noise around the ring, on the plane of its own scale: no seam.
        u, v = x / k.ridges[n, 2] + 31.0 * n + 0.13 * (k.seed % 887), y / k.ridges[n, 2]
        shape = outline(table, u, v, 1.4, 8, s * pixel / k.ridges[n, 2], 0.0)
        peaked = 1.0 - 2.2 * abs(shape)
        top = height * (0.55 + 0.75 * (shape + k.ridges[n, 3] * (peaked - shape - 0.5)))
        if k.ridges[n, 4] > 0.0:
            top *= smooth_step(2.0 * x / radius - 0.2)
        top -= s * s / _TWICE_EARTH_M
        cover = min(1.0, max(0.0, 0.5 + (top - z) / (s * pixel)))
        if cover <= 0.0:
            continue
        high = z + s * s / _TWICE_EARTH_M
        grain = outline(table, 2.0 * u + high / (0.3 * height), 2.0 * v + 1.7 * high / height, 0.7, 4, 0.02, 0.0)
        lit = 1.0 - (1.0 - k.shade) * smooth_step(0.5 + 2.0 * grain)
        snow = smooth_step((high + 500.0 * grain - k.snow_line) / 250.0)
        wood = smooth_step(0.9 - 1.2 * high / height + grain)
        for c in range(3):
            stone = k.rock[0, c] + wood * (k.rock[1, c] - k.rock[0, c])
            air[c] = (stone + snow * (0.86 - stone)) * lit * (k.ambient[c] + k.direct[c])
        air_towards(k, wx, wy, 0.0, 1.0, air[3:])
        haze(k, s, air[3:], air)
        for c in range(3):
            rgb[c] += cover * (air[c] - rgb[c])
