"""Close-ups of what was predicted: from the surest to the least sure, then the refused and the misleading."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from shortfinal.crops import box_around, centre_crop
from shortfinal.detector import crop_image
from shortfinal.errors import InputError
from shortfinal.evaluate.faults import PAPER_M
from shortfinal.evaluate.rows import AXES, DO_NOT_USE, Rows
from shortfinal.geometry import Camera, PixelWindow, project
from shortfinal.integrity import FALSE_ALARM_RATE, Decision, check_integrity
from shortfinal.keypoints import GaussianKeypoints
from shortfinal.pose import estimate_pose
from shortfinal.runway import Runway
from shortfinal.stream.overlay import COLOURS, WORDS, draw_keypoints, draw_outline, draw_truth, framed

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_SIZE = 320  # px of a close-up
# Colours in full resolution: lines are a pixel wide. Some 20 kB.
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 80, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
_EXTREMES = 2  # refused examples, and misleading ones
_MARGIN = 1.5  # side of a close-up over the runway's longer side


@dataclass(frozen=True)
class ExamplePicture:
    """One row's prediction over its picture."""

    row: int
    title: str
    jpeg: bytes  # (320, 320) RGB


def example_pictures(rows: Rows, open_picture: Callable[[int], Image | None], count: int = 12) -> list[ExamplePicture]:
    """`count` rows from the surest to the least sure, evenly over the quantiles of sigma; then the refused whose
    p-value is the lowest, then the accepted whose error exceeds its protection level the most.

    `open_picture` gives the picture (h, w, 3; RGB) of a row, or None where it cannot be had: then the row is
    left out. The outline is the prediction, in the decision's colour; ellipses are 2σ, crosses the truth.
    """
    examples = []
    for row, why in _chosen(rows, count):
        picture = open_picture(row)
        if picture is not None:
            tile = _close_up(rows, row, picture)
            examples.append(ExamplePicture(row, _title(rows, row, why), as_jpeg(tile)))
    return examples


def as_jpeg(picture: Image) -> bytes:
    """An RGB picture, some 20 kB for one of (320, 320, 3)."""
    return bytes(cv2.imencode(".jpg", picture[..., ::-1], _JPEG)[1])


def rejection_example(
    picture: Image,
    keypoints: GaussianKeypoints,
    runway: Runway,
    camera: Camera,
    *,
    nearer_m: float = PAPER_M,
    false_alarm_rate: float = FALSE_ALARM_RATE,
    size: int = 360,
) -> Image | None:
    """The same keypoints (4 corners) held against the runway as it is, at the left, and at the right against one whose
    far threshold is believed `nearer_m` farther away than it is; below them the far end, magnified:
    (2 size, 2 size, 3), RGB.

    The outline is the runway as it is believed, projected from the estimate, in the decision's colour; ellipses
    are the keypoints' 2σ. None unless the first is accepted and the second refused: it would be no example.
    """
    windows = [centre_crop(box_around(px), _MARGIN, size) for px in (keypoints.mean_px, keypoints.mean_px[2:])]
    columns = []
    beliefs = ((0.0, "as it is", Decision.USE), (nearer_m, f"believed {nearer_m:g} m longer", Decision.DO_NOT_USE))
    for ahead, belief, wanted in beliefs:
        corners = runway.corners + np.array([[0], [0], [1], [1]]) * [ahead, 0.0, 0.0]
        estimate = estimate_pose(keypoints, corners, camera)
        verdict = check_integrity(estimate, false_alarm_rate)
        if verdict.decision is not wanted or estimate.pose is None:
            return None
        projected, colour = project(camera, estimate.pose, corners), COLOURS[wanted]
        titles = (f"{belief}: {WORDS[wanted]}, p = {verdict.p_value:.2g}", "the far end")
        tiles = []
        for window, title in zip(windows, titles, strict=True):
            tile = crop_image(picture, window)
            draw_keypoints(tile, keypoints, window, None)
            draw_outline(tile, projected, window, colour)
            tiles.append(framed(tile, title, colour))
        columns.append(np.vstack(tiles))
    return np.hstack(columns)


