"""The runway: named points in metres, from its size, from WGS84, or by name from a database."""

from __future__ import annotations

import functools
import operator
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shortfinal.errors import InputError
from shortfinal.files import read_json
from shortfinal.geometry import as_array

Array = NDArray[np.float64]

_LONGEST_M = 1e5
_LEAST_KNOWN_M = 100.0
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
    none, they are the flat rectangle. The near ones are the landing threshold's; the far ones end the
    runway's surface, whether or not the threshold of the other direction is displaced. Raises
    InputError for a size that is not positive.
    """

    length_m: float
    width_m: float
    ident: str = ""  # airport and landing direction, e.g. "LFPO/24"
    corners: Array = None  # type: ignore[assignment]  # set from the size if not given
    displaced_m: float = 0.0  # how far the surface begins before the landing threshold
    # How well the corners' places are known, for each axis of each by itself; ICAO Annex 15 asks for thresholds to 1 m
    # with 95 %, which is 0.5.
    survey_sigma_m: float = 0.0

    def __post_init__(self) -> None:
        for name in ("length_m", "width_m"):
            value = getattr(self, name)
            number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
            if not (number and 0 < value < _LONGEST_M):
                raise InputError(f"runway {self.ident}: {name} is {value!r}; it must be > 0, in metres")
        if not 0 <= self.displaced_m < _LONGEST_M:
            raise InputError(f"runway {self.ident}: displaced_m is {self.displaced_m!r}; it must be >= 0, in metres")
        if not 0 <= self.survey_sigma_m < _LEAST_KNOWN_M:
            raise InputError(
                f"runway {self.ident}: survey_sigma_m is {self.survey_sigma_m!r}; it must be from 0 to "
                f"{_LEAST_KNOWN_M:g}, in metres"
            )
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
        begin, width, space = aiming_point_m(self.length_m)
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


def aiming_point_m(landing_distance_m: float) -> tuple[float, float, float]:
    """Where the aiming-point marking begins, its stripes' width, the space between, m (Annex 14, Table 5-1)."""
    return next(row[1:] for row in _AIMING_POINT_M if landing_distance_m >= row[0])


def find_runway(
    ident: str, database: str | Path | None = None, *, width_m: float | None = None, level: bool = False
) -> Runway:
    """The runway named "AIRPORT/DIRECTION", e.g. "LFPO/24", of a runway database.

    `database` is LARD's JSON file, OurAirports' runways.csv, or the folder that holds it; without it
    the environment variable SHORTFINAL_RUNWAYS names one. The airport is its ICAO code or, if
    OurAirports' airports.csv lies beside, its IATA, GPS or local code. `width_m` and `level` say what
    to take where the database gives no width or no elevation: this width, and no difference of
    elevation. Raises InputError, naming the nearest, the choice or the field, if there is no such
    file, no such runway, more than one, or too little known of it.
    """
    path = database or os.environ.get(DATABASE_VARIABLE)
    if not path:
        raise InputError(
            f"runway {ident}: no runway database; pass its path or set {DATABASE_VARIABLE} to LARD's JSON file, "
            "OurAirports' runways.csv or its folder"
        )
    return load_database(path).find(ident, width_m=width_m, level=level)


class Direction(Protocol):
    """A landing direction as a database has it."""

    @property
    def place(self) -> str:
        """Where it stands in the file."""

    @property
    def closed(self) -> bool:
        """Whether it is out of use."""

    def runway(self, ident: str, width_m: float | None, level: bool) -> Runway:
        """The runway; arguments as of `find_runway`. Raises InputError for an entry that gives none."""


@dataclass(frozen=True, eq=False)
class RunwayDatabase:
    """Runways by airport and landing direction."""

    name: str  # for messages
    airports: Mapping[str, Mapping[str, Sequence[Direction]]]  # by code and direction, in capitals, "06" and not "6"
    codes: Sequence[Mapping[str, Sequence[str]]] = ()  # airports by other codes, the first to be looked up first
    titles: Mapping[str, str] = field(default_factory=dict)  # what airports are called

    def find(self, ident: str, *, width_m: float | None = None, level: bool = False) -> Runway:
        """As `find_runway`. A closed runway is given only if no open one has its name."""
        code, direction = _parts(ident)
        airport = self._airport(code, direction, ident)
        there = self.airports[airport]
        found = there.get(direction, ())
        found = [d for d in found if not d.closed] or found
        if len(found) == 1:
            return found[0].runway(f"{airport}/{direction}", width_m, level)
        if found:
            places = " and ".join(d.place for d in found)
            raise InputError(f"{self.name}: runway {ident!r} stands there more than once, {places}; remove all but one")
        sides = [d for d in there if direction.isdigit() and re.fullmatch(rf"{direction}\D", d)]
        if sides:
            choice = " or ".join(f"{airport}/{d}" for d in sorted(sides))
            raise InputError(f"{self.name}: runway {ident!r} is ambiguous; choose {choice}")
        raise self._unknown(ident, [f"{airport}/{d}" for d in sorted(there)])

    def _airport(self, code: str, direction: str, ident: str) -> str:
        if code in self.airports:
            return code
        for kind in self.codes:
            found = kind.get(code, ())
            if len(found) == 1:
                return found[0]
            if found:
                choice = " or ".join(f"{a}/{direction} ({self.titles.get(a, 'unnamed')})" for a in sorted(found))
                raise InputError(f"{self.name}: runway {ident!r} is ambiguous; choose {choice}")
        raise self._unknown(ident, self._nearest(code, direction))

    def _nearest(self, code: str, direction: str) -> list[str]:
        """Airports of similar code, and those called so."""
        known = {key: found[0] for kind in reversed(self.codes) for key, found in kind.items()}
        known |= {airport: airport for airport in self.airports}
        unlike = {key: _unlike(code, key) for key in known}
        least = min(unlike.values(), default=3)
        close = {known[key] for key in known if unlike[key] == least <= 2}
        # The first two letters of an ICAO code are the country's.
        near = sorted(close, key=lambda a: (a[:2] != code[:2], direction not in self.airports[a], a))[:3]
        called = [a for a, title in self.titles.items() if len(code) > 2 and code in title.upper()][:3]
        names = []
        for airport in dict.fromkeys(near + called):
            title = self.titles.get(airport)
            name = f"{airport}/{direction}" if direction in self.airports[airport] else airport
            names.append(f"{name} ({title})" if title else name)
        return names

    def _unknown(self, ident: str, near: Sequence[str]) -> InputError:
        return InputError(f"{self.name}: unknown runway {ident!r}" + (f"; nearest: {', '.join(near)}" if near else ""))


