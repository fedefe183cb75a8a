"""The far threshold 184 m short: how often the residual test sees it, and what it costs when not.

The image shows the far corners 184 m short of where the database has them: the fault of Valentin et
al. 2025. Detection follows the non-central χ² law with λ the statistic of the same frame without
noise; a Monte Carlo through the batch solver checks that. Keypoints come from 224 px crops that
frame the runway, as a network sees them, so σ is in crop pixels.

    python benchmarks/threshold_fault.py [--out docs] [--draws 2000]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, chndtr
from scipy.stats import binom

import shortfinal as sf
from shortfinal.integrity import check_integrity_batch
from shortfinal.pose import PoseEstimateBatch, estimate_pose_batch

Array = NDArray[np.float64]

CAMERA = sf.Camera(2448, 2648, 3401.6, 3401.6, 1223.5, 1323.5)  # LARD's
SHORT_M = 184.0
RATE = 1e-3
CROP_PX = 224
DISTANCES_M = (500.0, 750.0, 1000.0, 1500.0, 2000.0, 3000.0, 4000.0, 6000.0)
LENGTHS_M = (1500.0, 2000.0, 3000.0)
SIGMAS_PX = (0.3, 0.8, 2.0)
POSES = 200  # a point; the noise draws are shared out among them


@dataclass(frozen=True)
class Point:
    """One runway, distance and σ, over random poses. Errors are those of accepted frames."""

    length_m: float
    distance_m: float
    sigma_px: float  # of the crop
    draws: int
    detected: int  # of the draws
    predicted: float  # detection probability
    low: int  # counts that the prediction yields in 99 % of samples
    high: int
    crop_scale: float  # crop pixels per image pixel, mean over the poses
    noise_free_along_m: float  # median error of the solve without noise: the bias of the fault
    noise_free_vertical_m: float
    accepted_along_m: float | None  # root mean square, with noise; None when no frame was accepted
    accepted_vertical_m: float | None

    @property
    def agrees(self) -> bool:
        """Whether the count lies within its 99 % interval."""
        return self.low <= self.detected <= self.high


def crop_scale(px: Array) -> float:
    """Crop pixels per image pixel: halved until the runway fits, never magnified."""
    extent = float(np.ptp(px, axis=0).max())
    return 0.5 ** max(0, int(np.ceil(np.log2(extent / CROP_PX))))


def faulty_frame(rng: np.random.Generator, runway: sf.Runway, distance_m: float) -> tuple[sf.Pose, Array]:
    """A pose that frames the runway, and what the image shows: the far corners short."""
    short = runway.corners - np.outer([0, 0, 1, 1], [SHORT_M, 0, 0])
    lateral, glide = np.radians([rng.uniform(-4, 4), rng.uniform(2.2, 3.8)])
    position = distance_m * np.array([-1.0, np.tan(lateral), np.tan(glide)])
    while True:
        pose = sf.Pose.from_attitude(position, *rng.uniform([-10, -8, -10], [10, 0, 10]))
        px = sf.project(CAMERA, pose, short)
        if (px >= 0).all() and (px <= [CAMERA.width - 1, CAMERA.height - 1]).all():
            return pose, px


def evaluate(length_m: float, distance_m: float, sigma_px: float, draws: int = 2000, seed: int = 0) -> Point:
    """Detection and error for one point of the curve."""
    rng = np.random.default_rng([seed, int(length_m), int(distance_m), int(1000 * sigma_px)])
    runway = sf.Runway(length_m, 45.0)
    frames = [faulty_frame(rng, runway, distance_m) for _ in range(POSES)]
    truth, px = np.array([pose.position_m for pose, _ in frames]), np.array([px for _, px in frames])
    scale = np.array([crop_scale(p) for p in px])
    sigma = sigma_px / scale
    clean = _solve(px, sigma, runway)
    power = 1.0 - chndtr(chdtri(clean.dof, RATE), clean.dof, clean.chi2)
    which = np.arange(draws) % POSES
    noisy = px[which] + sigma[which, None, None] * rng.normal(size=(draws, 4, 2))
    batch = _solve(noisy, sigma[which], runway)
    checked = check_integrity_batch(batch, RATE)
    predicted = float(power[which].mean())
    low, high = binom.interval(0.99, draws, predicted)
    bias = np.abs(clean.positions - truth)
    error = (batch.positions - truth[which])[checked.usable]
    rms = np.sqrt(np.mean(error**2, axis=0)) if len(error) else (None, None, None)
    return Point(
        length_m, distance_m, sigma_px, draws, int(draws - checked.usable.sum()), predicted, int(low), int(high),
        float(scale.mean()), float(np.median(bias[:, 0])), float(np.median(bias[:, 2])),
        *(None if v is None else float(v) for v in (rms[0], rms[2])),
    )  # fmt: skip


def _solve(px: Array, sigma: Array, runway: sf.Runway) -> PoseEstimateBatch:
    return estimate_pose_batch(px, sigma[:, None, None] ** 2 * np.eye(8), runway.corners, CAMERA)


def curve(draws: int) -> list[Point]:
    return [evaluate(length, d, sigma, draws) for length in LENGTHS_M for sigma in SIGMAS_PX for d in DISTANCES_M]


def draw(points: Sequence[Point], path: Path) -> None:
    """Left: detection against distance. Right: the error of the frames that pass."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update({"font.size": 9, "axes.grid": True, "grid.alpha": 0.3})
    figure, axes = plt.subplots(2, len(LENGTHS_M), figsize=(11, 6.4), sharex=True, sharey="row", layout="constrained")
    for column, length in enumerate(LENGTHS_M):
        for sigma, colour in zip(SIGMAS_PX, ("tab:blue", "tab:orange", "tab:green"), strict=True):
            line = [p for p in points if p.length_m == length and p.sigma_px == sigma]
            _draw_detection(axes[0, column], line, colour, f"σ = {sigma} px")
            _draw_error(axes[1, column], line, colour)
        _draw_bias(axes[1, column], [p for p in points if p.length_m == length and p.sigma_px == SIGMAS_PX[0]])
        axes[0, column].set_title(f"{length:,.0f} m runway")
        axes[1, column].set_xlabel("distance to the threshold, km")
    axes[0, 0].set_ylabel("detected, %")
    axes[1, 0].set_ylabel("error of accepted frames, m (RMS)")
    axes[0, -1].legend(title="lines: non-central χ²\ndots: Monte Carlo, 99 %")
    for style, label in (("k-", "along"), ("k--", "vertical")):
        axes[1, 0].plot([], [], style, label=label)
    axes[1, 0].plot([], [], color="0.6", lw=3, label="the fault alone, no noise")
    axes[1, 0].legend(loc="lower right")
    figure.suptitle(f"Far threshold {SHORT_M:.0f} m short, four corners, {CROP_PX} px crops, false-alarm rate {RATE:g}")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def _draw_detection(axis, line, colour, label):  # type: ignore[no-untyped-def]
    x = [p.distance_m / 1000 for p in line]
    rate = np.array([100 * p.detected / p.draws for p in line])
    ends = [binom.interval(0.99, p.draws, min(max(p.detected / p.draws, 1e-9), 1 - 1e-9)) for p in line]
    bars = np.abs(100 * np.array(ends).T / [p.draws for p in line] - rate)
    axis.plot(x, [100 * p.predicted for p in line], color=colour, label=label)
    axis.errorbar(x, rate, bars, fmt="o", ms=4, color=colour, capsize=2)


