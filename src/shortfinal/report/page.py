"""An evaluation as one HTML file: opens without a network, light and dark, prints."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any, TypeVar
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from shortfinal.evaluate.rows import DECISIONS, USE, Rows
from shortfinal.files import write_whole
from shortfinal.report.examples import ExamplePicture
from shortfinal.report.plots import CAPTIONS

MAX_ROWS = 4000  # of the explorer; more make the file large and tell nobody more
MAX_GROUPS = 120  # of one table
MAX_BYTES = 4_900_000  # of the file
PLOT_BYTES = 1_600_000  # of them, at most for plots
EXAMPLE_BYTES = 1_200_000  # and for example pictures
CLIP = 300  # characters of one text from outside, in the tables
STANDS_OUT = 0.05  # a group is named at the top if its interval of a coverage lies farther than this from nominal
NAMED = 7  # of those, at most
SEED = 20240184
GLOSSARY = ("glossary", "How to read this", "")  # stands in page.html

Metric = dict[str, Any]
T = TypeVar("T")


def write_page(
    out: Path, evidence: dict[str, Any], rows: Rows, plots: Mapping[str, str], examples: Sequence[ExamplePicture]
) -> Path:
    """Write out/report.html, at most 5 MB, and return its path.

    evidence: the content of evaluation.json; what it lacks is left out of the page. rows: the table behind it; some
    4,000 of them go into the page (those misleading, worst and not accepted first, then a seeded draw). plots: name ->
    SVG whose colours are the CSS variables --ink, --paper, --grid, --c1 ... --c6. examples: thumbnails. What does not
    fit into the size is named in the page's notes: plots and examples each have their share, rows get what is left.
    Raises InputError if the file cannot be written.
    """
    kept_plots = _fit(plots.items(), PLOT_BYTES, lambda item: len(item[1].encode("utf-8", "backslashreplace")))
    kept_examples = _fit(examples, EXAMPLE_BYTES, lambda example: len(example.jpeg) * 4 // 3 + CLIP)
    notes = []
    if len(kept_plots) < len(plots):
        lacking = ", ".join(name for name in plots if name not in dict(kept_plots))
        notes.append(f"Plots too large for this file, to be found beside it: {lacking}.")
    if len(kept_examples) < len(examples):
        notes.append(f"{len(examples) - len(kept_examples)} of {len(examples)} example pictures are left out for size.")
    script = _template("page.js")
    frame = {
        "title": _text(evidence.get("title") or "Evaluation"),
        "version": _text(evidence.get("version")),
        "created": _text(evidence.get("created")),
        "subject": _subject(evidence),
        "style": _template("page.css"),
        "script": script,
        "script_hash": base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    }
    sections = _sections(evidence, len(rows), dict(kept_plots), kept_examples, notes)
    frame["body"] = "\n".join(
        f'<section id="{ident}" aria-labelledby="{ident}-title">{content}</section>' for ident, _, content in sections
    )
    frame["contents"] = _items(f'<a href="#{ident}">{name}</a>' for ident, name, _ in [*sections, GLOSSARY])
    page = Template(_template("page.html"))
    empty = page.substitute(frame, data="").encode("utf-8", "backslashreplace")
    data = _embedded(evidence, rows, [example.row for example in kept_examples], MAX_BYTES - len(empty))
    path = Path(out) / "report.html"
    # A name read from a damaged file system may hold half a character, which UTF-8 cannot.
    write_whole(path, page.substitute(frame, data=data).encode("utf-8", "backslashreplace"))
    return path


def _template(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


def _fit(items: Iterable[T], budget: int, size: Callable[[T], int]) -> list[T]:
    """Those of them that fit, in order."""
    kept = []
    for item in items:
        if size(item) <= budget:
            budget -= size(item)
            kept.append(item)
    return kept


# --- the rows that go along, as JSON


def chosen_rows(rows: Rows, limit: int, also: Sequence[int] = ()) -> NDArray[np.int64]:
    """Numbers of at most `limit` rows, the most telling first.

    `also`, then rows whose error exceeds a level though they were accepted, the worst by pixels and by sigmas (an
    eighth of the limit each), those not accepted (up to half the limit, drawn with a fixed seed), then any.
    """
    everyone = np.random.default_rng(SEED).permutation(len(rows))
    with np.errstate(invalid="ignore", divide="ignore"):
        misleading = rows.accepted & (np.abs(rows.error_m) > rows.level_m).any(axis=1)
        pixels = np.linalg.norm(rows.error_px, axis=2).max(axis=1, initial=0)
        sigmas = (np.abs(rows.error_px) / rows.sigma_px).max(axis=(1, 2), initial=0)
    worst = [
        np.argsort(-np.where(np.isfinite(size), size, -1), kind="stable")[: limit // 8] for size in (pixels, sigmas)
    ]
    ordered = np.concatenate(
        [
            np.asarray(also, np.int64),
            everyone[misleading[everyone]],
            *worst,
            everyone[(rows.decision != USE)[everyone]][: limit // 2],
            everyone,
        ]
    )
    _, first = np.unique(ordered, return_index=True)
    return ordered[np.sort(first)][:limit]


FIELDS = (
    *("row", "picture", "source", "ident", "airport", "light", "decision", "reason"),
    *("distance_m", "glide_deg", "lateral_deg", "enlarged", "present", "statistic", "dof", "p_value", "latency_ms"),
    *("error_m", "sigma_m", "level_m", "truth_px", "mean_px", "sigma_px", "correlation"),
)


def _embedded(evidence: dict[str, Any], rows: Rows, also: Sequence[int], budget: int) -> str:
    """The rows and what the diagrams need, as JSON that cannot end its script element; rows fill the budget."""
    head = {
        "fields": FIELDS,
        "total": len(rows),
        "alert_limits_m": (evidence.get("settings") or {}).get("alert_limits_m"),
    }
    numbers = chosen_rows(rows, MAX_ROWS, also)
    some = rows.select(numbers)
    variance = np.diagonal(some.cov_px, axis1=1, axis2=2)
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma = np.sqrt(variance)
        correlation = np.stack(
            [some.cov_px[:, 2 * k, 2 * k + 1] / sigma[:, 2 * k] / sigma[:, 2 * k + 1] for k in range(4)], 1
        )
    columns = [
        numbers,
        *(getattr(some, name) for name in FIELDS[1:20]),
        some.truth_px.reshape(-1, 8),
        some.mean_px.reshape(-1, 8),
        sigma,
        correlation,
    ]
    lines = []
    for values in zip(*columns, strict=True):
        line = _json(
            [
                _plain(value, 7 if name in ("truth_px", "mean_px") else 5)
                for name, value in zip(FIELDS, values, strict=True)
            ]
        )
        budget -= len(line) + 1
        if budget < len(_json(head)) + 20:
            break
        lines.append(line)
    return f'{_json(head)[:-1]},"rows":[{",".join(lines)}]}}'


def _json(value: Any) -> str:
    """JSON for a script element: no character that HTML reads."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _plain(value: Any, digits: int) -> Any:
    """A cell for JSON: null where not known, "inf" for a level that cannot be given; a vector of nothing is null."""
    if isinstance(value, np.ndarray):
        cells = [_plain(number, digits) for number in value.tolist()]
        return None if all(cell is None for cell in cells) else cells
    if isinstance(value, (float, np.floating)):
        return None if math.isnan(value) else "inf" if math.isinf(value) else float(f"{value:.{digits}g}")
    if isinstance(value, np.integer):
        return int(value)
    return _clip("" if value is None else str(value))


