"""The field's pictures of an evaluation, drawn from its evidence and its rows.

A figure is drawn once, in the colours of THEME, and leaves as PNG, as an SVG file, and as SVG text
whose colours are variables (`var(--ink)`), so that the page that holds it chooses light or dark.
"""

from __future__ import annotations

import functools
import io
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch, Polygon
from matplotlib.path import Path as Outline
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2

from shortfinal.evaluate.figures import DISTANCE_M
from shortfinal.evaluate.intervals import mean_figure
from shortfinal.evaluate.rows import AXES, Rows
from shortfinal.files import make_folder, write_whole

Array = NDArray[np.float64]
Evidence = dict[str, Any]  # evaluation.json

INK, PAPER, GRID = "#1c2430", "#ffffff", "#d4dae2"
# Okabe and Ito's colours (2008): told apart by colour-blind readers too.
BLUE, RED, GREEN, PURPLE, ORANGE, SKY = "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"
THEME = {
    "ink": INK, "paper": PAPER, "grid": GRID,
    "c1": BLUE, "c2": RED, "c3": GREEN, "c4": PURPLE, "c5": ORANGE, "c6": SKY,
}  # fmt: skip

CAPTIONS = {
    "calibration": "Share of the errors that lie within the central interval that sigma promises, with its 95 % band. "
    "Below the diagonal sigma is too small: the errors are larger than stated.",
    "sharpness": "How the stated sigma of a coordinate is spread, near and far corners apart; ticks mark the medians. "
    "Of two calibrated networks the one further to the left is the better.",
    "statistic": "The RAIM statistic of the evaluated rows against the χ² density that it should follow, and with the "
    "planted fault. What lies right of the threshold is refused: of the fault much should, of the nominal almost none.",
    "detection": "Share of faults that are refused, by their size, with 95 % intervals. "
    "At size zero it is the false-alarm rate.",
    "roc": "Share of faults that are refused against the share of faultless rows refused with them, for all "
    "thresholds. The higher a line stands at the left, the better; on the dotted line one could as well guess.",
    "error_by_distance": "Position error by distance: the median and the 95 % quantile span the band. "
    "Where the RMS error stands above the predicted sigma, sigma is too small; the protection level "
    "must stay above all.",
    "error_by_group": "Median pixel error and the share of errors within the 95 % interval, with their own 95 % "
    "intervals, for each group. Triangles mark groups whose errors leave that interval more than twice as often as "
    "promised.",
    **{
        f"stanford_{axis}": f"Stanford diagram of the {axis} axis: each accepted row's error against its protection "
        "level; stronger colour is more rows. Below the diagonal the error exceeds the level: misleading information. "
        "What lies beyond the axes, infinite levels among it, is drawn at their edge."
        for axis in AXES
    },
    "latency": "Share of rows whose picture was looked at, all looks together, within the time.",
    "bias_by_distance": "Mean signed error of the near and of the far corners with its 95 % interval, along u (to the "
    "right) and v (down). An interval that leaves zero out is a bias; a short bar marks the median.",
}

_STYLE: Any = {  # of matplotlib
    "font.family": "sans-serif", "font.size": 9, "text.color": INK,
    "axes.edgecolor": INK, "axes.labelcolor": INK, "axes.titlecolor": INK, "axes.titlelocation": "left",
    "axes.titlesize": 9.5, "axes.titleweight": "bold", "axes.linewidth": 0.7, "axes.axisbelow": True,
    "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "grid.color": GRID,
    "grid.linewidth": 0.6, "axes.facecolor": PAPER, "figure.facecolor": PAPER, "figure.edgecolor": PAPER,
    "xtick.color": INK, "ytick.color": INK, "xtick.major.width": 0.7, "ytick.major.width": 0.7,
    "xtick.minor.size": 0, "ytick.minor.size": 0, "lines.linewidth": 1.5, "lines.markersize": 4.5,
    "patch.edgecolor": INK, "legend.frameon": False, "legend.fontsize": 8, "legend.handlelength": 1.6,
    "figure.constrained_layout.use": True,
    "svg.fonttype": "none", "svg.hashsalt": "shortfinal", "savefig.facecolor": "auto", "savefig.edgecolor": "auto",
}  # fmt: skip
_LEAST_REACH_PX = 0.5  # of the axis of biases: chance must not look like one
_FEWEST = 5  # rows of a bin that is drawn
_MOST_AIRPORTS = 30
_CELLS = 48  # of a Stanford diagram, each way
_SHADES = 5
_SMALL = 7.5  # font size of what is written into a figure
_OUTSIDE = 0.1  # share beyond the 95 % interval that is marked: twice as many as promised


