"""The camera between the light and the file: lens, sensor, tone, storage.

Each effect leaves every edge where it was (blur kernels are symmetric, resampling keeps pixel
centres), so that labels hold as they are. Light and pictures are display-referred, 0 to 255.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image as Pillow

from shortfinal.scene.overlays import draw_cockpit, draw_screen

Array = NDArray[np.float64]
Light = NDArray[np.float32]
Image = NDArray[np.uint8]

_STEPS = 4  # table entries per grey level of the tone curve
_FILTERS = ("area", "bicubic", "lanczos")


@dataclass(frozen=True)
class Sensor:
    """What a camera, and what stores its pictures, does to the light. The default does nothing."""

    blur_px: float = 0.0  # Gaussian blur of lens and pixel, standard deviation
    noise: float = 0.0  # read noise, standard deviation, of 255
    jpeg_quality: int = 0  # 1 to 100; 0: not compressed
    jpeg_colour_halved: bool = True  # colour stored at half the resolution (4:2:0), else in full (4:4:4)
    defocus_px: float = 0.0  # radius of the disc that a point becomes
    motion_px: float = 0.0  # length of the streak that a point becomes while the shutter is open
    motion_deg: float = 0.0  # direction of the streak, from u towards v
    vignetting: float = 0.0  # share of the light lost in the picture's corners
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)  # of R, G, B: exposure and white balance
    gamma: tuple[float, float, float] = (1.0, 1.0, 1.0)  # exponent of R, G, B: below 1 lifts the shadows
    contrast: float = 1.0  # slope at mid-grey of an S-shaped curve
    black: float = 0.0  # grey level that black is lifted to (stray light), of 255
    saturation: float = 1.0  # 0: grey
    shot_noise: float = 0.0  # standard deviation at full light, falling with the root of the light, of 255
    grain_px: float = 0.0  # width over which noise is alike (after demosaicking or denoising), standard deviation
    sharpening: float = 0.0  # unsharp mask: share of the fine structure that is added once more
    sharpening_px: float = 1.0  # and what counts as fine, standard deviation
    levels: int = 256  # grey levels per channel
    resample: float = 1.0  # the picture was stored at this fraction of its size, and enlarged again
    resample_filter: str = "area"  # or bicubic, lanczos: the filter of that shrinking
    overlays: tuple[str, ...] = ()  # of overlays.COCKPIT and overlays.SCREEN, drawn where there is room


def random_sensor(rng: np.random.Generator, rate: float = 1.0) -> Sensor:
    """A random camera, from clean to poor; most are good enough to place a corner to a fraction of a pixel.

    `rate` (0 to 1) multiplies the probability of every effect: below 1 for pictures that came through
    a camera already.
    """
    u = rng.uniform

    def chance(probability: float) -> bool:
        return bool(rng.random() < rate * probability)

    def spread(sigma: float, size: int | None = None) -> Array:
        return np.exp(rng.normal(0.0, sigma, size))

    blur = abs(rng.normal(0, 0.45)) if chance(0.75) else 0.0
    gain, gamma = np.ones(3), np.ones(3)
    if chance(0.7):
        gain, gamma = spread(0.14) * spread(0.05, 3), spread(0.18) * spread(0.03, 3)
    noise, shot = (abs(rng.normal(0, 1.2)), abs(rng.normal(0, 2.5))) if chance(0.65) else (0.0, 0.0)
    if chance(0.06):
        noise, shot = u(3, 9), u(0, 8)
    quality = int(rng.integers(70, 99)) if chance(0.75) else 0
    if chance(0.1):
        quality = int(rng.integers(30, 70))
    return Sensor(
        blur_px=float(u(0.7, 1.6) if chance(0.08) else blur),
        noise=float(noise),
        jpeg_quality=quality,
        jpeg_colour_halved=bool(rng.random() < 0.75),
        defocus_px=u(0.6, 1.8) if chance(0.04) else 0.0,
        motion_px=u(1.0, 4.0) if chance(0.06) else 0.0,
        motion_deg=u(0.0, 180.0),
        vignetting=u(0.05, 0.45) if chance(0.25) else 0.0,
        gain=_rgb(gain),
        gamma=_rgb(gamma),
        contrast=float(spread(0.15)) if chance(0.5) else 1.0,
        black=u(0.0, 25.0) if chance(0.15) else 0.0,
        saturation=_saturation(rng) if chance(0.5) else 1.0,
        shot_noise=float(shot),
        grain_px=u(0.4, 1.1) if chance(0.3) else 0.0,
        sharpening=u(0.2, 1.2) if chance(0.35) else 0.0,
        sharpening_px=u(0.5, 1.2),
        levels=int(rng.integers(24, 80)) if chance(0.02) else 256,
        resample=u(0.5, 0.95) if chance(0.12) else 1.0,
        resample_filter=str(rng.choice(_FILTERS)),
        overlays=tuple(name for name, p in _OVERLAY_RATES if chance(p)),
    )


_OVERLAY_RATES = (("glareshield", 0.05), ("post", 0.04), ("propeller", 0.03), ("hud", 0.03), ("watermark", 0.15))


def expose(light: Light, sensor: Sensor, rng: np.random.Generator, keep_out: ArrayLike | None = None) -> Image:
    """Light (h, w, 3) in 0..255 to the 8-bit picture that the sensor stores.

    `keep_out` (4,): left, top, right, bottom of the runway's box; overlays are drawn around it, and
    none without it. `rng` draws noise and overlays.
    """
    if keep_out is not None:
        light = draw_cockpit(light, sensor.overlays, rng, np.asarray(keep_out, float))
    light = _through_the_lens(light, sensor)
    light = _saturated(_toned(light, sensor), sensor.saturation)
    light = _with_noise(light, sensor, rng)
    if sensor.sharpening > 0:
        soft = cv2.GaussianBlur(light, (0, 0), sensor.sharpening_px, borderType=cv2.BORDER_REFLECT)
        light = np.asarray(cv2.addWeighted(light, 1 + sensor.sharpening, soft, -sensor.sharpening, 0), np.float32)
    picture = to_8_bit(light)
    if sensor.levels < 256:
        steps = np.round(np.arange(256) * (sensor.levels - 1) / 255) * 255 / (sensor.levels - 1)
        picture = np.asarray(cv2.LUT(picture, np.round(steps).astype(np.uint8)), np.uint8)
    if keep_out is not None:
        picture = draw_screen(picture, sensor.overlays, rng, np.asarray(keep_out, float))
    if sensor.resample < 1:
        picture = _resampled(picture, sensor.resample, sensor.resample_filter)
    return _compressed(picture, sensor) if sensor.jpeg_quality else picture


def to_8_bit(light: Light) -> Image:
    """Rounded, and cut off at 0 and 255."""
    return np.asarray(np.clip(light + np.float32(0.5), 0, 255).astype(np.uint8))


def _rgb(values: Array) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def _saturation(rng: np.random.Generator) -> float:
    return 0.0 if rng.random() < 0.06 else float(np.exp(rng.normal(-0.05, 0.25)))


def _through_the_lens(light: Light, sensor: Sensor) -> Light:
    if sensor.vignetting > 0:
        light = light * _falloff(light.shape[0], light.shape[1], sensor.vignetting)[..., None]
    if sensor.blur_px > 0.05:
        light = np.asarray(cv2.GaussianBlur(light, (0, 0), sensor.blur_px, borderType=cv2.BORDER_REFLECT), np.float32)
    for kernel in (_disc(sensor.defocus_px), _streak(sensor.motion_px, sensor.motion_deg)):
        if kernel.size > 1:
            light = np.asarray(cv2.filter2D(light, -1, kernel, borderType=cv2.BORDER_REFLECT), np.float32)
    return light


def _falloff(height: int, width: int, loss: float) -> Light:
    """The cos^4 law: light falls as 1 / (1 + tan^2)^2 with the angle off the axis; `loss` of it in the corners."""
    corner = (1 - loss) ** -0.5 - 1  # tan^2 there
    v, u = (np.linspace(-1, 1, n, dtype=np.float32) ** 2 for n in (height, width))
    across = width**2 / (width**2 + height**2)
    return np.asarray((1 + corner * ((1 - across) * v[:, None] + across * u)) ** -2, np.float32)


def _disc(radius: float) -> Array:
    """A disc of light (n, n), averaged within each pixel from 8 x 8 points; n odd."""
    reach = int(np.ceil(radius - 0.5)) if radius > 0.3 else 0
    fine = (np.arange(8 * (2 * reach + 1)) + 0.5) / 8 - reach - 0.5
    inside = fine[:, None] ** 2 + fine**2 <= radius**2
    means = inside.reshape(2 * reach + 1, 8, 2 * reach + 1, 8).mean(axis=(1, 3))
    return means / means.sum() if reach else np.ones((1, 1))


def _streak(length: float, direction_deg: float) -> Array:
    """A line of light (n, n) centred on its pixel, spread over the neighbours of its points; n odd."""
    reach = int(np.ceil(length / 2))
    if length < 0.3:
        return np.ones((1, 1))
    along = np.linspace(-length / 2, length / 2, 8 * reach + 1)[:, None, None]
    n = np.arange(-reach, reach + 1)
    angle = np.radians(direction_deg)
    weight_u = np.maximum(0, 1 - np.abs(n[None, None, :] - along * np.cos(angle)))
    weight_v = np.maximum(0, 1 - np.abs(n[None, :, None] - along * np.sin(angle)))
    kernel = (weight_u * weight_v).sum(axis=0)
    return np.asarray(kernel / kernel.sum())


def _toned(light: Light, sensor: Sensor) -> Light:
    """Exposure, white balance and the camera's response, by table."""
    if (sensor.gain, sensor.gamma, sensor.contrast, sensor.black) == ((1, 1, 1), (1, 1, 1), 1, 0):
        return light
    level = np.arange(255 * _STEPS + 1)[None] / (255 * _STEPS)
    tone = np.clip(level * np.array(sensor.gain)[:, None], 0, 1) ** np.array(sensor.gamma)[:, None]
    # x^c / (x^c + (1 - x)^c) runs from 0 to 1 and has the slope c at one half.
    tone = tone**sensor.contrast / (tone**sensor.contrast + (1 - tone) ** sensor.contrast)
    tables = (sensor.black + (255 - sensor.black) * tone).astype(np.float32)
    entry = np.clip(light * np.float32(_STEPS) + np.float32(0.5), 0, 255 * _STEPS).astype(np.uint16)
    return np.stack([table.take(entry[..., channel]) for channel, table in enumerate(tables)], axis=-1)


