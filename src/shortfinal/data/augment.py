"""Training crops that differ each time, with labels that stay true.

Geometry (crop, small rotation, mirror) is one affine map, applied to picture and corners alike. The
camera's effects are a weak random `Sensor`. What happens on the way to the lens (haze, drops, glare,
dirt, night) is drawn on the crop by EFFECTS; none of it moves a corner.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from shortfinal.crops import (
    PATCH_PX,
    Crop,
    bogo_crop,
    box_around,
    centre_crop,
    corner_patches,
    inverse_crop,
    native_crop,
    random_margin,
    search_crop,
)
from shortfinal.data.dataset import Example
from shortfinal.detector import KeypointDetector, warp_image
from shortfinal.geometry import PixelWindow
from shortfinal.keypoints import CORNER_NAMES, mirrored
from shortfinal.scene.sensor import expose, random_sensor, to_8_bit

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Light = NDArray[np.float32]

MIRRORED, ROTATED, OVERHANGING, ELSEWHERE, CUT = 0.5, 0.3, 0.05, 0.08, 0.06  # probabilities
SENSOR_RATE = 0.4  # of random_sensor's effects: the pictures have been through one already
_CORNER_SCALES = (0.4, 1.5)  # pixels of the picture that corners are looked at in, per pixel of the example
_CORNER_SIDES = (40, 320)  # of that picture
_FIRST_LOOK = (0.0015, 0.04)  # its sigma, as a share of that picture's side
_UNEVEN = 0.5  # probability
_PROFILE = (0.06, 0.06, 0.15)  # of a runway, in its widths: a crest, a wave, the far end's height; standard deviations
_STEEPEST = 0.35  # of its rise, over the camera's height
_UNIT_RUNWAY = np.array([[0, 1], [0, 0], [1, 0], [1, 1]], np.float32)
_COLUMN_PX = 4.0  # from one line across the picture to the next along which it is bent
_HIDDEN_PX = 0.3  # a corner so far behind nearer ground is not seen
_MOST_TURN_DEG = 7.0
_CLEAR_PX = 6.0  # a drop stays this far from the corners before it may bend the picture


@dataclass(frozen=True, eq=False)
class Warp:
    """An affine map from an image to a square crop."""

    crop_from_image: Array  # (2, 3): pixel (u, v, 1) of the image to (u, v) of the crop
    size: int  # side of the crop, px
    mirrored: bool = False  # then left and right change names
    border: int = cv2.BORDER_CONSTANT  # OpenCV's, beyond the image: black

    @property
    def scale(self) -> float:
        """Pixels of the crop per pixel of the image."""
        return float(np.sqrt(abs(np.linalg.det(self.crop_from_image[:, :2]))))

    @property
    def image_from_crop(self) -> Array:
        """The inverse map (2, 3)."""
        return np.linalg.inv(np.vstack([self.crop_from_image, [0, 0, 1]]))[:2]

    def cut(self, image: Image) -> Image:
        """The crop (size, size, 3), resampled once; area-averaged where it shrinks."""
        return warp_image(image, self.image_from_crop, (self.size, self.size), self.border)

    def apply(self, keypoints_px: ArrayLike, names: Sequence[str] = CORNER_NAMES) -> Array:
        """The image's keypoints (K, 2) as the crop's, each again in the place of its name."""
        moved = np.asarray(keypoints_px, float) @ self.crop_from_image[:, :2].T + self.crop_from_image[:, 2]
        return moved[mirrored(names)] if self.mirrored else moved

    def region(self, image: Image) -> tuple[Image, Warp]:
        """The part of the image that the crop shows, and the map from there."""
        ends = np.array([[-1, -1, 1], [self.size, -1, 1], [-1, self.size, 1], [self.size, self.size, 1]])
        reach = ends @ self.image_from_crop.T
        height, width = image.shape[:2]
        left, top = np.clip(np.floor(reach.min(axis=0)) - 2, 0, [width - 1, height - 1]).astype(int)
        right, bottom = np.clip(np.ceil(reach.max(axis=0)) + 3, [left + 1, top + 1], [width, height]).astype(int)
        matrix = self.crop_from_image.copy()
        matrix[:, 2] += matrix[:, :2] @ [left, top]
        return image[top:bottom, left:right], Warp(matrix, self.size, self.mirrored, self.border)


def inside(corners_px: Array, width: float, height: float) -> NDArray[np.bool_]:
    """Which of the points (K, 2) lie within a picture of that size; none that is not a number does."""
    last = np.array([width, height]) - 0.5
    return np.asarray(((corners_px >= -0.5) & (corners_px <= last)).all(axis=1))


def within(example: Example) -> Array:
    """An example's keypoints (K, 2), NaN where they are not in the picture."""
    height, width = example.image.shape[:2]
    places = np.full((len(example.names), 2), np.nan) if example.keypoints_px is None else example.keypoints_px
    return np.where(inside(places, width, height)[:, None], places, np.nan)