def _unlike(a: str, b: str) -> int:
    """How many characters differ, read from the left or from the right; a missing one counts too."""
    differ = min(sum(map(operator.ne, a, b)), sum(map(operator.ne, reversed(a), reversed(b))))
    return int(differ + abs(len(a) - len(b)))


def load_database(path: str | Path) -> RunwayDatabase:
    """A runway database: LARD's JSON, OurAirports' runways.csv, or a folder with it; told apart by content.

    OurAirports' airports.csv is read too where it lies beside. A file is read once, until it changes.
    Raises InputError for a file that is neither.
    """
    file = Path(path) / "runways.csv" if Path(path).is_dir() else Path(path)
    beside = file.with_name("airports.csv")
    return _load(file, beside if beside.is_file() and beside != file else None, _version(file), _version(beside))


def _version(file: Path) -> tuple[int, int]:
    """What tells a changed file."""
    try:
        status = file.stat()
    except OSError:
        return (0, 0)
    return (status.st_mtime_ns, status.st_size)


@functools.lru_cache(maxsize=8)
def _load(file: Path, airports: Path | None, *_: tuple[int, int]) -> RunwayDatabase:
    try:
        with file.open("rb") as content:
            begin = content.read(4096).removeprefix(b"\xef\xbb\xbf").lstrip()
    except OSError as error:
        raise InputError(f"{file}: cannot read the runway database: {error.strerror}") from error
    if begin[:1] not in (b"{", b"["):
        from shortfinal.airports import read_ourairports

        return read_ourairports(file, airports)
    return lard_database(read_json(file, "runway database"), str(file))


def lard_database(content: Any, name: str) -> RunwayDatabase:
    """A database of LARD's JSON: {airport: {direction: {A, B, C, D: {coordinate: ...}}}}. Raises InputError."""
    if not isinstance(content, dict) or not all(isinstance(v, dict) for v in content.values()):
        raise InputError(f"{name}: expected {{airport: {{direction: corners}}}} as in LARD's database")
    airports: dict[str, dict[str, list[Direction]]] = {}
    for airport, directions in content.items():
        there = airports.setdefault(airport.upper(), {})
        for direction, corners in directions.items():
            entry = _LardDirection(name, f"as {airport}/{direction}", corners)
            there.setdefault(direction_name(direction), []).append(entry)
    return RunwayDatabase(name, airports)


@dataclass(frozen=True, eq=False)
class _LardDirection:
    file: str
    place: str
    corners: Any
    closed: bool = False

    def runway(self, ident: str, width_m: float | None, level: bool) -> Runway:
        """LARD's C and D are the landing threshold, A and B the far end; it leaves nothing out."""
        try:
            coordinates = [self.corners[corner]["coordinate"] for corner in "CDBA"]
            corners = [[c["latitude"], c["longitude"], c["altitude"]] for c in coordinates]
        except (KeyError, TypeError) as error:
            raise InputError(f"{self.file}: runway {ident}: no WGS84 coordinate for corner ({error})") from error
        return Runway.from_corners_wgs84(corners, ident)


@functools.lru_cache(maxsize=1024)
def direction_name(text: str) -> str:
    """A landing direction as databases are asked for it: in capitals, with two digits."""
    name = text.strip().upper()
    number = re.match(r"\d+", name)
    return name if number is None else number[0].lstrip("0").zfill(2) + name[number.end() :]


def _parts(ident: str) -> tuple[str, str]:
    """Airport and direction of "LFPO/24" or "LFPO-24". Codes such as "FR-0123" have a dash of their own."""
    name = ident.strip().upper()
    airport, _, direction = name.partition("/") if "/" in name else name.rpartition("-")
    return airport.strip() or name, direction_name(direction) if airport else ""
