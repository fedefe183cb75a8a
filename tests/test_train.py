import csv
import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

import shortfinal as sf
from shortfinal.data.dataset import Example, read_dataset, write_dataset
from shortfinal.detector import shipped_model
from shortfinal.errors import JobError
from shortfinal.files import csv_text
from shortfinal.keypoints import AIMING_NAMES

torch = pytest.importorskip("torch")

from shortfinal.train import fit  # noqa: E402
from shortfinal.train.fit import Batch, Run, auroc, figures_of, load_checkpoint, network_weights, open_data, train  # noqa: E402
from shortfinal.train.model import Prediction  # noqa: E402
from shortfinal.train.recipe import Recipe, make_recipe, to_dict  # noqa: E402

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
FOLDED = DATA / "weights" / "tf2_mobilenet_v2_1.0_224_ptq_float32.npz"


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Two data sets of rendered views: of runways, of their ends, and of land without one."""
    folder = tmp_path_factory.mktemp("training")
    write_dataset(folder / "a", 12, seed=5)
    write_dataset(folder / "b", 6, seed=7)
    for name in "ab":
        shown = [corners is not None for _, corners in read_dataset(folder / name).labels]
        assert True in shown
        assert False in shown
    return folder


@pytest.fixture(scope="module")
def recipe(scenes):
    return Recipe((str(scenes / "a"),), (str(scenes / "b"),), backbone="test_efficientnet", width=8, size=64, batch=4,
                  steps=4, validate_every=2, workers=0)  # fmt: skip


def changed(recipe, out, **changes):
    return dataclasses.replace(recipe, out=str(out), **changes)


def relabelled(source, folder, change):
    """A data set of the same pictures, each row as `change` (number, row) makes it; None leaves it out."""
    with (source / "labels.csv").open(newline="") as file:
        rows = [row | {"image": str(source / row["image"])} for row in csv.DictReader(file)]
    kept = [row for row in (change(k, row) for k, row in enumerate(rows)) if row]
    folder.mkdir()
    (folder / "labels.csv").write_text(csv_text(kept[0], kept))
    return folder


def at_airports(names, splits=()):
    """Change rows to those of airports, e.g. "AAB": the third runway is at BBBB. Rows without a runway are left out."""

    def change(number, row):
        if number >= len(names) or not row["near_left_u"]:
            return None
        return row | {"ident": f"{4 * names[number]}/01"} | ({"split": splits[number]} if splits else {})

    return change


# The data.


@pytest.fixture(scope="module")
def runways(tmp_path_factory):
    """Ten pictures of runways."""
    folder = tmp_path_factory.mktemp("runways")
    write_dataset(folder / "w", 10, seed=9)
    return folder / "w"


def test_data_that_share_an_airport_are_refused_unless_told(recipe, runways, tmp_path):
    one = relabelled(runways, tmp_path / "one", at_airports("AABB"))
    other = relabelled(runways, tmp_path / "other", at_airports("CBCC"))
    both = {"data": (str(one),), "validation": (str(other),)}
    with pytest.raises(sf.InputError, match=r"^1 airports are in both training and validation \(first: BBBB\)"):
        open_data(changed(recipe, tmp_path, **both))
    learning, held = open_data(changed(recipe, tmp_path, share_airports=True, **both))
    assert (len(learning), len(held)) == (4, 4)


def test_without_validation_a_fifth_of_the_airports_is_held_out(recipe, runways, tmp_path):
    folder = relabelled(runways, tmp_path / "x", at_airports("AABBCCDDEE"))
    learning, held = open_data(changed(recipe, tmp_path, data=(str(folder),), validation=()))
    places = [{picture.labels[0].airport for picture, _ in part.labels} for part in (learning, held)]
    assert [len(place) for place in places] == [4, 1]
    assert not places[0] & places[1]
    one = relabelled(runways, tmp_path / "one", at_airports("AAAA"))
    with pytest.raises(sf.InputError, match=rf"^{one}: split: 1 airports cannot fill 2 splits: AAAA; or name pictures"):
        open_data(changed(recipe, tmp_path, data=(str(one),), validation=()))


def test_without_validation_the_data_sets_own_splits_count(recipe, runways, tmp_path):
    splits = ["train", "val", "train", "test", "test", "train"]
    folder = relabelled(runways, tmp_path / "x", at_airports("ABCDEF", splits))
    learning, held = open_data(changed(recipe, tmp_path, data=(str(folder),), validation=()))
    assert sorted(p.labels[0].airport for p, _ in learning.labels) == ["AAAA", "CCCC", "FFFF"]
    assert [p.labels[0].airport for p, _ in held.labels] == ["BBBB"]


def test_pictures_kept_for_the_test_are_not_drawn_on(recipe, runways, tmp_path):
    # No validation is marked, so a fifth of the rest becomes it; test stays apart.
    folder = relabelled(runways, tmp_path / "x", at_airports("ABCDEFGH", ["train"] * 5 + ["test"] * 3))
    parts = open_data(changed(recipe, tmp_path, data=(str(folder),), validation=()))
    airports = sorted(p.labels[0].airport for part in parts for p, _ in part.labels)
    assert airports == ["AAAA", "BBBB", "CCCC", "DDDD", "EEEE"]


def test_rendered_views_split_one_by_one_those_of_land_too(recipe, scenes, tmp_path):
    learning, held = open_data(changed(recipe, tmp_path, data=(str(scenes / "a"), str(scenes / "b")), validation=()))
    assert len(learning) + len(held) == 18
    assert len(held) in (3, 4)
    paths = [{picture.path for picture, _ in part.labels} for part in (learning, held)]
    assert not paths[0] & paths[1]


def test_the_aiming_points_marking_is_learned_too(recipe, tmp_path):
    eight = changed(recipe, tmp_path / "run", steps=2, keypoints=(*sf.CORNER_NAMES, *AIMING_NAMES), covariance="full")
    assert np.isfinite(train(eight)["nll"])
    learning, _ = open_data(eight)
    draws, marked_ones = fit._Draws(learning, eight, range(12), 0, 4), 0
    for batch in (draws[n] for n in range(48)):
        assert batch.corners_px.shape == (8, 2)
        if batch.visible.all():
            left, right = batch.corners_px[[0, 3, 4, 7]], batch.corners_px[[1, 2, 5, 6]]
            assert (left[:, 0] < right[:, 0]).all()  # mirrored or not
            marked_ones += 1
    assert marked_ones > 3
    with pytest.raises(sf.InputError, match="no label has the keypoint papi-left"):
        open_data(dataclasses.replace(eight, keypoints=(*sf.CORNER_NAMES, "papi-left", "papi-right")))


def test_data_without_a_runway_are_refused(recipe, scenes, tmp_path):
    folder = relabelled(scenes / "a", tmp_path / "x", lambda k, row: None if row["near_left_u"] else row)
    with pytest.raises(sf.InputError, match=rf"^{folder}: no training picture shows a runway$"):
        train(changed(recipe, tmp_path / "run", data=(str(folder),)))
    with pytest.raises(sf.InputError, match=rf"^{folder}: no held-out picture shows a runway$"):
        train(changed(recipe, tmp_path / "run", validation=(str(folder),)))
    assert not (tmp_path / "run").exists()


def test_every_pass_shows_every_picture_once_whoever_draws(recipe, scenes):
    examples = read_dataset(scenes / "a")
    alone = fit._Draws(examples, recipe, range(0, 9), 0, 4)
    picks = [alone._pick(n) for n in range(36)]
    assert sorted(picks[:12]) == sorted(picks[12:24]) == sorted(picks[24:]) == list(range(12))
    assert picks[:12] != picks[12:24]
    # Two processes, begun at the fifth step: the fifth batch of one that was never stopped.
    shares = [fit._Draws(examples, recipe, range(4, 9), rank, 2) for rank in (0, 1)]
    for place in range(4):
        one, other = alone[4 * 4 + place], shares[place // 2][place % 2]
        assert all(torch.equal(a.nan_to_num(-1), b.nan_to_num(-1)) for a, b in zip(one, other, strict=True))


def marked(corners, size=(160, 120)):
    """A picture that is grey but for a bright dot at each corner."""
    image = np.full((size[1], size[0], 3), 90, np.uint8)
    for u, v in np.round(corners).astype(int):
        cv2.circle(image, (int(u), int(v)), 2, (250, 250, 250), -1)
    return Example(image, np.asarray(corners, float))


@pytest.mark.parametrize("crop", ["framed", "native"])
def test_held_out_pictures_are_looked_at_around_what_they_show(recipe, crop):
    recipe = dataclasses.replace(recipe, crop=crop)
    whole = [[60.0, 90], [80, 91], [75, 60], [66, 60]]
    cut = [[30.0, 400], [300, 400], [75, 60], [45, 61]]
    for corners, seen in ((whole, [1, 1, 1, 1]), (cut, [0, 0, 1, 1])):
        data = [marked(corners)]
        batch = fit._Held(data, recipe)[0]
        assert batch.visible.tolist() == seen
        for place in batch.corners_px[batch.visible.bool()]:
            u, v = place.round().int().tolist()
            assert batch.image[:, v, u].min() > 1.5  # (250 / 255 - 0.5) / 0.25 = 1.9 at a dot, -0.6 beside it
        native = fit.held_out_window(data[0], recipe, 0)
        assert float(batch.scale) == pytest.approx(native.scale[0])
    if crop == "native":
        assert float(fit._Held([marked(whole)], recipe)[0].scale) == 1.0
    nothing = fit._Held([Example(marked(whole).image, None)], recipe)[0]
    assert nothing.visible.tolist() == [0, 0, 0, 0]
    assert nothing.corners_px.isfinite().all()


def test_a_corner_beyond_the_picture_is_not_visible_though_the_crop_reaches_there(recipe):
    # The near corners lie just below the picture, and the crop with its margin shows black there.
    example = marked([[55.0, 122.0], [105, 122], [110, 90], [50, 90]])
    batch = fit._Held([example], recipe)[0]
    moved = fit.held_out_window(example, recipe, 0).apply(example.corners_px)
    assert ((moved > 0) & (moved < recipe.size - 1)).all()
    assert batch.visible.tolist() == [0, 0, 1, 1]


def test_few_held_out_pictures_are_taken_from_all_of_them(recipe):
    data = [marked(np.array([[60.0, 90], [80, 91], [75 - 2 * k, 60], [66, 60]])) for k in range(7)]
    held = fit._Held(data, dataclasses.replace(recipe, validation_count=3))
    assert len(held) == 3
    for index, number in enumerate((0, 2, 4)):
        assert torch.equal(held[index].image, fit._Held([data[number]], recipe)[0].image)


# What is measured.


def prediction(mean, sigma, present, factor=None):
    mean = torch.tensor(mean, dtype=torch.float64)
    return Prediction(mean, torch.full_like(mean, sigma), factor, mean[..., 0], torch.tensor(present), None)


def answers():
    """Three crops: four corners off by 1 and 3 px, two corners off by 2, and nothing; enlarged 2, 4 and 1 times."""
    truth = torch.full((3, 4, 2), 50.0).double()
    visible = torch.tensor([[1.0, 1, 1, 1], [0, 0, 1, 1], [0, 0, 0, 0]])
    off = [[[1.0, -3]] * 4, [[99.0, 99]] * 2 + [[2.0, 2]] * 2, [[99.0, 99]] * 4]
    said = prediction((truth + torch.tensor(off).double()).tolist(), 2.0, [3.0, 1.0, -1.0])
    return said, Batch(
        torch.zeros(3, 3, 0, 0), truth, visible, torch.full((3, 4), torch.nan), torch.tensor([2.0, 4.0, 1.0])
    )


def test_figures_are_those_of_what_is_visible():
    figures = figures_of(*answers())
    # Errors: four of 1 and four of 3, at scale 2; four of 2, at scale 4. In units of sigma 0.5, 1.5 and 1.
    assert figures["mean_px"] == pytest.approx(24 / 12)
    assert figures["native_mean_px"] == pytest.approx((4 * 0.5 + 4 * 1.5 + 4 * 0.5) / 12)
    assert figures["median_px"] == 2
    assert figures["p90_px"] == 3
    assert figures["far_median_px"] == 2
    assert figures["nll"] == pytest.approx((4 * 0.125 + 4 * 1.125 + 4 * 0.5) / 12 + np.log(2))
    # Two-sided normal quantiles: 0.67 at 50 %, 0.99 at 68 %, 1.64 at 90 %.
    assert [figures[f"coverage_{level}"] for level in (50, 68, 90, 95, 99)] == pytest.approx([1 / 3, 1 / 3, 1, 1, 1])
    assert figures["present_auroc"] == 1


def test_the_likelihood_counts_correlations():
    said, batch = answers()
    rho = 0.6
    factor = torch.eye(8).double()
    for k in range(0, 8, 2):
        factor[k + 1, k], factor[k + 1, k + 1] = rho, (1 - rho**2) ** 0.5
    correlated = figures_of(said._replace(factor=factor.expand(3, -1, -1)), batch)
    # e' R^-1 e of a pair (a, b): (a^2 - 2 rho a b + b^2) / (1 - rho^2).
    pairs = [(0.5, -1.5)] * 4 + [(1.0, 1.0)] * 2
    squared = sum((a * a - 2 * rho * a * b + b * b) / (1 - rho**2) for a, b in pairs)
    wanted = (0.5 * squared + 6 * 0.5 * np.log(1 - rho**2)) / 12 + np.log(2)
    assert correlated["nll"] == pytest.approx(wanted)
    assert correlated["coverage_90"] == figures_of(said, batch)["coverage_90"]


def test_without_crops_of_both_kinds_there_is_no_auroc_and_without_corners_nothing():
    said, batch = answers()
    assert "present_auroc" not in figures_of(Prediction(*(p if p is None else p[:2] for p in said)),
                                             Batch(*(part[:2] for part in batch)))  # fmt: skip
    with pytest.raises(sf.InputError, match="no corner of a runway can be seen"):
        figures_of(said, batch._replace(visible=torch.zeros(3, 4)))


@pytest.mark.parametrize(
    ("scores", "positive", "area"),
    [([1, 2, 3, 4], [0, 0, 1, 1], 1.0), ([4, 3, 2, 1], [0, 0, 1, 1], 0.0), ([1, 1, 1, 1], [0, 1, 0, 1], 0.5),
     ([1, 3, 2, 4], [0, 0, 1, 1], 0.75), ([1, 2, 2, 3], [0, 0, 1, 1], 0.875), ([5, 1, 2], [1, 0, 0], 1.0)],
)  # fmt: skip
def test_auroc_is_the_chance_of_the_right_order(scores, positive, area):
    assert auroc(np.array(scores, float), np.array(positive, bool)) == pytest.approx(area)


# A run.


def same_run(one, other):
    """Whether two folders hold the same curve and the same weights, to the bit."""
    assert (one / "log.csv").read_text() == (other / "log.csv").read_text()
    for name in ("last.pt", "best.pt"):
        mine, its = (load_checkpoint(folder / name) for folder in (one, other))
        assert mine["step"] == its["step"]
        assert mine["history"] == its["history"]
        for part in ("net", "average"):
            assert all(torch.equal(value, its[part][key]) for key, value in mine[part].items())


@pytest.fixture(scope="module")
def done(recipe, tmp_path_factory):
    """A run that nothing disturbed."""
    out = tmp_path_factory.mktemp("done")
    figures = train(changed(recipe, out, covariance="keypoint"))
    return out, figures


def test_a_run_leaves_its_curve_and_its_best(done):
    out, figures = done
    with (out / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["step"]) for row in rows] == [2, 4]
    assert figures == min(load_checkpoint(out / "last.pt")["history"], key=lambda row: row["nll"])
    assert load_checkpoint(out / "best.pt")["history"][-1] == figures
    assert set(rows[0]) == {"step", "loss", "nll", "mean_px", "median_px", "p90_px", "native_mean_px", "far_median_px",
                            "coverage_50", "coverage_68", "coverage_90", "coverage_95", "coverage_99",
                            "present_auroc"}  # fmt: skip
    assert all(np.isfinite(float(value)) for row in rows for value in row.values())


def on_tensorboard(out, name):
    """Steps and values of a curve."""
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = accumulator.EventAccumulator(str(out / "tensorboard")).Reload()
    return [(event.step, event.value) for event in events.Scalars(name)]


def test_tensorboard_has_the_validations(done):
    history = load_checkpoint(done[0] / "last.pt")["history"]
    for name in ("nll", "median_px", "coverage_95", "present_auroc"):
        wanted = [(row["step"], pytest.approx(row[name], rel=1e-6)) for row in history]  # float32 there
        assert on_tensorboard(done[0], name) == wanted


class Killed(BaseException):
    """As a kill, nothing catches it."""


@pytest.mark.parametrize("place", ["before", "after"])
def test_training_resumes_to_the_same_curve_and_weights(recipe, done, tmp_path, monkeypatch, place):
    """Stopped at the first last.pt, before it is written or after: done again or gone on from, the same comes out."""
    recipe = changed(recipe, tmp_path / "run", covariance="keypoint")
    save = Run.save

    def killed(run, name):
        if name != "last.pt" or place == "after":
            save(run, name)
        if name == "last.pt":
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(Run, "save", killed)
        with pytest.raises(Killed):
            train(recipe)
    assert (tmp_path / "run" / "last.pt").exists() == (place == "after")
    train(recipe)
    same_run(tmp_path / "run", done[0])
    before = (tmp_path / "run" / "last.pt").read_bytes()
    assert train(recipe) == done[1]  # and done is done
    assert (tmp_path / "run" / "last.pt").read_bytes() == before


TRAINING = """
import json, sys
from shortfinal.train.fit import leave, train
from shortfinal.train.recipe import Recipe
train(Recipe(**json.loads(sys.argv[1])))
leave()
"""


def command(recipe, *before):
    return [sys.executable, *before, json.dumps(to_dict(recipe))]


@pytest.mark.slow
def test_a_killed_process_goes_on_to_the_same_curve(recipe, tmp_path):
    long = {"steps": 40, "covariance": "full", "workers": 1}
    train(changed(recipe, tmp_path / "whole", **long))
    halves = changed(recipe, tmp_path / "halves", **long)
    with subprocess.Popen(command(halves, "-c", TRAINING), stdout=subprocess.DEVNULL) as process:
        curve, until = tmp_path / "halves" / "log.csv", time.monotonic() + 300
        while process.poll() is None and time.monotonic() < until:
            if curve.exists() and len(curve.read_text().splitlines()) > 3:  # after the third validation
                break
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    history = load_checkpoint(tmp_path / "halves" / "last.pt")["history"]
    assert history[-1]["step"] < 40
    shown = on_tensorboard(tmp_path / "halves", "nll")  # what is on the record was shown
    assert shown[: len(history)] == [(row["step"], pytest.approx(row["nll"], rel=1e-6)) for row in history]
    train(halves)
    same_run(tmp_path / "whole", tmp_path / "halves")


# test_export.py is about what becomes of a checkpoint.


@pytest.mark.parametrize("changes", [{"learning_rate": 0.5}, {"head": "fc"}, {"seed": 3, "size": 96}])
def test_a_run_of_another_recipe_is_not_continued(recipe, done, tmp_path, changes):
    shutil.copytree(done[0], tmp_path / "run")
    with pytest.raises(sf.InputError, match=rf"last\.pt: was made with another covariance, {next(iter(changes))}|"
                                            rf"another .*{next(iter(changes))}.*; choose another --out"):  # fmt: skip
        train(changed(recipe, tmp_path / "run", **changes))
    # Where it lies and how many prepare crops are no part of the result.
    assert train(changed(recipe, tmp_path / "run", covariance="keypoint", workers=2)) == done[1]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a checkpoint: "),
        (b"nonsense", "not a checkpoint: "),
        ([1, 2], "a torch file, but not a checkpoint of shortfinal train"),
        ({"recipe": {}, "net": {}}, "not a complete checkpoint: lacks average, optimizer"),
        ({"recipe": 3}, "not a complete checkpoint: lacks net"),
    ],
)
def test_what_is_no_checkpoint_is_refused(recipe, tmp_path, content, message):
    path = tmp_path / "last.pt"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
    with pytest.raises(sf.InputError, match=rf"last\.pt: {message}") as refusal:
        train(changed(recipe, tmp_path))
    assert "\n" not in str(refusal.value)
    with pytest.raises(sf.InputError, match=rf"last\.pt: {message}"):
        train(changed(recipe, tmp_path / "run", start=str(path)))


def test_a_checkpoint_that_is_not_there_is_refused(recipe, tmp_path):
    with pytest.raises(sf.InputError, match=r"x\.pt: cannot read the checkpoint: No such file"):
        train(changed(recipe, tmp_path / "run", start=str(tmp_path / "x.pt")))


def test_a_run_begins_where_another_ended(recipe, done, tmp_path):
    start = str(done[0] / "best.pt")
    recipe = changed(recipe, tmp_path / "next", covariance="full", steps=1, learning_rate=0.0, start=start)
    train(dataclasses.replace(recipe, covariance="keypoint"))
    was, now = (network_weights(load_checkpoint(path)) for path in (start, tmp_path / "next" / "last.pt"))
    for name, weight in was.items():
        if name.endswith(("running_mean", "running_var", "num_batches_tracked")):
            continue  # they follow the pictures
        torch.testing.assert_close(now[name], weight)


def test_a_run_begins_with_the_network_that_ships(recipe, scenes, tmp_path):
    folders = {name: getattr(recipe, name) for name in ("data", "validation")}
    second = make_recipe("finetune", {**folders, "out": str(tmp_path), "batch": 4, "steps": 1, "workers": 0})
    run = Run(second, 12)
    examples = read_dataset(scenes / "a")
    pictures = torch.stack([fit._Held(examples, second)[n].image for n in range(4)])
    run.begin(lambda: pictures)
    whole, half = sf.PixelWindow(0, 0, 224, 224, 224, 224), pictures[0].permute(1, 2, 0) * 0.25 + 0.5
    picture = (half * 255).round().to(torch.uint8).numpy()
    look = sf.KeypointDetector(calibrated=False).look(picture, whole)
    with torch.inference_mode():
        prediction = run.average.eval()(pictures[:1])
    # Settled batch norms change nothing but the rounding of float32; the picture is of whole grey levels.
    np.testing.assert_allclose(prediction.mean_px[0], look.keypoints.mean_px, atol=0.02)
    np.testing.assert_allclose(prediction.sigma_px[0], look.keypoints.sigma_px, rtol=0.01)
    norms = [m for part in run.net.means for m in part.modules() if isinstance(m, torch.nn.BatchNorm2d)]
    assert all(float((m.running_var - 1).abs().max()) > 1e-3 for m in norms)  # of what they see, so that they may learn
    train(second)
    was, now = (network_weights(load_checkpoint(path)) for path in ("shipped", tmp_path / "last.pt"))
    learned = {name.partition(".")[0] for name in was if not torch.equal(was[name], now[name])}
    assert learned == {"backbone", "neck", "score", "spread", "correlation", "present"}  # the other parts stay


@pytest.mark.parametrize(
    ("changes", "differs"),
    [({"backbone": "test_resnet"}, "backbone"), ({"head": "fc"}, "head"), ({"features": (32,)}, "features"),
     ({"mean": (0.4,) * 3}, "mean"), ({"width": 12}, r"neck\..*"), ({"covariance": "diagonal"}, r"correlation\..*"),
     ({"covariance": "full"}, r"correlation\..*")],
)  # fmt: skip
def test_a_start_of_another_network_is_refused(recipe, done, tmp_path, changes, differs):
    recipe = changed(recipe, tmp_path, start=str(done[0] / "best.pt"), covariance="keypoint")
    with pytest.raises(sf.InputError, match=rf"best\.pt: of another network \({differs} differs\)$"):
        train(dataclasses.replace(recipe, **changes))


def test_a_start_that_lacks_a_weight_is_refused(recipe, done, tmp_path):
    state = load_checkpoint(done[0] / "best.pt")
    del state["average"]["module.present.0.weight"]
    torch.save(state, tmp_path / "x.pt")
    with pytest.raises(sf.InputError, match=r"x\.pt: of another network \(present\.0\.weight differs\)$"):
        train(changed(recipe, tmp_path / "run", start=str(tmp_path / "x.pt"), covariance="keypoint"))


def test_learning_the_covariance_leaves_the_means_as_they_are(recipe, scenes, tmp_path):
    train(changed(recipe, tmp_path / "means", steps=2))
    start = str(tmp_path / "means" / "last.pt")
    second = changed(recipe, tmp_path / "cov", start=start, learn="covariance", covariance="full", steps=3)
    run = Run(second, 12)
    run.begin(lambda: None)
    examples = read_dataset(scenes / "b")
    image = torch.stack([batch.image for batch in map(fit._Held(examples, second).__getitem__, range(6))])
    before = run.average.eval()(image)
    train(second)
    run.resume()
    for network in (run.average.eval(), run.net.eval()):
        after = network(image)
        assert torch.equal(before.mean_px, after.mean_px)
        assert torch.equal(before.attention, after.attention)
        assert (before.sigma_px != after.sigma_px).all()
        assert (before.factor != after.factor).any()


def test_learning_to_search_leaves_the_rest_as_it_is(recipe, scenes, done, tmp_path):
    start = str(done[0] / "best.pt")
    changes = {
        "start": start,
        "learn": "where",
        "covariance": "keypoint",
        "steps": 3,
        "validate_every": 1,
    }
    train(changed(recipe, tmp_path / "where", **changes))
    before, after = (load_checkpoint(path) for path in (start, tmp_path / "where" / "last.pt"))
    old, new = network_weights(before), network_weights(after)
    for name in old:
        assert torch.equal(old[name], new[name]), name
    assert {name.partition(".")[0] for name in set(new) - set(old)} == {"where"}
    figures = after["history"][-1]
    assert figures["median_px"] == before["history"][-1]["median_px"]  # of the corners, as they were
    assert 0 <= figures["where_found"] <= 1
    assert figures["where_loss"] < after["history"][0]["where_loss"]
    again = train(changed(recipe, tmp_path / "where", **changes))  # from its end
    assert again["where_loss"] == min(row["where_loss"] for row in after["history"])


def test_learning_to_look_at_corners_leaves_the_rest_as_it_is(recipe, scenes, done, tmp_path):
    searching = {"start": str(done[0] / "best.pt"), "learn": "where", "covariance": "keypoint"}
    train(changed(recipe, tmp_path / "where", steps=1, **searching))
    start = str(tmp_path / "where" / "last.pt")
    changes = {"start": start, "learn": "corners", "covariance": "keypoint", "steps": 4, "validate_every": 2}
    train(changed(recipe, tmp_path / "corners", **changes))
    before, after = (load_checkpoint(path) for path in (start, tmp_path / "corners" / "last.pt"))
    old, new = network_weights(before), network_weights(after)
    for name in old:  # the search's part too
        assert torch.equal(old[name], new[name]), name
    assert {name.partition(".")[0] for name in set(new) - set(old)} == {"corners"}
    figures = after["history"][-1]
    assert figures["median_px"] == before["history"][-1]["median_px"]  # of the look at all, as it was
    assert 0 <= figures["corner_coverage_68"] <= 1
    again = train(changed(recipe, tmp_path / "corners", **changes))  # from its end
    assert again["corner_nll"] == min(row["corner_nll"] for row in after["history"])
    looking = changed(recipe, tmp_path / "looking", **changes, first_look=str(shipped_model()), weather=False)
    for drawn, looked in zip(fit._Held(read_dataset(scenes / "b"), changed(looking, tmp_path, first_look="")),
                             fit._Held(read_dataset(scenes / "b"), looking)):  # fmt: skip
        assert drawn.image.shape == looked.image.shape == (4, 3, 48, 48)
        if drawn.visible.all() and looked.visible.all():
            assert not torch.equal(drawn.image, looked.image)
    run = Run(changed(recipe, tmp_path / "again", **changes), 12)
    run.begin(lambda: None)
    draws = fit._Draws(read_dataset(scenes / "a"), run.recipe, range(1), 0, 4)
    batch = Batch(*map(torch.stack, zip(*(draws[n] for n in range(4)))))
    losses = []
    for _ in range(20):  # the same corners
        run.step, run.schedule.last_epoch = 3, 0
        losses.append(run.advance(batch))
    assert np.mean(losses[-5:]) < losses[0]


def test_the_average_forgets_as_told(recipe, scenes, tmp_path):
    examples = read_dataset(scenes / "a")
    for decay in (0.0, 0.15, 0.998):
        run = Run(changed(recipe, tmp_path, ema=decay), 12)
        run.begin(lambda: None)
        draws = fit._Draws(examples, recipe, range(4), 0, 4)
        mine = None
        for step in range(4):
            batch = Batch(*map(torch.stack, zip(*(draws[4 * step + n] for n in range(4)))))
            run.advance(batch)
            weight = run.net.score.weight.detach().double()
            # The first is taken as it is; of the n-th, n / (n + 9) of what was kept, at most the recipe's share.
            keep = min(decay, (1 + step) / (10 + step)) if step else 0.0
            mine = weight.clone() if mine is None else keep * mine + (1 - keep) * weight
            torch.testing.assert_close(run.average.module.score.weight.double(), mine, rtol=1e-5, atol=1e-8)
        if decay == 0:
            assert torch.equal(run.average.module.score.weight, run.net.score.weight)


def test_epochs_are_passes_over_the_data(recipe, tmp_path):
    assert Run(changed(recipe, tmp_path, epochs=30.0), 12).steps == 90
    assert Run(changed(recipe, tmp_path, epochs=0.1), 12).steps == 1
    assert Run(changed(recipe, tmp_path), 12).steps == 4


@pytest.mark.parametrize("precision", ["bf16-mixed", "16-mixed"])
@pytest.mark.filterwarnings("ignore:.*not supported on CPU")
def test_mixed_precision_stays_finite(recipe, tmp_path, precision):
    figures = train(changed(recipe, tmp_path, precision=precision))
    assert all(np.isfinite(value) for value in figures.values())
    assert train(changed(recipe, tmp_path, precision=precision)) == figures


@pytest.mark.parametrize("changes", [{"likelihood": "beta"}, {"likelihood": "published", "optimizer": "rmsprop"},
                                     {"head": "fc", "optimizer": "adam", "schedule": "constant"},
                                     {"crop": "native", "weather": False, "epochs": 0.4}])  # fmt: skip
def test_every_choice_trains(recipe, tmp_path, changes):
    run = Run(changed(recipe, tmp_path, **changes), 12)
    batches = fit._Draws(read_dataset(recipe.data[0]), run.recipe, range(30), 0, 4)
    batch = Batch(*map(torch.stack, zip(*(batches[n] for n in range(4)))))
    losses = []
    for _ in range(30):  # the same pictures: whatever the loss, it must fall
        run.step = 3  # past the first tenth
        run.schedule.last_epoch = 0
        losses.append(run.advance(batch))
    assert np.mean(losses[-5:]) < losses[0]


def test_a_loss_that_is_not_finite_ends_the_run(recipe, tmp_path, monkeypatch):
    monkeypatch.setattr(fit, "gaussian_nll", lambda error, *rest: error.sum(dim=(1, 2)) * np.nan)
    with pytest.raises(JobError, match=r"^diverged at step 1; lower the learning rate$"):
        train(changed(recipe, tmp_path))


def test_weights_that_are_not_finite_end_the_run(recipe, tmp_path):
    """Those of the last step before a validation show there."""
    run = Run(changed(recipe, tmp_path), 12)
    run.begin(lambda: None)
    with torch.no_grad():
        run.average.module.score.weight[0, 0] = np.nan
    with pytest.raises(JobError, match=r"^diverged at step 0; lower the learning rate$"):
        fit._validate(run, read_dataset(recipe.validation[0]))


@pytest.mark.parametrize("workers", [0, 1])
def test_a_broken_picture_is_one_line_whoever_reads_it(recipe, tmp_path, workers):
    write_dataset(tmp_path / "a", 1, seed=5)
    (tmp_path / "a" / "images" / "000000.png").write_bytes(b"no picture")
    with pytest.raises(sf.InputError, match=r"^[^\n]*000000\.png: cannot be read as an image$") as refusal:
        train(changed(recipe, tmp_path / "run", data=(str(tmp_path / "a"),), workers=workers))
    assert str(refusal.value).startswith(str(tmp_path))


@pytest.mark.slow
@pytest.mark.skipif(not FOLDED.is_file(), reason="shared/data is not here: no pretrained MobileNetV2")
def test_a_run_begins_from_pretrained_weights_settled_on_its_pictures(recipe, tmp_path):
    pretrained = changed(recipe, tmp_path, backbone="mobilenetv2_100", weights=str(FOLDED), steps=1, batch=2,
                         mean=(0.5,) * 3, std=(0.5,) * 3, features=(8,), learning_rate=0.0)  # fmt: skip
    train(pretrained)
    net = network_weights(load_checkpoint(tmp_path / "last.pt"))
    with np.load(FOLDED) as content:
        np.testing.assert_array_equal(net["backbone.conv_stem.weight"],
                                      content["000_CONV_2D_s2_act3_w"].transpose(0, 3, 1, 2))  # fmt: skip
    assert (net["backbone.bn1.running_var"] != 1).all()
    with pytest.raises(sf.InputError, match=r"npz: needs mean = \[0\.5, 0\.5, 0\.5\] and std = \[0\.5, 0\.5, 0\.5\]"):
        train(dataclasses.replace(pretrained, out=str(tmp_path / "other"), std=(0.25,) * 3))


def test_a_backbone_that_cannot_be_had_is_one_line(recipe, tmp_path, monkeypatch):
    with pytest.raises(sf.InputError, match=r"^backbone: 'test_vit' with size 72: \S[^\n]*$"):
        train(changed(recipe, tmp_path, backbone="test_vit", features=(16,), size=72))

    def offline(*args, pretrained=False, **options):
        raise ConnectionError(f"no way to the hub\nsecond line, {pretrained}")

    monkeypatch.setattr(fit, "KeypointNet", offline)
    with pytest.raises(sf.InputError, match=r"^backbone: 'resnet18' with weights = timm: no way to the hub$"):
        train(changed(recipe, tmp_path, backbone="resnet18", weights="timm"))


# Several processes.


def test_a_batch_that_cannot_be_shared_is_refused(recipe, tmp_path, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "3")
    with pytest.raises(sf.InputError, match=r"^batch: 4 pictures cannot be shared evenly by 3 processes$"):
        Run(changed(recipe, tmp_path), 12)


@pytest.mark.slow
def test_two_processes_train_as_one(recipe, tmp_path):
    """Over gloo, on this machine, as torchrun starts them; with group norm, which does not depend on the batch."""
    alone = changed(recipe, tmp_path / "one", backbone="test_efficientnet_gn", features=(32,), steps=6,
                    covariance="full", learning_rate=1e-3)  # fmt: skip
    train(alone)
    both = dataclasses.replace(alone, out=str(tmp_path / "two"))
    script = tmp_path / "training.py"
    script.write_text(TRAINING)
    launch = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", str(script))
    made = subprocess.run(command(both, *launch), capture_output=True, text=True, timeout=500,
                          env=os.environ | {"OMP_NUM_THREADS": "1"})  # fmt: skip
    assert made.returncode == 0, made.stderr[-2000:]
    one, two = (load_checkpoint(tmp_path / name / "last.pt") for name in ("one", "two"))
    assert two["step"] == 6
    # The gradient is the mean of two halves instead of one of the whole: float32's 6e-8 of it, which Adam's six
    # steps may make some ten times as much. (One weight has no effect, and its gradient is nothing but rounding:
    # the bias of the map that the softmax is taken of.)
    first = Run(dataclasses.replace(alone, out=str(tmp_path / "none")), 12).net.state_dict()
    names = [name for name in first if name != "score.bias"]
    apart = sum(float((one["net"][name] - two["net"][name]).square().sum()) for name in names) ** 0.5
    gone = sum(float((one["net"][name] - first[name]).square().sum()) for name in names) ** 0.5
    assert gone > 1e-2
    assert apart < 3e-5 * gone
    for row, other in zip(one["history"], two["history"], strict=True):
        assert row["loss"] == pytest.approx(other["loss"], rel=1e-5)
        assert row["nll"] == pytest.approx(other["nll"], rel=1e-5)
