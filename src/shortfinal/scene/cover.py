"""What covers open country, as compiled functions of a place: fields, wild ground, woods, water, roads, rivers.

`g` is the record of a `Land`, `a` that of the airfield, `k` that of the sky; colours go out by `rgb`.
`footprint` is the size of the pixel on the ground, m: what is finer is faded out.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from shortfinal.scene.airfield import away
from shortfinal.scene.noise import fractal, hash01, noise, outline, shader, smooth_step, turf

ROAD, MOTORWAY, RIVER = 1, 2, 3


@shader
def region(g: Any, x: Any, y: Any) -> Any:
    """The region (x, y) lies in: key, centre, cosine and sine of its orientation, distance to its border.

    Regions are the cells about a jittered lattice's points (Worley 1996).
    """
    gx, gy = x / g.region, y / g.region
    i0, j0 = math.floor(gx), math.floor(gy)
    best, second, key, cx, cy = 1e9, 1e9, 0, 0.0, 0.0
    for i in range(int(i0) - 1, int(i0) + 2):
        for j in range(int(j0) - 1, int(j0) + 2):
            px, py = i + 0.1 + 0.8 * hash01(i, j, g.seed), j + 0.1 + 0.8 * hash01(i, j, g.seed + 1)
            square = (px - gx) * (px - gx) + (py - gy) * (py - gy)
            if square < best:
                second, best, key, cx, cy = best, square, 7919 * i + 104729 * j + g.seed, px, py
            elif square < second:
                second = square
    turn = g.heading[0] + g.heading[1] * (hash01(key, 1, 2) - 0.5)
    edge = 0.5 * g.region * (math.sqrt(second) - math.sqrt(best))
    return key, cx * g.region, cy * g.region, math.cos(turn), math.sin(turn), edge


@shader
def _cut(at_m: Any, length: Any, share: Any) -> Any:
    """The part of a length, cut at a share of it, with `at_m` in it: how far in, how long, if the second."""
    if at_m < share * length:
        return at_m, length * share, 0
    return at_m - share * length, length * (1.0 - share), 1


@shader
def _parcel(g: Any, u: Any, v: Any, key: Any) -> Any:
    """The parcel at (u, v) of a region: its key, the distance to its edge, whether it runs along v, the way across."""
    wide = g.parcel[0] * (0.6 + 0.8 * hash01(key, 3, 5))
    high = g.parcel[0] * (0.6 + 0.8 * hash01(key, 4, 5))
    i = math.floor(u / wide)
    slide = high * hash01(i, key, 6)
    j = math.floor((v + slide) / high)
    p, q = u - i * wide, v + slide - j * high
    key = np.int64(key) * 31 + np.int64(i) * 1009 + np.int64(j) * 9176
    stretch = g.parcel[2]
    for level in range(int(g.parcel[1])):
        pick = hash01(key, level, 7)
        if level > 1 and pick < 0.12:
            break
        at = 0.3 + 0.4 * hash01(key, level, 8)
        if wide * stretch > high:
            p, wide, second = _cut(p, wide, at)
            key = 2 * key + 1 + second
        else:
            q, high, second = _cut(q, high, at)
            key = 2 * key + 3 + second
    edge = min(min(p, wide - p), min(q, high - q))
    along = wide < high
    return key, edge, p if along else q, min(wide, high)


@shader
def wood(g: Any, table: Any, x: Any, y: Any, footprint: Any) -> Any:
    """Above 0 in the woods."""
    if g.wood[1] >= 2.0:
        return -1.0
    return outline(table, x + g.origin[1], y + g.origin[0], g.wood[0], 7, footprint, g.wood[1])


@shader
def land_height(g: Any, a: Any, table: Any, x: Any, y: Any, footprint: Any) -> Any:
    """Above 0 on dry land, in lengths of the coast's wavelength; the airfield's own ground is dry."""
    if g.water[1] <= -9.0:
        return 1.0
    clear = away(a, x, y)
    dry = 2.0 * max(0.0, 1.0 - clear / g.water[5])
    level = g.water[1] + g.water[2] * x + g.water[3] * y - dry
    # The noise bends the airfield's shore as well: the pull to dry land is no straight line.
    return outline(table, x + g.origin[0], y + g.origin[1], g.water[0], 9, footprint, level)


@shader
def open_country(
    g: Any,
    table: Any,
    x: Any,
    y: Any,
    key: Any,
    cx: Any,
    cy: Any,
    c: Any,
    s: Any,
    border: Any,
    footprint: Any,
    rgb: Any,
) -> Any:
    """Fields or wild ground into `rgb`; the parcel's key."""
    grown = g.relief * turf(table, x, y, footprint)
    if hash01(key, 9, 9) >= g.farmed:
        patch = smooth_step(0.5 + 1.6 * outline(table, x + 900.0, y, 700.0, 8, footprint, 0.0))
        bare = smooth_step(5.0 * outline(table, x, y + 700.0, 190.0, 7, footprint, 0.1))
        for n in range(3):
            rgb[n] = g.wild[0, n] + patch * (g.wild[1, n] - g.wild[0, n])
            rgb[n] = (1.0 + grown) * (rgb[n] + 0.8 * bare * (g.wild[2, n] - rgb[n]))
        off = 450.0 * abs(outline(table, x + 300.0, y + 500.0, 900.0, 5, footprint, 0.0))  # a track, m off
        cover = min(1.0, max(0.0, (1.5 - off) / footprint + 0.5)) * min(1.0, 2.0 / footprint)
        for n in range(3):
            rgb[n] += 0.7 * cover * (g.hedge[2 + n] - rgb[n])
        return 0
    u, v = c * (x - cx) + s * (y - cy), c * (y - cy) - s * (x - cx)
    parcel, edge, across, breadth = _parcel(g, u, v, key)
    edge = min(edge, border)
    pick = hash01(parcel, 1, 11)
    tone = (1.0 + (0.25 + 0.5 * hash01(parcel, 5, 11)) * grown) * (0.78 + 0.44 * hash01(parcel, 2, 11))
    if pick < g.wood[3]:
        for n in range(3):
            rgb[n] = g.crowns[0, n] * (1.0 + grown)
        return parcel
    index = int(8.0 * math.pow(hash01(parcel, 3, 11), 1.4))
    rows = g.tillage * min(1.0, max(0.0, 3.0 / footprint - 0.5))
    if rows > 0.0:
        tone *= 1.0 + rows * math.sin(across * (1.1 + 1.2 * pick)) * (0.4 + pick)
    lanes = min(1.0, 2.0 / footprint)  # wheel tracks every 24 m or so
    if pick > 0.4 and across % (18.0 + 10.0 * pick) < 1.2 + 0.5 * footprint:
        tone *= 1.0 + 1.5 * g.tillage * lanes * (1.0 if pick > 0.6 else -1.0)
    melt = smooth_step(1.3 * footprint / breadth - 0.3)  # parcels smaller than a pixel melt together
    for n in range(3):
        own = g.fields[index, n] * tone
        mean = 0.4 * g.fields[0, n] + 0.35 * g.fields[1, n] + 0.25 * g.fields[2, n]
        rgb[n] = own + 0.8 * melt * (mean - own)
    half = g.hedge[0]
    cover = min(1.0, max(0.0, (half - edge) / footprint + 0.5)) * min(1.0, 2.0 * half / footprint)
    if cover > 0.0:
        planted = hash01(parcel, 4, 11) < g.hedge[1]
        for n in range(3):
            line = g.crowns[0, n] if planted else g.hedge[2 + n]
            rgb[n] += 0.8 * cover * (line - rgb[n])
    return parcel