def random_warp(corners_px: Array, image_size: tuple[int, int], size: int, rng: np.random.Generator) -> Warp:
    """Where a training crop lies: a Bogo crop of random scale, some turned by a few degrees, half of them mirrored.

    It holds those of the corners (4, 2) that the image (width, height) does; of an image without any,
    a random part. Most lie within the image; few hang over its border, and turned ones may.
    """
    seen = corners_px[inside(corners_px, *image_size)]
    if len(seen) < 2:
        seen = _somewhere(image_size, rng)
    box = box_around(seen)
    turn_deg, border = 0.0, cv2.BORDER_CONSTANT
    if rng.random() < ROTATED:
        turn_deg = rng.uniform(-_MOST_TURN_DEG, _MOST_TURN_DEG)
        # Not reflected: the mirror image of a runway's end is another end.
        border = cv2.BORDER_REPLICATE if rng.random() < 0.5 else cv2.BORDER_CONSTANT
    turn = _turn((box[:2] + box[2:]) / 2, turn_deg)
    box = box_around(seen @ turn[:, :2].T + turn[:, 2])
    within = None if rng.random() < OVERHANGING else image_size
    window = bogo_crop(box, random_margin(box, image_size, rng), size, rng, slack=0.02, image_size=within)
    return _warp(window, turn, border, rng)


def beside_warp(corners_px: Array, image_size: tuple[int, int], size: int, rng: np.random.Generator) -> Warp | None:
    """A crop of the scale of `random_warp`'s without the runway (`inverse_crop`); None where there is no room."""
    window = inverse_crop(box_around(corners_px), image_size, size, rng)
    return None if window is None else _warp(window, _STILL, cv2.BORDER_CONSTANT, rng)


def native_warp(corners_px: Array, image_size: tuple[int, int], size: int, rng: np.random.Generator) -> Warp:
    """The paper's crop (`native_crop`), half of them mirrored."""
    return _warp(native_crop(box_around(corners_px), image_size, rng, size, 0.0), _STILL, cv2.BORDER_CONSTANT, rng)


_STILL = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def _warp(window: PixelWindow, turn: Array, border: int, rng: np.random.Generator) -> Warp:
    matrix = _matrix(window) @ np.vstack([turn, [0, 0, 1]])
    turned = bool(rng.random() < MIRRORED)
    if turned:
        matrix[0] = [0, 0, window.out_width - 1] - matrix[0]
    return Warp(matrix, window.out_width, turned, border)


def _somewhere(image_size: tuple[int, int], rng: np.random.Generator) -> Array:
    """Two corners of a square inside the image."""
    side = 0.5 * min(image_size)
    first = rng.uniform(0, np.array(image_size) - 1 - side)
    return np.array([first, first + side])


