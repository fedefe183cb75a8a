"""Houses, streets, gardens, works and trees, as compiled functions: a lattice of lots in each region's orientation.

A block is a rectangle of lots with a street along two of its sides. What stands on a lot follows from
hashes of its place. A ray is followed from lot to lot (Amanatides and Woo 1987) down to the ground.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from shortfinal.scene.airfield import away
from shortfinal.scene.cover import MOTORWAY, RIVER, land_height, line_off, region
from shortfinal.scene.noise import fractal, hash01, noise, shader, smooth_step

CLEARANCE = 0.02  # slope of the plane, from the airfield's grounds, that nothing rises above

_BLOCKS = 512  # remembered, by hash
_HOUSES, _WORKS, _PARK, _OPEN = 0.0, 1.0, 2.0, 3.0
_FLAT, _GABLE, _TREE = 1.0, 2.0, 3.0


@shader
def memory() -> Any:
    """Room for what has been found out about blocks: their keys, and facts (density, kind, greatest height)."""
    return np.full(_BLOCKS, -1, np.int64), np.zeros((_BLOCKS, 3))


@shader
def _density(g: Any, table: Any, x: Any, y: Any, cx: Any, cy: Any, key: Any) -> Any:
    """How built-up (x, y) is: 0 and below outside, 1 in the middle of a town."""
    best = -1.0
    for n in range(g.towns.shape[0]):
        radius = g.towns[n, 2]
        if radius == 0.0:
            break
        dx, dy = x - g.towns[n, 0], y - g.towns[n, 1]
        out = math.sqrt(dx * dx + dy * dy) / radius
        ragged = 0.9 * (noise(table, x / 900.0, y / 900.0) - 0.5) + 0.5 * (noise(table, x / 280.0, y / 280.0) - 0.5)
        best = max(best, 1.0 - out + ragged)
    if hash01(key, 1, 21) < g.village[0]:
        dx, dy = x - cx, y - cy
        out = math.sqrt(dx * dx + dy * dy) / (130.0 + 280.0 * hash01(key, 2, 21))
        best = max(best, 0.45 * (1.0 - out))
    return best


@shader
def block(
    g: Any, a: Any, table: Any, i: Any, j: Any, key: Any, cx: Any, cy: Any, c: Any, s: Any, tags: Any, facts: Any
) -> Any:  # fmt: skip
    """Where in `facts` block (i, j) of a region is described."""
    tag = (np.int64(key) * 1000003 + np.int64(i) * 7919 + np.int64(j)) & 0x7FFFFFFFFFFFFFFF
    slot = (tag ^ (tag >> 17)) % _BLOCKS
    if tags[slot] == tag:
        return slot
    tags[slot] = tag
    wide, high = g.lot[0] * g.lot[1], g.lot[0] * g.lot[2]
    u, v = (i + 0.5) * wide, (j + 0.5) * high
    x, y = cx + c * u - s * v, cy + s * u + c * v
    corner = 0.5 * math.sqrt(wide * wide + high * high)
    clear = away(a, x, y) - corner
    density = _density(g, table, x, y, cx, cy, key) if clear > 30.0 else -1.0
    pick = hash01(i, j, key)
    kind = _HOUSES
    if density <= 0.0 and hash01(i + 5, j, key) < g.village[1]:
        density = 0.12  # a farm
    if density <= 0.0:
        kind = _OPEN
        wild = hash01(key, 9, 9) >= g.farmed
        thick = smooth_step(2.0 * noise(table, x / 400.0, y / 400.0) - 0.5)
        density = g.scrub * (1.0 if wild else 0.1) * thick
    elif density > 0.15 and (pick < g.built[2] or hash01(key, 5, 21) < 0.8 * g.built[2]):
        kind = _WORKS
    elif pick > 0.93:
        kind = _PARK
    if density > 0.0 and not _buildable(g, a, table, x, y, corner, key):
        density = 0.0
    facts[slot, 0], facts[slot, 1], facts[slot, 2] = density, kind, max(0.0, CLEARANCE * clear)
    return slot


@shader
def _buildable(g: Any, a: Any, table: Any, x: Any, y: Any, reach: Any, key: Any) -> Any:
    """Whether the ground within `reach` m is dry, off motorways and rivers, and of the region `key`."""
    return (
        land_height(g, a, table, x, y, reach) > 0.3 * reach / g.water[0]
        and line_off(g, x, y, MOTORWAY) > reach
        and line_off(g, x, y, RIVER) > reach
        and region(g, x, y)[0] == key
    )


@shader
def _tree(g: Any, i: Any, j: Any, key: Any, limit: Any, size: Any, o: Any) -> None:
    side = g.lot[0]
    radius = size * side * (0.12 + 0.2 * hash01(i, j, key + 31))
    o[0] = _TREE
    o[1] = (i + 0.5) * side + 0.3 * side * (hash01(i, j, key + 32) - 0.5)
    o[2] = (j + 0.5) * side + 0.3 * side * (hash01(i, j, key + 33) - 0.5)
    o[3] = o[4] = radius
    o[5] = min(limit, radius * (1.6 + 1.2 * hash01(i, j, key + 34)))
    o[6], o[7] = hash01(i, j, key + 35), 0.0


@shader
def _house(g: Any, i: Any, j: Any, key: Any, density: Any, limit: Any, o: Any) -> None:
    side = g.lot[0]
    large = density > 0.45 and hash01(i, j, key + 41) < 0.7 * density - 0.2
    o[0] = _FLAT if large or hash01(key, 7, 21) < 0.3 else _GABLE
    o[1] = (i + 0.5) * side + 0.12 * side * (hash01(i, j, key + 42) - 0.5)
    o[2] = (j + 0.5) * side + 0.12 * side * (hash01(i, j, key + 43) - 0.5)
    least = 0.36 if large else 0.2
    o[3] = side * (least + 0.14 * hash01(i, j, key + 44))
    o[4] = side * (least + 0.14 * hash01(i, j, key + 45))
    height = 4.0 + 3.5 * hash01(i, j, key + 46)
    if large:
        height = 6.0 + (g.built[3] - 6.0) * hash01(i, j, key + 47) * density
    o[5] = min(min(limit, g.built[3]), height)
    o[6] = hash01(i, j, key + 48)


@shader
def _works(g: Any, i: Any, bi: Any, bj: Any, key: Any, limit: Any, o: Any) -> None:
    """One or two halls that fill a block, or one and a yard."""
    side, nu, nv = g.lot[0], g.lot[1], g.lot[2]
    wide, high = side * (nu - 1.0), side * (nv - 1.0)
    cut = 0.3 + 0.4 * hash01(bi, bj, key + 51)
    first = (i - bi * nu - 1.0 + 0.5) / (nu - 1.0) < cut
    begin, end = (0.0, cut) if first else (cut, 1.0)
    half = 1.0 if first else 2.0
    o[0] = _FLAT if hash01(bi, bj, key + 52 + half) < 0.82 else 0.0
    o[1] = bi * nu * side + side + wide * 0.5 * (begin + end)
    o[2] = bj * nv * side + side + high * 0.5
    o[3] = 0.5 * wide * (end - begin) * (0.6 + 0.32 * hash01(bi, bj, key + 54 + half))
    o[4] = 0.5 * high * (0.5 + 0.4 * hash01(bi, bj, key + 56 + half))
    o[5] = min(limit, 6.0 + 6.0 * hash01(bi, bj, key + 58 + half))
    o[6] = hash01(bi, bj, key + 60 + half)


@shader
def lot(g: Any, i: Any, j: Any, bi: Any, bj: Any, key: Any, density: Any, kind: Any, limit: Any, o: Any) -> None:
    """What stands on a lot, into `o`: kind (0: nothing), centre, half sizes, height, a number for its looks."""
    o[0] = 0.0
    if density <= 0.0 or limit < 3.0:
        return
    pick = hash01(i, j, key + 3)
    if kind == _OPEN:
        if pick < density:  # scrub: smaller than what is planted
            _tree(g, i, j, key, limit, 0.3 + 0.3 * pick / density, o)
            o[7] = 1.0
        return
    if i == bi * g.lot[1] or j == bj * g.lot[2]:  # the street, with a tree now and then
        return
    if kind == _WORKS:
        _works(g, i, bi, bj, key, limit, o)
        return
    full = min(1.0, 0.3 + 2.0 * density)
    if kind == _HOUSES and pick < g.built[0] * full:
        _house(g, i, j, key, density, limit, o)
    elif pick > 1.0 - g.built[1]:
        _tree(g, i, j, key, limit, 1.0, o)


@shader
def _meet(u: Any, v: Any, lean_u: Any, lean_v: Any, top: Any, o: Any) -> Any:
    """The greatest height in 0..top at which the ray meets the object `o`, or -1; the face into o[7].

    Faces: 0 above, 1 and 2 along u, 3 and 4 along v; of a tree, none.
    """
    du, dv = u - o[1], v - o[2]
    if o[0] == _TREE:
        middle, tall = 0.55 * o[5], 0.45 * o[5]
        p, q, r = du / o[3], dv / o[3], -middle / tall
        lp, lq, lr = lean_u / o[3], lean_v / o[3], 1.0 / tall
        aa, bb, cc = lp * lp + lq * lq + lr * lr, p * lp + q * lq + r * lr, p * p + q * q + r * r - 1.0
        square = bb * bb - aa * cc
        if square <= 0.0:
            return -1.0
        z = (math.sqrt(square) - bb) / aa
        return z if z <= top + 0.5 * o[5] else -1.0
    tiny_u = lean_u if abs(lean_u) > 1e-6 else 1e-6
    tiny_v = lean_v if abs(lean_v) > 1e-6 else 1e-6
    half_u, half_v = abs(o[3] / tiny_u), abs(o[4] / tiny_v)
    zu, zv = -du / tiny_u, -dv / tiny_v
    low, high = max(0.0, max(zu - half_u, zv - half_v)), min(zu + half_u, zv + half_v)
    if low > min(high, o[5]):
        return -1.0
    if high >= o[5]:
        o[7] = 0.0
        return o[5]
    if zu + half_u < zv + half_v:
        o[7] = 1.0 if tiny_u > 0.0 else 2.0
    else:
        o[7] = 3.0 if tiny_v > 0.0 else 4.0
    return high


@shader
def walk(
    g: Any, a: Any, table: Any, u: Any, v: Any, lean_u: Any, lean_v: Any, top: Any, key: Any, cx: Any, cy: Any,
    c: Any, s: Any, tags: Any, facts: Any, o: Any,
) -> Any:  # fmt: skip
    """Height at which the ray that ends on the ground at (u, v) first meets something, or -1; what, into `o`."""
    side = g.lot[0]
    i, j = math.floor((u + lean_u * top) / side), math.floor((v + lean_v * top) / side)
    bi, bj, slot = 1 << 40, 1 << 40, 0
    for _ in range(64):
        ni, nj = math.floor(i / g.lot[1]), math.floor(j / g.lot[2])
        if ni != bi or nj != bj:
            bi, bj = ni, nj
            slot = block(g, a, table, bi, bj, key, cx, cy, c, s, tags, facts)
        lot(g, i, j, bi, bj, key, facts[slot, 0], facts[slot, 1], facts[slot, 2], o)
        if o[0] > 0.0:
            z = _meet(u, v, lean_u, lean_v, top, o)
            if z >= 0.0:
                return z
        # To the next lot on the way down.
        zu = ((i if lean_u > 0.0 else i + 1) * side - u) / lean_u if lean_u != 0.0 else -1.0
        zv = ((j if lean_v > 0.0 else j + 1) * side - v) / lean_v if lean_v != 0.0 else -1.0
        if max(zu, zv) <= 0.0:
            break
        if zu > zv:
            i += -1 if lean_u > 0.0 else 1
        else:
            j += -1 if lean_v > 0.0 else 1
    return -1.0


@shader
def _shade_object(g: Any, k: Any, table: Any, u: Any, v: Any, z: Any, su: Any, sv: Any, o: Any, rgb: Any) -> None:
    """Colour of what the ray met at (u, v, z), beside that of level ground in the same light."""
    bright = (1.0 - k.shade) / max(0.3, k.sun[2])
    if o[0] == _TREE:
        p, q, r = (u - o[1]) / o[3], (v - o[2]) / o[3], (z - 0.55 * o[5]) / (0.45 * o[5])
        facing = p * su + q * sv + 0.6 * r * k.sun[2]
        light = max(0.6, k.shade) * (1.0 + 0.25 * r) + 0.6 * bright * max(0.0, facing)
        leaf = 0.75 + 0.5 * noise(table, 0.9 * u + 3.0 * z, 0.9 * v - 2.0 * z)
        for n in range(3):
            crown = g.crowns[0, n] + o[6] * (g.crowns[1, n] - g.crowns[0, n])
            rgb[n] = light * leaf * (crown + 0.5 * o[7] * (g.wild[1, n] - crown))
        return
    light = 1.0
    if o[7] == 0.0:
        if o[0] == _GABLE:  # one slope towards the sun
            slope = 0.5 * (sv if v > o[2] else -sv) if o[3] > o[4] else 0.5 * (su if u > o[1] else -su)
            light = 0.1 + k.shade + bright * max(0.0, 0.87 * k.sun[2] + slope)
        light *= 0.92 + 0.16 * noise(table, 0.3 * u, 0.3 * v)
    else:
        facing = (su, -su, sv, -sv)[int(o[7]) - 1]
        light = 0.1 + 0.75 * k.shade + bright * max(0.0, facing)
    index = min(g.roofs.shape[0] - 1, int(g.roofs.shape[0] * o[6]))
    for n in range(3):
        colour = g.roofs[index, n] * (0.8 + 0.4 * (7.0 * o[6] % 1.0))
        wall = g.walls[0, n] + (13.0 * o[6] % 1.0) * (g.walls[1, n] - g.walls[0, n])
        rgb[n] = min(1.35, light) * (colour if o[7] == 0.0 else wall)


@shader
def _streets(g: Any, table: Any, u: Any, v: Any, kind: Any, density: Any, footprint: Any, rgb: Any) -> None:
    """Gardens or yards, and the streets between the blocks."""
    side = g.lot[0]
    nu, nv = side * g.lot[1], side * g.lot[2]
    pu, pv = u - nu * math.floor(u / nu), v - nv * math.floor(v / nv)
    off, half = min(abs(pu - 0.5 * side), abs(pv - 0.5 * side)), g.lot[3]
    hard = 1.0 if kind == _WORKS else 0.0 if kind == _PARK else min(0.8, density)
    green = 1.0 + 0.8 * fractal(table, u, v, 30.0, 4, footprint)
    hard = smooth_step(2.0 * hard - 0.5 + 0.8 * fractal(table, u + 50.0, v, 45.0, 3, footprint))
    road = min(1.0, max(0.0, (half - off) / footprint + 0.5)) * min(1.0, 2.0 * half / footprint)
    path = min(1.0, max(0.0, (half + 2.0 - off) / footprint + 0.5)) * min(1.0, 2.0 * half / footprint)
    for n in range(3):
        rgb[n] = green * (g.yards[0, n] + hard * (g.yards[1, n] - g.yards[0, n]))
        rgb[n] += 0.6 * path * (1.15 * g.yards[1, n] - rgb[n])
        rgb[n] += road * (0.95 * g.road_rgb[n] - rgb[n])


@shader
def town(
    g: Any, a: Any, k: Any, table: Any, x: Any, y: Any, lean_x: Any, lean_y: Any, ceiling: Any, short: Any,
    footprint: Any, key: Any, cx: Any, cy: Any, c: Any, s: Any, tags: Any, facts: Any, o: Any, rgb: Any,
) -> Any:  # fmt: skip
    """Town at (x, y), or what hides it, into `rgb`. Returns 0 in open country, 1 in its shadow, above for the rest."""
    u, v = c * (x - cx) + s * (y - cy), c * (y - cy) - s * (x - cx)
    lean_u, lean_v = c * lean_x + s * lean_y, c * lean_y - s * lean_x
    su, sv = c * k.sun[0] + s * k.sun[1], c * k.sun[1] - s * k.sun[0]
    side = g.lot[0]
    near = short < 3.0
    top = min(g.built[3], ceiling) if near else 0.0
    z = walk(g, a, table, u, v, lean_u, lean_v, top, key, cx, cy, c, s, tags, facts, o)
    if z >= 0.0:
        _shade_object(g, k, table, u + lean_u * z, v + lean_v * z, z, su, sv, o, rgb)
        return 2 + int(97 * o[6]) + 100 * int(o[7])
    wide, high = side * g.lot[1], side * g.lot[2]
    slot = block(g, a, table, math.floor(u / wide), math.floor(v / high), key, cx, cy, c, s, tags, facts)
    density, kind = facts[slot, 0], facts[slot, 1]
    built = density > 0.0 and kind != _OPEN
    if built:
        _streets(g, table, u, v, kind, density, footprint, rgb)
        far = smooth_step(footprint / side - 0.6)  # houses smaller than a pixel melt together
        if far > 0.0:
            roofs = g.built[0] * min(1.0, 0.3 + 2.0 * density) * 0.35
            for n in range(3):
                mean = 0.2 * (g.roofs[0, n] + g.roofs[1, n] + g.roofs[2, n] + g.roofs[3, n] + g.roofs[4, n])
                rgb[n] += far * roofs * (mean - rgb[n])
    if near and k.shade < 0.95:
        reach = min(g.built[3], 5.0 * side * k.sun[2])
        if walk(g, a, table, u, v, su / k.sun[2], sv / k.sun[2], reach, key, cx, cy, c, s, tags, facts, o) > 0.05:
            if built:
                for n in range(3):
                    rgb[n] *= k.shade
            return 3 if built else 1
    return 4 if built else 0


@shader
def lamps(
    g: Any, a: Any, table: Any, x: Any, y: Any, footprint: Any, tags: Any, facts: Any
) -> Any:  # fmt: skip
    """Street lamps of the town at (x, y) as seen by a pixel, 0..1."""
    key, cx, cy, c, s, _ = region(g, x, y)
    u, v = c * (x - cx) + s * (y - cy), c * (y - cy) - s * (x - cx)
    wide, high = g.lot[0] * g.lot[1], g.lot[0] * g.lot[2]
    slot = block(g, a, table, math.floor(u / wide), math.floor(v / high), key, cx, cy, c, s, tags, facts)
    if facts[slot, 0] <= 0.0 or facts[slot, 1] == _OPEN:
        return 0.0
    spacing = g.lamps[3]
    while spacing < 1.5 * footprint:
        spacing *= 2.0
    i, j = math.floor(u / spacing), math.floor(v / spacing)
    du = u / spacing - i - 0.2 - 0.6 * hash01(i, j, key + 71)
    dv = v / spacing - j - 0.2 - 0.6 * hash01(i, j, key + 72)
    radius = max(1.5, 0.7 * footprint)
    if (du * du + dv * dv) * spacing * spacing > radius * radius:
        return 0.0
    many = spacing / g.lamps[3]
    return min(1.0, (0.3 + 2.0 * facts[slot, 0]) * many * many * 9.0 / (radius * radius))
