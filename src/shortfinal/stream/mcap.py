"""A flight as an MCAP file that opens in Foxglove (https://mcap.dev/spec, https://docs.foxglove.dev/docs/sdk/schemas).

Messages are JSON. Those of Foxglove's own schemas carry its names and fields; `shortfinal.Result` is the
frame's record as in frames.jsonl. Frames, topics and units: docs/sinks.md.
"""

from __future__ import annotations

import base64
import json
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from shortfinal.errors import InputError
from shortfinal.geometry import BODY_FROM_CAMERA, Camera, PixelWindow, Pose
from shortfinal.pipeline import FrameResult
from shortfinal.runway import Runway
from shortfinal.stream.overlay import COLOURS, WORDS, ellipse

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

WIDEST = 960  # px of a picture that is kept; wider ones are reduced
QUALITY = 80  # of the JPEG, per cent
FLUSHED = 16  # frames after which what was written is put into the file: no more are lost to a kill

_LINE_LOOP = 2  # foxglove.PointsAnnotationType
_ELLIPSE = {"r": 1.0, "g": 0.93, "b": 0.43, "a": 1.0}
_CLEAR = {"r": 0.0, "g": 0.0, "b": 0.0, "a": 0.0}
_SHADE = _CLEAR | {"a": 0.6}


def _object(**fields: Any) -> dict[str, Any]:
    return {"type": "object", "properties": fields, "required": list(fields)}


def _numbers(count: int) -> dict[str, Any]:
    return {"type": "array", "items": _NUMBER, "minItems": count, "maxItems": count}


