"""A model, or predictions made elsewhere, held against a data set: rows, figures, and all of it as one record."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from shortfinal.calibration import fit_calibration
from shortfinal.data.labelled import Origin
from shortfinal.data.predictions import Prediction, match, read_predictions
from shortfinal.detector import KeypointDetector, ModelInfo
from shortfinal.errors import InputError
from shortfinal.evaluate.faults import MOST_ROWS, PAPER_M, fault_figures
from shortfinal.evaluate.figures import DISTANCE_M, airports_of, metrics_of
from shortfinal.evaluate.intervals import share_figure
from shortfinal.evaluate.judge import NOMINAL, Problems, Rates, Solved, reasons_of
from shortfinal.evaluate.predict import predict
from shortfinal.evaluate.rows import AXES, DO_NOT_USE, MISSING, NOT_MONITORED, USE, Rows
from shortfinal.evaluate.truth import Known, Truth, read_truth
from shortfinal.files import make_folder, sha256_of
from shortfinal.geometry import Camera
from shortfinal.protection import AlertLimits

Array = NDArray[np.float64]
Seen = Callable[[str, int, int], None]  # what is being done, how much is done, of how much

NIGHT, DIM = 45.0, 90.0  # mean level of what was looked at, of 255, below which it is night, or dim
MOST_PROBLEMS = 500  # kept in the record; all are counted
_SHARES = np.linspace(0.02, 0.98, 49)  # nominal shares of the calibration curve
_SIGMA_EDGES_PX = np.logspace(-2, 2.5, 91)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What came of it: one row for each labelled runway, and the record of all figures (docs/evaluation.md)."""

    rows: Rows
    evidence: dict[str, Any]
    truth: Truth


@dataclass(frozen=True)
class Subject:
    """What is evaluated: a model file (.onnx), or a file of predictions."""

    path: Path

    @property
    def kind(self) -> Literal["model", "predictions"]:
        """Told by the file's ending."""
        return "model" if self.path.suffix.lower() == ".onnx" else "predictions"


def evaluate(
    subject: Subject,
    data: str | Path,
    out: str | Path,
    *,
    runways: str | Path | None = None,
    camera: Camera | None = None,
    corners: Sequence[str] = (),
    origin: Origin = "corner",
    rates: Rates = NOMINAL,
    limits: AlertLimits | None = None,
    seed: int = 0,
    progress: Seen = lambda what, done, total: None,
) -> Evaluation:
    """Look, match, solve, doubt and count.

    `data`, `runways`, `camera`, `corners`, `origin` as in `read_truth`; `limits`: alert limits along, across
    and in height; `seed`: of the faults planted. A model's predictions are kept in `out`, where an
    interrupted run goes on. Raises InputError for a model, data set or file of predictions of no use.
    """
    truth = read_truth(
        data, runways=runways, camera=camera, corners=corners, origin=origin,
        progress=lambda done, total: progress("reading labels", done, total),
    )  # fmt: skip
    targets = [known.target for known in truth.known]
    digest, data_digest = sha256_of([subject.path]), sha256_of(label_files(truth))
    info = None
    if subject.kind == "model":
        detector = KeypointDetector(subject.path)
        info = detector.info
        made_of = {"model": digest, "labels": data_digest}
        read = predict(
            detector, targets, make_folder(out), made_of, lambda done, total: progress("looking", done, total)
        )
    else:
        read = read_predictions(subject.path, origin)
    progress("judging", 0, 1)
    matched, strangers = match(targets, read.found)
    filled, sigma = _with_sigma(truth.known, matched, info)
    rows, problems, solved = _judged(truth.known, filled, rates)
    evidence = _evidence(truth, rows, problems, solved, rates, limits, seed)
    evidence["subject"] = {
        "kind": subject.kind, "name": subject.path.name, "sha256": digest, "sigma": sigma, "model": _plain(info),
    }  # fmt: skip
    evidence["data"]["sha256"] = data_digest
    refused = (*truth.problems, *read.refused, *strangers)
    evidence["problems"] = [asdict(problem) for problem in refused[:MOST_PROBLEMS]]
    evidence["counts"] |= {
        "predictions": len(read.found) + len(read.refused), "unmatched": len(strangers),
        "problems": dict(Counter(problem.kind for problem in refused)),
    }  # fmt: skip
    if sigma == FITTED:
        evidence["notes"].append(
            "The predictions have no sigma. One for each coordinate was fitted to their errors here: coverage is right "
            "by construction, and the sigma of new pictures is not shown to be."
        )
    evidence["title"] = f"{subject.path.name} on {truth.data.source and Path(truth.data.source).resolve().name}"
    progress("judging", 1, 1)
    return Evaluation(rows, _finite(evidence), truth)


