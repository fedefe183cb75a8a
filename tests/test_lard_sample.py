"""Real pictures the network never saw: LARD's sample, crops from the labelled box."""

import json
from pathlib import Path

import pytest
from test_cli import call

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.is_dir(), reason="shared/data is not here")
def test_corners_on_real_pictures_beat_the_prototype(tmp_path, capsys):
    # The prototype the shipped model has to beat: median 1.55 px, 12 px at 90 %, 30 % in 68 %.
    folder = SHARED / "lard_sample"
    status, out, _ = call(capsys, "run", folder, "--runways", SHARED / "lard_runways.json", "--out", tmp_path, "--json")
    assert status == 0
    figures = json.loads(out)
    assert figures["frames"] == 78
    assert figures["all"]["median_px"] < 1.55
    assert figures["all"]["p90_px"] < 12.0
    assert figures["all"]["coverage_68"] > 0.30
