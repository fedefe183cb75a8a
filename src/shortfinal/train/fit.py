"""`shortfinal train`: fit a KeypointNet to a rendered data set, resumable after a stop or a kill."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.fabric import Fabric
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torch.utils.data import DataLoader, Dataset

from shortfinal.calibration import coverage
from shortfinal.crops import box_around, centre_crop
from shortfinal.data.augment import augmented_crop
from shortfinal.data.dataset import read_dataset
from shortfinal.detector import crop_image, normalise
from shortfinal.errors import InputError, JobError
from shortfinal.files import csv_text, make_folder, write_whole
from shortfinal.train.model import KeypointNet, gaussian_nll, to_pixels, variance_px

Batch = tuple[Tensor, Tensor]

MEAN, STD = (0.45, 0.45, 0.45), (0.22, 0.22, 0.22)


@dataclass(frozen=True)
class Recipe:
    """How to train. Everything that the result depends on, besides the data."""

    data: str  # folder of the training scenes
    validation: str  # folder of the held-out scenes
    out: str  # folder of the checkpoints
    backbone: str = "mobilenetv3_small_100"  # any timm model with features_only
    width: int = 96  # channels of the head
    size: int = 224  # side of the crop, px
    margin: float = 1.4  # of the evaluation crop; training draws its own (crops.random_margin)
    batch: int = 32
    steps: int = 10000
    warm_up: float = 0.1  # share of the steps before the variance enters the mean's loss
    learning_rate: float = 2e-3
    weight_decay: float = 0.02
    ema: float = 0.998
    validate_every: int = 500  # steps
    validation_count: int = 1000
    workers: int = 1
    seed: int = 0


class _Draws(Dataset[Batch]):
    """Draw number n of the training run: a function of the seed and n, so that resuming is exact."""

    def __init__(self, recipe: Recipe, start: int) -> None:
        self.examples = read_dataset(recipe.data)
        self.recipe, self.start = recipe, start

    def __len__(self) -> int:
        return (self.recipe.steps * self.recipe.batch) - self.start

    def __getitem__(self, index: int) -> Batch:
        rng = np.random.default_rng([self.recipe.seed, 1, self.start + index])
        example = self.examples[int(rng.integers(len(self.examples)))]
        crop, corners = augmented_crop(example, self.recipe.size, rng)
        image = normalise(crop, MEAN, STD)
        return torch.from_numpy(image), torch.from_numpy(corners.astype(np.float32))


class _Held(Dataset[Batch]):
    """The held-out scenes, cropped at the centre."""

    def __init__(self, recipe: Recipe) -> None:
        self.examples = read_dataset(recipe.validation)
        self.recipe = recipe

    def __len__(self) -> int:
        return min(len(self.examples), self.recipe.validation_count)

    def __getitem__(self, index: int) -> Batch:
        example = self.examples[index]
        window = centre_crop(box_around(example.corners_px), self.recipe.margin, self.recipe.size)
        image = normalise(crop_image(example.image, window), MEAN, STD)
        return torch.from_numpy(image), torch.from_numpy(window.apply(example.corners_px).astype(np.float32))


def validate(model: torch.nn.Module, batches: Iterable[Batch], size: int) -> dict[str, float]:
    """Errors in pixels of the crop, per coordinate, and how honest the predicted sigma is."""
    model.eval()
    errors, variances = [], []
    with torch.inference_mode():
        for image, corners in batches:
            mean, log_variance = model(image.contiguous(memory_format=torch.channels_last))
            errors.append(to_pixels(mean, size) - corners)
            variances.append(variance_px(log_variance))
    error, sigma = torch.cat(errors), torch.cat(variances).sqrt()
    size_of = error.abs()
    covered = coverage(error.cpu().numpy(), sigma.cpu().numpy(), (0.68, 0.95))
    return {
        "nll": float((0.5 * (error / sigma).square() + sigma.log()).mean()),
        "median_px": float(size_of.median()),
        "p90_px": float(size_of.flatten().quantile(0.9)),
        "mean_px": float(size_of.mean()),
        "far_median_px": float(size_of[:, 2:].median()),
        "coverage_68": float(covered[0]),
        "coverage_95": float(covered[1]),
    }


class Run:
    """A training run: its parts, its place on disk, and how to go on from there."""

    _PARTS = ("net", "average", "optimizer", "schedule")

    def __init__(self, recipe: Recipe) -> None:
        self.recipe, self.folder = recipe, Path(recipe.out)
        self.fabric = Fabric(accelerator="auto", devices=1)
        torch.manual_seed(recipe.seed)
        self.net = KeypointNet(recipe.backbone, width=recipe.width)
        self.net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        optimizer = torch.optim.AdamW(self.net.parameters(), lr=recipe.learning_rate, weight_decay=recipe.weight_decay)
        self.schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer, recipe.learning_rate, total_steps=recipe.steps + 1, pct_start=0.08
        )
        self.model, self.optimizer = self.fabric.setup(self.net, optimizer)
        self.average = AveragedModel(self.net, multi_avg_fn=get_ema_multi_avg_fn(recipe.ema), use_buffers=True)
        self.step, self.history = 0, list[dict[str, float]]()

    def save(self, name: str) -> None:
        """Write a checkpoint whole or not at all."""
        parts = {part: getattr(self, part).state_dict() for part in self._PARTS}
        state = parts | {"step": self.step, "history": self.history, "recipe": asdict(self.recipe)}
        content = io.BytesIO()
        torch.save(state, content)
        write_whole(self.folder / name, content.getvalue())

    def resume(self) -> bool:
        """Go on from last.pt, if there is one. Raises InputError if it was made by another recipe."""
        path = self.folder / "last.pt"
        if not path.exists():
            return False
        state = load_checkpoint(path)
        was, now = state["recipe"], asdict(self.recipe)
        changed = [k for k in now if was.get(k) != now[k] and k not in ("out", "workers")]
        if changed:
            raise InputError(f"{path}: was made with another {', '.join(changed)}; choose another --out")
        for part in self._PARTS:
            getattr(self, part).load_state_dict(state[part])
        self.step, self.history = state["step"], state["history"]
        return True

    def advance(self, image: Tensor, corners: Tensor) -> float:
        """One step of the optimiser; returns the loss."""
        self.model.train()
        mean, log_variance = self.model(image.contiguous(memory_format=torch.channels_last))
        error = to_pixels(mean, self.recipe.size) - corners
        if self.step < self.recipe.warm_up * self.recipe.steps:
            # Means first: while they are far off, the variance would only learn to excuse them.
            loss = 0.1 * error.abs().mean() + gaussian_nll(error.detach(), log_variance)
        else:
            loss = gaussian_nll(error, log_variance)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise JobError(f"diverged at step {self.step + 1}; lower --learning-rate")
        self.optimizer.zero_grad(set_to_none=True)
        self.fabric.backward(loss)
        self.fabric.clip_gradients(self.model, self.optimizer, max_norm=5.0)
        self.optimizer.step()
        self.schedule.step()
        self.average.update_parameters(self.net)
        self.step += 1
        return value

    def record(self, figures: dict[str, float]) -> None:
        """Keep a validation: last.pt always, best.pt if it is the best yet, and the table of all."""
        best = min((row["nll"] for row in self.history), default=math.inf)
        self.history.append(figures)
        if figures["nll"] < best:
            self.save("best.pt")
        write_whole(self.folder / "log.csv", csv_text(figures, self.history))
        self.save("last.pt")  # last of all: what is lost by a kill before it is done again, not twice


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """The content of a checkpoint. Raises InputError if it is missing or not one of ours."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise InputError(f"{path}: cannot read the checkpoint: {error.strerror}") from error
    except Exception as error:  # torch raises many kinds for a file that is not a checkpoint
        raise InputError(f"{path}: not a checkpoint: {str(error).splitlines()[0][:120]}") from error
    if not isinstance(state, dict) or "recipe" not in state:
        raise InputError(f"{path}: a torch file, but not a checkpoint of shortfinal train")
    recipe = state["recipe"] if isinstance(state["recipe"], dict) else {}
    lacks = [key for key in (*Run._PARTS, "step", "history") if key not in state]
    lacks += [f"recipe.{field.name}" for field in fields(Recipe) if field.name not in recipe]
    if lacks or not state["history"]:
        raise InputError(f"{path}: not a complete checkpoint: lacks {', '.join(lacks) or 'history'}")
    return state


