"""The contract between seeing and solving: keypoints with a Gaussian uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shortfinal.errors import InputError
from shortfinal.geometry import as_array, frozen

Array = NDArray[np.float64]

_FARTHEST_PX = 1e6

CORNER_NAMES = ("near-left", "near-right", "far-right", "far-left")
# Outer corners of the pair of aiming-point markings, in the same order.
AIMING_NAMES = ("aiming-near-left", "aiming-near-right", "aiming-far-right", "aiming-far-left")


def mirrored(names: Sequence[str]) -> list[int]:
    """Which keypoint stands in each one's place when the picture is mirrored: left for right and right for left.

    Raises InputError for a name whose mirror image is not among them.
    """
    order = []
    for name in names:
        other = "-".join({"left": "right", "right": "left"}.get(part, part) for part in name.split("-"))
        if other not in names:
            raise InputError(f"keypoints: {name} without {other}, which it becomes in a mirrored picture")
        order.append(list(names).index(other))
    return order


@dataclass(frozen=True, eq=False)
class GaussianKeypoints:
    """K keypoints: means (K, 2) in pixels, covariance (2K, 2K) in px², rows u0, v0, u1, v1, ...

    The full covariance is kept, so keypoints may be correlated with one another. Raises InputError
    for a wrong shape, a non-finite entry, or a covariance that is not symmetric or not positive
    definite: an uncertainty of zero is a claim that cannot be checked.
    """

    mean_px: Array
    cov_px: Array

    def __post_init__(self) -> None:
        mean = _checked_mean(self.mean_px)
        cov = as_array(self.cov_px, (2 * len(mean), 2 * len(mean)), "cov_px")
        check_covariance(cov, "cov_px", lambda row: f"keypoint {row // 2} {'uv'[row % 2]}")
        largest = float(np.diag(cov).max())
        if largest > _FARTHEST_PX**2:
            raise InputError(f"cov_px: a standard deviation of {np.sqrt(largest):.3g} px is no measurement")
        object.__setattr__(self, "mean_px", mean)
        object.__setattr__(self, "cov_px", cov)

    @classmethod
    def from_sigma(cls, mean_px: ArrayLike, sigma_px: ArrayLike) -> GaussianKeypoints:
        """Independent coordinates; `sigma_px` is one number, (K, 1) per keypoint, or (K, 2).

        Raises InputError unless every sigma is finite and positive.
        """
        mean = _checked_mean(mean_px)
        try:
            sigma = np.broadcast_to(np.asarray(sigma_px, np.float64), mean.shape)
        except (TypeError, ValueError) as error:
            raise InputError(f"sigma_px: expected one number or an array like {mean.shape}") from error
        good = (sigma > 0) & (sigma < np.inf)
        if not good.all():
            k, axis = (int(i) for i in np.argwhere(~good)[0])
            raise InputError(f"sigma_px: keypoint {k} {'uv'[axis]} is {sigma[k, axis]}; it must be finite and > 0")
        if sigma.max() > _FARTHEST_PX:
            raise InputError(f"sigma_px: a standard deviation of {sigma.max():.3g} px is no measurement")
        cov = np.zeros((mean.size, mean.size))
        np.fill_diagonal(cov, sigma.ravel() ** 2)
        if not cov.diagonal().min() > 0:
            raise InputError(f"sigma_px: {sigma.min():.3g} squared is zero; it must be > 0")
        keypoints = object.__new__(cls)  # a positive diagonal needs no eigenvalues to be checked
        keypoints.__dict__.update(mean_px=mean, cov_px=frozen(cov))
        return keypoints

    @property
    def sigma_px(self) -> Array:
        """Standard deviations (K, 2)."""
        return np.sqrt(np.diag(self.cov_px)).reshape(-1, 2)

    @property
    def whitening(self) -> Array:
        """L⁻¹ (2K, 2K) with L Lᵀ the covariance: it turns residuals into unit normals."""
        return np.linalg.inv(np.linalg.cholesky(self.cov_px))

    def only(self, chosen: ArrayLike) -> GaussianKeypoints:
        """Those of the keypoints that `chosen` (K,), true or false, says; the others are marginalised out."""
        keep = np.asarray(chosen, bool)
        rows = np.repeat(keep, 2)
        return self if keep.all() else GaussianKeypoints(self.mean_px[keep], self.cov_px[np.ix_(rows, rows)])

    def replaced(self, chosen: ArrayLike, other: GaussianKeypoints) -> GaussianKeypoints:
        """With the keypoints whose numbers are `chosen` (n,) as `other` has them, independent of those that stay."""
        keypoints = np.asarray(chosen, int)
        rows = (2 * keypoints[:, None] + [0, 1]).ravel()
        mean, cov = self.mean_px.copy(), self.cov_px.copy()
        mean[keypoints] = other.mean_px[keypoints]
        cov[rows], cov[:, rows] = 0.0, 0.0
        cov[np.ix_(rows, rows)] = other.cov_px[np.ix_(rows, rows)]
        return GaussianKeypoints(mean, cov)

    def widened(self, cov_px: Array) -> GaussianKeypoints:
        """With another, independent error's covariance (2K, 2K) added."""
        return GaussianKeypoints(self.mean_px, self.cov_px + cov_px)

    def block(self, k: int) -> Array:
        """Covariance (2, 2) of keypoint k, for its ellipse."""
        return self.cov_px[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]


def _checked_mean(mean_px: ArrayLike) -> Array:
    mean = as_array(mean_px, (None, 2), "mean_px")
    if len(mean) == 0:
        raise InputError("mean_px: at least one keypoint is needed")
    farthest = max(float(mean.max()), -float(mean.min()))
    if farthest > _FARTHEST_PX:
        raise InputError(f"mean_px: {farthest:.3g} is no pixel of any camera")
    return mean


def check_covariance(cov: Array, name: str, row_name: Callable[[int], str]) -> None:
    """Raises InputError unless `cov` (n, n) is symmetric and positive definite; `row_name` says what a row is of."""
    variance = np.diag(cov)
    if (variance <= 0).any():
        row = int(np.argmax(variance <= 0))
        raise InputError(f"{name}: the variance of {row_name(row)} is {variance[row]}; it must be > 0")
    # Compared as correlations, so that the tolerances have no unit.
    sigma = np.sqrt(variance)
    correlation = cov / np.outer(sigma, sigma)
    skew = np.abs(correlation - correlation.T)
    if skew.max() > 1e-8:
        i, j = (int(n) for n in np.unravel_index(int(skew.argmax()), skew.shape))
        raise InputError(f"{name}: not symmetric: entry [{i}, {j}] is {cov[i, j]}, [{j}, {i}] is {cov[j, i]}")
    smallest = float(np.linalg.eigvalsh(correlation)[0])
    if smallest < 1e-10:
        raise InputError(
            f"{name}: not positive definite (smallest eigenvalue of the correlations {smallest:.2e}); "
            "a valid covariance has only positive ones"
        )
