"""The figures of the field, of any rows: pixels, honesty of sigma, navigation, integrity, latency."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from shortfinal.calibration import LEVELS
from shortfinal.evaluate.intervals import auroc_figure, mean_figure, quantile_figures, share_figure
from shortfinal.evaluate.rows import AXES, DECISIONS, MISSING, NOT_MONITORED, Figure, Rows
from shortfinal.pipeline import PRESENT
from shortfinal.protection import AlertLimits

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

PARTS = {"": slice(0, 4), "near_": slice(0, 2), "far_": slice(2, 4)}  # of the keypoint order
_QUANTILES = {"median": 0.5, "q90": 0.9, "q95": 0.95, "q99": 0.99}
_PIXELS = ("median", "q90", "q99")

# Groups by which all figures are given: edges, and how a value is written.
DISTANCE_M = (0.0, 500.0, 1000.0, 1500.0, 2000.0, 3000.0, 4000.0, 6000.0, 10000.0)
GLIDE_DEG = (0.0, 2.0, 2.5, 3.0, 3.5, 4.0, 90.0)
LIGHTS = ("night", "dim", "bright")
MOST_AIRPORTS = 60  # in tables and pictures: those with most rows


# What figures are called, by what they are made of.
CORNERS = (
    *(f"{part}error_px.{q}" for part in PARTS for q in ("mean", *_PIXELS)),
    *(f"error_input_px.{q}" for q in ("mean", *_PIXELS)), "sigma_px.median", "sigma_input_px.median", "nll", "nees",
    *(f"{part}coverage.{level * 100:.0f}" for part in PARTS for level in LEVELS),
)  # fmt: skip
DECIDED = tuple(decision.replace("-", "_") for decision in DECISIONS)
TESTED = ("alarm", "detection.far_threshold_184m")
WITHIN = tuple(f"{axis}_within_2sigma" for axis in AXES)
OVER = (*(f"{axis}_over_level" for axis in AXES), "over_level")
OF_LIMITS = ("available", "hazardous")  # which need alert limits
POSES = (
    *(f"{axis}_m.{q}" for axis in AXES for q in ("median", "q90", "q95")), "distance_relative.median",
    "distance_relative.q90", *WITHIN, *OVER, "hazardous",
)  # fmt: skip
BOUNDS = tuple(f"level.{axis}_m.median" for axis in AXES)
SCOPE = ("presence.auroc", "presence.refused", "presence.false_find")
LATENCY = tuple(f"latency_ms.{q}" for q in ("median", "q95", "q99"))
METRICS = (*CORNERS, *DECIDED, *TESTED, *POSES, "available", *BOUNDS, *SCOPE, *LATENCY)
_SHARES = {*DECIDED, *TESTED, *WITHIN, *OVER, *OF_LIMITS, *SCOPE, *(name for name in CORNERS if "coverage" in name)}


def is_share(metric: str) -> bool:
    """Whether a figure lies between 0 and 1."""
    return metric in _SHARES


def figures_of(rows: Rows, limits: AlertLimits | None = None) -> dict[str, Figure]:
    """Every figure that these rows allow, by name (docs/evaluation.md); what nothing is known of is absent.

    `limits`: alert limits, for availability and hazardous information.
    """
    found: dict[str, Figure] = {}
    for name, figure in (
        *_shares(rows),
        *_pixels(rows),
        *_honesty(rows),
        *_navigation(rows, limits),
        *_scope(rows),
        *_times(rows),
    ):
        if figure is not None:
            found[name] = figure
    return found


def groups_of(rows: Rows) -> Iterator[tuple[str, str, Flags]]:
    """(by, group, which rows): everything, then by distance, glide angle, airport and light."""
    yield "all", "all", np.ones(len(rows), bool)
    for by, values, edges, unit in (
        ("distance", rows.distance_m, DISTANCE_M, "m"), ("glide", rows.glide_deg, GLIDE_DEG, "°")
    ):  # fmt: skip
        for low, high in itertools.pairwise(edges):
            yield by, f"{low:g}–{high:g} {unit}", (values >= low) & (values < high)
    for name in airports_of(rows):
        yield "airport", name, rows.airport == name
    for light in LIGHTS:
        yield "light", light, rows.light == light


def airports_of(rows: Rows) -> dict[str, int]:
    """Rows of each airport, at most MOST_AIRPORTS of those with most; rendered scenes, each its own world, are none."""
    names, counts = np.unique(rows.airport.astype(str), return_counts=True)
    some = [(int(count), str(name)) for name, count in zip(names, counts, strict=True) if name and count > 1]
    kept = sorted(some, key=lambda one: (-one[0], one[1]))[:MOST_AIRPORTS]
    return {name: count for count, name in sorted(kept, key=lambda one: one[1])}


def metrics_of(rows: Rows, limits: AlertLimits | None = None) -> list[dict[str, Any]]:
    """`figures_of` all rows and of every group that has any, as records."""
    return [
        {"by": by, "group": group, "name": name, **asdict(figure)}
        for by, group, which in groups_of(rows)
        if which.any()
        for name, figure in figures_of(rows.select(which), limits).items()
    ]


Named = Iterator[tuple[str, Figure | None]]


def _quantiles(name: str, values: Array, wanted: tuple[str, ...], unit: str) -> Named:
    found = quantile_figures(values, [_QUANTILES[which] for which in wanted], unit)
    yield from ((f"{name}.{which}", figure) for which, figure in zip(wanted, found, strict=True))


def _shares(rows: Rows) -> Named:
    for decision in DECISIONS:
        yield decision.replace("-", "_"), share_figure(rows.decision == decision)
    monitored = monitored_rows(rows)
    yield "alarm", share_figure(np.where(monitored, ~rows.accepted, np.nan))


def monitored_rows(rows: Rows) -> Flags:
    """Which have a verdict, of whatever kind (N,)."""
    return np.asarray((rows.decision != NOT_MONITORED) & (rows.decision != MISSING))


def _pixels(rows: Rows) -> Named:
    size, sigma = np.abs(rows.error_px), rows.sigma_px
    for part, of in PARTS.items():
        yield f"{part}error_px.mean", mean_figure(size[:, of], "px")
        yield from _quantiles(f"{part}error_px", size[:, of], _PIXELS, "px")
    enlarged = rows.enlarged[:, None, None]
    yield "error_input_px.mean", mean_figure(size * enlarged, "px")
    yield from _quantiles("error_input_px", size * enlarged, _PIXELS, "px")
    yield from _quantiles("sigma_px", sigma, ("median",), "px")
    yield from _quantiles("sigma_input_px", sigma * enlarged, ("median",), "px")


def _honesty(rows: Rows) -> Named:
    squared, log_det = standardised(rows)
    yield "nll", mean_figure((squared + log_det + 8 * np.log(2 * np.pi)) / 16)
    yield "nees", mean_figure(squared / 8)
    score = np.abs(rows.error_px) / rows.sigma_px
    for part, of in PARTS.items():
        for level in LEVELS:
            held = _flags(score[:, of] <= ndtri((1 + level) / 2), score[:, of])
            yield f"{part}coverage.{level * 100:.0f}", share_figure(held)


def standardised(rows: Rows) -> tuple[Array, Array]:
    """eᵀΣ⁻¹e and log|Σ| (N,) of each row's eight coordinates; NaN where something is not labelled or predicted."""
    error, out = rows.error_px.reshape(-1, 8), np.full((2, len(rows)), np.nan)
    good = np.isfinite(error).all(axis=1) & np.isfinite(rows.cov_px).all(axis=(1, 2))
    factor = np.linalg.cholesky(rows.cov_px[good])
    white = np.linalg.solve(factor, error[good][..., None])[..., 0]
    out[0, good] = (white**2).sum(axis=1)
    out[1, good] = 2 * np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
    return out[0], out[1]


