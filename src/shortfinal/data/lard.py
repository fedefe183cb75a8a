"""LARD's label files (Ducoffe et al. 2023, arXiv 2304.09938), read into our conventions.

Four layouts are known by their columns: LARD v1 (corners A to D), LARD v2 (TR, TL, BL, BR), the
synthetic test set's short form (A to D, distance in kilometres), and v1 rows that carry the sorted
corners as well. Frames, units and the pixel centre: the table of conventions in docs/architecture.md.

LARD truncates to whole pixels a coordinate counted from the image's edge. A label is thus the
index of the pixel that holds the corner: in our convention, where that pixel's centre has the
index as its coordinate, the nearest whole number. So the import is the identity, there is no
half-pixel bias, and the error is uniform within half a pixel.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shortfinal.data.table import Row, Table, read_table
from shortfinal.errors import InputError
from shortfinal.geometry import Camera

Array = NDArray[np.float64]

# Google Earth Studio as LARD v1 sets it up: 2448 x 2048 with a strip of 300 rows above and below.
EARTH_STUDIO = Camera(2448, 2648, 3401.6, 3401.6, 1223.5, 1323.5)
WHOLE_PIXEL_SIGMA = 1 / math.sqrt(12.0)  # px: of an error uniform within half a pixel

NAUTICAL_MILE_M = 1852.0
_V1_DISTANCE_STEP_M = 0.01 * NAUTICAL_MILE_M  # to which v1 rounds, before the test set's kilometres too
_DISTANCE_UNITS_M = {"slant_distance": NAUTICAL_MILE_M, "slant_distance_km": 1000.0}

_PLACE = ("image", "airport", "runway")
_READING_ORDER = tuple("ABCD")
_NAMED = ("BL", "BR", "TR", "TL")  # top is far, bottom near, as the pilot sees them: keypoint order


@dataclass(frozen=True, eq=False)
class RunwayLabel:
    """One row of a label file, in our conventions."""

    line: int  # where the row stands in the file; the header is line 1
    image: str  # the picture's name, as the file has it
    ident: str  # landing direction, "BIRK/01"; always with two digits
    corners_px: Array  # (4, 2) near-left, near-right, far-right, far-left; full-resolution pixels
    camera: Camera | None  # that took the full-resolution image; None: the file does not say
    distance_m: float | None  # recorded, camera to the middle of the landing threshold
    distance_step_m: float  # to which that distance is rounded; 0: negligibly
    raw_order_ok: bool  # the columns were in the order their names promise
    rounding_sigma_px: float  # standard deviation that rounding gives each coordinate


def read_labels(path: str | Path, camera: Camera | None = None) -> list[RunwayLabel]:
    """All rows of a LARD label file; `;` or `,` between the columns.

    `camera` is the one that took the full-resolution images; without it the Earth Studio camera is
    taken where the rows are LARD v1's, and None elsewhere. Columns named for a corner are trusted,
    so a swap stays visible; A to D, which name none, are sorted into left and right here. Raises
    InputError, naming file, line and field, for anything that is not such a file.
    """
    return labels_of(read_table(path), camera)


def labels_of(table: Table, camera: Camera | None = None) -> list[RunwayLabel]:
    """`read_labels` of a table that has been read."""
    if not table.columns:
        raise InputError(f"{table.path}: empty; expected LARD labels with a header line")
    _check_columns(table.path, table.columns)
    if not table.records:
        raise InputError(f"{table.path}: line 1: a header without rows; expected one label per line")
    return [_label(row, camera) for row in table.rows()]


def _check_columns(path: str | Path, columns: Sequence[str]) -> None:
    """Refuse a header without a picture, a runway and four corners."""
    layouts = [_PLACE + _coordinates(corners) for corners in (_NAMED, _READING_ORDER)]
    missing = min(([name for name in layout if name not in columns] for layout in layouts), key=len)
    if missing:
        near = difflib.get_close_matches(missing[0], columns, n=3)
        hint = f" (nearest: {', '.join(near)})" if near else ""
        raise InputError(
            f"{path}: line 1: no column {', '.join(missing)}{hint}; expected image, airport, runway "
            f"and x_A, y_A to x_D, y_D or x_TL, y_TL to x_BL, y_BL; found {', '.join(columns):.200}"
        )


def _coordinates(corners: Sequence[str]) -> tuple[str, ...]:
    return tuple(f"{axis}_{corner}" for corner in corners for axis in "xy")


def _label(row: Row, given: Camera | None) -> RunwayLabel:
    camera = given or _own_camera(row)
    corners, in_order = _corners(row, camera)
    return RunwayLabel(
        line=row.line,
        image=row.text("image"),
        ident=_ident(row.text("airport"), row.text("runway")),
        corners_px=corners,
        camera=camera,
        distance_m=_distance(row),
        distance_step_m=_V1_DISTANCE_STEP_M if _is_v1(row) else 0.0,
        raw_order_ok=in_order and _goes_round(corners),
        rounding_sigma_px=WHOLE_PIXEL_SIGMA,
    )


def _own_camera(row: Row) -> Camera | None:
    """Earth Studio's, for v1 rows of its images; `height` and `width` say 1024 there, wrongly."""
    return EARTH_STUDIO if _is_v1(row) and row.get("type") in ("", "earth_studio") else None


