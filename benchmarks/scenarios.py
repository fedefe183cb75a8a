"""Every fault of `shortfinal.scenarios`, flown: what rose, after how long, what was accepted meanwhile.

    python benchmarks/scenarios.py [--out docs/results] [--fault black ...]

Prints the table of docs/faults.md and writes it as scenarios.md and scenarios.json. About a minute on two cores.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from shortfinal.crops import box_around
from shortfinal.demo import RUNWAY
from shortfinal.detector import KeypointDetector
from shortfinal.files import write_whole
from shortfinal.geometry import project
from shortfinal.integrity import Decision
from shortfinal.pipeline import LandingPipeline
from shortfinal.runway import Runway
from shortfinal.scenarios import CAMERA, INTEGRITY_RISK, RISES, Approach, Fault, Outcome, fly_with, render_approach

COLUMNS = ("fault", "rose", "after, s", "accepted meanwhile", "largest error, m", "over its level", "accepted again, s")


def row(outcome: Outcome) -> dict[str, Any]:
    """What came of a flight, as plain values."""
    fault = outcome.fault
    rises = RISES.get(fault, "^$") if fault else "^$"
    after = outcome.rose_after_s(rises)
    said = [words for m in outcome.during if not m.accepted for words in m.words.split("; ") if re.search(rises, words)]
    error, again = outcome.largest_error_m, outcome.recovered_after_s
    return {
        "fault": "none" if fault is None else fault.value,
        "rose": said[0] if said else None,
        "after_s": None if after is None else round(after, 2),
        "frames": len(outcome.during),
        "accepted": len(outcome.accepted),
        "without_a_bound": outcome.unbounded,
        "largest_error_m": None if error is None else [round(float(e), 1) for e in error],
        "over_level": None if outcome.worst is None else round(outcome.worst, 3),
        "again_after_s": None if again is None or not math.isfinite(outcome.end_s) else round(again, 2),
        "notes": [re.sub(r"\S*/tmp\w+", "results", note) for note in outcome.notes],
        "facts": {k: v for k, v in outcome.facts.items() if k != "poses_s"},
    }


def cells(record: dict[str, Any]) -> list[str]:
    """A row of the table."""
    accepted = f"{record['accepted']} of {record['frames']}"
    if record["without_a_bound"]:
        accepted += f", {record['without_a_bound']} without a bound"
    error = record["largest_error_m"]
    return [
        record["fault"], (record["rose"] or "–")[:90], _number(record["after_s"]), accepted,
        "–" if error is None else " / ".join(f"{e:g}" for e in error),
        _number(record["over_level"]), _number(record["again_after_s"]),
    ]  # fmt: skip


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.2g}"


def table(records: list[dict[str, Any]]) -> str:
    """As Markdown."""
    lines = [COLUMNS, ("---",) * len(COLUMNS), *(cells(record) for record in records)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def unseen(approach: Approach, name: str, runway: Runway, *, mirrored: bool = False) -> dict[str, Any]:
    """What one picture cannot show: every fifth frame by itself, looked at in the right place; how far off it is."""
    pipeline = LandingPipeline(KeypointDetector(), runway, CAMERA, integrity_risk=INTEGRITY_RISK)
    errors, ratios, frames = [np.zeros(3)], [0.0], range(0, len(approach.images), 5)
    for n in frames:
        image, box = approach.images[n], box_around(project(CAMERA, approach.poses[n], RUNWAY.corners))
        if mirrored:
            image = np.ascontiguousarray(image[:, ::-1])
            box[[0, 2]] = CAMERA.width - 1 - box[[2, 0]]
        result = pipeline.step(image, float(approach.times_s[n]), box=box)
        if result.verdict.decision is Decision.USE and result.estimate is not None and result.estimate.pose is not None:
            errors.append(np.abs(result.estimate.pose.position_m - approach.poses[n].position_m))
            levels = result.protection
            ratios.append(0.0 if levels is None else float((errors[-1] / np.array(levels.levels[:3])).max()))
    return {
        "fault": name, "used": len(ratios) - 1, "frames": len(frames),
        "largest_error_m": np.max(errors, axis=0).round(1).tolist(), "over_level": round(max(ratios), 3),
    }  # fmt: skip


def main() -> None:
    """Fly them all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="write scenarios.md and scenarios.json there")
    parser.add_argument("--fault", nargs="*", choices=[fault.name.lower() for fault in Fault], help="only these")
    options = parser.parse_args()
    chosen = [Fault[name.upper()] for name in options.fault] if options.fault else [None, *Fault]
    approach, records = render_approach(), []
    for fault in chosen:
        with tempfile.TemporaryDirectory() as folder:
            records.append(row(fly_with(fault, approach, Path(folder))))
        print(table(records[-1:]).splitlines()[-1], flush=True)
    scale = 4.0 / 3.0
    hidden = [
        unseen(approach, "mirrored from the start", RUNWAY, mirrored=True),
        unseen(approach, "a runway of the same proportions loaded, a third larger",
               Runway(scale * RUNWAY.length_m, scale * RUNWAY.width_m)),
    ]  # fmt: skip
    print(json.dumps(hidden, indent=1))
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        write_whole(options.out / "scenarios.md", table(records))
        write_whole(options.out / "scenarios.json", json.dumps({"flights": records, "frames": hidden}, indent=1) + "\n")


if __name__ == "__main__":
    main()
