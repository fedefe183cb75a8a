"""Are predicted uncertainties true? Coverage, sharpness, likelihood, and the scale that mends them.

Errors are keypoint minus truth, in any unit; sigma in the same unit. Calibrated means that errors
over sigma are standard normal; sharp means that sigma is small. The first without the second is
useless, the second without the first is dangerous.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri

from shortfinal.errors import InputError

Array = NDArray[np.float64]


def coverage(errors: ArrayLike, sigma: ArrayLike, level: ArrayLike) -> Array:
    """Share of errors within the central interval that should hold `level` of them.

    `errors` and `sigma` have one shape, and |e| / sigma is compared with the two-sided normal
    quantile. Or errors are (N, d) and `sigma` a covariance (N, d, d), and eᵀ Σ⁻¹ e is compared with
    the quantile of χ²(d): the ellipses. The result has the shape of `level`, a probability or an
    array of them. Raises InputError for shapes that do not match, no errors, a non-finite entry, a
    sigma that is not positive, or a level outside (0, 1).
    """
    levels = np.asarray(level, np.float64)
    if not ((levels > 0) & (levels < 1)).all():
        raise InputError("level: every level must lie between 0 and 1")
    squared, dof, _ = _standardise(errors, sigma)
    limit = chdtri(dof, 1.0 - levels)  # for one dimension the two-sided normal quantile, squared
    return np.asarray((squared.ravel() <= limit[..., None]).mean(axis=-1))


def sharpness(sigma: ArrayLike) -> float:
    """Root mean square of sigma: the size of the claimed error. Raises InputError unless all are > 0."""
    values = np.asarray(sigma, np.float64)
    _check_positive(values)
    return float(np.sqrt(np.mean(values**2)))


def gaussian_nll(errors: ArrayLike, sigma: ArrayLike) -> float:
    """Mean negative log-likelihood, nats: ½ eᵀ Σ⁻¹ e + ½ log|Σ| + (d/2) log 2π per error of d numbers.

    With the ½ before log|Σ| that Valentin et al. 2025 leave out: without it the best σ is too small
    by √2. Arguments and errors as in `coverage`.
    """
    squared, dof, log_det = _standardise(errors, sigma)
    return float(0.5 * np.mean(squared + log_det + dof * np.log(2.0 * np.pi)))


def fit_sigma_scale(errors: ArrayLike, sigma: ArrayLike) -> Array:
    """The factor on sigma that maximises the likelihood, per column: sqrt(mean((e / sigma)²)).

    `errors` and `sigma` are (N, ...); the mean runs over N. Above 1: overconfident. Raises
    InputError as `coverage`.
    """
    e, s = _matched(errors, sigma)
    return np.asarray(np.sqrt(np.mean((e / s) ** 2, axis=0)))


def _standardise(errors: ArrayLike, sigma: ArrayLike) -> tuple[Array, int, Array]:
    """Squared standardised errors, their dimension, and log|Σ|."""
    e, s = np.asarray(errors, np.float64), np.asarray(sigma, np.float64)
    if s.ndim != 3 or e.ndim != 2:
        e, s = _matched(e, s)
        return (e / s) ** 2, 1, 2.0 * np.log(s)
    if s.shape != (*e.shape, e.shape[1]):
        raise InputError(f"sigma: expected covariances {(*e.shape, e.shape[-1])} for errors {e.shape}, got {s.shape}")
    _check_errors(e)
    if not np.isfinite(s).all():
        raise InputError("sigma: every entry of a covariance must be finite")
    if (np.abs(s - s.swapaxes(1, 2)) > 1e-9 * np.abs(s).max(axis=(1, 2), keepdims=True)).any():
        raise InputError("sigma: a covariance is not symmetric")
    try:
        factor = np.linalg.cholesky(s)
    except np.linalg.LinAlgError as error:
        raise InputError("sigma: a covariance is not positive definite") from error
    white = np.linalg.solve(factor, e[..., None])[..., 0]
    log_det = 2.0 * np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
    return np.asarray((white**2).sum(axis=1)), e.shape[1], np.asarray(log_det)


def _matched(errors: ArrayLike, sigma: ArrayLike) -> tuple[Array, Array]:
    e, s = np.asarray(errors, np.float64), np.asarray(sigma, np.float64)
    if e.shape != s.shape:
        raise InputError(f"sigma: shape {s.shape} does not match errors {e.shape}")
    _check_errors(e)
    _check_positive(s)
    return e, s


def _check_errors(errors: Array) -> None:
    if errors.size == 0 or not np.isfinite(errors).all():
        raise InputError("errors: at least one is needed, and every one must be finite")


def _check_positive(sigma: Array) -> None:
    if sigma.size == 0 or not (np.isfinite(sigma) & (sigma > 0)).all():
        raise InputError("sigma: at least one is needed, and every one must be finite and > 0")
