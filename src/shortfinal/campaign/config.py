"""What a campaign varies: a TOML file, refused by file and key, as frozen dataclasses.

Each section of the file is a dataclass here, and each of its keys a field. A section written once
holds for the whole campaign; a section written as several `[[section]]` is a list of variants, and
the scenarios are all combinations of the variants.
"""

from __future__ import annotations

import difflib
import itertools
import math
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, get_type_hints

from shortfinal.errors import InputError
from shortfinal.files import read_toml
from shortfinal.geometry import Camera
from shortfinal.keypoints import CORNER_NAMES

Range = tuple[float, float]  # uniform between two numbers; equal ones make it that number
Accept = Callable[[Any], Any]  # a value as TOML has it -> the field's; raises InputError: what was expected


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _number(low: float, high: float) -> Accept:
    def accept(value: Any) -> float:
        if not (_is_number(value) and low <= value <= high):
            raise InputError(f"expected a number from {low:g} to {high:g}")
        return float(value)

    return accept


def _range(low: float, high: float) -> Accept:
    def accept(value: Any) -> Range:
        ends: list[Any] = value if isinstance(value, list) else [value, value]
        good = len(ends) == 2 and all(_is_number(v) for v in ends) and low <= ends[0] <= ends[1] <= high
        if not good:
            raise InputError(f"expected a number or [low, high] within {low:g} to {high:g}")
        return float(ends[0]), float(ends[1])

    return accept