def _draw_error(axis, line, colour):  # type: ignore[no-untyped-def]
    # A mean over a handful of frames says nothing.
    kept = [p for p in line if p.accepted_along_m is not None and p.draws - p.detected >= 20]
    x = [p.distance_m / 1000 for p in kept]
    axis.semilogy(x, [p.accepted_along_m for p in kept], "-o", ms=3, color=colour)
    axis.semilogy(x, [p.accepted_vertical_m for p in kept], "--o", ms=3, color=colour)


def _draw_bias(axis, line):  # type: ignore[no-untyped-def]
    # With equal σ the weights cancel: the bias is the same for every σ.
    x = [p.distance_m / 1000 for p in line]
    axis.semilogy(x, [p.noise_free_along_m for p in line], "-", lw=3, color="0.6", zorder=0)
    axis.semilogy(x, [p.noise_free_vertical_m for p in line], "--", lw=3, color="0.6", zorder=0)


def main() -> None:
    from rich.console import Console
    from rich.table import Table

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs", help="folder for the results")
    parser.add_argument("--draws", type=int, default=2000, help="noise draws a point")
    options = parser.parse_args()
    points = curve(options.draws)
    table = Table("runway m", "σ px", "km", "detected %", "predicted %", "in 99 %", "along m", "vertical m")
    for p in points:
        errors = ("-" if v is None else f"{v:.1f}" for v in (p.accepted_along_m, p.accepted_vertical_m))
        shares = (f"{100 * v:.1f}" for v in (p.detected / p.draws, p.predicted))
        table.add_row(
            f"{p.length_m:.0f}",
            f"{p.sigma_px}",
            f"{p.distance_m / 1000}",
            *shares,
            "yes" if p.agrees else "no",
            *errors,
        )
    Console().print(table)
    agreeing = sum(p.agrees for p in points)
    print(f"{agreeing} of {len(points)} points lie within the 99 % interval of the prediction")
    results = options.out / "results" / "threshold_fault.json"
    results.parent.mkdir(parents=True, exist_ok=True)
    rows = [{**asdict(p), "agrees": p.agrees} for p in points]
    settings = {"short_m": SHORT_M, "false_alarm_rate": RATE, "crop_px": CROP_PX, "poses": POSES}
    results.write_text(json.dumps({"settings": settings, "points": rows}, indent=1) + "\n", encoding="utf-8")
    draw(points, options.out / "figures" / "threshold_fault.png")


if __name__ == "__main__":
    main()
