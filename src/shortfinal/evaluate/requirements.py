"""Requirements that a user writes in TOML, held against figures with their 95 % intervals.

A requirement is met only where that is shown: a figure that is absent, of too few rows, or whose interval
reaches beyond the bound is "not shown", which is no pass.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from shortfinal.errors import InputError
from shortfinal.evaluate.figures import (
    BOUNDS,
    CORNERS,
    LATENCY,
    LIGHTS,
    METRICS,
    OF_LIMITS,
    OVER,
    POSES,
    SCOPE,
    TESTED,
    is_share,
)
from shortfinal.evaluate.rows import AXES, DECISIONS, Figure, Flags, Rows
from shortfinal.files import read_toml
from shortfinal.protection import AlertLimits

Judge = Literal["interval", "estimate"]
Range = tuple[float, float]
SHOWN, FAILED, NOT_SHOWN = "shown", "failed", "not shown"


@dataclass(frozen=True)
class Condition:
    """Which rows a requirement is about: those that satisfy every field that is given."""

    airport: tuple[str, ...] = ()  # one of these
    ident: tuple[str, ...] = ()  # one of these, "LFPO/24"
    distance_m: Range | None = None  # low <= distance < high
    glide_deg: Range | None = None  # low <= angle < high
    light: tuple[str, ...] = ()  # of LIGHTS
    decision: tuple[str, ...] = ()  # of DECISIONS

    def select(self, rows: Rows) -> Flags:
        """Which rows (N,). A row of which a field is not known is not among them."""
        chosen = np.ones(len(rows), np.bool_)
        for name, wanted in self.given():
            values = getattr(rows, name)
            if name in _RANGES:
                chosen &= (values >= wanted[0]) & (values < wanted[1])  # NaN: neither
            else:
                chosen &= np.isin(values.astype(str), wanted)
        return chosen

    def __str__(self) -> str:
        return "; ".join(
            _range_text(name, w) if name in _RANGES else f"{name} {', '.join(w)}" for name, w in self.given()
        )

    def given(self) -> list[tuple[str, Any]]:
        """The fields that are given: name and value."""
        values = [(field.name, getattr(self, field.name)) for field in fields(self)]
        return [(name, wanted) for name, wanted in values if wanted]


_RANGES = {"distance_m": ("distance", "m"), "glide_deg": ("glide angle", "degrees")}
_WORDS = {"airport": (), "ident": (), "light": LIGHTS, "decision": DECISIONS}  # what each may be; (): any text


def _range_text(name: str, wanted: Range) -> str:
    label, unit = _RANGES[name]
    low, high = wanted
    return f"{label} from {low:g} {unit}" if math.isinf(high) else f"{label} {low:g} to {high:g} {unit}"


@dataclass(frozen=True)
class Requirement:
    """A bound on one figure, of the rows that satisfy a condition."""

    id: str
    metric: str  # of METRICS
    text: str = ""  # what it is for, in the user's words
    at_most: float | None = None  # one of the two, or both
    at_least: float | None = None
    where: Condition = Condition()
    fewest: int = 20  # rows that the figure must be of
    judge: Judge = "interval"  # what must satisfy the bound: the whole 95 % interval, or the estimate alone

    @property
    def bound(self) -> str:
        """In words: "at most 0.6"."""
        ends = (("at least", self.at_least), ("at most", self.at_most))
        return " and ".join(f"{words} {end:g}" for words, end in ends if end is not None)

    def holds(self, low: float, high: float) -> bool:
        """Whether everything from `low` to `high` satisfies the bound."""
        above = self.at_least is None or low >= self.at_least
        return above and (self.at_most is None or high <= self.at_most)


@dataclass(frozen=True)
class Requirements:
    """A file of requirements."""

    alert_limits: AlertLimits | None  # of the operation, for "available" and "hazardous"
    requirements: tuple[Requirement, ...]


# Reading


def read_requirements(path: str | Path) -> Requirements:
    """Requirements from a TOML file (examples/requirements.toml).

    Raises InputError, one line that names the file, the requirement (by id, or by its number from 1), the field
    and the mend, for whatever is missing, unknown or of no use.
    """
    content = read_toml(path, "requirements")
    try:
        return _requirements(content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _requirements(content: dict[str, Any]) -> Requirements:
    _refuse_unknown(content, ("alert_limits", "requirement"))
    limits = _alert_limits(content["alert_limits"]) if "alert_limits" in content else None
    tables = content.get("requirement", [])
    if not (isinstance(tables, list) and all(isinstance(table, dict) for table in tables)):
        raise InputError("requirement: expected tables, each under [[requirement]]")
    if not tables:
        raise InputError("no requirement in it; write each under [[requirement]], with id, metric and a bound")
    requirements: list[Requirement] = []
    for number, table in enumerate(tables, 1):
        name = table.get("id")
        label = f"requirement {name!r}" if isinstance(name, str) and name.strip() else f"requirement {number}"
        try:
            requirement = _requirement(table, limits)
            if requirement.id in {other.id for other in requirements}:
                raise InputError(f"id: there are two of this name; requirement {number} needs another")
        except InputError as error:
            raise InputError(f"{label}: {error}") from error
        requirements.append(requirement)
    return Requirements(limits, tuple(requirements))


def _alert_limits(table: Any) -> AlertLimits:
    names = tuple(f"{axis}_m" for axis in AXES)
    if not isinstance(table, dict) or not table:
        raise InputError(f"alert_limits: expected a table of {', '.join(names)}, in metres; {table!r:.40}")
    try:
        _refuse_unknown(table, names)
        for name, value in table.items():
            if not (_is_number(value) and value > 0):
                raise InputError(f"{name}: {value!r:.40}; expected metres, over 0; leave out an axis without limit")
    except InputError as error:
        raise InputError(f"alert_limits: {error}") from error
    return AlertLimits(**{name: float(value) for name, value in table.items()})


def _requirement(table: dict[str, Any], limits: AlertLimits | None) -> Requirement:
    _refuse_unknown(table, tuple(field.name for field in fields(Requirement)))
    for name in ("id", "metric"):
        if name not in table:
            raise InputError(f"{name}: missing" + ("; name the figure that is required" if name == "metric" else ""))
    for name in ("id", "metric", "text"):
        value = table.get(name, "-")
        if not isinstance(value, str) or not value.strip():
            raise InputError(f"{name}: {value!r:.40}; expected a text")
    metric = table["metric"]
    if metric not in METRICS:
        raise InputError(f"metric: no figure is called {metric!r:.40}{_nearest(metric, METRICS)}")
    if metric in OF_LIMITS and limits is None:
        raise InputError(f"metric: {metric} needs the operation's [alert_limits] in this file")
    ends = {name: _bound(name, table[name], metric) for name in ("at_least", "at_most") if name in table}
    if not ends:
        raise InputError("at_most, at_least: missing; give one of them, or both")
    if len(ends) == 2 and ends["at_least"] > ends["at_most"]:
        raise InputError(
            f"at_least: {ends['at_least']:g} is above at_most, {ends['at_most']:g}: nothing satisfies both"
        )
    fewest, judge = table.get("fewest", Requirement.fewest), table.get("judge", Requirement.judge)
    if type(fewest) is not int or fewest < 1:
        raise InputError(f"fewest: {fewest!r:.40}; expected a whole number of rows, 1 or more")
    if judge not in get_args(Judge):
        raise InputError(f"judge: {judge!r:.40}; expected {' or '.join(get_args(Judge))}")
    where = _condition(table["where"]) if "where" in table else Condition()
    return Requirement(table["id"], metric, table.get("text", ""), where=where, fewest=fewest, judge=judge, **ends)


def _bound(name: str, value: Any, metric: str) -> float:
    """One end. A share's must leave something to fail: every share is at most 1."""
    if not _is_number(value):
        raise InputError(f"{name}: {value!r:.40}; expected a number")
    if is_share(metric) and not (0 <= value < 1 if name == "at_most" else 0 < value <= 1):
        range_ = "from 0 to below 1" if name == "at_most" else "over 0, up to 1"
        raise InputError(f"{name}: {value!r:.40}; {metric} is a share, expected a number {range_}")
    if metric != "nll" and value < 0:
        raise InputError(f"{name}: {value!r:.40}; {metric} is never negative, expected 0 or more")
    return float(value)


