"""`shortfinal train`: fit a KeypointNet to labelled pictures, on one process or many; goes on after a stop."""

from __future__ import annotations

import io
import math
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, fields
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from lightning.fabric import Fabric
from lightning.fabric.loggers.tensorboard import TensorBoardLogger
from numpy.typing import ArrayLike
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor
from torch.optim.swa_utils import AveragedModel
from torch.utils.data import DataLoader, Dataset

from shortfinal.calibration import LEVELS, coverage
from shortfinal.crops import PATCH_PX, box_around, centre_crop, native_crop, search_crop
from shortfinal.data.augment import augmented_crop, corner_looks, inside, within
from shortfinal.data.dataset import Example, LabelledDataset, read_dataset
from shortfinal.data.formats import split_by_airport
from shortfinal.detector import KeypointDetector, crop_image, normalise, shipped_model
from shortfinal.errors import InputError, JobError
from shortfinal.files import csv_text, make_folder, write_whole
from shortfinal.geometry import PixelWindow
from shortfinal.train.loss import attention_loss, gaussian_nll, scope_loss, where_loss
from shortfinal.train.model import KeypointNet, Prediction
from shortfinal.train.recipe import Recipe, to_dict
from shortfinal.train.weights import (
    FOLDED_MEAN,
    FOLDED_STD,
    first_line,
    fold_back,
    load_weights,
    read_model,
    reading,
    settle_batch_norm,
)

PARTS = ("where", "corners")  # of a network that learns them last, all else as it is
_RISE = 0.03  # share of the steps in which the learning rate rises


class Batch(NamedTuple):
    """Crops, where their corners are, and how much they were enlarged; or patches, of one corner each."""

    image: Tensor  # (B, 3, S, S), or (B, 4, 3, P, P)
    corners_px: Tensor  # (B, K, 2); anything where not visible
    visible: Tensor  # (B, K) 0 or 1: labelled, and in the picture and the crop
    box_px: Tensor  # (B, 4) left, top, right, bottom around the corners, also beyond the crop; NaN: not in the picture
    scale: Tensor  # (B,) pixels of the crop per pixel of the picture; or (B, 4), of each patch

    def to(self, device: Any) -> Batch:
        """On another device, crops with their channels last."""
        return Batch(_channels_last(self.image.to(device)), *(part.to(device) for part in self[1:]))


class _Draws(Dataset[Batch]):
    """The crops that one process trains on: number n of the run is a function of the seed and n, so that
    resuming is exact, and as many processes as there may be draw the same together.
    """

    def __init__(self, examples: LabelledDataset, recipe: Recipe, steps: range, rank: int, share: int) -> None:
        self.examples, self.recipe, self.steps, self.rank, self.share = examples, recipe, steps, rank, share
        self._turn, self._order = -1, np.empty(0, int)
        self._first = _FirstLook(recipe)

    def __len__(self) -> int:
        return len(self.steps) * self.share

    def __getitem__(self, index: int) -> Batch:
        step, place = divmod(index, self.share)
        recipe = self.recipe
        number = self.steps[step] * recipe.batch + self.rank * self.share + place
        rng = np.random.default_rng([recipe.seed, 1, number])
        example = self.examples[self._pick(number)]
        if recipe.learn == "corners":
            return _patches(example, rng, recipe, recipe.weather, self._first.detector)
        crop, corners = augmented_crop(example, recipe.size, rng, kind=recipe.cut, weather=recipe.weather)
        return _labelled(_normalised(crop, recipe), corners, 1.0, recipe.size)

    def _pick(self, number: int) -> int:
        """Which example: each once in every pass over the data, in that pass's own order."""
        turn, place = divmod(number, len(self.examples))
        if turn != self._turn:
            rng = np.random.default_rng([self.recipe.seed, 3, turn])
            self._turn, self._order = turn, rng.permutation(len(self.examples))
        return int(self._order[place])


class _Held(Dataset[Batch]):
    """The held-out pictures, or so many of them from beginning to end: framed at the centre, or as the recipe crops."""

    def __init__(self, examples: LabelledDataset, recipe: Recipe) -> None:
        self.examples, self.recipe, self._first = examples, recipe, _FirstLook(recipe)

    def __len__(self) -> int:
        return min(len(self.examples), self.recipe.validation_count)

    def __getitem__(self, index: int) -> Batch:
        number = index * len(self.examples) // len(self)
        example = self.examples[number]
        if self.recipe.learn == "corners":
            rng = np.random.default_rng([self.recipe.seed, 2, number])
            return _patches(example, rng, self.recipe, False, self._first.detector)
        window = held_out_window(example, self.recipe, number)
        corners = window.apply(within(example))
        crop = _normalised(crop_image(example.image, window), self.recipe)
        return _labelled(crop, corners, window.scale[0], self.recipe.size)