def _chosen(rows: Rows, count: int) -> Iterator[tuple[int, str]]:
    """Rows, and what they are examples of."""
    known = np.flatnonzero(rows.predicted & np.isfinite(rows.cov_px).all(axis=(1, 2)))
    order = known[np.argsort(_sigma(rows, known), kind="stable")]
    places = np.unique(np.linspace(0, len(order) - 1, min(count, len(order))).round().astype(int))
    for place in places:
        yield int(order[place]), ""
    p = rows.p_value[known]
    refused = known[(rows.decision[known] == DO_NOT_USE) & np.isfinite(p)]
    for row in refused[np.argsort(rows.p_value[refused], kind="stable")][:_EXTREMES]:
        yield int(row), f"refused, p = {rows.p_value[row]:.1g}"
    with np.errstate(divide="ignore", invalid="ignore"):  # a level of zero
        beyond = np.abs(rows.error_m[known]) / rows.level_m[known]
    beyond = np.where(np.isfinite(rows.level_m[known]) & rows.accepted[known, None], beyond, 0.0)
    beyond = np.nan_to_num(beyond, nan=0.0, posinf=np.inf)
    worst = np.argsort(-beyond.max(axis=1), kind="stable")[:_EXTREMES]
    for place in worst[beyond[worst].max(axis=1) > 1]:
        row, axis = int(known[place]), int(beyond[place].argmax())
        error, level = abs(rows.error_m[row, axis]), rows.level_m[row, axis]
        yield row, f"misleading, {AXES[axis]} error {_short(error)} m over its level of {_short(level)} m"


def _short(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.2g}"


def _sigma(rows: Rows, which: NDArray[np.int64]) -> Array:
    """(n,) one sigma a row, px: the root of the mean variance of its coordinates."""
    return np.asarray(np.sqrt(np.diagonal(rows.cov_px[which], axis1=1, axis2=2).mean(axis=1)))


def _title(rows: Rows, row: int, why: str) -> str:
    error = np.abs(rows.mean_px[row] - rows.truth_px[row]).mean()
    distance = rows.distance_m[row]
    parts = [
        str(rows.ident[row] or rows.picture[row]),
        f"{distance / 1000:.1f} km" if np.isfinite(distance) else "",
        f"σ {_sigma(rows, np.array([row]))[0]:.2g} px",
        f"mean error {error:.2g} px" if np.isfinite(error) else "",
        why or str(rows.decision[row]).replace("-", " "),
    ]
    return ", ".join(part for part in parts if part)


def _close_up(rows: Rows, row: int, picture: Image) -> Image:
    truth, decision = rows.truth_px[row], Decision(rows.decision[row])
    window = _window(truth, rows.mean_px[row])
    tile = crop_image(picture, window)
    try:
        keypoints = GaussianKeypoints(rows.mean_px[row], rows.cov_px[row])
        draw_keypoints(tile, keypoints, window, COLOURS[decision])
    except InputError:  # a covariance that has no ellipse
        draw_outline(tile, rows.mean_px[row], window, COLOURS[decision])
    if np.isfinite(truth).all():
        draw_truth(tile, truth, window)
    return framed(tile, WORDS[decision], COLOURS[decision])


def _window(truth: Array, mean: Array) -> PixelWindow:
    """Around the runway as labelled and as predicted; a prediction far astray does not shrink the runway to a dot."""
    if not np.isfinite(truth).all():
        return centre_crop(box_around(mean), _MARGIN, _SIZE)
    both = np.vstack([truth, mean])
    astray = np.ptp(both, axis=0).max() > 3 * np.ptp(truth, axis=0).max()
    return (
        centre_crop(box_around(truth), 2 * _MARGIN, _SIZE) if astray else centre_crop(box_around(both), _MARGIN, _SIZE)
    )
