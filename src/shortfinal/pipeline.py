"""One frame in; where the runway is, where the camera is, and whether to believe it, out."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shortfinal.crops import box_around, centre_crop
from shortfinal.detector import Image, KeypointDetector, check_image, crop_image
from shortfinal.errors import InputError
from shortfinal.geometry import Camera, PixelWindow, Pose, as_array, project
from shortfinal.integrity import FALSE_ALARM_RATE, Decision, IntegrityVerdict, check_integrity, check_rate
from shortfinal.keypoints import CORNER_NAMES, GaussianKeypoints
from shortfinal.pose import PoseEstimate, estimate_pose
from shortfinal.protection import FAULT_PRIOR, INTEGRITY_RISK, ProtectionLevels, protection_levels
from shortfinal.runway import Runway

Array = NDArray[np.float64]
T = TypeVar("T")

WIDE_MARGIN = 1.9  # of the first crop around a prior pose: the widest that training uses
LOOKS = 3  # crops at most, for a frame
FLAT = 1.5  # standard deviation of a crop's levels, of 255, below which nothing can be in it


@dataclass(frozen=True, eq=False)
class FrameResult:
    """All that is known of one frame. What could not be done is None, and `verdict.reasons` says why."""

    timestamp_s: float
    crop: PixelWindow | None  # where the detector looked
    keypoints: GaussianKeypoints | None  # in the frame's pixels
    estimate: PoseEstimate | None
    verdict: IntegrityVerdict
    protection: ProtectionLevels | None = None  # what bounds the error of an accepted frame; None if not monitored
    timings: dict[str, float] = field(default_factory=dict)  # "detect_ms", "solve_ms", "doubt_ms"

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON. Lengths in metres, angles in degrees, pixels of the frame."""
        record: dict[str, Any] = {
            "timestamp_s": self.timestamp_s,
            "decision": self.verdict.decision.value,
            "reasons": list(self.verdict.reasons),
            "statistic": self.verdict.statistic,
            "dof": self.verdict.dof,
            "p_value": self.verdict.p_value,
            "timings": {stage: round(ms, 3) for stage, ms in self.timings.items()},
        }
        if self.crop is not None:
            record["crop"] = [self.crop.left, self.crop.top, self.crop.width, self.crop.height]
        if self.keypoints is not None:
            record["keypoints_px"] = self.keypoints.mean_px.tolist()
            record["keypoints_cov_px"] = self.keypoints.cov_px.tolist()
        if self.estimate is not None:
            record["status"] = self.estimate.status.value
        if self.estimate is not None and self.estimate.pose is not None and self.estimate.cov is not None:
            record["position_m"] = self.estimate.pose.position_m.tolist()
            record["attitude_deg"] = list(self.estimate.pose.attitude)
            record["pose_cov"] = self.estimate.cov.tolist()
        if self.protection is not None:
            record["protection"] = self.protection.to_dict()
        return record


