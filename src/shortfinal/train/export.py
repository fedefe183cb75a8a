"""From a checkpoint to the model file: ONNX, with its description inside, checked against torch.

In fp16 and int8 the backbone is lowered. What locates (the fused map, soft argmax, sigmas) stays in
float32: a coordinate of 200 px has steps of 1/8 px in fp16.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
import onnx
import onnx_ir
import onnxruntime
import torch
from numpy.typing import NDArray
from onnx import GraphProto, ModelProto, NodeProto, TensorProto, compose, helper, numpy_helper
from torch import Tensor, nn

from shortfinal.calibrate import framed
from shortfinal.crops import PATCH_PX
from shortfinal.data.dataset import read_dataset
from shortfinal.detector import (
    CORNER_OUTPUTS,
    FORMAT,
    OUTPUTS,
    PATCHES,
    SEARCH,
    SHARPEN,
    WHERE,
    ModelInfo,
    Precision,
    crop_image,
    described,
    normalise,
)
from shortfinal.errors import InputError, JobError
from shortfinal.files import write_whole
from shortfinal.train.fit import load_checkpoint, network_of, network_weights
from shortfinal.train.model import Corners, KeypointNet, Prediction

Array = NDArray[np.float64]
Pictures = NDArray[np.float32]  # (N, 3, S, S), normalised

_PICTURES = 200  # of a data set: every other one to set the ranges of int8, the others to compare on
_FEWEST = 16
_BATCH = 16
_TRIES = 8  # of int8: how much of the backbone stays in floating point
_QUANTISED = ("Conv", "Gemm", "MatMul", "Add", "Relu")


class Difference(NamedTuple):
    """How far a model file is from torch, as root mean squares."""

    mean_px: float
    sigma: float  # relative, or of correlations if that is more
    probability: float

    def within(self, limit: Difference) -> bool:
        """Whether no part exceeds the limit's, and all are numbers."""
        return all(mine <= most for mine, most in zip(self, limit, strict=True))

    def __str__(self) -> str:
        return f"{self.mean_px:.2g} px, {self.sigma:.2%} of sigma, {self.probability:.2g} of probability"


# float32: ten times what the rounding of a trained network was (0.0004 px of 224); the others: what may be lost.
LIMITS: dict[Precision, Difference] = {
    "fp32": Difference(5e-3, 1e-3, 2e-4),
    "fp16": Difference(0.05, 0.01, 0.01),
    "int8": Difference(0.1, 0.05, 0.05),
}


class Network(nn.Module):
    """What the model file computes."""

    def __init__(self, net: KeypointNet) -> None:
        super().__init__()
        self.net = net

    @property
    def outputs(self) -> tuple[str, ...]:
        """The names of what it gives."""
        return OUTPUTS if self.net.where is None else (*OUTPUTS, WHERE)

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        """Pictures (B, 3, S, S) to the file's outputs: (B, K, 2), (B, 2K, 2K), (B, K), (B,) and, if the network says
        where runways are, (B, 2, H, W): the probability that a box's centre is in a cell, and its longer side, px.
        """
        told = self.net(image)
        answer = (told.mean_px, told.cov_px, told.visible.sigmoid(), told.present.sigmoid())
        if told.where is None:
            return answer
        return (*answer, torch.stack([told.where[:, 0].sigmoid(), told.where[:, 1].clamp(0, 7).exp()], dim=1))


class _CornerNetwork(nn.Module):
    """What the model file computes of patches: (N, 4, 3, P, P) to CORNER_OUTPUTS."""

    def __init__(self, corners: Corners) -> None:
        super().__init__()
        self.corners = corners

    def forward(self, patches: Tensor) -> tuple[Tensor, ...]:
        told: Prediction = self.corners(patches)
        return told.mean_px, told.cov_px, told.visible.sigmoid()


def load_network(checkpoint: str | Path) -> tuple[Network, dict[str, Any]]:
    """The averaged network of a checkpoint, ready for inference, and the checkpoint's content.

    Raises InputError for a file that is no checkpoint, or whose weights are not of its recipe's network.
    """
    state = load_checkpoint(checkpoint)
    weights = network_weights(state)
    net = network_of(state["recipe"], weights)
    try:
        net.load_state_dict(weights)
    except RuntimeError as error:
        raise InputError(f"{checkpoint}: its weights are not those of the network in its recipe") from error
    return Network(net).eval(), state