def _navigation(rows: Rows, limits: AlertLimits | None) -> Named:
    size = np.abs(rows.error_m)
    known = np.isfinite(size).all(axis=1)
    bounded = known & rows.accepted
    over = size > rows.level_m
    for axis, name in enumerate(AXES):
        yield from _quantiles(f"{name}_m", size[:, axis], ("median", "q90", "q95"), "m")
        within = _flags(size[:, axis] <= 2 * rows.sigma_m[:, axis], size[:, axis])
        yield f"{name}_within_2sigma", share_figure(within)
        finite = bounded & np.isfinite(rows.level_m[:, axis])
        yield f"{name}_over_level", share_figure(np.where(finite, over[:, axis], np.nan))
        yield from _quantiles(f"level.{name}_m", np.where(finite, rows.level_m[:, axis], np.nan), ("median",), "m")
    bounded_all = bounded & np.isfinite(rows.level_m).any(axis=1)
    yield "over_level", share_figure(np.where(bounded_all, (over & np.isfinite(rows.level_m)).any(axis=1), np.nan))
    relative = np.linalg.norm(rows.error_m, axis=1) / rows.distance_m
    yield from _quantiles("distance_relative", np.where(known, relative, np.nan), ("median", "q90"), "")
    yield "detection.far_threshold_184m", share_figure(rows.caught_184m)
    if limits is not None:
        available = available_rows(rows, limits)
        yield "available", share_figure(available)
        hazard = available & (size > _limits(limits)).any(axis=1)
        yield "hazardous", share_figure(np.where(known | ~available, hazard, np.nan))


def available_rows(rows: Rows, limits: AlertLimits) -> Flags:
    """Which are accepted with every level within its alert limit (N,)."""
    return np.asarray(rows.accepted & (rows.level_m <= _limits(limits)).all(axis=1))


def _limits(limits: AlertLimits) -> Array:
    return np.array([limits.along_m, limits.cross_m, limits.vertical_m])


def _scope(rows: Rows) -> Named:
    """In scope or not: crops with the runway against crops beside it."""
    yield "presence.auroc", auroc_figure(rows.present, rows.absent)
    yield "presence.refused", share_figure(_flags(rows.present < PRESENT, rows.present))
    yield "presence.false_find", share_figure(_flags(rows.absent >= PRESENT, rows.absent))


def _times(rows: Rows) -> Named:
    yield from _quantiles("latency_ms", rows.latency_ms, ("median", "q95", "q99"), "ms")


def _flags(flags: Flags, of: Array) -> Array:
    """1 or 0, NaN where what was compared is not known."""
    return np.where(np.isnan(of), np.nan, flags)