def _whole(low: int) -> Accept:
    def accept(value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or value < low:
            raise InputError(f"expected a whole number, {low} or more")
        return value

    return accept


def _probability(value: Any) -> float:
    if not (_is_number(value) and 0 < value < 1):
        raise InputError("expected a probability, over 0 and below 1")
    return float(value)


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise InputError("expected true or false")
    return value


def _choice(*words: str) -> Accept:
    def accept(value: Any) -> str:
        if value not in words:
            raise InputError(f"expected one of {', '.join(words)}")
        return str(value)

    return accept


def _points(value: Any) -> tuple[tuple[float, ...], ...]:
    rows: list[Any] = value if isinstance(value, list) else [None]
    if not all(isinstance(row, list) and len(row) == 3 and all(_is_number(v) for v in row) for row in rows):
        raise InputError("expected a list of [x, y, z] in metres")
    return tuple(tuple(float(v) for v in row) for row in rows)


@dataclass(frozen=True)
class Poses:
    """Where the camera is and how it is turned; drawn anew until every point is in the frame."""

    distance_m: Annotated[Range, _range(10, 1e5)] = (500, 6000)  # before the threshold, along the runway
    glide_deg: Annotated[Range, _range(0.1, 45)] = (2.2, 3.8)  # elevation seen from the threshold's middle
    lateral_deg: Annotated[Range, _range(-45, 45)] = (-4, 4)  # azimuth seen from there, left positive
    yaw_deg: Annotated[Range, _range(-180, 180)] = (-10, 10)
    pitch_deg: Annotated[Range, _range(-90, 90)] = (-8, 0)
    roll_deg: Annotated[Range, _range(-180, 180)] = (-10, 10)


@dataclass(frozen=True)
class RunwaySizes:
    """The runway as the solver is told it."""

    length_m: Annotated[Range, _range(50, 1e4)] = (1500, 3500)
    width_m: Annotated[Range, _range(5, 500)] = (30, 60)
    points_m: Annotated[tuple[tuple[float, ...], ...], _points] = ()  # named points beyond the corners, runway frame


@dataclass(frozen=True)
class Sigma:
    """The standard deviation of a coordinate: log-normal, as networks state it; errors follow it."""

    px: Annotated[float, _number(1e-3, 1e3)] = 0.5  # median
    spread: Annotated[float, _number(0, 3)] = 0.0  # standard deviation of ln(sigma)
    floor_px: Annotated[float, _number(0, 1e3)] = 0.0  # no sigma is smaller
    far_ratio: Annotated[float, _number(0.01, 100)] = 1.0  # the far corners' over the others'


@dataclass(frozen=True)
class Correlation:
    """Errors equally correlated between any two keypoints, u with u and v with v."""

    rho: Annotated[float, _number(0, 0.999)] = 0.0
    told: Annotated[bool, _flag] = True  # whether the solver and the monitor are given it


@dataclass(frozen=True)
class Priors:
    """What is known beside the picture: one sigma each, and errors that follow it."""

    attitude_deg: Annotated[float | None, _number(1e-6, 90)] = None  # about each of the camera's axes
    altitude_m: Annotated[float | None, _number(1e-4, 1e4)] = None  # a radar altimeter's, over z = 0
    position_m: Annotated[float | None, _number(1e-4, 1e4)] = None  # along each axis


@dataclass(frozen=True)
class Fault:
    """What is wrong in every trial: nothing, one corner in the picture, or the far threshold."""

    kind: Annotated[str, _choice("none", "corner", "far-threshold")] = "none"
    corner: Annotated[str, _choice("any", "near", "far", *CORNER_NAMES)] = "any"  # which, drawn for each trial
    shift_sigma: Annotated[float | None, _number(0, 1e3)] = None  # by so many sigma of its coordinates
    shift_px: Annotated[float | None, _number(0, 1e4)] = None  # or so many pixels
    direction: Annotated[str, _choice("random", "worst")] = "random"  # worst: least seen by the residual test
    far_off_m: Annotated[float | None, _number(-1e4, 1e4)] = None  # where the picture shows it, beyond where it is told


@dataclass(frozen=True)
class Monitor:
    """The residual test, and the protection levels and alert limits if asked for."""

    false_alarm_rate: Annotated[float, _probability] = 1e-3
    protection: Annotated[bool, _flag] = False
    method: Annotated[str, _choice("residual", "solution-separation")] = "residual"
    integrity_risk: Annotated[float, _probability] = 1e-7
    fault_prior: Annotated[float, _probability] = 1e-4
    along_limit_m: Annotated[float | None, _number(1e-3, 1e5)] = None  # alert limits
    cross_limit_m: Annotated[float | None, _number(1e-3, 1e5)] = None
    vertical_limit_m: Annotated[float | None, _number(1e-3, 1e5)] = None

    @property
    def limits_m(self) -> tuple[float, float, float]:
        """Alert limits along, cross and vertical; infinite where none is set."""
        limits = (self.along_limit_m, self.cross_limit_m, self.vertical_limit_m)
        along, cross, vertical = (math.inf if v is None else v for v in limits)
        return along, cross, vertical


@dataclass(frozen=True)
class Scenario:
    """One combination of the variants."""

    name: str
    variants: tuple[tuple[str, str], ...]  # (section, name of its variant) of each section that varies
    camera: Camera
    poses: Poses = Poses()
    runway: RunwaySizes = RunwaySizes()
    sigma: Sigma = Sigma()
    correlation: Correlation = Correlation()
    priors: Priors = Priors()
    fault: Fault = Fault()
    monitor: Monitor = Monitor()


@dataclass(frozen=True)
class Campaign:
    """The scenarios, and how many trials each gets."""

    seed: int
    trials: int  # of each scenario
    scenarios: tuple[Scenario, ...]


_SECTIONS: dict[str, type] = {
    "camera": Camera,
    "poses": Poses,
    "runway": RunwaySizes,
    "sigma": Sigma,
    "correlation": Correlation,
    "priors": Priors,
    "fault": Fault,
    "monitor": Monitor,
}


def read_campaign(path: str | Path) -> Campaign:
    """Read a campaign.

    `seed` and `trials` (of each scenario), then the sections camera (required; as in camera files),
    poses, runway, sigma, correlation, priors, fault and monitor. Raises InputError naming the file
    and the key.
    """
    content = read_toml(path, "campaign")
    try:
        return _campaign(content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _campaign(content: dict[str, Any]) -> Campaign:
    _check_known(content, ("seed", "trials", *_SECTIONS), "")
    for name in ("seed", "trials", "camera"):
        if name not in content:
            raise InputError(f"no {name}; a campaign has seed, trials, a camera and what varies")
    seed = _accepted("seed", content["seed"], _whole(0))
    trials = _accepted("trials", content["trials"], _whole(1))
    # In the order of the file, so that its reader finds the scenarios where he expects them.
    variants = {name: _variants(name, value) for name, value in content.items() if name in _SECTIONS}
    varied = [name for name, options in variants.items() if len(options) > 1]
    scenarios = []
    for combination in itertools.product(*variants.values()):
        chosen = dict(zip(variants, combination, strict=True))
        labels = tuple((name, chosen[name][0]) for name in varied)
        name = ", ".join(label for _, label in labels) or "all"
        scenario = Scenario(name, labels, **{section: value for section, (_, value) in chosen.items()})
        _check_length(scenario)
        scenarios.append(scenario)
    names = [s.name for s in scenarios]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InputError(f"two scenarios are called {twice!r}; give each variant a name of its own")
    return Campaign(seed, trials, tuple(scenarios))


def _variants(section: str, given: Any) -> list[tuple[str, Any]]:
    """(label, value) of each variant of a section."""
    tables = given if isinstance(given, list) else [given]
    if not tables or not all(isinstance(table, dict) for table in tables):
        raise InputError(f"{section}: expected a table [{section}], or several [[{section}]]")
    several = len(tables) > 1
    options = []
    for number, table in enumerate(tables, 1):
        where = f"[[{section}]] number {number}" if several else section
        keys = {key: value for key, value in table.items() if key != "name"}
        name = _accepted(f"{where}: name", table.get("name", _label(keys)), _text)
        options.append((name, _camera(where, keys) if section == "camera" else _section(section, where, keys)))
    return options


def _label(keys: dict[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in keys.items()) or "default"


def _text(value: Any) -> str:
    if not isinstance(value, str) or not value.strip():
        raise InputError("expected a text")
    return value


def _section(section: str, where: str, keys: dict[str, Any]) -> Any:
    kind = _SECTIONS[section]
    accepts = {name: hint.__metadata__[0] for name, hint in get_type_hints(kind, include_extras=True).items()}
    _check_known(keys, (*accepts, "name"), f"{where}: ")
    value = kind(**{key: _accepted(f"{where}: {key}", v, accepts[key]) for key, v in keys.items()})
    if isinstance(value, Fault):
        _check_fault(where, value, keys)
    return value


def _check_length(scenario: Scenario) -> None:
    shortest, off = scenario.runway.length_m[0], scenario.fault.far_off_m
    if off is not None and shortest + off < 50:
        raise InputError(f"fault: far_off_m: {off:g} leaves less than 50 m of a runway of {shortest:g} m")


_FAULT_KEYS = {
    "none": (),
    "corner": ("corner", "shift_sigma", "shift_px", "direction"),
    "far-threshold": ("far_off_m",),
}


def _check_fault(where: str, fault: Fault, keys: dict[str, Any]) -> None:
    allowed = _FAULT_KEYS[fault.kind]
    for key in keys:
        if key != "kind" and key not in allowed:
            raise InputError(f"{where}: {key}: not a key of kind {fault.kind!r}")
    if fault.kind == "corner" and (fault.shift_sigma is None) == (fault.shift_px is None):
        raise InputError(f"{where}: give shift_sigma or shift_px, one of them")
    if fault.kind == "far-threshold" and fault.far_off_m is None:
        raise InputError(f"{where}: no far_off_m: how far beyond its place the far threshold is seen, m (short: < 0)")


def _camera(where: str, keys: dict[str, Any]) -> Camera:
    names = [f.name for f in fields(Camera)]
    _check_known(keys, (*names, "name"), f"{where}: ")
    missing = [f.name for f in fields(Camera) if f.default is MISSING and f.name not in keys]
    if missing:
        raise InputError(f"{where}: no {missing[0]}; a camera has {', '.join(names)}")
    return Camera(**keys)


def _accepted(where: str, value: Any, accept: Accept) -> Any:
    try:
        return accept(value)
    except InputError as error:
        raise InputError(f"{where}: {error}, got {value!r:.60}") from error


def _check_known(given: dict[str, Any], known: tuple[str, ...], where: str) -> None:
    for key in given:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1, cutoff=0)
            raise InputError(f"{where}unknown key {key!r}; the nearest known one is {near[0]!r}")
