"""Rendered data sets: random approaches, drawn around the runway, with exact labels.

On disk: `images/000000.png`, ... and `labels.csv`, one row a picture. Every row follows from the
seed and its number alone, so an interrupted run continues where it stopped.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from shortfinal.crops import bogo_crop, box_around
from shortfinal.data.lard import NAUTICAL_MILE_M
from shortfinal.data.scene import Scene, Sensor, random_scene, random_sensor, render
from shortfinal.data.table import read_table
from shortfinal.errors import InputError
from shortfinal.files import csv_text, make_folder, write_png, write_whole
from shortfinal.geometry import Camera, Pose, project
from shortfinal.runway import Runway

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

COLUMNS = (
    "image", "width", "height", "fx", "fy", "cx", "cy", "length_m", "width_m",
    "x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg",
    "near_left_u", "near_left_v", "near_right_u", "near_right_v",
    "far_right_u", "far_right_v", "far_left_u", "far_left_v",
)  # fmt: skip
_CORNER_COLUMNS = COLUMNS[-8:]


@dataclass(frozen=True, eq=False)
class Example:
    """One picture and where the corners are in it."""

    image: Image  # (h, w, 3) RGB
    corners_px: Array  # (4, 2), keypoint order


def random_approach(rng: np.random.Generator) -> Pose:
    """A camera in LARD's approach cone, somewhat widened (LARD, Ducoffe et al. 2023, table 1).

    Slant distance 0.05 to 4.5 NM, log-uniform; glide angle 1.8 to 4.5 degrees at an apex 305 m past
    the threshold; 5 degrees to either side; yaw, roll 12 degrees to either side, pitch -9 to 1.
    """
    distance = float(np.exp(rng.uniform(np.log(0.05), np.log(4.5)))) * NAUTICAL_MILE_M
    lateral, glide = np.radians([rng.uniform(-5, 5), rng.uniform(1.8, 4.5)])
    height = (distance + 305.0) * np.tan(glide)
    attitude = rng.uniform([-12, -9, -12], [12, 1, 12])
    return Pose.from_attitude([-distance, distance * np.tan(lateral), height], *attitude)


@dataclass(frozen=True, eq=False)
class Shot:
    """A picture about to be taken."""

    scene: Scene
    runway: Runway
    camera: Camera  # of the picture
    pose: Pose
    sensor: Sensor
    noise_seed: int

    @property
    def corners_px(self) -> Array:
        """Where the corners will be (4, 2)."""
        return project(self.camera, self.pose, self.runway.corners)

    def render(self) -> Example:
        """Take it."""
        image = render(self.scene, self.camera, self.pose, self.sensor, samples=3, seed=self.noise_seed)
        return Example(image, self.corners_px)

    def row(self, name: str) -> dict[str, str]:
        """Its line in labels.csv, to nine digits."""
        c, r = self.camera, self.runway
        numbers = [c.width, c.height, c.fx, c.fy, c.cx, c.cy, r.length_m, r.width_m]
        numbers += [*self.pose.position_m, *self.pose.attitude, *self.corners_px.ravel()]
        return dict(zip(COLUMNS, [name, *(f"{n:.9g}" for n in numbers)], strict=True))


def plan_shot(seed: int, index: int) -> Shot:
    """Picture number `index` of the data set `seed`.

    The runway's box is 11 to 200 pixels long (log-uniform), as a camera sees it from afar or near; the
    picture holds it with room for the training crop to move.
    """
    rng = np.random.default_rng([seed, index])
    scene = random_scene(rng)
    runway = Runway(scene.length, scene.width)
    pose = random_approach(rng)
    unit = Camera(1, 1, 1000.0, 1000.0 * rng.uniform(0.9, 1.1), 0.0, 0.0)
    box = box_around(project(unit, pose, runway.corners))
    side = float(np.exp(rng.uniform(np.log(11.0), np.log(200.0))))
    zoom = side / float((box[2:] - box[:2]).max())
    camera = Camera(1, 1, unit.fx * zoom, unit.fy * zoom, 0.0, 0.0)
    out = int(np.ceil(max(1.3 * side, min(1.9 * side, 235.0)))) + 2
    window = bogo_crop(box_around(project(camera, pose, runway.corners)), out / side, out, rng, slack=0.06)
    return Shot(scene, runway, camera.view(window), pose, random_sensor(rng), int(rng.integers(2**31)))


def write_dataset(
    out: str | Path,
    count: int,
    seed: int = 0,
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Path:
    """Render `count` pictures into the folder `out`; those already there are kept.

    Returns the path of labels.csv, which appears when all are done. Raises InputError if the folder
    holds a data set of another seed.
    """
    folder = Path(out)
    make_folder(folder / "images")
    _claim(folder / "dataset.json", seed)

    def one(index: int) -> dict[str, str]:
        name = f"images/{index:06d}.png"
        shot = plan_shot(seed, index)
        if not _is_whole_png(folder / name):
            write_png(folder / name, shot.render().image)
        if progress:
            progress(index)
        return shot.row(name)

    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        rows = list(pool.map(one, range(count)))
    write_whole(folder / "labels.csv", csv_text(COLUMNS, rows))
    return folder / "labels.csv"


def _claim(stamp: Path, seed: int) -> None:
    """Note the seed in the folder, or refuse a folder of another seed."""
    text = json.dumps({"seed": seed})
    try:
        there = stamp.read_text(encoding="utf-8") if stamp.exists() else text
    except OSError as error:
        raise InputError(f"{stamp}: cannot be read: {error.strerror}; choose an empty folder") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{stamp}: not a text file; choose an empty folder") from error
    if there != text:
        raise InputError(f"{stamp.parent}: holds a data set of another seed; choose an empty folder or the same --seed")
    write_whole(stamp, text)


def _is_whole_png(path: Path) -> bool:
    """Whether the file is there and ends as a PNG does, with its IEND chunk of 12 bytes."""
    try:
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(size - 12, 0))
            return b"IEND" in file.read()
    except OSError:
        return False


class RenderedDataset:
    """The examples of a data set on disk, read when asked for."""

    def __init__(self, folder: Path, names: list[str], corners_px: Array) -> None:
        self.folder, self.names, self.corners_px = folder, names, corners_px

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Example:
        path = self.folder / self.names[index]
        return Example(read_image(path), self.corners_px[index])


def read_dataset(folder: str | Path) -> RenderedDataset:
    """A data set written by `write_dataset`.

    Raises InputError naming the file, the line and the field, or the first picture that is missing.
    """
    path = Path(folder) / "labels.csv"
    table = read_table(path)
    if not table.records:
        raise InputError(f"{path}: no rows; `shortfinal data render` writes them")
    missing = [c for c in ("image", *_CORNER_COLUMNS) if c not in table.columns]
    if missing:
        raise InputError(f"{path}: lacks the columns {', '.join(missing)}")
    rows = list(table.rows())
    corners = np.array([[row.number(name) for name in _CORNER_COLUMNS] for row in rows]).reshape(-1, 4, 2)
    for row in rows:
        picture = os.path.join(path.parent, row.get("image"))
        if not os.path.isfile(picture):
            raise InputError(f"{path}: line {row.line}: {picture}: no such image")
    return RenderedDataset(path.parent, [row.get("image") for row in rows], corners)


def read_image(path: str | Path) -> Image:
    """An image file as RGB (h, w, 3) uint8, as stored: labels are in stored pixels, so EXIF does not turn it.

    Raises InputError if it is missing, no image, or cut off.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such image")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read as an image: {error.strerror}") from error
    # libjpeg fills what is missing with grey. Some cameras pad behind the end marker.
    if content.startswith(b"\xff\xd8") and b"\xff\xd9" not in content.rstrip(b"\0")[-64:]:
        raise InputError(f"{path}: truncated JPEG")
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:  # of an empty file, or one that claims too large a picture
        image = None
    if image is None:
        raise InputError(f"{path}: cannot be read as an image")
    return np.ascontiguousarray(image[..., ::-1])
