"""Faults constant in the world: how far out a single frame sees them, and a window of frames.

Approaches of 3 degrees from 5 km to 300 m at 70 m/s, 5 frames a second. The single-frame test sees
every frame; the window holds 20 frames, one a second, tied by odometry. Every detector may alarm in
1 % of faultless flights: its rate a test is 1 % over the number of its tests along a flight
(Bonferroni). `summed` adds the χ² of the window's frames without the motion between them; `whole`
is the window's χ², `named` its directed tests, `window` both at half the rate, as `check_window`.
The named suspect is the one that most flights' window puts first. Flight k has the same draws in
every setting.

    python benchmarks/window.py [--flights 20] [--jobs 2] [--out docs] [--json]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

import shortfinal as sf
from shortfinal.integrity import check_integrity_batch
from shortfinal.pose import PoseEstimate, PoseEstimateBatch, estimate_pose_batch
from shortfinal.window import SUSPECTS, RelativeMotion, WindowVerdict, check_window

Array = NDArray[np.float64]

CAMERA = sf.Camera(2448, 2648, 3401.6, 3401.6, 1223.5, 1323.5)  # LARD's
FAR_M, NEAR_M, SPEED_MPS, FRAMES_PER_S = 5000.0, 300.0, 70.0, 5
LENGTH = 20  # frames of a window, a second apart
FLIGHT_RATE = 0.01  # false alarms a flight
SPREAD = 0.4  # of log σ over the keypoints of a frame
ODOMETRY = {"0.1 m, 0.05°": (0.1, 0.05), "0.5 m, 0.2°": (0.5, 0.2), "none": None}  # 1σ a second
GOOD = next(iter(ODOMETRY))
LENGTHS_M, SIGMAS_PX = (1500.0, 2000.0, 3000.0), (0.3, 0.8, 2.0)
DETECTORS = ("single", "summed", "whole", "named", "window")


@dataclass(frozen=True)
class Fault:
    """What the world is, where the map says `length_m` x 45 m and the camera file f = 3401.6 px."""

    name: str
    longer_m: float = 0.0
    wider_m: float = 0.0
    near_m: float = 0.0  # the near threshold's place along the runway
    focal: float = 1.0
    stride: float = 1.0  # odometry over the true motion

    def image(self, length_m: float) -> Array:
        """Corners (4, 3) that the camera sees."""
        half = (45.0 + self.wider_m) / 2
        x = [self.near_m, self.near_m, length_m + self.longer_m, length_m + self.longer_m]
        return np.column_stack([x, [half, -half, -half, half], np.zeros(4)])

    def camera(self) -> sf.Camera:
        """The camera that took the images."""
        return replace(CAMERA, fx=self.focal * CAMERA.fx, fy=self.focal * CAMERA.fy)


FAULTS = (
    Fault("none"),
    Fault("far threshold 184 m short", longer_m=-184.0),
    Fault("focal length 3 % long", focal=1.03),
    Fault("parallel runway, 200 m longer, 60 m wide", longer_m=200.0, wider_m=15.0),
    Fault("near threshold 60 m further on", near_m=60.0),
    Fault("odometry 3 % long", stride=1.03),
)


@dataclass(frozen=True)
class Flight:
    """What one detector made of one flight."""

    detector: str
    range_m: float | None  # to the threshold at its first alarm; None: never
    along_m: float | None  # error of its last pose then (window: smoothed), along the runway
    vertical_m: float | None
    named: str = ""  # the window's best explanation


@dataclass(frozen=True)
class Setting:
    """One row of the table."""

    fault: Fault
    length_m: float
    sigma_px: float
    odometry: str


def path(rng: np.random.Generator) -> list[sf.Pose]:
    """The true poses, one a frame: down the glide path, swaying."""
    time = np.arange(0, (FAR_M - NEAR_M) / SPEED_MPS, 1 / FRAMES_PER_S)
    distance, phase = FAR_M - SPEED_MPS * time, rng.uniform(0, 2 * np.pi, 5)
    sway = np.sin(time[:, None] * [0.4, 0.5, 0.6, 0.2, 0.25] + phase) * [1.0, 0.7, 2.0, 0.003, 0.001]
    position = distance[:, None] * np.column_stack(
        [-np.ones_like(time), sway[:, 3], np.tan(np.radians(3)) + sway[:, 4]]
    )
    return [sf.Pose.from_attitude(p, *(a - [0, 3, 0])) for p, a in zip(position, sway[:, :3], strict=True)]


def see(rng: np.random.Generator, poses: Sequence[sf.Pose], setting: Setting) -> PoseEstimateBatch:
    """Every frame solved with the map's runway and the camera file."""
    corners = setting.fault.image(setting.length_m)
    px = np.array([sf.project(setting.fault.camera(), pose, corners) for pose in poses])
    sigma = setting.sigma_px * np.exp(SPREAD * rng.normal(size=(len(poses), 8)))
    noise = (sigma * rng.normal(size=sigma.shape)).reshape(px.shape)
    return estimate_pose_batch(
        px + noise, sigma[:, :, None] ** 2 * np.eye(8), sf.Runway(setting.length_m, 45.0).corners, CAMERA
    )


