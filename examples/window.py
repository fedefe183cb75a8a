"""Doubt a flight, not a frame: `python examples/window.py`.

The map has a runway of 1,500 m; the one in the images is 184 m shorter. No frame shows it by itself.
"""

import numpy as np

import shortfinal as sf
from shortfinal.window import IntegrityWindow, RelativeMotion

camera = sf.Camera(width=2448, height=2648, fx=3401.6, fy=3401.6, cx=1223.5, cy=1323.5)
runway, in_the_images = sf.Runway(1500.0, 45.0), sf.Runway(1500.0 - 184.0, 45.0)
rng = np.random.default_rng(4)

# One frame a second at 70 m/s down a 3° glide path, seen with a sigma of 0.8 px; and odometry, good
# to 0.1 m and 0.05° a second. Its covariance is of (x, y, z, rotation about x, y, z).
sigma_px, sigma_step = 0.8, np.array([0.1, 0.1, 0.1, *np.radians([0.05, 0.05, 0.05])])
truth = [sf.Pose.from_attitude([-d, 5.0, d * np.tan(np.radians(3))], pitch_deg=-3.0) for d in range(4000, 1500, -70)]

window = IntegrityWindow(length=20, false_alarm_rate=1e-4)
before, alone = None, 0
for pose in truth:
    seen = sf.project(camera, pose, in_the_images.corners) + rng.normal(0, sigma_px, (4, 2))
    estimate = sf.estimate_pose(sf.GaussianKeypoints.from_sigma(seen, sigma_px), runway.corners, camera)
    motion = None
    if before is not None:
        step = RelativeMotion.between(before, pose, np.diag(sigma_step**2))
        noisy = sf.Pose(step.translation_m, step.earlier_from_later).plus(sigma_step * rng.normal(size=6))
        motion = RelativeMotion(noisy.position_m, noisy.runway_from_camera, step.cov)
    before = pose
    verdict = window.push(estimate, motion)
    alone += sf.check_integrity(estimate, 1e-4).decision.name == "DO_NOT_USE"
    if verdict.decision.name == "DO_NOT_USE":
        break

print(f"{-pose.position_m[0]:.0f} m before the threshold: {verdict.decision.name}")
for reason in verdict.reasons:
    print(f"  {reason}")
print(f"  frames refused by themselves so far: {alone}")
