"""Weights from a file: pretrained backbones, and the networks in model files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

from shortfinal.crops import PATCH_PX
from shortfinal.detector import KeypointDetector, ModelInfo
from shortfinal.errors import InputError

FOLDED_MEAN = FOLDED_STD = (0.5, 0.5, 0.5)  # of RGB / 255, that `load_folded_mobilenet`'s file was trained with


def load_weights(backbone: nn.Module, path: str | Path, pictures: Tensor) -> None:
    """A backbone's pretrained weights from a file: MobileNetV2's (.npz, see below), or torch's or safetensors'.

    The latter may hold more than the backbone has (its classifier), under timm's names. `pictures`
    (B, 3, S, S) as the network sees them settle folded batch norms. Raises InputError if the file is
    missing, or lacks something that the backbone has.
    """
    if Path(path).suffix == ".npz":
        load_folded_mobilenet(backbone, path)
        settle_batch_norm(backbone, pictures)
        return
    given = {_plain(name): value for name, value in _read_tensors(path).items()}
    mine = backbone.state_dict()
    fitting = {
        name: given[_plain(name)]
        for name, weight in mine.items()
        if _plain(name) in given and given[_plain(name)].shape == weight.shape
    }
    # Older files do not count the batches that a batch norm saw; nothing here does either.
    lacking = [name for name in mine if name not in fitting and not name.endswith("num_batches_tracked")]
    if lacking:
        raise InputError(
            f"{path}: fits {len(mine) - len(lacking)} of the backbone's {len(mine)} tensors, not {lacking[0]}; "
            "is it of another network?"
        )
    backbone.load_state_dict(fitting, strict=False)


def _plain(name: str) -> str:
    """The name of a tensor, of timm's whole model or of the same as a backbone, which names stages otherwise."""
    return name.removeprefix("model.").replace(".", "_")


def _read_tensors(path: str | Path) -> dict[str, Tensor]:
    state: Any
    with reading(path, "weights", "a file of weights"):
        if Path(path).suffix == ".safetensors":
            from safetensors.torch import load_file  # timm's own dependency

            state = load_file(path)
        else:
            state = torch.load(path, map_location="cpu", weights_only=True)
    if isinstance(state, dict) and isinstance(state.get("state_dict"), dict):
        state = state["state_dict"]
    tensors = {k: v for k, v in state.items() if isinstance(v, Tensor)} if isinstance(state, dict) else {}
    if not tensors:
        raise InputError(f"{path}: holds no tensors by name; expected the state_dict of a timm model")
    return tensors


@contextmanager
def reading(path: str | Path, what: str, kind: str) -> Iterator[None]:
    """What goes wrong while torch or safetensors read `what`, a file of this `kind`, as InputError."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot read the {what}: {error.strerror or error}") from error
    except Exception as error:  # both raise many kinds for a file that is not their own
        raise InputError(f"{path}: not {kind}: {first_line(error)}") from error


def first_line(error: BaseException) -> str:
    """What an error of somebody else's says, as part of a line of ours."""
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0][:160]


def load_folded_mobilenet(model: nn.Module, path: str | Path) -> None:
    """Weights of TensorFlow's MobileNetV2, batch norm folded in, into timm's `mobilenetv2_100`.

    The file (.npz) has `NNN_..._w` (OHWI; depthwise 1, H, W, C) and `NNN_..._b` in the order of the
    layers, for inputs (RGB - 127.5) / 127.5 and TensorFlow's padding ("same": timm's `pad_type`). A
    model cut short (`features_only`) takes as many as it has. Each batch norm gets the layer's bias
    and statistics of a standard normal, so that in evaluation it adds the bias and does no more;
    `settle_batch_norm` then makes it fit to train with.
    Raises InputError if the file is missing, or is not of this network; the model then stays as it was.
    """
    try:
        with np.load(path, allow_pickle=False) as content:
            arrays = {name: content[name] for name in content.files}
    except FileNotFoundError as error:
        raise InputError(f"{path}: cannot read the weights: {error.strerror}") from error
    except Exception as error:  # numpy, zipfile and zlib each have their own for a damaged file
        raise InputError(f"{path}: cannot read the weights: {first_line(error)}") from error
    kernels = [arrays[name] for name in sorted(arrays) if name.endswith("_w")]
    biases = [arrays[name] for name in sorted(arrays) if name.endswith("_b")]
    layers: list[Any] = [m for m in model.modules() if isinstance(m, (nn.Conv2d, nn.Linear))]
    norms: list[Any] = [m for m in model.modules() if isinstance(m, nn.BatchNorm2d)]
    if not norms or len(layers) > min(len(kernels), len(biases)):
        raise InputError(f"{path}: holds {min(len(kernels), len(biases))} layers; the network has {len(layers)}")
    weights = [_unfolded(layer, kernel) for layer, kernel in zip(layers, kernels, strict=False)]
    for number, (layer, weight, bias) in enumerate(zip(layers, weights, biases, strict=False)):
        adds = number < len(norms) or layer.bias is not None
        if weight.shape != layer.weight.shape or bias.shape != weight.shape[:1] or not adds:
            raise InputError(
                f"{path}: layer {number} is {tuple(weight.shape)}; the network's is {tuple(layer.weight.shape)}"
            )
    with torch.no_grad():
        for number, (layer, weight, bias) in enumerate(zip(layers, weights, biases, strict=False)):
            layer.weight.copy_(weight)
            if number >= len(norms):
                layer.bias.copy_(torch.from_numpy(bias))
                continue
            _only_adds(norms[number], torch.from_numpy(bias))


