"""shortfinal: runway keypoints with uncertainty, the pose they give, and whether to believe it.

Names are loaded on first use, so that `import shortfinal` is instant and never loads torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from shortfinal.calibration import Calibration, coverage, fit_calibration, fit_sigma_scale, gaussian_nll, sharpness
    from shortfinal.detector import KeypointDetector, Look, ModelInfo
    from shortfinal.distribution import PoseSamples, sample_pose
    from shortfinal.errors import InputError
    from shortfinal.exclusion import FaultExclusion, exclude_faults
    from shortfinal.features import Altitude, AttitudePrior, Feature, GaussianLines, PositionPrior
    from shortfinal.geometry import (
        Attitude,
        Camera,
        PixelWindow,
        Pose,
        project,
        project_jacobian,
        project_lines,
        unproject,
    )
    from shortfinal.integrity import (
        Decision,
        IntegrityVerdict,
        check_integrity,
        check_integrity_as_published,
        check_integrity_batch,
        detection_probability,
        minimal_detectable_bias,
    )
    from shortfinal.keypoints import CORNER_NAMES, GaussianKeypoints
    from shortfinal.pipeline import FrameResult, LandingPipeline
    from shortfinal.pose import PoseEstimate, PoseEstimateBatch, SolverStatus, estimate_pose, estimate_pose_batch
    from shortfinal.protection import AlertLimits, ProtectionLevels, protection_levels, protection_levels_batch
    from shortfinal.runway import Runway, find_runway
    from shortfinal.tracker import Track, Tracker, TrackerSettings, TrackState
    from shortfinal.window import IntegrityWindow, RelativeMotion, WindowVerdict, check_window

_HOME = {
    "calibration": ("Calibration", "coverage", "fit_calibration", "fit_sigma_scale", "gaussian_nll", "sharpness"),
    "detector": ("KeypointDetector", "Look", "ModelInfo"),
    "errors": ("InputError",),
    "geometry": (
        "Attitude",
        "Camera",
        "PixelWindow",
        "Pose",
        "project",
        "project_jacobian",
        "project_lines",
        "unproject",
    ),
    "integrity": (
        "Decision",
        "IntegrityVerdict",
        "check_integrity",
        "check_integrity_as_published",
        "check_integrity_batch",
        "detection_probability",
        "minimal_detectable_bias",
    ),
    "keypoints": ("CORNER_NAMES", "GaussianKeypoints"),
    "pipeline": ("FrameResult", "LandingPipeline"),
    "pose": ("PoseEstimate", "PoseEstimateBatch", "SolverStatus", "estimate_pose", "estimate_pose_batch"),
    "runway": ("Runway", "find_runway"),
    "exclusion": ("FaultExclusion", "exclude_faults"),
    "distribution": ("PoseSamples", "sample_pose"),
    "features": ("Altitude", "AttitudePrior", "Feature", "GaussianLines", "PositionPrior"),
    "protection": ("AlertLimits", "ProtectionLevels", "protection_levels", "protection_levels_batch"),
    "tracker": ("Track", "Tracker", "TrackerSettings", "TrackState"),
    "window": ("IntegrityWindow", "RelativeMotion", "WindowVerdict", "check_window"),
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__version__ = "0.1.0"
__all__ = [
    "CORNER_NAMES",
    "AlertLimits",
    "Altitude",
    "Attitude",
    "AttitudePrior",
    "Calibration",
    "Camera",
    "Decision",
    "FaultExclusion",
    "Feature",
    "FrameResult",
    "GaussianKeypoints",
    "GaussianLines",
    "InputError",
    "IntegrityVerdict",
    "IntegrityWindow",
    "KeypointDetector",
    "LandingPipeline",
    "Look",
    "ModelInfo",
    "PixelWindow",
    "Pose",
    "PoseEstimate",
    "PoseEstimateBatch",
    "PoseSamples",
    "PositionPrior",
    "ProtectionLevels",
    "RelativeMotion",
    "Runway",
    "SolverStatus",
    "Track",
    "TrackState",
    "Tracker",
    "TrackerSettings",
    "WindowVerdict",
    "__version__",
    "check_integrity",
    "check_integrity_as_published",
    "check_integrity_batch",
    "check_window",
    "coverage",
    "detection_probability",
    "estimate_pose",
    "estimate_pose_batch",
    "exclude_faults",
    "find_runway",
    "fit_calibration",
    "fit_sigma_scale",
    "gaussian_nll",
    "minimal_detectable_bias",
    "project",
    "project_jacobian",
    "project_lines",
    "protection_levels",
    "protection_levels_batch",
    "sample_pose",
    "sharpness",
    "unproject",
]


def __getattr__(name: str) -> Any:
    module = _MODULE_OF.get(name)
    if module is None:
        raise AttributeError(f"module 'shortfinal' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"shortfinal.{module}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
