"""From a data set and a model, or predictions made elsewhere, to rows and figures."""

import csv
import json
import math
import shutil

import numpy as np
import pytest
from test_cli import call

import shortfinal as sf
from shortfinal.data.dataset import write_dataset
from shortfinal.data.formats import CORNER_COLUMNS
from shortfinal.data.predictions import SIGMA_COLUMNS
from shortfinal.detector import shipped_model
from shortfinal.errors import InputError
from shortfinal.evaluate.figures import METRICS, figures_of, metrics_of
from shortfinal.evaluate.judge import Rates
from shortfinal.evaluate.requirements import Condition, Requirement, Requirements, check
from shortfinal.evaluate.run import FITTED, Subject, evaluate
from shortfinal.protection import AlertLimits

BENCHMARK = "evaluation"

CAMERA = sf.Camera(640, 640, 1200.0, 1200.0, 319.5, 319.5)
LIMITS = AlertLimits(along_m=500, cross_m=100, vertical_m=50)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Ten whole frames of a camera, rendered."""
    folder = tmp_path_factory.mktemp("frames")
    write_dataset(folder, 10, seed=3, camera=CAMERA)
    return folder


@pytest.fixture(scope="module")
def seen(frames, tmp_path_factory):
    return evaluate(Subject(shipped_model()), frames, tmp_path_factory.mktemp("seen"), limits=LIMITS)


def labels_of(folder):
    with (folder / "labels.csv").open() as file:
        return list(csv.DictReader(file))


def predictions(path, labels, sigma=0.5, seed=0, spread=1.0, edit=None):
    """A CSV file of predictions off by `spread` times `sigma`."""
    rng = np.random.default_rng(seed)
    columns = ["image", *CORNER_COLUMNS, *(SIGMA_COLUMNS if sigma else ())]
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        for label in labels:
            size = (sigma or 0.5) * np.exp(rng.normal(0, 0.3, 8))
            off = spread * size * rng.standard_normal(8)
            cells = {"image": label["image"]}
            cells |= {n: float(label[n]) + e for n, e in zip(CORNER_COLUMNS, off)}
            cells |= dict(zip(SIGMA_COLUMNS, size)) if sigma else {}
            if edit:
                edit(label, cells)
            writer.writerow(cells)
    return path


def test_a_model_is_held_against_rendered_frames(seen, frames):
    rows, labels = seen.rows, labels_of(frames)
    assert len(rows) == 10
    assert rows.predicted.sum() >= 8
    # The same as looking at one frame by hand.
    i = int(np.flatnonzero(rows.accepted)[0])
    label = labels[i]
    truth = np.array([float(label[n]) for n in CORNER_COLUMNS]).reshape(4, 2)
    np.testing.assert_allclose(rows.truth_px[i], truth, rtol=1e-6)
    pipeline = sf.LandingPipeline(
        sf.KeypointDetector(), sf.Runway(float(label["length_m"]), float(label["width_m"])), CAMERA
    )
    image = sf.read_image(frames / label["image"]) if hasattr(sf, "read_image") else _read(frames / label["image"])
    box = [*truth.min(axis=0), *truth.max(axis=0)]
    result = pipeline.step(image, box=box)
    np.testing.assert_allclose(result.keypoints.mean_px, rows.mean_px[i], atol=1e-3)
    assert result.verdict.p_value == pytest.approx(rows.p_value[i], rel=1e-2)
    true_position = [float(label[n]) for n in ("x_m", "y_m", "z_m")]
    np.testing.assert_allclose(
        rows.error_m[i], result.estimate.pose.position_m - true_position, atol=0.02 * abs(rows.error_m[i]).max() + 0.1
    )
    np.testing.assert_allclose(rows.level_m[i], result.protection.levels[:3], rtol=0.02)


def _read(path):
    from shortfinal.data.image import read_image

    return read_image(path)


def test_an_interrupted_run_goes_on_where_it_stopped(seen, frames, tmp_path):
    whole = tmp_path / "whole"
    evaluate(Subject(shipped_model()), frames, whole)
    lines = (whole / "predictions.csv").read_text().splitlines(keepends=True)
    text = "".join(lines[:5]) + lines[5][:40]  # four done, the fifth half written
    (whole / "predictions.csv").write_text(text)
    again = evaluate(Subject(shipped_model()), frames, whole)
    after = (whole / "predictions.csv").read_text().splitlines(keepends=True)
    assert after[:5] == lines[:5]
    assert len(after) == len(lines)
    np.testing.assert_allclose(again.rows.mean_px, seen.rows.mean_px, atol=1e-3)


def test_a_folder_with_another_models_predictions_is_refused(frames, tmp_path):
    evaluate(Subject(shipped_model()), frames, tmp_path)
    other = shutil.copytree(frames, tmp_path / "other")
    (other / "labels.csv").write_text((other / "labels.csv").read_text().replace("S3N", "S4N"))
    with pytest.raises(InputError, match="another model or data set"):
        evaluate(Subject(shipped_model()), other, tmp_path)


def test_predictions_made_elsewhere_are_judged_alike(seen, frames, tmp_path):
    """The model's own predictions, given as a file."""
    kept = tmp_path / "kept"
    evaluate(Subject(shipped_model()), frames, kept)
    again = evaluate(Subject(kept / "predictions.csv"), frames, tmp_path / "again", limits=LIMITS)
    assert again.rows.decision.tolist() == seen.rows.decision.tolist()
    np.testing.assert_allclose(again.rows.error_m, seen.rows.error_m, rtol=1e-4, atol=1e-2)


