"""Predictions and truth, in; the figures of the field, out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shortfinal.calibration import coverage
from shortfinal.integrity import Decision
from shortfinal.pipeline import FrameResult

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CornerFigures:
    """Corner errors, per coordinate, in pixels of the image; how honest their sigma is."""

    count: int  # coordinates
    median_px: float
    p90_px: float
    mean_px: float
    sigma_median_px: float
    coverage_68: float
    coverage_95: float


@dataclass(frozen=True)
class Evaluation:
    """Figures of a run over labelled frames."""

    frames: int
    decisions: dict[str, int]  # frames by decision
    all: CornerFigures | None
    near: CornerFigures | None
    far: CornerFigures | None
    distance_error: dict[str, float] | None  # |solved - recorded| / recorded: median, p90, of solved frames


_PARTS = {"all": slice(0, 4), "near": slice(0, 2), "far": slice(2, 4)}  # of the keypoint order


def evaluate(
    results: Sequence[FrameResult], truths_px: Sequence[Array | None], distances_m: Sequence[float | None]
) -> Evaluation:
    """Figures of `results` (N) against labelled corners (4, 2) and recorded distances, where there are any."""
    decisions = {d.value: sum(r.verdict.decision is d for r in results) for d in Decision}
    pairs = [
        (r.keypoints, t) for r, t in zip(results, truths_px, strict=True) if r.keypoints is not None and t is not None
    ]
    figures: dict[str, CornerFigures] = {}
    if pairs:
        errors = np.array([k.mean_px - t for k, t in pairs])
        sigmas = np.array([k.sigma_px for k, _ in pairs])
        figures = {name: corner_figures(errors[:, part], sigmas[:, part]) for name, part in _PARTS.items()}
    distance = _distance_error(results, distances_m)
    return Evaluation(len(results), decisions, figures.get("all"), figures.get("near"), figures.get("far"), distance)


def corner_figures(errors: Array, sigmas: Array) -> CornerFigures:
    """Figures of errors (..., 2) with their standard deviations (..., 2), px."""
    size = np.abs(errors)
    return CornerFigures(
        count=size.size,
        median_px=float(np.median(size)),
        p90_px=float(np.quantile(size, 0.9)),
        mean_px=float(size.mean()),
        sigma_median_px=float(np.median(sigmas)),
        coverage_68=float(coverage(errors, sigmas, 0.68)),
        coverage_95=float(coverage(errors, sigmas, 0.95)),
    )


def _distance_error(results: Sequence[FrameResult], distances_m: Sequence[float | None]) -> dict[str, float] | None:
    relative = []
    for result, distance in zip(results, distances_m, strict=True):
        if distance and result.estimate is not None and result.estimate.pose is not None:
            relative.append(abs(np.linalg.norm(result.estimate.pose.position_m) - distance) / distance)
    if not relative:
        return None
    return {"frames": len(relative), "median": float(np.median(relative)), "p90": float(np.quantile(relative, 0.9))}


def rows(evaluation: Evaluation) -> list[tuple[str, Any]]:
    """(corners, figures) for a table: all, near, far."""
    named = (("all", evaluation.all), ("near", evaluation.near), ("far", evaluation.far))
    return [(name, figures) for name, figures in named if figures is not None]
