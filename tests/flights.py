"""Results of frames as the pipeline gives them, from a pose that is known; and tracks, as the tracker gives them."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np

import shortfinal as sf
from shortfinal.integrity import Decision, IntegrityVerdict
from shortfinal.pipeline import FrameResult
from shortfinal.tracker import Track, TrackState

CAMERA = sf.Camera(1280, 720, 1200.0, 1200.0, 639.5, 359.5)
RUNWAY = sf.Runway(1500.0, 45.0, "XXXX/24")
POSE = sf.Pose.from_attitude([-1200.0, 30.0, 70.0], yaw_deg=4.0, pitch_deg=-3.0, roll_deg=7.0)
VELOCITY = np.array([62.0, -1.5, -3.2])


def covariance(seed=0):
    """A full covariance (9, 9) of a track, metres, radians and metres per second."""
    rng = np.random.default_rng(seed)
    scale = np.array([8.0, 1.0, 0.8, 0.004, 0.003, 0.006, 0.5, 0.2, 0.1])
    mixed = np.eye(9) + 0.4 * rng.standard_normal((9, 9))
    return (mixed @ mixed.T) * np.outer(scale, scale)


def track(timestamp_s=0.0, state=TrackState.TRACKING, pose=POSE, taken=True, reason="measurement taken in (p = 0.4)"):
    if state in (TrackState.SEARCHING, TrackState.LOST):
        return Track(timestamp_s, state, reason, None, None, None, False, None, 0.0)
    return Track(timestamp_s, state, reason, pose, VELOCITY, covariance(), taken, 0.4, 0.0)


def result(timestamp_s=0.0, decision=Decision.USE, pose=POSE, track=None):
    """Of keypoints without error; with a far corner 20 px aside for DO_NOT_USE; without any for NOT_MONITORED."""
    if decision is Decision.NOT_MONITORED:
        verdict = IntegrityVerdict(decision, ("no runway in view (its probability is 0.03)",), 0, 1e-3)
        return FrameResult(timestamp_s, None, None, None, verdict, timings={"detect_ms": 4.25}, track=track)
    px = sf.project(CAMERA, pose, RUNWAY.corners)
    if decision is Decision.DO_NOT_USE:
        px[2] += [20.0, 0.0]
    keypoints = sf.GaussianKeypoints.from_sigma(px, 0.5)
    estimate = sf.estimate_pose(keypoints, RUNWAY.corners, CAMERA)
    verdict = sf.check_integrity(estimate)
    assert verdict.decision is decision
    levels = sf.protection_levels(estimate, integrity_risk=1e-3, fault_prior=1e-4, false_alarm_rate=1e-3)
    window = sf.PixelWindow(500.0, 300.0, 224.0, 224.0, 224, 224)
    timings = {"detect_ms": 4.25, "solve_ms": 0.125}
    return FrameResult(timestamp_s, window, keypoints, estimate, verdict, levels, timings, 0.98, track=track)


def picture():
    """A frame with something in it: smooth, so that JPEG keeps it."""
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    return np.stack([rows * 255 // 720, columns * 255 // 1280, (rows + columns) * 255 // 2000], axis=2).astype(np.uint8)


def survivor(imports, opening, path, frames):
    """Write frames into `sink` in another process, kill it without warning after `frames`; how many it had written."""
    program = f"""
import dataclasses, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from flights import CAMERA, RUNWAY, picture, result, track
{imports}
{opening}
frame, image = result(track=track()), picture()
for number in range(10**6):
    sink.write(number, dataclasses.replace(frame, timestamp_s=number / 30), image)
    print(number, flush=True)
"""
    with subprocess.Popen([sys.executable, "-c", program, str(path)], stdout=subprocess.PIPE, text=True) as child:
        done = 0
        for line in child.stdout:
            done = int(line) + 1
            if done == frames:
                break
        child.kill()
    assert child.returncode == -signal.SIGKILL
    return done