def test_figures_of_known_errors(tmp_path, benchmark):
    labels, found = benchmark.make(tmp_path, 3000)
    made = evaluate(Subject(found), labels, tmp_path / "out", rates=Rates(false_alarm_rate=0.01), limits=LIMITS)
    figures = figures_of(made.rows, LIMITS)
    assert set(figures) <= set(METRICS)
    assert set(METRICS) - set(figures) == {  # there are no pictures, and no network
        *(f"error_input_px.{q}" for q in ("mean", "median", "q90", "q99")), "sigma_input_px.median",
        *(f"latency_ms.{q}" for q in ("median", "q95", "q99")),
        "presence.auroc", "presence.refused", "presence.false_find",
    }  # fmt: skip
    # 24,000 coordinates: 3.3 standard errors of a share are 1.07 points at most; those of 3,000 rows 1.8.
    for level in (50, 68, 90, 95, 99):
        assert figures[f"coverage.{level}"].value == pytest.approx(level / 100, abs=0.011)
    assert figures["nees"].value == pytest.approx(1, abs=3.3 * (2 / 8 / 3000) ** 0.5)
    assert figures["alarm"].value == pytest.approx(0.01, abs=3.3 * (0.01 * 0.99 / 3000) ** 0.5)
    assert figures["along_within_2sigma"].value == pytest.approx(0.9545, abs=0.02)
    assert figures["over_level"].value == 0  # at a risk of 1e-7
    assert figures["use"].value + figures["do_not_use"].value + figures["not_monitored"].value == pytest.approx(1)
    assert 0 < figures["available"].value < 1
    for name, figure in figures.items():
        assert figure.low <= figure.value <= figure.high, name
    # E|e| of e ~ N(0, s²), log s ~ N(log 0.5, 0.4²).
    assert figures["error_px.mean"].value == pytest.approx(0.5 * np.exp(0.08) * (2 / np.pi) ** 0.5, rel=0.03)


def test_every_row_is_in_its_groups(tmp_path, benchmark):
    labels, found = benchmark.make(tmp_path, 400)
    made = evaluate(Subject(found), labels, tmp_path / "out")
    metrics = metrics_of(made.rows)
    for by in ("all", "distance", "glide"):
        counts = [m["count"] for m in metrics if m["by"] == by and m["name"] == "use"]
        assert sum(counts) == 400, by
    json.dumps(made.evidence, allow_nan=False)


def test_without_sigma_one_is_fitted_and_that_is_said(frames, tmp_path, benchmark):
    labels, found = benchmark.make(tmp_path, 300)
    text = [line.split(",")[:9] for line in found.read_text().splitlines()]
    found.write_text("\n".join(",".join(cells) for cells in text))
    made = evaluate(Subject(found), labels, tmp_path / "out")
    assert made.evidence["subject"]["sigma"] == FITTED
    assert any("fitted" in note for note in made.evidence["notes"])
    # Three quarters of the errors are within what three quarters should be, by construction.
    score = np.abs(made.rows.error_px / made.rows.sigma_px)
    assert np.nanmean(score < 1.1503494) == pytest.approx(0.75, abs=0.01)
    with pytest.raises(InputError, match="too few labels to fit"):
        few = tmp_path / "few.csv"
        few.write_text("\n".join(",".join(cells) for cells in text[:10]))
        evaluate(Subject(few), labels, tmp_path / "out")


