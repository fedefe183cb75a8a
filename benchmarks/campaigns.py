"""The published campaigns: run, and their tables as Markdown.

    python benchmarks/campaigns.py [--out results/campaigns]

Each file of benchmarks/campaigns/ is a campaign of its own; `shortfinal campaign` runs it as well,
and either goes on where the other stopped.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from shortfinal.campaign.config import read_campaign
from shortfinal.campaign.report import write_figures, write_tables
from shortfinal.campaign.run import run_campaign

HERE = Path(__file__).parent / "campaigns"

Table = list[dict[str, Any]]


def run(name: str, out: Path) -> Table:
    campaign = read_campaign(HERE / f"{name}.toml")
    counts, effort = run_campaign(campaign, out / name)
    print(
        f"{name}: {effort.trials:,} trials in {effort.seconds:.0f} s, at most {effort.peak_mb or 0:.0f} MB a process\n"
    )
    write_figures(campaign, counts, out / name)
    return write_tables(campaign, counts, out / name)


def markdown(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def per_cent(rate: dict[str, Any]) -> str:
    return f"{100 * rate['rate']:.3g}"


def with_interval(rate: dict[str, Any]) -> str:
    return f"{100 * rate['rate']:.3g} ({100 * rate['low']:.3g}–{100 * rate['high']:.3g})"


def correlation(tables: Table) -> str:
    """False alarms against nominal, coverage of the 95 % interval, and the mean NEES."""
    nominal = ("0.05", "0.01", "0.001")
    rows = []
    for table in tables:
        rates = table["rates"]
        alarms = [with_interval(rates[f"p_below_{rate}"]) for rate in nominal]
        inside = " / ".join(per_cent(rates[f"within_95_{axis}"]) for axis in ("along", "cross", "vertical"))
        rows.append([table["name"], *alarms, inside, f"{table['mean_nees']:.2f}"])
    alarms = [f"false alarms %, nominal {100 * float(rate):g} %" for rate in nominal]
    return markdown(["correlation", *alarms, "within 1.96σ, % (along / cross / vertical)", "mean NEES"], rows)


def four_corners(tables: Table) -> str:
    """Per distance: what each prior detects of each fault, and the median protection levels without one."""
    by = {tuple(table["variants"].values()): table for table in tables}
    distances, priors, faults = (list(dict.fromkeys(column)) for column in zip(*by, strict=True))
    parts = []
    sound_name, *shown = faults
    for distance in distances:
        rows = []
        for prior in priors:
            sound = by[distance, prior, sound_name]
            detected = [per_cent(by[distance, prior, fault]["rates"]["detection"]) for fault in shown]
            levels = (axis["median"] for axis in sound["protection_level_m"].values())
            level = " / ".join("none" if v is None else f"{v:.3g}" for v in levels)
            rates = sound["rates"]
            rows.append([prior, with_interval(rates["false_alarm"]), *detected, level, per_cent(rates["available"])])
        head = [f"at {distance}", "false alarms %", *(f"{fault}, detected %" for fault in shown)]
        parts.append(markdown([*head, "median protection level, m (along / cross / vertical)", "available %"], rows))
    return "\n".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--out", type=Path, default=Path("results/campaigns"), help="folder for the results")
    options = parser.parse_args()
    for name, table in (("correlation", correlation), ("four_corners", four_corners)):
        print(table(run(name, options.out)))


if __name__ == "__main__":
    main()