@shader
def crowns(g: Any, k: Any, table: Any, x: Any, y: Any, footprint: Any, rgb: Any) -> None:
    """The canopy from above: crowns with a bright and a dark side."""
    kind = smooth_step(0.5 + 2.0 * outline(table, x, y, 420.0, 5, footprint, 0.0))
    bump = 0.0
    if footprint < 9.0:
        dx, dy = 0.45 * k.sun[0], 0.45 * k.sun[1]
        fade = 1.0 - footprint / 9.0
        bump = fade * (noise(table, x / 7.0, y / 7.0) - noise(table, x / 7.0 + dx, y / 7.0 + dy))
    tone = 1.0 + 0.8 * bump + 0.55 * fractal(table, x, y, 45.0, 4, footprint)
    for n in range(3):
        rgb[n] = tone * (g.crowns[0, n] + kind * (g.crowns[1, n] - g.crowns[0, n]))


@shader
def water(g: Any, k: Any, table: Any, x: Any, y: Any, height: Any, grazing: Any, footprint: Any, rgb: Any) -> None:
    """Sea or lake, `height` below the shore, seen at `grazing` (sine of the angle to the surface)."""
    out = -height * g.water[0] * 1.2  # m from the shore, roughly
    broad = g.shore[0] * (0.3 + 1.4 * noise(table, x / 600.0, y / 600.0))
    shallow = math.exp(-out / broad) * (0.75 + 0.9 * fractal(table, x, y, 120.0, 5, footprint))
    shallow = min(1.0, max(0.0, shallow))
    ripple = 1.0 + 0.12 * fractal(table, x, y, 500.0, 6, footprint)
    mirror = g.shore[3] * math.pow(1.0 - grazing, 6.0)  # rather than Fresnel's fifth power: waves
    surf = 0.0
    if g.shore[2] > 0.0:
        at = out / (4.0 + 14.0 * noise(table, x / 90.0, y / 90.0))
        surf = g.shore[2] * math.exp(-at * at) * smooth_step(0.6 + 2.0 * fractal(table, x, y, 25.0, 3, footprint))
    for n in range(3):
        deep = g.water_rgb[0, n] + shallow * (g.water_rgb[1, n] - g.water_rgb[0, n])
        deep += mirror * (0.8 * k.horizon[n] - deep)
        rgb[n] = deep * ripple + surf * (0.85 - deep)