FITTED = "fitted here, not predicted"


def label_files(truth: Truth) -> list[Path]:
    """The files that the labels stand in."""
    return [Path(name) for name in sorted({known.target.label.file for known in truth.known})]


def _plain(info: ModelInfo | None) -> dict[str, Any] | None:
    return None if info is None else dict(json.loads(info.to_json()))


# Sigma.


def _with_sigma(
    known: Sequence[Known], matched: Sequence[Prediction | None], info: ModelInfo | None
) -> tuple[list[Prediction | None], str]:
    """The predictions with a covariance each, and where it is from; one without, among others with, is none."""
    if info is not None:
        calibrated = info.calibration and f"calibrated on {info.calibration.fitted_on}"
        return list(matched), calibrated or "the network's own"
    means = [p for p in matched if p is not None and p.mean_px is not None]
    if not means or any(p.cov_px is not None for p in means):
        # Of some only: what has no sigma says nothing that could be doubted.
        mended = [
            replace(p, mean_px=None, obstacle="it has no sigma, unlike others")
            if p is not None and p.mean_px is not None and p.cov_px is None
            else p
            for p in matched
        ]
        return mended, "given"
    errors = np.array([
        (p.mean_px - k.target.truth_px).ravel()
        for p, k in zip(matched, known, strict=True)
        if p is not None and p.mean_px is not None
    ])  # fmt: skip
    try:
        scale = fit_calibration(errors, np.ones_like(errors), "").sigma_scale
    except InputError as error:
        raise InputError(f"the predictions have no sigma, and too few labels to fit one: {error}") from error
    cov = np.diag(np.square(scale))
    return [replace(p, cov_px=cov) if p is not None and p.mean_px is not None else p for p in matched], FITTED


# Rows.


def _judged(
    known: Sequence[Known], predictions: Sequence[Prediction | None], rates: Rates
) -> tuple[Rows, Problems, Solved]:
    n = len(known)
    truth_px = np.array([k.target.truth_px for k in known])
    mean, cov = np.full((n, 4, 2), np.nan), np.full((n, 8, 8), np.nan)
    points, position = np.full((n, 4, 3), np.nan), np.full((n, 3), np.nan)
    for i, (k, p) in enumerate(zip(known, predictions, strict=True)):
        if p is not None and p.mean_px is not None and p.cov_px is not None:
            mean[i], cov[i] = p.mean_px, p.cov_px
        if k.runway is not None:
            points[i] = k.runway.corners
        if k.pose is not None:
            position[i] = k.pose.position_m
    obstacle = np.array([p.obstacle if p is not None else "nothing was predicted" for p in predictions], object)
    missing = np.array([p is None for p in predictions])
    problems = Problems.of(mean, cov, np.where((obstacle == "")[:, None, None], points, np.nan),
                           [k.camera for k in known])  # fmt: skip
    solved = problems.solve(rates, levels=True)
    short = problems.solve(rates, ahead_m=np.full(n, PAPER_M))
    decision = np.full(n, NOT_MONITORED, object)
    decision[solved.monitored] = np.where(solved.usable[solved.monitored], USE, DO_NOT_USE)
    decision[missing] = MISSING
    reason = reasons_of(solved, rates)
    reason = np.where(obstacle != "", obstacle, reason)
    far, glide, lateral = _geometry(position, known)
    rows = Rows(
        picture=_texts(k.target.picture.name for k in known), source=_texts(k.target.source for k in known),
        ident=_texts(k.target.label.ident for k in known), airport=_texts(k.target.label.airport for k in known),
        light=_texts(_light(p) for p in predictions), truth_px=truth_px, mean_px=mean, cov_px=cov,
        enlarged=_numbers(predictions, "enlarged"), distance_m=far, glide_deg=glide, lateral_deg=lateral,
        decision=decision, reason=reason, present=_numbers(predictions, "score"),
        absent=_numbers(predictions, "absent"), statistic=solved.statistic,
        dof=np.full(n, solved.dof), p_value=solved.p_value, error_m=solved.position_m - position,
        sigma_m=solved.sigma_m, level_m=solved.level_m,
        caught_184m=np.where(solved.monitored, ~short.usable, np.nan), latency_ms=_numbers(predictions, "latency_ms"),
    )  # fmt: skip
    return rows, problems, solved


