"""What was predicted of each labelled runway, what is true of it, and what came of it: one row each."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Texts = NDArray[np.object_]
Flags = NDArray[np.bool_]

USE, DO_NOT_USE, NOT_MONITORED, MISSING = "use", "do-not-use", "not-monitored", "missing"
DECISIONS = (USE, DO_NOT_USE, NOT_MONITORED, MISSING)  # missing: nothing was predicted
AXES = ("along", "cross", "vertical")


@dataclass(frozen=True)
class Figure:
    """One number that was measured, and the interval that holds the true one with 95 %."""

    value: float
    low: float  # NaN: of too few rows to say
    high: float
    count: int  # of what it is made of: coordinates, rows
    unit: str  # "px", "m", "ms", "" of shares and pure numbers


@dataclass(frozen=True, eq=False)
class Rows:
    """N labelled runways. NaN or "": not known. Frames, units and order as everywhere (docs/architecture.md)."""

    picture: Texts  # (N,) name of the picture in its data set
    source: Texts  # (N,) where the label stands: "labels.csv: line 7"
    ident: Texts  # (N,) "LFPO/24"
    airport: Texts  # (N,) "LFPO"
    light: Texts  # (N,) "night", "dim", "bright"
    truth_px: Array  # (N, 4, 2) labelled corners, pixels of the picture
    mean_px: Array  # (N, 4, 2) predicted ones; NaN where nothing was
    cov_px: Array  # (N, 8, 8)
    enlarged: Array  # (N,) pixels of the network's input for one of the picture's
    distance_m: Array  # (N,) true, from the camera to the middle of the landing threshold
    glide_deg: Array  # (N,) true angle of that line above the runway
    lateral_deg: Array  # (N,) true angle of that line to the left of the centreline
    decision: Texts  # (N,) one of DECISIONS
    reason: Texts  # (N,) in words
    present: Array  # (N,) probability that a runway is in view
    absent: Array  # (N,) the same of a crop beside the runway, of its scale, without it
    statistic: Array  # (N,) of the integrity test; of those monitored
    dof: Array  # (N,)
    p_value: Array  # (N,)
    error_m: Array  # (N, 3) along, cross, vertical: solved position less the true one
    sigma_m: Array  # (N, 3) what the estimate says of it
    level_m: Array  # (N, 3) protection levels; infinite where none can be given
    caught_184m: Array  # (N,) 1: would be refused were the far threshold 184 m nearer than it is; 0: would not
    latency_ms: Array  # (N,) of looking at the picture

    def __len__(self) -> int:
        return len(self.picture)

    def select(self, which: NDArray[np.bool_] | NDArray[np.int64]) -> Rows:
        """Some of them."""
        return Rows(**{field.name: getattr(self, field.name)[which] for field in fields(self)})

    @property
    def predicted(self) -> Flags:
        """Which have keypoints (N,)."""
        return np.asarray(np.isfinite(self.mean_px).all(axis=(1, 2)))

    @property
    def accepted(self) -> Flags:
        """Which may be used (N,)."""
        return np.asarray(self.decision == USE)

    @property
    def error_px(self) -> Array:
        """(N, 4, 2) predicted less true."""
        return self.mean_px - self.truth_px

    @property
    def sigma_px(self) -> Array:
        """(N, 4, 2)."""
        return np.sqrt(np.diagonal(self.cov_px, axis1=1, axis2=2)).reshape(-1, 4, 2)