# --- words and numbers


def _clip(text: str) -> str:
    return text if len(text) <= CLIP else text[: CLIP - 1] + "…"


def _text(value: Any) -> str:
    """Any text from outside, safe in HTML; a dash where there is none."""
    return "–" if value is None or value == "" else html.escape(_clip(str(value)))


SHARES = re.compile(
    r"(near_|far_)?coverage\.|(use|do_not_use|not_monitored|missing|alarm|available|hazardous|over_level)$"
    r"|\w+_(within_2sigma|over_level)$|detection\.|distance_relative"
)


def _number(value: float | None, share: bool = False) -> str:
    if value is None or not math.isfinite(value):
        return "–"
    if share:
        percent = 100 * value
        decimals = 0 if percent in (0, 100) else 1 if 1 <= percent <= 99 else 2
        text = f"{percent:.{decimals}f}" if percent == 0 or abs(percent) >= 0.01 else f"{percent:.1e}"
        return f"{text} %".replace("-", "−")
    if value == 0:
        return "0"
    size = math.floor(math.log10(abs(value)))
    text = f"{value:.2e}" if size < -4 or size > 6 else f"{value:,.{max(0, 2 - size)}f}"
    return text.replace("-", "−")


def _interval(metric: Metric) -> str:
    share = bool(SHARES.match(metric.get("name", "")))
    low, high = metric.get("low"), metric.get("high")
    if low is None or high is None:
        return "no interval"
    return f"{_number(low, share).removesuffix(' %')} to {_number(high, share)}"


def _unit(metric: Metric) -> str:
    return f" {_text(metric['unit'])}" if metric.get("unit") else ""


def _value(metric: Metric) -> str:
    return _number(metric.get("value"), bool(SHARES.match(metric.get("name", ""))))