def _condition(table: Any) -> Condition:
    if not isinstance(table, dict) or not table:
        raise InputError(f"where: {table!r:.40}; expected a table of {', '.join((*_WORDS, *_RANGES))}, or no where")
    try:
        _refuse_unknown(table, (*_WORDS, *_RANGES))
        values: dict[str, Any] = {
            name: _range(name, v) if name in _RANGES else _words(name, v) for name, v in table.items()
        }
    except InputError as error:
        raise InputError(f"where: {error}") from error
    return Condition(**values)


def _range(name: str, value: Any) -> Range:
    ends: list[Any] = value if isinstance(value, list) and len(value) == 2 else [None, None]
    if not (_is_number(ends[0]) and (_is_number(ends[1]) or ends[1] == math.inf) and ends[0] < ends[1]):
        raise InputError(f"{name}: {value!r:.40}; expected [low, high], low below high; high may be inf")
    return float(ends[0]), float(ends[1])


def _words(name: str, value: Any) -> tuple[str, ...]:
    values: list[Any] = value if isinstance(value, list) else [value]
    known = _WORDS[name]
    if not values or not all(isinstance(v, str) and v and (not known or v in known) for v in values):
        raise InputError(f"{name}: {value!r:.40}; expected one or a list of {', '.join(known) or 'texts'}")
    return tuple(values)


