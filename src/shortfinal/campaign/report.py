"""What a campaign says: rates with their confidence intervals, as tables and as maps."""

from __future__ import annotations

import io
import json
import math
import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from shortfinal.campaign.config import Campaign, Scenario
from shortfinal.campaign.trials import (
    AXES,
    BINS,
    BINS_A_DECADE,
    COUNTERS,
    DISTANCE_CELLS,
    GLIDE_CELLS,
    LOWEST_EXPONENT,
    TAIL_RATES,
    Counts,
)
from shortfinal.evaluate.intervals import CONFIDENCE, share_interval
from shortfinal.files import csv_text, make_folder, write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from rich.table import Table

Array = NDArray[np.float64]

_MOST_NAMED = 12  # scenarios in a legend
QUANTILES = {"median": 0.5, "q95": 0.95}


@dataclass(frozen=True)
class Rate:
    """A share of trials, and the Clopper-Pearson interval that holds the true one with CONFIDENCE."""

    count: int
    of: int
    rate: float | None  # None: of nothing
    low: float
    high: float


def rate_of(count: int, of: int) -> Rate:
    """`count` of `of`, with its exact (Clopper & Pearson 1934) two-sided interval."""
    low, high = share_interval(count / of, of) if of else (0.0, 1.0)
    return Rate(count, of, count / of if of else None, low, high)


def rates(scenario: Scenario, counted: dict[str, int]) -> dict[str, Rate]:
    """The rates that a scenario has, by name; `counted` by the names of COUNTERS.

    Where there is a fault, every trial has it: the rates are conditional on it.
    """
    faulty = scenario.fault.kind != "none"
    pairs = {"monitored": ("monitored", "trials"), "detection" if faulty else "false_alarm": ("refused", "monitored")}
    if faulty:
        pairs["missed_detection"] = ("accepted", "monitored")
    protected, limited = scenario.monitor.protection, _has_limits(scenario)
    if protected and limited:
        pairs |= {"available": ("available", "trials"), "hazardous": ("hazardous", "trials")}
    if protected:
        pairs |= {name: (name, "trials") for name in _with_axes("over_level")}
    if limited:
        pairs |= {name: (name, "trials") for name in _with_axes("over_limit")}
    pairs |= {f"p_below_{rate:g}": (f"p_below_{rate:g}", "monitored") for rate in TAIL_RATES}
    pairs |= {f"within_95_{axis}": (f"within_95_{axis}", "monitored") for axis in AXES}
    return {name: rate_of(counted[count], counted[of]) for name, (count, of) in pairs.items()}


def _has_limits(scenario: Scenario) -> bool:
    return any(map(math.isfinite, scenario.monitor.limits_m))


def _with_axes(name: str) -> tuple[str, ...]:
    return name, *(f"{name}_{axis}" for axis in AXES)


def quantile(histogram: NDArray[np.int64], share: float) -> float | None:
    """Of one of the logarithmic histograms (BINS,), between its edges; None of nothing, or beyond its end.

    A bin spans 2.3 %; within it the logarithm is taken as uniform.
    """
    below = np.cumsum(histogram)
    wanted = share * below[-1]
    if wanted == 0:
        return None
    at = int(np.searchsorted(below, wanted))
    if at == BINS - 1:
        return None
    inside = (wanted - (below[at] - histogram[at])) / histogram[at]
    return float(10 ** (LOWEST_EXPONENT + (at + inside) / BINS_A_DECADE))


def scenario_table(scenario: Scenario, counts: Counts) -> dict[str, Any]:
    """All that was counted of a scenario, as JSON takes it."""
    counted = dict(zip(COUNTERS, counts.cells.sum(axis=0).tolist(), strict=True))
    accepted, monitored = counted["accepted"], counted["monitored"]
    *squares, nees = counts.squares.tolist()
    table: dict[str, Any] = {
        "name": scenario.name,
        "variants": dict(scenario.variants),
        "counts": counted,
        "rates": {name: asdict(rate) for name, rate in rates(scenario, counted).items()},
        "rms_error_m": {a: math.sqrt(s / accepted) if accepted else None for a, s in zip(AXES, squares, strict=True)},
        "error_m": _quantiles(counts.errors),
        "mean_nees": nees / monitored if monitored else None,
        "p_values": counts.p_values.tolist(),
    }
    if scenario.monitor.protection:
        table["protection_level_m"] = _quantiles(counts.levels)
    return table | ({"map": _map(scenario, counts)} if _has_map(scenario) else {})


