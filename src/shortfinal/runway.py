"""The runway: named points in metres, from its size, from WGS84, or by name from a database."""

from __future__ import annotations

import difflib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shortfinal.errors import InputError
from shortfinal.files import read_json
from shortfinal.geometry import as_array

Array = NDArray[np.float64]

_LONGEST_M = 1e5
DATABASE_VARIABLE = "SHORTFINAL_RUNWAYS"

# ICAO Annex 14 vol. I, Table 5-1, of ranges the least: from which landing distance on, where the
# marking begins, width of a stripe, space between the stripes. A length of 45 m lies in every range.
_AIMING_POINT_M = (
    (2400.0, 400.0, 6.0, 18.0),
    (1200.0, 300.0, 6.0, 18.0),
    (800.0, 250.0, 6.0, 9.0),
    (0.0, 150.0, 4.0, 6.0),
)
_STRIPE_LENGTH_M = 45.0
_MARGIN_M = 2.0  # from the edge; the renderer keeps it as well


@dataclass(frozen=True, eq=False)
class Runway:
    """A landing direction of a runway, in its own frame (origin: centre of the landing threshold).

    `corners` (4, 3), metres, in keypoint order: near-left, near-right, far-right, far-left. Given
    none, they are the flat rectangle. Raises InputError for a size that is not positive.
    """

    length_m: float
    width_m: float
    ident: str = ""  # airport and landing direction, e.g. "LFPO/24"
    corners: Array = None  # type: ignore[assignment]  # set from the size if not given

    def __post_init__(self) -> None:
        for name in ("length_m", "width_m"):
            value = getattr(self, name)
            number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
            if not (number and 0 < value < _LONGEST_M):
                raise InputError(f"runway {self.ident}: {name} is {value!r}; it must be > 0, in metres")
        half = self.width_m / 2
        flat = [[0, half, 0], [0, -half, 0], [self.length_m, -half, 0], [self.length_m, half, 0]]
        given: ArrayLike = flat if self.corners is None else self.corners
        object.__setattr__(self, "corners", as_array(given, (4, 3), "corners"))

    @property
    def edges(self) -> Array:
        """Left and right edge (2, 2, 3), metres: of each the near end, then the far one."""
        near_left, near_right, far_right, far_left = self.corners
        edges: Array = np.array([[near_left, far_left], [near_right, far_right]])
        return edges

    @property
    def aiming_point(self) -> Array:
        """Outer corners (4, 3) of the aiming-point marking, metres, in the order of the runway's corners.

        By ICAO Annex 14 for a landing distance of `length_m`, on the surface between the corners, and
        no nearer to the edges than the width allows. What is painted may differ: real markings stand
        at the visual slope indicator where there is one. Raises InputError for a runway too small.
        """
        begin, width, space = next(row[1:] for row in _AIMING_POINT_M if self.length_m >= row[0])
        half = min(space / 2 + width, self.width_m / 2 - _MARGIN_M)
        if half <= space / 2 or begin + _STRIPE_LENGTH_M > self.length_m:
            raise InputError(
                f"runway {self.ident}: {self.length_m:.0f} m by {self.width_m:.0f} m has no room for an aiming point"
            )
        along = np.array([0, 0, 1, 1])[:, None] * _STRIPE_LENGTH_M / self.length_m + begin / self.length_m
        leftward = 0.5 + np.array([1, -1, -1, 1])[:, None] * half / self.width_m
        near_left, near_right, far_right, far_left = self.corners
        left, right = near_left + along * (far_left - near_left), near_right + along * (far_right - near_right)
        marking: Array = right + leftward * (left - right)
        return marking

    @classmethod
    def from_corners_wgs84(cls, corners: ArrayLike, ident: str = "") -> Runway:
        """From four corners (4, 3): latitude, longitude (degrees), height over the ellipsoid (m).

        The first two are the landing threshold's, the last two the far end's; left and right are
        told apart here. z is up at the threshold and x lies level along the centreline, so the far
        end keeps its own elevation and the Earth's curvature. Raises InputError if the four do not
        make a runway (a shape with width over length, crossed, or with an impossible coordinate).
        """
        lla = as_array(corners, (4, 3), f"runway {ident}: corners")
        if (np.abs(lla[:, 0]) > 90).any() or (np.abs(lla[:, 1]) > 360).any():
            raise InputError(f"runway {ident}: corners must be latitude, longitude (degrees), height (m)")
        import pymap3d

        mean = lla[:2].mean(axis=0)
        enu = np.column_stack(pymap3d.geodetic2enu(*lla.T, *mean))
        centre, far = enu[:2].mean(axis=0), enu[2:].mean(axis=0)
        heading = (far - centre)[:2] / max(1e-9, float(np.linalg.norm((far - centre)[:2])))
        # Rows: along, left (a quarter turn from along), up.
        runway_from_enu = np.array([[*heading, 0.0], [-heading[1], heading[0], 0.0], [0.0, 0.0, 1.0]])
        local = (enu - centre) @ runway_from_enu.T
        near, end = (pair[np.argsort(-pair[:, 1])] for pair in (local[:2], local[2:]))
        length = float(end[:, 0].mean() - near[:, 0].mean())
        width = float(np.mean([near[0, 1] - near[1, 1], end[0, 1] - end[1, 1]]))
        if not 0 < width < length:
            raise InputError(f"runway {ident}: the corners give {length:.0f} m by {width:.0f} m; check their order")
        return cls(length, width, ident, np.vstack([near, end[::-1]]))

    @classmethod
    def from_thresholds_wgs84(cls, threshold: ArrayLike, end: ArrayLike, width_m: float, ident: str = "") -> Runway:
        """From the centres of both ends (3,): latitude, longitude (degrees), height (m)."""
        a, b = as_array(threshold, (3,), "threshold"), as_array(end, (3,), "end")
        import pymap3d

        east, north, up = pymap3d.geodetic2enu(*b, *a)
        length = float(np.hypot(east, north))
        half = width_m / 2
        corners = [[0, half, 0], [0, -half, 0], [length, -half, up], [length, half, up]]
        return cls(length, width_m, ident, np.array(corners))


