"""The latency benchmark: calls take turns, both runtimes compute the same, and the table says what was measured."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from shortfinal.detector import shipped_model

pytest.importorskip("torch")

BENCHMARK = "latency"
# A process that has run OpenVINO and then trains with torch ends in a segmentation fault (2026.4.1, 2.13).
APART = "SHORTFINAL_TEST_APART"
apart = pytest.mark.skipif(APART not in os.environ, reason="run by test_openvino_in_a_process_of_its_own")


@pytest.fixture(scope="module")
def tiny(benchmark, tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "tiny.onnx"
    benchmark.write_network(path, size=64, backbone="test_resnet", features=(32,))
    return path


def test_calls_take_turns(benchmark):
    made = []
    calls = {name: lambda name=name, ms=ms: (made.append(name), time.sleep(ms / 1e3)) for name, ms in
             {"fast": 1, "slow": 20}.items()}  # fmt: skip
    times = benchmark.measure(calls, rounds=5, warm_up=2)
    assert [sorted(made[n : n + 2]) for n in range(0, 14, 2)] == [["fast", "slow"]] * 7
    assert {len(values) for values in times.values()} == {5}
    # A sleep lasts no less than asked for; how much longer is the machine's affair.
    assert times["slow"].min() >= 20
    assert times["fast"].min() >= 1


@pytest.mark.slow
def test_openvino_in_a_process_of_its_own():
    pytest.importorskip("openvino")
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", __file__, "-k", "both_runtimes or the_table"]
    done = subprocess.run(
        command, env={**os.environ, APART: "1"}, cwd=Path(__file__).parent, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-2000:]
    assert "skipped" not in done.stdout


@apart
def test_both_runtimes_compute_the_same(benchmark, tiny):
    pytest.importorskip("openvino")
    one, other = (load(tiny, 1)() for load in benchmark.RUNTIMES.values())
    assert one.shape == (1, 4, 2)
    np.testing.assert_allclose(one, other, rtol=0, atol=64 * 1e-5)  # export's tolerance, of the side


@apart
def test_the_table_has_a_row_a_model_and_ratios_to_the_reference(benchmark, tiny):
    models = {benchmark.REFERENCE: tiny, "ships": shipped_model()}
    rows = benchmark.table(models, rounds=3, threads=1, warm_up=1)
    for runtime in benchmark.RUNTIMES:
        first, second = (row[runtime] for row in rows)
        assert first["times_as_fast"] == 1.0
        assert second["times_as_fast"] == pytest.approx(first["median_ms"] / second["median_ms"])
        assert 0 < second["median_ms"] <= second["p99_ms"]
    lines = benchmark.markdown(rows).splitlines()
    assert len(lines) == 4
    assert len({line.count("|") for line in lines}) == 1