def train(recipe: Recipe, console: Console | None = None) -> dict[str, float]:
    """Train, or go on from the last validation; returns the figures of the best (out/best.pt).

    Keeps out/last.pt for resuming and out/log.csv, a row at each validation.
    """
    console = console or Console()
    make_folder(recipe.out)
    run = Run(recipe)
    if run.resume():
        console.print(f"going on from step {run.step}")
    held: Any = run.fabric.setup_dataloaders(DataLoader(_Held(recipe), batch_size=64))
    draws = _Draws(recipe, run.step * recipe.batch)
    batches: Any = run.fabric.setup_dataloaders(DataLoader(draws, batch_size=recipe.batch, num_workers=recipe.workers))
    smooth = math.nan
    try:
        with _bar(console) as bar:
            task = bar.add_task("training", total=recipe.steps, completed=run.step, note="")
            for image, corners in batches:
                loss = run.advance(image, corners)
                smooth = loss if math.isnan(smooth) else 0.98 * smooth + 0.02 * loss
                bar.update(task, completed=run.step, note=f"loss {smooth:.3f}" + _brief(run.history))
                if run.step % recipe.validate_every == 0 or run.step == recipe.steps:
                    run.record({"step": run.step, "loss": smooth, **validate(run.average, held, recipe.size)})
    except InputError as error:  # a worker's comes with its traceback before it
        line = str(error).strip().splitlines()[-1]
        raise InputError(line.removeprefix("shortfinal.errors.InputError: ")) from error
    return min(run.history, key=lambda row: row["nll"])


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
    return f" · held out: median {last['median_px']:.2f} px, nll {last['nll']:.3f}" if last else ""