def _quantiles(histograms: NDArray[np.int64]) -> dict[str, dict[str, float | None]]:
    return {
        axis: {name: quantile(histogram, share) for name, share in QUANTILES.items()}
        for axis, histogram in zip(AXES, histograms, strict=True)
    }


def _has_map(scenario: Scenario) -> bool:
    return all(edges[0] < edges[-1] for edges in _edges(scenario))


def _map(scenario: Scenario, counts: Counts) -> dict[str, Any]:
    """Counts of the cells: distance down, glide angle across."""
    edges = _edges(scenario)
    names = ("trials", "monitored", "refused", "accepted", "available", "over_level", "over_limit", "hazardous")
    return {
        "distance_m": edges[0].tolist(),
        "glide_deg": edges[1].tolist(),
        **{name: _grid(counts, name).tolist() for name in names},
    }


def _edges(scenario: Scenario) -> tuple[Array, Array]:
    poses = scenario.poses
    return np.linspace(*poses.distance_m, DISTANCE_CELLS + 1), np.linspace(*poses.glide_deg, GLIDE_CELLS + 1)


def _grid(counts: Counts, name: str) -> NDArray[np.int64]:
    return counts.cells[:, COUNTERS.index(name)].reshape(DISTANCE_CELLS, GLIDE_CELLS)


def write_tables(campaign: Campaign, counts: list[Counts], out: str | Path) -> list[dict[str, Any]]:
    """Write tables.json and table.csv into `out`; the scenarios' tables. Raises InputError as `make_folder`."""
    folder = make_folder(out)
    tables = [scenario_table(s, c) for s, c in zip(campaign.scenarios, counts, strict=True)]
    record = {"confidence": CONFIDENCE, "campaign": asdict(campaign), "scenarios": tables}
    write_whole(folder / "tables.json", json.dumps(record, indent=1, allow_nan=False) + "\n")
    rows = [_row(table) for table in tables]
    columns = list(dict.fromkeys(name for row in rows for name in row))
    write_whole(folder / "table.csv", csv_text(columns, rows))
    return tables


def write_figures(campaign: Campaign, counts: list[Counts], out: str | Path) -> list[Path]:
    """Write false_alarms.png, and a map of each scenario that varies distance and glide angle, into `out`.

    The files written. Raises InputError as `make_folder`.
    """
    folder, pictures = make_folder(out), {}
    faultless = [(s, c) for s, c in zip(campaign.scenarios, counts, strict=True) if s.fault.kind == "none"]
    if faultless:
        pictures[folder / "false_alarms.png"] = _draw_false_alarms(faultless)
    for number, (scenario, count) in enumerate(zip(campaign.scenarios, counts, strict=True), 1):
        if _has_map(scenario):
            pictures[folder / f"map-{number:02d}-{_file_name(scenario.name)}.png"] = _draw_maps(scenario, count)
    for path, picture in pictures.items():
        write_whole(path, picture)
    return list(pictures)


def _file_name(name: str) -> str:
    return re.sub(r"[^a-z0-9.]+", "-", name.lower()).strip("-.")[:60]


def _row(table: dict[str, Any]) -> dict[str, Any]:
    """One line of the table."""
    row: dict[str, Any] = {"scenario": table["name"], **table["variants"], "trials": table["counts"]["trials"]}
    for name, rate in table["rates"].items():
        row |= {name: _short(rate["rate"]), f"{name}_low": _short(rate["low"]), f"{name}_high": _short(rate["high"])}
    row |= {f"rms_{axis}_m": _short(v) for axis, v in table["rms_error_m"].items()}
    for kind, field in (("error", "error_m"), ("level", "protection_level_m")):
        for axis, values in table.get(field, {}).items():
            row |= {f"{kind}_{axis}_{name}_m": _short(v) for name, v in values.items()}
    return row | {"mean_nees": _short(table["mean_nees"])}


