"""Frames as a table: a folder of Parquet files with one row a frame, in flat columns (docs/sinks.md)."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from shortfinal.errors import InputError
from shortfinal.files import make_folder
from shortfinal.keypoints import CORNER_NAMES
from shortfinal.pipeline import FrameResult
from shortfinal.pose import PoseEstimate

Array = NDArray[np.float64]

ROWS = 300  # of a file: ten seconds of a camera of 30 frames/s, and the most that a kill loses

_CORNERS = [name.replace("-", "_") for name in CORNER_NAMES]
_POSITION, _ANGLES = ("x_m", "y_m", "z_m"), ("yaw_deg", "pitch_deg", "roll_deg")
_LEVELS = ("along_m", "cross_m", "vertical_m", "lateral_deg", "vertical_deg")
_CROP = ("crop_left", "crop_top", "crop_width", "crop_height")
_VELOCITY = ("track_vx_mps", "track_vy_mps", "track_vz_mps")
_INTEGERS = ("frame", "timestamp_ns", "dof")
_TEXTS = ("decision", "reasons", "status", "track_state", "track_reason")
_LISTS = {"keypoints_cov_px2": 36, "pose_cov": 21, "track_cov": 45}  # upper triangles, row by row
_NUMBERS = (
    "statistic", "p_value", "present", *_CROP,
    *(f"{corner}_{axis}_px" for corner in _CORNERS for axis in "uv"),
    *_POSITION, *(f"sigma_{name}" for name in _POSITION), *_ANGLES, *(f"level_{name}" for name in _LEVELS),
    *(f"track_{name}" for name in _POSITION), *(f"track_sigma_{name}" for name in _POSITION),
    *(f"track_{name}" for name in _ANGLES), *_VELOCITY, "track_innovation_p", "track_coasting_s",
)  # fmt: skip


class ParquetSink:
    """Writes `frames-00000.parquet`, `frames-00001.parquet`, ... of `ROWS` frames each into a folder, whole.

    What is not known of a frame is null; a level that cannot be given is infinite. A folder reads as
    one table, while it grows too.
    """

    def __init__(self, folder: str | Path) -> None:
        """Raises InputError if the folder cannot be made, holds such files already, or without pyarrow."""
        try:
            import pyarrow
            import pyarrow.parquet
        except ModuleNotFoundError as error:
            raise InputError("Parquet needs the package pyarrow: pip install 'shortfinal[data]'") from error
        self._arrow: Any = pyarrow
        self.folder = make_folder(folder)
        if any(self.folder.glob("frames-*.parquet")):
            raise InputError(f"{self.folder}: holds the frames of another flight; choose an empty folder")
        self._schema = _schema(pyarrow)
        self._rows: list[dict[str, Any]] = []
        self._files = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        self.close()

    def write(self, frame: int, result: FrameResult, image: NDArray[np.uint8] | None = None) -> None:
        """Append a frame; the picture is left out. Raises InputError if a file is due and cannot be written.

        The frames that it would have held are kept then, and written with the next.
        """
        self._rows.append(row_of(frame, result))
        if len(self._rows) % ROWS == 0:
            self._flush()

    def close(self) -> None:
        """Write the last file. Raises InputError if it cannot be written."""
        if self._rows:
            self._flush()

    def _flush(self) -> None:
        path = self.folder / f"frames-{self._files:05d}.parquet"
        # Readers of folders pass over names that begin with a dot, should a kill leave one.
        partial = path.with_name(f".{path.name}")
        try:
            table = self._arrow.Table.from_pylist(self._rows, self._schema)
            self._arrow.parquet.write_table(table, partial, compression="zstd")
            partial.replace(path)
        except OSError as error:
            with suppress(OSError):
                partial.unlink(missing_ok=True)
            raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
        self._rows, self._files = [], self._files + 1


def row_of(frame: int, result: FrameResult) -> dict[str, Any]:
    """The columns of a frame by name; those without a value are left out."""
    verdict, track = result.verdict, getattr(result, "track", None)
    row: dict[str, Any] = {
        "frame": frame, "timestamp_ns": round(1e9 * result.timestamp_s), "decision": verdict.decision.value,
        "reasons": "; ".join(verdict.reasons), "statistic": verdict.statistic, "dof": verdict.dof,
        "p_value": verdict.p_value, "present": result.present, "timings_ms": list(result.timings.items()),
    }  # fmt: skip
    if result.crop is not None:
        crop = result.crop
        row |= zip(_CROP, (crop.left, crop.top, crop.width, crop.height), strict=True)
    if result.keypoints is not None:
        for name, (u, v) in zip(_CORNERS, result.keypoints.mean_px[:4].tolist(), strict=True):
            row |= {f"{name}_u_px": u, f"{name}_v_px": v}
        row["keypoints_cov_px2"] = _upper(result.keypoints.cov_px[:8, :8])
    if result.estimate is not None:
        row |= _columns_of(result.estimate)
    if result.protection is not None:
        row |= {f"level_{name}": float(level) for name, level in zip(_LEVELS, result.protection.levels, strict=True)}
    return row if track is None else row | _track_columns(track)


def _columns_of(estimate: PoseEstimate) -> dict[str, Any]:
    row: dict[str, Any] = {"status": estimate.status.value}
    if estimate.pose is not None and estimate.cov is not None:
        row |= _pose_columns("", estimate.pose, estimate.cov)
        row["pose_cov"] = _upper(estimate.cov)
    return row


def _track_columns(track: Any) -> dict[str, Any]:
    row: dict[str, Any] = {
        "track_state": track.state.value, "track_reason": track.reason, "track_taken": track.taken,
        "track_innovation_p": track.innovation_p, "track_coasting_s": track.coasting_s,
    }  # fmt: skip
    if track.pose is not None:
        row |= _pose_columns("track_", track.pose, track.cov)
        row |= zip(_VELOCITY, track.velocity_mps.tolist(), strict=True)
        row["track_cov"] = _upper(track.cov)
    return row


def _pose_columns(prefix: str, pose: Any, cov: Array) -> dict[str, float]:
    sigma = np.sqrt(np.diag(cov)[:3]).tolist()
    values = (*pose.position_m.tolist(), *sigma, *pose.attitude)
    names = (*_POSITION, *(f"sigma_{name}" for name in _POSITION), *_ANGLES)
    return {f"{prefix}{name}": value for name, value in zip(names, values, strict=True)}


def _upper(matrix: Array) -> list[float]:
    values: list[float] = matrix[np.triu_indices(len(matrix))].tolist()
    return values


def _schema(arrow: Any) -> Any:
    return arrow.schema(
        [(name, arrow.int64()) for name in _INTEGERS]
        + [(name, arrow.string()) for name in _TEXTS]
        + [(name, arrow.float64()) for name in _NUMBERS]
        + [("track_taken", arrow.bool_())]
        + [(name, arrow.list_(arrow.float64(), length)) for name, length in _LISTS.items()]
        + [("timings_ms", arrow.map_(arrow.string(), arrow.float64()))]
    )
