"""OurAirports' tables (runways.csv, airports.csv) as a runway database.

What the publisher documents (ourairports.com/help/data-dictionary.html), and what follows here:

- `le_` and `he_` are the low- and the high-numbered end. Their coordinates are of "the centre of the
  end of the runway", and `length_ft` is of "the full runway surface (including displaced
  thresholds)". So the coordinates are the surface's ends; a landing threshold lies
  `displaced_threshold_ft` further in along the centreline, its elevation interpolated between the ends.
- The far end of a landing direction is the end of the surface, also where the threshold of the
  other direction is displaced: the painted runway goes on to there, as in LARD's corners A and B.
- Elevations are above mean sea level, where WGS84 heights are above the ellipsoid. A runway's frame
  has its origin on the threshold, so only the difference between the ends counts, in which the
  geoid's undulation cancels but for some centimetres to decimetres.
- The tables are volunteers' work with many holes and some mistakes. A hole is refused by field, or
  filled by what the caller passes; ends that contradict the length or the heading are refused.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from shortfinal.errors import InputError
from shortfinal.runway import Direction, Runway, RunwayDatabase, direction_name

Array = NDArray[np.float64]

FOOT_M = 0.3048

_LENGTH_TOLERANCE = 0.05  # of length_ft: rounded coordinates stay below, a mistaken one does not
_ENDS = ("latitude_deg", "longitude_deg", "elevation_ft", "displaced_threshold_ft", "heading_degT", "ident")
_RUNWAY_COLUMNS = (
    "airport_ident",
    "length_ft",
    "width_ft",
    "closed",
    *(f"{e}_{n}" for e in ("le", "he") for n in _ENDS),
)
_CODE_COLUMNS = ("icao_code", "gps_code", "iata_code", "local_code")  # in the order they are looked up
_HELIPAD = re.compile(r"|H\d*[A-Z]?", re.IGNORECASE)  # or no end at all


def read_ourairports(runways: Path, airports: Path | None = None) -> RunwayDatabase:
    """The open and closed runways of runways.csv, by the codes of airports.csv too if given.

    Raises InputError for a file that cannot be read, lacks a column, or has a line of the wrong length.
    """
    rows: dict[str, list[_Row]] = {}
    for row in _rows(runways, _RUNWAY_COLUMNS):
        if not all(_HELIPAD.fullmatch(row.text(f"{end}_ident")) for end in ("le", "he")):
            rows.setdefault(row.text("airport_ident").upper(), []).append(row)
    codes: tuple[dict[str, list[str]], ...] = tuple({} for _ in _CODE_COLUMNS)
    titles = {}
    for row in _rows(airports, ("ident", "name", "iata_code", "gps_code", "local_code")) if airports else ():
        airport = row.text("ident").upper()
        if airport in rows:
            titles[airport] = row.text("name")
            for kind, column in zip(codes, _CODE_COLUMNS, strict=True):
                code = row.text(column).upper()
                if code:
                    kind.setdefault(code, []).append(airport)
    return RunwayDatabase(str(runways), _Airports(rows), codes, titles)


class _Airports(Mapping[str, Mapping[str, Sequence[Direction]]]):
    """Landing directions by airport, worked out when asked for: most of a table never is."""

    def __init__(self, rows: dict[str, list[_Row]]) -> None:
        self._rows = rows

    def __getitem__(self, airport: str) -> Mapping[str, Sequence[Direction]]:
        there: dict[str, list[Direction]] = {}
        for row in self._rows[airport]:
            for near, far in (("le", "he"), ("he", "le")):
                name = row.text(f"{near}_ident")
                if not _HELIPAD.fullmatch(name):
                    there.setdefault(direction_name(name), []).append(_RowDirection(row, near, far))
        return there

    def __iter__(self) -> Iterator[str]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)

    def __contains__(self, airport: object) -> bool:
        return airport in self._rows


def _rows(path: Path, needed: Sequence[str]) -> Iterator[_Row]:
    """The rows of a table, by column."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, strict=True)
            columns = {name.strip(): k for k, name in enumerate(next(reader, []))}
            missing = [name for name in needed if name not in columns]
            if missing and "iata_code" in columns:
                raise InputError(f"{path}: a list of airports; pass runways.csv, or the folder with both")
            if missing:
                raise InputError(
                    f"{path}: line 1: no column {missing[0]}; expected LARD's runway database (JSON) or "
                    "OurAirports' runways.csv with its header"
                )
            for cells in reader:
                if len(cells) == len(columns):
                    yield _Row(path, reader.line_num, columns, tuple(cells))
                elif cells:
                    raise InputError(
                        f"{path}: line {reader.line_num}: {len(cells)} cells under {len(columns)} columns; "
                        "the file may be cut short: fetch it again"
                    )
    except OSError as error:
        raise InputError(f"{path}: cannot read the runway database: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not a table of OurAirports: {error}; fetch it again") from error


