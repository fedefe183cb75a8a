"""Solve and doubt keypoints of your own detector: `python examples/solve_and_doubt.py`.

Anything that gives four corners with a sigma or a covariance can be used so.
"""

import numpy as np

import shortfinal as sf

camera = sf.Camera(width=1920, height=1080, fx=1800.0, fy=1800.0, cx=959.5, cy=539.5)
runway = sf.Runway(length_m=2000.0, width_m=45.0, ident="XXXX/24")

# What a detector saw from 1.2 km, 80 m up: the corners (near-left, near-right, far-right, far-left),
# here those of a known pose with noise of the sigma that is claimed for them.
truth = sf.Pose.from_attitude([-1200.0, 15.0, 80.0], yaw_deg=1.0, pitch_deg=-3.0, roll_deg=2.0)
sigma_px = np.array([[0.6, 0.5], [0.6, 0.5], [0.4, 0.3], [0.4, 0.3]])
seen_px = sf.project(camera, truth, runway.corners) + np.random.default_rng(1).normal(0, sigma_px)


def report(title: str, corners_px: np.ndarray) -> sf.IntegrityVerdict:
    """Solve, doubt, print."""
    estimate = sf.estimate_pose(sf.GaussianKeypoints.from_sigma(corners_px, sigma_px), runway.corners, camera)
    verdict = sf.check_integrity(estimate, false_alarm_rate=1e-3)
    x, y, z = estimate.pose.position_m
    sx, sy, sz = 2 * estimate.sigma_position_m
    print(title)
    print(f"  {-x:.0f} ± {sx:.0f} m before the threshold, {y:+.1f} ± {sy:.1f} m left, {z:.1f} ± {sz:.1f} m high (2σ)")
    print(f"  {verdict.decision.name}: {verdict.reasons[0]}")
    levels = sf.protection_levels(estimate, integrity_risk=1e-5, fault_prior=1e-4)
    for reason in levels.available(sf.AlertLimits.lpv200()).reasons:
        print(f"  not available, {reason}")
    return verdict


report("as seen", seen_px)

slid = seen_px.copy()
slid[1] += [25.0, 0.0]  # the near-right corner taken for a taxiway's edge
report("one corner slid by 25 px", slid)
