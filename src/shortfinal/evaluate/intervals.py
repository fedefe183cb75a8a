"""Means, shares and quantiles with the interval that holds the true one with 95 %.

Numbers of one row (the coordinates of one runway) are alike, rows are taken as independent: every
variance is that of a ratio of sums over rows. Shares get the interval of Korn & Graubard (1998), which
is Clopper and Pearson's for as many draws as the rows are worth; quantiles get Woodruff's (1952), the
quantiles at the ends of the share's interval. Where rows are not independent (frames of one approach,
one airport) the true intervals are wider.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv, expit, logit, ndtri, stdtrit

from shortfinal.evaluate.rows import Figure

Array = NDArray[np.float64]

CONFIDENCE = 0.95
_TAIL = (1 - CONFIDENCE) / 2


def mean_figure(values: Array, unit: str = "") -> Figure | None:
    """The mean of values (N,) or (N, ...), NaN left out, over N independent rows; None of nothing."""
    sums, counts = _by_row(values)
    total = counts.sum()
    if total == 0:
        return None
    mean = float(sums.sum() / total)
    rows = int((counts > 0).sum())
    if rows < 2:
        return Figure(mean, math.nan, math.nan, int(total), unit)
    error = math.sqrt(_variance(sums - mean * counts, rows, float(total)))
    reach = float(stdtrit(rows - 1, 1 - _TAIL)) * error
    return Figure(mean, mean - reach, mean + reach, int(total), unit)


def share_figure(flags: Array | NDArray[np.bool_]) -> Figure | None:
    """The share of flags (N,) or (N, ...) that are 1, NaN left out, over N independent rows; None of nothing."""
    sums, counts = _by_row(np.asarray(flags, np.float64))
    total = int(counts.sum())
    if total == 0:
        return None
    share = float(sums.sum() / total)
    low, high = share_interval(share, _worth(sums - share * counts, counts, share))
    return Figure(share, low, high, total, "")


def quantile_figures(values: Array, levels: Sequence[float], unit: str = "") -> list[Figure | None]:
    """The quantiles of values (N,) or (N, ...) at several levels, NaN left out, over N independent rows.

    An end that lies beyond the data is the smallest or the largest of them.
    """
    known = np.sort(values[~np.isnan(values)])
    if len(known) == 0:
        return [None] * len(levels)
    figures: list[Figure | None] = []
    counts = _by_row(values)[1]
    for level in levels:
        at = float(np.quantile(known, level))
        below = _by_row(np.where(np.isnan(values), np.nan, values <= at))[0]
        ends = share_interval(level, _worth(below - level * counts, counts, level))
        low, high = (float(end) for end in np.quantile(known, ends))
        figures.append(Figure(at, low, high, len(known), unit))
    return figures


def auroc_figure(inside: Array, outside: Array) -> Figure | None:
    """The area under the ROC curve of a score that should be high inside (N,) and low outside (M,); NaN left out.

    It is the share of pairs in the right order, ties counted half. The interval is DeLong, DeLong and
    Clarke-Pearson's (1988), on the scale of the logit, where it cannot leave (0, 1); of a perfect separation, as
    for so many rows without an exception. None where either is empty.
    """
    a, b = inside[~np.isnan(inside)], outside[~np.isnan(outside)]
    if not (len(a) and len(b)):
        return None
    above = (_below(a, b), 1 - _below(b, a))  # of each its share of pairs in the right order
    area, pairs = float(above[0].mean()), len(a) + len(b)
    if min(len(a), len(b)) < 2:
        return Figure(area, math.nan, math.nan, pairs, "")
    variance = float(sum(np.var(shares, ddof=1) / len(shares) for shares in above))
    if variance == 0:
        return Figure(area, *share_interval(area, min(len(a), len(b))), pairs, "")
    reach = float(ndtri(1 - _TAIL)) * math.sqrt(variance) / (area * (1 - area))
    low, high = expit(logit(area) + np.array([-reach, reach]))
    return Figure(area, float(low), float(high), pairs, "")


def _below(values: Array, others: Array) -> Array:
    """Of each value the share of the others that it exceeds, ties counted half."""
    ordered = np.sort(others)
    less, up_to = (np.searchsorted(ordered, values, side=side) for side in ("left", "right"))
    return np.asarray((less + up_to) / 2 / len(others))


def _by_row(values: Array) -> tuple[Array, Array]:
    """Sum and number of the values known of each row (N,)."""
    table = values.reshape(len(values), -1)
    known = ~np.isnan(table)
    return np.where(known, table, 0.0).sum(axis=1), known.sum(axis=1).astype(np.float64)


def _variance(residuals: Array, rows: int, total: float) -> float:
    """Of a ratio of sums, from each row's part in what is left of the numerator (N,)."""
    return float(np.sum(residuals**2)) / total**2 * rows / (rows - 1)


def _worth(residuals: Array, counts: Array, share: float) -> float:
    """How many independent draws know a share as well as these rows; of shares 0 and 1 as many as there are rows."""
    rows = int((counts > 0).sum())
    variance = _variance(residuals, rows, float(counts.sum())) if rows > 1 else 0.0
    if variance == 0:
        return float(rows)
    draws = share * (1 - share) / variance
    # The variance is itself an estimate: Korn and Graubard's allowance for the degrees of freedom.
    loss = (float(stdtrit(counts.sum() - 1, 1 - _TAIL)) / float(stdtrit(rows - 1, 1 - _TAIL))) ** 2
    return float(min(draws * loss, counts.sum()))


def share_interval(share: float, draws: float) -> tuple[float, float]:
    """Clopper & Pearson (1934), for a number of draws that need not be whole."""
    hits = share * draws
    low = float(betaincinv(hits, draws - hits + 1, _TAIL)) if hits > 0 else 0.0
    high = float(betaincinv(hits + 1, draws - hits, 1 - _TAIL)) if hits < draws else 1.0
    return low, high