def _saturated(light: Light, saturation: float) -> Light:
    if saturation == 1:
        return light
    grey = np.tile([0.299, 0.587, 0.114], (3, 1))  # luma of ITU-R BT.601
    return np.asarray(cv2.transform(light, saturation * np.eye(3) + (1 - saturation) * grey), np.float32)


def _with_noise(light: Light, sensor: Sensor, rng: np.random.Generator) -> Light:
    """Read noise everywhere, shot noise with a variance that grows with the light."""
    if max(sensor.noise, sensor.shot_noise) <= 0:
        return light
    noise = rng.standard_normal(light.shape, dtype=np.float32)
    if sensor.grain_px > 0:
        kernel = cv2.getGaussianKernel(2 * int(np.ceil(3 * sensor.grain_px)) + 1, sensor.grain_px, cv2.CV_32F)
        kernel = kernel / np.sqrt((kernel**2).sum())  # along each axis: the variance stays 1
        noise = np.asarray(cv2.sepFilter2D(noise, -1, kernel, kernel, borderType=cv2.BORDER_REFLECT), np.float32)
    if sensor.shot_noise > 0:
        variance = np.maximum(light, 0) * np.float32(sensor.shot_noise**2 / 255) + np.float32(sensor.noise**2)
        return np.asarray(light + np.sqrt(variance) * noise, np.float32)
    return np.asarray(light + np.float32(sensor.noise) * noise, np.float32)


def _resampled(picture: Image, factor: float, name: str) -> Image:
    """Shrunk by a filter that may ring, and enlarged again. Both map the same edges onto each other."""
    height, width = picture.shape[:2]
    small = (max(1, round(width * factor)), max(1, round(height * factor)))
    if name == "area":  # OpenCV's counts the shares of pixels; Pillow's box takes whole ones, which jitters
        shrunk = np.asarray(cv2.resize(picture, small, interpolation=cv2.INTER_AREA))
    else:  # Pillow's filters widen as they shrink; OpenCV's alias
        shrunk = np.asarray(Pillow.fromarray(picture).resize(small, Pillow.Resampling[name.upper()].value))
    return np.asarray(cv2.resize(shrunk, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)


def _compressed(picture: Image, sensor: Sensor) -> Image:
    halved = sensor.jpeg_colour_halved
    sampling = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420 if halved else cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
    flags = [cv2.IMWRITE_JPEG_QUALITY, sensor.jpeg_quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
    _, code = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), flags)
    decoded = np.asarray(cv2.imdecode(code, cv2.IMREAD_COLOR), np.uint8)
    return np.asarray(cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB), np.uint8)
