"""LARD's label files, version 1 (Ducoffe et al. 2023, arXiv 2304.09938) and 2 (Bougacha et al. 2026,
arXiv 2603.26748), read into our conventions, and files in the style of version 1 written.

Four layouts are known by their columns: LARD v1 (corners A to D), LARD v2 (TR, TL, BL, BR), the
synthetic test set's short form (A to D, distance in kilometres), and v1 rows that carry the sorted
corners as well. Frames, units and the pixel centre: the table of conventions in docs/architecture.md.

LARD truncates to whole pixels a coordinate counted from the image's edge. A label is thus the
index of the pixel that holds the corner: in our convention, where that pixel's centre has the
index as its coordinate, the nearest whole number. So the import is the identity, there is no
half-pixel bias, and the error is uniform within half a pixel. Left of the picture or above it,
where only v2 has corners, truncation rounds up instead of down, and one is taken off.

What LARD records of the flight, as found by holding 78 rows of v1 and 3 of v2 against their corners
(tests/test_lard_flight.py): yaw is the true heading, clockwise from north (v1's description says
that 0 is south); pitch is from the vertical under the camera, 90 level; roll has our sign. In v1
along-track distance and height are measured along and across the runway's plane, which slopes.
v1's `lateral_path_angle` has its apex some 3 km past the threshold, and one sign on some runways,
the other on others: it is not used. In v2 heights are vertical, the angle's apex is the threshold,
and right of the centreline is positive. How `time` orders day and month nobody says: it stays text.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from shortfinal.data.table import Refusal, Row, Table, read_table
from shortfinal.errors import InputError
from shortfinal.files import write_whole
from shortfinal.geometry import Camera, Pose, as_array, frozen, so3_exp
from shortfinal.keypoints import GaussianKeypoints
from shortfinal.pose import estimate_pose
from shortfinal.runway import Runway

Array = NDArray[np.float64]

# Google Earth Studio as LARD v1 sets it up: 2448 x 2048 with a strip of 300 rows above and below.
EARTH_STUDIO = Camera(2448, 2648, 3401.6, 3401.6, 1223.5, 1323.5)
# 60 by 60 degrees on 1024 x 1024. The labels do not say; the rows at hand (flight simulator) agree to
# 1 %. One scenario file, which states size and field of view, makes the pictures of all five sources.
LARD_V2 = Camera(1024, 1024, 512 * math.sqrt(3.0), 512 * math.sqrt(3.0), 511.5, 511.5)
WHOLE_PIXEL_SIGMA = 1 / math.sqrt(12.0)  # px: of an error uniform within half a pixel

NAUTICAL_MILE_M = 1852.0
FOOT_M = 0.3048
OWN = "shortfinal"  # `type` of the rows that `write_labels` writes
_EARTH_RADIUS_M = 6_371_000.0
_V1_DISTANCE_STEP_M = 0.01 * NAUTICAL_MILE_M  # to which v1 rounds, before the test set's kilometres too
_DISTANCE_UNITS_M = {"slant_distance": NAUTICAL_MILE_M, "slant_distance_km": 1000.0}
AIMING_POINT_M = 305.0  # past the threshold: the apex of `vertical_path_angle`
_FARTHEST_PX = 1e5  # of a corner, where no camera says how large the picture is

_PLACE = ("image", "airport", "runway")
_READING_ORDER = tuple("ABCD")
_NAMED = ("BL", "BR", "TR", "TL")  # top is far, bottom near, as the pilot sees them: keypoint order
_FLIGHT = ("along_track_distance", "height_above_runway", "yaw", "pitch", "roll")
_INTRINSICS = ("width", "height", "fx", "fy", "cx", "cy")
_YES, _NO = ("1", "1.0", "true", "yes"), ("0", "0.0", "false", "no")


class Source(NamedTuple):
    """What LARD made its pictures with."""

    camera: Camera | None  # None: LARD does not say
    database: str  # LARD's file that holds the runways as this source shows them


# By LARD's version, and the column `type` (the hub's subsets are ges, flsim, xplane, arcgis, bingmaps).
SOURCES = {
    (1, "earth_studio"): Source(EARTH_STUDIO, "runways_database.json"),
    (1, "real"): Source(None, "runways_database.json"),
    (2, "earth_studio"): Source(LARD_V2, "runways_db_V2_GEarth.json"),
    (2, "flight_simulator"): Source(LARD_V2, "runways_db_V2_FLSim.json"),
    (2, "xplane"): Source(LARD_V2, "runways_db_V2_XPlane.json"),
    (2, "arcgis"): Source(LARD_V2, "runways_db_V2_ArcGIS.json"),
    (2, "bingmaps"): Source(LARD_V2, "runways_db_V2_Bing.json"),
}


@dataclass(frozen=True)
class Flight:
    """What a file records of the camera's pose; `recorded_pose` makes a Pose of it."""

    along_m: float  # before the threshold
    height_m: float  # above it
    in_plane: bool  # LARD v1: both along and across the runway's plane; else level and upright
    lateral_m: float | None  # left of the centreline; None: LARD v1's is no use
    heading_deg: float  # true, clockwise from north
    pitch_deg: float  # nose up, from the horizon under the camera
    roll_deg: float  # right wing down
    wgs84: tuple[float, float, float] | None = None  # v2: latitude, longitude (degrees), altitude (m)


