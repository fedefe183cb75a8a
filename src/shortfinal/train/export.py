"""From a checkpoint to the model file: ONNX, with its description inside, checked against torch."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from shortfinal.detector import FORMAT, METADATA_KEY, ModelInfo
from shortfinal.errors import InputError, JobError
from shortfinal.files import write_whole
from shortfinal.keypoints import CORNER_NAMES
from shortfinal.train.fit import MEAN, STD, load_checkpoint
from shortfinal.train.model import KeypointNet, to_pixels, variance_px

# How near ONNX must come to torch, in units of the input's side. (torch itself is off by 4e-6 of it
# from double precision.)
TOLERANCE = 1e-5


class GaussianNet(nn.Module):
    """What the model file computes: means (B, K, 2) and covariance (B, 2K, 2K) in input pixels."""

    def __init__(self, net: KeypointNet, size: int) -> None:
        super().__init__()
        self.net, self.size = net, size

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Means and covariances."""
        mean, log_variance = self.net(image)
        variance = variance_px(log_variance).flatten(1)
        identity = torch.eye(variance.shape[1], dtype=variance.dtype)
        return to_pixels(mean, self.size), variance[:, :, None] * identity


def load_network(checkpoint: str | Path) -> tuple[GaussianNet, dict[str, Any]]:
    """The averaged network of a checkpoint, ready for inference, and the checkpoint's content."""
    state = load_checkpoint(checkpoint)
    recipe = state["recipe"]
    net = KeypointNet(recipe["backbone"], width=recipe["width"])
    # An averaged model's state is the network's, under "module.", and a count.
    weights = {k.removeprefix("module."): v for k, v in state["average"].items() if k.startswith("module.")}
    net.load_state_dict(weights)
    return GaussianNet(net, recipe["size"]).eval(), state


def export(checkpoint: str | Path, out: str | Path) -> ModelInfo:
    """Write the checkpoint's network to the ONNX file `out`, and read it back against torch.

    Raises InputError for a file that is no checkpoint; JobError if ONNX Runtime and torch differ
    by more than `TOLERANCE`, in which case nothing is written.
    """
    import onnx

    model, state = load_network(checkpoint)
    recipe = state["recipe"]
    info = ModelInfo(
        format=FORMAT, size=recipe["size"], mean=MEAN, std=STD, keypoints=CORNER_NAMES, covariance="diagonal",
        margin=recipe["margin"], backbone=recipe["backbone"],
        training={"steps": state["step"], "batch": recipe["batch"], "seed": recipe["seed"], "data": "rendered scenes"},
        figures=state["history"][-1],
    )  # fmt: skip
    target = Path(out)
    with tempfile.TemporaryDirectory(dir=_folder_of(target)) as scratch:
        draft = Path(scratch) / "model.onnx"
        example = torch.zeros(2, 3, info.size, info.size)
        batch = torch.export.Dim("batch", min=1, max=4096)
        torch.onnx.export(
            model, (example,), draft, input_names=["image"], output_names=["mean_px", "cov_px"], dynamo=True,
            dynamic_shapes={"image": {0: batch}}, external_data=False, verbose=False,
        )  # fmt: skip
        content = onnx.load(draft)
        content.metadata_props.add(key=METADATA_KEY, value=info.to_json())
        content.doc_string = ""
        for node in content.graph.node:  # the exporter notes where each node stood in the source, paths included
            del node.metadata_props[:]
            node.doc_string = ""
        onnx.save(content, draft)
        difference = compare(draft, model, info.size)
        if difference > TOLERANCE:
            raise JobError(f"{checkpoint}: ONNX Runtime differs from torch by {difference:.1e}; not written")
        write_whole(target, draft.read_bytes())
    return info


def compare(path: str | Path, model: GaussianNet, size: int, count: int = 16, seed: int = 0) -> float:
    """Largest difference of means and sigmas from torch's, on random pictures, in units of their side."""
    import onnxruntime

    rng = np.random.default_rng(seed)
    smooth = torch.from_numpy(rng.normal(0, 1, (count, 3, size // 8, size // 8)).astype(np.float32))
    image = nn.functional.interpolate(smooth, size=(size, size), mode="bilinear")
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    got_mean, got_cov = session.run(["mean_px", "cov_px"], {"image": image.numpy()})
    with torch.inference_mode():
        mean, cov = model(image)
    got_sigma, sigma = (np.sqrt(np.diagonal(c, axis1=1, axis2=2)) for c in (got_cov, cov.numpy()))
    return float(max(np.abs(got_mean - mean.numpy()).max(), np.abs(got_sigma - sigma).max()) / size)


def _folder_of(path: Path) -> Path:
    if not path.parent.is_dir():
        raise InputError(f"{path}: no such folder {path.parent}; make it first")
    if path.is_dir():
        raise InputError(f"{path}: cannot be written: Is a directory")
    return path.parent
