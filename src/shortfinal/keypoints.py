"""The contract between seeing and solving: keypoints with a Gaussian uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shortfinal.errors import InputError
from shortfinal.geometry import as_array

Array = NDArray[np.float64]

_FARTHEST_PX = 1e6

CORNER_NAMES = ("near-left", "near-right", "far-right", "far-left")


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
        mean = as_array(self.mean_px, (None, 2), "mean_px")
        if len(mean) == 0:
            raise InputError("mean_px: at least one keypoint is needed")
        if np.abs(mean).max() > _FARTHEST_PX:
            raise InputError(f"mean_px: {np.abs(mean).max():.3g} is no pixel of any camera")
        cov = as_array(self.cov_px, (2 * len(mean), 2 * len(mean)), "cov_px")
        _check_covariance(cov)
        object.__setattr__(self, "mean_px", mean)
        object.__setattr__(self, "cov_px", cov)

    @classmethod
    def from_sigma(cls, mean_px: ArrayLike, sigma_px: ArrayLike) -> GaussianKeypoints:
        """Independent coordinates; `sigma_px` is one number, (K, 1) per keypoint, or (K, 2).

        Raises InputError unless every sigma is finite and positive.
        """
        mean = as_array(mean_px, (None, 2), "mean_px")
        try:
            sigma = np.broadcast_to(np.asarray(sigma_px, np.float64), mean.shape)
        except (TypeError, ValueError) as error:
            raise InputError(f"sigma_px: expected one number or an array like {mean.shape}") from error
        if not (np.isfinite(sigma) & (sigma > 0)).all():
            k, axis = (int(i) for i in np.argwhere(~(np.isfinite(sigma) & (sigma > 0)))[0])
            raise InputError(f"sigma_px: keypoint {k} {'uv'[axis]} is {sigma[k, axis]}; it must be finite and > 0")
        return cls(mean, np.diag(np.minimum(sigma, 2 * _FARTHEST_PX).ravel() ** 2))

    @property
    def sigma_px(self) -> Array:
        """Standard deviations (K, 2)."""
        return np.sqrt(np.diag(self.cov_px)).reshape(-1, 2)

    @property
    def whitening(self) -> Array:
        """L⁻¹ (2K, 2K) with L Lᵀ the covariance: it turns residuals into unit normals."""
        return np.linalg.inv(np.linalg.cholesky(self.cov_px))

    def block(self, k: int) -> Array:
        """Covariance (2, 2) of keypoint k, for its ellipse."""
        return self.cov_px[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]


def _check_covariance(cov: Array) -> None:
    variance = np.diag(cov)
    if variance.max() > _FARTHEST_PX**2:
        raise InputError(f"cov_px: a standard deviation of {np.sqrt(variance.max()):.3g} px is no measurement")
    if (variance <= 0).any():
        row = int(np.argmax(variance <= 0))
        raise InputError(
            f"cov_px: the variance of keypoint {row // 2} {'uv'[row % 2]} is {variance[row]}; it must be > 0"
        )
    # Compared as correlations, so that the tolerances have no unit.
    sigma = np.sqrt(variance)
    correlation = cov / np.outer(sigma, sigma)
    skew = np.abs(correlation - correlation.T)
    if skew.max() > 1e-8:
        i, j = (int(n) for n in np.unravel_index(int(skew.argmax()), skew.shape))
        raise InputError(f"cov_px: not symmetric: entry [{i}, {j}] is {cov[i, j]}, [{j}, {i}] is {cov[j, i]}")
    smallest = float(np.linalg.eigvalsh(correlation)[0])
    if smallest < 1e-10:
        raise InputError(
            f"cov_px: not positive definite (smallest eigenvalue of the correlations {smallest:.2e}); "
            "a valid covariance has only positive ones"
        )
