"""How long does one picture take? Networks in ONNX Runtime and OpenVINO, batch 1, on the processor.

All models in both runtimes take turns of one call, round after round, so that whatever else the
machine does hits all alike; each finds the caches as the others left them, as a network does between
the rest of a pipeline. Two threads each, fp32. A row's ratio is to ResNet-18 in the same runtime. The
weights are random: they do not change how long a network takes. ResNets and EfficientNet as in the
paper (arXiv 2508.09732), with the last feature map only; beside ours, the model file that ships, and
any others that are named.

    python benchmarks/latency.py [MODEL.onnx ...] [--rounds 300] [--threads 2] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shortfinal.detector import shipped_model

Call = Callable[[], NDArray[np.float32]]  # one inference: means (1, K, 2)

REFERENCE = "ResNet-18"
NETWORKS: dict[str, dict[str, Any]] = {
    "default (MobileNetV4-conv-small)": {},
    REFERENCE: {"backbone": "resnet18", "features": (32,)},
    "ResNet-50": {"backbone": "resnet50", "features": (32,)},
    "EfficientNet-B5": {"backbone": "efficientnet_b5", "features": (32,)},
}
SIZE = 224
WARM_UP = 20  # rounds


def write_network(path: Path, size: int = SIZE, **network: Any) -> None:
    """A KeypointNet with random weights as an ONNX file: one picture in, what a model file gives out."""
    import torch

    from shortfinal.train.model import KeypointNet

    class Outputs(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.net = KeypointNet(**network)

        def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, ...]:
            said = self.net(image)
            return said.mean_px, said.cov_px, said.visible.sigmoid(), said.present.sigmoid()

    torch.manual_seed(0)
    torch.onnx.export(
        Outputs().eval(), (torch.zeros(1, 3, size, size),), path, input_names=["image"],
        output_names=["mean_px", "cov_px", "visible", "present"], dynamo=True, external_data=False, verbose=False,
    )  # fmt: skip


def onnx_runtime(path: Path, threads: int) -> Call:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    # Or its threads go on spinning into the next one's turn.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    image = _picture(session.get_inputs()[0].shape[-1])
    return lambda: session.run(["mean_px"], {"image": image})[0]


def openvino(path: Path, threads: int) -> Call:
    from openvino import Core

    core = Core()
    model = core.read_model(path)
    image = _picture(model.input("image").partial_shape[3].get_length())
    model.reshape({"image": image.shape})  # model files leave the batch open
    # fp32 is asked for: where the processor has bf16 it would be taken.
    wanted = {"INFERENCE_NUM_THREADS": threads, "PERFORMANCE_HINT": "LATENCY", "INFERENCE_PRECISION_HINT": "f32"}
    request = core.compile_model(model, "CPU", wanted).create_infer_request()
    return lambda: request.infer({"image": image}, share_inputs=True)["mean_px"]


RUNTIMES: dict[str, Callable[[Path, int], Call]] = {"ONNX Runtime": onnx_runtime}
if find_spec("openvino"):
    RUNTIMES["OpenVINO"] = openvino


def _picture(size: int) -> NDArray[np.float32]:
    return np.random.default_rng(0).normal(size=(1, 3, size, size)).astype(np.float32)


def measure(calls: Mapping[Any, Call], rounds: int, warm_up: int = WARM_UP) -> dict[Any, NDArray[np.float64]]:
    """Milliseconds (rounds,) of each call, one after the other in another order each round."""
    order, names = np.random.default_rng(1), list(calls)
    times: dict[Any, list[float]] = {name: [] for name in names}
    for number in range(warm_up + rounds):
        for place in order.permutation(len(names)):
            begin = time.perf_counter()
            calls[names[place]]()
            if number >= warm_up:
                times[names[place]].append(1e3 * (time.perf_counter() - begin))
    return {name: np.array(values) for name, values in times.items()}


def table(models: Mapping[str, Path], rounds: int, threads: int, warm_up: int = WARM_UP) -> list[dict[str, Any]]:
    """A row a model: size of the file, and of each runtime median, 99 % and how many times as fast as REFERENCE."""
    calls = {(m, r): load(path, threads) for m, path in models.items() for r, load in RUNTIMES.items()}
    times = measure(calls, rounds, warm_up)
    rows = []
    for name, path in models.items():
        row: dict[str, Any] = {"model": name, "megabytes": path.stat().st_size / 1e6}
        for runtime in RUNTIMES:
            median, p99 = np.percentile(times[name, runtime], [50, 99])
            reference = np.median(times[REFERENCE, runtime])
            row[runtime] = {
                "median_ms": float(median),
                "p99_ms": float(p99),
                "times_as_fast": float(reference / median),
            }
        rows.append(row)
    return rows


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    head, rule = ["model", "MB"], ["---", "---:"]
    for runtime in RUNTIMES:
        head += [f"{runtime}: median ms", "99 % ms", "times as fast"]
        rule += ["---:"] * 3
    lines = [head, rule]
    for row in rows:
        cells = [row["model"], f"{row['megabytes']:.1f}"]
        for runtime in RUNTIMES:
            figures = row[runtime]
            cells += [f"{figures['median_ms']:.2f}", f"{figures['p99_ms']:.2f}", f"{figures['times_as_fast']:.2f}"]
        lines.append(cells)
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("files", nargs="*", type=Path, help="further model files")
    parser.add_argument("--rounds", type=int, default=300)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    options = parser.parse_args()
    files = {"ships: runway.onnx": shipped_model()} | {file.name: file for file in options.files}
    with tempfile.TemporaryDirectory() as folder:
        models = {name: Path(folder) / f"{number}.onnx" for number, name in enumerate(NETWORKS)}
        for name, path in models.items():
            write_network(path, **NETWORKS[name])
        rows = table(models | files, options.rounds, options.threads)
    load = os.getloadavg()[0]
    if options.json:
        print(json.dumps({"threads": options.threads, "rounds": options.rounds, "load": load, "rows": rows}, indent=1))
        return
    print(markdown(rows))
    print(f"\n{options.rounds} rounds, {options.threads} threads, fp32 but for what a file says; load {load:.1f}")
    if "OpenVINO" not in RUNTIMES:
        print("OpenVINO is not installed: pip install openvino")


if __name__ == "__main__":
    main()
