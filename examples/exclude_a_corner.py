"""Name the point at fault and go on without it: `python examples/exclude_a_corner.py`.

Eight points leave freedom to tell which one contradicts the others; four corners do not.
"""

import numpy as np

import shortfinal as sf

camera = sf.Camera(width=1920, height=1080, fx=1800.0, fy=1800.0, cx=959.5, cy=539.5)
runway = sf.Runway(length_m=2000.0, width_m=45.0)
points = np.vstack([runway.corners, runway.aiming_point])  # (8, 3) m
names = ("near-left", "near-right", "far-right", "far-left", "aim 1", "aim 2", "aim 3", "aim 4")

truth = sf.Pose.from_attitude([-1000.0, 10.0, 60.0], yaw_deg=1.0, pitch_deg=-3.0)
seen_px = sf.project(camera, truth, points) + np.random.default_rng(1).normal(0, 0.4, (8, 2))
seen_px[2] += [6.0, 2.0]  # the far-right corner taken for a taxiway's edge


def report(title: str, count: int) -> None:
    """Solve with the first `count` points, and leave out what contradicts the rest."""
    keypoints = sf.GaussianKeypoints.from_sigma(seen_px[:count], 0.4)
    estimate = sf.estimate_pose(keypoints, points[:count], camera)
    found = sf.exclude_faults(estimate, names=names[:count])
    print(f"{title}: {found.verdict.decision.name}, excluded: {', '.join(found.excluded) or 'nothing'}")
    for reason in found.verdict.reasons:
        print(f"  {reason}")
    before, after = (abs(e.pose.position_m[0] - truth.position_m[0]) for e in (estimate, found.estimate))
    print(f"  error along the runway: {before:.1f} m with all points, {after:.1f} m as given back")


report("eight points", 8)
report("four corners", 4)