def read_model(path: str | Path) -> tuple[ModelInfo, dict[str, Tensor]]:
    """What a model file says of itself, and its tensors by their names in `KeypointNet`.

    The exporter folds most batch norms into the convolutions before them, and calls what they add "<weight>_bias":
    `fold_back` turns these into batch norms again. Raises InputError for a file that is no model of ours, or whose
    weights are not in fp32.
    """
    info = KeypointDetector(path).info
    if info.precision != "fp32":
        raise InputError(f"{path}: a model in {info.precision}; only one in fp32 can be trained on")
    named: dict[str, Tensor] = {}
    for tensor in onnx.load(path).graph.initializer:
        name = tensor.name.removeprefix("net.")
        if "." in name:
            named[name.removeprefix("corners.") if name.startswith("corners.corners.") else name] = torch.from_numpy(
                numpy_helper.to_array(tensor).copy()
            )
    return info, named


def fold_back(net: Any, tensors: dict[str, Tensor], size: int, source: str | Path) -> dict[str, Tensor]:
    """The state of a `KeypointNet` of inputs (B, 3, S, S) from `read_model`'s tensors: a batch norm that was folded
    into the convolution before it adds what that added, and does no more. Raises InputError if one is lacking.
    """
    state, names = dict(net.state_dict()), {id(module): name for name, module in net.named_modules()}
    came: dict[int, tuple[str, Tensor]] = {}  # an output: whose it is; held, or its id would be another's

    def passed(layer: nn.Module, inputs: Any, output: Tensor) -> None:
        came[id(output)] = names[id(layer)], output

    def normed(norm: Any, inputs: Any) -> None:
        name = names[id(norm)]
        before = came.get(id(inputs[0]), ("", None))[0]
        folded = tensors.get(f"{before}.weight_bias")
        if folded is not None and folded.shape == norm.bias.shape and f"{name}.weight" not in tensors:
            _only_adds(norm, folded)
            tensors.update({f"{name}.{part}": value for part, value in norm.state_dict().items()})

    hooks = [m.register_forward_hook(passed) for m in net.modules() if list(m.parameters(recurse=False))]
    hooks += [m.register_forward_pre_hook(normed) for m in net.modules() if isinstance(m, nn.BatchNorm2d)]
    net.eval()
    with torch.no_grad():
        net(torch.zeros(1, 3, size, size))
        if net.corners is not None:
            net(torch.zeros(1, 4, 3, PATCH_PX, PATCH_PX))
    for hook in hooks:
        hook.remove()
    used = {name for name, _ in came.values()}
    for name, mine in state.items():
        layer, _, kind = name.rpartition(".")
        if kind != "num_batches_tracked" and layer in used:  # the head fc makes no use of the neck
            given = tensors.get(name)
            if given is None or given.shape != mine.shape:
                raise InputError(f"{source}: does not hold {name} of the network that it describes")
            state[name] = given
    return state


def _only_adds(norm: Any, bias: Tensor) -> None:
    """Make a batch norm add a bias in evaluation, and do no more."""
    norm.running_mean.zero_()
    norm.running_var.fill_(1.0)
    norm.weight.fill_((1.0 + norm.eps) ** 0.5)
    norm.bias.copy_(bias)


def _unfolded(layer: Any, kernel: np.ndarray[Any, Any]) -> Tensor:
    """A kernel of TensorFlow's in torch's order of axes."""
    if kernel.ndim != 4:
        return torch.from_numpy(kernel)
    depthwise = isinstance(layer, nn.Conv2d) and layer.groups > 1
    moved = torch.from_numpy(np.ascontiguousarray(kernel.transpose((3, 0, 1, 2) if depthwise else (0, 3, 1, 2))))
    return moved.flatten(1) if isinstance(layer, nn.Linear) else moved


def settle_batch_norm(model: nn.Module, pictures: Tensor) -> None:
    """Give each batch norm the mean and variance of what it sees, and undo them in its weight and bias.

    What the network computes stays as it is; but in training, where a batch norm uses the batch's own
    statistics, it now starts from about the same function instead of another one.
    """

    def measure(norm: Any, inputs: tuple[Tensor, ...]) -> None:
        (seen,) = inputs
        mean, variance = seen.mean(dim=(0, 2, 3)), seen.var(dim=(0, 2, 3), unbiased=False)
        gain = norm.weight / (norm.running_var + norm.eps).sqrt()
        norm.bias += gain * (mean - norm.running_mean)
        norm.weight.copy_(gain * (variance + norm.eps).sqrt())
        norm.running_mean.copy_(mean)
        norm.running_var.copy_(variance)

    norms = [module for module in model.modules() if isinstance(module, nn.BatchNorm2d)]
    hooks = [norm.register_forward_pre_hook(measure) for norm in norms]
    was = model.training
    model.eval()
    try:
        with torch.no_grad():
            model(pictures)
    finally:
        for hook in hooks:
            hook.remove()
        model.train(was)
