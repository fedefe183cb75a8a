"""A flight as a Rerun recording (.rrd; https://rerun.io): camera, runway and path in 3D, the picture, the figures."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from shortfinal.errors import InputError
from shortfinal.geometry import Camera
from shortfinal.integrity import Decision
from shortfinal.pipeline import FrameResult
from shortfinal.runway import Runway
from shortfinal.stream.mcap import FLUSHED, jpeg, reduced
from shortfinal.stream.overlay import COLOURS, ellipse

Image = NDArray[np.uint8]

_ELLIPSE = (255, 236, 110)
_PLANE_M = 60.0  # in front of the camera, where the picture is shown


class RerunSink:
    """Writes every frame, whatever its verdict; colours tell them apart. A kill loses half a second."""

    def __init__(self, path: str | Path, camera: Camera, runway: Runway) -> None:
        """Begin the file, in place of what is there. Raises InputError if it cannot be written, or without rerun."""
        try:
            import rerun
        except ModuleNotFoundError as error:
            raise InputError("Rerun needs the package rerun-sdk: pip install 'shortfinal[rerun]'") from error
        self._rerun: Any = rerun
        self._frames = 0
        self._window = reduced(camera)
        try:
            Path(path).open("wb").close()  # Rerun's own message runs over several lines
            self._recording: Any = rerun.RecordingStream("shortfinal")
            self._recording.save(path)
        except (OSError, RuntimeError) as error:
            raise InputError(f"{path}: cannot be written: {getattr(error, 'strerror', None) or error}") from error
        self._begin(camera, runway)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        self.close()

    def write(self, frame: int, result: FrameResult, image: Image | None = None) -> None:
        """Append a frame; `image` (height, width, 3) RGB of the camera's size is reduced."""
        rr, track = self._rerun, result.track
        self._recording.set_time("time", duration=np.timedelta64(round(1e9 * result.timestamp_s), "ns"))
        self._recording.set_time("frame", sequence=frame)
        colour = COLOURS[result.verdict.decision]
        own = None if result.estimate is None else result.estimate.pose
        pose = own if track is None or track.pose is None else track.pose
        if pose is not None:
            self._log("camera", rr.Transform3D(translation=pose.position_m, mat3x3=pose.runway_from_camera))
        if own is not None:
            self._log("path/frame", rr.Points3D([own.position_m], colors=[colour], radii=-2.0))
        if track is not None and track.pose is not None:
            self._log("path/track", rr.Points3D([track.pose.position_m], colors=[(90, 170, 255)], radii=-2.0))
        if image is not None:
            picture = rr.EncodedImage(contents=jpeg(image, self._window), media_type="image/jpeg")
            self._log("camera/image", picture)
        self._draw(result, colour)
        words = f"{result.verdict.decision.value}: {'; '.join(result.verdict.reasons)}"
        if track is not None:
            words += f" | {track.state.value}: {track.reason}"
        level = "INFO" if result.verdict.decision is Decision.USE else "WARN"
        self._log("verdict", rr.TextLog(words, level=level, color=colour))
        for name, value in _scalars(result, pose).items():
            self._log(name, rr.Scalars([value]))
        self._frames += 1
        if self._frames % FLUSHED == 0:
            self._recording.flush()

    def close(self) -> None:
        """Write what is still to be written."""
        self._recording.flush()
        self._recording.disconnect()

    def _begin(self, camera: Camera, runway: Runway) -> None:
        rr, blueprint = self._rerun, self._rerun.blueprint
        seen = camera.view(self._window)
        self._log("", rr.ViewCoordinates.FLU, static=True)
        outline = np.vstack([runway.corners, runway.corners[:1]])
        self._log("runway", rr.LineStrips3D([outline], colors=[(230, 230, 230)], labels=[runway.ident]), static=True)
        pinhole = rr.Pinhole(
            # Rerun counts from the corner of the first pixel, not from its centre.
            focal_length=[seen.fx, seen.fy], principal_point=[seen.cx + 0.5, seen.cy + 0.5],
            width=seen.width, height=seen.height, camera_xyz=rr.ViewCoordinates.RDF, image_plane_distance=_PLANE_M,
        )  # fmt: skip
        self._log("camera/image", pinhole, static=True)
        ever = rr.VisibleTimeRange(
            "time", start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.cursor_relative()
        )
        paths = {name: blueprint.VisibleTimeRanges([ever]) for name in ("path/frame", "path/track")}
        figures = blueprint.Vertical(
            *(blueprint.TimeSeriesView(origin=name, name=name) for name in ("p_value", "level", "position")),
            blueprint.TextLogView(origin="verdict"),
        )
        views = blueprint.Vertical(
            blueprint.Spatial2DView(origin="camera/image", name="camera"),
            blueprint.Spatial3DView(origin="/", name="runway", overrides=paths),
        )
        self._recording.send_blueprint(blueprint.Blueprint(blueprint.Horizontal(views, figures), collapse_panels=True))

    def _draw(self, result: FrameResult, colour: tuple[int, int, int]) -> None:
        """The outline and the ellipses of 2 sigma; those of the frame before are cleared where there are none."""
        rr, keypoints = self._rerun, result.keypoints
        if keypoints is None:
            self._log("camera/image/keypoints", rr.Clear(recursive=True))
            return
        means = self._window.apply(keypoints.mean_px) + 0.5
        loops = [
            self._window.apply(ellipse(mean, keypoints.block(k), 2.0, 25)) + 0.5
            for k, mean in enumerate(keypoints.mean_px)
        ]
        self._log("camera/image/keypoints", rr.Points2D(means, colors=[_ELLIPSE], radii=-1.5))
        closed = [np.vstack([loop, loop[:1]]) for loop in loops]
        self._log("camera/image/keypoints/ellipses", rr.LineStrips2D(closed, colors=[_ELLIPSE]))
        outline = [np.vstack([means[:4], means[:1]])]
        self._log("camera/image/keypoints/outline", rr.LineStrips2D(outline, colors=[colour]))

    def _log(self, name: str, what: Any, static: bool = False) -> None:
        self._recording.log(name or "/", what, static=static)


def _scalars(result: FrameResult, pose: Any) -> dict[str, float]:
    values: dict[str, float] = {}
    if result.verdict.p_value is not None:
        values["p_value"] = result.verdict.p_value
    if result.protection is not None:
        levels = result.protection.levels
        named = {
            f"level/{name}": level for name, level in zip(("along_m", "cross_m", "vertical_m"), levels, strict=False)
        }
        values |= {name: float(level) for name, level in named.items() if np.isfinite(level)}
    if pose is not None:
        values |= {f"position/{axis}_m": float(value) for axis, value in zip("xyz", pose.position_m, strict=True)}
    return values
