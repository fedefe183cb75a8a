"""The kernels compiled ahead of use, side by side: once on a machine it takes most of a minute."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from shortfinal.geometry import Camera, Pose, project, project_jacobian
from shortfinal.keypoints import GaussianKeypoints
from shortfinal.pose import PoseEstimate, SolverStatus, estimate_pose
from shortfinal.runway import Runway

_CAMERA, _RUNWAY, _POSE = Camera(8, 8, 10, 10, 3.5, 3.5), Runway(1500, 45), Pose.from_attitude([-900, 0, 60])


def warm_up(*, levels: bool, scenes: bool) -> None:
    """Compile the solver, and on demand the protection levels and the renderer, unless it is done."""
    parts = [_solve, *([_protect] * levels), *([_render] * scenes)]
    if not any((Path(__file__).parent / "__pycache__").glob("pose._solve_kernel-*.nbi")):
        with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
            for done in [pool.submit(part) for part in parts]:
                done.result()
    for part in parts:
        part()


def _keypoints() -> GaussianKeypoints:
    return GaussianKeypoints.from_sigma(project(_CAMERA, _POSE, _RUNWAY.corners), 1.0)


def _solve() -> None:
    estimate_pose(_keypoints(), _RUNWAY.corners, _CAMERA)


def _protect() -> None:
    from shortfinal.protection import protection_levels

    jacobian = project_jacobian(_CAMERA, _POSE, _RUNWAY.corners)
    estimate = PoseEstimate(
        pose=_POSE,
        cov=np.asarray(np.linalg.inv(jacobian.T @ jacobian), np.float64),
        status=SolverStatus.CONVERGED,
        residual=np.zeros(8),
        jacobian=jacobian,
        chi2=0.0,
        iterations=0,
        sharp_rows=8,
        relative_sigma=0.0,
        keypoints=_keypoints(),
        points=_RUNWAY.corners,
        camera=_CAMERA,
    )
    protection_levels(estimate)


def _render() -> None:
    from shortfinal.scene.render import random_scene, render

    render(random_scene(np.random.default_rng(0), _RUNWAY), _CAMERA, _POSE)