def measure(rng: np.random.Generator, poses: Sequence[sf.Pose], setting: Setting) -> list[RelativeMotion | None]:
    quality = ODOMETRY[setting.odometry]
    if quality is None:
        return [None] * (len(poses) - 1)
    metres, degrees = quality
    cov = np.diag([metres**2] * 3 + [np.radians(degrees) ** 2] * 3)
    motions: list[RelativeMotion | None] = []
    for earlier, later in pairwise(poses):
        true = RelativeMotion.between(earlier, later, cov)
        step = sf.Pose(setting.fault.stride * true.translation_m, true.earlier_from_later)
        step = step.plus(np.sqrt(np.diag(cov)) * rng.normal(size=6))
        motions.append(RelativeMotion(step.position_m, step.runway_from_camera, cov))
    return motions


def fly(setting: Setting, seed: int) -> list[Flight]:
    """One flight past all detectors."""
    rng = np.random.default_rng([seed, 17])
    poses = path(rng)
    batch = see(rng, poses, setting)
    held = list(range(0, len(poses), FRAMES_PER_S))
    motions = measure(rng, [poses[k] for k in held], setting)
    flights = [_single(batch, poses)]
    waiting = set(DETECTORS[1:])
    for last, verdict, parts in windows(batch, motions, held):
        rate = FLIGHT_RATE / (len(held) - 1)
        for detector in [name for name in DETECTORS if name in waiting and parts[name] < rate]:
            best = _again(batch, motions, held, last, rate).suspicions[0] if detector == "window" else None
            named = f"{best.suspect.name} {best.suspect.words[best.value > 0]}" if best else ""
            error = verdict.positions[-1] - poses[held[last]].position_m if verdict.positions is not None else None
            flights.append(_flight(detector, poses[held[last]], error, named))
            waiting.remove(detector)
        if not waiting:
            break
    return flights + [Flight(name, None, None, None) for name in DETECTORS if name in waiting]


def windows(
    batch: PoseEstimateBatch, motions: Sequence[RelativeMotion | None], held: Sequence[int]
) -> Iterator[tuple[int, WindowVerdict, dict[str, float]]]:
    """Each window by the number of its last frame, with the p-value of each detector."""
    estimates = [batch[k] for k in held]
    for last in range(1, len(held)):
        first = max(0, last - LENGTH + 1)
        part = estimates[first : last + 1]
        verdict = check_window(part, motions[first:last], 1e-300)  # no alarm: all suspicions are score tests
        yield last, verdict, _p_values(part, verdict)


def _p_values(part: Sequence[PoseEstimate], verdict: WindowVerdict) -> dict[str, float]:
    summed = float(chdtrc(2 * len(part), sum(est.chi2 for est in part)))
    whole = 1.0 if verdict.p_value is None else verdict.p_value
    named = min(1.0, len(SUSPECTS) * min((s.p_value for s in verdict.suspicions), default=1.0))
    return {"summed": summed, "whole": whole, "named": named, "window": min(1.0, 2 * whole, 2 * named), "single": 1.0}