@matplotlib.rc_context(_STYLE)
def draw(evidence: Evidence, rows: Rows) -> dict[str, Figure]:
    """The figures by name, in the order of CAPTIONS; those that `evidence` or `rows` have nothing for are left out.

    `evidence` is what evaluation.json holds, `rows` what it was made of.
    """
    figures = {name: _DRAWN[name](evidence, rows) for name in CAPTIONS}
    return {name: figure for name, figure in figures.items() if figure is not None}


def as_svg(figure: Figure, name: str) -> str:
    """The figure as an SVG element for a page: transparent, its colours the variables named in THEME.

    `name` goes before its ids, so that many figures can stand in one page, and is its label.
    """
    return _themed(_svg(figure, name))


def write_plots(out: str | Path, evidence: Evidence, rows: Rows) -> dict[str, str]:
    """Write figures/NAME.svg and figures/NAME.png of each figure into `out`; as `as_svg` by name, for a page.

    Raises InputError if they cannot be written.
    """
    folder, texts = make_folder(Path(out) / "figures"), {}
    for name, figure in draw(evidence, rows).items():
        text = _svg(figure, name)
        write_whole(folder / f"{name}.svg", text.replace('style="', f'style="background: {PAPER}; ', 1) + "\n")
        figure.set_layout_engine("none")  # it is laid out by now, and that takes longer than to draw it
        write_whole(folder / f"{name}.png", _png(figure))
        texts[name] = _themed(text)
    return texts


def _themed(text: str) -> str:
    for variable, colour in THEME.items():
        text = text.replace(colour, f"var(--{variable})")
    return text


@matplotlib.rc_context(_STYLE)
def _png(figure: Figure) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=150, metadata={"Software": None})
    return content.getvalue()


@matplotlib.rc_context(_STYLE)
def _svg(figure: Figure, name: str) -> str:
    """SVG in the colours of THEME: no header, no metadata, two decimals, only the ids that are referred to."""
    content = io.StringIO()
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    figure.savefig(content, format="svg", transparent=True, metadata=nothing)
    text = content.getvalue()
    # Matplotlib's style element would hold for the whole page.
    text = re.sub(r"<defs>\s*<style.*?</style>\s*</defs>\s*", "", text[text.index("<svg") :], flags=re.DOTALL).strip()
    label = f'role="img" aria-label="{name.replace("_", " ")}" style="stroke-linejoin: round; stroke-linecap: butt"'
    text = text.replace("<svg", f"<svg {label}", 1)
    text = re.sub(r"<[^>]*>", lambda tag: _short_tag(tag[0]), text)
    used = set(re.findall(r"url\(#([^)]+)\)", text)) | set(re.findall(r'href="#([^"]+)"', text))
    text = re.sub(r' id="([^"]+)"', lambda m: f' id="{name}-{m[1]}"' if m[1] in used else "", text)
    return re.sub(r'(url\(#|href="#)', rf"\g<1>{name}-", text)


def _short_tag(tag: str) -> str:
    tag = re.sub(r"-?\d+\.\d{3,}(e-?\d+)?", lambda number: f"{float(number[0]):.2f}".rstrip("0").rstrip("."), tag)
    tag = re.sub(r"font-family: [^;\"]*", "font-family: sans-serif", tag)
    tag = re.sub(r' transform="rotate\(-0 [^)]*\)"', "", tag)
    return re.sub(r"\s+", " ", tag)