STEMS = {
    "error_px": "Corner error, px",
    "near_error_px": "Near corners' error, px",
    "far_error_px": "Far corners' error, px",
    "error_input_px": "Corner error, px of the network's input",
    "sigma_px": "Predicted σ, px",
    "sigma_input_px": "Predicted σ, px of the network's input",
    "coverage": "All corners",
    "near_coverage": "Near corners",
    "far_coverage": "Far corners",
    "nees": "Normalised error squared",
    "nll": "Negative log-likelihood per coordinate",
    "use": "Accepted",
    "do_not_use": "Refused",
    "not_monitored": "Not monitored",
    "missing": "Missing: nothing was predicted",
    "alarm": "Refused, of those monitored",
    "along_m": "Along-track error, m",
    "cross_m": "Cross-track error, m",
    "vertical_m": "Vertical error, m",
    "distance_relative": "Distance error over distance",
    "along_within_2sigma": "Along-track errors within 2σ",
    "cross_within_2sigma": "Cross-track errors within 2σ",
    "vertical_within_2sigma": "Vertical errors within 2σ",
    "along_over_level": "Along-track error over its level",
    "cross_over_level": "Cross-track error over its level",
    "vertical_over_level": "Vertical error over its level",
    "over_level": "Accepted, error over a level",
    "available": "Available: accepted, every level within its limit",
    "hazardous": "Hazardous: available, an error over its limit",
    "level.along_m": "Along-track protection level, m",
    "level.cross_m": "Cross-track protection level, m",
    "level.vertical_m": "Vertical protection level, m",
    "latency_ms": "Looking at a picture, ms",
    "presence.auroc": "Area under the ROC curve, runway against crops beside it",
    "presence.refused": "Runways taken for none",
    "presence.false_find": "Crops without a runway taken for one",
    "detection.far_threshold_184m": "Would be refused were the runway 184 m shorter than believed",
}
COLUMNS = ("mean", "median", "50", "68", "90", "95", "99", "q90", "q95", "q99")
COLUMN_NAMES = {
    **{level: f"{level} %" for level in ("50", "68", "90", "95", "99")},
    **{f"q{level}": f"{level} % quantile" for level in ("90", "95", "99")},
}
COVERAGE = {
    "coverage": "all corners",
    "near_coverage": "the near corners",
    "far_coverage": "the far corners",
}
CHAPTERS = (
    ("Corners", ("error_px", "near_error_px", "far_error_px", "error_input_px", "sigma_px", "sigma_input_px")),
    ("Coverage: share of errors within the interval of σ", ("coverage", "near_coverage", "far_coverage")),
    ("Likelihood", ("nees", "nll")),
    ("Decisions", ("use", "do_not_use", "not_monitored", "missing", "alarm", "detection.far_threshold_184m")),
    (
        "Position",
        (
            *("along_m", "cross_m", "vertical_m", "distance_relative"),
            *("along_within_2sigma", "cross_within_2sigma", "vertical_within_2sigma"),
        ),
    ),
    (
        "Integrity",
        (*("over_level", "along_over_level", "cross_over_level", "vertical_over_level", "available", "hazardous"),),
    ),
    ("Protection levels", ("level.along_m", "level.cross_m", "level.vertical_m")),
    ("In scope or not", ("presence.auroc", "presence.refused", "presence.false_find")),
    ("Time", ("latency_ms",)),
)


def _split(name: str) -> tuple[str, str]:
    """("error_px", "median") of "error_px.median"; what is not of such a family stands alone."""
    stem, _, column = name.rpartition(".")
    return (stem, column) if stem and column in COLUMNS else (name, "")


def _label(name: str) -> str:
    """A figure in words, without its unit, which goes with the value."""
    stem, column = _split(name)
    if stem in COVERAGE:
        return f"Errors of {COVERAGE[stem]} within their {column} % interval"
    label = re.sub(", (px|m|ms)$", "", STEMS.get(stem, stem))
    return _text(label) + (f", {COLUMN_NAMES.get(column, column)}" if column else "")


def _nominal(name: str) -> float | None:
    """What a figure ought to be, where theory says so."""
    stem, column = _split(name)
    if stem.endswith("coverage") and column.isdigit():
        return int(column) / 100
    if name.endswith("_within_2sigma"):
        return 0.9545  # 2 Φ(2) − 1
    return 1.0 if name == "nees" else None


def _gap(metric: Metric, reference: float | None) -> float:
    """How far the whole interval lies above the reference, or below it (negative); 0 where it does neither."""
    low, high = metric.get("low"), metric.get("high")
    if reference is None or low is None or high is None:
        return 0.0
    return float(max(low - reference, 0.0) + min(high - reference, 0.0))


def _tone(name: str, gap: float, judged: bool) -> str:
    """Of a figure beyond its reference: bad, warn (σ larger than need be) or good."""
    if gap == 0:
        return ""
    if judged:  # against theory
        too_sure = gap > 0 if name == "nees" else gap < 0
        return "bad" if too_sure else "warn"
    better_high = name in (USE, "available") or name.startswith("detection.")
    return "good" if (gap > 0) == better_high else "bad"


def _items(items: Iterable[str], kind: str = "") -> str:
    return f"<ul{kind}>" + "".join(item if item.startswith("<li") else f"<li>{item}</li>" for item in items) + "</ul>"


def _table(head: Sequence[str], lines: Iterable[str], kind: str = "", name: str = "") -> str:
    """A table that scrolls by itself where the page is narrow; cells of `lines` are HTML."""
    heads = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{name or "Table"}"><table{kind}>'
        f"<thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def _facts(pairs: Iterable[tuple[str, str]]) -> str:
    return '<dl class="facts">' + "".join(f"<dt>{name}</dt><dd>{value}</dd>" for name, value in pairs) + "</dl>"


