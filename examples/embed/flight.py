"""A flight in your own program: `python examples/embed/flight.py`.

Frames come from anywhere as (time, picture, GNSS/INS fix); what may be used of each result goes to the
autopilot. Here the frames are rendered and the fix is the truth with errors, so that it runs anywhere:
put your camera and your receiver in the place of `frames`, and your autopilot's in that of `print`.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pymap3d

import shortfinal as sf
from shortfinal.demo import CAMERA, RUNWAY, SPEED_M_S, approach_pose, demo_scene, render_frame

# The landing threshold's centre (WGS84; degrees, degrees, metres above the ellipsoid) and the landing
# direction (degrees from true north). They set the runway frame; so take them from where the
# runway's corners come from.
THRESHOLD, HEADING_DEG = (43.0, 1.5, 150.0), 87.0
# What your operation tolerates, and how often, per frame and axis, an error may be beyond the level unseen.
# Four corners of this model bound a thousandth; at 1e-5 a single wrong corner must be bounded as well,
# and there is no level (docs/limits.md).
LIMITS, RISK = sf.AlertLimits(cross_m=5.0, vertical_m=5.0), 1e-3


class Fix(NamedTuple):
    """Of the camera, at the frame's time: lever arm and mounting angles taken out, interpolated."""

    latitude_deg: float
    longitude_deg: float
    height_m: float  # above the ellipsoid
    heading_deg: float  # true
    pitch_deg: float
    roll_deg: float


def pose_of(fix: Fix) -> sf.Pose:
    """In the runway frame: x along the landing direction, y left, z up."""
    east, north, up = pymap3d.geodetic2enu(fix.latitude_deg, fix.longitude_deg, fix.height_m, *THRESHOLD)
    sin, cos = np.sin(np.radians(HEADING_DEG)), np.cos(np.radians(HEADING_DEG))
    position = [east * sin + north * cos, north * sin - east * cos, up]
    return sf.Pose.from_attitude(position, fix.heading_deg - HEADING_DEG, fix.pitch_deg, fix.roll_deg)


def frames() -> Iterator[tuple[float, np.ndarray, Fix]]:
    """Time in seconds, picture (height, width, 3; RGB, uint8), fix; the demo's, 260 m before the threshold and on."""
    scene, rng = demo_scene(), np.random.default_rng(1)
    for number in range(91, 98):
        pose = approach_pose(number)
        x, y, z = pose.position_m + rng.normal(0, [5.0, 5.0, 8.0])  # single-frequency GNSS
        yaw, pitch, roll = np.array(pose.attitude) + rng.normal(0, 0.3, 3)
        sin, cos = np.sin(np.radians(HEADING_DEG)), np.cos(np.radians(HEADING_DEG))
        place = pymap3d.enu2geodetic(x * sin - y * cos, x * cos + y * sin, z, *THRESHOLD)
        time_s = (pose.position_m[0] + 3000.0) / SPEED_M_S
        yield time_s, render_frame(scene, number), Fix(*map(float, place), yaw + HEADING_DEG, pitch, roll)


def obstacle(result: sf.FrameResult) -> str:
    """Why a result must not be used; nothing if it may: checked, followed, and exact enough."""
    if result.verdict.decision is not sf.Decision.USE:
        return result.verdict.reasons[0]
    if result.track.state is not sf.TrackState.TRACKING or not result.track.taken:
        return result.track.reason
    return "; ".join(result.protection.available(LIMITS).reasons)


def main() -> None:
    tracker = sf.Tracker()
    detector = sf.KeypointDetector(shares_cores=True)
    pipeline = sf.LandingPipeline(detector, RUNWAY, CAMERA, tracker=tracker, integrity_risk=RISK)
    for time_s, picture, fix in frames():
        # The fix says where to look, until there is a track. It is no measurement: the verdict stays independent.
        prior = pose_of(fix) if tracker.predict(time_s) is None else None
        result = pipeline.step(picture, time_s, prior=prior)
        words = obstacle(result)
        if not words:
            # The levels are of the frame's own pose. The track's, result.track.pose, is smoother; nothing bounds it.
            (x, y, z), levels = result.estimate.pose.position_m, result.protection
            words = f"{-x:.0f} m to go, {y:+.1f} ± {levels.cross_m:.1f} m, {z:.1f} ± {levels.vertical_m:.1f} m"
        print(f"{time_s:.2f} s, {result.verdict.decision.value}, {result.track.state.value}: {words}")


if __name__ == "__main__":
    main()