def _refuse_unknown(table: Mapping[str, Any], known: Sequence[str]) -> None:
    for name in table:
        if name not in known:
            raise InputError(f"{name}: no such field{_nearest(name, known) or '; there are ' + ', '.join(known)}")


def _nearest(name: str, known: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, known, 3)
    return f"; did you mean {' or '.join(near)}?" if near else ""


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


# Checking


def check(
    requirements: Requirements, rows: Rows, figures: Callable[[Rows], Mapping[str, Figure]]
) -> list[dict[str, Any]]:
    """One record for each requirement, as in evaluation.json: id, text, metric, where, bound, the figure, result, why.

    `figures` gives the figures of some of the rows; it is called once for each condition, and never without a row.
    The result is "failed" if the estimate breaks the bound, "shown" if what `judge` names satisfies it and is of
    enough rows, else "not shown".
    """
    found: dict[Condition, tuple[Rows, Mapping[str, Figure]]] = {}
    records = []
    for requirement in requirements.requirements:
        where = requirement.where
        if where not in found:
            chosen = rows.select(where.select(rows))
            found[where] = chosen, figures(chosen) if len(chosen) else {}
        chosen, its_figures = found[where]
        figure = its_figures.get(requirement.metric)
        if not len(chosen):
            result, why = NOT_SHOWN, _why_no_rows(where, rows)
        elif figure is None:
            result, why = NOT_SHOWN, _why_absent(requirement.metric, chosen)
        else:
            result, why = _judged(requirement, figure, _rows_of(requirement.metric, figure, chosen))
        records.append(_record(requirement, figure, result, why))
    return records


def passed(records: Sequence[Mapping[str, Any]]) -> bool:
    """Whether there are requirements, and each is shown to be met."""
    return bool(records) and all(record["result"] == SHOWN for record in records)


