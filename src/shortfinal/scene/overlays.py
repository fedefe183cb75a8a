"""What stands between lens and world, or is written over the picture: cockpit, propeller, symbols, watermarks.

Nothing is drawn over the runway: a part that would touch its box is left out. Boxes (4,) are left,
top, right, bottom in pixels.
"""

from __future__ import annotations

from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont

Array = NDArray[np.float64]
Mask = NDArray[np.uint8]  # (h, w): 255 where it covers
Picture = TypeVar("Picture", NDArray[np.float32], NDArray[np.uint8])

COCKPIT = ("glareshield", "post", "propeller")  # before the lens, out of focus
SCREEN = ("hud", "watermark")  # over the finished picture

_CLEAR_PX = 3.0  # of the runway's box
_SMALLEST = 160  # px; writing in smaller pictures could not be read
_TITLES = ("Terrain View", "Aerial Imagery", "Global Survey", "Sky Atlas", "Flight Preview")
_CREDITS = ("Imagery 2021, survey and satellite data", "Elevation data: public domain", "Map data, terrain, relief")


def draw_cockpit(
    light: NDArray[np.float32], names: tuple[str, ...], rng: np.random.Generator, keep_out: Array
) -> NDArray[np.float32]:
    """Light (h, w, 3) with those of COCKPIT that `names` holds, around the box `keep_out`."""
    if "propeller" in names:
        light = _propeller(light, rng, keep_out)
    if "post" in names:
        light = _post(light, rng, keep_out)
    return _glareshield(light, rng, keep_out) if "glareshield" in names else light


def draw_screen(
    picture: NDArray[np.uint8], names: tuple[str, ...], rng: np.random.Generator, keep_out: Array
) -> NDArray[np.uint8]:
    """The picture (h, w, 3) with those of SCREEN that `names` holds, around the box `keep_out`."""
    if min(picture.shape[:2]) < _SMALLEST:
        return picture
    if "hud" in names:
        picture = _hud(picture, rng, keep_out)
    return _watermark(picture, rng, keep_out) if "watermark" in names else picture


def _laid(picture: Picture, mask: Mask, colour: Any, opacity: float, keep_out: Array) -> Picture:
    """The picture under a coloured mask; as it was, if the mask touches the box."""
    height, width = mask.shape
    left, top = (max(0, int(np.floor(edge - _CLEAR_PX))) for edge in keep_out[:2])
    right, bottom = (max(0, int(np.ceil(edge + _CLEAR_PX)) + 1) for edge in keep_out[2:])
    if mask[top : min(bottom, height), left : min(right, width)].any():
        return picture
    x, y, w, h = cv2.boundingRect(mask)
    out = picture.copy()
    part = out[y : y + h, x : x + w]
    cover = mask[y : y + h, x : x + w, None] * np.float32(opacity / 255)
    mixed = part + (np.asarray(colour, np.float32) - part) * cover
    part[:] = mixed if out.dtype == np.float32 else np.round(mixed)
    return out


def _polygon(picture: Picture, points: Array, blur_px: float = 0.0) -> Mask:
    """The mask of a polygon (N, 2), to 1/16 px."""
    mask = np.zeros(picture.shape[:2], np.uint8)
    cv2.fillPoly(mask, [np.round(points * 16).astype(np.int32)], 255, cv2.LINE_AA, 4)
    return np.asarray(cv2.GaussianBlur(mask, (0, 0), blur_px), np.uint8) if blur_px > 0.2 else mask


def _dark(rng: np.random.Generator) -> Array:
    return np.asarray(rng.uniform(8, 70) * np.exp(rng.normal(0, 0.06, 3)))


def _glareshield(light: NDArray[np.float32], rng: np.random.Generator, keep_out: Array) -> NDArray[np.float32]:
    """The top of the instrument panel, along the lower border."""
    height, width = light.shape[:2]
    blur = rng.uniform(0.001, 0.006) * height
    reach = min(rng.uniform(0.05, 0.3) * height, height - keep_out[3] - _CLEAR_PX - 4 * blur)
    u = np.linspace(-0.05, 1.05, 60)
    fall = (rng.uniform(0, 2.5) * np.abs(u - rng.uniform(0.2, 0.8)) ** rng.uniform(1.5, 4)).clip(0, 0.97)
    edge = np.column_stack([u * width, height - reach * (1 - fall)])
    floor = np.array([[1.1 * width, height + 4 * blur], [-0.1 * width, height + 4 * blur]])
    if reach < 0.03 * height:
        return light
    colour = _dark(rng)
    light = _laid(light, _polygon(light, np.vstack([edge, floor]), blur), colour, 1.0, keep_out)
    edge[:, 1] += rng.uniform(0.1, 0.4) * reach
    below = np.vstack([edge, floor])  # the face turned away from the light
    return _laid(light, _polygon(light, below, blur), colour * rng.uniform(0.3, 0.8), 1.0, keep_out)


