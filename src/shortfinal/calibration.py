"""Are predicted uncertainties true? Coverage, sharpness, likelihood, and the scale that mends them.

Errors are keypoint minus truth, in any unit; sigma in the same unit. Calibrated means that errors
over sigma are standard normal; sharp means that sigma is small. The first without the second is
useless, the second without the first is dangerous.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri, ndtri

from shortfinal.errors import InputError

Array = NDArray[np.float64]

LEVELS = (0.5, 0.68, 0.9, 0.95, 0.99)  # probabilities at which coverage is reported and bounds are kept
_MATCHED = 0.75  # the share of errors at which the fitted scale meets the normal distribution
_FEWEST = 20  # errors of a coordinate, with which its scale is known to some 20 % (one standard error)


@dataclass(frozen=True)
class Calibration:
    """What held-out pictures say of a network's sigmas: a factor on each, and bounds that need no normal distribution.

    Of n coordinates in the order u0, v0, u1, v1, ... "Calibrated" sigma is the network's, times
    `sigma_scale`. Raises InputError, naming the field, for sizes that differ or a value of no use.
    """

    sigma_scale: tuple[float, ...]  # (n,)
    levels: tuple[float, ...]  # probabilities, rising
    bounds: tuple[tuple[float, ...], ...]  # (levels, n), of |error| in calibrated sigmas; inf: too few errors to say
    count: tuple[int, ...]  # (n,) errors it was fitted to
    fitted_on: str  # which pictures

    def __post_init__(self) -> None:
        n = len(self.sigma_scale)
        bounds = np.array(self.bounds, np.float64) if len({len(row) for row in self.bounds}) == 1 else np.empty(0)
        scale, levels = np.array(self.sigma_scale, np.float64), np.array(self.levels, np.float64)
        fine = {
            "sigma_scale": n > 0 and bool((np.isfinite(scale) & (scale > 0)).all()),
            "levels": bool(((levels > 0) & (levels < 1)).all() and (np.diff(levels) > 0).all()),
            "bounds": bounds.shape == (len(levels), n)
            and bool((bounds > 0).all() and (bounds[1:] >= bounds[:-1]).all()),
            "count": len(self.count) == n and all(type(c) is int and c > 0 for c in self.count),
            "fitted_on": isinstance(self.fitted_on, str),
        }
        for name, good in fine.items():
            if not good:
                raise InputError(f"calibration: {name} is of no use ({getattr(self, name)!r:.40})")

    def conformal_bounds_px(self, sigma_px: ArrayLike, level: float) -> Array:
        """How large (K, 2) each coordinate's error is at most, with probability `level` or more.

        `sigma_px` (K, 2) is calibrated, as `KeypointDetector` gives it. It holds for each coordinate by
        itself, on average over pictures (and over what it was fitted to), if these are exchangeable with
        those it was fitted to, however the errors are distributed: split conformal prediction (Papadopoulos
        et al. 2002; Lei et al. 2018). inf where too few were seen for that level. Raises InputError for a
        level that is not kept, or another number of keypoints.
        """
        if level not in self.levels:
            raise InputError(f"level: {level}; kept are {', '.join(map(str, self.levels))}")
        sigma = np.asarray(sigma_px, np.float64)
        if sigma.shape != (len(self.sigma_scale) // 2, 2):
            raise InputError(f"sigma_px: expected shape {(len(self.sigma_scale) // 2, 2)}, got {sigma.shape}")
        return np.asarray(sigma * np.reshape(self.bounds[self.levels.index(level)], sigma.shape))

    def to_plain(self) -> dict[str, Any]:
        """Its fields for JSON, which knows no infinity: null instead."""
        bounds = [[None if math.isinf(bound) else bound for bound in row] for row in self.bounds]
        return {**asdict(self), "bounds": bounds}

    @classmethod
    def from_plain(cls, content: Mapping[str, Any]) -> Calibration:
        """What `to_plain` gave, read back. Raises InputError if it is something else."""
        try:
            rows = tuple(
                tuple(math.inf if bound is None else float(bound) for bound in row) for row in content["bounds"]
            )
            scale, levels = (tuple(float(v) for v in content[name]) for name in ("sigma_scale", "levels"))
            count, fitted_on = tuple(content["count"]), content["fitted_on"]
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"calibration: not as it is written ({error!r:.60})") from error
        return cls(scale, levels, rows, count, fitted_on)


def fit_calibration(errors: ArrayLike, sigma: ArrayLike, fitted_on: str) -> Calibration:
    """A calibration from errors (N, n) of n coordinates, NaN where there is none, and the network's own sigmas (N, n).

    Raises InputError for shapes that do not match, a sigma that is not finite and positive, or fewer
    than 20 errors of a coordinate, or mostly zeros.
    """
    e, s = np.asarray(errors, np.float64), np.asarray(sigma, np.float64)
    if e.ndim != 2 or e.shape != s.shape:
        raise InputError(f"sigma: shape {s.shape} does not match errors {e.shape}; both are (N, n)")
    if s.size:
        _check_positive(s)
    if np.isinf(e).any():
        raise InputError("errors: every one must be finite, or NaN where there is none")
    columns = [np.sort(z[~np.isnan(z)]) for z in np.abs(e / s).T]
    for column, scores in enumerate(columns):
        which = f"coordinate {'uv'[column % 2]} of keypoint {column // 2}"
        if len(scores) < _FEWEST:
            raise InputError(f"errors: {len(scores)} of {which}; at least {_FEWEST} are needed")
        if not _robust_scale(scores) > 0:
            raise InputError(f"errors: those of {which} are mostly zero, which tells nothing of sigma")
    scale = tuple(map(_robust_scale, columns))
    # The scale divides the score of every picture alike, those to come included. So whether an error is
    # within its bound does not depend on it, and it may be fitted to the same errors: the bound times the
    # scale is the order statistic of |e| / sigma, which knows nothing of it.
    bounds = tuple(
        tuple(_conformal_score(scores, level) / c for scores, c in zip(columns, scale, strict=True)) for level in LEVELS
    )
    return Calibration(scale, LEVELS, bounds, tuple(map(len, columns)), fitted_on)


def _robust_scale(scores: Array) -> float:
    """The factor on sigma after which three quarters of the |error| / sigma are as small as they should be.

    The likelihood's factor (`fit_sigma_scale`) follows the few largest errors: of eleven distributions, normal
    to Student's t with 2 degrees of freedom and 2 % outliers of 20 sigma, it left the worst of the five
    LEVELS wrong by 18 % on average and up to 42 %, this one by 4.6 % and up to 9 % (docs/log.md).
    """
    return float(np.quantile(scores, _MATCHED) / ndtri(0.5 + _MATCHED / 2))


def _conformal_score(scores: Array, level: float) -> float:
    """The smallest of the sorted n `scores` that one more is at most as large as, with probability `level`.

    The ceil((n + 1) level)-th; inf if there is none, which is so for n < level / (1 - level).
    """
    rank = math.ceil((len(scores) + 1) * level - 1e-9)  # 1e-9: 0.68 * 75 is 51, not a little more
    return float(scores[rank - 1]) if rank <= len(scores) else math.inf


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