@dataclass(frozen=True, eq=False, slots=True)
class _Row:
    path: Path
    line: int
    columns: dict[str, int]
    cells: tuple[str, ...]  # a list would keep the garbage collector busy

    def text(self, column: str) -> str:
        return self.cells[self.columns[column]].strip() if column in self.columns else ""

    def number(self, column: str, low: float, high: float, mend: str = "correct it") -> float | None:
        """The number, or None in an empty cell."""
        if not self.text(column):
            return None
        try:
            value = float(self.text(column))
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            self.refuse(column, f"expected a number from {low:g} to {high:g}; {mend}")
        return value

    def refuse(self, column: str, why: str) -> NoReturn:
        shown = f"is {self.text(column)!r}" if self.text(column) else "is empty"
        raise InputError(f"{self.path}: line {self.line}: {column} {shown}; {why}")


@dataclass(frozen=True, eq=False, slots=True)
class _RowDirection:
    """A row, landed on from the end `near`."""

    row: _Row
    near: str
    far: str

    @property
    def place(self) -> str:
        return f"line {self.row.line}"

    @property
    def closed(self) -> bool:
        return self.row.text("closed") == "1"

    def runway(self, ident: str, width_m: float | None, level: bool) -> Runway:
        """Between the landing threshold and the far end of the surface."""
        width = self._width(width_m)
        threshold, far, displaced = self.ends_wgs84(level)
        return replace(Runway.from_thresholds_wgs84(threshold, far, width, ident), displaced_m=displaced)

    def ends_wgs84(self, level: bool = False) -> tuple[Array, Array, float]:
        """Landing threshold and far end (3,): degrees, degrees, metres above sea level; displacement (m)."""
        import pymap3d

        near, far = (np.array([*self._position(end), self._elevation(end, level)]) for end in (self.near, self.far))
        east, north, up = pymap3d.geodetic2enu(*far, *near)
        surface = math.hypot(east, north)
        self._check(surface, math.degrees(math.atan2(east, north)) % 360)
        displaced = FOOT_M * (self.row.number(f"{self.near}_displaced_threshold_ft", 0, surface / FOOT_M) or 0.0)
        share = displaced / surface
        threshold = np.array(pymap3d.enu2geodetic(share * east, share * north, share * up, *near))
        threshold[2] = near[2] + share * (far[2] - near[2])  # above sea level, where a straight line dips below
        return threshold, far, displaced

    def _width(self, given_m: float | None) -> float:
        width = self.row.number("width_ft", 0, 2000)
        if width:
            return FOOT_M * width
        return given_m or self.row.refuse("width_ft", "fill it in, or pass width_m")

    def _position(self, end: str) -> tuple[float, float]:
        position = []
        for name, limit in (("latitude_deg", 90), ("longitude_deg", 180)):
            value = self.row.number(f"{end}_{name}", -limit, limit)
            if value is None:
                self.row.refuse(f"{end}_{name}", "fill in the ends' coordinates, or pass the runway's size instead")
            position.append(value)
        return position[0], position[1]

    def _elevation(self, end: str, level: bool) -> float:
        """Metres above mean sea level. Of a level runway without any, zero: only the difference counts."""
        other = self.far if end == self.near else self.near
        known = [self.row.number(f"{e}_elevation_ft", -2000, 20000) for e in (end, other)]
        if known[0] is None and not level:
            self.row.refuse(f"{end}_elevation_ft", "fill it in, or pass level=True if the runway may be taken as level")
        return FOOT_M * next((value for value in known if value is not None), 0.0)

    def _check(self, surface_m: float, heading: float) -> None:
        """Refuse ends that contradict the row's length or heading."""
        length = self.row.number("length_ft", 0, 1e5)
        if surface_m < 1 or (length and abs(surface_m / FOOT_M / length - 1) > _LENGTH_TOLERANCE):
            self.row.refuse(
                "length_ft", f"but the ends lie {surface_m / FOOT_M:.0f} ft apart; correct it or the coordinates"
            )
        column = f"{self.near}_heading_degT"
        stated = self.row.number(column, 0, 360)
        if stated is None:
            column = f"{self.near}_ident"
            number = re.match(r"\d+", self.row.text(column))
            stated = 10.0 * int(number[0]) if number else heading
        # A quarter turn: a magnetic heading may stand there, but the ends must not have changed places.
        if abs((heading - stated + 180) % 360 - 180) > 90:
            self.row.refuse(column, f"but the ends lie on {heading:.0f} degrees; their coordinates have changed places")