def _short(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def render_table(tables: list[dict[str, Any]]) -> Table:
    """One line a scenario, for people: the main rates in per cent with their intervals, errors, levels."""
    from rich.table import Table

    has = {name for table in tables for name in table["rates"]}
    shown = [n for n in ("monitored", "false_alarm", "detection", "available", "over_level", "over_limit", "hazardous")
             if n in has]  # fmt: skip
    levels = any("protection_level_m" in table for table in tables)
    table = Table(box=None, pad_edge=False)
    table.add_column("scenario")
    for name in (*(f"{n.replace('_', ' ')} %" for n in shown), "RMS error m", *(["median level m"] if levels else [])):
        table.add_column(name, justify="right")
    for row in tables:
        cells = [_per_cent(row["rates"].get(name), interval=name != "monitored") for name in shown]
        cells.append(_triple(row["rms_error_m"]))
        if levels:
            medians = {axis: v["median"] for axis, v in row.get("protection_level_m", {}).items()}
            cells.append(_triple(medians) if medians else "–")
        table.add_row(row["name"], *cells)
    return table


def _per_cent(rate: dict[str, Any] | None, *, interval: bool) -> str:
    if rate is None or rate["rate"] is None:
        return "–"
    ends = f" ({100 * rate['low']:.3g}–{100 * rate['high']:.3g})" if interval else ""
    return f"{100 * rate['rate']:.3g}{ends}"


def _triple(values: dict[str, float | None]) -> str:
    return " / ".join("–" if v is None else f"{v:.3g}" for v in values.values())


def _draw_false_alarms(faultless: list[tuple[Scenario, Counts]]) -> bytes:
    """Counted against nominal false-alarm rates, with their intervals, PNG: a line a scenario."""
    # Not pyplot: it keeps a global state, and a display back end that a server has not.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 5.5), layout="constrained")
    axes = figure.subplots()
    axes.loglog(TAIL_RATES, TAIL_RATES, "--", color="0.4", label="as promised")
    for scenario, counts in faultless:
        counted = dict(zip(COUNTERS, counts.cells.sum(axis=0).tolist(), strict=True))
        found = [rate_of(counted[f"p_below_{rate:g}"], counted["monitored"]) for rate in TAIL_RATES]
        share = np.array([r.rate or math.nan for r in found])  # none at all: only the end of its interval is drawn
        below, above = share - [r.low for r in found], [r.high for r in found] - share
        axes.errorbar(TAIL_RATES, share, [below, above], fmt="o-", ms=4, lw=1, capsize=2, label=scenario.name)
    axes.set(xlabel="nominal false-alarm rate", ylabel=f"counted, with {CONFIDENCE:.0%} intervals")
    axes.set_title("False alarms of trials without a fault")
    axes.grid(alpha=0.3)
    if len(faultless) <= _MOST_NAMED:
        axes.legend(fontsize=8)
    return _png(figure)


def _draw_maps(scenario: Scenario, counts: Counts) -> bytes:
    """A panel for each rate over distance and glide angle, PNG."""
    from matplotlib.figure import Figure

    refused = "false alarms" if scenario.fault.kind == "none" else "detected"
    panels = [("monitored", "trials", "monitored"), ("refused", "monitored", refused)]
    if scenario.monitor.protection:
        panels.append(("over_level", "trials", "error over protection level"))
        if _has_limits(scenario):
            panels.append(("available", "trials", "available"))
    figure = Figure(figsize=(6 * len(panels), 4.5), layout="constrained")
    for axes, panel in zip(figure.subplots(1, len(panels)), panels, strict=True):
        _draw_map(axes, scenario, counts, *panel)
    figure.suptitle(f"{scenario.name}: {counts.cells[:, 0].sum():,} trials, % of each cell")
    return _png(figure)


def _png(figure: Figure) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110)
    return content.getvalue()


def _draw_map(axes: Axes, scenario: Scenario, counts: Counts, name: str, of: str, title: str) -> None:
    part, whole = _grid(counts, name), _grid(counts, of)
    share = np.divide(100.0 * part, whole, out=np.full(part.shape, np.nan), where=whole > 0)
    distance, glide = _edges(scenario)
    # Cividis: told apart by colour-blind readers too. Cells without a trial stay grey.
    axes.set_facecolor("0.85")
    known = share[np.isfinite(share)]
    top = max(float(known.max(initial=0.0)), 1e-6)
    mesh = axes.pcolormesh(distance / 1000, glide, share.T, cmap="cividis", vmin=0, vmax=top)
    across, up = ([float(v) for v in (e[:-1] + e[1:]) / 2] for e in (distance / 1000, glide))
    for (i, j), value in np.ndenumerate(share):
        if np.isfinite(value):
            colour = "white" if value < 0.6 * top else "black"
            number = f"{value:.0f}" if value >= 10 else f"{value:.2g}"
            axes.text(across[i], up[j], number, ha="center", va="center", fontsize=6, color=colour)
    axes.figure.colorbar(mesh, ax=axes, label="%")
    axes.set(xlabel="distance to the threshold, km", ylabel="glide angle, degrees", title=title)