def find_runway(ident: str, database: str | Path | None = None) -> Runway:
    """The runway named "AIRPORT/DIRECTION" (e.g. "LFPO/24") in a LARD runway database (JSON).

    The file is `database`, or the one the environment variable SHORTFINAL_RUNWAYS names. Raises
    InputError, with the nearest names, if there is no such file or runway.
    """
    path = database or os.environ.get(DATABASE_VARIABLE)
    if not path:
        raise InputError(
            f"runway {ident}: no runway database; pass its path or set {DATABASE_VARIABLE} to a LARD-style JSON file"
        )
    return find_in_database(load_database(path), ident, str(path))


def load_database(path: str | Path) -> dict[str, Any]:
    """The database file as it is: {airport: {direction: {A, B, C, D: ...}}}. Raises InputError."""
    content = read_json(path, "runway database")
    if not isinstance(content, dict) or not all(isinstance(v, dict) for v in content.values()):
        raise InputError(f"{path}: expected {{airport: {{direction: corners}}}} as in LARD's database")
    return content


def find_in_database(database: dict[str, Any], ident: str, name: str = "database") -> Runway:
    """One runway of a loaded database. LARD's C and D are the landing threshold, A and B the far end."""
    airport, _, direction = ident.strip().upper().replace("-", "/").partition("/")
    entry = database.get(airport, {}).get(direction) or database.get(airport, {}).get(direction.lstrip("0"))
    if entry is None:
        known = [f"{a}/{d}" for a, directions in database.items() for d in directions]
        near = [k for k in known if k.startswith(airport + "/")] or difflib.get_close_matches(
            f"{airport}/{direction}", known, n=3, cutoff=0.4
        )
        hint = f"; nearest: {', '.join(near[:6])}" if near else ""
        raise InputError(f"{name}: unknown runway {ident!r} among {len(known)}{hint}")
    try:
        coordinates = [entry[corner]["coordinate"] for corner in "CDBA"]
        corners = [[c["latitude"], c["longitude"], c["altitude"]] for c in coordinates]
    except (KeyError, TypeError) as error:
        raise InputError(f"{name}: runway {ident}: no WGS84 coordinate for corner ({error})") from error
    return Runway.from_corners_wgs84(corners, f"{airport}/{direction}")