# --- the figures -------------------------------------------------------------------------------------------------


def _calibration(evidence: Evidence, _: Rows) -> Figure | None:
    found = evidence.get("calibration")
    if not found:
        return None
    nominal, observed, low, high = (_numbers(found[key]) for key in ("nominal", "observed", "low", "high"))
    figure, (axes,) = _panels("Calibration", (4.6, 4.4))
    axes.plot([0, 1], [0, 1], "--", color=INK, lw=1, label="as promised")
    axes.fill_between(nominal, low, high, color=BLUE, alpha=0.25, lw=0, label="95 % interval")
    axes.plot(nominal, observed, color=BLUE, label="observed")
    axes.text(0.98, 0.06, "σ too small", ha="right", fontsize=_SMALL, style="italic")
    axes.text(0.02, 0.62, "σ too large", fontsize=_SMALL, style="italic")
    axes.set(xlabel="promised share of errors", ylabel="observed share", xlim=(0, 1), ylim=(0, 1), aspect="equal")
    _per_cent(axes.xaxis, axes.yaxis)
    axes.legend(loc="upper left")
    return figure


def _sharpness(evidence: Evidence, rows: Rows) -> Figure | None:
    found, known = evidence.get("sharpness"), rows.predicted
    if not found or not known.any():
        return None
    edges, sigma = _numbers(found["edges"]), rows.sigma_px[known]
    figure, (axes,) = _panels("Sharpness", (5.6, 3.2))
    for label, ends, colour, line in (("near", slice(0, 2), BLUE, "-"), ("far", slice(2, 4), RED, "--")):
        values = sigma[:, ends].ravel()
        values = values[np.isfinite(values)]
        if not len(values):
            continue
        share = np.histogram(values, edges)[0] / len(values)
        middle = float(np.median(values))
        axes.stairs(share, edges, color=colour, fill=True, alpha=0.18)
        axes.stairs(share, edges, color=colour, ls=line, lw=1.5, label=f"{label} corners, median {middle:.2g} px")
        axes.plot([middle], [0], marker="^", ms=8, color=colour, clip_on=False, zorder=4)
    axes.set(xscale="log", xlabel="σ of a coordinate, px of the picture", ylabel="share of coordinates")
    axes.set_ylim(0, 1.25 * axes.get_ylim()[1])  # room for the legend
    _log_ticks(axes.xaxis, edges[0], edges[-1])
    _per_cent(axes.yaxis)
    axes.legend(loc="upper right")
    return figure


def _statistic(evidence: Evidence, _: Rows) -> Figure | None:
    found = evidence.get("statistic")
    if not found:
        return None
    edges, threshold, dof = _numbers(found["edges"]), found["threshold"], found["dof"]
    figure, (axes,) = _panels("RAIM statistic", (5.6, 3.6))
    least = math.inf
    for key, label, colour, line in (
        ("nominal", "nominal", BLUE, "-"), ("fault", found.get("fault_name"), RED, "--")
    ):  # fmt: skip
        if not found.get(key):
            continue
        density = _numbers(found[key])
        least = min(least, density[density > 0].min(initial=math.inf))
        axes.stairs(density, edges, baseline=1e-12, color=colour, fill=True, alpha=0.2)
        axes.stairs(density, edges, baseline=None, color=colour, ls=line, lw=1.3, label=label)
    at = np.linspace(max(edges[0], 1e-3), edges[-1], 300)
    if dof is not None:
        axes.plot(at, chi2.pdf(at, dof), color=INK, lw=1.2, label=f"χ² density, {dof:g} degrees of freedom")
    # The density falls for ever; what matters is a decade below the least that was counted.
    lowest = max(1e-6, min(0.3 * least, 1e-3))
    axes.set(yscale="log", ylim=(lowest, 30), xlim=(edges[0], edges[-1]), ylabel="density")
    axes.set(xlabel="statistic (squared whitened residual)")
    if threshold is not None:
        axes.axvline(threshold, color=INK, ls=":", lw=1.5)
        axes.annotate(
            f"refused beyond {threshold:.3g}", (threshold, 1), (-4, -3), xycoords=("data", "axes fraction"),
            textcoords="offset points", fontsize=_SMALL, va="top", ha="right",
        )  # fmt: skip
    _log_ticks(axes.yaxis, lowest, 30)
    axes.legend(loc="upper right")
    return figure


