import math

import numpy as np
import pytest

import shortfinal as sf
from shortfinal.scene import cover, town
from shortfinal.scene.airfield import away
from shortfinal.scene.land import random_climate, random_land
from shortfinal.scene.noise import noise, noise_table, outline, packed
from shortfinal.scene.render import random_scene
from shortfinal.scene.sky import haze, random_sky

TABLE = noise_table()
RUNWAY = sf.Runway(2000, 45)


class Ground:
    """A scene's land as its kernels see it, at places."""

    def __init__(self, seed, **changes):
        scene = random_scene(np.random.default_rng(seed), RUNWAY)
        self.airfield, self.land = scene.airfield, scene.land._replace(**changes)
        self.a, self.l = packed(scene.airfield)[0], packed(self.land)[0]
        self.tags, self.facts = town.memory()
        self.object = np.zeros(8)

    def walk(self, x, y, lean_x=0.0, lean_y=0.0, top=50.0):
        """Height at which a ray that ends on the ground at (x, y) meets something in the region of (x, y), or -1."""
        key, cx, cy, c, s, _ = cover.region(self.l, x, y)
        return self.walk_in(key, cx, cy, c, s, x, y, lean_x, lean_y, top)

    def walk_in(self, key, cx, cy, c, s, x, y, lean_x=0.0, lean_y=0.0, top=50.0):
        u, v = c * (x - cx) + s * (y - cy), c * (y - cy) - s * (x - cx)
        lean_u, lean_v = c * lean_x + s * lean_y, c * lean_y - s * lean_x
        place = (key, cx, cy, c, s, self.tags, self.facts, self.object)
        return town.walk(self.l, self.a, TABLE, u, v, lean_u, lean_v, top, *place)


def town_at(x, y, radius, seed, **changes):
    """Dry land with nothing but one town."""
    towns = np.array([[x, y, radius]] + [[0.0] * 3] * 4)
    dry = np.array([1000.0, -9, 0, 0, 0, 100])
    return Ground(seed, **{"towns": towns, "water": dry, "lines": np.zeros((10, 12)), **changes})


@pytest.mark.parametrize("seed", range(4))
def test_nothing_rises_above_one_in_fifty_from_the_airfield(seed):
    ground, rng = town_at(0, 0, 20e3, seed), np.random.default_rng(seed)
    tops = []
    for x, y in rng.uniform([-1500, -1500], [3500, 1500], (4000, 2)):
        top = ground.walk(x, y)
        tops.append(top)
        assert top <= 0.02 * away(ground.a, x, y)
    assert max(tops) > 4.0  # and something does stand there


@pytest.mark.parametrize("seed", range(3))
def test_a_ray_meets_what_stands_in_its_way(seed):
    # Against marching down the ray in small steps, asking at each what stands right below: houses only,
    # for under a crown there is air.
    treeless = {"built": np.array([0.6, 0.0, 0.15, 15.0]), "scrub": 0.0}
    ground, rng, met = town_at(0, 0, 20e3, seed, **treeless), np.random.default_rng(seed), 0
    for x, y in rng.uniform([-9000, 2000], [-6000, 4000], (60, 2)):
        place = cover.region(ground.l, x, y)[:5]
        bearing, lean = rng.uniform(0, 2 * math.pi), rng.uniform(1, 8)
        lean_x, lean_y = lean * math.cos(bearing), lean * math.sin(bearing)
        found = ground.walk_in(*place, x, y, lean_x, lean_y, 30.0)
        steps = np.arange(30.0, 0.0, -0.02)
        below = (z for z in steps if ground.walk_in(*place, x + lean_x * z, y + lean_y * z) >= z)
        assert max(found, 0.0) == pytest.approx(next(below, 0.0), abs=0.05)
        met += found >= 0
    assert met > 15


@pytest.mark.parametrize("seed", range(12))
def test_the_airfield_is_dry_and_roads_keep_off_it(seed):
    ground, rng = Ground(seed), np.random.default_rng(seed)
    half, margin = ground.airfield.grounds[:2]
    for x, y in rng.uniform([-margin, -half], [2000 + margin, half], (300, 2)):
        assert cover.land_height(ground.l, ground.a, TABLE, x, y, 1.0) > 0.0
        for kind in (cover.ROAD, cover.MOTORWAY, cover.RIVER):
            assert cover.line_off(ground.l, x, y, kind) > 0.0


