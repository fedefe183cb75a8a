"""What a pose may be estimated from beside keypoints: edge lines, and what other sensors say.

Each comes with its covariance and enters the solver's least squares as further whitened rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shortfinal.errors import InputError
from shortfinal.geometry import as_array, nearest_rotation
from shortfinal.keypoints import CORNER_NAMES, check_covariance

Array = NDArray[np.float64]
Kind = TypeVar("Kind")

_AXES = "xyz"
_LINE_AXES = ("rho", "theta")


class Feature(NamedTuple):
    """One thing measured: its name, and its rows in the residual, the Jacobian and the factor."""

    name: str
    rows: slice


@lru_cache(maxsize=64)
def feature_rows(keypoints: int, lines: int, attitude: bool, position: bool, altitude: bool) -> tuple[Feature, ...]:
    """The features in the order of the solver's rows: corners by name, further points by number."""
    named = [*CORNER_NAMES, *(f"point {k}" for k in range(len(CORNER_NAMES), keypoints))][:keypoints]
    sizes = [(name, 2) for name in (*named, *(f"line {k}" for k in range(lines)))]
    sizes += [("attitude prior", 3)] * attitude + [("position prior", 3)] * position + [("altitude", 1)] * altitude
    ends = np.cumsum([size for _, size in sizes]).tolist()
    return tuple(Feature(name, slice(end - size, end)) for (name, size), end in zip(sizes, ends, strict=True))


@dataclass(frozen=True, eq=False)
class GaussianLines:
    """L straight lines of the image in normal form, u cos(theta) + v sin(theta) = rho.

    `mean` (L, 2): rho in pixels, theta in radians, of the *undistorted* image (a line bends under
    distortion). `cov` (2L, 2L), rows rho0, theta0, rho1, theta1, ... (rho, theta) and
    (-rho, theta + pi) are the same line. Raises InputError as `GaussianKeypoints`.
    """

    mean: Array
    cov: Array

    def __post_init__(self) -> None:
        mean = as_array(self.mean, (None, 2), "lines: mean")
        if len(mean) == 0:
            raise InputError("lines: mean: at least one line is needed")
        cov = as_array(self.cov, (2 * len(mean), 2 * len(mean)), "lines: cov")
        check_covariance(cov, "lines: cov", lambda row: f"line {row // 2} {_LINE_AXES[row % 2]}")
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "cov", cov)

    @classmethod
    def through(cls, ends_px: ArrayLike, cov_px: ArrayLike) -> GaussianLines:
        """The lines through two points each: (L, 2, 2) undistorted pixels, covariance (4L, 4L) px².

        The covariance is carried over to first order. Raises InputError where both points are one.
        """
        ends = as_array(ends_px, (None, 2, 2), "lines: ends_px")
        cov = as_array(cov_px, (4 * len(ends), 4 * len(ends)), "lines: cov_px")
        along = ends[:, 1] - ends[:, 0]
        length = np.hypot(*along.T)
        if not (length > 0).all():
            raise InputError(f"lines: ends_px: the two points of line {int(np.argmin(length > 0))} are the same")
        normal = np.column_stack([-along[:, 1], along[:, 0]]) / length[:, None]
        rho = np.einsum("li,li->l", normal, ends[:, 0])
        slope = np.zeros((2 * len(ends), 4 * len(ends)))
        for k, n in enumerate(normal):
            # A shift of the second end along the normal turns the line by shift / length, of the
            # first by minus that; rho changes by as much as the line's point nearest the origin moves.
            foot = -float(along[k] @ ends[k, 0]) / length[k] ** 2  # 0 at the first end, 1 at the second
            slope[2 * k, 4 * k : 4 * k + 4] = [*(1.0 - foot) * n, *foot * n]
            slope[2 * k + 1, 4 * k : 4 * k + 4] = [*-n / length[k], *n / length[k]]
        return cls(np.column_stack([rho, np.arctan2(normal[:, 1], normal[:, 0])]), slope @ cov @ slope.T)


@dataclass(frozen=True, eq=False)
class AttitudePrior:
    """An attitude from elsewhere: `runway_from_camera` (3, 3, or a scipy Rotation), and the
    covariance (3, 3), rad², of its local increment about the camera's axes.

    Raises InputError for a matrix that is no rotation (to 1e-6), or no covariance.
    """

    runway_from_camera: Array
    cov_rad2: Array

    def __post_init__(self) -> None:
        given: Any = self.runway_from_camera
        matrix = as_array(given.as_matrix() if hasattr(given, "as_matrix") else given, (3, 3), "attitude_prior")
        rotation = nearest_rotation(matrix)
        off = float(np.abs(matrix - rotation).max())
        if off > 1e-6 or np.linalg.det(matrix) < 0:
            raise InputError(f"attitude_prior: not a rotation (off by {off:.1e}, or it mirrors)")
        object.__setattr__(self, "runway_from_camera", rotation)
        object.__setattr__(self, "cov_rad2", _prior_covariance(self.cov_rad2, "attitude_prior"))


@dataclass(frozen=True, eq=False)
class PositionPrior:
    """A position from elsewhere: `position_m` (3,) in the runway frame, covariance (3, 3) m².

    Raises InputError for a wrong shape, a non-finite entry or no covariance.
    """

    position_m: Array
    cov_m2: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "position_m", as_array(self.position_m, (3,), "position_prior"))
        object.__setattr__(self, "cov_m2", _prior_covariance(self.cov_m2, "position_prior"))


@dataclass(frozen=True)
class Altitude:
    """Height over z = 0 of the runway frame, as of a radar altimeter over the threshold's plane.

    Raises InputError unless both are finite and `sigma_m` is positive.
    """

    height_m: float
    sigma_m: float

    def __post_init__(self) -> None:
        for name in ("height_m", "sigma_m"):
            object.__setattr__(self, name, float(as_array(getattr(self, name), (), f"altitude: {name}")))
        if not self.sigma_m > 0 or not self.sigma_m**2 > 0:
            raise InputError(f"altitude: sigma_m is {self.sigma_m}; it must be > 0")


def given_as(kind: type[Kind], value: Any, name: str) -> Kind:
    """`value` if it is of the type, else the pair it holds, checked. Raises InputError naming the argument."""
    if isinstance(value, kind):
        return value
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != 2:
        raise InputError(f"{name}: expected a value and its covariance, got {' '.join(repr(value).split()):.80}")
    return kind(*value)


def _prior_covariance(cov: ArrayLike, name: str) -> Array:
    array = as_array(cov, (3, 3), f"{name}: covariance")
    check_covariance(array, f"{name}: covariance", lambda row: _AXES[row])
    return array
