"""The land around an airfield: fields, wild ground, woods, water, roads, rivers, towns.

All of it is a function of the place alone, evaluated where a ray meets the ground z = 0, so that any
camera at any resolution sees the same land. What has height is looked for along the last of the ray.
It keeps below a plane that rises 1 in 50 from the airfield's grounds, lest it hides the runway.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shortfinal.scene.airfield import Airfield, away
from shortfinal.scene.cover import MOTORWAY, RIVER, ROAD, crowns, land_height, lines, open_country, region, water, wood
from shortfinal.scene.noise import noise, packed, shader, smooth_step
from shortfinal.scene.town import CLEARANCE, town

Array = NDArray[np.float64]

_MOST_LINES, _MOST_TOWNS = 10, 5  # fixed, so that every land has one compiled layout


class Land(NamedTuple):
    """What covers the ground. Lengths in metres, colours as in the picture by daylight, 0..1."""

    seed: int
    origin: Array  # (2,) where in the noise
    # open country
    fields: Array  # (8, 3) crops and soils, the commonest first
    wild: Array  # (3, 3) uncultivated ground
    farmed: float  # share of the regions under the plough
    region: float  # size of regions of one orientation
    heading: Array  # (2,) orientation, and how far regions turn from it, rad
    parcel: Array  # (3,) largest size, splits, elongation
    hedge: Array  # (5,) half width of parcel edges, share of hedges (else tracks), track r, g, b
    tillage: float  # contrast of rows and tramlines
    relief: float  # contrast of the ground's texture
    # woods
    wood: Array  # (4,) wavelength, level (1: none), height, share of parcels
    crowns: Array  # (2, 3) colours
    # water
    water: Array  # (6,) wavelength, level (-9: none), tilt's x, y per m, ragged, reach of the airfield's own ground
    water_rgb: Array  # (3, 3) deep, shallow, shore
    shore: Array  # (4,) width of shallows, width of the shore, surf, gloss
    # lines
    lines: Array  # (10, 12) kind (0: none), x, y, cosine, sine, two sines (amplitude, wave number, phase), half width
    road_rgb: Array  # (3,)
    # towns
    towns: Array  # (5, 3) x, y, radius (0: none)
    village: Array  # (2,) share of farmed regions with one, share of blocks with a farm
    lot: Array  # (4,) side, lots to a block along and across, half width of the streets
    built: Array  # (4,) share of lots with a house, with a tree, of industrial blocks, greatest height
    scrub: float  # share of lots with a bush or tree in wild country
    roofs: Array  # (6, 3)
    walls: Array  # (2, 3) darkest and brightest
    yards: Array  # (2, 3) gardens, industrial ground
    lamps: Array  # (4,) r, g, b at night; spacing


# What the country is like (open, farm, town, wood), by climate.
_SETTINGS = {
    "temperate": [0.1, 0.5, 0.27, 0.13], "autumn": [0.1, 0.5, 0.25, 0.15], "dry": [0.25, 0.45, 0.27, 0.03],
    "desert": [0.65, 0.1, 0.25, 0.0], "tundra": [0.5, 0.1, 0.3, 0.1], "winter": [0.3, 0.3, 0.2, 0.2],
    "tropical": [0.12, 0.33, 0.3, 0.25],
}  # fmt: skip

# Colours by climate: eight of fields, the commonest first; three of wild ground; two of crowns.
_CLIMATES = {
    "temperate": (
        "424e3a 565840 685a4a 3a4634 544a40 586644 88785e 706850",
        "505a3e 605e46 424c36",
        "2e3a28 3c462e",
    ),
    "autumn": (
        "625446 544c42 766852 585840 4c463e 84745c 4a523a 6e5c48",
        "665e48 585240 726850",
        "484230 584a32",
    ),
    "dry": (
        "8e7c60 7a6a54 686248 9e8c70 866a54 5a5a42 ac9a7e 50543c",
        "807258 6c644c 928266",
        "424632 52523c",
    ),
    "desert": (
        "a89274 988268 b49e80 8c7a64 5a6246 a08a70 7e6e5c 686a4e",
        "ac9678 948068 bea88a",
        "5c5c46 6c6852",
    ),
    "tundra": (
        "62664c 5c5e46 6e6a54 505a3e 685c4e 585644 787460 4a543c",
        "5e5846 50543e 685648",
        "323a2c 404432",
    ),
    "winter": (
        "ced2d8 c0c4ca d8dbe0 b2b5ba c8ccd2 969492 dee0e4 a4a3a2",
        "ccd0d6 babdc2 d6d9de",
        "464a4a 585854",
    ),
    "tropical": (
        "485836 54623c 3e4e30 686846 765e48 5c563c 4e5c3e 7c7254",
        "4e5c3a 5c6242 6a6046",
        "304028 3a4a2e",
    ),
}


class Climate(NamedTuple):
    """The colours of a kind of country, 0..1."""

    name: str
    fields: Array  # (8, 3)
    wild: Array  # (3, 3)
    crowns: Array  # (2, 3)

    @property
    def rock(self) -> Array:
        """Colours of the relief (2, 3): stone, and the slopes below it."""
        stone = 0.5 * self.wild[0] + 0.5 * np.array([0.44, 0.40, 0.36])
        return np.array([stone, 0.5 * (self.crowns[0] + self.wild[1])])


def random_climate(rng: np.random.Generator) -> Climate:
    """A kind of country, its colours somewhat changed."""
    names, shares = list(_CLIMATES), [0.30, 0.13, 0.16, 0.11, 0.12, 0.07, 0.11]
    name = str(rng.choice(names, p=shares))
    gain, tint = np.exp(rng.normal(-0.12 if name == "winter" else 0.14, 0.13)), rng.normal(0, 0.025, 3)
    grey = rng.uniform(-0.05, 0.5)  # less or more of the colour taken out

    def vary(colours: str) -> Array:
        plain = np.array([list(bytes.fromhex(colour)) for colour in colours.split()]) / 255.0
        rgb = plain * gain * (1 + tint) + rng.normal(0, 0.012, plain.shape)
        return np.asarray(np.clip(rgb + grey * (rgb.mean(axis=1, keepdims=True) - rgb), 0.03, 0.95))

    fields, wild, crowns = _CLIMATES[name]
    return Climate(name, vary(fields), vary(wild), vary(crowns))


def random_land(rng: np.random.Generator, climate: Climate, airfield: Airfield) -> Land:
    """Random land of that climate, laid out around the airfield."""
    u = rng.uniform
    setting = str(rng.choice(["open", "farm", "town", "wood"], p=_SETTINGS[climate.name]))
    farmed = {"farm": u(0.8, 1.0), "town": u(0.3, 0.9), "wood": u(0.1, 0.5), "open": u(0, 0.2)}[setting]
    kind = str(rng.choice(["none", "sea", "lakes"], p=[0.52, 0.3, 0.18]))
    level = {"wood": u(-0.12, 0.1), "town": u(0.12, 0.4)}.get(setting, u(0.1, 0.6))
    treeless = climate.name in ("desert", "tundra") and rng.random() < 0.7
    asphalt = u(0.27, 0.5) + rng.normal(0, 0.01, 3)
    track = climate.wild[2] * 0.4 + 0.6 * np.array([0.58, 0.53, 0.45]) * u(0.7, 1)
    spread = u(0, 1.6) if rng.random() < 0.8 else 0.0
    return Land(
        seed=int(rng.integers(0, 2**30)),
        origin=u(0, 1e5, 2),
        fields=climate.fields[rng.permutation(8)] if rng.random() < 0.4 else climate.fields,
        wild=climate.wild,
        farmed=farmed,
        region=u(900, 2600),
        heading=np.array([u(0, math.pi), spread]),
        parcel=np.array([u(350, 1000), rng.integers(2, 7), math.exp(rng.normal(0, 0.7))]),
        hedge=np.array([u(1.5, 5.0), u(0, 1), *track]),
        tillage=u(0, 0.12),
        relief=u(0.25, 0.65),
        wood=np.array([u(400, 2600), 2.0 if treeless else level, u(9, 22), 0.0 if treeless else u(0, 0.14)]),
        crowns=climate.crowns,
        **_random_water(rng, kind, climate, airfield),
        lines=_random_lines(rng, airfield, setting),
        road_rgb=np.clip(asphalt, 0.1, 0.8),
        **_random_towns(rng, setting, climate, airfield),
    )  # fmt: skip


def _random_water(rng: np.random.Generator, kind: str, climate: Climate, airfield: Airfield) -> dict[str, Any]:
    u = rng.uniform
    bearing = u(0, 2 * math.pi) if rng.random() < 0.5 else math.pi + rng.normal(0, 0.5)  # often before the threshold
    slope = math.exp(u(math.log(3e-5), math.log(3e-4))) if kind == "sea" else 0.0
    level = {"none": -9.0, "sea": u(-0.25, 0.15), "lakes": u(-0.34, -0.16)}[kind]
    wavelength = u(1500, 7000) if kind == "sea" else u(900, 3500)
    deep = np.array([0.05, 0.075, 0.12]) * math.exp(rng.normal(-0.3, 0.5)) + np.array([0, u(0, 0.03), u(0, 0.04)])
    if climate.name == "winter" and kind == "lakes":
        deep = np.array([0.72, 0.74, 0.77])  # frozen
    shallow = np.array([u(0.12, 0.3), u(0.13, 0.34), u(0.13, 0.34)])
    sand = np.array([0.60, 0.54, 0.44]) * u(0.5, 1.1) if rng.random() < 0.5 else climate.wild[2] * u(0.6, 1.0)
    return {
        "water": np.array([
            wavelength, level, slope * math.cos(bearing), slope * math.sin(bearing),
            0.0 if kind == "lakes" else u(0, 1), math.exp(u(math.log(60), math.log(900))),
        ]),
        "water_rgb": np.array([deep, 0.6 * deep + 0.4 * shallow, sand]),
        "shore": np.array([u(10, 220), u(4, 45), u(0, 0.6) * (kind == "sea" and rng.random() < 0.5),
                           u(0, 0.7) if rng.random() < 0.5 else 0.0]),
    }  # fmt: skip


def _random_lines(rng: np.random.Generator, airfield: Airfield, setting: str) -> Array:
    """Roads, motorways and rivers that bend, and keep off the airfield's grounds."""
    lines = np.zeros((_MOST_LINES, 12))
    record, found = packed(airfield), 0
    kinds = [MOTORWAY] * int(rng.random() < 0.55) + [RIVER] * int(rng.random() < 0.3)
    kinds += [ROAD] * int(rng.integers(2 if setting == "farm" else 1, _MOST_LINES - 2))
    along = np.linspace(-9e3, 9e3, 400)
    for kind in kinds:
        half = {ROAD: rng.uniform(2.5, 6), MOTORWAY: rng.uniform(11, 19), RIVER: math.exp(rng.uniform(1.6, 4.5))}[kind]
        for _ in range(8):
            angle = rng.uniform(0, math.pi)
            at = np.array([rng.uniform(-7000, airfield.length + 4000), rng.uniform(-3500, 3500)])
            long, short = rng.uniform(1200, 6000), rng.uniform(250, 1200)
            bends = [long * rng.uniform(0, 0.14), 2 * math.pi / long, rng.uniform(0, 6.3),
                     short * rng.uniform(0, {ROAD: 0.05, MOTORWAY: 0.05, RIVER: 0.22}[kind]), 2 * math.pi / short,
                     rng.uniform(0, 6.3)]  # fmt: skip
            aside = bends[0] * np.sin(bends[1] * along + bends[2]) + bends[3] * np.sin(bends[4] * along + bends[5])
            c, s = math.cos(angle), math.sin(angle)
            if _off_grounds(record, at[0] + c * along - s * aside, at[1] + s * along + c * aside, 40.0 + 2 * half):
                lines[found] = kind, *at, c, s, *bends, half
                found += 1
                break
    return lines