def test_towns_thin_out_from_their_middle():
    ground, rng = town_at(9e3, 9e3, 3e3, 1, village=np.zeros(2), scrub=0.0), np.random.default_rng(1)

    def built(radius):
        bearings = rng.uniform(0, 2 * math.pi, 600)
        tops = [ground.walk(9000 + radius * math.cos(b), 9000 + radius * math.sin(b)) for b in bearings]
        return np.mean(np.array(tops) > 0)

    inner, outer, outside = built(900.0), built(2700.0), built(6500.0)
    # Standard error of each share below 0.02.
    assert inner > outer + 0.06 > outside + 0.06 > 0.05
    assert outside < 0.02


def test_an_outline_stops_early_without_a_change_of_side():
    # Leaving octaves out once the sign is sure must not change it.
    rng = np.random.default_rng(3)
    for x, y in rng.uniform(0, 1e5, (2000, 2)):
        level = rng.uniform(-0.5, 0.5)
        total, amplitude, p, q = -level, 1.0, x / 900.0, y / 900.0
        for _ in range(6):
            total += amplitude * (noise(TABLE, p, q) - 0.5)
            p, q = 1.6 * p - 1.2 * q + 11.3, 1.2 * p + 1.6 * q + 7.9
            amplitude *= 0.5
        assert np.sign(outline(TABLE, x, y, 900.0, 6, 1e-9, level)) == np.sign(total)


def test_at_the_visibility_a_contrast_of_two_percent_is_left():
    # Koschmieder: exp(-3.912) = 0.02.
    sky = random_sky(np.random.default_rng(0), 2000.0, np.zeros((2, 3)), 1e4)
    k = packed(sky._replace(beta=np.full(3, 3.912 / sky.visibility_m)))[0]
    black, white, air = np.zeros(3), np.ones(3), np.full(3, 0.5)
    haze(k, sky.visibility_m, air, black)
    haze(k, sky.visibility_m, air, white)
    np.testing.assert_allclose(white - black, 0.02, rtol=1e-3)
    near = np.array([0.1, 0.2, 0.3])
    haze(k, 0.0, air, near)
    np.testing.assert_allclose(near, [0.1, 0.2, 0.3], rtol=1e-12)


def test_light_and_weather_come_in_their_shares():
    skies = [random_sky(np.random.default_rng(n), 2000.0, np.zeros((2, 3)), 1e4) for n in range(2000)]
    night = np.mean([s.darkness == 1.0 for s in skies])
    overcast = np.mean([s.clouds[2] == 1.0 for s in skies])
    # Four standard errors of a share p of 2000.
    assert abs(night - 0.05) < 4 * math.sqrt(0.05 * 0.95 / 2000)
    assert abs(overcast - 0.09) < 4 * math.sqrt(0.09 * 0.91 / 2000)
    assert min(s.visibility_m for s in skies) >= 3e3
    for s in skies:
        assert math.isclose(np.linalg.norm(s.sun), 1.0)
        assert s.sun[2] > 0
        assert 0.2 < s.shade <= 1.0
        assert (s.beta > 0).all()


def test_colours_of_the_land_are_dull_and_within_range():
    rng = np.random.default_rng(4)
    for _ in range(200):
        climate = random_climate(rng)
        for colours in (climate.fields, climate.wild, climate.crowns, climate.rock):
            assert colours.min() >= 0.03
            assert colours.max() <= 0.95
            assert np.ptp(colours, axis=1).max() < 0.4
    assert random_climate(np.random.default_rng(1)).name == random_climate(np.random.default_rng(1)).name


def test_a_seed_is_a_land():
    scene = random_scene(np.random.default_rng(5), RUNWAY)
    climate = random_climate(np.random.default_rng(5))
    one, same = (random_land(np.random.default_rng(6), climate, scene.airfield) for _ in range(2))
    for name, value in one._asdict().items():
        np.testing.assert_array_equal(value, getattr(same, name))