def _list(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


_NUMBER, _TEXT, _WHOLE = {"type": "number"}, {"type": "string"}, {"type": "integer", "minimum": 0}
_TIME = {
    "title": "time",
    **_object(sec=_WHOLE, nsec={"type": "integer", "minimum": 0, "maximum": 999_999_999}),
}
_POINT2 = _object(x=_NUMBER, y=_NUMBER)
_VECTOR3 = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_COLOUR = _object(r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)

# Foxglove's message types with all of their fields, but optional ones.
SCHEMAS: dict[str, dict[str, Any]] = {
    "foxglove.CompressedImage": _object(
        timestamp=_TIME, frame_id=_TEXT, data={"type": "string", "contentEncoding": "base64"}, format=_TEXT
    ),
    "foxglove.CameraCalibration": _object(
        timestamp=_TIME, frame_id=_TEXT, width=_WHOLE, height=_WHOLE, distortion_model=_TEXT,
        D=_list(_NUMBER), K=_numbers(9), R=_numbers(9), P=_numbers(12),
    ),
    "foxglove.ImageAnnotations": _object(
        circles=_list(
            _object(
                timestamp=_TIME, position=_POINT2, diameter=_NUMBER, thickness=_NUMBER, fill_color=_COLOUR,
                outline_color=_COLOUR,
            )
        ),
        points=_list(
            _object(
                timestamp=_TIME, type=_WHOLE, points=_list(_POINT2), outline_color=_COLOUR,
                outline_colors=_list(_COLOUR), fill_color=_COLOUR, thickness=_NUMBER,
            )
        ),
        texts=_list(
            _object(
                timestamp=_TIME, position=_POINT2, text=_TEXT, font_size=_NUMBER, text_color=_COLOUR,
                background_color=_COLOUR,
            )
        ),
    ),
    "foxglove.FrameTransform": _object(
        timestamp=_TIME, parent_frame_id=_TEXT, child_frame_id=_TEXT, translation=_VECTOR3, rotation=_QUATERNION
    ),
    "foxglove.PoseInFrame": _object(
        timestamp=_TIME, frame_id=_TEXT, pose=_object(position=_VECTOR3, orientation=_QUATERNION)
    ),
    # Further fields come and go with what was found: see FrameResult.to_dict.
    "shortfinal.Result": _object(
        frame=_WHOLE, timestamp_s=_NUMBER, decision=_TEXT, reasons=_list(_TEXT), track={"type": ["object", "null"]}
    ),
}  # fmt: skip

TOPICS: dict[str, str] = {
    "/camera/image": "foxglove.CompressedImage",
    "/camera/calibration": "foxglove.CameraCalibration",
    "/camera/annotations": "foxglove.ImageAnnotations",
    "/tf": "foxglove.FrameTransform",
    "/pose/frame": "foxglove.PoseInFrame",
    "/pose/track": "foxglove.PoseInFrame",
    "/result": "shortfinal.Result",
}


class McapSink:
    """Writes every frame, whatever its verdict. A kill leaves a file that can be read to half a second before it."""

    def __init__(self, path: str | Path, camera: Camera, runway: Runway) -> None:
        """Begin the file, in place of one that is there. Raises InputError if it cannot be written, or without mcap."""
        try:
            from mcap.writer import Writer
        except ModuleNotFoundError as error:
            raise InputError("MCAP needs the package mcap: pip install 'shortfinal[mcap]'") from error
        self.path = Path(path)
        self._window = reduced(camera)
        self._calibration = _calibration(camera.view(self._window))
        self._frames = 0
        try:
            self._file = self.path.open("wb")
        except OSError as error:
            raise _refusal(self.path, error) from error
        try:
            self._writer: Any = Writer(self._file)
            self._writer.start(library="shortfinal")
            self._writer.add_metadata("shortfinal", _about(camera, runway))
            self._channels = {}
            schemas = {
                name: self._writer.register_schema(name, "jsonschema", json.dumps({"title": name, **schema}).encode())
                for name, schema in SCHEMAS.items()
            }
            for topic, name in TOPICS.items():
                self._channels[topic] = self._writer.register_channel(topic, "json", schemas[name])
        except OSError as error:
            raise self._failure(error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        self.close()

    def write(self, frame: int, result: FrameResult, image: Image | None = None) -> None:
        """Append a frame; `image` (height, width, 3) RGB of the camera's size is reduced to `WIDEST`.

        Raises InputError for a time before zero, or if the file cannot be written (a full disk): it is
        closed then, with the frames that it has.
        """
        ns = round(1e9 * result.timestamp_s)
        if ns < 0:
            raise InputError(f"frame {frame}: timestamp_s is {result.timestamp_s}; MCAP knows no time before 0")
        if self._file.closed:
            raise InputError(f"{self.path}: frame {frame} comes after the file was closed, or could not be written")
        try:
            for topic, message in self._messages(frame, result, image, _stamp(ns)):
                data = json.dumps(message, allow_nan=False, separators=(",", ":")).encode()
                self._writer.add_message(self._channels[topic], ns, data, ns, frame)
            self._frames += 1
            if self._frames % FLUSHED == 0:
                self._writer.flush()
        except OSError as error:
            raise self._failure(error) from error

    def close(self) -> None:
        """Write the index. Raises InputError if it cannot be written; the frames can be read all the same."""
        if self._file.closed:
            return
        try:
            self._writer.finish()
            self._file.close()
        except OSError as error:
            raise self._failure(error) from error

    def _messages(
        self, frame: int, result: FrameResult, image: Image | None, stamp: dict[str, int]
    ) -> list[tuple[str, dict[str, Any]]]:
        track = result.track
        record = {"frame": frame, "track": None, **result.to_dict()}
        messages: list[tuple[str, dict[str, Any]]] = [("/result", record)]
        own = None if result.estimate is None else result.estimate.pose
        tracked = None if track is None else track.pose
        for topic, pose in (("/pose/frame", own), ("/pose/track", tracked)):
            if pose is not None:
                turn = pose.runway_from_camera @ BODY_FROM_CAMERA.T
                inside = {"position": _xyz(pose.position_m), "orientation": _quaternion(turn)}
                messages.append((topic, {"timestamp": stamp, "frame_id": "runway", "pose": inside}))
        place = tracked or own
        if place is not None:
            messages.append(("/tf", _transform(place, stamp)))
        if image is not None:
            header = {"timestamp": stamp, "frame_id": "camera"}
            data = base64.b64encode(jpeg(image, self._window)).decode()
            messages.append(("/camera/calibration", header | self._calibration))
            messages.append(("/camera/image", header | {"data": data, "format": "jpeg"}))
        annotations = {"circles": [], "points": self._lines(result, stamp), "texts": [_label(result, stamp)]}
        messages.append(("/camera/annotations", annotations))
        return messages

    def _lines(self, result: FrameResult, stamp: dict[str, int]) -> list[dict[str, Any]]:
        """The outline in the verdict's colour and the ellipses of 2 sigma; nothing, where nothing was found."""
        keypoints = result.keypoints
        if keypoints is None:
            return []
        lines = [(keypoints.mean_px[:4], _verdict_colour(result), 2.0)]
        lines += [
            (ellipse(mean, keypoints.block(k), 2.0, 24), _ELLIPSE, 1.0) for k, mean in enumerate(keypoints.mean_px)
        ]
        return [
            {
                "timestamp": stamp,
                "type": _LINE_LOOP,
                # Foxglove counts from the corner of the first pixel, not from its centre.
                "points": [{"x": round(x, 3), "y": round(y, 3)} for x, y in (self._window.apply(px) + 0.5).tolist()],
                "outline_color": colour,
                "outline_colors": [],
                "fill_color": _CLEAR,
                "thickness": thickness,
            }
            for px, colour, thickness in lines
        ]

    def _failure(self, error: OSError) -> InputError:
        """Let go of the file: after half a chunk nothing more of it could be read."""
        with suppress(OSError):  # what could not be written then cannot be now
            self._file.close()
        return _refusal(self.path, error)


def _refusal(path: Path, error: OSError) -> InputError:
    return InputError(f"{path}: cannot be written: {error.strerror}")


def reduced(camera: Camera) -> PixelWindow:
    """The whole of a camera's picture, at most `WIDEST` wide."""
    size = min(1.0, WIDEST / camera.width)
    width, height = max(1, round(camera.width * size)), max(1, round(camera.height * size))
    return PixelWindow.resize(camera.width, camera.height, width, height)


def jpeg(image: Image, window: PixelWindow) -> bytes:
    """A picture (h, w, 3) RGB, resized to the window's output, as a JPEG file."""
    size = (window.out_width, window.out_height)
    small = image if size == image.shape[1::-1] else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), (cv2.IMWRITE_JPEG_QUALITY, QUALITY))
    return data.tobytes()


