"""Rendered data sets: random approaches with exact labels, as views, as a camera's whole frames, or crops of them.

On disk: `images/000000.png`, ... and `labels.csv`, one row a picture; beside whole frames the
same in LARD's form. Every row follows from the seed and its number alone, so an interrupted run
continues where it stopped.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shortfinal.crops import bogo_crop, box_around, inverse_crop, native_crop
from shortfinal.data.formats import CAMERA_COLUMNS, CORNER_COLUMNS, POSE_COLUMNS, keypoint_columns, open_dataset
from shortfinal.data.image import Image, read_image
from shortfinal.data.labelled import Label, Picture
from shortfinal.data.lard import AIMING_POINT_M, NAUTICAL_MILE_M, NewLabel, write_database, write_labels
from shortfinal.errors import InputError
from shortfinal.files import claim, csv_text, make_folder, write_png, write_whole
from shortfinal.geometry import Camera, PixelWindow, Pose, can_project, project, unproject
from shortfinal.keypoints import AIMING_NAMES, CORNER_NAMES
from shortfinal.runway import Runway
from shortfinal.scene.render import Scene, random_scene, render
from shortfinal.scene.sensor import Sensor, random_sensor

Array = NDArray[np.float64]

COLUMNS = (
    "image", "ident", *CAMERA_COLUMNS, "distortion", "length_m", "width_m", *POSE_COLUMNS, *CORNER_COLUMNS,
    *keypoint_columns(AIMING_NAMES),
)  # fmt: skip
_TRIES, _BORDER_PX = 50, 1.0
_LARGEST_PX = 235.0  # side of a view that shows more than the runway: a crop of 224 px has room to move
# What a view shows, and how often: the runway, with some of the land or much of it; one of its ends; land only.
_VIEWS = (("runway", 0.45), ("afar", 0.2), ("end", 0.25), ("land", 0.1))


@dataclass(frozen=True, eq=False)
class Example:
    """One picture and where the keypoints are in it."""

    image: Image  # (h, w, 3) RGB
    # (K, 2), the corners first, also beyond the border; NaN: not labelled; None: no runway
    keypoints_px: Array | None
    names: tuple[str, ...] = CORNER_NAMES  # of the keypoints

    @property
    def corners_px(self) -> Array | None:
        """The corners (4, 2) alone."""
        return None if self.keypoints_px is None else self.keypoints_px[:4]


class Cone(NamedTuple):
    """From where and how an approach is seen. Ranges; of `nautical_miles` the logarithm is uniform."""

    nautical_miles: tuple[float, float]  # along track, before the threshold
    glide_deg: tuple[float, float]  # at an apex 305 m past the threshold
    lateral_deg: float  # to either side
    yaw_deg: float
    pitch_deg: tuple[float, float]
    roll_deg: float


LARD_CONE = Cone((0.08, 3.0), (2.2, 3.8), 4.0, 10.0, (-8.0, 0.0), 10.0)  # Ducoffe et al. 2023, table 1
WIDE_CONE = Cone((0.05, 4.5), (1.8, 4.5), 5.0, 12.0, (-9.0, 1.0), 12.0)


def random_approach(rng: np.random.Generator, visibility_m: float = math.inf, cone: Cone = WIDE_CONE) -> Pose:
    """A camera in the cone, no farther out than 0.7 of the visibility, where 6 % of the contrast is left."""
    nearest, farthest = cone.nautical_miles[0], min(cone.nautical_miles[1], 0.7 * visibility_m / NAUTICAL_MILE_M)
    distance = float(np.exp(rng.uniform(np.log(nearest), np.log(farthest)))) * NAUTICAL_MILE_M
    lateral, glide = np.radians([rng.uniform(-cone.lateral_deg, cone.lateral_deg), rng.uniform(*cone.glide_deg)])
    height = (distance + AIMING_POINT_M) * np.tan(glide)
    (down, up), yaw, roll = cone.pitch_deg, cone.yaw_deg, cone.roll_deg
    attitude = rng.uniform([-yaw, down, -roll], [yaw, up, roll])
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
    empty: bool = False  # the runway is not in it

    @property
    def runway(self) -> Runway:
        """The scene's, flat."""
        return replace(self.scene.runway, ident=self.ident)

    @property
    def keypoints_px(self) -> Array | None:
        """Where the corners and the aiming point's marking will be (8, 2), beyond the border too; NaN for what is
        not painted, or behind the camera. None if the picture shows land only.
        """
        if self.empty:
            return None
        places, marking = np.full((8, 2), np.nan), self.scene.aiming_marking
        places[:4] = project(self.camera, self.pose, self.runway.corners)
        if marking is not None and can_project(self.camera, self.pose, marking).all():
            places[4:] = project(self.camera, self.pose, marking)
        return places

    @property
    def corners_px(self) -> Array | None:
        """The corners (4, 2) alone."""
        return None if self.keypoints_px is None else self.keypoints_px[:4]

    def render(self) -> Example:
        """Take it."""
        image = render(self.scene, self.camera, self.pose, self.sensor, samples=3, seed=self.noise_seed)
        return Example(image, self.keypoints_px, (*CORNER_NAMES, *AIMING_NAMES))

    def row(self, name: str) -> dict[str, str]:
        """Its line in labels.csv, to nine digits."""
        c, r = self.camera, self.runway
        lens = " ".join(f"{k:.9g}" for k in c.distortion)
        cells = [name, r.ident, c.width, c.height, *(f"{n:.12g}" for n in (c.fx, c.fy, c.cx, c.cy)), lens]
        numbers = [f"{n:.9g}" for n in (r.length_m, r.width_m, *self.pose.position_m, *self.pose.attitude)]
        places = np.full(16, np.nan) if self.keypoints_px is None else self.keypoints_px.ravel()
        labels = ["" if np.isnan(n) else f"{n:.9g}" for n in places]
        return dict(zip(COLUMNS, [*map(str, cells), *numbers, *labels], strict=True))


