"""Predictions made elsewhere: a table (CSV), or COCO's keypoint results, as trackers and YOLO-pose write them.

CSV, one prediction a line, in our conventions (docs/architecture.md): `image`, the corners
(`near_left_u`, `near_left_v`, ... as in labels.csv), and where known `ident` (LFPO/24), `score`, sigmas
(`near_left_sigma_u`, ...) or `cov`: the 36 numbers of the covariance's upper triangle, row by row, px².

COCO: a list of results, each with `image_id` (a number of the data set's own COCO file, or the
picture's name with or without its ending), `keypoints` (x, y and anything, K times), and where known
`score`, `sigma` (2K numbers) or `cov` (2K rows); or an object with these as its `annotations`, which
may have `images` and `categories`.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shortfinal.data.formats import CORNER_COLUMNS
from shortfinal.data.labelled import LARGEST_PX, Label, Origin, Picture, Problem, corner_order
from shortfinal.data.table import Row, read_table
from shortfinal.errors import InputError
from shortfinal.files import read_json

Array = NDArray[np.float64]

SIGMA_COLUMNS = tuple(f"{name[:-1]}sigma_{name[-1]}" for name in CORNER_COLUMNS)
_NUMBERS = ("score", "absent", "enlarged", "grey", "latency_ms")  # each may be missing
COLUMNS = (
    "image", "label", "ident", *CORNER_COLUMNS, "cov", *_NUMBERS, "obstacle",
)  # fmt: skip
_UPPER = np.triu_indices(8)
_SMALLEST_PX = 1e-6  # a sigma below it is a mistake


@dataclass(frozen=True, eq=False)
class Prediction:
    """Four corners of one runway in one picture; pixels of the picture's file, in the order of keypoints."""

    where: str  # "predictions.csv: line 7"
    image: str  # the picture's name
    mean_px: Array | None  # (4, 2); None: the network looked, and something was in the way
    cov_px: Array | None  # (8, 8); None: nothing is said of it
    ident: str = ""  # "LFPO/24"; "": not said
    label: str = ""  # "labels.csv: line 7": the label it was made for; "": not said
    score: float = math.nan  # of the detector, or the probability of a runway
    absent: float = math.nan  # the same of a part of the picture without the runway
    enlarged: float = math.nan  # pixels of the network's input for one of the picture's
    grey: float = math.nan  # mean level of what was looked at, 0 to 255
    latency_ms: float = math.nan
    obstacle: str = ""  # why it cannot be used, found before any test


@dataclass(frozen=True)
class Predictions:
    """A file of them: those that are sound, and those that are not."""

    found: tuple[Prediction, ...]
    refused: tuple[Problem, ...]


def read_predictions(path: str | Path, origin: Origin = "corner") -> Predictions:
    """Predictions from a file: .csv, else COCO's JSON, whose pixels count from `origin` (`labelled`).

    A line or a result that is wrong is in `refused`, with its field and mend. Raises InputError if the
    file cannot be read or has none of the columns or lists.
    """
    file = Path(path)
    if file.suffix.lower() == ".csv":
        return _read_table(file)
    return _read_results(file, origin)


# CSV.


def _read_table(file: Path) -> Predictions:
    table = read_table(file)
    missing = [name for name in ("image", *CORNER_COLUMNS) if name not in table.columns]
    if missing:
        raise InputError(f"{file}: line 1: no column {', '.join(missing)}; expected image and the eight coordinates")
    has_sigma = [name for name in SIGMA_COLUMNS if name in table.columns]
    if has_sigma and len(has_sigma) < 8:
        lacking = next(name for name in SIGMA_COLUMNS if name not in has_sigma)
        raise InputError(f"{file}: line 1: no column {lacking}; give the sigma of all eight coordinates, or of none")
    rows, bad = table.read(lambda row: _table_row(row, bool(has_sigma)))
    problems = [_problem(InputError(r.message), str(file), f"line {r.line}") for r in bad]
    return Predictions(tuple(rows), tuple(problems))


