"""The audit of a label file: which labels contradict the runway, and what could not be seen.

Four labelled corners fix the pose and leave two degrees of freedom; RAIM asks of each row whether
what is left over fits the labels' rounding. Two checks need no χ²: do the corners stand in the
order their columns promise, and does the solved distance agree with the recorded one? "Could not
check" is a result of its own and never looks like "passed".
"""

from __future__ import annotations

import io
import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, chdtri, chndtr, chndtrinc, ndtri

from shortfinal.data.lard import Labels, RunwayLabel, read_labels
from shortfinal.data.table import Refusal
from shortfinal.errors import InputError
from shortfinal.files import csv_text, make_folder, write_whole
from shortfinal.geometry import Camera, project
from shortfinal.integrity import Decision, check_integrity
from shortfinal.keypoints import CORNER_NAMES, GaussianKeypoints
from shortfinal.pose import PoseEstimate, estimate_pose
from shortfinal.runway import Runway, RunwayDatabase, load_database

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from rich.console import RenderableType

Array = NDArray[np.float64]

# One row in a thousand named by chance: about one in LARD's test set, against faults of some per cent.
FALSE_ALARM_RATE = 1e-3
# Beside what sigma and rounding explain: a margin, by choice, for the surveyed runway and the focal length.
# LARD's own labels need none of it.
DISTANCE_ALLOWANCE = 0.002
POWER = 0.99  # the chance of being found by which the blind spots are drawn
SHIFT_PX = 5.0  # a slip of the hand, as the share missed is told for
_DIRECTIONS = 16
_REFUSED_SHOWN = 5  # on the screen; the files list them all


class Finding(Enum):
    """What speaks against a label."""

    UNSOLVABLE = "unsolvable"  # the solver found no physical pose that shows the runway like this
    ORDER = "order"  # the columns' order is broken, or the corners do not go round the runway
    RESIDUAL = "residual"  # χ² rejects: the four corners do not fit the runway from any pose
    DISTANCE = "distance"  # the solved distance and the recorded one differ beyond the tolerance


@dataclass(frozen=True, eq=False)
class AuditedLabel:
    """One row's result. What could not be computed is NaN."""

    label: RunwayLabel
    findings: tuple[Finding, ...]
    checked: bool  # whether the corners could be held against the runway
    note: str  # why it could not be checked, or how the solver failed
    statistic: float = math.nan  # square of the whitened residual
    p_value: float = math.nan
    reprojection_px: float = math.nan  # root mean square over the corners, of their distance
    distance_m: float = math.nan  # solved camera to the middle of the landing threshold
    distance_tolerance_m: float = math.nan
    smallest_found_px: tuple[float, ...] = (math.nan,) * 4  # per corner: a longer shift is found with POWER
    shift_missed: float = math.nan  # chance to miss SHIFT_PX on one corner, any direction

    @property
    def verdict(self) -> str:
        """`contradicts`, `not checked` or `passed`."""
        if self.findings:
            return "contradicts"
        return "passed" if self.checked else "not checked"

    @property
    def distance_error_m(self) -> float:
        """Solved minus recorded; NaN where either is missing."""
        recorded = self.label.distance_m
        return math.nan if recorded is None else self.distance_m - recorded