def _judged(requirement: Requirement, figure: Figure, count: int) -> tuple[str, str]:
    value, low, high = figure.value, figure.low, figure.high
    unit = f" {figure.unit}" if figure.unit else ""
    estimate = f"{value:.4g}{unit}, of {count} rows"
    if math.isnan(value):
        return NOT_SHOWN, f"the figure is not a number, of {count} rows"
    if not requirement.holds(value, value):
        return FAILED, f"{estimate}; required is {requirement.bound}"
    if count < requirement.fewest:
        return NOT_SHOWN, f"{estimate}; at least {requirement.fewest} rows are needed"
    if requirement.judge == "estimate":
        return SHOWN, f"{estimate}; judged by the estimate alone"
    if math.isnan(low) or math.isnan(high):
        return NOT_SHOWN, f"{estimate}; too few for an interval"
    interval = f"{estimate}; the 95 % interval, {low:.4g} to {high:.4g}{unit},"
    if not requirement.holds(low, high):
        return NOT_SHOWN, f"{interval} reaches beyond {requirement.bound}"
    return SHOWN, f"{interval} lies within {requirement.bound}"


def _rows_of(metric: str, figure: Figure, rows: Rows) -> int:
    """How many rows a figure is of; its own count may be of coordinates, several of one row."""
    of = int(np.isfinite(rows.error_px).all(axis=(1, 2)).sum()) if metric in CORNERS else len(rows)
    return min(of, figure.count)


def _record(requirement: Requirement, figure: Figure | None, result: str, why: str) -> dict[str, Any]:
    value, low, high = (
        _finite(number) for number in ((figure.value, figure.low, figure.high) if figure else (math.nan,) * 3)
    )
    return {
        "id": requirement.id, "text": requirement.text, "metric": requirement.metric,
        "where": str(requirement.where) or "all", "bound": requirement.bound, "value": value, "low": low, "high": high,
        "count": int(figure.count) if figure else 0, "unit": figure.unit if figure else "",
        "result": result, "why": why,
    }  # fmt: skip


def _finite(number: float) -> float | None:
    return float(number) if math.isfinite(number) else None


def _why_no_rows(where: Condition, rows: Rows) -> str:
    """What no row satisfies, and what the data has of the first field that alone leaves none."""
    given = where.given()
    if not given:
        return "no rows"
    for name, wanted in given:
        if not Condition(**{name: wanted}).select(rows).any():
            return f"no rows with {where}; {_what_there_is(name, getattr(rows, name))}"
    return f"no rows with {where}"


def _what_there_is(name: str, values: Any) -> str:
    label, unit = _RANGES.get(name, (name, ""))
    known: Any = values[np.isfinite(values)] if unit else sorted({str(value) for value in values} - {""})
    if not len(known):
        return f"no {label} is known in the data"
    there = f"{known.min():g} to {known.max():g} {unit}" if unit else ", ".join(known[:12])
    return f"the data has {label} {there}"


def _why_absent(metric: str, rows: Rows) -> str:
    """Why a figure could not be computed of these rows (at least one)."""
    needs = (
        (CORNERS, rows.predicted, "no corners were predicted"),
        (("error_input_px", "sigma_input_px"), np.isfinite(rows.enlarged), "the scale of the crops is not known"),
        (POSES, np.isfinite(rows.distance_m), "no true poses in the data"),
        (POSES, np.isfinite(rows.error_m).any(axis=1), "no row was solved to a pose"),
        ((*OVER, "hazardous", *BOUNDS), np.isfinite(rows.level_m).any(axis=1), "no protection level could be given"),
        ((*OVER, "hazardous", *BOUNDS), rows.accepted, "no row was accepted"),
        (TESTED, np.isfinite(rows.statistic), "no row was monitored"),
        (SCOPE, np.isfinite(rows.present), "no probability of a runway was predicted"),
        (SCOPE, np.isfinite(rows.absent), "no crop without the runway was looked at"),
        (LATENCY, np.isfinite(rows.latency_ms), "no times were measured"),
    )  # fmt: skip
    for names, there, what in needs:
        if (metric in names or metric.partition(".")[0] in names) and not there.any():
            return f"{what}, of {len(rows)} rows"
    return f"{metric} could not be computed of these {len(rows)} rows"