# --- sections


def _subject(evidence: dict[str, Any]) -> str:
    subject, data = evidence.get("subject") or {}, evidence.get("data") or {}
    kind = "predictions made elsewhere" if subject.get("kind") == "predictions" else "the model"
    airports = len(data.get("airports") or {})
    words = [
        f"Tested: {kind} <b>{_text(subject.get('name'))}</b> (σ: {_text(subject.get('sigma'))})",
        f"on <b>{_text(data.get('name'))}</b> ({_count(data.get('pictures'), 'picture')},",
        f"{_count(data.get('labels'), 'labelled runway')}"
        + (f", {_count(airports, 'airport')})." if airports else ")."),
    ]
    return " ".join(words)


def _count(number: int | None, noun: str) -> str:
    return f"{noun}s: –" if number is None else f"{number:,} {noun}{'' if number == 1 else 's'}"


def _sections(
    evidence: dict[str, Any],
    total: int,
    plots: dict[str, str],
    examples: Sequence[ExamplePicture],
    notes: Sequence[str],
) -> list[tuple[str, str, str]]:
    """(id, name in the contents, HTML) of each section that has something to say."""
    sections = [
        ("verdict", "Verdict", "Verdict", _verdict(evidence, notes)),
        ("requirements", "Requirements", "Requirements", _requirements(evidence)),
        ("figures", "Key figures", "Key figures", _figures(evidence)),
        ("groups", "Groups", "Groups: where it is good, where not", _groups(evidence)),
        ("plots", "Plots", "Plots", _plots(plots)),
        ("integrity", "Integrity", "Integrity: error against protection level", _integrity(evidence, total, plots)),
        ("examples", "Examples", "Examples", _examples(examples)),
        ("rows", "Rows", "Rows", _explorer(total)),
        ("problems", "Problems", "Problems of the input", _problems(evidence)),
        ("settings", "Settings", "Settings and hashes", _settings(evidence)),
    ]
    return [
        (ident, name, content if ident == "verdict" else f'<h2 id="{ident}-title">{title}</h2>{content}')
        for ident, name, title, content in sections
        if content
    ]


RESULTS = {"failed": ("bad", "failed"), "not shown": ("warn", "not shown"), "shown": ("good", "shown")}


def _verdict(evidence: dict[str, Any], notes: Sequence[str]) -> str:
    requirements = evidence.get("requirements") or []
    failed = [one for one in requirements if one.get("result") == "failed"]
    unshown = [one for one in requirements if one.get("result") not in ("failed", "shown")]
    count = len(requirements)
    of = f"of {count} requirement{'' if count == 1 else 's'}"
    also = f", {len(unshown)} could not be shown" if unshown else ""
    if not requirements:
        tone, sentence = "none", "No requirements were given: these are figures, not a verdict."
    elif failed:
        tone, sentence = "bad", f"{len(failed)} {of} failed{also}."
    elif unshown:
        tone, sentence = "warn", f"None {of} failed, but {len(unshown)} could not be shown."
    else:
        tone, sentence = "good", f"All {count} requirements are shown." if count > 1 else "The requirement is shown."
    parts = [
        f'<div class="verdict tone-{tone}"><h2 id="verdict-title">{sentence}</h2>{_tally(evidence)}</div>',
        _items((_finding(one) for one in [*failed, *unshown]), ' class="findings"') if failed or unshown else "",
    ]
    outliers = _outliers(evidence)
    if outliers:
        parts.append("<h3>Where σ does not hold</h3>" + _items(outliers, ' class="findings"'))
    told = [*(evidence.get("notes") or []), *notes]
    if told:
        parts.append("<h3>To know before reading on</h3>" + _items((_text(note) for note in told), ' class="notes"'))
    return "".join(parts)


def _finding(one: dict[str, Any]) -> str:
    tone, result = RESULTS.get(one.get("result", ""), ("warn", "not shown"))
    where = f" ({_text(one['where'])})" if one.get("where") not in ("", "all", None) else ""
    said = f'<b class="{tone}">{_text(one.get("id"))} {result}.</b> {_text(one.get("text"))}{where}'
    return f'<li class="tone-{tone}">{said} <span class="soft">{_text(one.get("why"))}</span></li>'


def _tally(evidence: dict[str, Any]) -> str:
    counts = evidence.get("counts") or {}
    decisions = counts.get("decisions") or {}
    labels = counts.get("labels") or sum(decisions.values())
    if not labels:
        return "<p>No labelled runway was evaluated.</p>"
    known = [(name, decisions.get(name) or 0) for name in DECISIONS]
    words = dict(zip(DECISIONS, ("accepted", "refused", "not monitored", "missing"), strict=True))
    stack = "".join(f'<span class="{name}" style="flex-grow:{n}"></span>' for name, n in known if n)
    tally = _items(
        [
            f"<b>{labels:,}</b> labelled",
            *(
                f'<span class="swatch {name}"></span><b>{n:,}</b> {words[name]} ({_number(n / labels, True)})'
                for name, n in known
            ),
            *([f"<b>{counts['unmatched']:,}</b> predictions of no label"] if counts.get("unmatched") else []),
            *(
                [f'<a href="#problems"><b>{sum(counts["problems"].values()):,}</b> problems of the input</a>']
                if counts.get("problems")
                else []
            ),
        ],
        ' class="tally"',
    )
    return f'<div class="stack" aria-hidden="true">{stack}</div>{tally}'