def _table_row(row: Row, has_sigma: bool) -> Prediction:
    obstacle = row.get("obstacle")
    mean = cov = None
    if not (obstacle and not any(row.get(name) for name in CORNER_COLUMNS)):
        mean = np.array([row.number(name, -LARGEST_PX, LARGEST_PX) for name in CORNER_COLUMNS]).reshape(4, 2)
        if row.get("cov"):
            cov = _from_triangle(row)
        elif has_sigma:
            sigma = [row.number(name, _SMALLEST_PX, LARGEST_PX) for name in SIGMA_COLUMNS]
            cov = np.diag(np.square(sigma))
    extra = {name: row.number(name) if row.get(name) else math.nan for name in _NUMBERS}
    where = f"{row.path}: line {row.line}"
    ident = (row.get("ident") or row.get("runway")).upper()
    return Prediction(where, row.text("image"), mean, cov, ident, row.get("label"), obstacle=obstacle, **extra)


def _from_triangle(row: Row) -> Array:
    try:
        numbers = np.array([float(part) for part in row.get("cov").split()])
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) != 36:
        row.refuse("cov", "expected 36 numbers, the upper triangle of the 8 x 8 covariance, row by row")
    cov = np.zeros((8, 8))
    cov[_UPPER] = numbers
    cov = cov + np.triu(cov, 1).T
    if not is_covariance(cov):
        row.refuse("cov", "expected a positive definite covariance")
    return cov


def is_covariance(cov: Array) -> bool:
    """Whether (n, n) is finite, and positive definite after scaling to ones on its diagonal."""
    variance = np.diagonal(cov)
    if not (np.isfinite(cov).all() and (variance > _SMALLEST_PX**2).all()):
        return False
    sigma = np.sqrt(variance)
    try:
        factor = np.linalg.cholesky(cov / np.outer(sigma, sigma))
    except np.linalg.LinAlgError:
        return False
    return bool(np.diagonal(factor).min() > 1e-6)


def triangle_text(cov_px: Array) -> str:
    """The cell `cov` of a covariance (8, 8), to nine digits."""
    return " ".join(f"{value:.9g}" for value in cov_px[_UPPER])


# COCO.


def _read_results(file: Path, origin: Origin) -> Predictions:
    content = read_json(file, "predictions")
    names: dict[Any, str] = {}
    order = [0, 1, 2, 3]
    if isinstance(content, dict):
        names = image_names(content)
        order = _order_of(content, str(file)) or order
        content = content.get("annotations")
    if not isinstance(content, list):
        raise InputError(f"{file}: no list of results; expected COCO's keypoint results, or a .csv")
    found, bad = [], []
    for number, entry in enumerate(content):
        row = f"result {number}"
        try:
            found.append(_result(entry, f"{file}: {row}", names, order, origin))
        except InputError as error:
            bad.append(_problem(error, str(file), row))
    return Predictions(tuple(found), tuple(bad))


def image_names(content: dict[str, Any]) -> dict[Any, str]:
    """File name of each image id of a COCO file's content."""
    images = content.get("images")
    entries = [e for e in images if isinstance(e, dict)] if isinstance(images, list) else []
    return {e["id"]: e["file_name"] for e in entries if isinstance(e.get("id"), (int, str)) and "file_name" in e}


def _order_of(content: dict[str, Any], where: str) -> list[int] | None:
    for category in content.get("categories") or ():
        if isinstance(category, dict) and isinstance(category.get("keypoints"), list):
            return corner_order([str(name) for name in category["keypoints"]], (), where)[:4]
    return None


