"""The command line: parse, call, print. Exit status 0 done, 1 the job failed, 2 the input was wrong."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import typer
from rich.console import Console, Group
from rich.live import Live
from rich.progress import (
    BarColumn,
    DownloadColumn,
    MofNCompleteColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)
from rich.table import Table
from rich.text import Text

from shortfinal.errors import InputError, JobError

if TYPE_CHECKING:
    from shortfinal.demo import Flown
    from shortfinal.evaluate.frames import Evaluation as RunFigures
    from shortfinal.evaluate.run import Evaluation
    from shortfinal.pipeline import FrameResult, LandingPipeline
    from shortfinal.protection import AlertLimits
    from shortfinal.stream.sink import Sink

T = TypeVar("T")

app = typer.Typer(
    add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None,
    help="Runway keypoints with uncertainty, the pose they give, and whether to believe it.",
)  # fmt: skip
data_app = typer.Typer(no_args_is_help=True, help="Data sets.")
app.add_typer(data_app, name="data")
reproduce_app = typer.Typer(no_args_is_help=True, help="The paper's tables again (arXiv 2508.09732).")
app.add_typer(reproduce_app, name="reproduce")

console = Console()
_STYLES = {"use": "green", "do-not-use": "bold red", "not-monitored": "yellow"}

Out = Annotated[Path, typer.Option(help="Folder for the results; made if it does not exist.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of tables.")]
Model = Annotated[Path | None, typer.Option(help="Model file (ONNX); the one that ships by default.")]
Survey = Annotated[
    float, typer.Option(help="How well the runway's corners are known, m, each axis: 0.5 for a survey to ICAO's 1 m.")
]
Rate = Annotated[float, typer.Option(help="Share of faultless frames that may be refused.")]
CameraFile = Annotated[Path | None, typer.Option(help="Camera (TOML): width, height, fx, fy, cx, cy, distortion.")]
_DATABASE = "Runway database: LARD's JSON, or OurAirports' runways.csv or its folder."
Runways = Annotated[Path | None, typer.Option(help=_DATABASE, envvar="SHORTFINAL_RUNWAYS")]
DataSet = Annotated[Path, typer.Argument(help="Folder, or the file that holds or describes its labels: labels.csv, "
                                              "COCO keypoints (.json), YOLO-pose (data.yaml).")]  # fmt: skip
Corners = Annotated[str, typer.Option(help="The data set's names of near-left, near-right, far-right, far-left, "
                                           "e.g. BL,BR,TR,TL, where they are not the usual ones.")]  # fmt: skip
OriginName = Annotated[Literal["corner", "centre"], typer.Option(help="From where COCO keypoints count: the image's "
                                                                 "corner, or its first pixel's centre.")]  # fmt: skip


def main() -> None:
    """Entry point: wrong input is one line on standard error and exit status 2."""
    try:
        sys.exit(app(standalone_mode=False))
    except InputError as error:
        _end(str(error), 2)
    except JobError as error:
        _end(str(error), 1)
    except (typer.Abort, KeyboardInterrupt):
        _end("stopped", 130)
    except Exception as error:
        message = getattr(error, "format_message", None)  # what the option parser raises
        if message is None:
            raise
        _end(f"{message()}; see --help", 2)


def _end(message: str, status: int) -> None:
    """One line, whatever the names in it contain."""
    print(f"shortfinal: {' '.join(message.split())}", file=sys.stderr)  # noqa: T201
    sys.exit(status)


@app.command()
def demo(out: Out = Path("results/demo"), model: Model = None, as_json: Json = False) -> None:
    """The main job on an embedded approach: watch the verdict, and what two faults do to it."""
    from shortfinal.demo import FRAMES, run_demo

    if as_json:
        flown = run_demo(out, model=model)
        _print_json(_demo_summary(flown) | {"out": str(out)})
        return
    rows: list[Flown] = []
    _compile(levels=True, scenes=True)
    with Live(console=console, refresh_per_second=4, vertical_overflow="crop") as live:

        def seen(frame: Flown) -> None:
            rows.append(frame)
            progress = f"frame {len(rows)} of {FRAMES}"
            live.update(Group(_demo_table(rows[-14:]), Text(progress, style="dim")))

        flown = run_demo(out, seen, model)
        live.update(_demo_table([f for f in flown if f.number % 7 == 3]))  # what stays on the screen
    console.print()
    _print_demo_summary(flown, out)


@app.command()
def run(
    source: Annotated[str, typer.Argument(help="Folder of images, video file, camera:0, rtsp://..., or - for raw RGB "
                                               "frames on standard input. With labels: the folder they are of.")],
    labels: Annotated[Path | None, typer.Option(help="LARD labels, or boxes: image, left, top, right, bottom. "
                                                     "SOURCE/labels.csv by default, if it is there.")] = None,
    camera: CameraFile = None,
    runway: Annotated[str, typer.Option(help="Landing direction, e.g. LFPO/24, where the labels do not say.")] = "",
    runways: Runways = None,
    size: Annotated[str, typer.Option(help="Runway length x width, m, e.g. 2000x45, instead of a database.")] = "",
    survey_sigma: Survey = 0.5,
    out: Out = Path("results/run"),
    model: Model = None,
    false_alarm_rate: Rate = 1e-3,
    box: Annotated[str, typer.Option(help="In a flight's first frame: left,top,right,bottom, px.")] = "",
    fps: Annotated[float | None, typer.Option(help="Frames a second of a folder; 30 by default.")] = None,
    copies: Annotated[int, typer.Option(min=0, help="Keep a copy of every so many frames of a flight; 0: none.")] = 1,
    mavlink: Annotated[str, typer.Option(help="To an autopilot: udpout:127.0.0.1:14550, /dev/ttyACM0:921600.")] = "",
    alert_limits: Annotated[str, typer.Option(help="What a flight tolerates: along,cross,vertical, m, e.g. "
                                                   "inf,40,35.")] = "",
    video: Annotated[Path | None, typer.Option(help="Also as a video with the results drawn in (.mp4).")] = None,
    mcap: Annotated[Path | None, typer.Option(help="Also as MCAP, for Foxglove.")] = None,
    parquet: Annotated[Path | None, typer.Option(help="Also as Parquet, in parts, into this folder.")] = None,
    rerun: Annotated[Path | None, typer.Option(help="Also for Rerun (.rrd).")] = None,
    view: Annotated[bool, typer.Option("--view", help="Show the flight live in a browser.")] = False,
    as_json: Json = False,
) -> None:  # fmt: skip
    """A flight, frame after frame, or each labelled image of a folder: keypoints, pose, verdict."""
    from shortfinal.runway import find_runway
    from shortfinal.stream.source import LabelledFolder, read_camera

    given = _sized_runway(size, runway) if size else find_runway(runway, runways) if runway else None
    given = given and replace(given, survey_sigma_m=survey_sigma)
    lens = read_camera(camera) if camera else None
    if labels is None and not (Path(source) / "labels.csv").is_file():
        sinks = _Sinks(mavlink, video, mcap, parquet, rerun, view, copies)
        limits = _limits(alert_limits) if alert_limits else None
        _fly(source, lens, given, out, model, false_alarm_rate, box, fps, limits, sinks, as_json=as_json)
        return
    folder = LabelledFolder(
        source, labels or Path(source) / "labels.csv", camera=lens, runway=given, database=runways,
        survey_sigma_m=survey_sigma,
    )  # fmt: skip
    _run_labelled(folder, out, model, false_alarm_rate, as_json=as_json)


def _fly(
    source: str, camera: Any, runway: Any, out: Path, model: Path | None, false_alarm_rate: float, box: str,
    fps: float | None, limits: AlertLimits | None, wanted: _Sinks, *, as_json: bool,
) -> None:  # fmt: skip
    """A flight: `run` without labels."""
    from shortfinal.detector import KeypointDetector, shipped_model
    from shortfinal.pipeline import LandingPipeline
    from shortfinal.stream.fly import BUDGET_MS, flight_record, fly
    from shortfinal.stream.frames import FPS, check_source, open_source
    from shortfinal.stream.sink import Log
    from shortfinal.tracker import Tracker

    check_source(source)
    if camera is None:
        raise InputError(f"{source}: a flight needs its camera: pass --camera (width, height, fx, fy, cx, cy)")
    if runway is None:
        raise InputError(f"{source}: a flight needs its runway: pass --size 2000x45, or --runway LFPO/24 and --runways")
    wanted.spare(Path(source), out)
    first = _box(box) if box else None
    path = model or shipped_model()
    pipeline = LandingPipeline(
        KeypointDetector(path, shares_cores=True), runway, camera, tracker=Tracker(), false_alarm_rate=false_alarm_rate
    )
    about = {"name": path.name, "sha256": pipeline.detector.sha256}
    flight = flight_record(source, pipeline, about, limits, BUDGET_MS)
    _compile(levels=True, quiet=as_json)  # a camera that is open does not wait for it
    frames = open_source(source, camera, fps)
    sinks = [*wanted.opened(pipeline, flight, getattr(frames, "fps", FPS)), Log(out, flight, wanted.copies)]
    with _bar() as bar:
        task = bar.add_task("frames", total=getattr(frames, "count", None), visible=not as_json)
        flown = fly(frames, pipeline, sinks, box=first, progress=lambda *_: bar.advance(task))
    if as_json:
        _print_json(asdict(flown) | {"out": str(out)})
        return
    decisions, states = (
        ", ".join(f"{count} {name}" for name, count in counts.items()) for counts in (flown.decisions, flown.states)
    )
    console.print(f"{flown.frames} frames: {decisions}; track: {states}")
    table = _table("", ("stage", "p50 ms", "p95 ms", "p99 ms"))
    for stage, times in flown.stages.items():
        table.add_row(stage.removesuffix("_ms"), *(f"{times[q]:.2f}" for q in ("p50", "p95", "p99")))
    console.print(table)
    console.print(
        f"warm-up {flown.warm_up_s:.1f} s; {flown.dropped} frames overtaken by newer ones, {flown.misses} results "
        f"later than {BUDGET_MS:g} ms, {flown.pictures_dropped} pictures not kept for want of time"
    )
    for note in flown.notes:
        console.print(Text(note))
    console.print(f"written: {out}/flight.json, frames.jsonl; to look at: shortfinal view {out}")


@dataclass(frozen=True)
class _Sinks:
    """Where a flight's results go besides its folder."""

    mavlink: str
    video: Path | None
    mcap: Path | None
    parquet: Path | None
    rerun: Path | None
    view: bool
    copies: int  # of every so many frames, in the folder

    def spare(self, source: Path, out: Path) -> None:
        """Raises InputError if what is written would take the place of the flight itself."""
        flight = source.resolve()
        for name, path in (("--video", self.video), ("--mcap", self.mcap), ("--rerun", self.rerun)):
            if path is not None and path.resolve() == flight:
                raise InputError(f"{name} {path}: is the flight itself, which it would replace; choose another name")
        if (out / "frames").resolve() == flight:
            raise InputError(f"--out {out}: its frames are the flight itself, and would be deleted; choose another")

    def opened(self, pipeline: LandingPipeline, flight: dict[str, Any], fps: float) -> list[Sink]:
        """Those that are wanted; `fps` of the video."""
        sinks: list[Sink] = []
        if self.mavlink:
            from shortfinal.stream.mavlink import MavlinkSink

            sinks.append(MavlinkSink(self.mavlink))
        if self.video:
            from shortfinal.stream.sink import AnnotatedVideo

            sinks.append(AnnotatedVideo(self.video, pipeline.camera, pipeline.runway, fps))
        if self.mcap:
            from shortfinal.stream.mcap import McapSink

            sinks.append(McapSink(self.mcap, pipeline.camera, pipeline.runway))
        if self.parquet:
            from shortfinal.stream.parquet import ParquetSink

            sinks.append(ParquetSink(self.parquet))
        if self.rerun:
            from shortfinal.stream.rerun import RerunSink

            sinks.append(RerunSink(self.rerun, pipeline.camera, pipeline.runway))
        if self.view:
            from shortfinal.stream.sink import Live

            sinks.append(live := Live(flight))
            console.print(f"live: {live.url}")
        return sinks