@dataclass(frozen=True, eq=False)
class AuditReport:
    """The results, worst first, and what they were measured against."""

    source: str
    labels: tuple[AuditedLabel, ...]
    sigma_px: float | None  # given; None: each label's own rounding
    false_alarm_rate: float  # per label
    refused: tuple[Refusal, ...] = ()  # rows of the file that are no labels

    @property
    def contradicting(self) -> tuple[AuditedLabel, ...]:
        """Labels with a finding."""
        return tuple(a for a in self.labels if a.findings)

    @property
    def not_checked(self) -> tuple[AuditedLabel, ...]:
        """Labels that could not be held against their runway."""
        return tuple(a for a in self.labels if not a.checked)

    @property
    def expected_false_alarms(self) -> float:
        """How many good labels χ² names by chance if sigma is right; the distance at most as many again."""
        return self.false_alarm_rate * (len(self.labels) - len(self.not_checked))

    @property
    def counts(self) -> dict[str, int]:
        """How many labels have each finding."""
        found = Counter(f for a in self.labels for f in a.findings)
        return {f.value: found[f] for f in Finding}

    @property
    def sigma_ratio(self) -> float:
        """Residuals of the passed labels over what sigma predicts; about 1 if sigma is right."""
        statistics = [a.statistic for a in self.labels if a.verdict == "passed"]
        # Four corners leave two degrees of freedom.
        return math.sqrt(float(np.mean(statistics)) / 2) if statistics else math.nan

    @property
    def blind_spots(self) -> dict[str, dict[str, float]]:
        """Per end, near and far: median, 90 % and largest of `smallest_found_px`; and the share missed."""
        rows = [a for a in self.labels if a.verdict == "passed"]
        smallest = np.array([a.smallest_found_px for a in rows]).reshape(-1, 4)
        ends = {"near": smallest[:, :2], "far": smallest[:, 2:]}
        return {
            end: dict(zip(("median_px", "p90_px", "max_px"), _quantiles(values), strict=True))
            for end, values in ends.items()
        }

    @property
    def shift_missed(self) -> float:
        """The share of SHIFT_PX slips of one corner, any corner and direction, that would pass here."""
        missed = [a.shift_missed for a in self.labels if a.verdict == "passed"]
        return float(np.mean(missed)) if missed else math.nan


def audit_file(
    labels_csv: str | Path,
    runways_json: str | Path,
    out_dir: str | Path,
    *,
    sigma_px: float | None = None,
    false_alarm_rate: float = FALSE_ALARM_RATE,
    camera: Camera | None = None,
) -> AuditReport:
    """Audit a LARD label file and write `audit.csv`, `audit.json` and `audit.png` into `out_dir`.

    Options as in `audit_labels`. Raises InputError for a file that cannot be read or has no good row.
    """
    labels = read_labels(labels_csv, camera)
    report = audit_labels(
        labels,
        load_database(runways_json),
        sigma_px=sigma_px,
        false_alarm_rate=false_alarm_rate,
        source=str(labels_csv),
    )
    write_report(report, out_dir)
    return report


def audit_labels(
    labels: Sequence[RunwayLabel],
    database: RunwayDatabase,
    *,
    sigma_px: float | None = None,
    false_alarm_rate: float = FALSE_ALARM_RATE,
    camera: Camera | None = None,
    source: str = "labels",
) -> AuditReport:
    """Hold each label against its runway in a loaded database (`load_database`).

    `sigma_px` is the standard deviation of a labelled coordinate (default: what rounding gives),
    `false_alarm_rate` the chance per label of naming a good one, `camera` the one for all labels
    (default: each label's own). The rows that `read_labels` refused are listed in the report.
    Raises InputError for a sigma or a rate out of range.
    """
    if sigma_px is not None and not (math.isfinite(sigma_px) and sigma_px > 0):
        raise InputError(f"sigma_px: got {sigma_px}; it must be finite and > 0")
    if not 0 < false_alarm_rate < POWER:
        raise InputError(f"false_alarm_rate: got {false_alarm_rate}; it must lie between 0 and {POWER:g}")
    runways = {ident: look_up(database, ident) for ident in {label.ident for label in labels}}
    audited = [
        audit_label(
            label, runways[label.ident], camera or label.camera, sigma_px or label.rounding_sigma_px, false_alarm_rate
        )
        for label in labels
    ]
    refused = labels.refused if isinstance(labels, Labels) else ()
    return AuditReport(source, tuple(sorted(audited, key=_badness)), sigma_px, false_alarm_rate, refused)


def look_up(database: RunwayDatabase | None, ident: str) -> Runway | str:
    """The runway of that name in a database, or why there is none."""
    if not ident:
        return "the label names no runway"
    if database is None:
        return "no runway database: pass --runways"
    try:
        return database.find(ident)
    except InputError as error:
        return str(error)