def export(
    checkpoint: str | Path, out: str | Path, precision: Precision = "fp32", data: str | Path | None = None
) -> ModelInfo:
    """Write the checkpoint's network to the ONNX file `out`, and hold it against torch.

    On crops of the data set `data`, else on random pictures. int8 needs one: half of the crops set the
    ranges of the backbone's layers, the other half compare. Its first layers stay in floating point as
    far as the `LIMITS` make it necessary. Raises InputError for a file that is no checkpoint, a data set
    of no use, or an unknown precision; JobError if ONNX Runtime and torch differ by more than the
    limits. Nothing is written then.
    """
    if precision not in get_args(Precision):
        raise InputError(f"precision: {precision!r}; expected one of {', '.join(get_args(Precision))}")
    if precision == "int8" and data is None:
        raise InputError("data: int8 needs a data set, to see what ranges its layers take")
    target = _writable(Path(out))
    network, state = load_network(checkpoint)
    info = _info(state, precision)
    pictures = random_pictures(info.size) if data is None else _crops(data, info)
    model = to_onnx(network, info.size)
    if precision == "int8":
        model, difference, share = _quantised(model, network, pictures[::2], pictures[1::2])
        info.figures["int8_share"] = share
        model = _on_request(model)
    else:
        model = _on_request(model if precision == "fp32" else _halved(model))
        difference = compare(model, pictures, answers_of(network, pictures))
    if not difference.within(LIMITS[precision]):
        raise JobError(
            f"{checkpoint}: in {precision} it differs from torch by {difference}; "
            f"allowed are {LIMITS[precision]}; not written"
        )
    info.figures.update({f"export_{name}": value for name, value in difference._asdict().items()})
    if network.net.corners is not None:
        model = _with_corners(model, network.net.corners)
    write_whole(target, described(_stripped(model).SerializeToString(), info))
    return info


def _info(state: dict[str, Any], precision: Precision) -> ModelInfo:
    recipe = state["recipe"]
    data = [recipe["data"]] if isinstance(recipe["data"], str) else recipe["data"]
    training = {name: recipe[name] for name in ("batch", "seed", "head", "features", "width")}
    return ModelInfo(
        format=FORMAT, size=recipe["size"], mean=tuple(recipe["mean"]), std=tuple(recipe["std"]),
        keypoints=tuple(recipe["keypoints"]), covariance=recipe["covariance"], margin=recipe["margin"],
        backbone=recipe["backbone"], precision=precision,
        training={"data": [Path(name).name for name in data], "steps": state["step"], **training},
        figures={name: value for name, value in state["history"][-1].items() if math.isfinite(value)},
        calibration=None,
    )  # fmt: skip


def to_onnx(network: Network, size: int) -> ModelProto:
    """The network in float32, for any number of pictures; its nodes still say of which module they are."""
    return _traced(network, torch.zeros(2, 3, size, size), "image", "batch", network.outputs)


def _traced(network: nn.Module, pictures: Tensor, name: str, many: str, outputs: Sequence[str]) -> ModelProto:
    """A network of one input, called `name` as its forward calls it, for any number of pictures, called `many`."""
    number = torch.export.Dim(many, min=1, max=4096)
    program = torch.onnx.export(
        network, (pictures,), input_names=[name], output_names=list(outputs), dynamo=True,
        dynamic_shapes={name: {0: number}}, verbose=False,
    )  # fmt: skip
    assert program is not None
    return program.model_proto


def _on_request(model: ModelProto) -> ModelProto:
    """With all that only WHERE needs under a condition, the optional input SEARCH, which is false if not given."""
    if WHERE not in {output.name for output in model.graph.output}:
        return model
    needed, others = set(OUTPUTS), list[NodeProto]()
    for node in reversed(model.graph.node):
        if needed & set(node.output):
            needed |= set(node.input)
        else:
            others.insert(0, node)
    conditional = ModelProto()
    conditional.CopyFrom(model)
    graph = conditional.graph
    kept = [node for node in graph.node if needed & set(node.output)]
    del graph.node[:]
    graph.node.extend(kept)
    _ask_for(graph, SEARCH, others, {WHERE: (1, 2, 0, 0)})
    declared = next(output for output in graph.output if output.name == WHERE)
    declared.CopyFrom(helper.make_tensor_value_info(WHERE, TensorProto.FLOAT, ["batch", 2, "rows", "columns"]))
    return conditional


def _ask_for(
    graph: GraphProto, condition: str, nodes: Sequence[NodeProto], outputs: Mapping[str, Sequence[int]]
) -> None:
    """Make `outputs` by `nodes` where the `condition`, an optional input, is true, and else nothing, of that shape."""
    for node in nodes:
        for names in (node.input, node.output):
            names[:] = [f"{name}.asked" if name in outputs else name for name in names]
    told = [helper.make_tensor_value_info(f"{name}.asked", TensorProto.FLOAT, None) for name in outputs]
    nothing = [numpy_helper.from_array(np.zeros(size, np.float32), f"{n}.unasked") for n, size in outputs.items()]
    constants = [helper.make_node("Constant", [], [tensor.name], value=tensor) for tensor in nothing]
    untold = [helper.make_tensor_value_info(tensor.name, TensorProto.FLOAT, None) for tensor in nothing]
    graph.node.append(
        helper.make_node(
            "If", [condition], list(outputs), then_branch=helper.make_graph(nodes, f"{condition} asked", [], told),
            else_branch=helper.make_graph(constants, f"{condition} not asked", [], untold),
        )
    )  # fmt: skip
    graph.input.append(helper.make_tensor_value_info(condition, TensorProto.BOOL, []))
    graph.initializer.append(numpy_helper.from_array(np.array(False), condition))


