import dataclasses

import pytest

import shortfinal as sf

pytest.importorskip("torch")

from shortfinal.train.recipe import PRESETS, Recipe, make_recipe, parse_change, read_recipe, to_dict

DATA = {"data": "scenes"}


def test_a_file_a_preset_and_changes_in_this_order(tmp_path):
    path = tmp_path / "recipe.toml"
    path.write_text(
        'preset = "paper-resnet"\ndata = ["a", "b"]\nvalidation = "c"\nepochs = 2\nseed = 7\nfeatures = [16, 32]\n'
    )
    recipe = read_recipe(path, {"seed": 8, "weights": "x.pt"})
    assert (recipe.data, recipe.validation) == (("a", "b"), ("c",))
    assert (recipe.backbone, recipe.optimizer, recipe.learning_rate) == ("resnet18", "adam", 5e-4)
    assert (recipe.epochs, recipe.features) == (2.0, (16, 32))
    assert (recipe.seed, recipe.weights) == (8, "x.pt")
    assert recipe.out == "runs/latest"


def test_the_presets_are_the_papers():
    """arXiv 2508.09732: 30 epochs, the loss as printed, deepest features only, no schedule; two optimisers."""
    assert set(PRESETS) == {"default", "finetune", "large", "paper-resnet", "paper-efficientnet"}
    resnet, efficientnet = (make_recipe(f"paper-{name}", DATA) for name in ("resnet", "efficientnet"))
    assert (efficientnet.optimizer, efficientnet.learning_rate) == ("rmsprop", 1e-4)
    for recipe in (resnet, efficientnet):
        assert (recipe.epochs, recipe.schedule, recipe.warm_up, recipe.ema) == (30, "constant", 0, 0)
        assert (recipe.likelihood, recipe.attention_weight, recipe.covariance) == ("published", 0, "diagonal")
        assert (recipe.features, recipe.crop, recipe.weather, recipe.head) == ((32,), "native", False, "sam")
    assert make_recipe("default", DATA) == Recipe(("scenes",))


def test_plain_values_make_the_same_recipe():
    recipe = make_recipe("paper-efficientnet", DATA)
    values = to_dict(recipe)
    assert all(isinstance(value, (str, int, float, bool, list)) for value in values.values())
    assert Recipe(**values) == recipe
    assert list(values) == [field.name for field in dataclasses.fields(Recipe)]


# What is damaged, and what the one line must say.
DAMAGE = [
    ({"lerning_rate": 1}, "lerning_rate: no such field; did you mean learning_rate?"),
    ({"back-bone": "x"}, "back-bone: no such field; did you mean backbone?"),
    ({"zzz": 1}, "zzz: no such field"),
    ({"data": []}, "data: missing; the folder, or folders, to train on"),
    ({"data": 3}, "data: 3; expected a list"),
    ({"data": [3]}, "data: 3; expected a text"),
    ({"steps": "many"}, "steps: 'many'; expected a whole number from 0 to 1e+09"),
    ({"steps": 2.5}, "steps: 2.5; expected a whole number"),
    ({"steps": True}, "steps: True; expected a whole number"),
    ({"steps": 0}, "steps: at least one step, or epochs, is needed"),
    ({"batch": 1}, "batch: 1; expected a whole number from 2 to 1e+06"),
    ({"size": 16}, "size: 16; expected a whole number from 32 to 4096"),
    ({"learning_rate": float("nan")}, "learning_rate: nan; expected a number from 0 to 100"),
    ({"learning_rate": -1}, "learning_rate: -1; expected a number from 0 to 100"),
    ({"ema": float("inf")}, "ema: inf; expected a number from 0 to 1"),
    ({"warm_up": 1.5}, "warm_up: 1.5; expected a number from 0 to 1"),
    ({"weather": "yes"}, "weather: 'yes'; expected true or false"),
    ({"backbone": 18}, "backbone: 18; expected a text"),
    ({"head": "soft"}, "head: 'soft'; expected one of sam, fc"),
    ({"covariance": "none"}, "covariance: 'none'; expected one of diagonal, keypoint, full"),
    ({"likelihood": "gauss"}, "likelihood: 'gauss'; expected one of half, published, beta"),
    ({"optimizer": "sgd"}, "optimizer: 'sgd'; expected one of adamw, adam, rmsprop"),
    ({"crop": "bogo"}, "crop: 'bogo'; expected one of framed, native"),
    ({"precision": "16"}, "precision: '16'; expected one of 32-true, bf16-mixed, 16-mixed"),
    ({"crop": ["framed"]}, "crop: ['framed']; expected one of framed, native"),
    ({"features": "4"}, "features: '4'; expected a whole number"),
    ({"features": 4}, "features: 4; expected a list"),
    ({"mean": [0.5, 0.5]}, "mean: 2 numbers; expected three, of red, green, blue"),
    ({"std": [0.2, 0.2, 0.0]}, "std: 0.0; expected numbers above 0"),
    ({"keypoints": ["near-left"]}, "keypoints: near-left; expected near-left, near-right, far-right, far-left, then"),
    ({"keypoints": [*sf.CORNER_NAMES, "near-left"]}, "keypoints: near-left, near-right, far-right, far-left, near-l"),
    ({"likelihood": "beta", "covariance": "full"}, "likelihood: beta weighs coordinates one by one"),
    ({"learn": "covariance"}, "learn: covariance needs start, a network"),
    ({"learn": "where"}, "learn: where needs start, a network"),
    ({"first_look": "m.onnx"}, "first_look: only learn = corners begins from one"),
    ({"crop": "tile"}, "crop: 'tile'; expected one of framed, native"),
]