def plan_shot(seed: int, index: int, camera: Camera | None = None, crop_px: int | None = None) -> Shot:
    """Picture number `index` of the data set `seed`.

    With a camera: the whole frame it takes, the runway inside; with `crop_px` too, only a crop of
    that side, as the paper draws it (`crops.native_crop`), from LARD's own cone. Without: a view as a
    camera sees it from afar or near, with room for the training crop to move: of the runway, 11 to
    200 pixels long (log-uniform), of one end of it, or of land without one.
    Raises InputError for a camera that cannot hold a runway.
    """
    rng = np.random.default_rng([seed, index])
    scene = random_scene(rng)
    runway, empty = scene.runway, False
    if camera is None:
        what = str(rng.choice([name for name, _ in _VIEWS], p=[share for _, share in _VIEWS]))
        if empty := what == "land":  # another runway would be a runway
            scene = scene._replace(airfield=scene.airfield._replace(other=np.zeros(6)))
        pose = random_approach(rng, scene.sky.visibility_m)
        camera = _view(runway, pose, what, rng)
    elif crop_px is None:
        pose = _framed_approach(scene, runway, camera, WIDE_CONE, rng)
    else:
        pose = _framed_approach(scene, runway, camera, LARD_CONE, rng)
        box = box_around(project(camera, pose, runway.corners))
        camera = camera.view(native_crop(box, (camera.width, camera.height), rng, crop_px))
    ident = f"S{seed}N{index:06d}/{scene.airfield.designator:02d}"
    return Shot(ident, scene, camera, pose, random_sensor(rng), int(rng.integers(2**31)), empty)


def _view(runway: Runway, pose: Pose, what: str, rng: np.random.Generator) -> Camera:
    """A camera that sees `what` of the runway; its lens may distort."""
    lens = (rng.normal(0, 0.15), rng.normal(0, 0.05), 0.0, 0.0) if rng.random() < 0.2 else ()
    unit = Camera(1, 1, 1000.0, 1000.0 * rng.uniform(0.9, 1.1), 0.0, 0.0, lens)
    points = runway.corners
    if what == "end":
        points = points[:2] if rng.random() < 0.3 else points[2:]
    box = box_around(project(unit, pose, points))
    side = float(np.exp(rng.uniform(np.log(11.0), np.log(110.0 if what == "afar" else 200.0))))
    zoom = side / float((box[2:] - box[:2]).max())
    camera = Camera(1, 1, unit.fx * zoom, unit.fy * zoom, 0.0, 0.0, lens)
    box = box_around(project(camera, pose, points))
    longest = {"runway": 1.9 * side, "afar": _LARGEST_PX, "end": 3.4 * side, "land": 1.9 * side}[what]
    out = int(np.ceil(max(1.3 * side, min(longest, _LARGEST_PX)))) + 2
    if what == "land":
        return camera.view(_beside(box, out, rng))
    return camera.view(bogo_crop(box, out / side, out, rng, slack=0.06))


def _beside(box: Array, out: int, rng: np.random.Generator) -> PixelWindow:
    """A window of `out` pixels at a random place around the box, apart from it."""
    reach = rng.uniform(1.5, 8.0, 2) * (box[2:] - box[:2]).max()
    origin = np.floor(box[:2] - rng.uniform(0.2, 0.8, 2) * reach)
    width, height = (int(n) for n in np.ceil(box[2:] - origin + reach))
    moved = box - np.tile(origin, 2)
    while (window := inverse_crop(moved, (width, height), out, rng)) is None:
        width, height = width + out, height + out
    return replace(window, left=window.left + float(origin[0]), top=window.top + float(origin[1]))