def augmented_crop(
    example: Example, size: int, rng: np.random.Generator, *, kind: Crop = "framed", weather: bool = True
) -> tuple[Image, Array]:
    """A random crop (size, size, 3) of an example as another camera in other weather saw it; its keypoints (K, 2).

    Keypoints beyond the crop are given too; those that are not in the picture, or not labelled, are NaN:
    a crop that hangs over its border shows none of them. The camera works at the image's resolution, or
    the crop's where that is coarser: its noise and its JPEG blocks are enlarged with the picture, as in
    use. `kind`: "framed" (`random_warp`); "native", the paper's crop, of whole runways only; "tile", as the search
    looks at a frame. Without `weather` the picture is only cut.
    """
    height, width = example.image.shape[:2]
    places = within(example)
    corners = places[:4]  # which frame the crop
    whole = bool(np.isfinite(corners).all())
    beside = None
    if kind == "tile":
        box = box_around(corners) if whole else None
        warp = _warp(search_crop(box, (width, height), size, rng), _STILL, cv2.BORDER_CONSTANT, rng)
    elif kind == "native" and whole:
        warp = native_warp(corners, (width, height), size, rng)
    else:
        if whole and rng.random() < ELSEWHERE:
            beside = beside_warp(corners, (width, height), size, rng)
        warp = beside or random_warp(corners, (width, height), size, rng)
        if beside is None and rng.random() < CUT:  # some corners beyond it, as after a bad guess where to look
            warp.crop_from_image[:, 2] += rng.uniform(-0.5, 0.5, 2) * size
    places = warp.apply(places, example.names)
    if not weather:
        return warp.cut(example.image), places
    sensor = random_sensor(rng, SENSOR_RATE)
    if warp.scale > 1:
        part, moved = warp.region(example.image)
        crop = moved.cut(expose(part.astype(np.float32), sensor, rng))
    else:
        crop = expose(warp.cut(example.image).astype(np.float32), sensor, rng)
    seen = places[inside(places, size, size)]
    for effect in EFFECTS:
        if rng.random() < effect.probability:
            crop = effect.apply(crop, seen, rng)
    return crop, places


def corner_looks(
    example: Example, rng: np.random.Generator, weather: bool = True, detector: KeypointDetector | None = None
) -> tuple[NDArray[np.uint8], Array, Array]:
    """Patches (4, P, P, 3) around where a first look puts an example's corners, half the time as another camera in
    other weather saw them; where the corners are in them (4, 2), NaN where they are not in the picture; and pixels of
    each patch per pixel of the picture (4,).

    The first look is the `detector`'s, half the time with one at each corner after it, as in use: it errs where the
    picture misleads. Without a detector it is drawn.
    """
    if rng.random() < _UNEVEN:
        example = uneven(example, rng)
    corners = within(example)[:4]
    seen = corners[np.isfinite(corners).all(axis=1)]
    shrunk = float(np.exp(rng.uniform(*np.log(_CORNER_SCALES))))
    side = 64 if len(seen) < 2 else int(np.clip(1.5 * shrunk * np.ptp(seen, axis=0).max(), *_CORNER_SIDES))
    picture, corners = augmented_crop(example, side, rng, weather=weather and rng.random() < 0.5)
    corners = np.where(inside(corners, side, side)[:, None], corners, np.nan)[:4]
    around = np.where(np.isfinite(corners), corners, rng.uniform(0, side, (4, 2)))
    found, said = _drawn(around, side, rng) if detector is None else _looked(detector, picture, around, rng)
    maps = corner_patches(found, said)
    patches = np.stack([warp_image(picture, each, (PATCH_PX, PATCH_PX)) for each in maps])
    axes = maps[:, :, :2]
    places = np.asarray(np.linalg.solve(axes, (corners - maps[:, :, 2])[..., None])[..., 0], np.float64)
    scale: Array = 1 / np.sqrt(np.abs(np.linalg.det(axes)))
    return patches, places, scale


