"""Label files as rows of named cells, refused by file, line and column; `;` or `,` between the cells."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from shortfinal.errors import InputError


@dataclass(frozen=True)
class Row:
    """One line under the header; cells by column name, refused by file, line and column."""

    path: str | Path
    line: int
    columns: tuple[str, ...]
    cells: tuple[str, ...]

    def __post_init__(self) -> None:
        if len(self.cells) != len(self.columns):
            raise InputError(
                f"{self.path}: line {self.line}: {len(self.cells)} cells under {len(self.columns)} columns; "
                "complete the line or remove it"
            )

    def get(self, column: str) -> str:
        """The cell, or nothing if there is no such column."""
        return self.cells[self.columns.index(column)] if column in self.columns else ""

    def text(self, column: str) -> str:
        """A cell that is not empty."""
        return self.get(column) or self.refuse(column, "expected a name")

    def number(self, column: str, low: float = -math.inf, high: float = math.inf) -> float:
        """A finite number from `low` to `high`."""
        try:
            value = float(self.get(column))
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            self.refuse(column, "expected a finite number")
        if not low <= value <= high:
            self.refuse(column, f"expected {low:g} to {high:g}")
        return value

    def refuse(self, column: str, mend: str) -> NoReturn:
        """Raises InputError for the cell."""
        raise InputError(f"{self.path}: line {self.line}: {column} is {self.get(column)!r}; {mend}")


@dataclass(frozen=True)
class Table:
    """A file's header, and the lines under it that are not blank. Without a header there are no columns."""

    path: str | Path
    columns: tuple[str, ...]
    records: tuple[tuple[int, tuple[str, ...]], ...]  # line in the file, cells

    def rows(self) -> Iterator[Row]:
        """The lines as rows. Raises InputError at one with too few or too many cells."""
        return (Row(self.path, line, self.columns, cells) for line, cells in self.records)


def read_table(path: str | Path) -> Table:
    """Read a file of labels. Raises InputError if it cannot be read, or has a column twice."""
    records = []
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            delimiter = ";" if ";" in file.readline() else ","
            file.seek(0)
            reader = csv.reader(file, delimiter=delimiter)
            for cells in reader:
                stripped = tuple(cell.strip() for cell in cells)
                if any(stripped):
                    records.append((reader.line_num, stripped))
    except OSError as error:
        raise InputError(f"{path}: cannot read the labels: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not a text file of labels: {error}") from error
    columns = records[0][1] if records else ()
    twice = {name for name in columns if columns.count(name) > 1}
    if twice:
        raise InputError(f"{path}: line 1: column {min(twice)!r} stands there twice; keep one")
    return Table(path, columns, tuple(records[1:]))
