"""Rendered data sets: random approaches with exact labels, as views of the runway or as a camera's whole frames.

On disk: `images/000000.png`, ... and `labels.csv`, one row a picture; beside whole frames the
same in LARD's form. Every row follows from the seed and its number alone, so an interrupted run
continues where it stopped.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shortfinal.crops import bogo_crop, box_around
from shortfinal.data.formats import CAMERA_COLUMNS, CORNER_COLUMNS, POSE_COLUMNS, open_dataset
from shortfinal.data.image import Image, read_image
from shortfinal.data.labelled import Picture
from shortfinal.data.lard import AIMING_POINT_M, NAUTICAL_MILE_M, NewLabel, write_database, write_labels
from shortfinal.errors import InputError
from shortfinal.files import csv_text, make_folder, write_png, write_whole
from shortfinal.geometry import Camera, Pose, can_project, project, unproject
from shortfinal.runway import Runway
from shortfinal.scene.render import Scene, random_scene, render
from shortfinal.scene.sensor import Sensor, random_sensor

Array = NDArray[np.float64]

COLUMNS = (
    "image", "ident", *CAMERA_COLUMNS, "distortion", "length_m", "width_m", *POSE_COLUMNS, *CORNER_COLUMNS
)  # fmt: skip
_TRIES, _BORDER_PX = 50, 1.0


@dataclass(frozen=True, eq=False)
class Example:
    """One picture and where the corners are in it."""

    image: Image  # (h, w, 3) RGB
    corners_px: Array  # (4, 2), keypoint order


def random_approach(rng: np.random.Generator, visibility_m: float = math.inf) -> Pose:
    """A camera in LARD's approach cone, somewhat widened (LARD, Ducoffe et al. 2023, table 1).

    Slant distance 0.05 to 4.5 NM, log-uniform; glide angle 1.8 to 4.5 degrees at an apex 305 m past
    the threshold; 5 degrees to either side; yaw, roll 12 degrees to either side, pitch -9 to 1. No farther out than
    0.7 of the visibility, where 6 % of the contrast is left.
    """
    farthest = min(4.5, 0.7 * visibility_m / NAUTICAL_MILE_M)
    distance = float(np.exp(rng.uniform(np.log(0.05), np.log(farthest)))) * NAUTICAL_MILE_M
    lateral, glide = np.radians([rng.uniform(-5, 5), rng.uniform(1.8, 4.5)])
    height = (distance + AIMING_POINT_M) * np.tan(glide)
    attitude = rng.uniform([-12, -9, -12], [12, 1, 12])
    return Pose.from_attitude([-distance, distance * np.tan(lateral), height], *attitude)


@dataclass(frozen=True, eq=False)
class Shot:
    """A picture about to be taken."""

    ident: str  # of the airfield and its landing direction; each picture has its own
    scene: Scene
    camera: Camera  # of the picture
    pose: Pose
    sensor: Sensor
    noise_seed: int

    @property
    def runway(self) -> Runway:
        """The scene's, flat."""
        return replace(self.scene.runway, ident=self.ident)

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
        lens = " ".join(f"{k:.9g}" for k in c.distortion)
        numbers = [r.length_m, r.width_m, *self.pose.position_m, *self.pose.attitude, *self.corners_px.ravel()]
        cells = [name, r.ident, c.width, c.height, *(f"{n:.12g}" for n in (c.fx, c.fy, c.cx, c.cy)), lens]
        return dict(zip(COLUMNS, [*map(str, cells), *(f"{n:.9g}" for n in numbers)], strict=True))


def plan_shot(seed: int, index: int, camera: Camera | None = None) -> Shot:
    """Picture number `index` of the data set `seed`.

    With a camera: the whole frame it takes, the runway inside. Without: a view around the runway,
    whose box is 11 to 200 pixels long (log-uniform), as a camera sees it from afar or near; with
    room for the training crop to move. Raises InputError for a camera that cannot hold a runway.
    """
    rng = np.random.default_rng([seed, index])
    scene = random_scene(rng)
    runway = scene.runway
    if camera is None:
        pose = random_approach(rng, scene.sky.visibility_m)
        camera = _view(runway, pose, rng)
    else:
        pose = _framed_approach(scene, runway, camera, rng)
    ident = f"S{seed}N{index:06d}/{scene.airfield.designator:02d}"
    return Shot(ident, scene, camera, pose, random_sensor(rng), int(rng.integers(2**31)))


def _view(runway: Runway, pose: Pose, rng: np.random.Generator) -> Camera:
    """A camera that sees the runway's surroundings only; its lens may distort."""
    lens = (rng.normal(0, 0.15), rng.normal(0, 0.05), 0.0, 0.0) if rng.random() < 0.2 else ()
    unit = Camera(1, 1, 1000.0, 1000.0 * rng.uniform(0.9, 1.1), 0.0, 0.0, lens)
    box = box_around(project(unit, pose, runway.corners))
    side = float(np.exp(rng.uniform(np.log(11.0), np.log(200.0))))
    zoom = side / float((box[2:] - box[:2]).max())
    camera = Camera(1, 1, unit.fx * zoom, unit.fy * zoom, 0.0, 0.0, lens)
    out = int(np.ceil(max(1.3 * side, min(1.9 * side, 235.0)))) + 2
    window = bogo_crop(box_around(project(camera, pose, runway.corners)), out / side, out, rng, slack=0.06)
    return camera.view(window)