def uneven(example: Example, rng: np.random.Generator) -> Example:
    """The same runway with a profile: its far end higher or lower, a crest or a hollow on the way.

    Seen from the height Z, ground that rises by h lies Z - h below the camera: what was so many pixels below the
    horizon comes to (1 - h / Z) times as many, and what then lies behind nearer ground is hidden. The four corners
    tell all of that: horizon, how far along the runway a pixel is, and its width over Z. What stands on the ground is
    bent with it. A corner that is hidden becomes NaN; an example without all four stays as it is.
    """
    corners = within(example)[:4]
    if not np.isfinite(corners).all():
        return example
    plane = cv2.getPerspectiveTransform(corners.astype(np.float32), _UNIT_RUNWAY)  # to shares of length and width
    down = plane[2] / np.hypot(*plane[2, :2])
    down *= np.sign(corners[0] @ down[:2] + down[2])
    near, far = (corners[end] @ down[:2] + down[2] for end in (slice(0, 2), slice(2, 4)))  # px below the horizon
    if not (far.min() > 1 and near.mean() > far.mean()):
        return example
    width = float(np.hypot(*(corners[1] - corners[0]) / near.mean()))  # over Z
    crest, wave, rise = rng.normal(0, _PROFILE)

    def moved(px: Array) -> tuple[Array, Array]:
        """How far below the horizon pixels (..., 2) are, and will be."""
        depth = px @ down[:2] + down[2]
        ground = np.where(depth > 1e-6, px @ plane[2, :2] + plane[2, 2], 1.0)
        along = np.clip((px @ plane[0, :2] + plane[0, 2]) / ground, -0.15, 1.15)  # level before and beyond
        lift = width * (crest * np.sin(np.pi * along) + wave * np.sin(2 * np.pi * along) + rise * along)
        return depth, depth * (1 - np.where(depth > 1e-6, np.clip(lift, -_STEEPEST, _STEEPEST), 0.0))

    height, wide = example.image.shape[:2]
    v, u = np.mgrid[:height, :wide].astype(np.float64)
    side = np.array([-down[1], down[0]])
    across, depth = u * side[0] + v * side[1], u * down[0] + v * down[1] + down[2]
    columns = np.arange(math.floor(across.min()), across.max() + _COLUMN_PX, _COLUMN_PX)
    deepest = max(float(depth.max()), 1.0) * (1 + 2 * _STEEPEST)
    rows = np.arange(math.ceil(2 * deepest), -1, -1) / 2  # from near to far
    lines = columns[:, None, None] * side + (rows[:, None] - down[2]) * down[:2]
    ahead = np.minimum.accumulate(moved(lines)[1], axis=1)
    came = np.stack([np.interp(rows[::-1], line[::-1], rows[::-1]) for line in ahead]).astype(np.float32)
    column = (across - columns[0]) / _COLUMN_PX
    at = cv2.remap(came, (2 * depth).astype(np.float32), column.astype(np.float32), cv2.INTER_LINEAR)
    shift = np.where(depth > 0, at - depth, 0.0)
    image = cv2.remap(
        example.image, (u + shift * down[0]).astype(np.float32), (v + shift * down[1]).astype(np.float32),
        cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101,
    )  # fmt: skip
    assert example.keypoints_px is not None
    places = example.keypoints_px.copy()
    depth_was, depth_is = moved(places)
    places += (depth_is - depth_was)[:, None] * down[:2]
    nearest = np.abs(columns[:, None] - example.keypoints_px @ side).argmin(axis=0)
    for number, (line, was, now) in enumerate(zip(ahead[nearest], depth_was, depth_is, strict=True)):
        if now > line[rows >= was].min(initial=math.inf) + _HIDDEN_PX:
            places[number] = np.nan
    return replace(example, image=np.asarray(image, np.uint8), keypoints_px=places)


