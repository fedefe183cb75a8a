"""A pose problem in a JSON file: keypoints that someone else found, for `shortfinal solve`."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shortfinal.errors import InputError
from shortfinal.features import Altitude, AttitudePrior, GaussianLines, PositionPrior
from shortfinal.files import read_json
from shortfinal.geometry import Camera, Pose, as_array
from shortfinal.keypoints import GaussianKeypoints
from shortfinal.pose import PoseEstimate, estimate_pose
from shortfinal.runway import Runway

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PoseProblem:
    """What `estimate_pose` needs, and the file it came from."""

    source: str
    keypoints: GaussianKeypoints
    points_m: Array  # (K, 3) runway frame
    camera: Camera
    features: dict[str, Any]  # lines, priors and the points' own sigma, by estimate_pose's names for them

    def solve(self) -> PoseEstimate:
        """The estimate, whatever its status. Raises InputError naming the file if there is nothing to solve."""
        try:
            return estimate_pose(self.keypoints, self.points_m, self.camera, **self.features)
        except InputError as error:
            raise InputError(f"{self.source}: {error}") from error


def read_problem(path: str | Path) -> PoseProblem:
    """Read a problem.

    {"camera": {"width", "height", "fx", "fy", "cx", "cy", "distortion"}, "keypoints_px": K x 2,
    "sigma_px": one number or K x 2, or "cov_px": 2K x 2K, "points_m": K x 3, or "runway":
    {"length_m", "width_m", "survey_sigma_m"}}; and, where there is more to go by, "attitude_prior": {"yaw_deg",
    "pitch_deg", "roll_deg", "sigma_deg"}, "position_prior": {"position_m", "sigma_m"}, "altitude":
    {"height_m", "sigma_m"}, "lines": {"rho_px", "theta_deg", "sigma_px", "sigma_deg", "edges_m"} (the
    edges: L x 2 x 3, the runway's left and right edge if not given). A sigma is one number or one for
    each value. Raises InputError naming the file and the field.
    """
    content = read_json(path, "problem")
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected a JSON object with camera, keypoints_px, sigma_px and runway")
    try:
        return _problem(content, str(path))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _problem(content: dict[str, Any], source: str) -> PoseProblem:
    camera, features = _build(Camera, _field(content, "camera"), "camera"), _features(content)
    if "points_m" in content:
        points = as_array(content["points_m"], (None, 3), "points_m")
    else:
        runway = _build(Runway, _field(content, "runway"), "runway")
        points, features["points_sigma_m"] = runway.corners, runway.survey_sigma_m
    mean = _field(content, "keypoints_px")
    if "cov_px" in content:
        keypoints = GaussianKeypoints(mean, content["cov_px"])
    else:
        keypoints = GaussianKeypoints.from_sigma(mean, _field(content, "sigma_px"))
    _check_outline(keypoints)
    return PoseProblem(source, keypoints, points, camera, features)


def _features(content: dict[str, Any]) -> dict[str, Any]:
    """What the file gives beside keypoints, as arguments of `estimate_pose`."""
    features: dict[str, Any] = {}
    if "altitude" in content:
        features["altitude"] = _build(Altitude, content["altitude"], "altitude")
    if "position_prior" in content:
        given = _build(_Position, content["position_prior"], "position_prior")
        features["position_prior"] = PositionPrior(given.position_m, _variances(given.sigma_m, 3, "position_prior"))
    if "attitude_prior" in content:
        given = _build(_AttitudeDeg, content["attitude_prior"], "attitude_prior")
        angles = as_array([given.yaw_deg, given.pitch_deg, given.roll_deg], (3,), "attitude_prior")
        turn = Pose.from_attitude([0.0, 0.0, 0.0], *angles).runway_from_camera
        variances = _variances(given.sigma_deg, 3, "attitude_prior")
        features["attitude_prior"] = AttitudePrior(turn, np.radians(1.0) ** 2 * variances)
    if "lines" in content:
        features |= _lines(_build(_LinesDeg, content["lines"], "lines"), content)
    return features


def _lines(given: _LinesDeg, content: dict[str, Any]) -> dict[str, Any]:
    rho, theta = (
        as_array(given.rho_px, (None,), "lines: rho_px"),
        as_array(given.theta_deg, (None,), "lines: theta_deg"),
    )
    if len(rho) != len(theta):
        raise InputError(f"lines: {len(rho)} rho_px for {len(theta)} theta_deg; give one of each per line")
    variances = np.diag(_variances(given.sigma_px, len(rho), "lines")).repeat(2)
    variances[1::2] = np.radians(1.0) ** 2 * np.diag(_variances(given.sigma_deg, len(rho), "lines"))
    if given.edges_m is None and "runway" not in content:
        raise InputError("lines: no field 'edges_m', and no runway whose edges they could be")
    edges = _build(Runway, content["runway"], "runway").edges if given.edges_m is None else given.edges_m
    lines = GaussianLines(np.column_stack([rho, np.radians(theta)]), np.diag(variances))
    return {"lines": lines, "edges": edges}


@dataclass(frozen=True)
class _Position:
    position_m: Any
    sigma_m: Any


@dataclass(frozen=True)
class _AttitudeDeg:
    yaw_deg: Any
    pitch_deg: Any
    roll_deg: Any
    sigma_deg: Any  # about the camera's x, y and z axes


@dataclass(frozen=True)
class _LinesDeg:
    rho_px: Any
    theta_deg: Any
    sigma_px: Any
    sigma_deg: Any
    edges_m: Any = None


def _variances(sigma: Any, count: int, name: str) -> Array:
    """Covariance (count, count) of independent values; `sigma` is one number or one for each."""
    given = np.asarray(as_array(sigma, () if np.ndim(sigma) == 0 else (count,), f"{name}: sigma"))
    return np.diag(np.broadcast_to(given, (count,)) ** 2)


def _check_outline(keypoints: GaussianKeypoints) -> None:
    """Refuse keypoints on one line, to within their sigma: a plane seen edge-on fixes no pose."""
    off_line = np.linalg.svd(keypoints.mean_px - keypoints.mean_px.mean(axis=0), compute_uv=False)[-1]
    if len(keypoints.mean_px) > 2 and off_line < keypoints.sigma_px.max():
        raise InputError(f"keypoints_px: all lie on one line, to {off_line:.2g} px; corners must span an area")


def _field(content: dict[str, Any], name: str) -> Any:
    if name not in content:
        raise InputError(f"no field {name!r}; it has {', '.join(content) or 'none'}")
    return content[name]


def _build(kind: Any, values: Any, name: str) -> Any:
    known = {field.name for field in fields(kind)}
    needed = {field.name for field in fields(kind) if field.default is MISSING}
    if not isinstance(values, dict) or not needed <= set(values) <= known:
        raise InputError(f"{name}: expected an object with {', '.join(sorted(needed))}, got {values!r:.80}")
    return kind(**values)