def _result(entry: Any, where: str, names: dict[Any, str], order: Sequence[int], origin: Origin) -> Prediction:
    def refuse(field: str, what: str, mend: str) -> InputError:
        return InputError(f"{where}: {field} is {what:.60}; {mend}")

    def numbers(field: str, values: Any, count: int | None = None) -> Array:
        try:
            table = np.array(values, np.float64).ravel()
        except (TypeError, ValueError):
            table = np.empty(0)
        if table.size == 0 or (count is not None and table.size != count):
            raise refuse(field, repr(values), f"expected {count or 'a list of'} numbers")
        if not np.isfinite(table).all():
            raise refuse(field, "not finite", "expected finite numbers")
        return table

    if not isinstance(entry, dict):
        raise refuse("result", repr(entry), "expected an object with image_id and keypoints")
    key = entry.get("image_id")
    if isinstance(key, bool) or not isinstance(key, (int, str)):
        raise refuse("image_id", repr(key), "expected a number, or the picture's name")
    values = numbers("keypoints", entry.get("keypoints"))
    count = values.size // 3
    if values.size % 3 or count < 4:
        raise refuse("keypoints", f"{values.size} numbers", "expected x, y, score of at least four keypoints")
    mean = values.reshape(-1, 3)[list(order), :2]
    if np.abs(mean).max() > LARGEST_PX:
        raise refuse("keypoints", f"{np.abs(mean).max():g}", "no pixel of any image")
    cov = None
    rows = np.ravel([[2 * k, 2 * k + 1] for k in order])
    if entry.get("cov") is not None:
        cov = numbers("cov", entry["cov"], (2 * count) ** 2).reshape(2 * count, -1)[np.ix_(rows, rows)]
        if not np.allclose(cov, cov.T, rtol=1e-6, atol=1e-12) or not is_covariance(cov):
            raise refuse("cov", "no covariance", "expected a symmetric, positive definite one")
    elif entry.get("sigma") is not None:
        sigma = numbers("sigma", entry["sigma"], 2 * count)[rows]
        if not (sigma > _SMALLEST_PX).all():
            raise refuse("sigma", f"{sigma.min():g}", "expected numbers above 0")
        cov = np.diag(sigma**2)
    score = entry.get("score")
    attributes = entry.get("attributes")
    ident = entry.get("runway") or (attributes.get("runway") if isinstance(attributes, dict) else "")
    return Prediction(
        where, names.get(key, str(key)), mean - (0.5 if origin == "corner" else 0.0), cov,
        str(ident or "").upper(), score=float(score) if isinstance(score, (int, float)) else math.nan,
    )  # fmt: skip


def _problem(error: InputError, file: str, row: str) -> Problem:
    what, _, mend = str(error).removeprefix(f"{file}: ").removeprefix(f"{row}: ").partition("; ")
    return Problem("prediction", file, row, what.partition(" is ")[0] if " is " in what else "", what, mend)


# To labels.


class Target(NamedTuple):
    """A labelled runway, and where it is in the picture's file."""

    picture: Picture
    label: Label
    truth_px: Array  # (4, 2)

    @property
    def source(self) -> str:
        """Where the label stands: "labels.csv: line 7"."""
        return f"{Path(self.label.file).name}: {self.label.row}"


def match(
    targets: Sequence[Target], predictions: Sequence[Prediction]
) -> tuple[list[Prediction | None], list[Problem]]:
    """The prediction of each labelled runway (N,), or None; and the predictions that are of no labelled picture.

    Pictures are known by name, else by its last part without the ending (numbers by their value). In
    a picture a prediction is of the label it was made for, or of a runway of the same identifier, where
    both say one; of several the highest score counts, and runways that predictions do not tell apart get
    the one nearest by.
    """
    names = dict.fromkeys(target.picture.name for target in targets)
    short: dict[str, list[str]] = defaultdict(list)
    for name in names:
        short[_key(name)].append(name)
    waiting: dict[str, list[Prediction]] = defaultdict(list)
    strangers = []
    for prediction in predictions:
        image = prediction.image
        called = [image] if image in names else short.get(_key(image), [])
        if len(called) == 1:
            waiting[called[0]].append(prediction)
        else:
            file, _, row = prediction.where.rpartition(": ")
            what = f"{len(called)} pictures are" if called else "no labelled picture is"
            strangers.append(Problem("unmatched", file, row, "image", f"{what} called {image!r}", "", image))
    for several in waiting.values():
        several.sort(key=lambda p: -p.score if p.score == p.score else 0.0)
    runways = Counter(target.picture.name for target in targets)
    matched: list[Prediction | None] = []
    for target in targets:
        mine = waiting[target.picture.name]
        fitting = [p for p in mine if _fits(p, target)]
        alone = runways[target.picture.name] == 1
        best = fitting[:1] if alone else sorted(fitting, key=lambda p: _apart(p, target))[:1]
        matched += best or [None]
        waiting[target.picture.name] = [p for p in mine if p not in best]
    return matched, strangers


def _key(name: str) -> str:
    stem = Path(name).stem
    return str(int(stem)) if stem.isdecimal() else stem


def _fits(prediction: Prediction, target: Target) -> bool:
    if prediction.label:
        return prediction.label == target.source
    return not (prediction.ident and target.label.ident) or prediction.ident == target.label.ident


def _apart(prediction: Prediction, target: Target) -> float:
    return math.inf if prediction.mean_px is None else float(np.abs(prediction.mean_px - target.truth_px).mean())