@dataclass(frozen=True)
class Picture:
    """What a file says of a picture beside its labels; empty or None where it says nothing."""

    source: str = ""  # LARD's `type`, e.g. "earth_studio"
    database: str = ""  # LARD's file that holds the runways as this source shows them
    scenario: str = ""
    time: str = ""
    weather: str = ""
    night: bool | None = None
    time_to_landing_s: float | None = None
    watermark_rows: int = 0  # of the strips at the top and at the bottom, each


@dataclass(frozen=True, eq=False)
class RunwayLabel:
    """One row of a label file, in our conventions."""

    line: int  # where the row stands in the file; the header is line 1
    image: str  # the picture's name, as the file has it
    ident: str  # landing direction, "BIRK/01"; always with two digits; "" of a real picture that names none
    corners_px: Array  # (4, 2) near-left, near-right, far-right, far-left; full-resolution pixels
    camera: Camera | None  # that took the full-resolution image; None: the file does not say
    distance_m: float | None  # recorded, camera to the middle of the landing threshold
    distance_step_m: float  # to which that distance is rounded; 0: negligibly
    raw_order_ok: bool  # the columns were in the order their names promise
    rounding_sigma_px: float  # standard deviation that rounding gives each coordinate
    picture: Picture = Picture()
    flight: Flight | None = None


@dataclass(frozen=True, eq=False)
class Labels(Sequence[RunwayLabel]):
    """The good rows of a file, in its order, and those that were refused."""

    rows: tuple[RunwayLabel, ...]
    refused: tuple[Refusal, ...] = ()

    def __len__(self) -> int:
        return len(self.rows)

    @overload
    def __getitem__(self, index: int) -> RunwayLabel: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[RunwayLabel, ...]: ...
    def __getitem__(self, index: int | slice) -> RunwayLabel | tuple[RunwayLabel, ...]:
        return self.rows[index]


def read_labels(path: str | Path, camera: Camera | None = None) -> Labels:
    """The rows of a LARD label file; `;` or `,` between the columns.

    `camera` is the one that took the full-resolution images; without it the row's own (columns fx,
    fy, cx, cy) or that of LARD's source is taken (SOURCES), and None elsewhere. Columns named for a
    corner are trusted, so a swap stays visible; A to D, which name none, are sorted into left and
    right here. A bad row, and one whose image and runway stood before, is in `refused`, with file,
    line and field. Raises InputError for a file without columns of labels or without any good row.
    """
    return labels_of(read_table(path), camera)


def labels_of(table: Table, camera: Camera | None = None) -> Labels:
    """`read_labels` of a table that has been read."""
    if not table.columns:
        raise InputError(f"{table.path}: empty; expected LARD labels with a header line")
    check_columns(f"{table.path}: line {table.header_line}", table.columns)
    if not table.records:
        raise InputError(f"{table.path}: line {table.header_line}: a header without rows; expected one label per line")
    seen: dict[tuple[str, str], int] = {}

    def convert(row: Row) -> RunwayLabel:
        label = label_of(row, camera)
        first = seen.setdefault((label.image, label.ident), row.line)
        if first != row.line:
            row.refuse("image", f"it stands on line {first} with the same runway; keep one of the two")
        return label

    kept, refused = table.read(convert)
    if not kept:
        raise InputError(f"{refused[0].message} (and none of the other rows is good)")
    return Labels(tuple(kept), tuple(refused))