def _with_corners(model: ModelProto, corners: Corners) -> ModelProto:
    """With the network that looks at each corner beside it, in float32; it has an input and outputs of its own.

    Both are optional, PATCHES and SHARPEN, which is false if not given; then it is not computed. Raises JobError if
    ONNX Runtime and torch differ by more than the limits.
    """
    network = _CornerNetwork(corners).eval()
    patches = random_pictures(PATCH_PX, 4 * _BATCH).reshape(-1, 4, 3, PATCH_PX, PATCH_PX)
    beside = _traced(network, torch.from_numpy(patches[:2]), PATCHES, "looks", CORNER_OUTPUTS)
    difference = compare(beside, patches, answers_of(network, patches))
    if not difference.within(LIMITS["fp32"]):
        raise JobError(f"the part that looks at corners differs from torch by {difference}; not written")
    beside = compose.add_prefix(beside, "corners.", rename_inputs=False, rename_outputs=False)
    joined = ModelProto()
    joined.CopyFrom(model)
    known = {(library.domain, library.version) for library in model.opset_import}
    assert {(library.domain, library.version) for library in beside.opset_import} <= known, "of the same exporter"
    graph = joined.graph
    graph.initializer.extend(beside.graph.initializer)
    graph.input.extend(beside.graph.input)
    graph.output.extend(beside.graph.output)
    graph.initializer.append(numpy_helper.from_array(np.zeros((1, *patches.shape[1:]), np.float32), PATCHES))
    shapes = dict(zip(CORNER_OUTPUTS, ((0, 4, 2), (0, 8, 8), (0, 4)), strict=True))
    _ask_for(graph, SHARPEN, list(beside.graph.node), shapes)
    return joined


def _stripped(model: ModelProto) -> ModelProto:
    """Without what the exporter notes of each node: where it stood in the source, paths included."""
    for part in (*model.graph.node, *model.graph.input, *model.graph.output, *model.graph.value_info, model.graph):
        del part.metadata_props[:]
        part.doc_string = ""
    return model