def _framed_approach(scene: Scene, runway: Runway, camera: Camera, rng: np.random.Generator) -> Pose:
    """A random approach, the camera turned no more than it needs for the runway to lie in the frame."""
    for _ in range(_TRIES):
        pose = random_approach(rng, scene.sky.visibility_m)
        for _ in range(4):  # turning changes the outline a little
            if not can_project(camera, pose, runway.corners).all():
                break
            box = box_around(project(camera, pose, runway.corners))
            inside = np.array([camera.width, camera.height]) - 1 - _BORDER_PX
            shift = np.maximum(_BORDER_PX - box[:2], 0) - np.maximum(box[2:] - inside, 0)
            if (box[2:] - box[:2] > inside - _BORDER_PX).any():
                break
            if not shift.any():
                return pose
            pose = _turned(pose, camera, (box[:2] + box[2:]) / 2, shift * 1.02)
    raise InputError(
        f"camera: {camera.width} x {camera.height} with fx {camera.fx:g}: no runway of {runway.length_m:.0f} m fits "
        f"into its frame in {_TRIES} approaches; take a wider lens"
    )


def _turned(pose: Pose, camera: Camera, px: Array, shift: Array) -> Pose:
    """The pose turned about the camera so that what is seen at `px` moves by `shift` pixels."""
    seen, wanted = unproject(camera, np.array([px, px + shift]))
    turn = Rotation.align_vectors(wanted[None], seen[None])[0].as_matrix()
    return Pose(pose.position_m, pose.runway_from_camera @ turn.T)


def write_dataset(
    out: str | Path,
    count: int,
    seed: int = 0,
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
    camera: Camera | None = None,
) -> Path:
    """Render `count` pictures into the folder `out`; those already there are kept.

    `camera`: whole frames as it takes them, else views around the runway (`plan_shot`). Returns the
    path of labels.csv, which appears when all are done; beside whole frames also lard.csv and
    runways.json, the same in LARD's form, for tools that read that.
    Raises InputError if the folder holds a data set of another seed or camera.
    """
    folder = Path(out)
    make_folder(folder / "images")
    _claim(folder / "dataset.json", {"seed": seed, "camera": None if camera is None else asdict(camera)})

    def one(index: int) -> tuple[dict[str, str], NewLabel, Runway]:
        name = f"images/{index:06d}.png"
        shot = plan_shot(seed, index, camera)
        if not _is_whole_png(folder / name):
            write_png(folder / name, shot.render().image)
        if progress:
            progress(index)
        return shot.row(name), NewLabel(name, shot.camera, shot.ident, shot.pose, shot.corners_px), shot.runway

    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        rows, labels, runways = zip(*pool.map(one, range(count)), strict=True)
    if camera is not None:  # LARD's whole pixels say too little of a small view
        write_labels(folder / "lard.csv", labels)
        write_database(folder / "runways.json", runways)
    write_whole(folder / "labels.csv", csv_text(COLUMNS, rows))
    return folder / "labels.csv"


def _claim(stamp: Path, made_by: dict[str, Any]) -> None:
    """Note in the folder what its pictures follow from, or refuse a folder of other pictures."""
    text = json.dumps(made_by)
    try:
        there = stamp.read_text(encoding="utf-8") if stamp.exists() else text
    except OSError as error:
        raise InputError(f"{stamp}: cannot be read: {error.strerror}; choose an empty folder") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{stamp}: not a text file; choose an empty folder") from error
    if there != text:
        raise InputError(
            f"{stamp.parent}: holds a data set of another seed or camera; choose an empty folder or the same ones"
        )
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


class LabelledDataset:
    """The examples of a data set, one a labelled runway, read when asked for."""

    def __init__(self, labels: Sequence[tuple[Picture, Array]]) -> None:
        self.labels = labels  # the picture, and the corners (4, 2) in pixels of the image they were labelled on

    def __len__(self) -> int:
        return len(self.labels)

    def __getitem__(self, index: int) -> Example:
        picture, corners = self.labels[index]
        image = read_image(picture.path)
        height, width = image.shape[:2]
        if picture.wrong_size(width, height):
            raise InputError(f"{picture.path}: {width} x {height} pixels, but its labels are for {picture.size}")
        return Example(image, picture.window(width, height).apply(corners))


def read_dataset(folder: str | Path) -> LabelledDataset:
    """A data set to train on, in any format `open_dataset` knows.

    Raises InputError naming the file, the line and the field of the first label that is wrong or
    lacks a corner, or the first picture that is missing.
    """
    data = open_dataset(folder)
    if data.refused:
        more = f" ({len(data.refused) - 1} more: see `shortfinal data check`)" if data.refused[1:] else ""
        raise InputError(f"{data.refused[0]}{more}")
    labels = []
    for picture in data.pictures:
        if not picture.path.is_file():
            raise InputError(f"{picture.path}: no such image")
        for label in picture.labels:
            if label.corners_px is None:
                raise InputError(f"{label.file}: {label.row}: not all four corners are labelled; complete or remove it")
            labels.append((picture, label.corners_px))
    return LabelledDataset(labels)
