"""One look against two: errors and sigma of near and far corners, full-resolution frames nearer than 1.5 km.

    python benchmarks/two_looks.py [--frames 150] [--seed 77] [--model MODEL]

Frames are of LARD's camera (examples/lard.toml), rendered around the runway at the camera's own
resolution. The first look is the crop that holds the whole runway; the second, one for each end.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import shortfinal as sf
from shortfinal.calibration import coverage
from shortfinal.crops import box_around, centre_crop
from shortfinal.data.dataset import plan_shot
from shortfinal.geometry import project
from shortfinal.scene.render import render
from shortfinal.stream.source import read_camera

NEAR_M = 1500.0
_ROOM = 1.0  # around the runway, in lengths of its box's longer side

Array = NDArray[np.float64]


def frame(seed: int, index: int, camera: sf.Camera) -> tuple[NDArray[np.uint8], sf.Camera, Array, sf.Runway] | None:
    """The part of a random frame around the runway, its camera, the corners (4, 2) and the runway; None if too far."""
    shot = plan_shot(seed, index, camera)
    if float(np.linalg.norm(shot.pose.position_m)) > NEAR_M:
        return None
    box = box_around(project(camera, shot.pose, shot.runway.corners))
    room = _ROOM * float((box[2:] - box[:2]).max())
    left, top = (int(max(0, np.floor(v))) for v in box[:2] - room)
    right, bottom = np.minimum(np.ceil(box[2:] + room), [camera.width, camera.height]).astype(int).tolist()
    view = camera.view(sf.PixelWindow(left, top, right - left, bottom - top, right - left, bottom - top))
    picture = render(shot.scene, view, shot.pose, shot.sensor, samples=3, seed=shot.noise_seed)
    return picture, view, project(view, shot.pose, shot.runway.corners), shot.runway


def measure(model: Path | None, frames: int, seed: int) -> tuple[Array, Array]:
    """Errors and sigmas (N, 2, 4, 2), px of the frame: first look, then with the second."""
    camera = read_camera(Path(__file__).parent.parent / "examples" / "lard.toml")
    detector = sf.KeypointDetector(model)
    errors, sigmas = [], []
    index = 0
    while len(errors) < frames:
        made, index = frame(seed, index, camera), index + 1
        if made is None:
            continue
        picture, view, corners, runway = made
        first = detector.detect(picture, centre_crop(box_around(corners), detector.info.margin, detector.info.size))
        second = sf.LandingPipeline(detector, runway, view).step(picture, box=box_around(corners)).keypoints or first
        errors.append([first.mean_px - corners, second.mean_px - corners])
        sigmas.append([first.sigma_px, second.sigma_px])
    return np.array(errors), np.array(sigmas)


def table(errors: Array, sigmas: Array) -> str:
    """Markdown: medians and 90 % of |error|, median sigma, coverage; and what the second look divides them by."""
    lines = [
        "| corners | looks | error, median | 90 % | sigma, median | within 68 % | 95 % |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, part in (("near", slice(0, 2)), ("far", slice(2, 4))):
        for looks in (0, 1):
            e, s = np.abs(errors[:, looks, part]), sigmas[:, looks, part]
            inside = coverage(errors[:, looks, part], s, (0.68, 0.95))
            lines.append(
                f"| {name} | {looks + 1} | {np.median(e):.2f} px | {np.quantile(e, 0.9):.2f} px | "
                f"{np.median(s):.2f} px | {100 * inside[0]:.0f} % | {100 * inside[1]:.0f} % |"
            )
        e, s = np.abs(errors[:, :, part]), sigmas[:, :, part]
        (first, second), (first_90, second_90) = (np.quantile(e, q, axis=(0, 2, 3)) for q in (0.5, 0.9))
        sigma = np.median(s, axis=(0, 2, 3))
        lines.append(
            f"| {name} | ratio | {first / second:.2f} | {first_90 / second_90:.2f} | {sigma[0] / sigma[1]:.2f} | | |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--seed", type=int, default=77)
    parser.add_argument("--model", type=Path)
    arguments = parser.parse_args()
    print(table(*measure(arguments.model, arguments.frames, arguments.seed)))