def _post(light: NDArray[np.float32], rng: np.random.Generator, keep_out: Array) -> NDArray[np.float32]:
    """A window post along one side."""
    height, width = light.shape[:2]
    blur = rng.uniform(0.001, 0.008) * height
    on_left = bool(rng.random() < 0.5)
    room = (keep_out[0] if on_left else width - 1 - keep_out[2]) - _CLEAR_PX - 4 * blur
    reach = np.minimum(rng.uniform(0.02, 0.2, 2) * width, room)
    if reach.min() < 0.01 * width:
        return light
    v = np.array([-0.1, 1.1]) * height
    outside = -0.1 * width
    points = np.array([[outside, v[0]], [reach[0], v[0]], [reach[1], v[1]], [outside, v[1]]])
    if not on_left:
        points = points * [-1, 1] + [width - 1, 0]
    return _laid(light, _polygon(light, points, blur), _dark(rng), 1.0, keep_out)


def _propeller(light: NDArray[np.float32], rng: np.random.Generator, keep_out: Array) -> NDArray[np.float32]:
    """Blades caught by the shutter: dark, half transparent, bent by the rows being read in turn."""
    height, width = light.shape[:2]
    hub = np.array([rng.uniform(0.3, 0.7) * width, rng.uniform(1.0, 1.3) * height])
    radius = rng.uniform(0.5, 1.2) * height
    bend, half, opacity, colour = rng.normal(0, 0.5), rng.uniform(0.015, 0.05), rng.uniform(0.2, 0.7), _dark(rng)
    along = np.linspace(0.05, 1, 20)
    for angle in np.arange(4) * rng.choice([np.pi / 2, 2 * np.pi / 3]) + rng.uniform(0, np.pi):
        sides = []
        for side in (-1, 1):
            turn = angle + bend * along + side * half * (1 - 0.5 * along) / along.clip(0.2)
            sides.append(hub + radius * along[:, None] * np.column_stack([np.cos(turn), np.sin(turn)]))
        blade = np.vstack([sides[0], sides[1][::-1]])
        light = _laid(light, _polygon(light, blade, 0.004 * height), colour, opacity, keep_out)
    return light


def _hud(picture: NDArray[np.uint8], rng: np.random.Generator, keep_out: Array) -> NDArray[np.uint8]:
    """Symbols of a head-up display: ladder, flight path, speed, altitude, heading."""
    height, width = picture.shape[:2]
    green = np.array([rng.uniform(40, 150), 255, rng.uniform(60, 170)])
    opacity, thick, size = rng.uniform(0.5, 0.95), max(1, round(height / 400)), height / 900
    centre = np.array([width, height]) * rng.uniform(0.4, 0.6, 2)
    tilt = rng.normal(0, 0.1)
    across, down = np.array([np.cos(tilt), np.sin(tilt)]), np.array([-np.sin(tilt), np.cos(tilt)])
    shapes: list[list[Array]] = []
    for step in range(-3, 4):  # the pitch ladder, open in the middle
        level = centre + step * 0.11 * height * down
        inner, outer = 0.05 * width, (0.45 if step == 0 else 0.14) * width
        shapes += [[level + side * inner * across, level + side * outer * across] for side in (-1, 1)]
    turn = np.linspace(0, 2 * np.pi, 24)
    circle = centre + rng.normal(0, 0.05, 2) * height + 0.015 * height * np.column_stack([np.cos(turn), np.sin(turn)])
    shapes.append(list(circle))
    for u, text in ((0.08, f"{rng.integers(90, 180)}"), (0.8, f"{rng.integers(100, 3000)}")):
        box = np.array([[0, 0], [0.12, 0], [0.12, 0.06], [0, 0.06], [0, 0]]) * width + [u * width, 0.45 * height]
        shapes.append(list(box))
        mask = np.zeros((height, width), np.uint8)
        place = (int(box[3, 0] + 0.015 * width), int(box[3, 1] - 0.015 * width))
        cv2.putText(mask, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, 255, thick, cv2.LINE_AA)
        picture = _laid(picture, mask, green, opacity, keep_out)
    for tick in np.arange(0.3, 0.71, 0.04) * width:  # the heading tape
        shapes.append([np.array([tick, 0.06 * height]), np.array([tick, 0.08 * height])])
    for shape in shapes:
        mask = np.zeros((height, width), np.uint8)
        cv2.polylines(mask, [np.round(np.array(shape) * 16).astype(np.int32)], False, 255, thick, cv2.LINE_AA, 4)
        picture = _laid(picture, mask, green, opacity, keep_out)
    return picture


def _watermark(picture: NDArray[np.uint8], rng: np.random.Generator, keep_out: Array) -> NDArray[np.uint8]:
    """Two lines of writing, mostly at the lower right, as map services print them."""
    height, width = picture.shape[:2]
    layer = Pillow.new("L", (width, height))
    draw = ImageDraw.Draw(layer)
    size, right, opacity = rng.uniform(0.025, 0.045) * height, bool(rng.random() < 0.8), rng.uniform(0.5, 1.0)
    v = height * rng.uniform(0.95, 0.99)
    for text, share in ((str(rng.choice(_CREDITS)), 0.5), (str(rng.choice(_TITLES)), 1.0)):
        font = ImageFont.load_default(max(7.0, share * size))
        u = width * (0.96 if right else 0.04)
        draw.text((u, v), text, 255, font, anchor="rb" if right else "lb")
        v -= 1.2 * share * size
    mask = np.asarray(layer)
    shadow = np.asarray(cv2.GaussianBlur(mask, (0, 0), 0.1 * size), np.uint8)
    for cover, colour, strength in ((shadow, np.zeros(3), 0.5 * opacity), (mask, np.full(3, 255), opacity)):
        picture = _laid(picture, cover, colour, strength, keep_out)
    return picture
