"""What a data set says is true: its labelled runways in pixels of the files, and where each was seen from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shortfinal.data.augment import inside
from shortfinal.data.formats import open_dataset
from shortfinal.data.labelled import Label, LabelledPictures, Origin, Picture, Problem
from shortfinal.data.lard import recorded_pose
from shortfinal.data.predictions import Target
from shortfinal.data.yolo import image_size
from shortfinal.errors import InputError
from shortfinal.geometry import Camera, Pose
from shortfinal.runway import Runway, RunwayDatabase, load_database

Array = NDArray[np.float64]


class Known(NamedTuple):
    """A labelled runway, and what is known of how it was seen."""

    target: Target
    camera: Camera | None  # of the picture's file
    runway: Runway | None
    pose: Pose | None  # the true one


@dataclass(frozen=True)
class Truth:
    """A data set's runways, one each, and what of it cannot be used."""

    data: LabelledPictures
    known: tuple[Known, ...]
    problems: tuple[Problem, ...]
    notes: tuple[str, ...]


def read_truth(
    source: str | Path,
    *,
    runways: str | Path | None = None,
    camera: Camera | None = None,
    corners: Sequence[str] = (),
    origin: Origin = "corner",
    progress: Callable[[int, int], None] | None = None,
) -> Truth:
    """The runways of a data set of any format, in pixels of its picture files.

    `runways`: the database that has their sizes, where the labels do not; `camera`: the one that took
    the files, where the labels do not say. Corners beyond the picture are NaN: nothing can be seen of
    them. A label or a picture that cannot be used is in `problems`. Raises InputError if nothing can.
    """
    data = open_dataset(source, corners=corners, origin=origin)
    database = load_database(runways) if runways is not None else None
    known, problems = [], list(data.refused)
    finder = _Finder(database)
    for done, picture in enumerate(data.pictures, 1):
        size, what = picture.size, "no such picture"
        if picture.path.is_file():
            # A label may be made on a larger copy, and only then must the file be opened for its size.
            size = image_size(picture.path) if picture.resampled or size is None else size
            what = "cannot be read as an image"
        if picture.labels and (size is None or what == "no such picture"):
            first = picture.labels[0]
            problems.append(Problem("picture", first.file, first.row, "image", f"{picture.name}: {what}",
                                    "put it there, or remove its label", picture.name))  # fmt: skip
        for label in picture.labels:
            known.append(_known(picture, label, size, camera, finder))
        if progress:
            progress(done, len(data.pictures))
    problems += finder.problems
    if not known:
        raise InputError(f"{source}: no labelled runway; expected at least one")
    return Truth(data, tuple(known), tuple(problems), (*data.notes, *_lacking(known, database, camera)))


@dataclass
class _Finder:
    """Runways by name, each looked up once."""

    database: RunwayDatabase | None

    def __post_init__(self) -> None:
        self.found: dict[str, Runway | None] = {}
        self.problems: list[Problem] = []

    def find(self, label: Label) -> Runway | None:
        if label.runway is not None or self.database is None or not label.ident:
            return label.runway
        if label.ident not in self.found:
            self.found[label.ident] = None
            try:
                self.found[label.ident] = self.database.find(label.ident)
            except InputError as error:
                self.problems.append(Problem("runway", label.file, label.row, "runway", str(error), ""))
        return self.found[label.ident]


def _known(
    picture: Picture, label: Label, size: tuple[int, int] | None, camera: Camera | None, finder: _Finder
) -> Known:
    runway = finder.find(label)
    if size is None:  # how its labels lie in the file is not known
        return Known(Target(picture, label, np.full((4, 2), np.nan)), None, runway, None)
    window = picture.window(*size)
    places = window.apply(label.keypoints_px[:4])
    places[~inside(places, *size)] = np.nan
    mine = camera or label.camera
    if camera is None and mine is not None and (mine.width, mine.height) != size:
        mine = mine.view(window)
    pose = label.pose
    if pose is None and label.recorded is not None and runway is not None:
        pose = recorded_pose(label.recorded, runway)
    return Known(Target(picture, label, places), mine, runway, pose)


def _lacking(known: Sequence[Known], database: RunwayDatabase | None, camera: Camera | None) -> list[str]:
    """What a reader must know of what could not be judged."""
    notes = []
    for name, missing, mend in (
        ("runway's size", [k.runway is None for k in known], "pass --runways" if database is None else "see problems"),
        ("camera", [k.camera is None for k in known], "pass --camera" if camera is None else "see problems"),
        ("true pose", [k.pose is None for k in known], "only labels that record one have errors in metres"),
    ):
        if any(missing):
            what = "pose errors" if name == "true pose" else "verdicts"
            notes.append(f"{sum(missing)} of {len(known)} labels: no {name}, so no {what} ({mend})")
    return notes