def held_out_window(example: Example, recipe: Recipe, index: int) -> PixelWindow:
    """Where a held-out picture is looked at: around the corners in it; the whole of one without a runway."""
    height, width = example.image.shape[:2]
    corners = within(example)[:4]
    seen = corners[np.isfinite(corners).all(axis=1)]
    if recipe.cut == "tile":
        rng = np.random.default_rng([recipe.seed, 2, index])
        return search_crop(box_around(seen) if len(seen) == 4 else None, (width, height), recipe.size, rng)
    if len(seen) < 2:
        return PixelWindow.resize(width, height, recipe.size, recipe.size)
    if recipe.cut == "native" and len(seen) == 4:
        rng = np.random.default_rng([recipe.seed, 2, index])
        return native_crop(box_around(seen), (width, height), rng, recipe.size, 0.0)
    return centre_crop(box_around(seen), recipe.margin, recipe.size)


def _labelled(image: Tensor, corners: np.ndarray[Any, Any], scale: ArrayLike, size: int) -> Batch:
    visible = inside(corners, size, size)  # NaN is not
    places = np.where(visible[:, None], corners, 0.0).astype(np.float32)
    return Batch(
        image, torch.from_numpy(places), torch.from_numpy(visible.astype(np.float32)),
        torch.from_numpy(_box(corners)), torch.as_tensor(np.asarray(scale, np.float32)),
    )  # fmt: skip


class _FirstLook:
    """The model that looks before the corners are looked at; loaded where it is used, in a worker's process."""

    def __init__(self, recipe: Recipe) -> None:
        self._path = recipe.first_look

    @cached_property
    def detector(self) -> KeypointDetector | None:
        return KeypointDetector(self._path, threads=1) if self._path else None


def _patches(
    example: Example, rng: np.random.Generator, recipe: Recipe, weather: bool, detector: KeypointDetector | None
) -> Batch:
    patches, corners, scale = corner_looks(example, rng, weather, detector)
    return _labelled(torch.stack([_normalised(patch, recipe) for patch in patches]), corners, scale, PATCH_PX)


def _normalised(crop: np.ndarray[Any, Any], recipe: Recipe) -> Tensor:
    mean, std = (tuple(float(v) for v in values) for values in (recipe.mean, recipe.std))
    return torch.from_numpy(normalise(crop, mean, std))


def _channels_last(image: Tensor) -> Tensor:
    return image.contiguous(memory_format=torch.channels_last) if image.dim() == 4 else image


