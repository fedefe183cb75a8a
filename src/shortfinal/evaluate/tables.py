"""Rows and figures as Parquet, for whoever wants to count for themselves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from shortfinal.errors import InputError
from shortfinal.evaluate.rows import AXES, Rows
from shortfinal.files import partial_of
from shortfinal.keypoints import CORNER_NAMES

_PLACES = [f"{name.replace('-', '_')}_{axis}" for name in CORNER_NAMES for axis in "uv"]
_TEXTS = ("picture", "source", "ident", "airport", "light", "decision", "reason")
_NUMBERS = (
    "distance_m", "glide_deg", "lateral_deg", "enlarged", "present", "absent", "statistic", "dof", "p_value",
    "caught_184m", "latency_ms",
)  # fmt: skip


def columns_of(rows: Rows) -> dict[str, Any]:
    """Each column (N,) by name: texts, then numbers; of the covariance its upper triangle, row by row."""
    columns: dict[str, Any] = {name: getattr(rows, name).astype(str) for name in _TEXTS}
    columns |= {name: getattr(rows, name) for name in _NUMBERS}
    for prefix, places in (("true", rows.truth_px), ("found", rows.mean_px), ("sigma", rows.sigma_px)):
        columns |= {f"{prefix}_{name}_px": places.reshape(-1, 8)[:, k] for k, name in enumerate(_PLACES)}
    for k, axis in enumerate(AXES):
        columns |= {
            f"{axis}_error_m": rows.error_m[:, k], f"{axis}_sigma_m": rows.sigma_m[:, k],
            f"{axis}_level_m": rows.level_m[:, k],
        }  # fmt: skip
    upper = np.triu_indices(8)
    columns["cov_px2"] = list(rows.cov_px[:, upper[0], upper[1]])
    return columns


def write_tables(folder: Path, rows: Rows, metrics: list[dict[str, Any]]) -> list[str]:
    """rows.parquet and metrics.parquet, where pyarrow is installed; otherwise nothing, and a note that says so."""
    try:
        import pyarrow as arrow
        import pyarrow.parquet as parquet
    except ModuleNotFoundError:
        return ["rows.parquet and metrics.parquet are not written: pip install 'shortfinal[data]'"]
    tables = {"rows.parquet": arrow.table(columns_of(rows)), "metrics.parquet": arrow.Table.from_pylist(metrics)}
    for name, table in tables.items():
        path = folder / name
        try:
            parquet.write_table(table, partial_of(path), compression="zstd")
            partial_of(path).replace(path)
        except OSError as error:
            partial_of(path).unlink(missing_ok=True)
            raise InputError(f"{path}: cannot be written: {error.strerror}") from error
    return []
