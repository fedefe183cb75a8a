"""One frame in; where the runway is, where the camera is, and whether to believe it, out."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shortfinal.crops import box_around, centre_crop
from shortfinal.detector import VISIBLE, Image, KeypointDetector, Look, Spot, check_image, crop_image, refined
from shortfinal.errors import InputError
from shortfinal.geometry import Camera, PixelWindow, Pose, as_array, project
from shortfinal.integrity import FALSE_ALARM_RATE, Decision, IntegrityVerdict, check_integrity, check_rate
from shortfinal.keypoints import CORNER_NAMES, GaussianKeypoints
from shortfinal.pose import PoseEstimate, estimate_pose
from shortfinal.protection import FAULT_PRIOR, INTEGRITY_RISK, ProtectionLevels, protection_levels
from shortfinal.runway import Runway
from shortfinal.search import Search, distinct, windows_around
from shortfinal.tracker import Track, Tracker, TrackState
from shortfinal.window import RelativeMotion

Array = NDArray[np.float64]
T = TypeVar("T")

WIDE_MARGIN = 1.9  # of the first crop around a prior pose: the widest that training uses
SPOT_MARGIN = 2.2  # of the first crop where a search found something: its place and size are rough
# What a search finds is a runway if it is present and each corner is visible with such a probability, and no
# coordinate's sigma exceeds such a share of the longer side of its box (benchmarks/search.py, docs/search.md).
CERTAIN, LIKELY = (0.999, 0.9, 0.09), (0.9, 0.5, 0.18)
FOLLOWED = 6  # spots of a frame, at most, that are looked at closely
LOOKS = 3  # crops at most, for a frame
PRESENT = 0.5  # probability of a runway below which there is none
COMPARED_ROWS = 16  # every so many of a picture's rows tell whether it is the last one once more
FLAT = 1.5  # standard deviation of a crop's levels, of 255, below which nothing can be in it


@dataclass(frozen=True, eq=False)
class FrameResult:
    """All that is known of one frame. What could not be done is None, and `verdict.reasons` says why."""

    timestamp_s: float
    crop: PixelWindow | None  # where the detector looked for the whole runway
    keypoints: GaussianKeypoints | None  # in the frame's pixels
    estimate: PoseEstimate | None
    verdict: IntegrityVerdict
    protection: ProtectionLevels | None = None  # what bounds the error of an accepted frame; None if not monitored
    timings: dict[str, float] = field(default_factory=dict)  # "detect_ms", "solve_ms", "doubt_ms"
    present: float | None = None  # probability that a runway is in the crop
    calibrated_on: str | None = None  # what the keypoints' sigma was mended with; None: it is the network's own
    bounds_95_px: Array | None = None  # (K, 2) split-conformal: 95 % of the errors are no larger; None: not calibrated
    track: Track | None = None  # over time, this frame included; None without a tracker

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
            record["crop"] = _bounds(self.crop)
            record["present"] = self.present
        if self.keypoints is not None:
            record["keypoints_px"] = self.keypoints.mean_px.tolist()
            record["keypoints_cov_px"] = self.keypoints.cov_px.tolist()
            record["calibrated_on"] = self.calibrated_on
        if self.bounds_95_px is not None:
            record["bounds_95_px"] = [[b if math.isfinite(b) else None for b in row] for row in self.bounds_95_px]
        if self.estimate is not None:
            record["status"] = self.estimate.status.value
        if self.estimate is not None and self.estimate.pose is not None and self.estimate.cov is not None:
            record["position_m"] = self.estimate.pose.position_m.tolist()
            record["attitude_deg"] = list(self.estimate.pose.attitude)
            record["pose_cov"] = self.estimate.cov.tolist()
        if self.protection is not None:
            record["protection"] = self.protection.to_dict()
        if self.track is not None:
            record["track"] = self.track.to_dict()
        return record


class LandingPipeline:
    """Find, crop, detect, solve, doubt, track: one runway, one camera, frame after frame.

    Where to look comes with the frame, a box around the runway or a prior pose (GNSS/INS), or else from the
    track's prediction, or the last frame whose pose was accepted. Without any of these the frame is searched,
    a part of it with each. Frames must be of the camera's size.
    """

    def __init__(
        self,
        detector: KeypointDetector,
        runway: Runway,
        camera: Camera,
        *,
        further_points: ArrayLike | None = None,
        tracker: Tracker | None = None,
        false_alarm_rate: float = FALSE_ALARM_RATE,
        integrity_risk: float = INTEGRITY_RISK,
        fault_prior: float = FAULT_PRIOR,
    ) -> None:
        """`further_points` (K - 4, 3): where the model's keypoints beyond the corners are on this runway, metres;
        those that are seen take part. `tracker`: follows pose and velocity over the frames; without one each frame
        stands alone. The last two are for the protection levels, as in `protection_levels`.

        Raises InputError for a probability outside (0, 1) or a model that finds other points than these.
        """
        for name, rate in (
            ("false_alarm_rate", false_alarm_rate), ("integrity_risk", integrity_risk), ("fault_prior", fault_prior)
        ):  # fmt: skip
            check_rate(rate, name)
        self.points = _places(detector, runway, further_points)
        self.detector, self._runway, self.camera = detector, runway, camera
        self.false_alarm_rate, self.integrity_risk, self.fault_prior = false_alarm_rate, integrity_risk, fault_prior
        self.tracker = tracker
        self._last: Pose | None = None
        self._search = Search(camera.width, camera.height, detector.info.size) if detector.searches else None
        self._rows, self._fresh_s = np.empty(0, np.uint8), -math.inf  # of the last picture that was new; when it came

    @property
    def runway(self) -> Runway:
        """The one to land on."""
        return self._runway

    def land_on(self, runway: Runway, further_points: ArrayLike | None = None) -> None:
        """Another runway from here on. Poses are in a runway's own frame, so what was known of the last one is
        forgotten, and the track begins anew. `further_points` and errors as in the constructor.
        """
        self.points = _places(self.detector, runway, further_points)
        self._runway, self._last = runway, None
        if self._search is not None:
            self._search.again()
        if self.tracker is not None:
            self.tracker.restart("the runway was changed")

    def step(
        self,
        frame_rgb: Image,
        timestamp_s: float = 0.0,
        *,
        box: ArrayLike | None = None,
        prior: Pose | None = None,
        motion: RelativeMotion | None = None,
    ) -> FrameResult:
        """Process one frame (height, width, 3; RGB, uint8).

        `box` (4,): left, top, right, bottom in pixels; `prior`: a pose near enough for a crop
        twice the runway's size to see most of it; `motion` of the camera since the last frame, by odometry,
        for the tracker. Raises InputError for a frame of another size or
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
        stale_s = self._repeats(frame_rgb, timestamp_s)
        if stale_s > 0:
            words = f"the same picture as {stale_s:.2f} s ago: frozen"
            return self._tracked(FrameResult(timestamp_s, None, None, None, self._not_monitored(words)), motion)
        result = self._seen(frame_rgb, timestamp_s, box, prior)
        return self._tracked(result, motion)

    def coast(self, timestamp_s: float, reason: str) -> FrameResult:
        """What there is to say without a frame: NOT_MONITORED for that reason, and the track carried on."""
        return self._tracked(FrameResult(timestamp_s, None, None, None, self._not_monitored(reason)), None)

    def _repeats(self, frame_rgb: Image, timestamp_s: float) -> float:
        """For how long the picture has been the same, to the bit, while time went on; a sensor's noise never is."""
        rows = frame_rgb[::COMPARED_ROWS]
        if np.array_equal(rows, self._rows):
            return timestamp_s - self._fresh_s
        self._rows, self._fresh_s = rows.copy(), timestamp_s
        return 0.0

    def _tracked(self, result: FrameResult, motion: RelativeMotion | None) -> FrameResult:
        if self.tracker is None:
            return result
        start = time.perf_counter()
        track = self.tracker.update(result.timestamp_s, result.estimate, result.verdict, motion)
        result.timings["track_ms"] = 1e3 * (time.perf_counter() - start)
        if track.state is TrackState.LOST:
            self._last = None
        return replace(result, track=track)

    def _seen(self, frame_rgb: Image, timestamp_s: float, box: ArrayLike | None, prior: Pose | None) -> FrameResult:
        near = prior or self._expected(timestamp_s)
        if box is None and near is None and self._search is not None:
            return self._found(frame_rgb, timestamp_s, self._search)
        timings: dict[str, float] = {}
        try:
            wide = None if box is not None else WIDE_MARGIN
            sight = _timed(
                timings, "detect_ms", lambda: see(self.detector, frame_rgb, self._first_box(box, near), wide)
            )
        except InputError as error:
            self._last = None
            return FrameResult(timestamp_s, None, None, None, self._not_monitored(str(error)), None, timings)
        if sight.obstacle:
            self._last = None  # it is not where it was: the next frame is searched
        return self._judged(sight, timestamp_s, timings)

    def _found(self, frame_rgb: Image, timestamp_s: float, search: Search) -> FrameResult:
        """A frame of which nothing is known: what of the runway is found in the part of it whose turn it is."""
        timings: dict[str, float] = {}
        try:
            spots = _timed(timings, "search_ms", lambda: search.look(self.detector, frame_rgb))
            sights = _timed(timings, "detect_ms", lambda: self._settled(frame_rgb, spots))
        except InputError as error:
            return FrameResult(timestamp_s, None, None, None, self._not_monitored(str(error)), None, timings)
        results = [self._judged(sight, timestamp_s, timings) for sight in sights]
        fitting = [result for result in self._meant(results) if self._fits(result, sights[results.index(result)])]
        self._last = None
        if len(fitting) == 1:
            search.again()
            assert fitting[0].estimate is not None  # as one that fits has
            self._last = fitting[0].estimate.pose
            return fitting[0]
        reason = f"searching for the runway: {search.progress}, none found"
        if results and self._side and not fitting:
            reason += (
                f" that is {self.runway.ident} for certain, with {len(results)} in view; a prior pose or a box tells"
            )
        elif results and not fitting:  # a pattern of fields can pass for a runway, but hardly for this one
            reason += f" that fits; one does not: {'; '.join(results[0].verdict.reasons)}"
        elif fitting:
            reason = f"{len(fitting)} runways in view fit, and which is meant is not known: pass a prior pose or a box"
        return FrameResult(timestamp_s, None, None, None, self._not_monitored(reason), None, timings)

    def _fits(self, result: FrameResult, sight: Sight) -> bool:
        """Whether what was found is the runway: by the look at the whole, where the sharper corners do not fit it. They
        tell whether this frame's measurement may be used.
        """
        verdict = result.verdict
        if verdict.decision is Decision.DO_NOT_USE and sight.keypoints is not sight.look.keypoints:
            _, verdict, _ = self.judge(sight.look.keypoints.only(sight.seen), points=self.points[sight.seen])
        return verdict.decision is Decision.USE

    def _settled(self, frame_rgb: Image, spots: list[Spot]) -> list[Sight]:
        """The runways that are at those spots, and beside them: each settled, nothing in its way.

        The first for certain; to count those beside it, where the runway's name needs that, less will do.
        """
        sights: list[Sight] = []
        ahead, followed = list(spots), 0
        while ahead and followed < FOLLOWED:
            limits = LIKELY if sights and self._side else CERTAIN
            sight, followed = _sight_at(self.detector, frame_rgb, ahead.pop(0), limits), followed + 1
            if sight is None or any(_spot_of(sight).overlaps(_spot_of(other)) for other in sights):
                continue
            if not sights:
                around = windows_around(_spot_of(sight), self.detector.info.size)
                ahead = distinct([*ahead, *self.detector.spots(frame_rgb, around)])
            sights.append(sight)
        return sights

    @property
    def _side(self) -> str:
        """L, C or R where the runway's name says that it has others beside it."""
        named = re.search(r"\d([LCR])$", self.runway.ident)
        return named[1] if named else ""

    def _meant(self, results: list[FrameResult]) -> list[FrameResult]:
        """Of runways in view those that may be meant: all, or if the name says which side, the one on that side.

        One alone may then be any of them, and so may each of two for a C.
        """
        if not self._side:
            return results
        if len(results) < (3 if self._side == "C" else 2):
            return []
        across = sorted(results, key=lambda result: 0.0 if result.crop is None else result.crop.left)
        return [across[{"L": 0, "C": len(across) // 2, "R": -1}[self._side]]]

    def _judged(self, sight: Sight, timestamp_s: float, timings: dict[str, float]) -> FrameResult:
        seen = (sight.look.present, *self._bounds(sight))
        crop, keypoints = sight.look.window, sight.keypoints.only(sight.seen)
        if sight.obstacle:
            verdict = self._not_monitored(sight.obstacle)
            return FrameResult(timestamp_s, crop, keypoints, None, verdict, None, timings, *seen)
        estimate, verdict, protection = self.judge(keypoints, timings, self.points[sight.seen])
        return FrameResult(timestamp_s, crop, keypoints, estimate, verdict, protection, timings, *seen)

    def judge(
        self,
        keypoints: GaussianKeypoints,
        timings: dict[str, float] | None = None,
        points: ArrayLike | None = None,
    ) -> tuple[PoseEstimate, IntegrityVerdict, ProtectionLevels | None]:
        """Solve and doubt: from keypoints in the frame's pixels, whoever found them, of `points` (K, 3) of the
        runway: the corners, if not given.
        """
        timings = {} if timings is None else timings
        places = self.runway.corners if points is None else points
        doubt_m = self.runway.survey_sigma_m
        estimate = _timed(
            timings, "solve_ms", lambda: estimate_pose(keypoints, places, self.camera, points_sigma_m=doubt_m)
        )
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

    def _bounds(self, sight: Sight) -> tuple[str | None, Array | None]:
        calibration = self.detector.calibration
        if calibration is None:
            return None, None
        bounds = calibration.conformal_bounds_px(sight.keypoints.sigma_px, 0.95)
        return calibration.fitted_on, bounds[sight.seen]

    def _not_monitored(self, reason: str) -> IntegrityVerdict:
        return IntegrityVerdict(Decision.NOT_MONITORED, (reason,), 0, self.false_alarm_rate)

    def _expected(self, timestamp_s: float) -> Pose | None:
        """Where the camera should be: by the track, or else where it last was."""
        track = None if self.tracker is None else self.tracker.predict(timestamp_s)
        return self._last if track is None or track.pose is None else track.pose

    def _first_box(self, box: ArrayLike | None, near: Pose | None) -> Array:
        if box is None:
            if near is None:
                raise InputError(
                    "where to look is not known: no box, no prior pose, no earlier frame was accepted, and the model "
                    "cannot search"
                )
            box = box_around(project(self.camera, near, self.runway.corners))
        bounds = as_array(box, (4,), "box")
        if (bounds[2:] < 0).any() or bounds[0] >= self.camera.width or bounds[1] >= self.camera.height:
            raise InputError(f"the runway's box {np.round(bounds).tolist()} lies outside the frame")
        return bounds


def _places(detector: KeypointDetector, runway: Runway, further_points: ArrayLike | None) -> Array:
    """Where the model's keypoints are on the runway (K, 3), metres."""
    further = np.empty((0, 3)) if further_points is None else as_array(further_points, (None, 3), "further_points")
    names = detector.info.keypoints
    if names[:4] != CORNER_NAMES or len(names) != 4 + len(further):
        raise InputError(
            f"detector: its keypoints are {', '.join(names)}; expected {', '.join(CORNER_NAMES)}"
            + (f" and {len(further)} further_points" if len(further) else "")
        )
    return np.vstack([runway.corners, further])


@dataclass(frozen=True, eq=False)
class Sight:
    """What was seen of a frame: the look at the whole runway, the keypoints, and what is in the way, if anything."""

    look: Look
    keypoints: GaussianKeypoints  # all of the model's, in the frame's pixels
    obstacle: str  # why the keypoints are not to be used; nothing if they may be

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which keypoints take part (K,): the corners, and of the further ones those that are in view."""
        return np.asarray((self.look.visible >= VISIBLE) | (np.arange(len(self.look.visible)) < 4))


def see(detector: KeypointDetector, frame: Image, box: ArrayLike, margin: float | None = None) -> Sight:
    """Crop and detect; again where the runway was found, until the crop frames it; then each corner by itself, if
    the model knows how and there is more to see: the crop that holds the whole of a near runway shows its far end,
    on which the monitor's power rests, a few pixels wide.

    `box` (4,): left, top, right, bottom around the runway, in the frame's pixels; `margin` of the first
    crop around it, the model's own if not given. A network must name four corners, even of a runway that
    the crop cuts off, and it does so with confidence. So what was found counts only if it lies well inside
    what was looked at. Raises InputError for a frame or box of no use, or a crop that is flat.
    """
    own, size = detector.info.margin, detector.info.size
    window = centre_crop(box, margin or own, size)
    if crop_image(frame, window).std() < FLAT:
        raise InputError("nothing to see: the crop is flat")
    look = detector.look(frame, window)
    for _ in range(LOOKS - 1):
        if _frames(look, own):
            break
        wider = own if look.visible[:4].min() >= VISIBLE else WIDE_MARGIN
        look = detector.look(frame, centre_crop(box_around(look.keypoints.mean_px[:4]), wider, size))
    if look.present < PRESENT:
        return Sight(look, look.keypoints, f"no runway in view (its probability is {look.present:.2g})")
    if not _frames(look, own):
        return Sight(look, look.keypoints, f"the runway does not settle inside the crop in {LOOKS} looks")
    keypoints = refined(detector, frame, look)
    return Sight(look, keypoints, _cut_off(keypoints, frame.shape[1], frame.shape[0]))


def _sight_at(detector: KeypointDetector, frame: Image, spot: Spot, limits: tuple[float, float, float]) -> Sight | None:
    """What is seen at a spot of a search; None unless it is a runway within `limits` (CERTAIN, LIKELY).

    The network names four corners of a field, too, but it is not sure where they are: by its own sigma, less than
    by what it makes of the picture as a whole, what is a runway is told from what is not.
    """
    try:
        sight = see(detector, frame, spot.box, SPOT_MARGIN)
    except InputError:  # a place of no use
        return None
    present, visible, share = limits
    # By the look at the whole: a field's corner is sharp, too.
    vague = float(sight.look.keypoints.sigma_px[:4].max()) > share * _spot_of(sight).side_px
    doubtful = sight.look.present < present or sight.look.visible[:4].min() < visible
    return None if sight.obstacle or vague or doubtful else sight


def _spot_of(sight: Sight) -> Spot:
    """The place of a runway that was looked at."""
    box = box_around(sight.keypoints.mean_px[:4])
    u, v = ((box[:2] + box[2:]) / 2).tolist()
    return Spot(sight.look.present, (u, v), float((box[2:] - box[:2]).max()))


def _cut_off(keypoints: GaussianKeypoints, width: int, height: int) -> str:
    """Which corner is at the frame's border, to within 2 sigma: it may lie beyond, unseen."""
    reach = 2 * keypoints.sigma_px
    last = np.array([width - 1, height - 1])
    outside = ((keypoints.mean_px < reach) | (keypoints.mean_px > last - reach))[:4].any(axis=1)
    if not outside.any():
        return ""
    return f"the {CORNER_NAMES[int(outside.argmax())]} corner lies at the border of the frame, or beyond it"


def _bounds(window: PixelWindow) -> list[float]:
    return [window.left, window.top, window.width, window.height]


def _frames(look: Look, margin: float) -> bool:
    """Whether the crop has all corners inside, with half the intended border, and the runway not much too small."""
    if look.visible[:4].min() < VISIBLE:
        return False
    inside = look.window.apply(look.keypoints.mean_px[:4]) / (look.window.out_width - 1)
    border = (1 - 1 / margin) / 4
    extent = float(np.ptp(inside, axis=0).max())
    return bool((inside > border).all() and (inside < 1 - border).all() and extent > 0.8 / margin)


def _timed(timings: dict[str, float], stage: str, work: Callable[[], T]) -> T:
    start = time.perf_counter()
    try:
        return work()
    finally:
        timings[stage] = 1e3 * (time.perf_counter() - start)