def _box(corners: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    whole = bool(np.isfinite(corners[:4]).all())
    return (box_around(corners[:4]) if whole else np.full(4, np.nan)).astype(np.float32)


def open_data(recipe: Recipe) -> tuple[LabelledDataset, LabelledDataset]:
    """Training and held-out examples.

    Without folders of held-out ones: what the data set calls train and val, or, of all that it does not
    call test, a fifth of the airports. Raises InputError if one of the two shows no runway, or if they
    share an airport and the recipe does not allow it.
    """
    train = _together(recipe.data, recipe.keypoints)
    train, held = (
        (train, _together(recipe.validation, recipe.keypoints)) if recipe.validation else _split(train, recipe)
    )
    sources = {"training": recipe.data, "held-out": recipe.validation or recipe.data}
    for (name, folders), part in zip(sources.items(), (train, held), strict=True):
        if not any(label is not None for _, label in part.labels):
            raise InputError(f"{' '.join(folders)}: no {name} picture shows a runway")
    shared = sorted(_airports(train) & _airports(held))
    if shared and not recipe.share_airports:
        raise InputError(
            f"{len(shared)} airports are in both training and validation (first: {shared[0]}); split by airport "
            "(`shortfinal data convert --split`), or set share_airports = true"
        )
    return train, held


def _split(data: LabelledDataset, recipe: Recipe) -> tuple[LabelledDataset, LabelledDataset]:
    labels = data.labels
    splits = [picture.split for picture, _ in labels]
    if not {"train", "val"} <= set(splits):
        labels = [label for label, split in zip(labels, splits, strict=True) if split != "test"]
        try:
            splits = split_by_airport([picture for picture, _ in labels], (0.8, 0.2), recipe.seed)
        except InputError as error:
            raise InputError(f"{' '.join(recipe.data)}: {error}; or name pictures for validation") from error
    parts = [[label for label, split in zip(labels, splits, strict=True) if split == name] for name in ("train", "val")]
    return LabelledDataset(parts[0], data.keypoints), LabelledDataset(parts[1], data.keypoints)


def _together(folders: Iterable[str], keypoints: tuple[str, ...]) -> LabelledDataset:
    return LabelledDataset([label for folder in folders for label in read_dataset(folder, keypoints).labels], keypoints)


def _airports(data: LabelledDataset) -> set[str]:
    return {label.airport for picture, _ in data.labels for label in picture.labels if label.airport}


def figures_of(prediction: Prediction, batch: Batch) -> dict[str, float]:
    """What a network makes of held-out crops: errors in pixels of the crop, per coordinate of visible corners,
    how honest sigma is, and how well crops with and without a runway are told apart.

    `nll` is the negative log-likelihood of the predicted Gaussians per coordinate, without its constant;
    `native_mean_px` is in pixels of the picture that the crop was enlarged from. Raises InputError if
    no corner is visible.
    """
    seen = batch.visible.bool()
    if not seen.any():
        raise InputError("validation: no corner of a runway can be seen in the held-out crops")
    nll = gaussian_nll(prediction.mean_px - batch.corners_px, prediction.sigma_px, prediction.factor, batch.visible)
    error = (prediction.mean_px - batch.corners_px)[seen]
    sigma, size = prediction.sigma_px[seen], error.abs()
    native = size / batch.scale.reshape(len(batch.scale), -1, 1).expand_as(batch.corners_px)[seen]
    far = (prediction.mean_px - batch.corners_px).abs()[:, 2:4][seen[:, 2:4]]
    covered = coverage(error.cpu().numpy(), sigma.cpu().numpy(), LEVELS)
    figures = {
        "nll": float(nll.sum() / error.numel()),
        "mean_px": float(size.mean()),
        "median_px": float(size.median()),
        "p90_px": float(size.flatten().quantile(0.9)),
        "native_mean_px": float(native.mean()),
        "far_median_px": float(far.median()) if len(far) else math.nan,
        **{f"coverage_{round(100 * level)}": float(share) for level, share in zip(LEVELS, covered, strict=True)},
    }
    present = seen.any(dim=1).cpu().numpy()
    if present.any() and not present.all():
        figures["present_auroc"] = auroc(prediction.present.cpu().numpy(), present)
    return figures


def where_figures(where: Tensor, batch: Batch, size: int) -> dict[str, float]:
    """What the search's part makes of held-out tiles (B, 2, H, W): its loss, and the share of runways, 8 pixels long
    or more and with their box's centre in the tile, that its highest cell is within a cell of.
    """
    loss = where_loss(where, batch.box_px, batch.visible, size)
    width = where.shape[-1]
    cell, best = size / width, where[:, 0].flatten(1).argmax(dim=1)
    place = torch.stack([best % width, best // width], dim=1) * cell + cell / 2 - 0.5
    centre, side = (batch.box_px[:, :2] + batch.box_px[:, 2:]) / 2, batch.box_px[:, 2:] - batch.box_px[:, :2]
    inside_ = ((centre > 0) & (centre < size - 1)).all(dim=1) & (side.amax(dim=1) >= 8)
    near = ((place - centre).abs() <= 1.5 * cell).all(dim=1)
    return {"where_loss": float(loss.mean()), "where_found": float(near[inside_].float().mean())}


def auroc(scores: np.ndarray[Any, Any], positive: np.ndarray[Any, Any]) -> float:
    """Chance that a positive scores above a negative, ties counted half (Mann and Whitney)."""
    from scipy.stats import rankdata

    n = int(positive.sum())
    return float((rankdata(scores)[positive].sum() - n * (n + 1) / 2) / (n * (len(scores) - n)))


def predict(model: Callable[[Tensor], Prediction], batches: Iterable[Batch]) -> tuple[Prediction, Batch]:
    """The network's answer to all batches, and the batches (less their pictures), each as one."""
    answers, asked = [], []
    with torch.inference_mode():
        for batch in batches:
            answer = model(_channels_last(batch.image))
            answers.append(answer._replace(attention=None))
            asked.append(batch._replace(image=batch.image[..., :0, :0]))
    parts: list[Any] = [None if c[0] is None else torch.cat(list(c)) for c in zip(*answers, strict=True)]
    return Prediction(*parts), Batch(*(torch.cat(list(column)) for column in zip(*asked, strict=True)))


class Run:
    """A training run: its parts, its place on disk, and how to go on from there."""

    _PARTS = ("net", "average", "optimizer", "schedule")

    def __init__(self, recipe: Recipe, length: int) -> None:
        self.recipe, self.folder = recipe, Path(recipe.out)
        self.steps = max(1, round(recipe.epochs * length / recipe.batch)) if recipe.epochs else recipe.steps
        world, here = (int(os.environ.get(name, 1)) for name in ("WORLD_SIZE", "LOCAL_WORLD_SIZE"))  # torchrun's
        if recipe.batch % world:
            raise InputError(f"batch: {recipe.batch} pictures cannot be shared evenly by {world} processes")
        self.board = TensorBoardLogger(self.folder, name="tensorboard", version="")
        self.fabric = Fabric(
            accelerator="auto", devices=here, num_nodes=world // here, strategy="ddp" if world > 1 else "auto",
            precision=recipe.precision, loggers=self.board,
        )  # fmt: skip
        self.fabric.launch()
        torch.manual_seed(recipe.seed)
        last = self.folder / "last.pt"
        source = last if last.exists() else recipe.start
        earlier = network_weights(load_checkpoint(source)) if source else None
        self.net = _network(recipe, earlier, pretrained=earlier is None and recipe.weights == "timm")
        self.net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        for part in self.kept:
            part.requires_grad_(False)
        optimizer = _optimizer(recipe, self.net)
        self.schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: _rate(recipe, step / self.steps))
        self.model, self.optimizer = self.fabric.setup(self.net, optimizer)
        self.average = AveragedModel(self.net, multi_avg_fn=_averaging(recipe.ema), use_buffers=True)
        self.step, self.history = 0, list[dict[str, float]]()
        self.figures: dict[str, float] = {}  # of the checkpoint it began from, where they stay as they are

    @property
    def kept(self) -> list[torch.nn.Module]:
        """The parts of the network that do not learn."""
        parts = dict(self.net.named_children())
        if self.recipe.learn in PARTS:
            return [part for name, part in parts.items() if name != self.recipe.learn]
        means = self.net.means if self.recipe.learn == "covariance" else []
        return means + [parts[name] for name in PARTS if name in parts]

    @property
    def goal(self) -> str:
        """The figure that tells which network is the best."""
        return {"where": "where_loss", "corners": "corner_nll"}.get(self.recipe.learn, "nll")

    def save(self, name: str) -> None:
        """Write a checkpoint whole or not at all."""
        parts = {part: getattr(self, part).state_dict() for part in self._PARTS}
        state = parts | {"step": self.step, "history": self.history, "recipe": to_dict(self.recipe)}
        state["precision"] = self.fabric.strategy.precision.state_dict()  # of half precision: the loss's scale
        content = io.BytesIO()
        torch.save(state, content)
        write_whole(self.folder / name, content.getvalue())

    def resume(self) -> bool:
        """Go on from last.pt, if there is one. Raises InputError if it was made by another recipe."""
        path = self.folder / "last.pt"
        if not path.exists():
            return False
        state = load_checkpoint(path)
        was, now = state["recipe"], to_dict(self.recipe)
        changed = [k for k in now if was.get(k) != now[k] and k not in ("out", "workers")]
        if changed:
            raise InputError(f"{path}: was made with another {', '.join(changed)}; choose another --out")
        for part in self._PARTS:
            getattr(self, part).load_state_dict(state[part])
        self.fabric.strategy.precision.load_state_dict(state.get("precision", {}))
        self.step, self.history = state["step"], state["history"]
        self.figures = _last_figures(state)
        return True

    def begin(self, pictures: Callable[[], Tensor]) -> None:
        """Start anew: from another run's averaged network, or pretrained weights, settled on `pictures` of the data."""
        recipe = self.recipe
        if recipe.start:
            state = load_checkpoint(recipe.start)
            weights, mine = network_weights(state), self.net.state_dict()
            was, now = state["recipe"], to_dict(recipe)
            differ = [name for name in ("backbone", "head", "features", "mean", "std") if was[name] != now[name]]
            differ += [k for k, v in weights.items() if k not in mine or mine[k].shape != v.shape]
            # One that had no correlations, or did not say where, may become one that does.
            differ += [k for k in mine if k not in weights and k.partition(".")[0] not in ("correlation", *PARTS)]
            if differ:
                raise InputError(f"{recipe.start}: of another network ({differ[0]} differs)")
            self.net.load_state_dict(weights, strict=False)
            self.figures = _last_figures(state)
            if _is_model(recipe.start) and recipe.learn == "all":  # its batch norms say nothing of what they saw
                settle_batch_norm(self.net, pictures().to(self.fabric.device))
        elif recipe.weights not in ("", "timm"):
            if recipe.weights.endswith(".npz") and (recipe.mean, recipe.std) != (FOLDED_MEAN, FOLDED_STD):
                raise InputError(f"{recipe.weights}: needs mean = {list(FOLDED_MEAN)} and std = {list(FOLDED_STD)}")
            load_weights(self.net.backbone, recipe.weights, pictures().to(self.fabric.device))
        self.average.module.load_state_dict(self.net.state_dict())

    def loss(self, batch: Batch) -> Tensor:
        """What this step minimises: a mean over the batch's pictures, so that processes can share it."""
        recipe = self.recipe
        prediction = self.model(batch.image)
        size = PATCH_PX if recipe.learn == "corners" else recipe.size
        if recipe.learn == "where":
            return where_loss(prediction.where, batch.box_px, batch.visible, recipe.size).mean()
        error = (prediction.mean_px - batch.corners_px) * batch.visible[..., None]
        coordinates = error[0].numel()
        warming = self.step < recipe.warm_up * self.steps
        # Means first: while they are far off, the variance would only learn to excuse them.
        shown = error.detach() if warming else error
        nll = gaussian_nll(shown, prediction.sigma_px, prediction.factor, batch.visible, recipe.likelihood)
        loss: Tensor = nll.mean() / coordinates
        if warming:
            loss = loss + 0.1 * error.abs().mean()
        if prediction.attention is not None and recipe.attention_weight:
            told = attention_loss(prediction.attention, batch.corners_px, batch.visible, size).mean()
            loss = loss + recipe.attention_weight * told / batch.visible.shape[1]
        return loss + recipe.scope_weight * scope_loss(prediction, batch.visible).mean()

    def advance(self, batch: Batch) -> float:
        """One step of the optimiser; returns the loss over all processes."""
        self.model.train()
        for part in self.kept:
            part.eval()
        loss = self.loss(batch.to(self.fabric.device))
        value = float(self.fabric.all_reduce(loss.detach(), reduce_op="mean"))  # type: ignore[arg-type]
        if not math.isfinite(value):
            raise JobError(f"diverged at step {self.step + 1}; lower the learning rate")
        self.optimizer.zero_grad(set_to_none=True)
        self.fabric.backward(loss)
        # What is not finite here shows in the next loss; half precision meets it now and then, and skips the step.
        self.fabric.clip_gradients(self.model, self.optimizer, max_norm=5.0, error_if_nonfinite=False)
        self.optimizer.step()
        self.schedule.step()
        self.average.update_parameters(self.net)
        self.step += 1
        return value

    def record(self, figures: dict[str, float]) -> None:
        """Keep a validation: last.pt always, best.pt if it is the best yet, and the table of all."""
        best = min((row[self.goal] for row in self.history), default=math.inf)
        self.history.append(figures)
        self.fabric.log_dict(figures, step=self.step)
        self.board.experiment.flush()
        if figures[self.goal] < best:
            self.save("best.pt")
        write_whole(self.folder / "log.csv", csv_text(figures, self.history))
        self.save("last.pt")  # last of all: what is lost by a kill before it is done again, not twice


def network_of(
    recipe: Mapping[str, Any], weights: Mapping[str, Tensor] | None = None, *, pretrained: bool = False
) -> KeypointNet:
    """The network that a recipe's plain values (`to_dict`, or a checkpoint's) describe; with the further PARTS that
    `weights`, by their names, have.
    """
    had = {key.partition(".")[0] for key in weights or ()}
    parts = {name: recipe["learn"] == name or name in had for name in PARTS}
    return KeypointNet(
        recipe["backbone"], len(recipe["keypoints"]), recipe["head"], recipe["covariance"], recipe["features"],
        recipe["width"], pretrained=pretrained, **parts,
    )  # fmt: skip


def _network(recipe: Recipe, earlier: Mapping[str, Tensor] | None, pretrained: bool) -> KeypointNet:
    """The recipe's network, once tried. Raises InputError for a backbone that has no weights, or not this size."""
    try:
        net = network_of(to_dict(recipe), earlier, pretrained=pretrained)
        with torch.no_grad():
            net.eval()(torch.zeros(1, 3, recipe.size, recipe.size))
    except InputError:
        raise
    except Exception as error:  # timm's and torch's, of many kinds
        what = "weights = timm" if pretrained else f"size {recipe.size}"
        raise InputError(f"backbone: {recipe.backbone!r} with {what}: {first_line(error)}") from error
    return net


def _optimizer(recipe: Recipe, net: torch.nn.Module) -> torch.optim.Optimizer:
    kinds: dict[str, Any] = {"adamw": torch.optim.AdamW, "adam": torch.optim.Adam, "rmsprop": torch.optim.RMSprop}
    learning = [weight for weight in net.parameters() if weight.requires_grad]
    made: torch.optim.Optimizer = kinds[recipe.optimizer](
        learning, lr=recipe.learning_rate, weight_decay=recipe.weight_decay
    )
    return made


def _rate(recipe: Recipe, done: float) -> float:
    """The learning rate, as a share of the recipe's, when that share of the steps is done."""
    if recipe.schedule == "constant":
        return 1.0
    if done < _RISE:
        return max(done / _RISE, 1e-2)
    return 0.5 * (1 + math.cos(math.pi * min(1.0, (done - _RISE) / (1 - _RISE))))


def _averaging(decay: float) -> Callable[[Any, Any, Any], None]:
    """An exponential moving average that forgets its first, untrained weights."""

    def update(averaged: list[Tensor], current: list[Tensor], count: Tensor) -> None:
        keep = min(decay, (1.0 + float(count)) / (10.0 + float(count)))
        for mine, new in zip(averaged, current, strict=True):
            if mine.is_floating_point():
                mine.lerp_(new.to(mine), 1.0 - keep)
            else:
                mine.copy_(new)

    quiet: Callable[[Any, Any, Any], None] = torch.no_grad()(update)
    return quiet


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """The content of a checkpoint, or as much of it as a model file (.onnx) holds: the recipe of its network, its
    weights and figures; "shipped" is the one in the package. Raises InputError if it is missing or not one of ours.
    """
    if _is_model(path):
        return _content_of_model(shipped_model() if path == "shipped" else path)
    with reading(path, "checkpoint", "a checkpoint"):
        state = torch.load(path, map_location="cpu", weights_only=True)
    if not isinstance(state, dict) or "recipe" not in state:
        raise InputError(f"{path}: a torch file, but not a checkpoint of shortfinal train")
    recipe = state["recipe"] if isinstance(state["recipe"], dict) else {}
    # What recipes have learned to say since: what it was when nobody asked.
    recipe = {field.name: field.default for field in fields(Recipe) if field.default is not MISSING} | recipe
    state["recipe"] = recipe
    lacks = [key for key in (*Run._PARTS, "step", "history") if key not in state]
    lacks += [f"recipe.{field.name}" for field in fields(Recipe) if field.name not in recipe]
    if lacks or not state["history"]:
        raise InputError(f"{path}: not a complete checkpoint: lacks {', '.join(lacks) or 'history'}")
    return state


def _is_model(path: str | Path) -> bool:
    return path == "shipped" or Path(path).suffix == ".onnx"


def _content_of_model(path: str | Path) -> dict[str, Any]:
    info, tensors = read_model(path)
    told = {name: getattr(info, name) for name in ("size", "mean", "std", "keypoints", "covariance", "margin")}
    recipe = to_dict(Recipe(data=("",), backbone=info.backbone, **told, **_of_network(info.training)))
    weights = fold_back(network_of(recipe, tensors), tensors, info.size, path)
    average = {f"module.{name}": value for name, value in weights.items()}
    steps = int(info.training.get("steps", 0))
    return {"recipe": recipe, "average": average, "step": steps, "history": [{"step": steps, **info.figures}]}


def _of_network(training: dict[str, Any]) -> dict[str, Any]:
    """Those fields of a recipe that a model file notes of its training and the network needs."""
    return {name: training[name] for name in ("head", "features", "width") if name in training}


def network_weights(state: dict[str, Any]) -> dict[str, Tensor]:
    """The averaged network of a checkpoint's content: its state is under "module.", beside a count."""
    return {k.removeprefix("module."): v for k, v in state["average"].items() if k.startswith("module.")}


def _last_figures(state: dict[str, Any]) -> dict[str, float]:
    """What a checkpoint says of its network."""
    return {k: v for k, v in state["history"][-1].items() if k not in ("step", "loss")}


def train(recipe: Recipe, console: Console | None = None) -> dict[str, float]:
    """Train, or go on from the last validation; returns the figures of the best (out/best.pt).

    Keeps out/last.pt for resuming, out/log.csv, a row at each validation, and out/tensorboard. Started
    by `torchrun`, the processes share each batch. Raises InputError for data or a recipe of no use,
    JobError if the loss diverges.
    """
    learning, held_out = open_data(recipe)
    make_folder(recipe.out)
    run = Run(recipe, len(learning))
    first = run.fabric.is_global_zero
    shown = (console or Console()) if first else Console(quiet=True)
    if run.resume():
        shown.print(f"going on from step {run.step}")
    else:
        run.begin(lambda: _some(learning, recipe))
    share = recipe.batch // run.fabric.world_size
    draws = _Draws(learning, recipe, range(run.step, run.steps), run.fabric.global_rank, share)
    batches: Iterable[Batch] = DataLoader(draws, batch_size=share, num_workers=recipe.workers)
    smooth = run.history[-1]["loss"] if run.history else math.nan
    try:
        with _bar(shown) as bar:
            task = bar.add_task("training", total=run.steps, completed=run.step, note="")
            for batch in batches:
                loss = run.advance(batch)
                smooth = loss if math.isnan(smooth) else 0.98 * smooth + 0.02 * loss
                bar.update(task, completed=run.step, note=f"loss {smooth:.3f}" + _brief(run.history))
                if run.step % recipe.validate_every == 0 or run.step == run.steps:
                    if first:
                        run.record({"step": run.step, "loss": smooth, **_validate(run, held_out)})
                    run.fabric.barrier()
    except InputError as error:  # a worker's comes with its traceback before it
        line = str(error).strip().splitlines()[-1]
        raise InputError(line.removeprefix("shortfinal.errors.InputError: ")) from error
    history = run.fabric.broadcast(run.history)
    run.fabric.barrier()
    return min(history, key=lambda row: row[run.goal])


def leave() -> None:
    """End this process at once if it is one of several; call it last.

    At an ordinary exit gloo's threads abort one such process in ten ("terminate called without an active
    exception"), and torchrun then calls a training that is done a failure.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)


def _some(examples: LabelledDataset, recipe: Recipe) -> Tensor:
    """The first pictures of the run (N, 3, S, S): up to 64, and no more than four batches."""
    count = min(64, recipe.batch * 4)
    draws = _Draws(examples, recipe, range(1), 0, count)
    return torch.stack([draws[n].image for n in range(count)])


def _validate(run: Run, examples: LabelledDataset) -> dict[str, float]:
    run.average.eval()
    loader = DataLoader(_Held(examples, run.recipe), batch_size=50)
    prediction, batch = predict(run.average, (batch.to(run.fabric.device) for batch in loader))
    if not (prediction.mean_px.isfinite().all() and prediction.sigma_px.isfinite().all()):
        raise JobError(f"diverged at step {run.step}; lower the learning rate")
    if run.recipe.learn == "corners":
        return run.figures | {f"corner_{name}": value for name, value in figures_of(prediction, batch).items()}
    if run.recipe.learn == "where":
        assert prediction.where is not None  # as the network has that part
        return run.figures | where_figures(prediction.where, batch, run.recipe.size)
    return figures_of(prediction, batch)


def _bar(console: Console) -> Progress:
    columns = (
        BarColumn(),
        TextColumn("{task.completed}/{task.total}"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    return Progress(*columns, console=console)


def _brief(history: list[dict[str, float]]) -> str:
    last = history[-1] if history else None
    if last is None:
        return ""
    part = "corner_" if "corner_nll" in last else ""
    return f" · held out: median {last[f'{part}median_px']:.2f} px, nll {last[f'{part}nll']:.3f}"