def _again(batch, motions, held, last, rate):  # type: ignore[no-untyped-def]
    first = max(0, last - LENGTH + 1)
    return check_window([batch[k] for k in held[first : last + 1]], motions[first:last], rate)


def _single(batch: PoseEstimateBatch, poses: Sequence[sf.Pose]) -> Flight:
    refused = np.flatnonzero(check_integrity_batch(batch).p_value < FLIGHT_RATE / len(poses))
    if not len(refused):
        return Flight("single", None, None, None)
    pose = poses[refused[0]]
    return _flight("single", pose, batch.positions[refused[0]] - pose.position_m)


def _flight(detector: str, truth: sf.Pose, error: Array | None, named: str = "") -> Flight:
    along, vertical = (None, None) if error is None else (float(error[0]), float(error[2]))
    return Flight(detector, float(-truth.position_m[0]), along, vertical, named)


@dataclass(frozen=True)
class Row:
    """Many flights of one setting past one detector; a flight without an alarm counts as range 0."""

    fault: str
    length_m: float
    sigma_px: float
    odometry: str
    detector: str
    flights: int
    alarms: int
    median_m: float  # range to the threshold at the first alarm
    ninety_m: float  # nine flights in ten have alarmed by then
    seconds: float | None  # from the start, median; None when fewer than half alarmed
    along_m: float | None  # root mean square error of the pose then
    vertical_m: float | None
    named: dict[str, int]  # what the window named first


def summarise(setting: Setting, flights: Sequence[Sequence[Flight]]) -> list[Row]:
    rows = []
    for detector in DETECTORS:
        of = [one for flight in flights for one in flight if one.detector == detector]
        ranges = np.array([one.range_m or 0.0 for one in of])
        seen = [one for one in of if one.range_m is not None]
        median, ninety = (float(np.percentile(ranges, q, method="lower")) for q in (50, 10))
        errors = np.array([[one.along_m, one.vertical_m] for one in seen if one.along_m is not None], float)
        rms = np.sqrt(np.mean(errors**2, axis=0)).tolist() if len(errors) else [None, None]
        names = [one.named for one in seen if one.named]
        counts = {name: names.count(name) for name in sorted(set(names), key=names.count, reverse=True)}
        seconds = (FAR_M - median) / SPEED_MPS if median > 0 else None
        rows.append(
            Row(
                setting.fault.name, setting.length_m, setting.sigma_px, setting.odometry, detector, len(of), len(seen),
                median, ninety, seconds, *rms, counts,
            )
        )  # fmt: skip
    return rows


def settings() -> list[Setting]:
    return [
        Setting(fault, length, sigma, odometry)
        for fault in FAULTS
        for length in LENGTHS_M
        for sigma in SIGMAS_PX
        for odometry in (ODOMETRY if length == LENGTHS_M[0] else (GOOD,))
        if odometry != "none" or fault.stride == 1.0
    ]


@dataclass(frozen=True)
class Correlated:
    """False alarms on faultless windows whose keypoint errors are correlated from frame to frame."""

    rho: float  # between consecutive frames of the window
    inflation: float  # of the covariance claimed
    windows: int
    rate: float
    whole: float  # share refused
    named: float
    window: float