def random_pictures(size: int, count: int = 16, seed: int = 0) -> Pictures:
    """Smooth noise (count, 3, size, size) of unit variance at the nodes of a grid of 8 px."""
    rng = np.random.default_rng(seed)
    coarse = torch.from_numpy(rng.normal(0, 1, (count, 3, size // 8, size // 8)).astype(np.float32))
    return np.asarray(nn.functional.interpolate(coarse, size=(size, size), mode="bilinear"))


def _crops(data: str | Path, info: ModelInfo) -> Pictures:
    """Runways of a data set, framed as in use."""
    examples = read_dataset(data)
    crops = []
    for n in range(0, len(examples), max(1, len(examples) // _PICTURES)):
        example = examples[n]
        window = None if example.corners_px is None else framed(example.image, example.corners_px, info)
        if window is not None:
            crops.append(normalise(crop_image(example.image, window), info.mean, info.std))
    if len(crops) < _FEWEST:
        raise InputError(f"{data}: {len(crops)} runways; at least {_FEWEST} are needed to compare on")
    return np.stack(crops)


def answers_of(network: nn.Module, pictures: Pictures) -> list[Array]:
    """What torch answers: the arrays of its outputs."""
    with torch.inference_mode():
        answers = [network(torch.from_numpy(batch)) for batch in _batches(pictures)]
    return [torch.cat(parts).double().numpy() for parts in zip(*answers, strict=True)]


def compare(model: ModelProto, pictures: Pictures, wanted: list[Array]) -> Difference:
    """How far ONNX Runtime's answers are from those `wanted` (`answers_of`)."""
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    asked = {given.name: np.array(True) for given in session.get_overridable_initializers() if given.name == SEARCH}
    image = session.get_inputs()[0].name
    answers = [session.run(None, {image: batch, **asked}) for batch in _batches(pictures)]
    mean, cov, *scope = (np.concatenate(parts).astype(np.float64) for parts in zip(*answers, strict=True))
    true_mean, true_cov, *true_scope = wanted
    if len(scope) > len(OUTPUTS) - 2:  # where: lengths count as far as there is a runway
        scope[-1], true_scope[-1] = _weighed(scope[-1], true_scope[-1]), _weighed(true_scope[-1], true_scope[-1])
    sigma, correlation = _split(cov)
    true_sigma, true_correlation = _split(true_cov)
    return Difference(
        _rms(mean - true_mean),
        max(_rms(sigma / true_sigma - 1), _rms(correlation - true_correlation)),
        max(_rms(mine - true) for mine, true in zip(scope, true_scope, strict=True)),
    )


def _weighed(where: Array, true: Array) -> Array:
    """Probabilities, and logarithms of lengths by the true probabilities, (N, 2, H, W)."""
    return np.stack([where[:, 0], np.log(where[:, 1]) * true[:, 0]], axis=1)


def _split(cov: Array) -> tuple[Array, Array]:
    """Sigmas (N, n) and correlations (N, n, n)."""
    sigma = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    return sigma, cov / (sigma[:, :, None] * sigma[:, None, :])


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _batches(pictures: Pictures) -> Iterator[Pictures]:
    return (pictures[start : start + _BATCH] for start in range(0, len(pictures), _BATCH))


def _backbone(model: ModelProto) -> list[NodeProto]:
    """The nodes that the backbone's feature maps come from, in order."""
    nodes: list[NodeProto] = []
    needed: set[str] = set()
    for node in reversed(model.graph.node):
        scopes = next((note.value for note in node.metadata_props if note.key == "pkg.torch.onnx.name_scopes"), "")
        if "'net.backbone'" in scopes or needed & set(node.output):
            nodes.insert(0, node)
            needed |= set(node.input)
    return nodes


def _halved(model: ModelProto) -> ModelProto:
    """With the backbone in fp16.

    Cut off and put back: given nodes to spare, ONNX Runtime's converter still rounds what lies between them.
    """
    from onnx.utils import Extractor
    from onnxruntime.transformers.float16 import convert_float_to_float16

    body = {output for node in _backbone(model) for output in node.output}
    rest = [node for node in model.graph.node if not body & set(node.output)]
    maps = list(dict.fromkeys(name for node in rest for name in node.input if name in body))
    parts = Extractor(model)
    low = convert_float_to_float16(parts.extract_model(["image"], maps), keep_io_types=True)
    in_order = onnx_ir.from_proto(low)
    in_order.graph.sort()
    low = compose.add_prefix(onnx_ir.to_proto(in_order), "backbone.", rename_inputs=False)
    high = parts.extract_model(maps, [output.name for output in model.graph.output])
    return compose.merge_models(low, high, io_map=[(f"backbone.{name}", name) for name in maps])


def _quantised(
    model: ModelProto, network: Network, ranges: Pictures, held_out: Pictures
) -> tuple[ModelProto, Difference, float]:
    """With as much of the backbone in int8 as the limits allow, and which share of its layers; or the last try.

    Its first layers stay in float32: they cost most (what they round away, no later layer sees) and weigh least.
    """
    backbone = _backbone(model)
    layers = [n for n, node in enumerate(backbone) if node.op_type in ("Conv", "Gemm", "MatMul")]
    wanted = answers_of(network, held_out)
    for spared in range(0, len(layers), -(-len(layers) // _TRIES)):
        quantised = _with_int8(model, {node.name for node in backbone[layers[spared] :]}, ranges)
        difference = compare(quantised, held_out, wanted)
        if difference.within(LIMITS["int8"]):
            break
    return quantised, difference, 1 - spared / len(layers)


def _with_int8(model: ModelProto, names: set[str], ranges: Pictures) -> ModelProto:
    """With the nodes of these names in int8, quantised and dequantised around each; one scale a channel."""
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, quantize_static
    from onnxruntime.quantization.quant_utils import add_pre_process_metadata

    class Reader(CalibrationDataReader):  # type: ignore[misc]
        def __init__(self) -> None:
            self.batches = _batches(ranges)

        def get_next(self) -> dict[str, Pictures] | None:
            batch = next(self.batches, None)
            return None if batch is None else {"image": batch}

    spared = [node.name for node in model.graph.node if node.name not in names]
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "int8.onnx"
        copy = ModelProto()
        copy.CopyFrom(model)
        add_pre_process_metadata(copy)  # torch's exporter has folded what pre-processing would; else it warns
        quantize_static(
            copy, path, Reader(), quant_format=QuantFormat.QDQ, per_channel=True, nodes_to_exclude=spared,
            op_types_to_quantize=list(_QUANTISED),
        )  # fmt: skip
        return onnx.load(path)


def _writable(path: Path) -> Path:
    if not path.parent.is_dir():
        raise InputError(f"{path}: no such folder {path.parent}; make it first")
    if path.is_dir():
        raise InputError(f"{path}: cannot be written: Is a directory")
    return path