def _outliers(evidence: dict[str, Any]) -> list[str]:
    """Where coverage is farthest from nominal, in words: all rows first, then the groups, each once."""
    found: dict[tuple[str, str], tuple[float, Metric]] = {}
    for metric in evidence.get("metrics") or []:
        stem, column = _split(metric["name"])
        if stem in COVERAGE and column == "90":
            where, gap = (metric["by"], metric["group"]), _gap(metric, 0.9)
            if abs(gap) > max(STANDS_OUT, abs(found[where][0]) if where in found else 0.0):
                found[where] = gap, metric
    ranked = sorted(found.items(), key=lambda one: (one[0][0] != "all", -abs(one[1][0])))
    said = [
        f'<li class="tone-{"bad" if gap < 0 else "warn"}"><b>{"All rows" if by == "all" else _text(f"{by} {group}")}:'
        "</b> "
        f"{_value(metric)} of the errors of {COVERAGE[_split(metric['name'])[0]]} lie within their 90 % interval "
        f'<span class="soft">({_interval(metric)}); σ is too {"small" if gap < 0 else "large"}.</span></li>'
        for (by, group), (gap, metric) in ranked[:NAMED]
    ]
    if len(ranked) > NAMED:
        said.append(f'<li class="tone-warn">{len(ranked) - NAMED} more: see <a href="#groups">Groups</a>.</li>')
    return said


def _requirements(evidence: dict[str, Any]) -> str:
    requirements = evidence.get("requirements")
    if not requirements:
        return "<p>No requirements were given.</p>"
    order = list(RESULTS)
    lines = []
    for one in sorted(requirements, key=lambda one: order.index(one["result"]) if one["result"] in order else 1):
        tone, result = RESULTS.get(one["result"], ("warn", "not shown"))
        lines.append(
            f'<td><span class="badge tone-{tone}">{result}</span></td><th scope="row">{_text(one.get("id"))}</th>'
            f'<td class="text">{_text(one.get("text"))}</td><td><code>{_text(one.get("metric"))}</code>'
            f"<small>{_text(one.get('where') or 'all rows')}</small></td><td>{_text(one.get('bound'))}{_unit(one)}</td>"
            f'<td class="num">{_value(one)}{_unit(one)}<small>{_interval(one)}</small></td>'
            f'<td class="num">{_number_of(one)}</td><td class="text">{_text(one.get("why"))}</td>'
        )
    head = ("Result", "Id", "Requirement", "Figure and where", "Bound", "Value, 95 % interval", "Of", "Why")
    return (
        "<p>Failed: the figure breaks the bound. Shown: the figure keeps it, and so does its whole 95 % interval, "
        "unless the requirement asks for the figure alone. Not shown: anything else; it is no pass.</p>"
        + _table(head, lines, name="Requirements")
    )


def _number_of(metric: Metric) -> str:
    return "–" if metric.get("count") is None else f"{metric['count']:,}"


def _figures(evidence: dict[str, Any]) -> str:
    metrics = {one["name"]: one for one in evidence.get("metrics") or [] if one["by"] == "all"}
    compare = evidence.get("compare") or {}
    other = {one["name"]: one for one in compare.get("metrics") or []}
    if not metrics:
        return "<p>No figure could be computed.</p>"
    tiles = ("error_px.median", "coverage.90", "nees", "use", "along_m.q95", "over_level", "latency_ms.q95")
    parts = [
        _items(
            (
                f"<b>{_value(metrics[name])}{_unit(metrics[name])}</b>{_label(name)}<br>"
                f'<span class="soft">{_interval(metrics[name])}, of {_number_of(metrics[name])}</span>'
                for name in tiles
                if name in metrics
            ),
            ' class="tiles"',
        )
    ]
    if compare:
        parts.append(f"<p>In each cell, below the line: <b>{_text(compare.get('name'))}</b>, to compare.</p>")
    placed = {stem for _, stems in CHAPTERS for stem in stems}
    rest = tuple(dict.fromkeys(stem for stem, _ in map(_split, metrics) if stem not in placed))
    chapters = (_chapter(title, stems, metrics, other) for title, stems in (*CHAPTERS, ("Other", rest)))
    parts.append(f'<div class="chapters">{"".join(chapters)}</div>')
    parts.append(
        '<p class="soft">In brackets: the 95 % interval, which counts the coordinates of one row as alike.</p>'
    )
    return "".join(parts)


