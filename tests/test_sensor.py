import dataclasses

import numpy as np
import pytest
from marks import dots, measure

from shortfinal.scene.overlays import COCKPIT, SCREEN
from shortfinal.scene.sensor import Sensor, expose, random_sensor

SIZE, SIGMA = (200, 160), 2.5
POINTS = np.array([[25 + 30 * i + 0.37 * j, 24 + 28 * j + 0.21 * i] for i in range(6) for j in range(5)])
FLAT = np.full((300, 300, 3), 100.0, np.float32)
EFFECTS = {
    "none": Sensor(),
    "blur": Sensor(blur_px=1.2),
    "defocus": Sensor(defocus_px=1.7),
    "motion": Sensor(motion_px=3.3, motion_deg=37.0),
    "vignetting": Sensor(vignetting=0.4),
    "tone": Sensor(gain=(1.1, 0.9, 1.0), gamma=(0.7, 0.8, 1.3), contrast=1.4, black=20.0),
    "saturation": Sensor(saturation=0.3),
    "noise": Sensor(noise=2.0, shot_noise=3.0),
    "sharpening": Sensor(sharpening=1.2, sharpening_px=0.8),
    "levels": Sensor(levels=24),
    "area": Sensor(resample=0.61, resample_filter="area"),
    "bicubic": Sensor(resample=0.53, resample_filter="bicubic"),
    "lanczos": Sensor(resample=0.74, resample_filter="lanczos"),
    "jpeg 4:2:0": Sensor(jpeg_quality=60),
    "jpeg 4:4:4": Sensor(jpeg_quality=60, jpeg_colour_halved=False),
}


@pytest.mark.parametrize("sensor", EFFECTS.values(), ids=EFFECTS)
def test_no_effect_moves_a_mark(sensor):
    # Noise of 3 on dots 100 high, three channels: a standard error of 3 / 100 / sqrt(3 pi / 2) = 0.014 px.
    picture = expose(dots(SIZE, POINTS, SIGMA), sensor, np.random.default_rng(1))
    shifts, heights = measure(picture, POINTS, SIGMA)
    assert np.abs(shifts).max() < 0.1
    assert heights.min() > 30


def test_colour_stays_with_its_edges():
    # Saturated colours, whose chroma the JPEG halves: each channel by itself.
    light = np.concatenate([dots(SIZE, POINTS, SIGMA)[..., :1]] * 3, axis=2)
    light[..., 1] = 80.0
    picture = expose(light, Sensor(jpeg_quality=98), np.random.default_rng(2))
    shifts, _ = measure(picture[..., [0, 0, 0]], POINTS, SIGMA)
    assert np.abs(shifts).max() < 0.1
    assert np.abs(shifts.mean(axis=0)).max() < 0.03


def test_the_default_sensor_rounds_and_no_more():
    light = np.random.default_rng(3).uniform(-20, 280, (40, 50, 3)).astype(np.float32)
    kept = light.copy()
    picture = expose(light, Sensor(), np.random.default_rng(0))
    np.testing.assert_array_equal(light, kept)
    assert np.abs(picture - light.clip(0, 255)).max() <= 0.5


@pytest.mark.parametrize(
    ("sensor", "expected", "samples"),
    [
        (Sensor(noise=4.0), 4.0, 1),
        (Sensor(shot_noise=6.0), 6.0 * (100 / 255) ** 0.5, 1),
        (Sensor(noise=3.0, shot_noise=6.0), (9 + 36 * 100 / 255) ** 0.5, 1),
        # Correlated noise counts as fewer samples: one in 4 pi sigma^2.
        (Sensor(noise=4.0, grain_px=1.0), 4.0, 4 * np.pi),
    ],
    ids=["read", "shot", "both", "correlated"],
)
def test_noise_has_its_variance(sensor, expected, samples):
    picture = expose(FLAT, sensor, np.random.default_rng(4)).astype(float)
    with_rounding = (expected**2 + 1 / 12) ** 0.5
    relative = 4 * (samples / (2 * picture.size)) ** 0.5  # four standard errors of a standard deviation
    assert picture.std() == pytest.approx(with_rounding, rel=relative)
    assert picture.mean() == pytest.approx(100, abs=4 * with_rounding * (samples / picture.size) ** 0.5)


def test_grain_is_alike_over_its_width():
    # White noise through a Gaussian of sigma g correlates as exp(-d^2 / 4 g^2).
    noise = expose(FLAT, Sensor(noise=10.0, grain_px=1.5), np.random.default_rng(5)).astype(float) - 100
    for d in (1, 2, 3):
        found = (noise[:, d:] * noise[:, :-d]).mean() / noise.var()
        assert found == pytest.approx(np.exp(-(d**2) / (4 * 1.5**2)), abs=0.03)