def _badness(audited: AuditedLabel) -> tuple[int, float, int]:
    """Sorts worst first: contradictions, then what could not be checked, then by χ²."""
    rank = ("contradicts", "not checked", "passed").index(audited.verdict)
    surprise = math.inf if math.isnan(audited.statistic) else audited.statistic
    return rank, -surprise, audited.label.line


def audit_label(
    label: RunwayLabel, runway: Runway | str, camera: Camera | None, sigma_px: float, rate: float
) -> AuditedLabel:
    """Hold one label against its runway, or say why there is none; arguments as in `audit_labels`."""
    order = () if label.raw_order_ok else (Finding.ORDER,)
    if isinstance(runway, str) or camera is None:
        return AuditedLabel(label, order, False, _why_not(label, runway))
    estimate = estimate_pose(GaussianKeypoints.from_sigma(label.corners_px, sigma_px), runway.corners, camera)
    return _audit_estimate(label, estimate, order, rate)


def _why_not(label: RunwayLabel, runway: Runway | str) -> str:
    """Why a label could not be checked."""
    if not isinstance(runway, str):
        kind = f" of {label.picture.source} pictures" if label.picture.source else ""
        return f"camera unknown{kind}: pass --camera"
    database = label.picture.database
    return f"{runway}; LARD's {database} has the runways of these labels" if label.ident and database else runway


def _audit_estimate(
    label: RunwayLabel, estimate: PoseEstimate, order: tuple[Finding, ...], rate: float
) -> AuditedLabel:
    verdict = check_integrity(estimate, rate)
    if estimate.pose is None or verdict.p_value is None:
        unsolvable = estimate.pose is None
        found = (Finding.UNSOLVABLE, *order) if unsolvable else order
        return AuditedLabel(label, found, unsolvable, "; ".join(verdict.reasons))
    distance, tolerance = _distance(estimate.pose.position_m, np.asarray(estimate.cov), label.distance_step_m, rate)
    rejected = (Finding.RESIDUAL,) if verdict.decision is Decision.DO_NOT_USE else ()
    recorded = distance if label.distance_m is None else label.distance_m
    off = (Finding.DISTANCE,) if abs(distance - recorded) > tolerance else ()
    smallest, missed = _blind_spots(estimate, rate)
    miss = label.corners_px - project(estimate.camera, estimate.pose, estimate.points)
    return AuditedLabel(
        label,
        findings=(*order, *rejected, *off),
        checked=True,
        note="; ".join(verdict.reasons),
        statistic=estimate.chi2,
        p_value=verdict.p_value,
        reprojection_px=float(np.sqrt((miss**2).sum(axis=1).mean())),
        distance_m=distance,
        distance_tolerance_m=tolerance,
        smallest_found_px=smallest,
        shift_missed=missed,
    )


def _distance(position_m: Array, cov: Array, step_m: float, rate: float) -> tuple[float, float]:
    """Solved distance to the threshold's middle, and how far off the recorded one may be, metres.

    The tolerance: the solve's sigma times the normal quantile for `rate`, half a step of the
    recorded distance, and DISTANCE_ALLOWANCE.
    """
    distance = float(np.linalg.norm(position_m))  # the threshold's middle is the origin
    towards = position_m / distance
    sigma = math.sqrt(towards @ cov[:3, :3] @ towards)
    return distance, -float(ndtri(rate / 2)) * sigma + step_m / 2 + DISTANCE_ALLOWANCE * distance


def _blind_spots(estimate: PoseEstimate, rate: float) -> tuple[tuple[float, ...], float]:
    """`smallest_found_px` and `shift_missed` of AuditedLabel, from the geometry alone."""
    basis = np.linalg.qr(estimate.jacobian)[0]
    whitening = estimate.keypoints.whitening
    leftover = whitening - basis @ (basis.T @ whitening)  # a shift in px to the residual it leaves
    threshold, needed = _chi2_limits(estimate.dof, rate)
    angles = np.arange(_DIRECTIONS) * (2 * math.pi / _DIRECTIONS)
    shifts = SHIFT_PX * np.column_stack([np.cos(angles), np.sin(angles)])
    blocks = leftover.reshape(-1, len(CORNER_NAMES), 2).transpose(1, 0, 2)
    # The direction that hides a corner's shift best is the last right singular vector of its block.
    weakest = np.linalg.svd(blocks, compute_uv=False)[:, -1]
    seen = weakest > 1e-10 * np.linalg.norm(whitening, 2)  # else rounding is all that is left
    smallest = np.divide(math.sqrt(needed), weakest, out=np.full(len(CORNER_NAMES), math.inf), where=seen)
    noncentrality = np.sum((blocks @ shifts.T) ** 2, axis=1)
    missed = float(chndtr(threshold, estimate.dof, noncentrality).mean())
    return tuple(float(px) for px in smallest), missed