def check_columns(where: str, columns: Sequence[str]) -> None:
    """Raises InputError for a header without a picture, a runway and four corners."""
    layouts = [_PLACE + _coordinates(corners) for corners in (_NAMED, _READING_ORDER)]
    missing = min(([name for name in layout if name not in columns] for layout in layouts), key=len)
    if missing:
        near = difflib.get_close_matches(missing[0], columns, n=3)
        hint = f" (nearest: {', '.join(near)})" if near else ""
        found = ", ".join(columns) if len(columns) > 1 else f"one column: ; or , separates them: {columns[0]!r}"
        raise InputError(
            f"{where}: no column {', '.join(missing)}{hint}; expected image, airport, runway "
            f"and x_A, y_A to x_D, y_D or x_TL, y_TL to x_BL, y_BL; found {found:.200}"
        )


def _coordinates(corners: Sequence[str]) -> tuple[str, ...]:
    return tuple(f"{axis}_{corner}" for corner in corners for axis in "xy")


def label_of(row: Row, given: Camera | None = None) -> RunwayLabel:
    """One row, with the `given` camera if there is one. Raises InputError naming file, line and field."""
    kind, v1 = row.get("type"), "x_A" in row.columns
    source = SOURCES.get((1, kind or "earth_studio") if v1 else (2, kind), Source(None, ""))
    camera = given or _own_camera(row, source)
    corners, in_order = _corners(row, camera, truncated=not v1)
    return RunwayLabel(
        line=row.line,
        image=row.text("image"),
        ident=_ident(row),
        corners_px=corners,
        camera=camera,
        distance_m=_distance(row),
        distance_step_m=_V1_DISTANCE_STEP_M if v1 and kind != OWN else 0.0,
        raw_order_ok=in_order and _goes_round(corners.tolist()),
        rounding_sigma_px=WHOLE_PIXEL_SIGMA,
        picture=_picture(row, source),
        flight=_flight(row, 0 if kind == OWN else 1 if v1 else 2),
    )


def _own_camera(row: Row, source: Source) -> Camera | None:
    """The one that the row states, or that of its source.

    `height` and `width` say 1024 of v1's pictures, wrongly, and are not looked at there.
    """
    if row.get("fx"):
        width, height = (row.number(n, 1, _FARTHEST_PX) for n in ("width", "height"))
        fx, fy = (row.number(n, 1e-3, 1e9) for n in ("fx", "fy"))
        cx, cy = (row.number(n) for n in ("cx", "cy"))
        return Camera(int(width), int(height), fx, fy, cx, cy, distortion_of(row))
    if source.camera is LARD_V2 and (row.get("width"), row.get("height")) != ("1024", "1024"):
        return None
    return source.camera


def distortion_of(row: Row) -> tuple[float, ...]:
    """OpenCV's coefficients of the cell `distortion`, spaces between them; none without one."""
    try:
        coefficients = tuple(float(k) for k in row.get("distortion").split())
        Camera(1, 1, 1.0, 1.0, 0.0, 0.0, coefficients)
    except ValueError:  # an InputError too
        row.refuse("distortion", "expected 0, 4, 5 or 8 finite numbers with spaces between them")
    return coefficients


def _ident(row: Row) -> str:
    """LARD writes runway 1 as "1" and as "01"; the database has it as "01", or 9 as "9"."""
    if row.get("type") == "real" and not (row.get("airport") and row.get("runway")):
        return ""
    airport, runway = row.text("airport"), row.text("runway")
    if not runway.isalnum() or "/" in airport:
        row.refuse("runway" if "/" not in airport else "airport", "expected a name such as 24L, of an airport LFPO")
    digits = re.match(r"\d*", runway)
    padding = "0" * (2 - len(digits.group())) if digits and digits.group() else ""
    return f"{airport}/{padding}{runway}".upper()


