"""The network at run time: an image and a crop in, Gaussian keypoints out. ONNX Runtime, no torch.

The only preprocessing code of the package: training uses `crop_image` and `normalise` from here.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from shortfinal.calibration import Calibration
from shortfinal.crops import PATCH_PX, corner_patches
from shortfinal.errors import InputError
from shortfinal.geometry import PixelWindow, frozen
from shortfinal.keypoints import CORNER_NAMES, GaussianKeypoints

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Ints = NDArray[np.int_]

METADATA_KEY = "shortfinal"
FORMAT = 2
OUTPUTS = ("mean_px", "cov_px", "visible", "present")
# The output of a model that can search, (2, H, W): probability and longer side of a runway's box, px. Made only on
# request, an optional input: a look at a crop does not pay for it.
WHERE, SEARCH = "where", "search"
# The outputs of a model that looks at each corner by itself, made on request from patches (N, 4, 3, P, P): both inputs
# are optional.
CORNER_OUTPUTS, PATCHES, SHARPEN = ("corner_px", "corner_cov_px", "corner_visible"), "patches", "sharpen"
CORNER_LOOKS = 2  # at each corner, at the most: the second from where the first put it,
STILL_PX, FINER = 4.0, 1.1  # if that moves a patch by more of its pixels, or makes one finer by more than this factor
MAGNIFIED = 3.0  # a corner is looked at by itself where a look magnifies the image by less: else it shows no more
VISIBLE = 0.5  # probability from which on a corner counts as seen
SPOT = 0.25  # probability of a cell from which on it may hold the centre of a runway
COVARIANCES = ("diagonal", "keypoint", "full")
Precision = Literal["fp32", "fp16", "int8"]


@dataclass(frozen=True)
class ModelInfo:
    """What a model file says of itself, as JSON in the ONNX metadata."""

    format: int  # version of this description
    size: int  # side of the square input, px
    mean: tuple[float, float, float]  # subtracted from RGB / 255
    std: tuple[float, float, float]  # then divided by
    keypoints: tuple[str, ...]  # names, in order; the four corners first
    covariance: str  # what is predicted of it: the "diagonal", the blocks of each "keypoint", or the "full" matrix
    margin: float  # the crop it works best with: side of the crop over longer side of the runway's box
    backbone: str
    precision: Precision  # of the backbone's arithmetic
    training: dict[str, Any]  # data, steps, seed
    figures: dict[str, float]  # errors (px of the input) and coverage on the held-out scenes
    calibration: Calibration | None  # how the network's sigma is mended; None: not at all

    @classmethod
    def from_json(cls, text: str, source: str) -> ModelInfo:
        """Parse and check. Raises InputError naming the field that is missing or of another format."""
        try:
            content = json.loads(text)
        except ValueError as error:
            raise InputError(f"{source}: its shortfinal description is not JSON; export it again") from error
        missing = (
            [f.name for f in fields(cls) if f.name not in content] if isinstance(content, dict) else ["all fields"]
        )
        if missing:
            raise InputError(f"{source}: its shortfinal description lacks {', '.join(missing)}; export it again")
        if content["format"] != FORMAT:
            raise InputError(f"{source}: description format {content['format']}; this version reads {FORMAT}")
        values = {f.name: content[f.name] for f in fields(cls)}
        for name in ("mean", "std", "keypoints"):
            values[name] = tuple(values[name]) if isinstance(values[name], list) else ()
        if values["calibration"] is not None:
            try:
                values["calibration"] = Calibration.from_plain(values["calibration"])
            except InputError as error:
                raise InputError(f"{source}: {error}; calibrate it again") from error
        info = cls(**values)
        wrong = info.first_wrong_field()
        if wrong:
            raise InputError(f"{source}: its description has a {wrong} of no use ({getattr(info, wrong)!r:.40})")
        return info

    def first_wrong_field(self) -> str:
        """The name of the first field whose value cannot be used, or nothing."""
        checks = {
            "size": type(self.size) is int and 16 <= self.size <= 4096,
            "mean": len(self.mean) == 3 and all(_is_number(v) for v in self.mean),
            "std": len(self.std) == 3 and all(_is_number(v) and v > 0 for v in self.std),
            "keypoints": self.keypoints[:4] == CORNER_NAMES and all(isinstance(name, str) for name in self.keypoints),
            "covariance": self.covariance in COVARIANCES,
            "margin": _is_number(self.margin) and 1 <= self.margin <= 10,
            "backbone": isinstance(self.backbone, str),
            "precision": self.precision in get_args(Precision),
            "training": isinstance(self.training, dict),
            "figures": isinstance(self.figures, dict) and all(map(_is_number, self.figures.values())),
            "calibration": self.calibration is None or len(self.calibration.sigma_scale) == 2 * len(self.keypoints),
        }
        return next((name for name, fine in checks.items() if not fine), "")

    def to_json(self) -> str:
        """The text `from_json` reads."""
        calibration = self.calibration and self.calibration.to_plain()
        return json.dumps({**asdict(replace(self, calibration=None)), "calibration": calibration})


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


@dataclass(frozen=True, eq=False)
class Look:
    """What the network says of one window of an image."""

    window: PixelWindow
    keypoints: GaussianKeypoints  # in the image's pixels
    visible: Array  # (K,) probability that the keypoint is in the window
    present: float  # probability that a runway is


class Spot(NamedTuple):
    """Where in an image a runway may be."""

    probability: float
    centre_px: tuple[float, float]  # of the runway's box, u and v
    side_px: float  # of the box, the longer one

    @property
    def box(self) -> Array:
        """A square box (4,) around it: left, top, right, bottom."""
        half, centre = self.side_px / 2, np.array(self.centre_px)
        return np.concatenate([centre - half, centre + half])

    def overlaps(self, other: Spot) -> bool:
        """Whether both are of one place: their centres within half the larger box of one another."""
        return math.dist(self.centre_px, other.centre_px) < max(self.side_px, other.side_px) / 2


class KeypointDetector:
    """A model file, loaded. `look` turns an image and a window of it into keypoints in the image's pixels."""

    def __init__(
        self, path: str | Path | None = None, threads: int = 0, calibrated: bool = True, shares_cores: bool = False
    ) -> None:
        """Load `path`, or the model that ships with the package. `threads`: 0 for all cores.

        `shares_cores`: other work runs on the same cores, as a camera's decoding does in flight. Threads
        then sleep while they wait, so that this work does not wait for them; where there is none, a look
        takes a quarter longer for it. What is seen is the same.

        Sigmas are mended as the file's calibration says, if it has one; not `calibrated`, they are as
        the network gives them. Raises InputError if the file is missing, is no ONNX model, or does not
        describe itself.
        """
        self._session, self.info, self.sha256 = _load(path, threads, shares_cores)  # of the file as it was loaded
        self.calibration = self.info.calibration if calibrated else None
        scale = self.calibration.sigma_scale if self.calibration else ()
        self._gain = np.outer(scale, scale) if scale else None  # of the covariance: D C D, D diagonal
        self._outputs = {output.name for output in self._session.get_outputs()}

    def detect(self, image: Image, window: PixelWindow) -> GaussianKeypoints:
        """The keypoints of `look`."""
        return self.look(image, window).keypoints

    def look(self, image: Image, window: PixelWindow) -> Look:
        """What the network sees within `window` of `image` (h, w, 3; RGB, uint8).

        The window must have the model's input size. Raises InputError for another image type or
        window, and when the network's answer is not a Gaussian (non-finite).
        """
        (answer,) = zip(*self._run(image, [window], OUTPUTS), strict=True)
        return self._look(window, *answer)

    @property
    def searches(self) -> bool:
        """Whether the model says where runways are (`spots`)."""
        return WHERE in self._outputs

    def spots(self, image: Image, windows: Sequence[PixelWindow]) -> list[Spot]:
        """Where in several windows of an image there may be runways, of any size; likeliest first. One call of the
        network. The same runway may be seen in several windows.

        Raises InputError as `look`, and for a model that cannot search.
        """
        if not self.searches:
            raise InputError("the model does not say where runways are: train it with learn = where, or pass a box")
        found: list[Spot] = []
        for window, (share, side) in zip(windows, *self._run(image, windows, (WHERE,)), strict=True):
            if not (np.isfinite(share).all() and np.isfinite(side).all()):
                raise InputError("the model's answer where runways are is not finite")
            found += _spots(window, share, side)
        return sorted(found, reverse=True)

    @property
    def sharpens(self) -> bool:
        """Whether the model looks at each corner by itself (`sharpened`)."""
        return CORNER_OUTPUTS[0] in self._outputs

    def sharpened(self, image: Image, keypoints: GaussianKeypoints, looks: int = CORNER_LOOKS) -> GaussianKeypoints:
        """Keypoints with their corners looked at again, each in a patch of its own at the image's resolution
        (`crops.corner_patches`), at most so many times: again only if that shows more. One that is not seen there
        stays as it is. What this says of the corners stands in place of what was known, and is independent of the
        keypoints beyond them.

        Raises InputError as `look`, and for a model that does not look at corners.
        """
        check_image(image)
        if not self.sharpens:
            raise InputError("the model does not look at corners by themselves: train it with learn = corners")
        info, known = self.info, keypoints
        pixels = np.empty((1, 4, 3, PATCH_PX, PATCH_PX), np.float32)
        nothing = np.empty((0, 3, info.size, info.size), np.float32)
        before = None
        for _ in range(looks):
            maps = corner_patches(known.mean_px[:4], known.sigma_px[:4])
            if before is not None and _shows_no_more(maps, before):
                break
            before = maps
            for corner, image_from_patch in enumerate(maps):
                patch = warp_image(image, image_from_patch, (PATCH_PX, PATCH_PX))
                normalise(patch, info.mean, info.std, out=pixels[0, corner])
            inputs = {"image": nothing, PATCHES: pixels, SHARPEN: np.array(True)}
            (mean,), (cov,), (visible,) = self._answers(CORNER_OUTPUTS, inputs)
            # From the patches to the image.
            axes, blocks = maps[:, :, :2], cov.astype(np.float64).reshape(4, 2, 4, 2)
            mean = np.einsum("kij,kj->ki", axes, mean.astype(np.float64)) + maps[:, :, 2]
            cov = self._mended(np.einsum("kij,kjml,mnl->kimn", axes, blocks, axes).reshape(8, 8))
            known = known.replaced(np.flatnonzero(visible >= VISIBLE), GaussianKeypoints(mean, cov))
        return known

    def _run(self, image: Image, windows: Sequence[PixelWindow], outputs: Sequence[str]) -> list[Any]:
        """Those outputs of the network (B, ...) for several windows of an image."""
        check_image(image)
        info = self.info
        batch = np.empty((len(windows), 3, info.size, info.size), np.float32)
        for pixels, window in zip(batch, windows, strict=True):
            if (window.out_width, window.out_height) != (info.size, info.size):
                raise InputError(
                    f"window: {window.out_width} x {window.out_height}; the model takes {info.size} x {info.size}"
                )
            normalise(crop_image(image, window), info.mean, info.std, out=pixels)
        if not windows:
            return [[] for _ in outputs]
        return self._answers(outputs, {"image": batch} | ({SEARCH: np.array(True)} if WHERE in outputs else {}))

    def _answers(self, outputs: Sequence[str], inputs: dict[str, Any]) -> list[Any]:
        try:
            answers: list[Any] = self._session.run(outputs, inputs)
        except Exception as error:  # ONNX Runtime has no common base class for what it raises
            raise InputError(f"the model failed: {str(error).splitlines()[0][:120]}") from error
        return answers

    def _look(self, window: PixelWindow, mean: Any, cov: Any, visible: Any, present: Any) -> Look:
        """One answer, float32, in the image's pixels."""
        probabilities = np.append(visible, present).astype(np.float64)
        if not ((probabilities >= 0) & (probabilities <= 1)).all():
            raise InputError(f"the model answers {probabilities.tolist()} where probabilities are expected")
        cov = self._mended(cov.astype(np.float64))
        keypoints = GaussianKeypoints(window.inverse(mean), window.inverse_cov(cov))
        return Look(window, keypoints, frozen(probabilities[:-1]), float(present))

    def _mended(self, cov: Array) -> Array:
        """The network's covariance of its first keypoints (n, n), symmetric, as the calibration says."""
        cov = (cov + cov.T) / 2  # equal but for the rounding of float32
        return cov if self._gain is None else cov * self._gain[: len(cov), : len(cov)]