def _framed_approach(scene: Scene, runway: Runway, camera: Camera, cone: Cone, rng: np.random.Generator) -> Pose:
    """A random approach, the camera turned no more than it needs for the runway to lie in the frame."""
    for _ in range(_TRIES):
        pose = random_approach(rng, scene.sky.visibility_m, cone)
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
    crop_px: int | None = None,
) -> Path:
    """Render `count` pictures into the folder `out`; those already there are kept.

    `camera`: whole frames as it takes them, or with `crop_px` crops of them, else views around the
    runway (`plan_shot`). Returns the path of labels.csv, which appears when all are done; beside whole
    frames also lard.csv and runways.json, the same in LARD's form, for tools that read that.
    Raises InputError if the folder holds a data set of another seed, camera or crop.
    """
    if crop_px is not None and camera is None:
        raise InputError("crop_px: crops are of a camera's frames; give the camera too")
    folder = Path(out)
    make_folder(folder / "images")
    made_by: dict[str, Any] = {"seed": seed, "camera": None if camera is None else asdict(camera)}
    if crop_px is not None:
        made_by["crop_px"] = crop_px
    claim(folder / "dataset.json", made_by, "a data set of another seed, camera or crop")

    def one(index: int) -> tuple[dict[str, str], NewLabel, Runway]:
        name = f"images/{index:06d}.png"
        shot = plan_shot(seed, index, camera, crop_px)
        if not _is_whole_png(folder / name):
            write_png(folder / name, shot.render().image)
        if progress:
            progress(index)
        corners = np.full((4, 2), np.nan) if shot.corners_px is None else shot.corners_px
        return shot.row(name), NewLabel(name, shot.camera, shot.ident, shot.pose, corners), shot.runway

    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        rows, labels, runways = zip(*pool.map(one, range(count)), strict=True)
    if camera is not None and crop_px is None:  # LARD's whole pixels say too little of a small view
        write_labels(folder / "lard.csv", labels)
        write_database(folder / "runways.json", runways)
    write_whole(folder / "labels.csv", csv_text(COLUMNS, rows))
    return folder / "labels.csv"


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
    """The examples of a data set, each a labelled runway or a picture without any, read when asked for."""

    def __init__(
        self, labels: Sequence[tuple[Picture, Label | None]], keypoints: tuple[str, ...] = CORNER_NAMES
    ) -> None:
        self.labels, self.keypoints = labels, keypoints  # None: a picture without a runway

    def __len__(self) -> int:
        return len(self.labels)

    def __getitem__(self, index: int) -> Example:
        picture, label = self.labels[index]
        image = read_image(picture.path)
        height, width = image.shape[:2]
        if picture.wrong_size(width, height):
            raise InputError(f"{picture.path}: {width} x {height} pixels, but its labels are for {picture.size}")
        if label is None:
            return Example(image, None, self.keypoints)
        places = np.full((len(self.keypoints), 2), np.nan)
        for row, name in enumerate(self.keypoints):
            if name in label.names and label.visible[label.names.index(name)] > 0:
                places[row] = label.keypoints_px[label.names.index(name)]
        return Example(image, picture.window(width, height).apply(places), self.keypoints)


def read_dataset(folder: str | Path, keypoints: tuple[str, ...] = CORNER_NAMES) -> LabelledDataset:
    """A data set to train on, in any format `open_dataset` knows, and of its keypoints those named.

    A runway of which some keypoints are labelled is an example too. Raises InputError naming the file,
    the line and the field of the first label that is wrong, the first picture that is missing, or a
    keypoint that no label has.
    """
    data = open_dataset(folder)
    if data.refused:
        more = f" ({len(data.refused) - 1} more: see `shortfinal data check`)" if data.refused[1:] else ""
        raise InputError(f"{data.refused[0]}{more}")
    labels: list[tuple[Picture, Label | None]] = []
    for picture in data.pictures:
        if not picture.path.is_file():
            raise InputError(f"{picture.path}: no such image")
        if not picture.labels:
            labels.append((picture, None))
        labels += [(picture, label) for label in picture.labels]
    known = {name for _, label in labels if label for name in label.names}
    for name in keypoints[4:]:
        if known and name not in known:
            raise InputError(f"{folder}: no label has the keypoint {name}; it has {', '.join(sorted(known))}")
    return LabelledDataset(labels, keypoints)
