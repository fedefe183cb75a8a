"""The command that makes the paper's Table 1 again: its table, how it goes on, and what it refuses."""

import json
import os

import cv2
import numpy as np
import pytest

import shortfinal as sf
from shortfinal.data.formats import CORNER_COLUMNS
from shortfinal.errors import JobError
from shortfinal.files import csv_text

torch = pytest.importorskip("torch")

from shortfinal.train import fit, reproduce  # noqa: E402
from shortfinal.train.fit import load_checkpoint  # noqa: E402
from shortfinal.train.reproduce import CELLS, markdown, reproduce_table1  # noqa: E402

# Eight of the ten pictures are trained on: at batches of four, an epoch is two steps.
TINY = {"backbone": "test_resnet", "weights": "", "size": 64, "batch": 4, "validate_every": 1, "workers": 0}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Ten light runways on dark ground, each at an airport of its own."""
    folder, rng, rows = tmp_path_factory.mktemp("data"), np.random.default_rng(3), []
    for number in range(10):
        corners = [[16.0, 50], [44, 50], [34, 14], [28, 14]] + rng.uniform(-4, 4, (4, 2))
        picture = rng.integers(40, 80, (64, 64, 3)).astype(np.uint8)
        cv2.fillPoly(picture, [np.round(corners).astype(np.int32)], (210, 210, 210))
        cv2.imwrite(str(folder / f"{number}.png"), picture)
        rows.append({"image": f"{number}.png", "ident": f"A{number}/09"} | dict(zip(CORNER_COLUMNS, corners.ravel())))
    (folder / "labels.csv").write_text(csv_text(rows[0], rows))
    return str(folder)


@pytest.fixture(scope="module")
def made(data, tmp_path_factory):
    """One pair and one cell of another, trained for two steps each."""
    out = tmp_path_factory.mktemp("table")
    return out, reproduce_table1([data], out, models=["resnet18", "efficientnet_b5-sam"], epochs=1, changes=TINY)


def test_the_table_has_six_rows_and_figures_only_of_what_was_trained(made):
    out, content = made
    assert json.loads((out / "table1.json").read_text()) == content
    rows = {(row["model"].split()[0], row["head"]): row for row in content["rows"]}
    assert [row["published_mean_px"] for row in content["rows"]] == [1.46, 0.80, 2.50, 0.65, 10.59, 0.50]
    trained = [key for key, row in rows.items() if row["state"] == "trained"]
    assert trained == [("ResNet-18", "FC"), ("ResNet-18", "SAM"), ("EfficientNet-B5", "SAM")]
    for key, row in rows.items():
        figures = [row[name] for name in ("mean_px", "nll", "sigma_ratio", "coverage_68", "steps", "minutes")]
        assert [f is not None for f in figures] == [key in trained] * len(figures)
    lines = [line for line in (out / "table1.md").read_text().splitlines() if line.startswith("|")]
    assert len(lines) == 8
    assert all(line.count("|") == 13 for line in lines)
    assert sum("| not trained |" in line for line in lines) == 3
    assert (out / "table1.png").read_bytes().startswith(b"\x89PNG")


def test_the_table_says_what_the_cells_were(made):
    _, content = made
    text = markdown(content)
    assert "ResNet-18 (as test_resnet) | FC | 1.46" in text
    assert "Began from random weights" in text
    assert "8 pictures; held out by airport: 2" in text
    assert "size = 64" in text  # what --set changed
    assert "likelihood" not in text.split("Changed by --set")[1]


def test_a_pair_is_trained_alike(made):
    out, content = made
    fc, sam = (load_checkpoint(out / f"resnet18-{head}" / "last.pt") for head in ("fc", "sam"))
    differ = {name for name in fc["recipe"] if fc["recipe"][name] != sam["recipe"][name]}
    assert differ == {"head", "out"}
    assert fc["recipe"]["likelihood"] == "half"
    assert fc["step"] == sam["step"] == content["rows"][0]["steps"] == 2
    other = load_checkpoint(out / "efficientnet_b5-sam" / "last.pt")["recipe"]
    assert (fc["recipe"]["optimizer"], other["optimizer"]) == ("adam", "rmsprop")  # the paper's


def test_figures_are_those_of_the_best_checkpoint(made):
    # Every validation saw all held-out pictures, so the table's figures are the best row of the history.
    out, content = made
    history = load_checkpoint(out / "resnet18-sam" / "last.pt")["history"]
    best, row = min(history, key=lambda figures: figures["nll"]), content["rows"][1]
    assert row["best_step"] == best["step"]
    for name in ("mean_px", "median_px", "nll", "coverage_68", "coverage_95"):
        assert row[name] == pytest.approx(best[name], rel=1e-3)
    assert 0 < row["minutes"] < 10


def test_what_is_finished_is_not_trained_again(made, data, monkeypatch):
    out, content = made
    monkeypatch.setattr(reproduce, "train", lambda *_: pytest.fail("trained again"))
    again = reproduce_table1([data], out, models=["resnet18-fc"], epochs=1, changes=TINY)
    assert again == content  # the cells that were not asked for are still in it


def test_a_stopped_cell_goes_on_where_it_was(made, data, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        from shortfinal.train import fit

        save = fit.Run.save

        def killed(run, name):
            save(run, name)
            if name == "last.pt":
                raise KeyboardInterrupt

        patch.setattr(fit.Run, "save", killed)
        with pytest.raises(KeyboardInterrupt):
            reproduce_table1([data], tmp_path, models=["resnet18-sam"], epochs=1, changes=TINY)
    other = reproduce_table1([data], tmp_path, models=["resnet18-fc"], epochs=1, changes=TINY)
    assert [row["state"] for row in other["rows"][:3]] == ["trained", "not finished", "not trained"]
    content = reproduce_table1([data], tmp_path, models=["resnet18-sam"], epochs=1, changes=TINY)
    whole, halves = (load_checkpoint(out / "resnet18-sam" / "last.pt") for out in (made[0], tmp_path))
    assert halves["step"] == whole["step"] == content["rows"][1]["steps"]
    for name, weight in whole["net"].items():
        torch.testing.assert_close(weight, halves["net"][name], rtol=1e-4, atol=1e-5)


def test_minutes_are_those_of_the_steps_that_were_kept(tmp_path):
    # Sessions of two and three minutes; then one that was killed before its first checkpoint.
    folder, last = tmp_path, tmp_path / "last.pt"
    for minutes, total in ((2, 2), (3, 5), (None, 5)):
        reproduce._minutes(folder)
        if minutes:
            last.touch()
            since = json.loads((folder / "minutes.json").read_text())["since"]
            os.utime(last, (since + 60 * minutes,) * 2)
        assert reproduce._minutes(folder) == pytest.approx(total)
        os.utime(last, (0, 0))  # long before the next session


def test_one_training_that_fails_stops_no_other(data, tmp_path, monkeypatch):
    train = reproduce.train

    def diverging(recipe, console):
        if recipe.head == "fc":
            raise JobError("diverged at step 1")
        return train(recipe, console)

    monkeypatch.setattr(reproduce, "train", diverging)
    with pytest.raises(JobError, match=r"^resnet18-fc: diverged at step 1$"):
        reproduce_table1([data], tmp_path, models=["resnet18"], epochs=1, changes=TINY)
    rows = json.loads((tmp_path / "table1.json").read_text())["rows"]
    assert [row["state"] for row in rows[:2]] == ["failed: diverged at step 1", "trained"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"models": ["resnet34"]}, r"^--models: 'resnet34'; expected some of resnet18, resnet18-fc, [^\n]*$"),
        ({"changes": TINY | {"head": "sam"}}, r"^--set head: [^\n]*--models$"),
        ({"changes": TINY | {"out": "x"}}, "^--set out: use --out$"),
        ({"changes": TINY | {"steps": 5}}, r"^--set steps: [^\n]*--epochs 0 too$"),
        ({"changes": TINY | {"bacth": 4}}, "^bacth: no such field; did you mean batch"),
        ({"changes": TINY | {"learning_rate": 0.1}}, r"cell\.json: was made with another learning_rate; "),
    ],
)
def test_what_is_of_no_use_is_refused_in_one_line(made, data, arguments, message):
    out, _ = made
    before = (out / "table1.json").read_bytes()
    given = {"models": ["resnet50"], "epochs": 1, "changes": TINY} | arguments
    with pytest.raises(sf.InputError, match=message) as refusal:
        reproduce_table1([data], out, **given)
    assert "\n" not in str(refusal.value)
    assert (out / "table1.json").read_bytes() == before


def test_data_and_backbones_are_looked_at_before_anything_is_written(data, tmp_path):
    with pytest.raises(sf.InputError, match=r"^backbone: 'nonsense': Unknown model"):
        reproduce_table1([data], tmp_path / "out", changes=TINY | {"backbone": "nonsense"})
    with pytest.raises(sf.InputError, match=r"nowhere: no such folder"):
        reproduce_table1([str(tmp_path / "nowhere")], tmp_path / "out", changes=TINY)
    assert not (tmp_path / "out").exists()


def test_weights_that_cannot_be_had_are_named_before_anything_is_trained(data, tmp_path, monkeypatch):
    def offline(*_, pretrained=False, **__):
        raise ConnectionError("no route to the hub\nmore of it")

    monkeypatch.setattr(fit, "KeypointNet", offline)
    with pytest.raises(
        sf.InputError, match=r"^weights: timm's of 'resnet18' [^\n]*no route to the hub\)[^\n]*weights=$"
    ):
        reproduce_table1([data], tmp_path, changes=TINY | {"backbone": "resnet18", "weights": "timm"})


def test_each_backbone_may_have_its_own_file_of_weights(data, tmp_path):
    recipes = [reproduce._recipe(cell, [data], [], tmp_path, {"weights": "w/{backbone}.pth"}) for cell in CELLS]
    assert [recipe.weights for recipe in recipes[1::2]] == ["w/resnet18.pth", "w/resnet50.pth", "w/efficientnet_b5.pth"]
