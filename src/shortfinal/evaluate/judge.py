"""Solve and doubt many predictions at once, of pictures that many cameras took."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shortfinal.geometry import Camera
from shortfinal.integrity import FALSE_ALARM_RATE, check_integrity_batch
from shortfinal.pose import STATUS_OF_CODE, PoseEstimateBatch, SolverStatus, estimate_pose_batch
from shortfinal.protection import FAULT_PRIOR, INTEGRITY_RISK, protection_levels_batch

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Places = NDArray[np.int64]

_FOCAL_PX = 1000.0  # of the camera to which pictures without distortion are brought


@dataclass(frozen=True)
class Rates:
    """What the monitor is set to."""

    false_alarm_rate: float = FALSE_ALARM_RATE
    integrity_risk: float = INTEGRITY_RISK
    fault_prior: float = FAULT_PRIOR
    survey_sigma_m: float = 0.0  # of the runways' corners, as in `Runway`


NOMINAL = Rates()


class Solved(NamedTuple):
    """N answers; NaN where there is none."""

    position_m: Array  # (N, 3)
    sigma_m: Array  # (N, 3)
    level_m: Array  # (N, 3); NaN unless asked for
    statistic: Array  # (N,)
    p_value: Array  # (N,)
    monitored: Flags  # (N,)
    usable: Flags  # (N,)
    status: NDArray[np.object_]  # (N,) of SolverStatus; None where no runway or camera is known
    dof: int
    threshold: float

    def select(self, which: Places) -> Solved:
        """Some of them."""
        some: dict[str, Any] = {
            name: value[which] for name, value in self._asdict().items() if isinstance(value, np.ndarray)
        }
        return self._replace(**some)


@dataclass(frozen=True, eq=False)
class Problems:
    """N sets of four corners with their covariances and where these are on the runway.

    What a camera without distortion saw is what another one would see, scaled and moved, covariance
    and all; so all such pictures are one batch, and each distorting camera is one of its own.
    """

    mean_px: Array  # (N, 4, 2), of the camera of its part
    cov_px: Array  # (N, 8, 8)
    points: Array  # (N, 4, 3) m
    scale: Array  # (N, 2) pixels here for one of the picture, in u and v
    parts: tuple[tuple[Places, Camera], ...]  # which rows, and who took them; rows in none cannot be solved

    @classmethod
    def of(cls, mean_px: Array, cov_px: Array, points: Array, cameras: list[Camera | None]) -> Problems:
        """`points` (N, 4, 3) and `mean_px` (N, 4, 2) NaN where not known."""
        known: Flags = np.asarray(np.isfinite(points).all(axis=(1, 2)) & np.isfinite(mean_px).all(axis=(1, 2)))
        mean, cov, scale = mean_px.copy(), cov_px.copy(), np.ones((len(mean_px), 2))
        groups: dict[Camera | None, list[int]] = {}
        for i, camera in enumerate(cameras):
            if camera is None or not known[i]:
                continue
            if any(camera.distortion):
                groups.setdefault(camera, []).append(i)
                continue
            scale[i] = _FOCAL_PX / camera.fx, _FOCAL_PX / camera.fy
            mean[i] -= camera.cx, camera.cy
            groups.setdefault(None, []).append(i)
        mean *= scale[:, None]
        both = np.tile(scale, 4)
        cov *= both[:, :, None] * both[:, None]
        plain = Camera(2, 2, _FOCAL_PX, _FOCAL_PX, 0.0, 0.0)
        parts = tuple((np.array(rows), camera or plain) for camera, rows in groups.items())
        return cls(mean, cov, points, scale, parts)

    def select(self, which: Places) -> Problems:
        """Some of them."""
        place = np.full(len(self.mean_px), -1)
        place[which] = np.arange(len(which))
        parts = tuple((kept[kept >= 0], camera) for kept, camera in ((place[rows], c) for rows, c in self.parts))
        return Problems(self.mean_px[which], self.cov_px[which], self.points[which], self.scale[which],
                        tuple((rows, camera) for rows, camera in parts if len(rows)))  # fmt: skip

    def solve(self, rates: Rates, *, shift_px: Array | None = None, ahead_m: Array | None = None,
              levels: bool = False) -> Solved:  # fmt: skip
        """The pose of each, its verdict and, if asked for, its protection levels.

        `shift_px` (N, 4, 2): added to the corners, in pixels of the picture; `ahead_m` (N,): added to where
        the far threshold is believed to be, along the runway.
        """
        n = len(self.mean_px)
        mean = self.mean_px if shift_px is None else self.mean_px + shift_px * self.scale[:, None]
        points = self.points
        if ahead_m is not None:
            points = points.copy()
            points[:, 2:, 0] += ahead_m[:, None]
        position, sigma, level = (np.full((n, 3), np.nan) for _ in range(3))
        statistic, p_value = np.full(n, np.nan), np.full(n, np.nan)
        monitored, usable = np.zeros(n, bool), np.zeros(n, bool)
        status = np.full(n, None, object)
        threshold = np.nan
        for rows, camera in self.parts:
            batch = estimate_pose_batch(
                mean[rows], self.cov_px[rows], points[rows], camera, points_sigma_m=rates.survey_sigma_m
            )
            verdict = check_integrity_batch(batch, rates.false_alarm_rate)
            position[rows], sigma[rows] = batch.positions, _sigma(batch)
            statistic[rows], p_value[rows], threshold = verdict.statistic, verdict.p_value, verdict.threshold
            monitored[rows], usable[rows] = verdict.monitored, verdict.usable
            status[rows] = np.array(STATUS_OF_CODE, object)[batch.status_codes]
            if levels:
                found = protection_levels_batch(
                    batch, integrity_risk=rates.integrity_risk, fault_prior=rates.fault_prior,
                    false_alarm_rate=rates.false_alarm_rate,
                ).levels[:, :3]  # fmt: skip
                level[rows] = np.where(verdict.monitored[:, None], found, np.nan)
        return Solved(position, sigma, level, statistic, p_value, monitored, usable, status, 2, threshold)


def _sigma(batch: PoseEstimateBatch) -> Array:
    return np.sqrt(np.diagonal(batch.covs, axis1=1, axis2=2)[:, :3])


def reasons_of(solved: Solved, rates: Rates) -> NDArray[np.object_]:
    """Each verdict in words (N,)."""
    words = np.full(len(solved.statistic), "", object)
    for i, (status, monitored) in enumerate(zip(solved.status, solved.monitored, strict=True)):
        if status is None:
            words[i] = "the runway's size or the camera is not known"
        elif monitored:
            sign, side = ("≥", "within") if solved.usable[i] else ("<", "over")
            words[i] = (
                f"residual {solved.statistic[i]:.3g} {side} {solved.threshold:.3g} "
                f"(p = {solved.p_value[i]:.2g} {sign} {rates.false_alarm_rate:.1g})"
            )
        elif status is SolverStatus.CONVERGED:
            words[i] = "no redundancy in effect, or a position too uncertain to check"
        else:
            words[i] = f"no unique estimate to check: the solver ended {status.value}"
    return words
