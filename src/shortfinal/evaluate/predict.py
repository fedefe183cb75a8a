"""What a model predicts of a data set's runways, written down one by one, so that a run goes on after a stop."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shortfinal.crops import box_around, inverse_crop
from shortfinal.data.formats import CORNER_COLUMNS
from shortfinal.data.image import Image, read_image
from shortfinal.data.predictions import COLUMNS, Predictions, Target, read_predictions, triangle_text
from shortfinal.detector import KeypointDetector, crop_image
from shortfinal.errors import InputError, JobError
from shortfinal.files import claim
from shortfinal.pipeline import Sight, see

_KEPT = "predictions.csv"


def predict(
    detector: KeypointDetector,
    targets: Sequence[Target],
    folder: Path,
    made_of: dict[str, Any],
    progress: Callable[[int, int], None] | None = None,
) -> Predictions:
    """The detector's keypoints of each runway that a picture shows, looked at as in use (`pipeline.see`).

    Written to `folder`/predictions.csv as they come; those already there are kept, if the folder's are
    made of the same (`made_of`). Runways of which less than two corners are in the picture, or whose
    picture cannot be read, get a line that says so. Raises InputError if the folder's are of something
    else, JobError if it cannot be written.
    """
    claim(folder / "predictions.json", made_of, "predictions of another model or data set")
    path = folder / _KEPT
    done = _kept(path)
    try:
        with path.open("a", encoding="utf-8", newline="") as file:
            if not done:
                file.write(_line(COLUMNS))
            image, open_path = None, None
            for number, target in enumerate(targets, 1):
                if (target.picture.name, target.source) not in done:
                    if open_path != target.picture.path:
                        image, open_path = _opened(target), target.picture.path
                    file.write(_line(_record(detector, target, image, number)))
                    file.flush()
                if progress:
                    progress(number, len(targets))
    except OSError as error:
        raise JobError(f"{path}: cannot be written: {error.strerror}; run again to go on") from error
    return read_predictions(path)


def _kept(path: Path) -> set[tuple[str, str]]:
    """Picture and label of the lines there; one that was cut off by a stop is removed."""
    if not path.exists():
        return set()
    try:
        content = path.read_bytes()
        whole = content[: content.rfind(b"\n") + 1]
        if len(whole) < len(content):
            with path.open("r+b") as file:
                file.truncate(len(whole))
        rows = list(csv.DictReader(io.StringIO(whole.decode("utf-8"))))
        return {(row["image"], row["label"]) for row in rows}
    except (OSError, UnicodeDecodeError, KeyError, csv.Error) as error:
        raise InputError(f"{path}: damaged ({error!r:.60}); delete it to begin again") from error


def _opened(target: Target) -> Image | None:
    try:
        return read_image(target.picture.path)
    except InputError:
        return None  # said in the line, and among the problems of the data set where the file is missing


def _record(detector: KeypointDetector, target: Target, image: Image | None, number: int) -> list[str]:
    """A line's cells; `number` seeds the draw of a crop without the runway."""
    start = time.perf_counter()
    sight, obstacle = _seen(detector, target, image)
    elapsed_ms = 1e3 * (time.perf_counter() - start)
    cells: dict[str, Any] = {
        "image": target.picture.name, "label": target.source, "ident": target.label.ident, "obstacle": obstacle,
    }  # fmt: skip
    if sight is not None and image is not None:
        corners = sight.keypoints.mean_px[:4].ravel()
        cells |= {name: f"{value:.9g}" for name, value in zip(CORNER_COLUMNS, corners, strict=True)}
        cells["cov"] = triangle_text(sight.keypoints.cov_px[:8, :8])
        cells["score"] = f"{sight.look.present:.6g}"
        cells["enlarged"] = f"{float(sight.look.window.scale[0]):.6g}"
        cells["grey"] = f"{crop_image(image, sight.look.window).mean():.4g}"
        cells["latency_ms"] = f"{elapsed_ms:.4g}"
        beside = inverse_crop(_box(target), image.shape[1::-1], detector.info.size, np.random.default_rng(number))
        if beside is not None:
            cells["absent"] = f"{detector.look(image, beside).present:.6g}"
    return [str(cells.get(name, "")) for name in COLUMNS]


def _seen(detector: KeypointDetector, target: Target, image: Image | None) -> tuple[Sight | None, str]:
    if image is None:
        return None, "the picture cannot be read"
    if np.isfinite(target.truth_px).all(axis=1).sum() < 2:
        return None, "less than two corners are in the picture"
    try:
        sight = see(detector, image, _box(target))
    except InputError as error:
        return None, str(error)
    return sight, sight.obstacle


def _box(target: Target) -> NDArray[np.float64]:
    """Around those corners that the picture shows."""
    return box_around(target.truth_px[np.isfinite(target.truth_px).all(axis=1)])


def _line(cells: Sequence[str]) -> str:
    text = io.StringIO()
    # The reader takes a line as a row, and quotation marks as a cell's: what would break that is replaced.
    csv.writer(text, lineterminator="\n").writerow(" ".join(cell.split()).replace('"', "'") for cell in cells)
    return text.getvalue()