def _random_towns(rng: np.random.Generator, setting: str, climate: Climate, airfield: Airfield) -> dict[str, Any]:
    u = rng.uniform
    towns = np.zeros((_MOST_TOWNS, 3))
    count = int(rng.integers(2, _MOST_TOWNS + 1) if setting == "town" else rng.integers(0, 3))
    for n in range(count):
        large = setting == "town" and n == 0
        at = [u(-7000, airfield.length + 6000), u(-1, 1) * (1500 if large else 3500)]
        towns[n] = *at, (math.exp(u(7.6, 8.8)) if large else math.exp(u(6.2, 7.8)))
    warm = climate.name in ("dry", "desert", "tropical") or rng.random() < 0.4
    tiles = np.array([[0.50, 0.34, 0.27], [0.56, 0.42, 0.34]]) * u(0.75, 1.1)
    greys = np.array([[0.34, 0.34, 0.35], [0.45, 0.45, 0.46], [0.62, 0.62, 0.62], [0.76, 0.75, 0.73]]) * u(0.85, 1.2)
    pale = np.array([[0.66, 0.60, 0.52], [0.74, 0.70, 0.63]])
    roofs = np.concatenate([tiles if warm else greys[:2], greys[1:3], pale if climate.name == "desert" else greys[2:]])
    if climate.name == "winter":
        roofs = 0.3 * roofs + 0.6
    odd = rng.random((6, 1)) < 0.12  # a coloured roof
    roofs = np.where(odd, 0.4 + u(-0.14, 0.14, (6, 3)), roofs) + rng.normal(0, 0.02, (6, 3))
    tall = u(7, 12) if rng.random() < 0.8 else u(14, 24)
    return {
        "towns": towns,
        "village": np.array([u(0, 0.7), u(0, 0.05)]),
        "lot": np.array([u(15, 25), rng.integers(5, 10), rng.integers(3, 6), u(3, 5)]),
        "built": np.array([u(0.5, 0.8), u(0.03, 0.35), u(0.02, 0.25), tall]),
        "scrub": u(0, 0.5) * (rng.random() < 0.6),
        "roofs": np.clip(roofs, 0.05, 0.92),
        "walls": np.array([np.array([0.34, 0.32, 0.30]), np.array([0.74, 0.71, 0.66])]) * u(0.85, 1.15),
        "yards": np.array([
            climate.wild[0] * 0.6 + climate.crowns[0] * 0.4, np.array([0.44, 0.43, 0.42]) * u(0.75, 1.2)
        ]),
        "lamps": np.array([1.0, u(0.6, 0.95), u(0.25, 0.9), u(30, 60)]),
    }  # fmt: skip