def refined(detector: KeypointDetector, image: Image, look: Look) -> GaussianKeypoints:
    """The keypoints of a look at an image, with the corners `sharpened` if the model knows how and that shows more."""
    sharper = detector.sharpens and look.window.scale[0] < MAGNIFIED
    return detector.sharpened(image, look.keypoints) if sharper else look.keypoints


def _shows_no_more(maps: Array, before: Array) -> bool:
    """Whether patches (4, 2, 3), of `crops.corner_patches`, lie where those `before` did, none of them finer."""
    size, smaller = (np.linalg.norm(each[:, :, 0], axis=1) for each in (before, maps))  # of a patch's pixel
    moved = np.linalg.norm((maps - before) @ [(PATCH_PX - 1) / 2, (PATCH_PX - 1) / 2, 1.0], axis=1) / size
    return bool((moved <= STILL_PX).all() and (size <= FINER * smaller).all())


def _spots(window: PixelWindow, share: Any, side: Any) -> list[Spot]:
    """The peaks of one window's answer (H, W), in the image's pixels."""
    peaks = (share >= SPOT) & (share == cv2.dilate(share, np.ones((3, 3), np.uint8)))
    rows, columns = share.shape
    found = []
    for row, column in np.argwhere(peaks):
        near = np.s_[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        weight = share[near].astype(np.float64)
        # The cell alone would leave it half a cell off.
        v, u = ((n[near] * weight).sum() / weight.sum() + 0.5 for n in np.indices(share.shape, float))
        cell = np.array([window.out_width / columns, window.out_height / rows])
        u, v = (float(n) for n in window.inverse(np.array([u, v]) * cell - 0.5))
        found.append(Spot(float(share[row, column]), (u, v), float(side[row, column] / window.scale[0])))
    return found


def check_image(image: Image) -> None:
    """Raises InputError unless `image` is (h, w, 3), uint8, and not empty."""
    if not (isinstance(image, np.ndarray) and image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8):
        shape = getattr(image, "shape", type(image).__name__)
        raise InputError(f"image: expected (height, width, 3) uint8 RGB, got {shape} {getattr(image, 'dtype', '')}")
    if image.size == 0:
        raise InputError(f"image: empty, {image.shape}")


def crop_image(image: Image, window: PixelWindow) -> Image:
    """The window's pixels (out_height, out_width, 3); black beyond the image's border.

    Shrinking by two or more averages whole blocks first, so nothing aliases; then bilinear.
    """
    sx, sy = window.scale
    # Output pixel to source pixel: PixelWindow.inverse, as a matrix.
    image_from_crop = np.array([[1 / sx, 0, 0.5 / sx + window.left - 0.5], [0, 1 / sy, 0.5 / sy + window.top - 0.5]])
    return warp_image(image, image_from_crop, (window.out_width, window.out_height))


def warp_image(
    image: Image, image_from_crop: NDArray[np.float64], out_size: tuple[int, int], border: int = cv2.BORDER_CONSTANT
) -> Image:
    """The picture (height, width, 3) whose pixel (u, v) is the image's at `image_from_crop` (2, 3) @ (u, v, 1).

    `out_size` is (width, height). Where that shrinks the image k-fold or more, blocks of k are averaged
    first, counted from the first whole pixel of the region that is needed: a window of whole pixels
    and scale 1/k gets the mean of its blocks, exactly. `border`: OpenCV's, black if not given.
    """
    width, height = out_size
    matrix = np.array(image_from_crop, float)
    # 1e-6: rounding in the matrix must not move a whole pixel, nor lose a whole factor.
    shrink = np.maximum(1, np.floor(np.linalg.norm(matrix[:, :2], axis=1) + 1e-6)).astype(int)
    if shrink.max() > 1:
        outline = np.array([[-0.5, width - 0.5, -0.5, width - 0.5], [-0.5, -0.5, height - 0.5, height - 0.5], [1] * 4])
        edges = matrix @ outline + 0.5
        origin = np.floor(edges.min(axis=1) + 1e-6).astype(int)
        needed = np.ceil((edges.max(axis=1) - origin) / shrink - 1e-6).astype(int)
        image, first = _block_means(image, origin, needed, shrink, border)
        matrix[:, 2] += 0.5 - (origin + first * shrink)
        matrix = matrix / shrink[:, None]
        matrix[:, 2] -= 0.5
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(image, matrix, out_size, flags=flags, borderMode=border), np.uint8)