@app.command()
def view(results: Annotated[Path, typer.Argument(help="Folder of a flight that run wrote.")]) -> None:
    """A flight as a page to scrub through: the frame with its overlay, deviations, levels, reasons."""
    from shortfinal.view.page import write_replay

    page = write_replay(results)
    console.print(f"written: {page}; open it in a browser")


def _box(text: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 4 or not (values[0] < values[2] and values[1] < values[3]):
        raise InputError(f"--box: {text!r}; expected left,top,right,bottom in pixels, left < right and top < bottom")
    return values


def _limits(text: str) -> AlertLimits:
    from shortfinal.protection import AlertLimits

    try:
        along, cross, vertical = (float(part) for part in text.split(","))
        return AlertLimits(along, cross, vertical)
    except ValueError as error:
        raise InputError(f"--alert-limits: {text!r}; expected along,cross,vertical in metres, each over 0; inf for an "
                         "axis without limit") from error  # fmt: skip


def _run_labelled(folder: Any, out: Path, model: Path | None, false_alarm_rate: float, *, as_json: bool) -> None:
    """Each labelled image of a `LabelledFolder` by itself."""
    if not as_json:
        _compile(levels=True)
    evaluation, results = _run_folder(folder, out, model, false_alarm_rate, quiet=as_json)
    if as_json:
        _print_json(asdict(evaluation) | {"rows_refused": len(folder.refused), "out": str(out)})
        return
    _print_evaluation(evaluation)
    _print_refused(results)
    for refusal in folder.refused[:10]:
        console.print(Text(f"left out: {refusal.message}"))
    console.print(f"written: {out}/frames.jsonl, evaluation.json, contact_sheet.png")


@app.command()
def audit(
    labels: Annotated[Path, typer.Argument(help="LARD label file (v1 or v2).")],
    runways: Annotated[Path, typer.Option(help=_DATABASE, envvar="SHORTFINAL_RUNWAYS")],
    out: Out = Path("results/audit"),
    sigma_px: Annotated[float | None, typer.Option(help="Of a label; what rounding gives by default.")] = None,
    false_alarm_rate: Rate = 1e-3,
    camera: CameraFile = None,
    as_json: Json = False,
) -> None:  # fmt: skip
    """Which labels contradict their runway? RAIM over a label file, worst first."""
    from shortfinal.audit import audit_file, render_summary, report_as_dict
    from shortfinal.stream.source import read_camera

    given = read_camera(camera) if camera else None
    if not as_json:
        _compile()
    report = audit_file(labels, runways, out, sigma_px=sigma_px, false_alarm_rate=false_alarm_rate, camera=given)
    if as_json:
        _print_json(report_as_dict(report))
        return
    console.print(render_summary(report))
    console.print(f"written: {out}/audit.csv, audit.json, audit.png")


@app.command()
def solve(
    problem: Annotated[Path, typer.Argument(help="JSON: camera, keypoints_px, sigma_px or cov_px, runway.")],
    false_alarm_rate: Rate = 1e-3,
    as_json: Json = False,
) -> None:  # fmt: skip
    """Pose, verdict and protection levels from keypoints, lines and priors that someone else found."""
    from shortfinal.exclusion import exclude_faults
    from shortfinal.problem import read_problem
    from shortfinal.protection import protection_levels

    found = exclude_faults(read_problem(problem).solve(), false_alarm_rate)
    estimate, verdict = found.estimate, found.verdict
    if estimate.pose is None or estimate.cov is None:
        raise InputError(f"{problem}: no pose: {verdict.reasons[0]}")
    record = {
        "status": estimate.status.value, "position_m": estimate.pose.position_m.tolist(),
        "attitude_deg": list(estimate.pose.attitude), "cov": estimate.cov.tolist(),
        "decision": verdict.decision.value, "reasons": list(verdict.reasons),
        "statistic": verdict.statistic, "dof": verdict.dof, "p_value": verdict.p_value,
        "excluded": list(found.excluded), "levels": None,
    }  # fmt: skip
    # After an exclusion no level is promised; without a check there is nothing to promise it of.
    if verdict.decision.value != "not-monitored" and not found.excluded:
        levels = protection_levels(estimate, false_alarm_rate=false_alarm_rate)
        record["levels"] = levels.to_dict()
    if as_json:
        _print_json(record)
        return
    sigma = estimate.sigma_position_m
    assert sigma is not None
    for axis, (name, value, s) in enumerate(zip("xyz", estimate.pose.position_m, sigma, strict=True)):
        bounded = record["levels"] is not None and levels.levels[axis] < float("inf")
        level = f", protection level {levels.levels[axis]:.3g} m" if bounded else ""
        console.print(f"{name}  {value:12.3f} ± {2 * s:.3f} m (2σ){level}")
    console.print("yaw {:.3f}, pitch {:.3f}, roll {:.3f} degrees".format(*estimate.pose.attitude))
    for reason in levels.reasons if record["levels"] is not None else ():
        console.print(reason)
    console.print(f"{verdict.decision.value}: {'; '.join(verdict.reasons)}", style=_STYLES[verdict.decision.value])


@app.command()
def train(
    recipe: Annotated[Path | None, typer.Argument(help="Recipe (TOML); see examples/recipe.toml.")] = None,
    data: Annotated[
        list[Path] | None, typer.Option(help="Training pictures: rendered, or LARD's, COCO keypoints, YOLO-pose.")
    ] = None,
    validation: Annotated[
        list[Path] | None, typer.Option(help="Held-out ones, e.g. rendered with another seed.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the checkpoints.")] = None,
    preset: Annotated[
        str, typer.Option(help="default, finetune, large, paper-resnet or paper-efficientnet; without a recipe.")
    ] = "default",
    change: Annotated[
        list[str] | None, typer.Option("--set", help="Any field of the recipe: --set steps=20000.")
    ] = None,
) -> None:
    """Train a network; run again with the same --out to go on after a stop. `torchrun` shares it among processes."""
    from shortfinal.train.fit import leave
    from shortfinal.train.fit import train as fit
    from shortfinal.train.recipe import make_recipe, parse_change, read_recipe

    changes = dict(parse_change(text) for text in change or ())
    for name, folders in (("data", data), ("validation", validation)):
        if folders:
            changes[name] = [str(folder) for folder in folders]
    if out:
        changes["out"] = str(out)
    made = read_recipe(recipe, changes) if recipe else make_recipe(preset, changes)
    figures = fit(made, console)
    console.print(f"best checkpoint: {made.out}/best.pt, " + ", ".join(f"{k} {v:.3f}" for k, v in figures.items()))
    leave()


@app.command()
def export(
    checkpoint: Annotated[Path, typer.Argument(help="best.pt of a training run.")],
    out: Annotated[Path, typer.Argument(help="Model file to write (.onnx).")],
    precision: Annotated[Literal["fp32", "fp16", "int8"], typer.Option(help="Of the backbone's arithmetic.")] = "fp32",
    data: Annotated[Path | None, typer.Option(help="Data set to compare on, and to set int8's ranges.")] = None,
) -> None:
    """Write a checkpoint as a model file that describes itself, checked against torch."""
    from shortfinal.train.export import export as write

    info = write(checkpoint, out, precision, data)
    console.print(
        f"written: {out} ({out.stat().st_size / 1e6:.1f} MB, {info.backbone}, {info.covariance} covariance, "
        f"{precision}); "
        f"off torch's by {info.figures['export_mean_px']:.2g} px and {info.figures['export_sigma']:.2%} of sigma"
    )


@app.command()
def calibrate(
    model: Annotated[Path, typer.Argument(help="Model file (.onnx).")],
    data: Annotated[Path, typer.Option(help="Labelled pictures that the network has not seen.")],
    out: Annotated[Path | None, typer.Option(help="Model file to write; MODEL itself if not given.")] = None,
    airports: Annotated[str, typer.Option(help="Only these, e.g. BIRK,LFPO/24.")] = "",
) -> None:
    """Hold a model's sigmas against labelled pictures, and keep in its file what mends them."""
    from shortfinal.calibrate import calibrate as fit

    with _counter("looking", quiet=False) as seen:
        made = fit(model, data, out or model, _names(airports), seen)
    scale = ", ".join(f"{factor:.2f}" for factor in made.sigma_scale)
    console.print(f"sigma times {scale} (near-left u, v, near-right u, ...), from {made.fitted_on}")
    console.print(f"written: {out or model}")


@app.command()
def evaluate(
    subject: Annotated[Path, typer.Argument(help="Model file (.onnx), or predictions made elsewhere: .csv, or COCO's "
                                                 "keypoint results (.json).")],
    data: Annotated[Path, typer.Option(help="Labelled pictures: folder, or the file that holds or describes them.")],
    out: Out = Path("results/evaluation"),
    requirements: Annotated[Path | None, typer.Option(help="What must be shown (TOML); exit status 1 if it is not. "
                                                           "See examples/requirements.toml.")] = None,
    compare: Annotated[Path | None, typer.Option(help="Another model or file of predictions, beside it.")] = None,
    runways: Runways = None,
    camera: CameraFile = None,
    corners: Corners = "",
    origin: OriginName = "corner",
    false_alarm_rate: Rate = 1e-3,
    integrity_risk: Annotated[float, typer.Option(help="Of protection levels: P(accepted and beyond).")] = 1e-7,
    fault_prior: Annotated[float, typer.Option(help="Of protection levels: P(a feature is at fault).")] = 1e-4,
    survey_sigma: Survey = 0.0,
    seed: Annotated[int, typer.Option(min=0, help="Of the faults that are planted.")] = 0,
    as_json: Json = False,
) -> None:  # fmt: skip
    """Hold a model, or predictions, against labelled pictures: report, figures with intervals, evidence."""
    from shortfinal.evaluate.figures import figures_of
    from shortfinal.evaluate.judge import Rates
    from shortfinal.evaluate.requirements import check, passed, read_requirements
    from shortfinal.evaluate.run import Subject
    from shortfinal.evaluate.run import evaluate as judge
    from shortfinal.report.write import write_report
    from shortfinal.stream.source import read_camera

    wanted = read_requirements(requirements) if requirements else None
    limits = wanted.alert_limits if wanted else None
    given = read_camera(camera) if camera else None
    if not as_json:
        _compile(levels=True)
    with _stages(quiet=as_json) as seen:

        def held(path: Path, folder: Path) -> Evaluation:
            return judge(
                Subject(path), data, folder, runways=runways, camera=given, corners=_names(corners), origin=origin,
                rates=Rates(false_alarm_rate, integrity_risk, fault_prior, survey_sigma), limits=limits, seed=seed,
                progress=seen,
            )  # fmt: skip

        made = held(subject, out)
        evidence = made.evidence
        if compare:
            other = held(compare, out / "compared").evidence
            evidence["compare"] = {
                "name": compare.name, "metrics": [m for m in other["metrics"] if m["by"] == "all"],
            }  # fmt: skip
        if wanted:
            evidence["requirements"] = check(wanted, made.rows, lambda rows: figures_of(rows, limits))
        write_report(made, out, Subject(subject), data, requirements, seen)
    if as_json:
        _print_json(
            {name: evidence[name] for name in ("counts", "metrics", "requirements", "notes")} | {"out": str(out)}
        )
    else:
        _print_figures(evidence, out)
    if wanted and not passed(evidence["requirements"]):
        lacking = [f"{one['id']} {one['result']}" for one in evidence["requirements"] if one["result"] != "shown"]
        raise JobError(f"{requirements}: {len(lacking)} of {len(wanted.requirements)} not met ({', '.join(lacking)}); "
                       f"see {out}/report.html")  # fmt: skip


@app.command()
def verify(
    report: Annotated[Path, typer.Argument(help="Folder that evaluate wrote, or its manifest.json.")],
    subject: Annotated[Path | None, typer.Option(help="The model or predictions, to be compared too.")] = None,
    data: Annotated[Path | None, typer.Option(help="The data set, to be compared too.")] = None,
    requirements: Annotated[Path | None, typer.Option(help="The requirements, to be compared too.")] = None,
) -> None:
    """Is a report still what evaluate wrote, of the same model, data and requirements? Exit status 1 if not."""
    from shortfinal.evaluate.pack import verify_manifest

    manifest = report / "manifest.json" if report.is_dir() else report
    changed = verify_manifest(manifest, subject=subject, data=data, requirements=requirements)
    for line in changed:
        console.print(Text(line))
    if changed:
        raise JobError(f"{manifest}: {len(changed)} things no longer match")
    console.print(f"{manifest}: everything matches")


@reproduce_app.command("table1")
def reproduce_table1(
    data: Annotated[list[Path], typer.Option(help="Training pictures, as for train; the paper's are LARD v1's.")],
    validation: Annotated[
        list[Path] | None, typer.Option(help="Held-out ones; by default a fifth of the data's airports.")
    ] = None,
    out: Out = Path("results/table1"),
    models: Annotated[str, typer.Option(help="Some of the six, e.g. resnet18,resnet50-sam; all by default.")] = "",
    epochs: Annotated[float, typer.Option(min=0, help="Passes over the data; the paper's by default.")] = 30.0,
    change: Annotated[
        list[str] | None, typer.Option("--set", help="Any field of the recipe: --set likelihood=published.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Table 1: three backbones with the FC and the SAM head, trained alike; run again to go on after a stop."""
    from shortfinal.train.recipe import parse_change
    from shortfinal.train.reproduce import markdown
    from shortfinal.train.reproduce import reproduce_table1 as reproduce

    content = reproduce(
        [str(folder) for folder in data], out, [str(folder) for folder in validation or ()], _names(models), epochs,
        dict(parse_change(text) for text in change or ()), Console(stderr=True) if as_json else console,
    )  # fmt: skip
    if as_json:
        _print_json(content | {"out": str(out)})
        return
    console.print(markdown(content), markup=False, highlight=False, soft_wrap=True)
    console.print(f"written: {out}/table1.md, table1.json, table1.png")


@app.command()
def campaign(
    config: Annotated[Path, typer.Argument(help="What varies (TOML); see examples/campaign.toml.")],
    out: Out = Path("results/campaign"),
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; one per processor by default.")] = None,
    ray: Annotated[str | None, typer.Option(help="Run on Ray: the cluster's address, or local.")] = None,
    as_json: Json = False,
) -> None:  # fmt: skip
    """How often does the monitor err? Monte Carlo over poses, errors and faults; run again to go on after a stop."""
    from shortfinal.campaign.config import read_campaign
    from shortfinal.campaign.report import render_table, write_figures, write_tables
    from shortfinal.campaign.run import run_campaign

    plan = read_campaign(config)
    with _trials_bar(quiet=as_json) as seen:
        counts, effort = run_campaign(plan, out, workers=workers, ray=ray, seen=seen)
    tables, figures = write_tables(plan, counts, out), write_figures(plan, counts, out)
    if as_json:
        _print_json({"scenarios": tables, **asdict(effort), "out": str(out)})
        return
    console.print(render_table(tables))
    console.print(
        "In brackets: 95 % intervals (Clopper-Pearson). Where there is a fault, every trial has it. RMS error of "
        "accepted trials, and median protection level: along / cross / vertical."
    )
    memory = "" if effort.peak_mb is None else f", at most {effort.peak_mb:.0f} MB a process"
    console.print(f"{effort.trials:,} trials in {effort.seconds:.1f} s{memory}")
    console.print(f"written: {out}/tables.json, table.csv, {len(figures)} figures")


@data_app.command("render")
def data_render(
    count: Annotated[int, typer.Option(help="How many pictures.", min=1)],
    out: Annotated[Path, typer.Option(help="Folder of the data set.")],
    seed: Annotated[int, typer.Option(min=0)] = 0,
    camera: Annotated[
        Path | None, typer.Option(help="Camera (TOML): whole frames as it takes them, instead of views of the runway.")
    ] = None,
    crop: Annotated[
        int | None, typer.Option(help="Side, px: of the camera's frames only a crop, as the paper draws it.", min=32)
    ] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Threads; all cores by default.")] = None,
) -> None:
    """Render a data set of random approaches with exact labels; run again to go on after a stop."""
    from shortfinal.data.dataset import write_dataset
    from shortfinal.stream.source import read_camera

    given = read_camera(camera) if camera else None
    with _bar() as bar:
        task = bar.add_task("rendering", total=count)
        labels = write_dataset(out, count, seed, workers, lambda _: bar.advance(task), given, crop)
    console.print(f"written: {labels}")


@data_app.command("check")
def data_check(
    source: DataSet,
    out: Out = Path("results/check"),
    runways: Runways = None,
    camera: CameraFile = None,
    corners: Corners = "",
    origin: OriginName = "corner",
    as_json: Json = False,
) -> None:
    """Is a data set fit to train on? Images, labels, duplicates, leakage between splits, distributions."""
    from shortfinal.data.check import check_dataset, render_summary, report_as_dict
    from shortfinal.stream.source import read_camera

    given = read_camera(camera) if camera else None
    if not as_json:
        _compile()
    with _counter("checking", quiet=as_json) as seen:
        report = check_dataset(
            source, out, runways=runways, camera=given, corners=_names(corners), origin=origin, progress=seen
        )
    if as_json:
        _print_json(report_as_dict(report) | {"out": str(out)})
    else:
        console.print(render_summary(report), highlight=False, markup=False)
        console.print(f"written: {out}/check.json, problems.csv, check.png, contact_sheet.png")
    if report.serious:
        kinds = ", ".join(f"{count} {kind}" for kind, count in report.counts.items())
        raise JobError(f"{source}: {len(report.serious)} problems ({kinds}); see {out}/problems.csv")


@data_app.command("convert")
def data_convert(
    source: DataSet,
    out: Annotated[Path, typer.Argument(help="Folder to write; it must not be there, or be empty.")],
    to: Annotated[Literal["coco", "yolo"], typer.Option(help="COCO keypoints, or YOLO-pose.")],
    split: Annotated[
        str, typer.Option(help="Shares of train, val, test, e.g. 0.8,0.1,0.1: split anew by airport.")
    ] = "",
    seed: Annotated[int, typer.Option(min=0, help="Of the split.")] = 0,
    corners: Corners = "",
    origin: OriginName = "corner",
    as_json: Json = False,
) -> None:
    """Write a data set, of whatever format, as COCO keypoints or YOLO-pose; images are linked or copied."""
    from shortfinal.data.formats import convert

    try:
        fractions = [float(share) for share in _names(split)]
    except ValueError as error:
        raise InputError(f"--split: {split!r}; expected shares of train, val, test, e.g. 0.8,0.1,0.1") from error
    with _counter("writing", quiet=as_json) as seen:
        done = convert(
            source, out, to, corners=_names(corners), origin=origin, fractions=fractions, seed=seed, progress=seen
        )
    if as_json:
        _print_json(asdict(done) | {"out": str(out)})
        return
    for line in (*done.refused[:10], *done.notes):
        console.print(str(line), highlight=False, markup=False)
    if len(done.refused) > 10:
        console.print(f"... and {len(done.refused) - 10} more left out")
    if done.outside:
        console.print(f"{done.outside} corners outside their picture are written as not labelled: YOLO has no room")
    splits = ", ".join(f"{count} {split or 'without split'}" for split, count in done.splits.items())
    console.print(f"written: {out}, {done.pictures} pictures ({splits}), {done.labels} labels")


@data_app.command("fetch")
def data_fetch(
    name: Annotated[str, typer.Argument(help="lard-v1, lard-v2 or ourairports.")],
    out: Annotated[Path, typer.Option(help="Folder for the files; made if it does not exist.")],
    subset: Annotated[list[str] | None, typer.Option(help="Part to fetch; may be repeated. LARD v2: ges, arcgis, "
                                                          "bingmaps, xplane, flsim. LARD v1: a word of an archive's "
                                                          "name, e.g. BIRK. All by default.")] = None,
    url: Annotated[str | None, typer.Option(help="Address of the service, if not the public one.")] = None,
) -> None:  # fmt: skip
    """Fetch a public data set, checked and unpacked; run again to go on after a stop."""
    from shortfinal.data.fetch import fetch_files, list_files, unpack_archives

    with console.status("asking what there is ..."):
        listing = list_files(name, url=url, subsets=subset or ())
    with _bytes_bar() as bar:
        fetching = bar.add_task("fetching", total=listing.size or None)
        files = fetch_files(listing, out, progress=lambda n: bar.advance(fetching, n))
        if listing.archives:
            unpacking = bar.add_task("unpacking", total=sum(a.size or 0 for a in listing.archives))
            unpack_archives(listing, out, progress=lambda n: bar.advance(unpacking, n))
    console.print(f"written: {out} ({len(files)} files, {len(listing.archives)} of them unpacked)")


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")] if text else []


def _run_folder(
    folder: Any, out: Path, model: Path | None, false_alarm_rate: float, *, quiet: bool
) -> tuple[RunFigures, list[tuple[str, FrameResult]]]:
    from shortfinal.detector import KeypointDetector
    from shortfinal.evaluate.frames import evaluate
    from shortfinal.files import make_folder, write_png, write_whole
    from shortfinal.pipeline import LandingPipeline
    from shortfinal.stream.overlay import contact_sheet, draw_close_up
    from shortfinal.stream.sink import JsonlWriter

    detector, target = KeypointDetector(model), make_folder(out)
    results, truths, distances, pictures = [], [], [], []
    every = max(1, len(folder) // 24)
    with JsonlWriter(target / "frames.jsonl") as lines:
        for number, frame in enumerate(_track(folder, len(folder), quiet)):
            pipeline = LandingPipeline(detector, frame.runway, frame.camera, false_alarm_rate=false_alarm_rate)
            result = pipeline.step(frame.image, box=frame.box)
            truth = None if frame.truth_px is None else frame.truth_px.tolist()
            lines.write(
                {"image": frame.name, **result.to_dict(), "truth_px": truth, "recorded_distance_m": frame.distance_m}
            )
            results.append((frame.name, result))
            truths.append(frame.truth_px)
            distances.append(frame.distance_m)
            if number % every == 0:
                pictures.append(
                    draw_close_up(frame.image, result, f"{frame.runway.ident}  {frame.name}", frame.truth_px)
                )
    evaluation = evaluate([r for _, r in results], truths, distances)
    write_png(target / "contact_sheet.png", contact_sheet(pictures, columns=6, width=300))
    write_whole(target / "evaluation.json", json.dumps(asdict(evaluation), indent=1))
    return evaluation, results


def _compile(*, levels: bool = False, scenes: bool = False, quiet: bool = False) -> None:
    """Compile the kernels with something to look at."""
    from shortfinal.warm import warm_up

    words = "compiling the kernels (once on this machine, most of a minute) ..."
    with nullcontext() if quiet else console.status(words):
        warm_up(levels=levels, scenes=scenes)


def _sized_runway(size: str, ident: str) -> Any:
    from shortfinal.runway import Runway

    length, _, width = size.lower().partition("x")
    try:
        return Runway(float(length), float(width), ident)
    except ValueError as error:
        raise InputError(f"--size: {size!r}; expected length x width in metres, e.g. 2000x45") from error


def _bar() -> Progress:
    return Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), console=console
    )


def _bytes_bar() -> Progress:
    return Progress(
        TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn(),
        console=console,
    )  # fmt: skip


@contextmanager
def _counter(what: str, *, quiet: bool) -> Iterator[Callable[[int, int], None] | None]:
    """A bar moved by a function of (how many are done, of so many)."""
    if quiet:
        yield None
        return
    with _bar() as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


@contextmanager
def _stages(*, quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """Bars moved by a function of (what is being done, how much is done, of so much), one for each thing done."""
    if quiet:
        yield lambda what, done, total: None
        return
    with _bar() as bar:
        tasks: dict[str, Any] = {}

        def seen(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=total)
            bar.update(tasks[what], completed=done, total=total)

        yield seen


@contextmanager
def _trials_bar(*, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """A bar with rate and time left, moved by a function of (trials done, of so many)."""
    if quiet:
        yield lambda done, total: None
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TextColumn("{task.fields[rate]}"),
               TimeRemainingColumn())  # fmt: skip
    start, before = time.perf_counter(), None
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("compiling", total=None, rate="")

        def seen(done: int, total: int) -> None:
            nonlocal start, before
            if before is None:  # what an earlier run did says nothing of this one's speed
                start, before = time.perf_counter(), done
                bar.reset(task, total=total, completed=done, description="trials")
                return
            rate = (done - before) / (time.perf_counter() - start)
            bar.update(task, completed=done, rate=f"{rate:,.0f} a second")

        yield seen


def _track(items: Iterable[T], total: int, quiet: bool) -> Iterator[T]:
    if quiet:
        yield from items
        return
    with _bar() as bar:
        yield from bar.track(items, total=total, description="frames")


def _print_json(record: dict[str, Any]) -> None:
    print(json.dumps(record))  # noqa: T201


def _table(title: str, columns: tuple[str, ...]) -> Table:
    table = Table(title=title or None, title_justify="left", box=None, pad_edge=False)
    for name in columns:
        words = name in ("stage", "fault", "verdict", "why", "corners", "image", "figure")
        table.add_column(name, justify="left" if words else "right", no_wrap=name != "why")
    return table


def _demo_table(frames: Iterable[Flown]) -> Table:
    table = _table("", ("frame", "distance", "height", "error", "up", "level", "p", "verdict", "fault"))
    for f in frames:
        estimate = f.result.estimate
        cells = ["–"] * 4
        sigma_m = None if estimate is None else estimate.sigma_position_m
        if estimate is not None and estimate.pose is not None and sigma_m is not None and f.error_m is not None:
            x, _, z = estimate.pose.position_m
            sx, _, sz = 2 * sigma_m
            along, _, vertical = f.error_m
            cells = [f"{-x:.0f} ±{sx:.0f}", f"{z:.0f} ±{sz:.1f}", f"{along:+.1f}", f"{vertical:+.1f}"]
        protection = f.result.protection
        level = (
            "none" if protection is None or protection.vertical_m == float("inf") else f"{protection.vertical_m:.0f}"
        )
        p, decision = f.result.verdict.p_value, f.result.verdict.decision.value
        table.add_row(
            str(f.number), *cells, level, "–" if p is None else f"{p:.0e}",
            Text(decision, style=_STYLES[decision]), Text(_FAULT_WORDS[f.fault.name], style="yellow"),
        )  # fmt: skip
    return table


_FAULT_WORDS = {"NONE": "", "FAR_THRESHOLD": "far short", "NEAR_CORNER": "corner slid"}


def _demo_summary(flown: list[Flown]) -> dict[str, Any]:
    """Per fault: frames, decisions, and medians of the error and of what the fault did to the pose."""
    from shortfinal.demo import Fault
    from shortfinal.integrity import Decision

    summary: dict[str, Any] = {}
    for fault in Fault:
        mine = [f for f in flown if f.fault is fault]
        summary[fault.name.lower()] = {
            "frames": len(mine),
            **{d.value: sum(f.result.verdict.decision is d for f in mine) for d in Decision},
            "median_abs_error_m": _medians([f.error_m for f in mine], absolute=True),
            "median_moved_by_fault_m": _medians([f.moved_m for f in mine], absolute=False),
        }
    return summary


def _medians(values: list[Any], *, absolute: bool) -> dict[str, float] | None:
    from statistics import median

    known = [v for v in values if v is not None]
    names = ("along", "cross", "vertical")
    pick = abs if absolute else float
    return {n: round(median(pick(float(v[i])) for v in known), 2) for i, n in enumerate(names)} if known else None


def _print_demo_summary(flown: list[Flown], out: Path) -> None:
    titles = {"none": "none", "far_threshold": "far 184 m short", "near_corner": "near corner slid"}
    table = _table("", ("fault", "frames", "used", "refused", "error along", "up", "moved along", "up"))
    for name, row in _demo_summary(flown).items():
        counts = [str(row[k]) for k in ("frames", "use", "do-not-use")]
        cells = []
        for key in ("median_abs_error_m", "median_moved_by_fault_m"):
            medians = row[key]
            blank = medians is None or (name == "none" and "moved" in key)
            cells += ["–", "–"] if blank else [f"{medians['along']:.1f}", f"{medians['vertical']:.1f}"]
        table.add_row(titles[name], *counts, *cells)
    console.print(table)
    console.print(
        "Medians of all frames, in metres; moved: what the fault did to the pose. The slid corner must be refused. "
        "The misplaced far threshold fits another pose so well that one frame often cannot show it (docs/limits.md)."
    )
    console.print(f"written: {out}/approach.mp4, contact_sheet.png, timeline.png, frames.jsonl")


def _print_evaluation(evaluation: RunFigures) -> None:
    from shortfinal.evaluate.frames import rows

    decisions = ", ".join(f"{count} {name}" for name, count in evaluation.decisions.items())
    console.print(f"{evaluation.frames} frames: {decisions}")
    if evaluation.all is None:
        return
    table = _table("", ("corners", "median px", "90 % px", "mean px", "median σ px", "in 68 %", "in 95 %"))
    for name, f in rows(evaluation):
        numbers = (f"{v:.2f}" for v in (f.median_px, f.p90_px, f.mean_px, f.sigma_median_px))
        table.add_row(name, *numbers, f"{f.coverage_68:.0%}", f"{f.coverage_95:.0%}")
    console.print(table)
    if evaluation.distance_error:
        e = evaluation.distance_error
        console.print(
            f"distance error: median {e['median']:.1%}, 90 % {e['p90']:.1%} of {e['frames']:.0f} solved frames"
        )


_SHOWN = (
    ("use", "not_monitored", "alarm"), ("error_px.median", "error_px.q90", "far_error_px.median"),
    ("coverage.68", "coverage.95", "nees"), ("along_m.median", "cross_m.median", "vertical_m.median", "over_level"),
    ("detection.far_threshold_184m", "latency_ms.median"),
)  # fmt: skip


def _print_figures(evidence: dict[str, Any], out: Path) -> None:
    """The figures that matter most, the requirements, and what a reader must know."""
    overall = {m["name"]: m for m in evidence["metrics"] if m["by"] == "all"}
    table = _table("", ("figure", "value", "95 % interval", "of"))
    for names in _SHOWN:
        for name in names:
            if metric := overall.get(name):
                ends = " – ".join("?" if end is None else f"{end:.3g}" for end in (metric["low"], metric["high"]))
                table.add_row(name, f"{metric['value']:.3g} {metric['unit']}", ends, f"{metric['count']:,}")
    console.print(f"{evidence['title']}: {evidence['counts']['labels']:,} labelled runways")
    console.print(table)
    for one in evidence["requirements"] or ():
        console.print(Text(f"{one['id']}: {one['result']}: {one['why']}", style=_RESULTS[one["result"]]))
    problems = evidence["counts"]["problems"]
    if problems:
        console.print(Text("problems: " + ", ".join(f"{count} {kind}" for kind, count in problems.items())))
    for problem in evidence["problems"][:10]:
        console.print(Text(f"  {problem['file']}: {problem['row']}: {problem['what']}"))
    for note in evidence["notes"]:
        console.print(Text(note))
    console.print(f"written: {out}/report.html, evaluation.json, model_card.md, manifest.json, figures/")


_RESULTS = {"shown": "green", "failed": "bold red", "not shown": "yellow"}


def _print_refused(results: list[tuple[str, FrameResult]], most: int = 10) -> None:
    refused = [(name, r) for name, r in results if r.verdict.decision.value != "use"]
    if not refused:
        return
    table = _table(
        f"{len(refused)} frames not to be used, the first {min(most, len(refused))}", ("image", "verdict", "why")
    )
    for name, result in refused[:most]:
        decision = result.verdict.decision.value
        table.add_row(Text(name), Text(decision, style=_STYLES[decision]), Text("; ".join(result.verdict.reasons)))
    console.print(table)


if __name__ == "__main__":
    main()