def test_vignetting_takes_its_share_in_the_corners():
    picture = expose(FLAT + 100, Sensor(vignetting=0.4), np.random.default_rng(0)).astype(float)
    assert picture[150, 150, 0] == pytest.approx(200, abs=1)
    assert picture[0, 0, 0] == pytest.approx(120, abs=1)
    # cos^4 falls as (1 + t r^2)^-2 with the distance r from the centre: in the middle of a side r^2 = 1/2.
    t = 0.6**-0.5 - 1
    assert picture[150, 0, 0] == pytest.approx(200 * (1 + t / 2) ** -2, abs=1)


def test_the_tone_curve_is_as_its_fields_say():
    def tone(level, **fields):
        light = np.full((4, 4, 3), level, np.float32)
        return expose(light, Sensor(**fields), np.random.default_rng(0))[0, 0].astype(float)

    np.testing.assert_allclose(tone(100, gain=(0.5, 1.0, 1.5)), [50, 100, 150], atol=1)
    np.testing.assert_allclose(tone(64, gamma=(0.5, 1.0, 2.0)), 255 * (64 / 255) ** np.array([0.5, 1, 2]), atol=1)
    assert tone(0, black=30.0)[0] == pytest.approx(30, abs=0.6)
    assert tone(255, black=30.0)[0] == pytest.approx(255, abs=0.6)
    slope = (tone(137.5, contrast=1.5)[0] - tone(117.5, contrast=1.5)[0]) / 20
    assert slope == pytest.approx(1.5, abs=1.25 / 20)  # two levels and their quarters rounded
    light = np.tile(np.float32([200, 100, 50]), (4, 4, 1))
    grey = expose(light, Sensor(saturation=0.0), np.random.default_rng(0))[0, 0]
    np.testing.assert_allclose(grey, 0.299 * 200 + 0.587 * 100 + 0.114 * 50, atol=0.51)


def test_few_levels_are_few():
    ramp = np.tile(np.arange(256, dtype=np.float32)[None, :, None], (4, 1, 3))
    picture = expose(ramp, Sensor(levels=24), np.random.default_rng(0))
    assert len(np.unique(picture)) == 24
    assert (picture.min(), picture.max()) == (0, 255)


def test_sharpening_and_lanczos_ring_and_area_does_not():
    edge = np.full((40, 64, 3), 60, np.float32)
    edge[:, 33:] = 180

    def overshoot(sensor):
        return int(expose(edge, sensor, np.random.default_rng(0)).max()) - 180

    assert overshoot(Sensor(sharpening=0.8)) > 20
    assert overshoot(Sensor(resample=0.7, resample_filter="lanczos")) > 5
    assert overshoot(Sensor(blur_px=1.0)) == 0


@pytest.mark.parametrize("name", COCKPIT + SCREEN)
def test_overlays_are_drawn_around_the_runway(name):
    rng = np.random.default_rng(6)
    light = np.full((240, 320, 3), 120.0, np.float32)
    drawn = 0
    for seed in range(60):
        left, top = rng.uniform([-20, -20], [280, 200])
        box = [left, top, left + rng.uniform(5, 150), top + rng.uniform(5, 120)]
        picture = expose(light, Sensor(overlays=(name,)), np.random.default_rng(seed), box)
        u0, v0 = max(0, int(left)), max(0, int(top))
        assert (picture[v0 : int(box[3]) + 2, u0 : int(box[2]) + 2] == 120).all()
        drawn += bool((picture != 120).any())
    assert drawn > 20


def test_without_a_box_nothing_is_drawn_over_the_picture():
    picture = expose(FLAT, Sensor(overlays=COCKPIT + SCREEN), np.random.default_rng(0))
    assert (picture == 100).all()


def test_a_random_sensor_follows_from_its_seed():
    assert random_sensor(np.random.default_rng(7)) == random_sensor(np.random.default_rng(7))
    light, rng = dots(SIZE, POINTS, SIGMA), np.random.default_rng(8)
    for _ in range(20):  # rate 0: no effect, whatever the other draws
        np.testing.assert_array_equal(expose(light, random_sensor(rng, 0.0), rng), expose(light, Sensor(), rng))


def test_random_sensors_vary_every_field_and_are_mostly_good():
    sensors = [random_sensor(np.random.default_rng([9, i])) for i in range(600)]
    for field in dataclasses.fields(Sensor):
        assert len({getattr(s, field.name) for s in sensors}) > 1, field.name
    blur = np.array([(s.blur_px**2 + s.defocus_px**2 / 4 + s.motion_px**2 / 12) ** 0.5 for s in sensors])
    assert np.mean(blur < 1) > 0.8
    assert np.mean([max(s.noise, s.shot_noise) < 5 for s in sensors]) > 0.8