def _block_means(image: Image, origin: Ints, needed: Ints, shrink: Ints, border: int) -> tuple[Image, Ints]:
    """Means of blocks of `shrink` pixels (x, y), the `needed` blocks from `origin` on as far as the image reaches.

    Beside them, the number of the first block. Blocks across the border count what `border` puts beyond it.
    """
    size = np.array([image.shape[1], image.shape[0]])
    first = np.maximum(0, -origin // shrink)
    last = np.minimum(needed, -((origin - size) // shrink))
    if (last <= first).any():
        return np.zeros((1, 1, 3), np.uint8), first + 10 * needed  # out of sight
    start, end = origin + first * shrink, origin + last * shrink
    inside = image[max(0, start[1]) : end[1], max(0, start[0]) : end[0]]
    (left, top), (right, bottom) = np.maximum(0, -start), np.maximum(0, end - size)
    if max(left, top, right, bottom) > 0:
        inside = np.asarray(cv2.copyMakeBorder(inside, top, bottom, left, right, border), np.uint8)
    columns, rows = (int(n) for n in last - first)
    return np.asarray(cv2.resize(inside, (columns, rows), interpolation=cv2.INTER_AREA), np.uint8), first


def normalise(
    crop: Image, mean: tuple[float, ...], std: tuple[float, ...], out: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """RGB (h, w, 3) uint8 to the network's input (3, h, w): (RGB / 255 - mean) / std; into `out` if given."""
    if out is None:
        out = np.empty((3, *crop.shape[:2]), np.float32)
    for plane, channel, centre, spread in zip(out, crop.transpose(2, 0, 1), mean, std, strict=True):
        np.divide(channel, 255, out=plane, dtype=np.float32)
        plane -= centre
        plane /= spread
    return out


def shipped_model() -> Path:
    """The model file inside the package."""
    return Path(str(files("shortfinal") / "models" / "runway.onnx"))


def _load(path: str | Path | None, threads: int, shares_cores: bool) -> tuple[Any, ModelInfo, str]:
    import onnxruntime

    source = Path(path) if path is not None else shipped_model()
    if not source.is_file():
        raise InputError(f"{source}: no such model file")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    if shares_cores:
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    try:
        content = source.read_bytes()
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime has no common base class for what a broken file raises
        raise InputError(f"{source}: not an ONNX model: {str(error).splitlines()[0][:120]}") from error
    text = session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
    if text is None:
        raise InputError(
            f"{source}: an ONNX model, but not one of ours: no {METADATA_KEY!r} metadata; see `shortfinal export`"
        )
    info = ModelInfo.from_json(text, str(source))
    shape = tuple(session.get_inputs()[0].shape[1:])
    k = len(info.keypoints)
    outputs = {out.name: tuple(out.shape[1:]) for out in session.get_outputs()}
    wanted = dict(zip(OUTPUTS, ((k, 2), (2 * k, 2 * k), (k,), ()), strict=True))
    on_request = {given.name for given in session.get_overridable_initializers()}
    fits = all(outputs.get(name) == wanted[name] for name in OUTPUTS) and (WHERE in outputs) == (SEARCH in on_request)
    if CORNER_OUTPUTS[0] in outputs:
        sizes = [outputs.get(name) for name in CORNER_OUTPUTS]
        fits = fits and sizes == [(4, 2), (8, 8), (4,)] and {PATCHES, SHARPEN} <= on_request
    if shape != (3, info.size, info.size) or not fits:
        given = ", ".join(f"{name} {sizes}" for name, sizes in outputs.items())
        raise InputError(f"{source}: it takes {shape} and gives {given}, unlike its description; export it again")
    return session, info, hashlib.sha256(content).hexdigest()


def described(model: bytes, info: ModelInfo) -> bytes:
    """An ONNX file's content with `info` as its description, in place of any it has. Needs the package onnx."""
    try:
        import onnx
    except ModuleNotFoundError as error:
        raise InputError("writing a model file needs onnx: pip install onnx") from error
    content = onnx.load_from_string(model)
    del content.metadata_props[:]
    content.metadata_props.add(key=METADATA_KEY, value=info.to_json())
    return bytes(content.SerializeToString())