def correlated(rho: float, inflation: float, count: int, rate: float = 1e-3) -> Correlated:
    """Windows of 20 frames, a second apart, ending 1 km from a 1,500 m runway; σ = 0.8 px."""
    rng = np.random.default_rng([int(100 * rho), int(inflation), 3])
    setting = Setting(FAULTS[0], 1500.0, 0.8, GOOD)
    end = int((FAR_M - 1000) / SPEED_MPS * FRAMES_PER_S)
    refused = np.zeros(3)
    for _ in range(count):
        poses = path(rng)[end - (LENGTH - 1) * FRAMES_PER_S : end + 1 : FRAMES_PER_S]
        corners = sf.Runway(setting.length_m, 45.0).corners
        px = np.array([sf.project(CAMERA, pose, corners) for pose in poses])
        unit = rng.normal(size=(LENGTH, 8))
        for k in range(1, LENGTH):
            unit[k] = rho * unit[k - 1] + np.sqrt(1 - rho**2) * unit[k]
        sigma = setting.sigma_px * np.exp(SPREAD * rng.normal(size=unit.shape))
        cov = inflation * sigma[:, :, None] ** 2 * np.eye(8)
        batch = estimate_pose_batch(px + (sigma * unit).reshape(px.shape), cov, corners, CAMERA)
        part = [batch[k] for k in range(LENGTH)]
        p = _p_values(part, check_window(part, measure(rng, poses, setting), 1e-300))
        refused += np.array([p["whole"], p["named"], p["window"]]) < rate
    return Correlated(rho, inflation, count, rate, *(refused / count).tolist())