@cache
def _chi2_limits(dof: int, rate: float) -> tuple[float, float]:
    """The χ² that rejects, and the noncentrality that exceeds it with probability POWER."""
    threshold = float(chdtri(dof, rate))
    return threshold, float(chndtrinc(threshold, dof, 1 - POWER))


def _quantiles(values: Array) -> tuple[float, float, float]:
    """Median, 90 % and largest; NaN of nothing."""
    if values.size == 0:
        return math.nan, math.nan, math.nan
    median, p90, largest = np.percentile(values, [50, 90, 100])
    return float(median), float(p90), float(largest)


# What is written: a table of all rows, the same with the summary as JSON, a picture.


def write_report(report: AuditReport, out_dir: str | Path) -> None:
    """Write `audit.csv`, `audit.json` and `audit.png`, each whole or not at all.

    Raises InputError if the folder cannot be made or written to.
    """
    folder = make_folder(out_dir)
    write_whole(folder / "audit.csv", _table(report))
    write_whole(folder / "audit.json", json.dumps(report_as_dict(report), indent=1, allow_nan=False))
    write_whole(folder / "audit.png", _picture(report))


def report_as_dict(report: AuditReport) -> dict[str, Any]:
    """The report as JSON takes it; a number that is infinite or could not be computed is None."""
    return {
        "source": report.source,
        "sigma_px": report.sigma_px,
        "false_alarm_rate": report.false_alarm_rate,
        "labels": len(report.labels),
        "contradicting": len(report.contradicting),
        "not_checked": len(report.not_checked),
        "refused": len(report.refused),
        "findings": report.counts,
        "expected_false_alarms": report.expected_false_alarms,
        "sigma_ratio": _finite(report.sigma_ratio),
        "found_with_probability": POWER,
        "smallest_found_px": {
            end: {k: _finite(v) for k, v in spots.items()} for end, spots in report.blind_spots.items()
        },
        "shift_px": SHIFT_PX,
        "shift_missed": _finite(report.shift_missed),
        "rows": _rows(report),
    }


def _rows(report: AuditReport) -> list[dict[str, Any]]:
    """The table: the labels, worst first, and behind them the rows that are none."""
    rows = [_row(audited) for audited in report.labels]
    empty = dict.fromkeys(rows[0]) if rows else {}
    return rows + [empty | {"line": r.line, "verdict": "refused", "note": r.message} for r in report.refused]


def _row(audited: AuditedLabel) -> dict[str, Any]:
    """One line of the table."""
    label = audited.label
    corners = dict(zip(CORNER_NAMES, audited.smallest_found_px, strict=True))
    return {
        "line": label.line,
        "image": label.image,
        "runway": label.ident,
        "verdict": audited.verdict,
        "findings": " ".join(f.value for f in audited.findings),
        "p_value": _finite(audited.p_value),
        "statistic": _finite(audited.statistic),
        "reprojection_px": _finite(audited.reprojection_px),
        "distance_m": _finite(audited.distance_m),
        "recorded_m": _finite(label.distance_m),
        "distance_error_m": _finite(audited.distance_error_m),
        "distance_tolerance_m": _finite(audited.distance_tolerance_m),
        **{f"smallest_found_px_{name.replace('-', '_')}": _finite(px) for name, px in corners.items()},
        "shift_missed": _finite(audited.shift_missed),
        "note": audited.note,
    }


def _finite(value: float | None) -> float | None:
    return float(f"{value:.6g}") if value is not None and math.isfinite(value) else None


