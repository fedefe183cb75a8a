"""A folder of images with labels or boxes, as frames ready for the pipeline."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shortfinal.crops import box_around
from shortfinal.data.image import read_image
from shortfinal.data.lard import labels_of
from shortfinal.data.table import Refusal, Row, read_table
from shortfinal.errors import InputError
from shortfinal.files import read_toml
from shortfinal.geometry import Camera, PixelWindow
from shortfinal.runway import Runway, RunwayDatabase, load_database

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_BOX = ("left", "top", "right", "bottom")


@dataclass(frozen=True, eq=False)
class Frame:
    """An image and what is known of it beforehand."""

    name: str
    image: Image  # (h, w, 3) RGB
    camera: Camera  # of this image's size
    runway: Runway
    box: Array  # (4,) left, top, right, bottom, px
    truth_px: Array | None = None  # (4, 2) labelled corners, keypoint order
    distance_m: float | None = None  # recorded, camera to the middle of the landing threshold


class LabelledFolder:
    """The rows of a label file, each with its image from the folder.

    `labels` has LARD's columns (v1 or v2), or image, left, top, right, bottom (pixels of the image).
    The runway is each row's own, looked up in `database`, unless one is given; the camera is the one
    that LARD's labels imply, scaled to the stored image, unless one is given. Rows that are no labels
    are left out, and listed in `refused`.
    """

    def __init__(
        self,
        folder: str | Path,
        labels: str | Path,
        *,
        camera: Camera | None = None,
        runway: Runway | None = None,
        database: str | Path | None = None,
        survey_sigma_m: float = 0.0,
    ) -> None:
        """`survey_sigma_m`: of every runway, as in `Runway`. Raises InputError naming the file, line and field that is
        wrong, before any image is read.
        """
        self.folder, self.labels = Path(folder), Path(labels)
        if not self.folder.is_dir():
            raise InputError(f"{folder}: no such folder of images")
        self._camera, self._runway, self._survey_sigma_m = camera, runway, survey_sigma_m
        self._database: RunwayDatabase | None = None
        if database is not None:
            self._database = load_database(database)
        self.refused: tuple[Refusal, ...] = ()
        self._rows = self._read()

    def __len__(self) -> int:
        return len(self._rows)

    def __iter__(self) -> Iterator[Frame]:
        return (row.frame() for row in self._rows)

    def _read(self) -> list[_Row]:
        table = read_table(self.labels)
        if set(_BOX) <= set(table.columns):
            if not table.records:
                raise InputError(f"{self.labels}: a header without rows; expected one box per line")
            return [self._boxed(row) for row in table.rows()]
        rows, labels = [], labels_of(table)
        self.refused = labels.refused
        for label in labels:
            where = f"{self.labels}: line {label.line}"
            if self._camera is None and label.camera is None:
                raise InputError(f"{where}: these labels do not say which camera took the picture; pass --camera")
            rows.append(
                _Row(
                    self._image(label.image, where),
                    self._camera,
                    label.camera,
                    self._runway_for(label.ident, where),
                    None,
                    label.corners_px,
                    label.distance_m,
                )
            )
        return rows

    def _boxed(self, cells: Row) -> _Row:
        where = f"{self.labels}: line {cells.line}"
        if self._camera is None:
            raise InputError(f"{where}: a box file does not say which camera took the picture; pass --camera")
        box = np.array([cells.number(name) for name in _BOX])
        if not (box[:2] < box[2:]).all():
            raise InputError(f"{where}: the box must have left < right and top < bottom, got {box.tolist()}")
        runway = self._runway_for(cells.get("runway"), where)
        return _Row(self._image(cells.get("image"), where), self._camera, None, runway, box, None, None)

    def _image(self, name: str, where: str) -> Path:
        """The file of that name in the folder, or in its `images`, whatever folder the label had it in."""
        candidates = [self.folder / name, self.folder / Path(name).name, self.folder / "images" / Path(name).name]
        for path in candidates:
            if name and path.is_file():
                return path
        raise InputError(f"{where}: image {name!r} is not in {self.folder}")

    def _runway_for(self, ident: str, where: str) -> Runway:
        if self._runway is not None:
            return self._runway
        if not ident:
            raise InputError(f"{where}: no runway; pass --runway")
        if self._database is None:
            raise InputError(f"{where}: runway {ident} needs a database; pass --runways")
        try:
            return replace(self._database.find(ident), survey_sigma_m=self._survey_sigma_m)
        except InputError as error:
            raise InputError(f"{where}: {error}") from error


@dataclass(frozen=True, eq=False)
class _Row:
    path: Path
    camera: Camera | None  # of the stored image
    full_camera: Camera | None  # of the image the label was made on
    runway: Runway
    box: Array | None
    corners_px: Array | None  # pixels of the full camera's image
    distance_m: float | None

    def frame(self) -> Frame:
        image = read_image(self.path)
        height, width = image.shape[:2]
        made_on = self.full_camera or self.camera
        assert made_on is not None  # the reader refuses a row without either
        stored = PixelWindow.resize(made_on.width, made_on.height, width, height)
        camera = self.camera or made_on.view(stored)
        if (camera.width, camera.height) != (width, height):
            raise InputError(
                f"{self.path}: {width} x {height} pixels, but the camera has {camera.width} x {camera.height}"
            )
        if self.corners_px is None:
            assert self.box is not None
            return Frame(self.path.name, image, camera, self.runway, self.box)
        truth = stored.apply(self.corners_px)
        return Frame(self.path.name, image, camera, self.runway, box_around(truth), truth, self.distance_m)


def read_camera(path: str | Path) -> Camera:
    """A camera from TOML: width, height, fx, fy, cx, cy and, optionally, distortion (OpenCV's order).

    Raises InputError naming the file and the field.
    """
    content = read_toml(path, "camera")
    content = content.get("camera", content)
    names = ("width", "height", "fx", "fy", "cx", "cy")
    missing = [n for n in names if n not in content]
    unknown = sorted(set(content) - {*names, "distortion"})
    if missing or unknown:
        what = f"lacks {', '.join(missing)}" if missing else f"has an unknown field {unknown[0]!r}"
        raise InputError(f"{path}: {what}; a camera has {', '.join(names)} and, optionally, distortion")
    for name in names:
        whole = name in ("width", "height")
        if isinstance(content[name], bool) or not isinstance(content[name], int if whole else (int, float)):
            raise InputError(f"{path}: {name} is {content[name]!r}; it must be a {'whole ' if whole else ''}number")
    distortion = content.get("distortion", [])
    if not isinstance(distortion, list) or not all(isinstance(k, (int, float)) for k in distortion):
        raise InputError(f"{path}: distortion is {distortion!r}; it must be a list of numbers")
    try:
        return Camera(**{n: content[n] for n in names}, distortion=tuple(distortion))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
