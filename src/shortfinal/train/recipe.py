"""Recipes: all that a training's result depends on, as a dataclass, in a TOML file, and as presets."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

from shortfinal.crops import Crop
from shortfinal.errors import InputError
from shortfinal.files import read_toml
from shortfinal.keypoints import CORNER_NAMES
from shortfinal.train.loss import Likelihood
from shortfinal.train.model import Covariance, Head

Framing = Literal["framed", "native"]
Optimizer = Literal["adamw", "adam", "rmsprop"]
Schedule = Literal["cosine", "constant"]
Learn = Literal["all", "covariance", "where", "corners"]
Precision = Literal["32-true", "bf16-mixed", "16-mixed"]


@dataclass(frozen=True)
class Recipe:
    """How to train. Raises InputError, naming the field, for a value of no use."""

    data: tuple[str, ...]  # folders of the training pictures
    validation: tuple[str, ...] = ()  # of the held-out ones; none: their split, or a fifth of the data's airports
    out: str = "runs/latest"  # folder of the checkpoints
    share_airports: bool = False  # let training and validation have airports in common
    # network
    backbone: str = "mobilenetv4_conv_small"  # any timm model with features_only
    weights: str = ""  # "timm": its pretrained ones; or a file of them
    head: Head = "sam"
    covariance: Covariance = "diagonal"
    features: tuple[int, ...] = (4, 8, 16, 32)  # strides
    width: int = 48  # channels of the fused map
    keypoints: tuple[str, ...] = CORNER_NAMES
    mean: tuple[float, ...] = (0.5, 0.5, 0.5)  # of RGB / 255
    std: tuple[float, ...] = (0.25, 0.25, 0.25)
    # pictures
    size: int = 224  # side of the crop, px
    # Of random scale around the runway, as the pipeline looks; "native": as the paper's.
    crop: Framing = "framed"
    margin: float = 1.4  # of the framed crop in evaluation; training draws its own (crops.random_margin)
    weather: bool = True  # augment: another camera in other weather
    # loss
    start: str = ""  # a checkpoint, or a model file in fp32 ("shipped": the package's), whose network to begin from
    # "covariance": backbone and means stay as they are, on pictures they were not trained on; "where": all but the
    # search's part, which a network that has none gets; "corners": all but the part that looks at each corner.
    learn: Learn = "all"
    first_look: str = ""  # of "corners": the model file that looks first, as in use; none: looks are drawn
    likelihood: Likelihood = "half"
    warm_up: float = 0.1  # share of the steps in which the means learn without the variances
    attention_weight: float = 0.3  # of the loss that tells the attention where the corner is; 0: none, as published
    scope_weight: float = 0.3  # of the loss of visibility and presence
    # steps
    epochs: float = 0.0  # passes over the data; 0: as many `steps`
    steps: int = 10000
    batch: int = 32  # pictures a step, of all processes together; a batch norm sees those of its own process
    optimizer: Optimizer = "adamw"
    schedule: Schedule = "cosine"  # after a linear rise over the first 3 %
    learning_rate: float = 2e-3
    weight_decay: float = 0.02
    ema: float = 0.998
    precision: Precision = "32-true"
    validate_every: int = 500  # steps
    validation_count: int = 1000
    workers: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        for field in fields(self):
            object.__setattr__(self, field.name, _checked(field.name, str(field.type), getattr(self, field.name)))
        if not self.data:
            raise InputError(f"data: {_NO_DATA}")
        if self.keypoints[:4] != CORNER_NAMES or len(set(self.keypoints)) < len(self.keypoints):
            raise InputError(f"keypoints: {', '.join(self.keypoints)}; expected {', '.join(CORNER_NAMES)}, then others")
        for name in ("mean", "std"):
            if len(getattr(self, name)) != 3:
                raise InputError(f"{name}: {len(getattr(self, name))} numbers; expected three, of red, green, blue")
        if min(self.std) <= 0:
            raise InputError(f"std: {min(self.std)}; expected numbers above 0")
        if self.epochs == 0 and self.steps < 1:
            raise InputError("steps: at least one step, or epochs, is needed")
        if self.likelihood == "beta" and self.covariance != "diagonal":
            raise InputError(f"likelihood: beta weighs coordinates one by one; covariance {self.covariance} has more")
        if self.learn != "all" and not self.start:
            raise InputError(f"learn: {self.learn} needs start, a network whose other parts are kept")
        if self.first_look and self.learn != "corners":
            raise InputError("first_look: only learn = corners begins from one")

    @property
    def cut(self) -> Crop:
        """How pictures are cut: as `crop` says, or as the search looks at them, to learn where runways are."""
        return "tile" if self.learn == "where" else self.crop


# The paper's: 30 epochs, 80/20, Adam 5e-4 for ResNets, RMSProp 1e-4 for EfficientNet (arXiv 2508.09732).
_PAPER: dict[str, Any] = {
    "crop": "native", "features": (32,), "weather": False, "warm_up": 0.0, "attention_weight": 0.0, "epochs": 30.0,
    "schedule": "constant", "weight_decay": 0.0, "ema": 0.0, "mean": (0.485, 0.456, 0.406),
    "std": (0.229, 0.224, 0.225), "likelihood": "published", "weights": "timm",
}  # fmt: skip
PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    # On pictures of one's own, from the network that ships; or one several times as large, from nothing.
    "finetune": {"start": "shipped", "covariance": "full", "learning_rate": 3e-4, "steps": 2000, "warm_up": 0.0},
    "large": {"backbone": "mobilenetv4_conv_medium", "width": 96, "covariance": "full", "steps": 60000},
    "paper-resnet": {**_PAPER, "backbone": "resnet18", "optimizer": "adam", "learning_rate": 5e-4},
    "paper-efficientnet": {**_PAPER, "backbone": "efficientnet_b5", "optimizer": "rmsprop", "learning_rate": 1e-4},
}


_NO_DATA = "missing; the folder, or folders, to train on"


def read_recipe(path: str | Path, changes: Mapping[str, Any] | None = None) -> Recipe:
    """A recipe from a TOML file: `preset` (one of PRESETS), and any field of Recipe; `changes` go before both.

    Raises InputError naming the file and the field for what is missing, unknown or of no use.
    """
    content = read_toml(path, "recipe")
    try:
        return make_recipe(str(content.pop("preset", "default")), {**content, **(changes or {})})
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def make_recipe(preset: str, changes: Mapping[str, Any]) -> Recipe:
    """A preset with changes. Raises InputError naming the field."""
    if preset not in PRESETS:
        raise InputError(f"preset: {preset!r}; expected one of {', '.join(PRESETS)}")
    values = {**PRESETS[preset], **changes}
    known = [field.name for field in fields(Recipe)]
    for name in values:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            raise InputError(f"{name}: no such field" + (f"; did you mean {near[0]}?" if near else ""))
    if "data" not in values:
        raise InputError(f"data: {_NO_DATA}")
    return Recipe(**values)


def parse_change(text: str) -> tuple[str, Any]:
    """A field and its value, "steps=20000" or "features=[8, 16]"; what is not TOML is a text."""
    name, equals, value = (part.strip() for part in text.partition("="))
    if not (name and equals):
        raise InputError(f"--set {text}: expected field=value")
    try:
        return name, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return name, value


def to_dict(recipe: Recipe) -> dict[str, Any]:
    """Plain values, tuples as lists, for a checkpoint."""
    return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(recipe).items()}


_RANGES: dict[str, tuple[float, float]] = {
    "width": (1, 4096), "size": (32, 4096), "margin": (1.0, 10.0), "warm_up": (0.0, 1.0), "batch": (2, 1_000_000),
    "learning_rate": (0.0, 100.0), "weight_decay": (0.0, 100.0), "ema": (0.0, 1.0), "validate_every": (1, 10**9),
    "validation_count": (1, 10**9), "workers": (0, 1024), "seed": (0, 2**31), "epochs": (0.0, 1e6), "steps": (0, 10**9),
    "attention_weight": (0.0, 1e3), "scope_weight": (0.0, 1e3),
}  # fmt: skip
_CHOICES = {
    "Head": Head, "Covariance": Covariance, "Framing": Framing, "Likelihood": Likelihood, "Optimizer": Optimizer,
    "Schedule": Schedule, "Learn": Learn, "Precision": Precision,
}  # fmt: skip
_NUMBERS: dict[str, Any] = {"int": int, "float": (int, float)}


def _checked(name: str, kind: str, value: Any) -> Any:
    """The value as the field's type has it; raises InputError if it cannot be."""
    if kind.startswith("tuple["):
        values = (value,) if isinstance(value, str) else value
        if not isinstance(values, (list, tuple)):
            raise InputError(f"{name}: {value!r}; expected a list")
        item = kind.removeprefix("tuple[").split(",")[0]
        return tuple(_checked(name, item, one) for one in values)
    if kind in _CHOICES:
        if value not in get_args(_CHOICES[kind]):
            raise InputError(f"{name}: {value!r}; expected one of {', '.join(get_args(_CHOICES[kind]))}")
        return value
    if kind in _NUMBERS:
        low, high = _RANGES.get(name, (-1e9, 1e9))
        if not isinstance(value, _NUMBERS[kind]) or isinstance(value, bool) or not low <= value <= high:
            whole = "a whole number" if kind == "int" else "a number"
            raise InputError(f"{name}: {value!r}; expected {whole} from {low:g} to {high:g}")
        return value if kind == "int" else float(value)
    if not isinstance(value, {"str": str, "bool": bool}[kind]):
        raise InputError(f"{name}: {value!r}; expected {'a text' if kind == 'str' else 'true or false'}")
    return value
