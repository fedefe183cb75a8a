"""May this measurement be used? A χ² test of the residual, as in GNSS receiver autonomous integrity
monitoring (RAIM), and what such a test can and cannot see.

With H and the residual whitened first (H_w = L⁻¹H, r_w = L⁻¹(y - μ), Σ = L Lᵀ) the squared residual
left by a least-squares fit is χ² with n - 6 degrees of freedom, n the rows that were measured, when
they err as they claim (Joerger & Pervan 2014). Whatever could not be checked is NOT_MONITORED, never USE.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtrc, chdtri, chndtrinc

from shortfinal.errors import InputError
from shortfinal.geometry import as_array
from shortfinal.pose import PoseEstimate, PoseEstimateBatch, SolverStatus

Array = NDArray[np.float64]

FALSE_ALARM_RATE = 1e-3
LARGEST_SHARE = 0.5  # of the distance, that the position's sigma may reach


class Decision(Enum):
    """What may be done with a measurement."""

    USE = "use"  # checked, and nothing contradicts the stated uncertainty
    DO_NOT_USE = "do-not-use"  # checked, and the keypoints contradict the geometry
    NOT_MONITORED = "not-monitored"  # could not be checked: no redundancy, or no estimate


@dataclass(frozen=True)
class IntegrityVerdict:
    """The decision on one estimate, with the reasons in words."""

    decision: Decision
    reasons: tuple[str, ...]
    dof: int
    false_alarm_rate: float  # share of faultless frames refused
    statistic: float | None = None  # squared whitened residual; None when not monitored
    p_value: float | None = None  # P(χ²(dof) > statistic), likewise
    threshold: float | None = None  # the statistic at which p_value equals false_alarm_rate


@dataclass(frozen=True, eq=False)
class IntegrityBatch:
    """The decisions on N estimates; statistic and p_value are NaN where `monitored` is False."""

    monitored: NDArray[np.bool_]  # (N,)
    usable: NDArray[np.bool_]  # (N,) monitored and not refused
    statistic: Array  # (N,)
    p_value: Array  # (N,)
    dof: int
    threshold: float
    false_alarm_rate: float

    def decision(self, i: int) -> Decision:
        """The decision on estimate `i`."""
        if not self.monitored[i]:
            return Decision.NOT_MONITORED
        return Decision.USE if self.usable[i] else Decision.DO_NOT_USE


def check_integrity(est: PoseEstimate, false_alarm_rate: float = FALSE_ALARM_RATE) -> IntegrityVerdict:
    """Does the residual fit the stated uncertainty? DO_NOT_USE when p < `false_alarm_rate`.

    p is the survival function of χ²(n - 6) at the squared whitened residual. NOT_MONITORED unless
    the solver converged, redundancy is left, and the pose is known well enough for a linear test.
    Raises InputError for a rate outside (0, 1).
    """
    check_rate(false_alarm_rate, "false_alarm_rate")
    obstacle = _obstacle(est)
    if obstacle:
        return IntegrityVerdict(Decision.NOT_MONITORED, (obstacle,), est.dof, false_alarm_rate)
    p, threshold = float(chdtrc(est.dof, est.chi2)), _threshold(est.dof, false_alarm_rate)
    refused = p < false_alarm_rate
    if refused:
        reason = (
            f"residual {est.chi2:.3g} over {threshold:.3g}: the keypoints do not fit the runway "
            f"(p = {p:.1g} < {false_alarm_rate:.1g})"
        )
    else:
        reason = f"residual {est.chi2:.3g} within {threshold:.3g} (p = {p:.2g})"
    decision = Decision.DO_NOT_USE if refused else Decision.USE
    return IntegrityVerdict(decision, (reason,), est.dof, false_alarm_rate, est.chi2, p, threshold)


def check_integrity_batch(batch: PoseEstimateBatch, false_alarm_rate: float = FALSE_ALARM_RATE) -> IntegrityBatch:
    """`check_integrity` of N estimates, as arrays. Raises InputError for a rate outside (0, 1)."""
    check_rate(false_alarm_rate, "false_alarm_rate")
    monitored = batch.converged & (batch.dof > 0) & (batch.sharp_rows > 6) & (batch.relative_sigma < LARGEST_SHARE)
    statistic = np.where(monitored, batch.chi2, np.nan)
    dof = batch.dof
    p = np.asarray(chdtrc(dof, statistic)) if dof > 0 else np.full(len(batch), np.nan)
    threshold = _threshold(dof, false_alarm_rate) if dof > 0 else math.nan
    return IntegrityBatch(
        monitored, monitored & (p >= false_alarm_rate), statistic, p, dof, threshold, false_alarm_rate
    )


def check_integrity_as_published(est: PoseEstimate) -> tuple[float, float]:
    """Statistic and p-value of Valentin et al. 2025, Algorithm 1, line 5 as printed; to compare only.

    r = L⁻¹ (I - H H⁺)(y - μ), with H and the residual *not* whitened. This projects along the wrong
    space unless Σ is a multiple of the identity, so that p is not uniform and false alarms are many
    times the nominal. (Line 7 then reads the density of χ² where a tail probability is meant; the
    tail is given here.) Raises InputError where there is no converged estimate.
    """
    solved = _solved(est)
    statistic, p = _as_published(solved.residual[None], solved.jacobian[None], solved.factor[None])
    return float(statistic[0]), float(p[0])


def check_integrity_batch_as_published(batch: PoseEstimateBatch) -> tuple[Array, Array]:
    """`check_integrity_as_published` of N estimates: (N,) statistics and p-values, NaN where not converged."""
    good = batch.converged
    factor = batch.factors if len(batch.factors) == 1 else batch.factors[good]
    out = np.full((2, len(batch)), np.nan)
    out[:, good] = _as_published(batch.residuals[good], batch.jacobians[good], factor)
    return out[0], out[1]


def bias_effect(est: PoseEstimate, bias_px: ArrayLike) -> Array:
    """Error of the pose (6,) that a shift of the keypoints (K, 2) causes, to first order.

    (Hᵀ Σ⁻¹ H)⁻¹ Hᵀ Σ⁻¹ b: metres in the runway frame, then radians. Raises InputError where there is
    no converged estimate.
    """
    q, r = np.linalg.qr(_solved(est).jacobian)
    return np.asarray(np.linalg.solve(r, q.T @ _whitened(est, bias_px)), np.float64)


def detection_probability(est: PoseEstimate, bias_px: ArrayLike, false_alarm_rate: float = FALSE_ALARM_RATE) -> float:
    """Probability that `check_integrity` refuses, were the keypoints shifted by `bias_px` (K, 2).

    The statistic is then non-central χ² with λ = |(I - H_w H_w⁺) L⁻¹ b|², to first order in the
    bias. A shift that a change of pose explains has λ = 0: it is never detected. Raises InputError
    for a rate outside (0, 1), or where the estimate is not monitored.
    """
    check_rate(false_alarm_rate, "false_alarm_rate")
    threshold = _threshold(_solved(est).dof, false_alarm_rate)
    from scipy.stats import ncx2  # its survival function does not saturate; slow to import

    noncentrality = _noncentrality(est, bias_px)
    tail = ncx2.sf(threshold, est.dof, noncentrality) if noncentrality > 0 else chdtrc(est.dof, threshold)
    return float(tail)


def minimal_detectable_bias(
    est: PoseEstimate,
    direction_px: ArrayLike,
    false_alarm_rate: float = FALSE_ALARM_RATE,
    power: float = 0.99,
) -> float:
    """The factor by which a shift `direction_px` (K, 2) must be scaled to be refused with
    probability `power` (Baarda 1968); infinite when a change of pose explains the shift.

    Raises InputError as `detection_probability`, and unless false_alarm_rate < power < 1.
    """
    check_rate(false_alarm_rate, "false_alarm_rate")
    if not false_alarm_rate < power < 1:
        raise InputError(f"power: {power} must lie between the false-alarm rate {false_alarm_rate} and 1")
    threshold = _threshold(_solved(est).dof, false_alarm_rate)
    needed = float(chndtrinc(threshold, est.dof, 1.0 - power))
    unit = _noncentrality(est, direction_px)
    # Below the rounding of the projection the share left over is none.
    total = float(np.sum(_whitened(est, direction_px) ** 2))
    if total == 0:
        raise InputError("direction_px: a shift of nothing has no direction")
    return math.sqrt(needed / unit) if unit > 1e-20 * total else math.inf


def check_rate(rate: float, name: str) -> None:
    """Raises InputError unless `rate` is a number between 0 and 1."""
    if not (isinstance(rate, (int, float)) and 0 < rate < 1):
        raise InputError(f"{name}: {rate} is no probability; it must lie between 0 and 1, e.g. {FALSE_ALARM_RATE}")


@lru_cache
def _threshold(dof: int, rate: float) -> float:
    """What χ²(dof) exceeds with probability `rate`."""
    return float(chdtri(dof, rate))


def _obstacle(est: PoseEstimate) -> str | None:
    """Why the estimate cannot be checked, or None."""
    if est.status is not SolverStatus.CONVERGED:
        return f"no unique estimate to check: the solver ended {est.status.value}"
    if est.dof <= 0:
        return f"no redundancy: {len(est.residual)} equations for 6 unknowns"
    if est.sharp_rows <= 6:
        return (
            f"no redundancy in effect: only {est.sharp_rows} of {len(est.residual)} measured numbers are known better "
            "than the runway is large in the image, or a prior than the runway is distant"
        )
    if not est.relative_sigma < LARGEST_SHARE:
        return f"the position is uncertain by more than {LARGEST_SHARE:.0%} of the distance: no longer first-order"
    return None


def _solved(est: PoseEstimate) -> PoseEstimate:
    obstacle = _obstacle(est)
    if obstacle:
        raise InputError(f"est: {obstacle}")
    return est


def _whitened(est: PoseEstimate, bias: ArrayLike) -> Array:
    """L⁻¹ b (n,) of a shift of the keypoints (K, 2), or of all that was measured (n,)."""
    rows, keypoints = len(est.residual), 2 * len(est.points)
    given = as_array(np.ravel(bias), (None,), "bias_px")
    if len(given) not in (rows, keypoints):
        wanted = f"{est.keypoints.mean_px.shape}" + (f" or ({rows},)" if rows > keypoints else "")
        raise InputError(f"bias_px: expected shape {wanted}, got {np.shape(bias)}")
    whole = np.zeros(rows)
    whole[: len(given)] = given
    return np.asarray(np.linalg.solve(est.factor, whole), np.float64)


def _noncentrality(est: PoseEstimate, bias_px: ArrayLike) -> float:
    """λ: the squared part of the whitened bias that no change of pose explains."""
    bias = _whitened(est, bias_px)
    q, _ = np.linalg.qr(est.jacobian)
    return float(np.sum((bias - q @ (q.T @ bias)) ** 2))


def _as_published(residual: Array, jacobian: Array, factor: Array) -> tuple[Array, Array]:
    """(N,) statistics and p-values from whitened residuals (N, 2K), Jacobians and L (N or 1, 2K, 2K)."""
    q, _ = np.linalg.qr(factor @ jacobian)
    plain = factor @ residual[..., None]
    left = np.linalg.solve(factor, plain - q @ (np.swapaxes(q, -1, -2) @ plain))[..., 0]
    statistic = np.sum(left**2, axis=-1)
    return statistic, np.asarray(chdtrc(residual.shape[1] - 6, statistic))