def _distance(row: Row) -> float | None:
    for column, unit_m in _DISTANCE_UNITS_M.items():
        if row.get(column):
            return unit_m * row.number(column, low=0.0, high=1000.0)
    return None


def _picture(row: Row, source: Source) -> Picture:
    night = row.get("night").lower()
    if night and night not in _YES + _NO:
        row.refuse("night", "expected true, false or nothing")
    return Picture(
        source=row.get("type"),
        database=source.database,
        scenario=row.get("scenario"),
        time=row.get("time"),
        weather=row.get("weather"),
        night=night in _YES if night else None,
        time_to_landing_s=row.number("time_to_landing") if row.get("time_to_landing") else None,
        watermark_rows=int(row.number("watermark_height", 0, _FARTHEST_PX)) if row.get("watermark_height") else 0,
    )


def _flight(row: Row, version: int) -> Flight | None:
    """The recorded flight, where all of it is there; LARD's version, or 0 of our own rows."""
    if not all(row.get(name) for name in _FLIGHT):
        return None
    along = NAUTICAL_MILE_M * row.number("along_track_distance", 0.0 if version else -1000.0, 1000.0)
    height = FOOT_M * row.number("height_above_runway", -1e5, 1e5)
    lateral = None
    if version != 1 and row.get("lateral_path_angle"):
        lateral = -along * math.tan(math.radians(row.number("lateral_path_angle", -89.0, 89.0)))
    if version == 2:
        along = _level_along(row, height, lateral or 0.0)
    geodetic = None
    if row.get("lat") and row.get("lon") and row.get("alt"):
        geodetic = (row.number("lat", -90, 90), row.number("lon", -360, 360), row.number("alt", -1e3, 1e5))
    return Flight(
        along_m=along,
        height_m=height,
        in_plane=version == 1,
        lateral_m=lateral,
        heading_deg=row.number("yaw", -360, 360),
        pitch_deg=row.number("pitch", 0, 180) - 90.0,
        roll_deg=row.number("roll", -180, 180),
        wgs84=geodetic,
    )


def _level_along(row: Row, height: float, lateral: float) -> float:
    """Level distance before the threshold: v2's along-track distance follows the runway's slope."""
    slant = _distance(row) or row.refuse("slant_distance", "expected the distance to the threshold")
    squared = slant**2 - height**2 - lateral**2
    if squared < 0:
        row.refuse("slant_distance", "it is less than the height above the runway; one of them is wrong")
    return math.sqrt(squared)


def _corners(row: Row, camera: Camera | None, *, truncated: bool) -> tuple[Array, bool]:
    """Corners (4, 2) in keypoint order, and whether their columns were in the order promised."""
    names = _NAMED if "x_TL" in row.columns else _READING_ORDER
    # LARD keeps runways that stick out of the picture; a corner a whole picture away is a mistake.
    width, height = (camera.width, camera.height) if camera else (_FARTHEST_PX, _FARTHEST_PX)
    px = [(row.number(f"x_{n}", -width, 2 * width), row.number(f"y_{n}", -height, 2 * height)) for n in names]
    if truncated:  # towards zero, which is up for what is left of the picture or above it
        px = [(u - (u <= -1 and u.is_integer()), v - (v <= -1 and v.is_integer())) for u, v in px]
    if names is _NAMED:
        return frozen(np.array(px)), True
    rows_then_columns = [(v, u) for u, v in px]
    return frozen(np.array(_from_reading_order(px))), rows_then_columns == sorted(rows_then_columns)


Point = Sequence[float]


def _from_reading_order(px: Sequence[Point]) -> list[Point]:
    """Corners A to D, read as text is read, into keypoint order: A and B are the far end's.

    Roll decides which of a pair is read first; the side of the runway's axis it lies on tells left
    from right at any roll.
    """
    (a, b), (c, d) = px[:2], px[2:]
    axis = (a[0] + b[0] - c[0] - d[0], a[1] + b[1] - c[1] - d[1])
    far_left, far_right = (a, b) if _cross(axis, a) <= _cross(axis, b) else (b, a)
    near_left, near_right = (c, d) if _cross(axis, c) <= _cross(axis, d) else (d, c)
    return [near_left, near_right, far_right, far_left]


