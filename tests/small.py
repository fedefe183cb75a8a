"""A model file that answers the same whatever it sees, and a folder of small labelled pictures."""

import csv
import dataclasses

import cv2
import numpy as np

import shortfinal as sf
from shortfinal.crops import PATCH_PX
from shortfinal.data.formats import CORNER_COLUMNS
from shortfinal.detector import CORNER_OUTPUTS, FORMAT, METADATA_KEY, OUTPUTS, PATCHES, SHARPEN, ModelInfo

INFO = ModelInfo(
    format=FORMAT, size=32, mean=(0.5, 0.5, 0.5), std=(0.25, 0.25, 0.25), keypoints=sf.CORNER_NAMES,
    covariance="full", margin=1.4, backbone="constants", precision="fp32", training={}, figures={}, calibration=None,
)  # fmt: skip
MEAN = np.array([[6.0, 25.0], [25.0, 26.0], [20.0, 7.0], [11.0, 6.0]])


def constant_model(path, info=INFO, mean=MEAN, cov=None, visible=1.0, present=1.0, metadata=None, corners=()):
    """Write the ONNX file; `cov` (2K, 2K) is the identity if not given, `metadata` what `info` says. `corners`: what it
    says of patches, (4, 2), (8, 8) and (4,); nothing if not given.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    k = len(mean)
    arrays = (mean, np.eye(2 * k) if cov is None else cov, np.full(k, visible), np.array(present))
    tensors = [numpy_helper.from_array(np.asarray(a, np.float32)[None], n) for n, a in zip(OUTPUTS, arrays)]
    tensors += [numpy_helper.from_array(np.asarray(a, np.float32)[None], n) for n, a in zip(CORNER_OUTPUTS, corners)]
    given = {PATCHES: np.zeros((1, 4, 3, PATCH_PX, PATCH_PX), np.float32), SHARPEN: np.array(False)} if corners else {}
    optional = [numpy_helper.from_array(a, name) for name, a in given.items()]
    graph = helper.make_graph(
        [helper.make_node("Constant", [], [t.name], value=t) for t in tensors], "constant",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, ["n", 3, info.size, info.size]),
         *[helper.make_tensor_value_info(t.name, t.data_type, list(t.dims)) for t in optional]],
        [helper.make_tensor_value_info(t.name, TensorProto.FLOAT, list(t.dims)) for t in tensors], optional,
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    for key, text in {METADATA_KEY: info.to_json()}.items() if metadata is None else metadata.items():
        model.metadata_props.add(key=key, value=text)
    onnx.save(model, path)
    return path


def labelled_folder(folder, count, idents=("LFPO/24",), seed=0):
    """`count` pictures (64 x 48) of smooth noise with a runway, each a little another; its corners (count, 4, 2)."""
    rng = np.random.default_rng(seed)
    corners = np.array([[12.0, 40], [50, 42], [40, 10], [22, 9]]) + rng.standard_t(3, (count, 4, 2)).clip(-6, 5)
    (folder / "images").mkdir(parents=True)
    with (folder / "labels.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["image", "ident", *CORNER_COLUMNS])
        for n in range(count):
            coarse = rng.integers(0, 256, (6, 8, 3), dtype=np.uint8)
            cv2.imwrite(str(folder / "images" / f"{n}.png"), cv2.resize(coarse, (64, 48)))
            rows.writerow([f"images/{n}.png", idents[n % len(idents)], *corners[n].ravel()])
    return corners


def named(info, *further):
    """The description with more keypoints."""
    return dataclasses.replace(info, keypoints=(*info.keypoints, *further))