@pytest.mark.parametrize(("changes", "message"), DAMAGE, ids=[message[:40] for _, message in DAMAGE])
def test_damage_is_one_line_that_names_the_field(changes, message):
    with pytest.raises(sf.InputError) as refusal:
        make_recipe("default", DATA | changes)
    assert str(refusal.value).startswith(message)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot read the recipe: No such file or directory"),
        (b"data = ", "not a TOML file: "),
        (b"data = 'a'\ndata = 'b'", "not a TOML file: "),
        (b"\xff\xfe\x00", "not a TOML file: "),
        (b"x = " + b"[" * 3000, "not a TOML file: "),
        (b"seed = 3", "data: missing; the folder, or folders, to train on"),
        (b"preset = 'paper'\ndata = 'a'", "preset: 'paper'; expected one of default, finetune, large, paper-"),
        (b"data = 'a'\n[network]\nwidth = 3", "network: no such field"),
        (b"data = 'a'\nwidth = 0", "width: 0; expected a whole number from 1 to 4096"),
    ],
)
def test_a_file_of_no_use_is_named(tmp_path, content, message):
    path = tmp_path / "recipe.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(sf.InputError) as refusal:
        read_recipe(path)
    assert str(refusal.value).startswith(f"{path}: {message}")
    assert "\n" not in str(refusal.value)
    with pytest.raises(sf.InputError, match="cannot read the recipe: Is a directory"):
        read_recipe(tmp_path)


@pytest.mark.parametrize(
    ("text", "change"),
    [
        ("steps=20000", ("steps", 20000)),
        (" steps = 20_000 ", ("steps", 20000)),
        ("features=[8, 16]", ("features", [8, 16])),
        ("learning_rate=1e-3", ("learning_rate", 1e-3)),
        ("weather=false", ("weather", False)),
        ("backbone=resnet18", ("backbone", "resnet18")),
        ('backbone="resnet18"', ("backbone", "resnet18")),
        ("weights=a=b.pt", ("weights", "a=b.pt")),
        ("out=runs/my run", ("out", "runs/my run")),
        ("weights=", ("weights", "")),
    ],
)
def test_a_change_is_a_field_and_a_value(text, change):
    assert parse_change(text) == change


@pytest.mark.parametrize("text", ["steps", "", "=3", " = 3"])
def test_a_change_without_field_or_value_is_refused(text):
    with pytest.raises(sf.InputError, match=rf"^--set {text}: expected field=value$"):
        parse_change(text)
