"""Real pictures the network never saw: LARD's sample, crops from the labelled box."""

import json
from pathlib import Path

import pytest
from test_cli import call

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.is_dir(), reason="shared/data is not here")
def test_corners_on_real_pictures_beat_the_prototype(tmp_path, capsys):
    # docs/results.md: median 0.36 px, 1.14 px at 90 %, 70 and 89 % within the intervals for 68 and 95 %;
    # distance 2.3 %. (The prototype to beat: 1.55 px, 12 px, 30 %.)
    folder = SHARED / "lard_sample"
    status, out, _ = call(capsys, "run", folder, "--runways", SHARED / "lard_runways.json", "--out", tmp_path, "--json")
    assert status == 0
    figures = json.loads(out)
    assert figures["frames"] == 78
    assert figures["all"]["median_px"] < 0.5
    assert figures["all"]["p90_px"] < 1.4
    assert 0.6 < figures["all"]["coverage_68"] < 0.8
    assert figures["near"]["coverage_95"] > 0.8
    assert figures["distance_error"]["median"] < 0.04