def _texts(values: Iterable[str]) -> NDArray[np.object_]:
    return np.array(list(values), object)


def _numbers(predictions: Sequence[Prediction | None], name: str) -> Array:
    return np.array([math.nan if p is None else getattr(p, name) for p in predictions])


def _light(prediction: Prediction | None) -> str:
    if prediction is None or math.isnan(prediction.grey):
        return ""
    return "night" if prediction.grey < NIGHT else "dim" if prediction.grey < DIM else "bright"


def _geometry(position: Array, known: Sequence[Known]) -> tuple[Array, Array, Array]:
    """Distance, glide angle and lateral angle (N,) of true positions (N, 3); else the recorded distance."""
    x, y, z = position.T
    recorded = [k.target.label.recorded for k in known]
    distance = np.array([math.nan if r is None or r.distance_m is None else r.distance_m for r in recorded])
    far = np.where(np.isnan(x), distance, np.linalg.norm(position, axis=1))
    return far, np.degrees(np.arctan2(z, np.hypot(x, y))), np.degrees(np.arctan2(y, -x))


# The record.


def _evidence(
    truth: Truth, rows: Rows, problems: Problems, solved: Solved, rates: Rates, limits: AlertLimits | None, seed: int
) -> dict[str, Any]:
    planted = np.sort(np.random.default_rng(seed).permutation(len(rows))[:MOST_ROWS])
    return {
        "format": 1,
        "title": "",
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "version": version("shortfinal"),
        "subject": {},
        "data": {
            "name": Path(truth.data.source).resolve().name, "format": truth.data.format,
            "pictures": len(truth.data.pictures), "labels": len(rows),
            "airports": airports_of(rows),
        },
        "settings": {
            **asdict(rates), "seed": seed,
            "alert_limits_m": limits and [limits.along_m, limits.cross_m, limits.vertical_m],
        },
        "counts": {
            "labels": len(rows), "predicted": int(rows.predicted.sum()),
            "missing": int((rows.decision == MISSING).sum()),
            "decisions": {str(k): int(v) for k, v in Counter(rows.decision.tolist()).items()},
        },
        "problems": [],
        "notes": list(truth.notes),
        "metrics": metrics_of(rows, limits),
        "calibration": _calibration(rows),
        "sharpness": _sharpness(rows),
        **_planted(problems, solved, rows, planted, rates, seed),
        "navigation": _navigation(rows),
        "stanford": _stanford(rows, limits),
        "requirements": None,
        "compare": None,
    }  # fmt: skip


def _planted(
    problems: Problems, solved: Solved, rows: Rows, which: NDArray[np.int64], rates: Rates, seed: int
) -> dict[str, Any]:
    some = problems.select(which)
    position = solved.position_m[which] - rows.error_m[which]  # the true one
    return fault_figures(some, solved.select(which), position, rates, seed)