@shader
def line_off(g: Any, x: Any, y: Any, kind: Any) -> Any:
    """Distance of (x, y) from the edge of the nearest line of a kind, m, negative on it."""
    best = 1e9
    for n in range(g.lines.shape[0]):
        if int(g.lines[n, 0]) == kind:
            best = min(best, _curve(g, n, x, y)[0] - g.lines[n, 11])
    return best


@shader
def _curve(g: Any, n: Any, x: Any, y: Any) -> Any:
    """Distance of (x, y) from a line's middle, to first order, and how far along it that is."""
    dx, dy = x - g.lines[n, 1], y - g.lines[n, 2]
    u, v = g.lines[n, 3] * dx + g.lines[n, 4] * dy, g.lines[n, 3] * dy - g.lines[n, 4] * dx
    far = abs(v) - g.lines[n, 5] - g.lines[n, 8]
    if far > 1000.0:
        return far, u
    p, q = g.lines[n, 6] * u + g.lines[n, 7], g.lines[n, 9] * u + g.lines[n, 10]
    slope = g.lines[n, 5] * g.lines[n, 6] * math.cos(p) + g.lines[n, 8] * g.lines[n, 9] * math.cos(q)
    return abs(v - g.lines[n, 5] * math.sin(p) - g.lines[n, 8] * math.sin(q)) / math.sqrt(1.0 + slope * slope), u


@shader
def lines(g: Any, table: Any, x: Any, y: Any, footprint: Any, rgb: Any) -> Any:
    """Roads, motorways and rivers over `rgb`; the kind of the last."""
    found = 0
    for n in range(g.lines.shape[0]):
        kind = int(g.lines[n, 0])
        if kind == 0:
            break
        half = g.lines[n, 11]
        verge = 1.7 * half
        off, u = _curve(g, n, x, y)
        if off > 1.3 * verge + 0.5 * footprint:
            continue
        if kind == RIVER:
            half *= 0.7 + 0.6 * noise(table, u / 180.0, n + 0.5)
        if off > verge + 0.5 * footprint:
            continue
        found = kind
        beside = min(1.0, max(0.0, (verge - off) / footprint + 0.5)) * min(1.0, 2.0 * verge / footprint)
        cover = min(1.0, max(0.0, (half - off) / footprint + 0.5)) * min(1.0, 2.0 * half / footprint)
        if kind == MOTORWAY:  # two carriageways and a median
            median = min(1.0, max(0.0, (0.16 * half - off) / footprint + 0.5)) * min(1.0, 0.3 * half / footprint)
            cover *= 1.0 - 0.8 * median
            line = abs(off - 0.58 * half)
            lane = 1.0 + 0.25 * max(0.0, 1.0 - line / 0.5) * min(1.0, 0.5 / footprint)
        else:
            lane = 1.0
        for c in range(3):
            bank = g.crowns[0, c] if kind == RIVER else 0.6 * g.hedge[2 + c] + 0.4 * g.wild[1, c]
            water = g.water_rgb[0, c] + 0.25 * (g.water_rgb[1, c] - g.water_rgb[0, c])
            rgb[c] += 0.6 * beside * (bank - rgb[c])
            rgb[c] += cover * ((water if kind == RIVER else g.road_rgb[c] * lane) - rgb[c])
    return found