def test_nothing_is_dropped_silently(tmp_path, benchmark):
    """A corrupt row, a NaN sigma, a missing prediction, a stranger: each is counted, named, and a row of its own."""
    labels, found = benchmark.make(tmp_path, 60)
    lines = found.read_text().splitlines()
    lines[3] = lines[3].replace(",", ";", 3)
    cells = lines[5].split(",")
    lines[5] = ",".join([*cells[:9], "nan", *cells[10:]])
    del lines[8]
    lines.append("stranger.png," + ",".join(lines[1].split(",")[1:]))
    found.write_text("\n".join(lines) + "\n")
    made = evaluate(Subject(found), labels, tmp_path / "out")
    counts = made.evidence["counts"]
    assert counts["labels"] == len(made.rows) == 60
    assert counts["missing"] == 3
    assert counts["problems"] == {"picture": 60, "prediction": 2, "unmatched": 1}
    said = {(p["kind"], p["row"]): p for p in made.evidence["problems"]}
    assert ("prediction", "line 4") in said
    assert said["prediction", "line 6"]["field"] == "near_left_sigma_u"
    assert figures_of(made.rows)["missing"].value == pytest.approx(3 / 60)


def test_pictures_that_are_missing_or_damaged_are_named_and_counted(frames, tmp_path):
    damaged = shutil.copytree(frames, tmp_path / "damaged")
    (damaged / "images" / "000002.png").unlink()
    content = (damaged / "images" / "000004.png").read_bytes()
    (damaged / "images" / "000004.png").write_bytes(content[: len(content) // 3])
    made = evaluate(Subject(shipped_model()), damaged, tmp_path / "out")
    assert made.evidence["counts"]["problems"] == {"picture": 1}
    assert "000002.png" in made.evidence["problems"][0]["what"]
    assert made.rows.decision[[2, 4]].tolist() == ["not-monitored"] * 2
    assert made.rows.reason[4] == "the picture cannot be read"
    assert not made.rows.predicted[[2, 4]].any()


def test_a_data_set_without_camera_or_runway_is_judged_in_pixels_and_that_is_said(frames, tmp_path):
    from shortfinal.data.formats import convert

    convert(frames, tmp_path / "coco", "coco")
    made = evaluate(Subject(shipped_model()), tmp_path / "coco", tmp_path / "out")
    figures = figures_of(made.rows)
    assert "error_px.median" in figures
    assert "along_m.median" not in figures
    assert any("camera" in note for note in made.evidence["notes"])
    assert made.evidence["stanford"] is None
    assert made.evidence["statistic"] is None


_HONEST = [
    Requirement(f"sigma at AP{k:02d}", "near_coverage.95", at_least=0.9, where=Condition(airport=(f"AP{k:02d}",)))
    for k in range(20)
]
_BEYOND, _NEARER = Condition(distance_m=(2000.0, math.inf)), Condition(distance_m=(0.0, 2000.0))
_SHARP = [
    Requirement("far corners beyond 2 km", "far_error_px.median", at_most=0.6, where=_BEYOND),
    Requirement("far corners nearer", "far_error_px.median", at_most=0.6, where=_NEARER),
]
_REQUIRED = Requirements(None, (*_HONEST, *_SHARP))


@pytest.mark.slow
@pytest.mark.parametrize("planted", ["sigma halved at one airport", "far corners biased beyond 2 km"])
def test_a_planted_fault_shows_in_its_group_and_in_no_other(planted, tmp_path, benchmark):
    labels, found = benchmark.make(tmp_path, 3000)
    clean = metrics_of(evaluate(Subject(found), labels, tmp_path / "a").rows)
    truth, guesses = labels_of(tmp_path), list(csv.DictReader(found.open()))
    for label, guess in zip(truth, guesses):
        if planted.startswith("sigma") and label["ident"].startswith("AP07"):
            guess |= {n: float(guess[n]) / 2 for n in SIGMA_COLUMNS}
        away = np.linalg.norm([float(label[n]) for n in ("x_m", "y_m", "z_m")])
        if planted.startswith("far") and away > 2000:
            for name in ("far_right_u", "far_left_u"):
                guess[name] = float(guess[name]) + 3
    with found.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(guesses[0]))
        writer.writeheader()
        writer.writerows(guesses)
    rows = evaluate(Subject(found), labels, tmp_path / "b").rows
    faulty = metrics_of(rows)
    failed = [one["id"] for one in check(_REQUIRED, rows, figures_of) if one["result"] == "failed"]
    assert failed == ["sigma at AP07" if planted.startswith("sigma") else "far corners beyond 2 km"]

    def figure(metrics, by, group, name):
        (one,) = [m for m in metrics if (m["by"], m["group"], m["name"]) == (by, group, name)]
        return one

    if planted.startswith("sigma"):
        for k in range(20):
            after = figure(faulty, "airport", f"AP{k:02d}", "coverage.95")
            # Within 1.96 of half a sigma lie 67.3 % of a normal distribution.
            assert (after["high"] < 0.75) == (k == 7)
    else:
        for group, far in (("1500–2000 m", False), ("2000–3000 m", True), ("4000–6000 m", True)):
            before, after = (figure(m, "distance", group, "far_error_px.median") for m in (clean, faulty))
            assert (after["low"] > 2 * before["high"]) == far
            near = [figure(m, "distance", group, "near_error_px.median")["value"] for m in (clean, faulty)]
            assert near[0] == near[1]


# The command.


def evaluated(capsys, *arguments):
    """Exit status, standard output and the last line of standard error of the command."""
    status, out, error = call(capsys, "evaluate", *arguments)
    return status, out, (error.strip().splitlines() or [""])[-1]


@pytest.mark.slow
def test_the_command_writes_all_of_it_and_its_status_says_whether_requirements_hold(seen, frames, tmp_path, capsys):
    kept = tmp_path / "kept"
    evaluate(Subject(shipped_model()), frames, kept)
    required = tmp_path / "required.toml"
    required.write_text('[[requirement]]\nid = "R1"\nmetric = "error_px.median"\nat_most = 100\nfewest = 2\n')
    out = tmp_path / "report"
    arguments = (shipped_model(), "--data", frames, "--out", out, "--requirements", required)
    shutil.copytree(kept, out)
    status, told, last = evaluated(capsys, *arguments, "--compare", kept / "predictions.csv", "--json")
    assert status == 0, last
    said = json.loads(told)
    assert [one["result"] for one in said["requirements"]] == ["shown"]
    assert said["counts"]["labels"] == 10
    written = {path.name for path in out.iterdir()}
    assert {"report.html", "evaluation.json", "model_card.md", "manifest.json", "predictions.csv"} <= written
    assert "figures" in written
    assert {"rows.parquet", "metrics.parquet"} <= written
    record = json.loads((out / "evaluation.json").read_text())
    assert record["compare"]["name"] == "predictions.csv"
    assert record["metrics"] == said["metrics"]
    assert (out / shipped_model().name).stat().st_size > shipped_model().stat().st_size  # with its card
    sf.KeypointDetector(out / shipped_model().name)

    from shortfinal.evaluate.pack import verify_manifest

    assert verify_manifest(out / "manifest.json", subject=shipped_model(), data=frames, requirements=required) == []
    (out / "model_card.md").write_text("better")
    assert any("model_card.md" in line for line in verify_manifest(out / "manifest.json"))

    required.write_text(required.read_text().replace("at_most = 100", "at_most = 0.001"))
    status, _, last = evaluated(capsys, *arguments, "--json")
    assert status == 1
    assert "R1 failed" in last


def test_rows_as_parquet_say_what_rows_say(seen, tmp_path):
    import pyarrow.parquet as parquet

    from shortfinal.evaluate.tables import write_tables

    assert write_tables(tmp_path, seen.rows, seen.evidence["metrics"]) == []
    table = parquet.read_table(tmp_path / "rows.parquet").to_pydict()
    assert table["decision"] == seen.rows.decision.tolist()
    np.testing.assert_array_equal(table["found_far_left_v_px"], seen.rows.mean_px[:, 3, 1])
    np.testing.assert_array_equal(table["along_error_m"], seen.rows.error_m[:, 0])
    upper = seen.rows.cov_px[:, *np.triu_indices(8)]
    np.testing.assert_array_equal(np.array(table["cov_px2"]), upper)
    metrics = parquet.read_table(tmp_path / "metrics.parquet").to_pylist()
    assert [m["name"] for m in metrics] == [m["name"] for m in seen.evidence["metrics"]]


@pytest.mark.parametrize(
    "arguments, says",
    [
        (["nothing.onnx"], "nothing.onnx"),
        (["predictions.csv"], "predictions.csv"),
        ([shipped_model(), "--requirements", "none.toml"], "none.toml"),
        ([shipped_model(), "--runways", "none.json"], "none.json"),
    ],
)
def test_what_is_not_there_is_named_in_one_line(arguments, says, frames, tmp_path, capsys):
    status, _, last = evaluated(capsys, *arguments, "--data", frames, "--out", tmp_path / "out", "--json")
    assert status == 2
    assert last.startswith("shortfinal: ")
    assert says in last
