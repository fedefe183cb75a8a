"""Faults planted into predictions: how often the monitor sees them, and what passes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtr

from shortfinal.evaluate.intervals import share_figure
from shortfinal.evaluate.judge import Problems, Rates, Solved

Array = NDArray[np.float64]

PAPER_M = 184.0  # by how much the paper misplaces the far threshold (arXiv 2508.09732)
MOST_ROWS = 10_000  # that faults are planted into: more tell no more than the interval's width
_BINS = 60
_RATES = 41  # points of the ROC


@dataclass(frozen=True)
class Fault:
    """One kind, and the sizes it is planted in."""

    name: str
    unit: str
    sizes: tuple[float, ...]
    corners: tuple[int, ...] = ()  # of which one slides in a random direction; none: the far threshold


FAULTS = (
    Fault("far threshold nearer than believed", "m", (25, 50, 100, PAPER_M, 300, 500)),
    Fault("one far corner slid", "px", (0.5, 1, 2, 5, 10, 20), (2, 3)),
    Fault("one near corner slid", "px", (0.5, 1, 2, 5, 10, 20, 50), (0, 1)),
)


def plant(problems: Problems, fault: Fault, size: float, rates: Rates, seed: int) -> Solved:
    """The answers to N problems, each with the fault."""
    n = len(problems.mean_px)
    if not fault.corners:
        return problems.solve(rates, ahead_m=np.full(n, size))
    rng = np.random.default_rng([seed, *fault.corners])  # the same corner and direction at every size
    which, angle = rng.choice(fault.corners, n), rng.uniform(0, 2 * np.pi, n)
    shift = np.zeros((n, 4, 2))
    shift[np.arange(n), which] = size * np.column_stack([np.cos(angle), np.sin(angle)])
    return problems.solve(rates, shift_px=shift)


def fault_figures(problems: Problems, nominal: Solved, truth_m: Array, rates: Rates, seed: int) -> dict[str, Any]:
    """The parts `statistic`, `faults` and `roc` of an evaluation, of problems (N) without a known fault.

    `truth_m` (N, 3): true positions, NaN where not known. Detection is the share of problems that were
    monitored without the fault and are refused with it.
    """
    checked = np.flatnonzero(nominal.monitored)
    if len(checked) == 0:
        return {"statistic": None, "faults": [], "roc": None}
    before = nominal.p_value[checked]
    records, roc, paper = [], {}, None
    for fault in FAULTS:
        solved = [plant(problems, fault, size, rates, seed) for size in fault.sizes]
        caught = [share_figure(np.where(nominal.monitored, ~s.usable, np.nan)) for s in solved]
        errors = [np.abs(s.position_m - truth_m)[s.usable & nominal.monitored] for s in solved]
        records.append({
            "name": fault.name, "unit": fault.unit, "sizes": list(fault.sizes),
            "detected": [f and f.value for f in caught], "low": [f and f.low for f in caught],
            "high": [f and f.high for f in caught], "accepted_error_m": [_largest(e) for e in errors],
        })  # fmt: skip
        shown = fault.sizes.index(PAPER_M) if not fault.corners else fault.sizes.index(5)
        name = f"{fault.name}, {fault.sizes[shown]:g} {fault.unit}"
        # What can no longer be checked is not used either: refused at any rate.
        roc[name] = np.nan_to_num(solved[shown].p_value[checked], nan=0.0)
        paper = solved[shown] if not fault.corners else paper
    assert paper is not None
    thresholds = np.logspace(-6, 0, _RATES)
    return {
        "statistic": _separation(nominal.statistic[checked], paper.statistic[checked], nominal),
        "faults": records,
        "roc": {
            "false_alarm": [float((before < t).mean()) for t in thresholds],
            "detection": {name: [float((p < t).mean()) for t in thresholds] for name, p in roc.items()},
        },
    }


def _separation(nominal: Array, fault: Array, solved: Solved) -> dict[str, Any]:
    """Histograms of the statistic, as densities; what lies beyond the last edge is in the last bin."""
    last = max(4 * solved.threshold, 30.0)
    edges = np.linspace(0.0, last, _BINS + 1)
    width = edges[1]
    nominal_share, fault_share = (
        np.histogram(np.minimum(np.nan_to_num(values, nan=last), last), edges)[0] / len(values)
        for values in (nominal, fault)
    )
    return {
        "dof": solved.dof, "threshold": solved.threshold, "edges": edges.tolist(),
        "expected": (np.diff(chdtr(solved.dof, edges)) / width).tolist(),
        "nominal": (nominal_share / width).tolist(), "fault": (fault_share / width).tolist(),
        "fault_name": f"far threshold {PAPER_M:g} m nearer than believed",
    }  # fmt: skip


def _largest(errors: Array) -> list[float] | None:
    """Of accepted ones (n, 3), the 95 % quantile per axis."""
    known = errors[np.isfinite(errors).all(axis=1)]
    return [float(q) for q in np.quantile(known, 0.95, axis=0)] if len(known) else None
