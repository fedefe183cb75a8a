"""Label files as rows of named cells, refused by file, line and column; `;` or `,` between the cells.

A line is a row: a quoted cell cannot run over its end, so that a damaged line never spoils the next.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NoReturn, TypeVar

from shortfinal.errors import InputError

T = TypeVar("T")

_BYTE_ORDER_MARKS = (b"\xff\xfe", b"\xfe\xff")  # of UTF-16 and UTF-32


@dataclass(frozen=True)
class Refusal:
    """A row that was left out, and why."""

    line: int  # where it stands in the file
    message: str  # one line: file, line, field and mend


@dataclass(frozen=True)
class Row:
    """One line under the header; cells by column name, refused by file, line and column."""

    path: str | Path
    line: int
    columns: Mapping[str, int]  # the place of each
    cells: tuple[str, ...]

    def get(self, column: str) -> str:
        """The cell, or nothing if there is no such column."""
        place = self.columns.get(column)
        return "" if place is None else self.cells[place]

    def text(self, column: str) -> str:
        """A cell that is not empty."""
        return self.get(column) or self.refuse(column, "expected a name")

    def number(self, column: str, low: float = -math.inf, high: float = math.inf) -> float:
        """A finite number from `low` to `high`."""
        cell = self.get(column)
        try:
            value = float(cell)
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or "_" in cell:  # Python reads 1_000; nobody else does
            self.refuse(column, "expected a finite number" + (", with a decimal point" if "," in cell else ""))
        if not low <= value <= high:
            self.refuse(column, f"expected {low:g} to {high:g}")
        return value

    def refuse(self, column: str, mend: str) -> NoReturn:
        """Raises InputError for the cell."""
        raise InputError(f"{self.path}: line {self.line}: {column} is {self.get(column)[:60]!r}; {mend}")


@dataclass(frozen=True)
class Table:
    """A file's header, and the lines under it that are not blank. Without a header there are no columns."""

    path: str | Path
    columns: tuple[str, ...]
    records: tuple[tuple[int, str], ...]  # line in the file, its text
    delimiter: str = ";"
    header_line: int = 1

    @cached_property
    def _places(self) -> dict[str, int]:
        return {name: place for place, name in enumerate(self.columns)}

    def rows(self) -> Iterator[Row]:
        """The lines as rows. Raises InputError at the first that is none."""
        return (self._row(line, text) for line, text in self.records)

    def read(self, convert: Callable[[Row], T]) -> tuple[list[T], list[Refusal]]:
        """What `convert` makes of the rows, and those it (or the table) refuses with InputError."""
        kept, refused = [], []
        for line, text in self.records:
            try:
                kept.append(convert(self._row(line, text)))
            except InputError as error:
                refused.append(Refusal(line, str(error)))
        return kept, refused

    def _row(self, line: int, text: str) -> Row:
        where = f"{self.path}: line {line}"
        if not text.isascii() and any("\ud800" <= c <= "\udfff" for c in text):
            raise InputError(f"{where}: holds bytes that are not UTF-8; save the file as UTF-8, or remove the line")
        if "\0" in text:
            raise InputError(f"{where}: holds a NUL byte; the file is damaged there: remove the line")
        cells = _cells(text, self.delimiter, where)
        if cells == self.columns:
            raise InputError(f"{where}: the header once more; remove the line")
        if len(cells) != len(self.columns):
            raise InputError(
                f"{where}: {len(cells)} cells under {len(self.columns)} columns; complete the line or remove it"
            )
        return Row(self.path, line, self._places, cells)


def _cells(text: str, delimiter: str, where: str) -> tuple[str, ...]:
    if '"' not in text:
        return tuple(cell.strip() for cell in text.split(delimiter))
    try:
        (cells,) = csv.reader([text], delimiter=delimiter, strict=True)
    except csv.Error:
        cells = ['"']
    if any('"' in cell for cell in cells):
        raise InputError(f"{where}: a quotation mark without its partner; remove it")
    return tuple(cell.strip() for cell in cells)


def read_table(path: str | Path) -> Table:
    """Read a file of labels. Raises InputError if it cannot be read, or has a column twice."""
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot read the labels: {error.strerror}") from error
    # What is not UTF-8 becomes surrogates here, and is refused with its row.
    text = content.decode("utf-8-sig", errors="surrogateescape").replace("\r\n", "\n").replace("\r", "\n")
    lines = [(number, line) for number, line in enumerate(text.split("\n"), start=1) if line.strip(" \t;,")]
    if not lines:
        return Table(path, (), ())
    number, header = lines[0]
    if content.startswith(_BYTE_ORDER_MARKS) or not header.replace("\t", " ").isprintable():
        raise InputError(f"{path}: not a text file of labels: line {number} is not UTF-8; save the file as UTF-8")
    delimiter = ";" if ";" in header else ","
    columns = _cells(header, delimiter, f"{path}: line {number}")
    twice = {name for name in columns if columns.count(name) > 1}
    if twice:
        raise InputError(f"{path}: line {number}: column {min(twice)!r} stands there twice; keep one")
    return Table(path, columns, tuple(lines[1:]), delimiter, number)