def _calibration(rows: Rows) -> dict[str, list[float]] | None:
    """Share of the coordinates within the central interval of each nominal share."""
    score = np.abs(rows.error_px) / rows.sigma_px
    observed = [share_figure(np.where(np.isnan(score), np.nan, score <= ndtri((1 + s) / 2))) for s in _SHARES]
    if observed[0] is None:
        return None
    found = [figure for figure in observed if figure is not None]
    return {
        "nominal": _SHARES.tolist(), "observed": [f.value for f in found], "low": [f.low for f in found],
        "high": [f.high for f in found],
    }  # fmt: skip


def _sharpness(rows: Rows) -> dict[str, list[Any]] | None:
    sigma = rows.sigma_px
    if not np.isfinite(sigma).any():
        return None

    def counted(part: Array) -> list[int]:
        known = part[np.isfinite(part)].clip(_SIGMA_EDGES_PX[0], _SIGMA_EDGES_PX[-1])
        return [int(count) for count in np.histogram(known, _SIGMA_EDGES_PX)[0]]

    return {
        "edges": _SIGMA_EDGES_PX.tolist(), "counts": counted(sigma), "near": counted(sigma[:, :2]),
        "far": counted(sigma[:, 2:]),
    }  # fmt: skip


def _navigation(rows: Rows) -> dict[str, Any] | None:
    """Error, its sigma and the protection level per axis, by distance."""
    known = np.isfinite(rows.error_m).all(axis=1)
    if not known.any():
        return None
    cell = np.digitize(rows.distance_m, DISTANCE_M) - 1
    axes: dict[str, Any] = {}
    for axis, name in enumerate(AXES):
        columns: dict[str, list[Any]] = {"count": [], "rms_m": [], "sigma_rms_m": [], "q95_m": [], "level_median_m": []}
        for k in range(len(DISTANCE_M) - 1):
            here = known & (cell == k)
            error, sigma, level = (values[here, axis] for values in (rows.error_m, rows.sigma_m, rows.level_m))
            some = len(error) > 0
            columns["count"].append(len(error))
            columns["rms_m"].append(math.sqrt((error**2).mean()) if some else None)
            columns["sigma_rms_m"].append(math.sqrt((sigma**2).mean()) if some else None)
            columns["q95_m"].append(float(np.quantile(np.abs(error), 0.95)) if some else None)
            level = level[~np.isnan(level)]
            columns["level_median_m"].append(float(np.median(level)) if len(level) else None)
        axes[name] = columns
    return {"edges_m": list(DISTANCE_M), "axes": axes}


def _stanford(rows: Rows, limits: AlertLimits | None) -> dict[str, dict[str, int]] | None:
    """Rows with a true position and a level, by region of the Stanford diagram (Tossaint et al. 2007), per axis."""
    known = np.asarray(np.isfinite(rows.error_m).all(axis=1) & ~np.isnan(rows.level_m).any(axis=1))
    if not known.any():
        return None
    bounds = (math.inf,) * 3 if limits is None else (limits.along_m, limits.cross_m, limits.vertical_m)
    some = rows.select(known)
    regions = {}
    for axis, (name, bound) in enumerate(zip(AXES, bounds, strict=True)):
        error, level = np.abs(some.error_m[:, axis]), some.level_m[:, axis]
        inside, held = level <= bound, error <= level
        counted = {
            "nominal": inside & held, "misleading": inside & ~held & (error <= bound),
            "hazardous": inside & ~held & (error > bound), "unavailable": ~inside & held,
            "unavailable_misleading": ~inside & ~held,
        }  # fmt: skip
        regions[name] = {region: int((flags & some.accepted).sum()) for region, flags in counted.items()}
        regions[name]["not_accepted"] = int((~some.accepted).sum())
    return regions


def _finite(value: Any) -> Any:
    """For JSON, which knows neither NaN nor infinity: null instead."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value