def _chapter(title: str, stems: Sequence[str], metrics: Mapping[str, Metric], other: Mapping[str, Metric]) -> str:
    """One subject's figures: families as a matrix of quantiles, single figures as one column."""
    named = [name for name in metrics if _split(name)[0] in stems]
    if not named:
        return ""
    columns = [column for column in ("", *COLUMNS) if any(_split(name)[1] == column for name in named)]
    lines = []
    for stem in stems:
        family = {_split(name)[1]: metrics[name] for name in named if _split(name)[0] == stem}
        if family:
            of = _number_of(next(iter(family.values())))
            cells = "".join(_cell(family.get(column), other) for column in columns)
            lines.append(f'<th scope="row">{_text(STEMS.get(stem, stem))}</th>{cells}<td class="num">{of}</td>')
    head = ["", *(COLUMN_NAMES.get(column, column) or "Value" for column in columns), "Of"]
    return f"<div><h3>{title}</h3>{_table(head, lines, name=title)}</div>"


def _cell(metric: Metric | None, other: Mapping[str, Metric]) -> str:
    if metric is None:
        return "<td></td>"
    gap = _gap(metric, _nominal(metric["name"]))
    tone = _tone(metric["name"], gap, True)
    was = other.get(metric["name"])
    compared = f"<small>{_value(was)} ({_interval(was)})</small>" if was else ""
    return (
        f'<td class="num{f" flag-{tone}" if tone else ""}">{_value(metric)}{_arrow(gap)}'
        f"<small>({_interval(metric)})</small>{compared}</td>"
    )


def _arrow(gap: float) -> str:
    return " ▲" if gap > 0 else " ▼" if gap < 0 else ""


GROUPINGS = (("distance", "Distance"), ("airport", "Airport"), ("glide", "Glide angle"), ("light", "Light"))
GROUP_COLUMNS = (
    ("coverage.90", "In the 90 % interval"),
    ("far_coverage.90", "… far corners"),
    ("error_px.median", "Median error, px"),
    ("far_error_px.median", "… far corners, px"),
    ("use", "Accepted"),
    ("along_m.median", "Along-track, median m"),
    ("over_level", "Error over level"),
)


def _groups(evidence: dict[str, Any]) -> str:
    metrics = evidence.get("metrics") or []
    overall = {one["name"]: one.get("value") for one in metrics if one["by"] == "all"}
    parts = []
    for by, title in GROUPINGS:
        groups: dict[str, dict[str, Metric]] = {}
        for one in metrics:
            if one["by"] == by:
                groups.setdefault(one["group"], {})[one["name"]] = one
        if groups:
            parts.append(f"<h3>By {title.lower()}</h3>" + _grouped(by, title, groups, overall))
    if not parts:
        return ""
    return (
        "<p>Dot: the value. Bar: its 95 % interval. Tick: what it ought to be (coverage) or the value over all rows. "
        "Coloured, with ▲ or ▼: the whole interval lies above or below the tick, the deeper the farther. "
        '<b class="bad">Red</b>: σ too small, or worse than over all. <b class="warn">Amber</b>: σ larger than it need '
        'be. <b class="good">Green</b>: better than over all. By chance alone one in twenty is coloured. Errors in '
        "pixels and metres differ with distance by nature; coverage ought not to.</p>" + "".join(parts)
    )


def _grouped(by: str, title: str, groups: dict[str, dict[str, Metric]], overall: Mapping[str, float | None]) -> str:
    columns = [(name, words) for name, words in GROUP_COLUMNS if any(name in group for group in groups.values())]
    names = list(groups)
    note = ""
    if len(names) > MAX_GROUPS:  # those of which most is known
        names.sort(key=lambda name: -max(one.get("count") or 0 for one in groups[name].values()))
        note = f'<p class="soft">The {MAX_GROUPS} largest of {len(names):,} groups; all are in evaluation.json.</p>'
        names = sorted(names[:MAX_GROUPS])
    tops = {}
    for name, _ in columns:
        ends = [one.get("value") or 0 for group in groups.values() if (one := group.get(name))]
        tops[name] = (
            1.0
            if name.startswith(("coverage", "far_coverage", "use"))
            else 1.15 * max(*ends, overall.get(name) or 0, 1e-9)
        )
    lines = []
    for group in names:
        cells = "".join(_bar_cell(groups[group].get(name), name, overall.get(name), tops[name]) for name, _ in columns)
        rows = groups[group].get("use") or {"count": None}
        shown = _text(group)
        if by in ("airport", "light") and group:
            shown = f'<a href="#{by}-{quote(str(group), safe="", errors="replace")}">{shown}</a>'
        lines.append(f'<th scope="row">{shown}</th><td class="num">{_number_of(rows)}</td>{cells}')
    return note + _table(
        [title, "Rows", *(words for _, words in columns)], lines, ' class="groups"', f"By {title.lower()}"
    )


