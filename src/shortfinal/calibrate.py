"""A model's sigmas held against labelled pictures, and mended: the calibration that its file carries."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shortfinal.calibration import Calibration, fit_calibration
from shortfinal.crops import box_around, centre_crop
from shortfinal.data.augment import inside
from shortfinal.data.dataset import LabelledDataset, read_dataset
from shortfinal.data.labelled import Label, Picture
from shortfinal.detector import Image, KeypointDetector, ModelInfo, described, refined
from shortfinal.errors import InputError
from shortfinal.files import write_whole
from shortfinal.geometry import PixelWindow
from shortfinal.keypoints import GaussianKeypoints

Array = NDArray[np.float64]


def calibrate(
    model: str | Path,
    data: str | Path,
    out: str | Path,
    airports: Collection[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Calibration:
    """Fit a calibration to a data set of any format, and write the model with it to `out`, which may be `model`.

    Each runway is looked at as in use (`framed`). The errors of the keypoints in the picture count, in
    pixels of that crop, and the network's own sigmas, so that a calibration already there changes nothing.
    `airports`: only runways at these, or with these identifiers ("LFPO", "LFPO/24"). `progress` is told
    how many pictures are done, of how many. Raises InputError for a model or data of no use, an airport
    that is not there, or too few runways; nothing is written then.
    """
    detector = KeypointDetector(model, calibrated=False)
    runways = _chosen(read_dataset(data), {name.upper() for name in airports or ()}, str(data))
    errors, sigmas = [], []
    for done, (picture, labels) in enumerate(runways.items(), 1):
        for error, sigma in _errors(detector, picture, labels):
            errors.append(error)
            sigmas.append(sigma)
        if progress:
            progress(done, len(runways))
    n = 2 * len(detector.info.keypoints)
    where = f" at {', '.join(sorted(airports))}" if airports else ""
    fitted_on = f"{len(errors)} runways of {Path(data).resolve().name}{where}"
    try:
        calibration = fit_calibration(np.reshape(errors, (-1, n)), np.reshape(sigmas, (-1, n)), fitted_on)
    except InputError as error:
        raise InputError(f"{data}: {fitted_on}: {error}") from error
    write_whole(out, described(Path(model).read_bytes(), replace(detector.info, calibration=calibration)))
    return calibration


def _chosen(examples: LabelledDataset, wanted: Collection[str], source: str) -> dict[Picture, list[Label]]:
    """The pictures that show a runway, and which: all, or those wanted."""
    runways: dict[Picture, list[Label]] = {}
    seen, known = set(), set()
    for picture in dict.fromkeys(picture for picture, _ in examples.labels):
        for label in picture.labels:
            known.add(label.airport)
            names = {label.airport.upper(), label.ident.upper()} & set(wanted)
            seen |= names
            if names or not wanted:
                runways.setdefault(picture, []).append(label)
    missing = sorted(set(wanted) - seen)
    if missing:
        there = ", ".join(sorted(known - {""})[:12]) or "no airports named"
        raise InputError(f"{source}: no runway at {', '.join(missing)}; its labels have {there}")
    return runways


def _errors(detector: KeypointDetector, picture: Picture, labels: list[Label]) -> Iterator[tuple[Array, Array]]:
    """Error and sigma (2K,) of each runway of one picture, in pixels of the crop; NaN for what it does not show."""
    image = LabelledDataset([(picture, None)])[0].image
    height, width = image.shape[:2]
    to_image = picture.window(width, height)
    for label in labels:
        places = dict(zip(label.names, to_image.apply(label.keypoints_px), strict=True))
        truth = np.array([places.get(name, (np.nan, np.nan)) for name in detector.info.keypoints])
        truth[~inside(truth, width, height)] = np.nan
        window = framed(image, truth[:4], detector.info)
        if window is not None:
            yield _in_crop(window, refined(detector, image, detector.look(image, window)), truth)


def framed(image: Image, corners_px: Array, info: ModelInfo) -> PixelWindow | None:
    """Where a model looks at a runway of known corners (4, 2): around those in the image; None if less than two are."""
    height, width = image.shape[:2]
    seen = corners_px[inside(corners_px, width, height)]
    return centre_crop(box_around(seen), info.margin, info.size) if len(seen) >= 2 else None


def _in_crop(window: PixelWindow, found: GaussianKeypoints, truth: Array) -> tuple[Array, Array]:
    error = window.apply(found.mean_px) - window.apply(truth)
    return error.ravel(), (found.sigma_px * window.scale).ravel()