def _goes_round(corners: Sequence[Point]) -> bool:
    """Whether corners in keypoint order are a convex outline that turns the right way.

    Any two corners of a convex outline that change places make it cross itself or turn back.
    """
    edges = [(corners[k - 3][0] - corners[k][0], corners[k - 3][1] - corners[k][1]) for k in range(4)]
    # Seen from above the order is anticlockwise; with v down that is a negative cross product.
    return all(_cross(edges[k], edges[k - 3]) < 0 for k in range(4))


def _cross(a: Point, b: Point) -> float:
    """z of the cross product; with v down, negative where b is left of a."""
    return a[0] * b[1] - a[1] * b[0]


# The recorded flight as a pose.

_ATTITUDE_RAD = 3e-5  # to which recorded pitch and roll hold
_HEIGHT_M = 0.05
_UNKNOWN_M, _UNKNOWN_RAD = 1e4, 1.0


def recorded_pose(label: RunwayLabel, runway: Runway, camera: Camera | None = None) -> Pose | None:
    """The camera's pose as the file records it, in the frame of `runway`; None where it records none.

    Height, along-track distance (to its rounding), pitch and roll are the record's. Yaw follows from
    where the camera sees the corners (a heading says nothing without the runway's own), and so does
    the lateral offset unless the record has a usable one. `camera` (default: the label's own) is
    needed for that; without one the answer is None, as it is where no pose fits.
    """
    flight, camera = label.flight, camera or label.camera
    if flight is None or camera is None:
        return None
    near, far = runway.corners[:2].mean(axis=0), runway.corners[2:].mean(axis=0)
    slope = math.atan2(far[2] - near[2], far[0] - near[0]) if flight.in_plane else 0.0
    up, along = (math.cos(slope), math.sin(slope)), flight.along_m
    y = flight.lateral_m or 0.0
    position = np.array([-along * up[0] - flight.height_m * up[1], y, flight.height_m * up[0] - along * up[1]])
    level = Pose.from_attitude(position, 0.0, flight.pitch_deg, flight.roll_deg).runway_from_camera
    # The horizon under the camera dips from the threshold's by the angle between their verticals;
    # v2's labels, and ours, are made on a flat Earth.
    tilt = along / _EARTH_RADIUS_M if flight.in_plane else 0.0
    vertical = level.T @ [0.0, 0.0, 1.0]
    attitude = (
        so3_exp([0.0, -tilt, 0.0]) @ level,
        _variances(_ATTITUDE_RAD) + _UNKNOWN_RAD**2 * np.outer(vertical, vertical),
    )
    sigma_y = _UNKNOWN_M if flight.lateral_m is None else _HEIGHT_M
    spread = _variances(max(label.distance_step_m / math.sqrt(12.0), _HEIGHT_M), sigma_y, _HEIGHT_M)
    keypoints = GaussianKeypoints.from_sigma(label.corners_px, label.rounding_sigma_px)
    return estimate_pose(
        keypoints, runway.corners, camera, attitude_prior=attitude, position_prior=(position, spread)
    ).pose


def _variances(*sigmas: float) -> Array:
    return np.diag(np.square(np.broadcast_to(sigmas, 3).astype(float)))


# Files in the style of LARD v1.


class NewLabel(NamedTuple):
    """A row to be written."""

    image: str  # the picture's name, relative to the file
    camera: Camera  # of the picture
    ident: str  # airport and landing direction, "LFPO/24"
    pose: Pose  # in that runway's frame
    corners_px: Array  # (4, 2) keypoint order


_V1_COLUMNS = (
    "image", "height", "width", "type", "original_dataset", "scenario", "airport", "runway", "time_to_landing",
    "weather", "night", "time", "slant_distance", "along_track_distance", "height_above_runway",
    "lateral_path_angle", "vertical_path_angle", "yaw", "pitch", "roll", "watermark_height",
    *_coordinates(_READING_ORDER),
)  # fmt: skip
_OWN_COLUMNS = ("fx", "fy", "cx", "cy", "distortion", *_coordinates(_NAMED))


