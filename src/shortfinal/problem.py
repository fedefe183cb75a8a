"""A pose problem in a JSON file: keypoints that someone else found, for `shortfinal solve`."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shortfinal.errors import InputError
from shortfinal.files import read_json
from shortfinal.geometry import Camera, as_array
from shortfinal.keypoints import GaussianKeypoints
from shortfinal.pose import PoseEstimate, estimate_pose
from shortfinal.runway import Runway


@dataclass(frozen=True, eq=False)
class PoseProblem:
    """What `estimate_pose` needs, and the file it came from."""

    source: str
    keypoints: GaussianKeypoints
    points_m: NDArray[np.float64]  # (K, 3) runway frame
    camera: Camera

    def solve(self) -> PoseEstimate:
        """The estimate, whatever its status. Raises InputError naming the file if there is nothing to solve."""
        try:
            return estimate_pose(self.keypoints, self.points_m, self.camera)
        except InputError as error:
            raise InputError(f"{self.source}: {error}") from error


def read_problem(path: str | Path) -> PoseProblem:
    """Read a problem.

    {"camera": {"width", "height", "fx", "fy", "cx", "cy", "distortion"}, "keypoints_px": K x 2,
    "sigma_px": one number or K x 2, or "cov_px": 2K x 2K, "points_m": K x 3, or "runway":
    {"length_m", "width_m"}}. Raises InputError naming the file and the field.
    """
    content = read_json(path, "problem")
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected a JSON object with camera, keypoints_px, sigma_px and runway")
    try:
        return _problem(content, str(path))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _problem(content: dict[str, Any], source: str) -> PoseProblem:
    camera = _build(Camera, _field(content, "camera"), "camera")
    if "points_m" in content:
        points = as_array(content["points_m"], (None, 3), "points_m")
    else:
        points = _build(Runway, _field(content, "runway"), "runway").corners
    mean = _field(content, "keypoints_px")
    if "cov_px" in content:
        keypoints = GaussianKeypoints(mean, content["cov_px"])
    else:
        keypoints = GaussianKeypoints.from_sigma(mean, _field(content, "sigma_px"))
    _check_outline(keypoints)
    return PoseProblem(source, keypoints, points, camera)


def _check_outline(keypoints: GaussianKeypoints) -> None:
    """Refuse keypoints on one line, to within their sigma: a plane seen edge-on fixes no pose."""
    off_line = np.linalg.svd(keypoints.mean_px - keypoints.mean_px.mean(axis=0), compute_uv=False)[-1]
    if off_line < keypoints.sigma_px.max():
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