def _table(report: AuditReport) -> str:
    rows = _rows(report)
    return csv_text(rows[0] if rows else ["line"], rows)


def render_summary(report: AuditReport, worst: int = 10) -> RenderableType:
    """One screen for people: how many labels contradict the runway, the worst, and the blind spots."""
    from rich.console import Group

    parts: list[RenderableType] = [_headline(report)]
    if shown := [a for a in report.labels if a.verdict != "passed"][:worst]:
        parts.append(_worst_table(shown))
    return Group(*parts, _limits(report))


def _headline(report: AuditReport) -> RenderableType:
    from rich.text import Text

    total, bad, unchecked = len(report.labels), len(report.contradicting), len(report.not_checked)
    passed = sum(a.verdict == "passed" for a in report.labels)
    text = Text(
        f"{bad} of {total} labels contradict the runway, {passed} passed, {unchecked} not checked",
        style="bold red" if bad else "bold green" if passed and not (unchecked or report.refused) else "bold yellow",
    )
    by_finding = ", ".join(f"{count} {name}" for name, count in report.counts.items() if count)
    text.append(f" ({by_finding})" if by_finding else "", style="default")
    if unchecked:
        idents = Counter(a.label.ident for a in report.not_checked)
        text.append(f"\n{unchecked} could not be checked: {', '.join(sorted(idents)[:8])}", style="bold yellow")
    if report.refused:
        text.append(f"\n{len(report.refused)} rows are no labels, and were left out:", style="bold yellow")
        for refusal in report.refused[:_REFUSED_SHOWN]:
            text.append(f"\n  {refusal.message}", style="default")
    return text


def _worst_table(shown: Sequence[AuditedLabel]) -> RenderableType:
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False)
    for name in ("line", "image", "runway", "χ²", "solved m", "recorded", "findings"):
        words = name in ("image", "runway", "findings")
        table.add_column(name, justify="left" if words else "right", no_wrap=name != "findings")
    for a in shown:
        findings = " ".join(f.value for f in a.findings) or a.note.partition(";")[0].removeprefix("database: ")
        numbers = (_number(a.statistic, ".3g"), _number(a.distance_m, ".0f"), _number(a.label.distance_m, ".0f"))
        name = Path(a.label.image).name
        name = name if len(name) <= 22 else f"{name[:10]}…{name[-11:]}"
        cells = (str(a.label.line), name, a.label.ident, *numbers, findings)
        table.add_row(*map(Text, cells))  # as Text, for a name may hold what rich takes for markup
    return table


def _number(value: float | None, form: str) -> str:
    return "–" if value is None or not math.isfinite(value) else format(value, form)


def _limits(report: AuditReport) -> RenderableType:
    from rich.text import Text

    if not any(a.verdict == "passed" for a in report.labels):
        return Text("No label passed, so there is nothing to say of what could not be seen.")
    sigmas = sorted({report.sigma_px or a.label.rounding_sigma_px for a in report.labels})
    lines = [
        f"Held against sigma {', '.join(f'{s:.3g}' for s in sigmas)} px, "
        f"with a false-alarm rate of {report.false_alarm_rate:g} a label.",
        f"By chance, χ² names {report.expected_false_alarms:.1f} good labels and the distance at most as many again.",
        f"The residuals of the passed labels are {_number(report.sigma_ratio, '.2f')} times what sigma predicts.",
        f"Not seen: a single corner shifted by less than this is not found with {POWER:.0%} in its worst direction",
    ]
    for end, spots in report.blind_spots.items():
        numbers = (_number(spots[k], ".1f") for k in ("median_px", "p90_px", "max_px"))
        lines.append("  {} corners: median {} px, 90 % {} px, largest {} px".format(end, *numbers))
    missed = _number(100 * report.shift_missed, ".0f")
    lines.append(f"  Of single corners shifted by {SHIFT_PX:g} px, any direction, {missed} % would pass here.")
    lines.append("  An error that moves all four corners as another pose would is not seen by χ² at all.")
    return Text("\n".join(lines))