def write_labels(path: str | Path, rows: Iterable[NewLabel]) -> None:
    """A CSV with LARD v1's columns, in its order and units, and behind them the camera and the named corners.

    Corners are whole pixels, A to D in reading order; `height` and `width` are the picture's own;
    `type` is "shortfinal". Level and upright distances, in NM and feet, and lateral angles as in v2
    (apex at the threshold, right positive). `yaw` counts from ten times the runway's number, as
    `write_database` lays it. Raises InputError for a name that such a file cannot hold, or a corner
    a picture's size or more outside the picture.
    """
    lines = [";".join((*_V1_COLUMNS, *_OWN_COLUMNS)), *(";".join(_cells_of(row)) for row in rows)]
    write_whole(path, "\n".join(lines) + "\n")


def _cells_of(row: NewLabel) -> list[str]:
    camera, position = row.camera, row.pose.position_m
    airport, _, direction = row.ident.partition("/")
    for name in (row.image, airport, direction):
        if not name or not name.isprintable() or name != name.strip() or any(c in name for c in ';"'):
            raise InputError(f"label {row.image!r}: {name!r} cannot stand in a LARD file; choose another name")
    corners = np.floor(as_array(row.corners_px, (4, 2), f"label {row.image}: corners_px") + 0.5).astype(int)
    size = np.array([camera.width, camera.height])
    if (corners < -size).any() or (corners > 2 * size).any():
        raise InputError(f"label {row.image}: corner {corners.tolist()} is outside the picture by more than its size")
    read = sorted(corners.tolist(), key=lambda c: (c[1], c[0]))
    along, left, height = (float(v) for v in position * [-1.0, 1.0, 1.0])
    lateral = math.degrees(math.atan2(-left, along))
    vertical = math.degrees(math.atan2(height, along + AIMING_POINT_M))
    yaw, pitch, roll = row.pose.attitude
    heading = (yaw + _laid_heading(direction) + 180.0) % 360.0 - 180.0
    numbers = [
        *(f"{metres / NAUTICAL_MILE_M:.6f}" for metres in (float(np.linalg.norm(position)), along)),
        f"{height / FOOT_M:.4f}",
        *(f"{angle:.6f}" for angle in (lateral, vertical, heading, pitch + 90.0, roll)),
    ]
    return [
        row.image, str(camera.height), str(camera.width), OWN, OWN, row.ident.replace("/", "_"), airport, direction,
        "", "", "", "", *numbers, "0", *(str(c) for corner in read for c in corner),
        *(f"{n:.9g}" for n in (camera.fx, camera.fy, camera.cx, camera.cy)),
        " ".join(f"{k:.9g}" for k in camera.distortion), *(str(c) for corner in corners.tolist() for c in corner),
    ]  # fmt: skip


def _laid_heading(direction: str) -> float:
    """Degrees: ten times the number of a landing direction; 0 without one."""
    number = re.match(r"\d{1,2}", direction)
    return 10.0 * int(number.group()) if number else 0.0


def write_database(path: str | Path, runways: Iterable[Runway]) -> None:
    """A runway database in LARD's form, for runways that lie nowhere: laid out at 0 N 0 E.

    Each is read back by `find_runway` with the same corners. Raises InputError for a runway without
    an ident such as "LFPO/24".
    """
    import json

    import pymap3d

    database: dict[str, dict[str, Any]] = {}
    for runway in runways:
        airport, _, direction = runway.ident.upper().partition("/")
        if not airport or not direction:
            raise InputError(f"runway {runway.ident!r}: a database needs a name such as LFPO/24")
        heading = math.radians(_laid_heading(direction))
        along, left, up = runway.corners.T
        east = along * math.sin(heading) - left * math.cos(heading)
        north = along * math.cos(heading) + left * math.sin(heading)
        corners = np.column_stack(pymap3d.enu2geodetic(east, north, up, 0.0, 0.0, 0.0)).tolist()
        names = zip("CDAB", corners, strict=True)  # C and D are the landing threshold's, A lies above D
        database.setdefault(airport, {})[direction] = {
            name: {"coordinate": dict(zip(("latitude", "longitude", "altitude"), corner, strict=True))}
            for name, corner in names
        }
    write_whole(path, json.dumps(database))