def _detection(evidence: Evidence, _: Rows) -> Figure | None:
    faults = evidence.get("faults")
    if not faults:
        return None
    columns = min(3, len(faults))
    lines = -(-len(faults) // columns)
    figure, panels = _panels("", (3.1 * columns + 0.3, 2.7 * lines), lines, columns, sharey=True)
    for axes in panels[len(faults) :]:
        axes.set_axis_off()
    for number, (axes, fault) in enumerate(zip(panels, faults, strict=False)):
        sizes, detected, low, high = (_numbers(fault[key]) for key in ("sizes", "detected", "low", "high"))
        axes.fill_between(sizes, low, high, color=BLUE, alpha=0.25, lw=0)
        axes.plot(sizes, detected, "o-", color=BLUE)
        axes.set_title(fault["name"])
        axes.set(xlabel=f"size, {fault['unit']}", ylim=(-0.03, 1.03))
        if number % columns == 0:
            axes.set_ylabel("share detected")
        _per_cent(axes.yaxis)
    return figure


def _roc(evidence: Evidence, _: Rows) -> Figure | None:
    found = evidence.get("roc")
    if not found:
        return None
    false_alarm = _numbers(found["false_alarm"])
    drawn = false_alarm > 0
    figure, (axes,) = _panels("Detection against false alarms", (5.6, 3.6))
    looks = zip((BLUE, RED, GREEN, PURPLE, ORANGE, SKY), ("-", "--", "-.", (0, (5, 1, 1, 1)), "-", "--"), strict=True)
    for (name, detection), (colour, line) in zip(found["detection"].items(), looks, strict=False):
        axes.plot(false_alarm[drawn], _numbers(detection)[drawn], color=colour, ls=line, label=name)
    low = float(false_alarm[drawn].min())
    chance = np.geomspace(low, 1, 100)
    axes.plot(chance, chance, ":", color=INK, lw=1, label="guessing")
    rate = (evidence.get("settings") or {}).get("false_alarm_rate")
    if rate is not None and rate > low:
        axes.axvline(rate, color=INK, lw=0.8, ls=(0, (4, 3)), label=f"set to {rate:g}")
    axes.set(xscale="log", xlim=(low, 1), ylim=(0, 1.02), xlabel="share of faultless rows refused (false alarms)")
    axes.set_ylabel("share of faults refused")
    _log_ticks(axes.xaxis, low, 1)
    _per_cent(axes.yaxis)
    figure.legend(loc="outside right upper")
    return figure


def _error_by_distance(evidence: Evidence, rows: Rows) -> Figure | None:
    found = evidence.get("navigation")
    if not found:
        return None
    edges = _numbers(found["edges_m"])
    middles = (edges[:-1] + edges[1:]) / 2000
    figure, panels = _panels("", (9.3, 3.5), 1, 3, sharex=True)
    for a, (axis, axes) in enumerate(zip(AXES, panels, strict=True)):
        table = {key: _numbers(values) for key, values in found["axes"][axis].items()}
        error, (half, most) = np.abs(rows.error_m[:, a]), (np.full(len(middles), np.nan) for _ in range(2))
        place = np.digitize(rows.distance_m, edges) - 1
        for k in range(len(middles)):
            here = error[(place == k) & np.isfinite(error)]
            if len(here) >= _FEWEST:
                half[k], most[k] = np.quantile(here, [0.5, 0.95])
        axes.fill_between(middles, half, most, color=SKY, alpha=0.35, lw=0, label="|error|, median to 95 %")
        axes.plot(middles, table["level_median_m"], "^-", color=RED, label="protection level, median")
        axes.plot(middles, table["rms_m"], "o-", color=BLUE, label="error, RMS")
        axes.plot(middles, table["sigma_rms_m"], "s--", color=ORANGE, mfc=PAPER, label="predicted σ, RMS")
        axes.set(yscale="log", xlabel="distance, km")
        axes.set_title(axis)
        axes.set_xlim(edges[0] / 1000, edges[-1] / 1000)
        _log_ticks(axes.yaxis, *axes.get_ylim())
    panels[0].set_ylabel("m")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def _error_by_group(evidence: Evidence, _: Rows) -> Figure | None:
    metrics = evidence.get("metrics") or ()
    table = {(m["by"], m["group"], m["name"]): m for m in metrics if m["value"] is not None}
    blocks = [(by, list(dict.fromkeys(g for b, g, _ in table if b == by))) for by in ("airport", "distance")]
    names = ("error_px.median", "coverage.95")
    blocks = [(by, [g for g in groups if any((by, g, n) in table for n in names)]) for by, groups in blocks]
    blocks = [(by, groups) for by, groups in blocks if groups]
    if not blocks:
        return None
    blocks, left_out = _worst_airports(blocks, table)
    count = sum(len(groups) + 1 for _, groups in blocks) + bool(left_out)
    figure, panels = _panels("", (7.6, 1.2 + 0.2 * count), 1, 2, sharey=True)
    ticks: list[tuple[float, str]] = []
    line = 0
    for by, groups in blocks:
        panels[0].annotate(
            by, (0, line), (-6, 0), xycoords=("axes fraction", "data"), textcoords="offset points",
            ha="right", va="center", weight="bold", annotation_clip=False,
        )  # fmt: skip
        for at, group in enumerate(groups, line + 1):
            ticks.append((at, group or "unnamed"))
            bad = _marked(table.get((by, group, "coverage.95")))
            for axes, name in zip(panels, names, strict=True):
                _draw_interval(axes, at, table.get((by, group, name)), bad)
        line += len(groups) + 1
        if by == "airport" and left_out:
            ticks.append((line, f"and {left_out} better"))
            line += 1
    overall = table.get(("all", "all", names[0]))
    if overall:
        panels[0].axvline(overall["value"], color=INK, ls="--", lw=1)
    panels[1].axvline(0.95, color=INK, ls="--", lw=1)
    panels[0].set_title("median error of a coordinate")
    panels[1].set_title("errors within their 95 % interval")
    panels[0].set(xlabel="px" + (" (dashed: of all rows)" if overall else ""), ylim=(line - 0.3, -0.6))
    panels[0].set_xlim(left=0)
    panels[1].set(xlabel="dashed: as promised", xlim=(None, 1.005))
    _per_cent(panels[1].xaxis)
    panels[0].yaxis.set_major_locator(FixedLocator([at for at, _ in ticks]))
    panels[0].set_yticklabels([name for _, name in ticks])
    for axes in panels:
        axes.tick_params(axis="y", length=0)
        axes.spines["left"].set_visible(False)
    return figure


def _worst_airports(
    blocks: list[tuple[str, list[str]]], table: dict[tuple[str, str, str], Any]
) -> tuple[list[tuple[str, list[str]]], int]:
    """Airports by their coverage, the lowest first, at most _MOST_AIRPORTS; and how many that leaves out."""
    out, left_out = [], 0
    for by, groups in blocks:
        shown = groups
        if by == "airport":
            coverage = {group: table.get((by, group, "coverage.95"), {"value": 1.0})["value"] for group in groups}
            shown = sorted(groups, key=lambda group: (coverage[group], group))[:_MOST_AIRPORTS]
            left_out = len(groups) - len(shown)
        out.append((by, shown))
    return out, left_out


def _marked(coverage: dict[str, Any] | None) -> bool:
    """Whether surely more than _OUTSIDE lie beyond the 95 % interval."""
    if coverage is None:
        return False
    high = coverage["value"] if coverage["high"] is None else coverage["high"]
    return bool(high < 1 - _OUTSIDE)


def _draw_interval(axes: Axes, at: float, metric: dict[str, Any] | None, bad: bool) -> None:
    if metric is None:
        return
    colour, marker = (RED, "^") if bad else (BLUE, "o")
    if metric["low"] is not None and metric["high"] is not None:
        axes.plot([metric["low"], metric["high"]], [at, at], color=colour, lw=1.8, solid_capstyle="butt")
    axes.plot([metric["value"]], [at], marker, color=colour, ms=6 if bad else 4.5)


def _stanford(a: int, evidence: Evidence, rows: Rows) -> Figure | None:
    axis = AXES[a]
    counts = (evidence.get("stanford") or {}).get(axis)
    which = rows.accepted & np.isfinite(rows.error_m[:, a]) & ~np.isnan(rows.level_m[:, a])
    if not counts or not which.any():
        return None
    error, level = np.abs(rows.error_m[which, a]), rows.level_m[which, a]
    limits = (evidence.get("settings") or {}).get("alert_limits_m")
    limit = math.inf if limits is None or limits[a] is None else float(limits[a])
    low, high = _decades(error, level, limit)
    figure, (axes,) = _panels(f"{axis}: error against protection level", (5.2, 5.0))
    axes.set(
        xscale="log", yscale="log", xlim=(low, high), ylim=(low, high), aspect="equal", ylabel="protection level, m"
    )
    axes.grid(False)
    edges = np.geomspace(low, high, _CELLS + 1)
    for over, colour, faintest in ((False, BLUE, 0.15), (True, RED, 0.6)):
        some = (error > level) == over
        cells = np.histogram2d(np.clip(error[some], low, high), np.clip(level[some], low, high), (edges, edges))[0]
        _draw_cells(axes, edges, cells, colour, faintest)
    axes.plot([low, high], [low, high], color=INK, lw=1)
    _draw_regions(axes, counts, limit, low, high)
    refused = counts.get("not_accepted")
    axes.set_xlabel(f"|{axis} error|, m" + (f"\nnot drawn: {refused:,} not accepted" if refused else ""))
    for each in (axes.xaxis, axes.yaxis):
        _log_ticks(each, low, high)
    return figure


def _decades(error: Array, level: Array, limit: float) -> tuple[float, float]:
    """Whole decades that hold almost all, and the limit with room for words at its right."""
    known = np.concatenate([error[error > 0], level[np.isfinite(level)]])
    low, high = np.quantile(known, [0.01, 0.9995]) if len(known) else (1.0, 1.0)
    if math.isfinite(limit):
        low, high = min(low, 0.1 * limit), max(high, 4 * limit)
    bottom, top = math.floor(math.log10(low)), math.ceil(math.log10(high))
    return 10.0**bottom, 10.0 ** max(top, bottom + 2)


def _draw_cells(axes: Axes, edges: Array, counts: Array, colour: str, faintest: float) -> None:
    """A cell of each count (x, y) above zero, in shades by its logarithm; one path a shade keeps the SVG small."""
    shade = np.ceil(_SHADES * np.log1p(counts) / math.log1p(counts.max(initial=1)) - 1e-9).astype(int)
    for number in range(1, _SHADES + 1):
        vertices: list[tuple[float, float]] = []
        for j in range(counts.shape[1]):
            # Neighbours of one shade are one rectangle.
            turns = np.flatnonzero(np.diff(np.pad(shade[:, j] == number, 1).astype(int)))
            for first, last in zip(turns[::2], turns[1::2], strict=True):
                left, right, bottom, top = edges[first], edges[last], edges[j], edges[j + 1]
                vertices += [(left, bottom), (right, bottom), (right, top), (left, top), (left, bottom)]
        if vertices:
            codes = [Outline.MOVETO, *[Outline.LINETO] * 3, Outline.CLOSEPOLY] * (len(vertices) // 5)
            alpha = faintest + (1 - faintest) * number / _SHADES
            axes.add_patch(PathPatch(Outline(vertices, codes), fc=colour, lw=0, alpha=alpha))


def _draw_regions(axes: Axes, counts: dict[str, int], limit: float, low: float, high: float) -> None:
    """The regions tinted, and their counts of rows written in."""
    if math.isfinite(limit):
        _tint(axes, ORANGE, (low, low), (limit, limit), (limit, low))
        _tint(axes, RED, (limit, low), (limit, limit), (high, limit), (high, low))
        _tint(axes, INK, (low, limit), (low, high), (high, high), (high, limit))
        axes.plot([low, high], [limit, limit], "--", color=INK, lw=0.8)
        axes.plot([limit, limit], [low, limit], "--", color=INK, lw=0.8)
        words = [
            (
                "nominal",
                "nominal",
                (low, low * min((limit / low) ** 0.6, (high / low) ** 0.4)),
                (5, 0),
                "left",
                "center",
            ),
            ("unavailable", "unavailable", (low, high), (5, -5), "left", "top"),
            ("misleading", "misleading", (limit, low), (-5, 5), "right", "bottom"),
            ("hazardous", "hazardous", (high, low), (-5, 5), "right", "bottom"),
            ("unavailable_misleading", "unavailable,\nmisleading", (high, limit), (-5, 4), "right", "bottom"),
        ]
    else:
        _tint(axes, ORANGE, (low, low), (high, high), (high, low))
        words = [
            ("nominal", "nominal", (low, low * (high / low) ** 0.4), (5, 0), "left", "center"),
            ("misleading", "misleading", (high, low), (-5, 5), "right", "bottom"),
        ]
    for key, word, place, offset, across, up in words:
        if counts.get(key) is not None:
            axes.annotate(
                f"{word}\n{counts[key]:,}", place, offset, textcoords="offset points", ha=across, va=up,
                fontsize=_SMALL, linespacing=1.25,
                bbox={"boxstyle": "square,pad=0.15", "fc": PAPER, "ec": "none", "lw": 0, "alpha": 0.75},
            )  # fmt: skip


def _tint(axes: Axes, colour: str, *corners: tuple[float, float]) -> None:
    axes.add_patch(Polygon(corners, fc=colour, lw=0, alpha=0.1, zorder=0.5))


def _latency(_: Evidence, rows: Rows) -> Figure | None:
    known = np.sort(rows.latency_ms[np.isfinite(rows.latency_ms)])
    if not len(known):
        return None
    share = np.linspace(0, 1, min(len(known), 300) + 1)[1:]
    figure, (axes,) = _panels("Latency", (5.6, 3.0))
    axes.plot(np.quantile(known, share, method="inverted_cdf"), share, color=BLUE, drawstyle="steps-post")
    for quantile, up in ((0.5, "center"), (0.95, "center"), (0.99, "bottom")):
        value = float(np.quantile(known, quantile))
        axes.plot([value], [quantile], "o", color=RED)
        # Left of the curve, where it has not been yet.
        axes.annotate(
            f"{100 * quantile:g} %: {value:.3g} ms", (value, quantile), (-8, 0), textcoords="offset points",
            fontsize=_SMALL, ha="right", va=up,
        )  # fmt: skip
    axes.set(xlabel="ms, looking at one picture", ylabel="share of rows", ylim=(0, 1.09), xlim=(0, None))
    _per_cent(axes.yaxis)
    return figure


def _bias_by_distance(evidence: Evidence, rows: Rows) -> Figure | None:
    known = rows.predicted & np.isfinite(rows.truth_px).all(axis=(1, 2)) & np.isfinite(rows.distance_m)
    if not known.any():
        return None
    edges = _numbers((evidence.get("navigation") or {}).get("edges_m") or DISTANCE_M)
    error, distance = rows.error_px[known], rows.distance_m[known]
    place = np.digitize(distance, edges) - 1
    figure, panels = _panels("", (7.6, 3.2), 1, 2, sharex=True, sharey=True)
    reach = 0.0
    for coordinate, axes in enumerate(panels):
        for end, ends, colour, marker, shift in (
            ("near", slice(0, 2), BLUE, "o", -0.035), ("far", slice(2, 4), RED, "s", 0.035)
        ):  # fmt: skip
            values = error[:, ends, coordinate].mean(axis=1)
            table = np.array([_bias(values[place == k]) for k in range(len(edges) - 1)])
            middle, mean, half, median = (*((edges[:-1] + edges[1:]) / 2000 + shift, *table.T),)
            axes.errorbar(middle, mean, half, fmt=marker, color=colour, capsize=2.5, lw=1.3, label=f"{end} corners")
            axes.plot(middle, median, "_", color=colour, ms=10, mew=1.2)
            ends_of = np.abs(np.concatenate([mean - half, mean + half]))
            reach = max(reach, float(ends_of[np.isfinite(ends_of)].max(initial=0.0)))
        axes.axhline(0, color=INK, lw=1)
        axes.set(xlabel="distance, km", xlim=(edges[0] / 1000, min(edges[-1], distance.max() * 1.1) / 1000))
        axes.set_title(("u, to the right", "v, down")[coordinate])
    panels[0].set_ylim(-max(1.1 * reach, _LEAST_REACH_PX), max(1.1 * reach, _LEAST_REACH_PX))
    if reach > 20:  # px: of outliers; small biases must be seen beside them
        panels[0].set_yscale("symlog", linthresh=1.0)
        panels[0].yaxis.set_major_formatter(FuncFormatter(_power))
    panels[0].set_ylabel("mean signed error, px")
    panels[0].legend(loc="best")
    return figure


def _bias(values: Array) -> tuple[float, float, float]:
    """Mean, half its 95 % interval, and median of `values` (n,)."""
    mean = mean_figure(values) if len(values) >= _FEWEST else None
    return (math.nan,) * 3 if mean is None else (mean.value, mean.high - mean.value, float(np.median(values)))


_DRAWN: dict[str, Callable[[Evidence, Rows], Figure | None]] = {
    "calibration": _calibration,
    "sharpness": _sharpness,
    "statistic": _statistic,
    "detection": _detection,
    "roc": _roc,
    "error_by_distance": _error_by_distance,
    "error_by_group": _error_by_group,
    **{f"stanford_{axis}": functools.partial(_stanford, a) for a, axis in enumerate(AXES)},
    "latency": _latency,
    "bias_by_distance": _bias_by_distance,
}


# --- what they share ---------------------------------------------------------------------------------------------


def _panels(
    title: str,
    size: tuple[float, float],
    lines: int = 1,
    columns: int = 1,
    *,
    sharex: bool = False,
    sharey: bool = False,
) -> tuple[Figure, list[Axes]]:
    """A figure of `size` inches and its axes, line by line. Not pyplot's: that keeps a global state."""
    figure = Figure(figsize=size)
    axes = list(figure.subplots(lines, columns, squeeze=False, sharex=sharex, sharey=sharey).flat)
    if title:
        axes[0].set_title(title)
    return figure, axes


def _numbers(values: Sequence[float | None] | ArrayLike) -> Array:
    """Null is NaN: not drawn."""
    return np.array([math.nan if value is None else value for value in np.asarray(values, object).tolist()], float)


def _per_cent(*axes: Axis) -> None:
    for axis in axes:
        axis.set_major_formatter(FuncFormatter(lambda share, _: f"{100 * share:.6g} %"))


def _log_ticks(axis: Axis, low: float, high: float) -> None:
    """Decades, and 2 and 5 between where they are few, in plain numbers."""
    subs = (1.0, 2.0, 5.0) if high / low < 300 else (1.0,)
    axis.set_major_locator(LogLocator(subs=subs, numticks=12))
    axis.set_major_formatter(FuncFormatter(_power))
    axis.set_minor_formatter(NullFormatter())


def _power(value: float, _: int | None = None) -> str:
    if value != 0 and abs(value) < 1e-3:
        return f"1e−{-round(math.log10(abs(value)))}"
    return f"{value:,.10g}".replace("-", "−")