def _stamp(ns: int) -> dict[str, int]:
    return dict(zip(("sec", "nsec"), divmod(ns, 10**9), strict=True))


def _xyz(values: Array) -> dict[str, float]:
    return dict(zip("xyz", values.tolist(), strict=True))


def _quaternion(matrix: Array) -> dict[str, float]:
    return dict(zip("xyzw", Rotation.from_matrix(matrix).as_quat(canonical=True).tolist(), strict=True))


def _verdict_colour(result: FrameResult) -> dict[str, float]:
    red, green, blue = COLOURS[result.verdict.decision]
    return {"r": red / 255, "g": green / 255, "b": blue / 255, "a": 1.0}


def _label(result: FrameResult, stamp: dict[str, int]) -> dict[str, Any]:
    """The verdict and its reasons, in the picture's corner."""
    return {
        "timestamp": stamp,
        "position": {"x": 8.0, "y": 20.0},
        "text": f"{WORDS[result.verdict.decision]}: {'; '.join(result.verdict.reasons)}",
        "font_size": 14.0,
        "text_color": _verdict_colour(result),
        "background_color": _SHADE,
    }


def _transform(pose: Pose, stamp: dict[str, int]) -> dict[str, Any]:
    return {
        "timestamp": stamp,
        "parent_frame_id": "runway",
        "child_frame_id": "camera",
        "translation": _xyz(pose.position_m),
        "rotation": _quaternion(pose.runway_from_camera),
    }


def _calibration(camera: Camera) -> dict[str, Any]:
    """OpenCV's coefficients under ROS's names; its pixels are ours: the first one's centre is (0, 0)."""
    rational = len(camera.distortion) > 5
    return {
        "width": camera.width,
        "height": camera.height,
        "distortion_model": "rational_polynomial" if rational else "plumb_bob",
        "D": (camera.distortion + (0.0,) * 5)[: 8 if rational else 5],
        "K": camera.matrix.ravel().tolist(),
        "R": np.eye(3).ravel().tolist(),
        "P": np.hstack([camera.matrix, np.zeros((3, 1))]).ravel().tolist(),
    }


def _about(camera: Camera, runway: Runway) -> dict[str, str]:
    """The camera and the runway, as the file's metadata: JSON as text."""
    return {
        "camera": json.dumps(_plain(camera, "width", "height", "fx", "fy", "cx", "cy", "distortion")),
        "runway": json.dumps(_plain(runway, "ident", "length_m", "width_m") | {"corners_m": runway.corners.tolist()}),
    }


def _plain(thing: object, *names: str) -> dict[str, ArrayLike]:
    return {name: getattr(thing, name) for name in names}