def _drawn(around: Array, side: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """A first look at corners (4, 2) in a picture of that side, and its sigma (4, 2).

    It errs as one (the runway moved and stretched) and for each corner by itself, by as much as it says, more or
    less, and at times by far more.
    """
    said = side * float(np.exp(rng.uniform(*np.log(_FIRST_LOOK)))) * np.exp(rng.normal(0, 0.3, (4, 1)))
    heavy = np.sqrt(4.0 / rng.chisquare(4.0))  # Student's t: first looks' errors have such tails
    common = rng.uniform(0, 1)
    moved = common * rng.normal(0, 1, 2) + common * rng.normal(0, 1) * (around - around.mean(axis=0)) / side
    found = around + heavy * said * (moved + np.sqrt(1 - common**2) * rng.normal(0, 1, (4, 2)))
    return found, np.repeat(said, 2, axis=1)


def _looked(detector: KeypointDetector, picture: Image, around: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """What a model makes of a picture with corners (4, 2), and its sigma (4, 2)."""
    box = box_around(around)
    side = float((box[2:] - box[:2]).max())
    shift = np.tile(rng.uniform(-0.06, 0.06, 2) * side, 2)
    keypoints = detector.look(picture, centre_crop(box + shift, rng.uniform(1.3, 1.7), detector.info.size)).keypoints
    if detector.sharpens and rng.random() < 0.5:
        keypoints = detector.sharpened(picture, keypoints, 1)
    return keypoints.mean_px[:4], keypoints.sigma_px[:4]


def haze(crop: Image, corners: Array, rng: np.random.Generator) -> Image:
    """A pale veil over the picture, denser towards the top, where the ground is far."""
    colour = rng.uniform(140, 235) * np.exp(rng.normal(0, [0.04, 0.02, 0.04]))
    dense = rng.uniform(0.1, 0.75)
    thin = dense * rng.uniform(0.2, 1.0)
    veil = np.linspace(dense, thin, len(crop), dtype=np.float32)[:, None, None]
    return to_8_bit(crop + (colour.astype(np.float32) - crop) * veil)


def glare(crop: Image, corners: Array, rng: np.random.Generator) -> Image:
    """The sun in the lens: a veil around a point, and a streak through it."""
    size = len(crop)
    v, u = (np.linspace(0, 1, 28, dtype=np.float32) - np.float32(place) for place in rng.uniform(-0.3, 1.3, 2))
    distance = u**2 + v[:, None] ** 2
    angle = rng.uniform(0, np.pi)
    off = (np.cos(angle) * u + np.sin(angle) * v[:, None]) ** 2
    light = rng.uniform(0.1, 0.7) / (1 + distance / rng.uniform(0.01, 0.15)) + rng.uniform(0.0, 0.12)
    light += rng.uniform(0.0, 0.35) * np.exp(-off / rng.uniform(0.001, 0.01)) / (1 + 2 * distance)
    added = np.asarray(cv2.resize(light.astype(np.float32), (size, size), interpolation=cv2.INTER_CUBIC), np.float32)
    colour = np.array([255.0, rng.uniform(225, 255), rng.uniform(190, 255)], np.float32)
    return to_8_bit(crop + (colour - np.float32(0.5) * crop) * added.clip(0, 1)[..., None])


def drops(crop: Image, corners: Array, rng: np.random.Generator) -> Image:
    """Rain on the lens: out-of-focus drops. Away from the corners they show the picture upside down, as lenses do."""
    size = len(crop)
    out = crop.copy()
    for _ in range(rng.integers(1, 9)):
        radius = float(np.exp(rng.uniform(np.log(3), np.log(0.12 * size))))
        centre = rng.uniform(0, size, 2)
        reach = int(radius) + 1
        left, top = np.maximum(0, centre.astype(int) - reach)
        right, bottom = np.minimum(size, centre.astype(int) + reach + 1)
        part = crop[top:bottom, left:right]
        bent = np.linalg.norm(corners - centre, axis=1).min(initial=np.inf) > radius + _CLEAR_PX
        behind, blur = (part[::-1, ::-1], 0.3 * radius) if bent else (part, 0.8)
        seen = np.asarray(cv2.GaussianBlur(behind, (0, 0), blur), np.float32)
        v, u = np.mgrid[top:bottom, left:right].astype(np.float32)
        away = np.hypot(u - centre[0], v - centre[1]) / np.float32(radius)
        cover = ((1.0 - away) * 4).clip(0, 1)[..., None]
        shade = 1 + bent * rng.uniform(0, 0.25) * (v - np.float32(centre[1])) / np.float32(radius)  # brighter below
        mixed = part + (shade[..., None] * seen - part) * cover
        out[top:bottom, left:right] = to_8_bit(np.asarray(mixed, np.float32))
    return out


def occlusion(crop: Image, corners: Array, rng: np.random.Generator) -> Image:
    """Something on the window: a wiper, dirt, an insect. At most two corners are hidden; they stay labelled."""
    size = len(crop)
    hidden = np.zeros(len(corners), bool)
    for _ in range(rng.integers(1, 4)):
        mask = _patch(size, rng)
        u, v = np.round(corners).astype(int).clip(0, size - 1).T
        now = hidden | (mask[v, u] > 64)
        if now.sum() > 2:
            continue
        hidden = now
        colour = rng.uniform(5, 110) * np.exp(rng.normal(0, 0.08, 3))
        cover = mask.astype(np.float32)[..., None] * np.float32(rng.uniform(0.6, 1.0) / 255)
        mixed = crop + (colour.astype(np.float32) - crop) * cover
        crop = to_8_bit(np.asarray(mixed, np.float32))
    return crop


def night(crop: Image, corners: Array, rng: np.random.Generator) -> Image:
    """Dusk to night: the ground dark, bright points kept, noise."""
    level = np.arange(256, dtype=np.float32) / 255
    exposure = min(0.7, rng.uniform(15, 60) / max(1.0, float(crop.mean())))  # what the camera makes of the dark
    dark = exposure * np.array([rng.uniform(0.75, 1.0), rng.uniform(0.85, 1.0), 1.0])
    bright = 1 / (1 + np.exp(-(level - rng.uniform(0.75, 0.95)) / 0.04))[:, None]
    table = 255 * (level[:, None] * dark * (1 - bright) + level[:, None] * bright)
    lit = cv2.LUT(crop, table[None].astype(np.uint8))
    noise = rng.standard_normal(crop.shape, dtype=np.float32)
    return to_8_bit(lit + noise * np.float32(rng.uniform(0.5, 5.0)))


class Effect(NamedTuple):
    """Something between the world and the lens."""

    apply: Callable[[Image, Array, np.random.Generator], Image]  # crop (h, w, 3), corners (4, 2), rng -> crop
    probability: float


EFFECTS = (
    Effect(haze, 0.12),
    Effect(night, 0.05),
    Effect(glare, 0.08),
    Effect(drops, 0.06),
    Effect(occlusion, 0.08),
)


def _turn(centre: Array, degrees: float) -> Array:
    """Rotation about a pixel (2, 3), from u towards v."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rotation = np.array([[c, -s], [s, c]])
    return np.column_stack([rotation, centre - rotation @ centre])


def _matrix(window: PixelWindow) -> Array:
    """PixelWindow.apply as a matrix (2, 3)."""
    origin = window.apply([0.0, 0.0])
    return np.column_stack([np.diag(window.scale), origin])


def _patch(size: int, rng: np.random.Generator) -> Image:
    """Where something covers a crop (size, size): 255 where it does, soft at its edge."""
    mask = np.zeros((size, size), np.uint8)
    if rng.random() < 0.3:  # a wiper across
        ends = rng.uniform(0, size, 2)
        line = np.round([[-5, ends[0]], [size + 5, ends[1]]]).astype(np.int32)
        thick = int(rng.integers(3, max(4, size // 14)))
        cv2.polylines(mask, [line[:, ::-1] if rng.random() < 0.5 else line], False, 255, thick, cv2.LINE_AA)
    else:  # a spot
        turn = np.linspace(0, 2 * np.pi, 10, endpoint=False)
        radius = np.exp(rng.uniform(np.log(2), np.log(0.1 * size))) * rng.uniform(0.5, 1.3, 10)
        outline = rng.uniform(0, size, 2) + radius[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
        cv2.fillPoly(mask, [np.round(outline * 16).astype(np.int32)], 255, cv2.LINE_AA, 4)
    return np.asarray(cv2.GaussianBlur(mask, (0, 0), rng.uniform(0.6, 4.0)), np.uint8)