def draw(rows: Sequence[Row], target: Path) -> None:
    """Top: evidence over range on one flight. Bottom: the range of the first alarm over many."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update({"font.size": 9, "axes.grid": True, "grid.alpha": 0.3})
    figure, axes = plt.subplots(2, len(LENGTHS_M), figsize=(11, 6.8), sharex=True, sharey="row", layout="constrained")
    for column, length in enumerate(LENGTHS_M):
        _draw_flight(axes[0, column], length)
        _draw_ranges(axes[1, column], [r for r in rows if r.fault == FAULTS[1].name and r.length_m == length])
        axes[0, column].set_title(f"{length:,.0f} m runway")
        axes[1, column].set_xlabel("distance to the threshold, km (0: never)")
        axes[1, column].set_xlim(5.05, -0.05)
    axes[0, 0].set_ylabel("evidence, −log₁₀ p\n(one flight, σ = 0.8 px)")
    axes[0, 0].legend(loc="upper left")
    handles, labels = axes[1, 0].get_legend_handles_labels()
    axes[1, 0].legend(
        handles[: len(DETECTORS) - 1],
        labels[: len(DETECTORS) - 1],
        loc="lower left",
        title="first alarm: median to 90 %",
    )
    figure.suptitle(
        f"{FAULTS[1].name.capitalize()}: single frames, and windows of {LENGTH} frames over {LENGTH - 1} s, "
        f"odometry {GOOD} a second, {FLIGHT_RATE:.0%} false alarms a flight"
    )
    target.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(target, dpi=150)
    plt.close(figure)


COLOURS = {"single": "tab:green", "summed": "0.55", "whole": "tab:orange", "named": "tab:blue"}


def _draw_flight(axis, length):  # type: ignore[no-untyped-def]
    rng = np.random.default_rng([int(length), 5])
    setting = Setting(FAULTS[1], length, 0.8, GOOD)
    poses = path(rng)
    batch, held = see(rng, poses, setting), list(range(0, len(poses), FRAMES_PER_S))
    motions = measure(rng, [poses[k] for k in held], setting)
    at = np.array([-pose.position_m[0] / 1000 for pose in poses])
    axis.plot(at, -np.log10(check_integrity_batch(batch).p_value), ".", ms=2, color=COLOURS["single"], label="single")
    evidence = {name: [] for name in ("summed", "whole", "named")}
    for _, _, parts in windows(batch, motions, held):
        for name, values in evidence.items():
            values.append(-np.log10(max(parts[name], 1e-30)))
    for name, values in evidence.items():
        axis.plot(at[held[1:]], values, color=COLOURS[name], label=name)
    axis.axhline(-np.log10(FLIGHT_RATE / len(held)), color="k", lw=0.8, ls="--", label="alarm (windows)")
    axis.axhline(-np.log10(FLIGHT_RATE / len(poses)), color="k", lw=0.8, ls=":", label="alarm (single)")
    axis.set_ylim(0, 20)


def _draw_ranges(axis, rows):  # type: ignore[no-untyped-def]
    for s, sigma in enumerate(SIGMAS_PX):
        for d, (detector, colour) in enumerate(COLOURS.items()):
            row = next(
                r for r in rows
                if (r.sigma_px, r.detector, r.odometry) == (sigma, detector, GOOD)
            )  # fmt: skip
            y = -s - 0.18 * (d - 1.5)
            axis.plot([row.median_m / 1000, row.ninety_m / 1000], [y, y], "-", lw=2, color=colour)
            axis.plot(row.median_m / 1000, y, "o", ms=5, color=colour, label=detector)
    axis.set_yticks(-np.arange(len(SIGMAS_PX)), [f"σ = {sigma} px" for sigma in SIGMAS_PX])


def show(rows: Sequence[Row], correlations: Sequence[Correlated]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(width=None if Console().is_terminal else 200)
    title = "first alarm, m: median / 90 % of flights (share that alarmed); error of the window's pose then: RMS, m"
    table = Table("fault", "runway", "σ px", "odometry /s", *DETECTORS, "along", "vertical", "named", title=title)
    for k in range(0, len(rows), len(DETECTORS)):
        group = rows[k : k + len(DETECTORS)]
        first, last = group[0], group[-1]
        errors = ("-" if v is None else f"{v:.1f}" for v in (last.along_m, last.vertical_m))
        names = next((f"{name} {count}/{last.alarms}" for name, count in last.named.items()), "")
        setting = (first.fault, f"{first.length_m:.0f}", f"{first.sigma_px}", first.odometry)
        table.add_row(*setting, *(_cell(r) for r in group), *errors, names)
    console.print(table)
    table = Table(
        "correlation", "covariance x", "windows", "rate %", "whole %", "named %", "window %", title="false alarms"
    )
    for c in correlations:
        shares = (f"{100 * v:.2f}" for v in (c.rate, c.whole, c.named, c.window))
        table.add_row(f"{c.rho}", f"{c.inflation:.3g}", f"{c.windows}", *shares)
    console.print(table)


def _cell(row: Row) -> str:
    ranges = " / ".join(f"{v:.0f}" if v > 0 else "-" for v in (row.median_m, row.ninety_m))
    return f"{ranges} ({row.alarms / row.flights:.0%})"


def _summary(job: tuple[Setting, int]) -> list[Row]:
    setting, flights = job
    return summarise(setting, [fly(setting, seed) for seed in range(flights)])


def _correlated(job: tuple[float, float, int]) -> Correlated:
    return correlated(*job)


def write(rows: Sequence[Row], correlations: Sequence[Correlated], out: Path) -> dict[str, object]:
    """The results as JSON and as a figure under `out`."""
    content = {"rows": [asdict(row) for row in rows], "correlations": [asdict(c) for c in correlations]}
    results = out / "results" / "window.json"
    results.parent.mkdir(parents=True, exist_ok=True)
    results.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    draw(rows, out / "figures" / "window.png")
    return content


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs", help="folder for the results")
    parser.add_argument("--flights", type=int, default=20, help="flights a setting")
    parser.add_argument("--windows", type=int, default=1000, help="windows a correlation")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--json", action="store_true", help="print the results as JSON instead of tables")
    options = parser.parse_args()
    inflated = [(rho, (1 + rho) / (1 - rho)) for rho in (0.5, 0.9)]
    jobs = [(rho, 1.0, options.windows) for rho in (0.0, 0.5, 0.9)] + [(*pair, options.windows) for pair in inflated]
    # Fresh processes: a fork of one with threads, as numpy's, may wait forever.
    with ProcessPoolExecutor(options.jobs, get_context("spawn")) as pool:
        rows = [row for part in pool.map(_summary, [(s, options.flights) for s in settings()]) for row in part]
        correlations = list(pool.map(_correlated, jobs))
    content = write(rows, correlations, options.out)
    print(json.dumps(content, indent=1)) if options.json else show(rows, correlations)


if __name__ == "__main__":
    main()