class LandingPipeline:
    """Crop, detect, solve, doubt: one runway, one camera, frame after frame.

    Where to look comes with each frame: a box around the runway, or a prior pose (GNSS/INS), or
    else the last frame whose pose was accepted. Frames must be of the camera's size.
    """

    def __init__(
        self,
        detector: KeypointDetector,
        runway: Runway,
        camera: Camera,
        *,
        false_alarm_rate: float = FALSE_ALARM_RATE,
        integrity_risk: float = INTEGRITY_RISK,
        fault_prior: float = FAULT_PRIOR,
    ) -> None:
        """The last two are for the protection levels, as in `protection_levels`.

        Raises InputError for a probability outside (0, 1) or a model whose keypoints are not the four corners.
        """
        if detector.info.keypoints != CORNER_NAMES:
            raise InputError(
                f"detector: its keypoints are {', '.join(detector.info.keypoints)}; expected {', '.join(CORNER_NAMES)}"
            )
        for name, rate in (
            ("false_alarm_rate", false_alarm_rate), ("integrity_risk", integrity_risk), ("fault_prior", fault_prior)
        ):  # fmt: skip
            check_rate(rate, name)
        self.detector, self.runway, self.camera = detector, runway, camera
        self.false_alarm_rate, self.integrity_risk, self.fault_prior = false_alarm_rate, integrity_risk, fault_prior
        self._last: Pose | None = None

    def step(
        self,
        frame_rgb: Image,
        timestamp_s: float = 0.0,
        *,
        box: ArrayLike | None = None,
        prior: Pose | None = None,
    ) -> FrameResult:
        """Process one frame (height, width, 3; RGB, uint8).

        `box` (4,): left, top, right, bottom in pixels; `prior`: a pose near enough for a crop
        twice the runway's size to see most of it. Raises InputError for a frame of another size or
        type or a timestamp that is not finite; whatever fails after that is a verdict of
        NOT_MONITORED with its reason.
        """
        check_image(frame_rgb)
        if frame_rgb.shape[:2] != (self.camera.height, self.camera.width):
            raise InputError(
                f"frame: {frame_rgb.shape[1]} x {frame_rgb.shape[0]} pixels; "
                f"the camera has {self.camera.width} x {self.camera.height}"
            )
        if not math.isfinite(timestamp_s):
            raise InputError(f"timestamp_s: {timestamp_s}; it must be finite")
        timings: dict[str, float] = {}
        try:
            crop, keypoints, obstacle = _timed(timings, "detect_ms", lambda: self._look(frame_rgb, box, prior))
        except InputError as error:
            return FrameResult(timestamp_s, None, None, None, self._not_monitored(str(error)), None, timings)
        if obstacle:
            return FrameResult(timestamp_s, crop, keypoints, None, self._not_monitored(obstacle), None, timings)
        estimate, verdict, protection = self.judge(keypoints, timings)
        return FrameResult(timestamp_s, crop, keypoints, estimate, verdict, protection, timings)

    def judge(
        self, keypoints: GaussianKeypoints, timings: dict[str, float] | None = None
    ) -> tuple[PoseEstimate, IntegrityVerdict, ProtectionLevels | None]:
        """Solve and doubt: from keypoints in the frame's pixels, whoever found them."""
        timings = {} if timings is None else timings
        estimate = _timed(timings, "solve_ms", lambda: estimate_pose(keypoints, self.runway.corners, self.camera))
        verdict, protection = _timed(timings, "doubt_ms", lambda: self._doubt(estimate))
        if verdict.decision is Decision.USE:
            self._last = estimate.pose
        return estimate, verdict, protection

    def _doubt(self, estimate: PoseEstimate) -> tuple[IntegrityVerdict, ProtectionLevels | None]:
        verdict = check_integrity(estimate, self.false_alarm_rate)
        if verdict.decision is Decision.NOT_MONITORED:
            return verdict, None
        return verdict, protection_levels(
            estimate,
            integrity_risk=self.integrity_risk,
            fault_prior=self.fault_prior,
            false_alarm_rate=self.false_alarm_rate,
        )

    def _not_monitored(self, reason: str) -> IntegrityVerdict:
        return IntegrityVerdict(Decision.NOT_MONITORED, (reason,), 0, self.false_alarm_rate)

    def _look(
        self, frame: Image, box: ArrayLike | None, prior: Pose | None
    ) -> tuple[PixelWindow, GaussianKeypoints, str]:
        """Crop and detect; again where the runway was found, until the crop frames it; what is in the way, or "".

        A network must name four corners, even of a runway that the crop cuts off, and it does so with
        confidence. So what was found counts only if it lies well inside what was looked at.
        """
        margin, size = self.detector.info.margin, self.detector.info.size
        wide = margin if box is not None else WIDE_MARGIN
        window = centre_crop(self._first_box(box, prior), wide, size)
        if crop_image(frame, window).std() < FLAT:
            raise InputError("nothing to see: the crop is flat")
        keypoints = self.detector.detect(frame, window)
        for _ in range(LOOKS - 1):
            if _frames(window, keypoints, margin):
                break
            window = centre_crop(box_around(keypoints.mean_px), margin, size)
            keypoints = self.detector.detect(frame, window)
        if not _frames(window, keypoints, margin):
            return window, keypoints, f"the runway does not settle inside the crop in {LOOKS} looks"
        return window, keypoints, self._cut_off(keypoints)

    def _first_box(self, box: ArrayLike | None, prior: Pose | None) -> Array:
        if box is None:
            near = prior or self._last
            if near is None:
                raise InputError("where to look is not known: no box, no prior pose, and no earlier frame was accepted")
            box = box_around(project(self.camera, near, self.runway.corners))
        bounds = as_array(box, (4,), "box")
        if (bounds[2:] < 0).any() or bounds[0] >= self.camera.width or bounds[1] >= self.camera.height:
            raise InputError(f"the runway's box {np.round(bounds).tolist()} lies outside the frame")
        return bounds

    def _cut_off(self, keypoints: GaussianKeypoints) -> str:
        """Which corner is at the frame's border, to within 2 sigma: it may lie beyond, unseen."""
        reach = 2 * keypoints.sigma_px
        last = np.array([self.camera.width - 1, self.camera.height - 1])
        outside = ((keypoints.mean_px < reach) | (keypoints.mean_px > last - reach)).any(axis=1)
        if not outside.any():
            return ""
        return f"the {CORNER_NAMES[int(outside.argmax())]} corner lies at the border of the frame, or beyond it"


def _frames(window: PixelWindow, keypoints: GaussianKeypoints, margin: float) -> bool:
    """Whether the crop has the runway inside, with half the intended border, and not much too small."""
    inside = window.apply(keypoints.mean_px) / (window.out_width - 1)
    border = (1 - 1 / margin) / 4
    extent = float(np.ptp(inside, axis=0).max())
    return bool((inside > border).all() and (inside < 1 - border).all() and extent > 0.8 / margin)


def _timed(timings: dict[str, float], stage: str, work: Callable[[], T]) -> T:
    start = time.perf_counter()
    try:
        return work()
    finally:
        timings[stage] = 1e3 * (time.perf_counter() - start)