def _bar_cell(metric: Metric | None, name: str, overall: float | None, top: float) -> str:
    if metric is None or metric.get("value") is None:
        return "<td>–</td>"
    nominal = _nominal(name)
    reference = overall if nominal is None else nominal
    gap = _gap(metric, reference)
    tone = _tone(name, gap, nominal is not None)

    def x(value: float) -> str:
        return f"{100 * min(max(value / top, 0), 1):.1f}"

    low, high = metric.get("low"), metric.get("high")
    # The farther off, the deeper the colour.
    depth = 8 + 30 * min(1.0, abs(gap) / (reference or 1.0) / (0.5 if nominal is not None else 1.0))
    span = "" if low is None or high is None else f'<path class="span" d="M{x(low)} 7H{x(high)}"/>'
    tick = "" if reference is None else f'<path class="tick" d="M{x(reference)} 1V13"/>'
    kind = f' class="flag-{tone}" style="--depth:{depth:.0f}%"' if tone else ""
    return (
        f'<td{kind}><span class="num">{_value(metric)}{_arrow(gap)}</span>'
        f'<svg viewBox="0 0 100 14" preserveAspectRatio="none" role="img" aria-label="{_interval(metric)}">'
        f'<title>{_interval(metric)}</title><path class="track" d="M0 7H100"/>{span}{tick}'
        f'<circle class="dot" cx="{x(metric["value"])}" cy="7" r="3"/></svg></td>'
    )


TITLES = {  # in the order of the page: the narrow ones first, two by two
    "calibration": "Calibration",
    "sharpness": "Sharpness",
    "statistic": "Statistic of the integrity test",
    "roc": "Detection against false alarms",
    "latency": "Latency",
    "detection": "Detection of planted faults",
    "bias_by_distance": "Bias of the corners by distance",
    "error_by_group": "Error and coverage by group",
    "error_by_distance": "Position error by distance",
    "rejection_example": "A fault refused",
    "stanford_along": "Along track, all rows",
    "stanford_cross": "Cross track, all rows",
    "stanford_vertical": "Vertical, all rows",
}
ONE_PANEL = ("calibration", "sharpness", "statistic", "roc", "latency")  # the picture itself bears the title


def _plots(plots: Mapping[str, str]) -> str:
    names = sorted(plots, key=lambda name: list(TITLES).index(name) if name in TITLES else len(TITLES))
    shown = "".join(_figure(name, plots[name]) for name in names if not name.startswith("stanford_"))
    return f'<div class="plots">{shown}</div>' if shown else ""


def _figure(name: str, picture: str) -> str:
    title = _text(TITLES.get(name, name.replace("_", " ").capitalize()))
    kind = ' class="small"' if name in ONE_PANEL or name.startswith("stanford_") else ""
    caption = _text(CAPTIONS.get(name, ""))
    return f'<figure{kind}><h3>{title}</h3><div class="plot">{picture}</div><figcaption>{caption}</figcaption></figure>'


REGIONS = (
    ("nominal", "Covered", "error within the level, level within the limit"),
    ("misleading", "Misleading", "error over the level"),
    ("hazardous", "Hazardous", "level within the alert limit, error over it"),
    ("unavailable", "Not available", "level over the limit, error within the level"),
    ("unavailable_misleading", "Not available, misleading", "level over the limit, error over the level"),
    ("not_accepted", "Not accepted", "refused or not monitored"),
)


def _integrity(evidence: dict[str, Any], total: int, plots: Mapping[str, str]) -> str:
    stanford = evidence.get("stanford") or {}
    if not stanford:
        return ""
    axes = [axis for axis in ("along", "cross", "vertical") if stanford.get(axis)]
    lines = []
    for region, title, meaning in REGIONS:
        counts = [stanford[axis].get(region) for axis in axes]
        if any(count is not None for count in counts):
            wrong = "misleading" in region or region == "hazardous"
            cells = "".join(
                f'<td class="num{" flag-bad" if wrong and count else ""}">{"–" if count is None else f"{count:,}"}</td>'
                for count in counts
            )
            lines.append(f'<th scope="row">{title}<small>{meaning}</small></th>{cells}')
    radios = "".join(
        f'<label><input type="radio" name="axis" value="{i}"{" checked" if i == 0 else ""}> {axis}</label>'
        for i, axis in enumerate(("along", "cross", "vertical"))
    )
    static = [name for name in plots if name.startswith("stanford_")]
    drawn = "the rows held in this file" if total > MAX_ROWS else "every row with truth and a level"
    return (
        "<p>A protection level is a promise: the error exceeds it with no more than the integrity risk that was set. "
        "A row below the diagonal breaks it.</p>"
        + _table(["Rows", *axes], lines, name="Counts of the Stanford diagrams")
        + f'<div class="{"screen" if static else ""}"><h3>Stanford diagram</h3>'
        f"<p>Drawn: {drawn}. Point at one to see it, click to open its numbers.</p>"
        "<noscript><p>This diagram needs scripts.</p></noscript>"
        f'<div class="tools"><fieldset><legend>Axis</legend>{radios}</fieldset>'
        '<label><input type="checkbox" id="with-refused"> also rows not accepted (×)</label></div>'
        '<div id="chart"><div id="tip" role="status" hidden></div></div><p class="soft" id="charted"></p></div>'
        + (f'<div class="plots">{"".join(_figure(name, plots[name]) for name in static)}</div>' if static else "")
    )