def _is_v1(row: Row) -> bool:
    return "x_A" in row.columns


def _ident(airport: str, runway: str) -> str:
    """LARD writes runway 1 as "1" and as "01"; the database has it as "01", or 9 as "9"."""
    digits = re.match(r"\d*", runway)
    padding = "0" * (2 - len(digits.group())) if digits and digits.group() else ""
    return f"{airport}/{padding}{runway}".upper()


def _distance(row: Row) -> float | None:
    for column, unit_m in _DISTANCE_UNITS_M.items():
        if row.get(column):
            return unit_m * row.number(column, low=0.0)
    return None


def _corners(row: Row, camera: Camera | None) -> tuple[Array, bool]:
    """Corners (4, 2) in keypoint order, and whether their columns were in the order promised."""
    names = _NAMED if "x_TL" in row.columns else _READING_ORDER
    # LARD keeps runways that stick out of the picture; a corner a whole picture away is a mistake.
    width, height = (camera.width, camera.height) if camera else (math.inf, math.inf)
    px = np.array([(row.number(f"x_{n}", -width, 2 * width), row.number(f"y_{n}", -height, 2 * height)) for n in names])
    if names is _NAMED:
        px.setflags(write=False)
        return px, True
    rows_then_columns = [(v, u) for u, v in px]
    return _from_reading_order(px), rows_then_columns == sorted(rows_then_columns)


def _from_reading_order(px: Array) -> Array:
    """Corners A to D, read as text is read, into keypoint order: A and B are the far end's.

    Roll decides which of a pair is read first; the side of the runway's axis it lies on tells left
    from right at any roll.
    """
    far, near = px[:2], px[2:]
    axis = far.mean(axis=0) - near.mean(axis=0)
    near, far = (pair[np.argsort(_cross(axis, pair))] for pair in (near, far))
    corners = np.array([*near, *far[::-1]])
    corners.setflags(write=False)
    return corners


def _goes_round(corners: Array) -> bool:
    """Whether corners in keypoint order are a convex outline that turns the right way.

    Any two corners of a convex outline that change places make it cross itself or turn back.
    """
    edges = np.roll(corners, -1, axis=0) - corners
    # Seen from above the order is anticlockwise; with v down that is a negative cross product.
    return bool((_cross(edges, np.roll(edges, -1, axis=0)) < 0).all())


def _cross(a: Array, b: Array) -> Array:
    """z of the cross product of (..., 2) with (..., 2); with v down, negative where b is left of a."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