def _picture(report: AuditReport) -> bytes:
    """Four panels, PNG."""
    # Not pyplot: it keeps a global state, and a display back end that a server has not.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 9), layout="constrained")
    axes = figure.subplots(2, 2)
    for draw, panel in zip((_draw_statistic, _draw_worst, _draw_distance, _draw_blind_spots), axes.flat, strict=True):
        draw(panel, report)
    figure.suptitle(
        f"{len(report.contradicting)} of {len(report.labels)} labels contradict the runway, "
        f"{len(report.not_checked)} could not be checked, {len(report.refused)} rows refused"
    )
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110)
    return content.getvalue()


def _solved(report: AuditReport) -> list[AuditedLabel]:
    return [a for a in report.labels if math.isfinite(a.statistic)]


def _colours(audited: Sequence[AuditedLabel]) -> list[str]:
    # Blue and vermilion: told apart by colour-blind readers too.
    return ["#D55E00" if a.findings else "#0072B2" for a in audited]


def _draw_statistic(axes: Axes, report: AuditReport) -> None:
    """The share of rows above each χ², beside what chance alone gives."""
    statistics = np.sort([a.statistic for a in _solved(report)])[::-1]
    limit = float(chdtri(2, report.false_alarm_rate))
    if statistics.size:
        axes.loglog(
            statistics, np.arange(1, statistics.size + 1) / statistics.size, ".", color="#0072B2", label="labels"
        )
    x = np.geomspace(0.01, 2 * limit, 200)
    axes.loglog(x, chdtrc(2, x), color="0.4", label="χ², 2 degrees of freedom")
    axes.axvline(limit, color="#D55E00", label=f"rejected above {limit:.1f}")
    lowest = 0.3 / max(statistics.size, 1)
    axes.set(xlim=(0.01, None), ylim=(lowest, 1.5), xlabel="residual statistic", ylabel="share of labels above")
    axes.set_title("Do the residuals fit sigma?")
    axes.legend()


def _draw_worst(axes: Axes, report: AuditReport, count: int = 12) -> None:
    worst = sorted(_solved(report), key=lambda a: -a.statistic)[:count]
    axes.barh(range(len(worst)), [a.statistic for a in worst], color=_colours(worst))
    names = [f"line {a.label.line}: {Path(a.label.image).stem:.28}" for a in worst]
    axes.set_yticks(range(len(worst)), names, fontsize=8)
    axes.axvline(float(chdtri(2, report.false_alarm_rate)), color="#D55E00")
    axes.invert_yaxis()
    axes.set(xlabel="residual statistic", xscale="symlog", title="Largest residuals (orange: contradicts)")


def _draw_distance(axes: Axes, report: AuditReport) -> None:
    rows = [a for a in _solved(report) if a.label.distance_m]
    recorded = np.array([a.label.distance_m for a in rows], float)
    error = np.array([a.distance_error_m for a in rows])
    tolerance = np.array([a.distance_tolerance_m for a in rows])
    order = np.argsort(recorded)
    axes.fill_between(recorded[order], -tolerance[order], tolerance[order], color="0.9", label="tolerance")
    axes.scatter(recorded, error, s=6, c=_colours(rows), zorder=2)
    axes.set_yscale("symlog", linthresh=10)
    axes.set(xlabel="recorded distance, m", ylabel="solved − recorded, m", title="Solved and recorded distance")
    axes.legend()


def _draw_blind_spots(axes: Axes, report: AuditReport) -> None:
    """Per label, the shift of a near and of a far corner that is just found, against distance."""
    rows = [a for a in _solved(report) if a.verdict == "passed"]
    distance = [a.distance_m for a in rows]
    for corners, name, colour in ((slice(0, 2), "near", "#0072B2"), (slice(2, 4), "far", "#009E73")):
        hidden = [max(a.smallest_found_px[corners]) for a in rows]
        axes.scatter(distance, hidden, s=6, color=colour, label=f"{name} corners")
    axes.axhline(SHIFT_PX, color="0.4", linestyle="--", label=f"{SHIFT_PX:g} px")
    axes.set(yscale="log", xlabel="distance, m", ylabel="px", title=f"Smallest shift surely found ({POWER:.0%})")
    axes.legend()