def _examples(examples: Sequence[ExamplePicture]) -> str:
    if not examples:
        return ""
    return "<p>Truth and prediction with 2σ ellipses. Click one for its numbers.</p>" + _items(
        (
            f'<a href="#row-{example.row}"><img alt="{_text(example.title)}" '
            f'src="data:image/jpeg;base64,{base64.b64encode(example.jpeg).decode()}">'
            f"<span>{_text(example.title)} <small>(row {example.row})</small></span></a>"
            for example in examples
        ),
        ' class="examples"',
    )


def _explorer(total: int) -> str:
    if not total:
        return "<p>There are no rows.</p>"
    some = (
        f" This file holds at most {MAX_ROWS:,} of {total:,} rows: those with an error over a level, the worst by "
        "pixels and by σ, those not accepted, then rows drawn with a fixed seed. It is no fair sample: its shares are "
        "not those of the whole. The table beside this file holds every row."
        if total > MAX_ROWS
        else ""
    )
    return (
        f"<p>One row per labelled runway. Click a row for all its numbers.{some}</p>"
        "<noscript><p>The rows need scripts.</p></noscript>"
        '<div class="tools"><label>Text <input type="search" id="by-text" size="16"></label>'
        '<label>Airport <select id="by-airport"><option value="">all</option></select></label>'
        '<label>Decision <select id="by-decision"><option value="">all</option></select></label>'
        '<button type="button" id="clear">Clear</button></div>'
        '<p class="soft" id="found" role="status"></p>'
        '<div class="scroll" id="table" tabindex="0" role="region" aria-label="Rows"></div>'
        '<div class="tools"><button type="button" id="previous">Previous 50</button>'
        '<button type="button" id="next">Next 50</button></div>'
        '<aside id="detail" aria-label="One row" hidden></aside>'
    )


def _problems(evidence: dict[str, Any]) -> str:
    counts = (evidence.get("counts") or {}).get("problems") or {}
    problems = evidence.get("problems") or []
    if not counts and not problems:
        return "<p>None: every row of the input could be read and matched.</p>"
    total = max(sum(counts.values()), len(problems))
    kinds = ", ".join(f"{_text(kind)}: {count:,}" for kind, count in counts.items())
    lines = (
        f'<th scope="row">{_text(one.get("kind"))}</th><td>{_text(one.get("file"))}</td>'
        f'<td class="num">{_text(one.get("row"))}</td><td>{_text(one.get("field"))}</td>'
        f'<td class="text">{_text(one.get("what"))}</td><td class="text">{_text(one.get("mend"))}</td>'
        f"<td>{_text(one.get('picture'))}</td>"
        for one in problems
    )
    table = _table(("Kind", "File", "Row", "Field", "What", "How to mend it", "Picture"), lines, name="Problems")
    listed = f"The first {len(problems):,} of {total:,}" if total > len(problems) else f"All {total:,}"
    return (
        f"<p>Counted and listed, not dropped in silence. {kinds}.</p>"
        f"<details{' open' if len(problems) <= 20 else ''}><summary>{listed}</summary>{table}</details>"
    )


def _settings(evidence: dict[str, Any]) -> str:
    subject, data = evidence.get("subject") or {}, evidence.get("data") or {}
    settings = evidence.get("settings") or {}
    limits = settings.get("alert_limits_m")

    def digest(value: Any) -> str:
        return f'<span class="hash">{_text(value)}</span>'

    facts = [
        ("Tested", f"{_text(subject.get('name'))} ({_text(subject.get('kind'))})"),
        ("Its SHA-256", digest(subject.get("sha256"))),
        ("σ", _text(subject.get("sigma"))),
        ("Data", f"{_text(data.get('name'))} ({_text(data.get('format'))})"),
        ("Its SHA-256", digest(data.get("sha256"))),
        ("False-alarm rate", _text(settings.get("false_alarm_rate"))),
        ("Integrity risk", _text(settings.get("integrity_risk"))),
        ("Prior of a fault", _text(settings.get("fault_prior"))),
        (
            "Alert limits",
            f"{', '.join(_text(limit) for limit in limits)} m along, cross, vertical" if limits else "none",
        ),
        *((_text(name), _text(value)) for name, value in settings.items() if name not in KNOWN_SETTINGS),
        ("shortfinal", _text(evidence.get("version"))),
        ("Written", _text(evidence.get("created"))),
    ]
    model = subject.get("model")
    told = html.escape(json.dumps(model, indent=1, ensure_ascii=False)[:20_000]) if model else ""
    return _facts(facts) + (
        f"<details><summary>What the model file says of itself</summary><pre>{told}</pre></details>" if told else ""
    )


KNOWN_SETTINGS = ("false_alarm_rate", "integrity_risk", "fault_prior", "alert_limits_m")