def _off_grounds(record: NDArray[np.void], x: Array, y: Array, margin: float) -> bool:
    """Whether all points lie further than `margin` m outside the airfield's grounds."""
    return bool(_nearest(record, x, y) > margin)


@shader
def _nearest(record: Any, x: Any, y: Any) -> Any:
    best = math.inf
    for n in range(x.shape[0]):
        best = min(best, away(record[0], x[n], y[n]))
    return best


@shader
def land(
    g: Any, a: Any, k: Any, table: Any, x: Any, y: Any, lean_x: Any, lean_y: Any, ceiling: Any, grazing: Any,
    short: Any, footprint: Any, tags: Any, facts: Any, o: Any, rgb: Any,
) -> Any:  # fmt: skip
    """The land's colour into `rgb`, where a ray meets the ground at (x, y); a number that tells covers apart.

    The ray was at (x + lean_x h, y + lean_y h) at height h, and came from above the height `ceiling`.
    `short` is the pixel's size across the ray, m; `tags`, `facts`, `o` (8,) are scratch (`memory`).
    """
    clear = away(a, x, y)
    tall = min(g.wood[2], min(CLEARANCE * clear, ceiling))
    if tall > 2.0:
        px, py = x + lean_x * tall, y + lean_y * tall
        free = CLEARANCE * away(a, px, py) >= tall
        if free and wood(g, table, px, py, footprint) > 0.0 and land_height(g, a, table, px, py, footprint) > 0.0:
            crowns(g, k, table, px, py, footprint, rgb)
            return 1
    height = land_height(g, a, table, x, y, footprint)
    if height < 0.0:
        water(g, k, table, x, y, height, grazing, footprint, rgb)
        return 2
    key, cx, cy, c, s, border = region(g, x, y)
    found = town(
        g, a, k, table, x, y, lean_x, lean_y, ceiling, short, footprint, key, cx, cy, c, s, tags, facts, o, rgb
    )
    if found >= 2 and found != 4:
        return 10 + found
    if found != 4:
        dark = found == 1
        found = 1000 + open_country(g, table, x, y, key, cx, cy, c, s, border, footprint, rgb)
        if tall > 2.0:
            if wood(g, table, x, y, footprint) > 0.0:  # its side
                for n in range(3):
                    rgb[n] = 0.6 * g.crowns[0, n]
                return 3
            if k.shade < 0.95:
                reach = 0.8 * tall / k.sun[2]
                dark = dark or wood(g, table, x + reach * k.sun[0], y + reach * k.sun[1], footprint) > 0.0
        if dark:
            found += 5
            for n in range(3):
                rgb[n] *= k.shade
    if clear > 10.0:
        found += lines(g, table, x, y, footprint, rgb)
    shore = height * g.water[0] * 1.2 / g.shore[1]
    if g.water[1] > -9.0 and shore < 2.0:
        bank = 1.0 - smooth_step(shore + 1.2 * (noise(table, x / 40.0, y / 40.0) - 0.5))
        for n in range(3):
            rgb[n] += bank * (g.water_rgb[2, n] - rgb[n])
    return found
