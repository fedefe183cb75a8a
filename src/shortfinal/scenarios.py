"""Faults as scenarios: each put into a rendered flight, flown for real, and what came of it.

The flight is drawn once (`render_approach`): a picture a second, and between them the exact
homography of the runway's plane, with fresh noise. A fault is on from `BEGIN_S` to `END_S`, or for the
whole flight where that is its nature. docs/faults.md has what each showed. Beside `demo.py` and not in
`stream/`, since it draws scenes: what flies must not depend on what draws.
"""

from __future__ import annotations

import json
import math
import re
import shutil
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import Enum
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from shortfinal.crops import box_around
from shortfinal.demo import RUNWAY, demo_scene
from shortfinal.detector import CORNER_LOOKS, KeypointDetector, Look, Spot, shipped_model
from shortfinal.files import sha256_of
from shortfinal.geometry import Camera, PixelWindow, Pose, project
from shortfinal.integrity import Decision
from shortfinal.keypoints import GaussianKeypoints
from shortfinal.pipeline import FrameResult, LandingPipeline
from shortfinal.runway import Runway
from shortfinal.scene.render import render, seen_from
from shortfinal.scene.sensor import Sensor, expose
from shortfinal.stream.fly import BUDGET_MS, flight_record, fly
from shortfinal.stream.frames import LiveSource, TimedFrame
from shortfinal.stream.sink import Log, Sink
from shortfinal.tracker import Tracker, TrackState

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

CAMERA = Camera(640, 480, 3400.0, 3400.0, 319.5, 239.5)
RATE_HZ, FRAMES = 10.0, 46
BEGIN_S, END_S = 1.2, 2.8
START_M, SPEED_M_S = 1400.0, 70.0
INTEGRITY_RISK = 1e-5  # at the default, 1e-7, most levels are infinite here, and cover whatever happens

_BLOCK = 10  # frames from one drawn picture
_BORDER = 40  # pixels that it is larger to each side


class Fault(Enum):
    """What goes wrong; the issue's list."""

    FROZEN = "frozen frame"
    BLACK = "black"
    WHITE = "white"
    BLUR = "blur"
    CORRUPTED = "half-corrupted frame"
    OCCLUDED = "lens occluded"
    RESOLUTION = "resolution change"
    TIME_BACK = "timestamp jumps back"
    TIME_STALLS = "timestamp stalls"
    CAMERA_GONE = "camera gone and back"
    WRONG_RUNWAY = "wrong runway loaded"
    WRONG_FOCAL = "wrong focal length by 3 %"
    MIRRORED = "mirrored image"
    RUNWAY_CHANGED = "runway changed in flight"
    MODEL_REPLACED = "model file replaced"
    DISK_FULL = "disk full"
    PEER_GONE = "sink's peer gone"
    FAR_THRESHOLD = "far threshold misplaced by 184 m"
    TAXIWAY_CORNER = "one corner locked on a taxiway"


WHOLE_FLIGHT = (Fault.WRONG_RUNWAY, Fault.WRONG_FOCAL, Fault.FAR_THRESHOLD)  # loaded so, from the start

RISES: dict[Fault, str] = {  # what must be said of a frame, as a regular expression; of the others docs/faults.md
    Fault.FROZEN: "the same picture",
    Fault.BLACK: "nothing to see",
    Fault.WHITE: "nothing to see",
    Fault.CORRUPTED: "does not settle|no runway in view|do not fit",
    Fault.OCCLUDED: "measurement refused|do not fit|does not settle",
    Fault.RESOLUTION: "320 x 240 pixels",
    Fault.TIME_BACK: "is not after",
    Fault.TIME_STALLS: "is not after",
    Fault.CAMERA_GONE: "no frame for",
    Fault.WRONG_RUNWAY: "do not fit",
    Fault.WRONG_FOCAL: "do not fit",
    Fault.FAR_THRESHOLD: "do not fit",
    Fault.MIRRORED: "measurement refused",
    Fault.RUNWAY_CHANGED: "the runway was changed",
    Fault.TAXIWAY_CORNER: "do not fit",
}

OTHER_RUNWAY = Runway(2400.0, 60.0, "DEMO/12")
LONGER_RUNWAY = Runway(RUNWAY.length_m + 184.0, RUNWAY.width_m, RUNWAY.ident)
_LOADED: dict[Fault | None, Runway] = {Fault.WRONG_RUNWAY: OTHER_RUNWAY, Fault.FAR_THRESHOLD: LONGER_RUNWAY}
_TAXIWAY_EDGE_M = (-1.0, -52.0, 0.0)  # where the scene's taxiway meets the threshold's line


@dataclass(frozen=True, eq=False)
class Approach:
    """A flight as it was: when, from where, and what the camera took."""

    times_s: Array  # (N,)
    poses: list[Pose]
    images: list[Image]  # of CAMERA

    @property
    def box(self) -> Array:
        """Around the runway in the first frame (4,): left, top, right, bottom, px."""
        return box_around(project(CAMERA, self.poses[0], RUNWAY.corners))


def approach_pose(time_s: float) -> Pose:
    """Down the glide path, offset to the left, with a little wander."""
    x = -START_M + SPEED_M_S * time_s
    sway, heave = math.sin(1.6 * time_s + 0.4), math.sin(2.1 * time_s + 1.0)
    z = (305.0 - x) * math.tan(math.radians(3.0)) + heave
    return Pose.from_attitude([x, 8.0 + 2.0 * sway, z], 0.8 + 0.4 * sway, -2.6 + 0.3 * heave, 2.0 + 2.0 * sway)


def render_approach() -> Approach:
    """The flight, drawn: five pictures, and 46 frames from them."""
    scene = demo_scene()
    window = PixelWindow(
        -_BORDER, -_BORDER, CAMERA.width + 2 * _BORDER, CAMERA.height + 2 * _BORDER,
        CAMERA.width + 2 * _BORDER, CAMERA.height + 2 * _BORDER,
    )  # fmt: skip
    wide = CAMERA.view(window)
    times = np.arange(FRAMES) / RATE_HZ
    poses = [approach_pose(float(t)) for t in times]
    images: list[Image] = []
    for first in range(0, FRAMES, _BLOCK):
        # From the nearest pose of the block: the frames before it only shrink it, and stay sharp.
        last = min(first + _BLOCK, FRAMES) - 1
        drawn = render(scene, wide, poses[last], Sensor(blur_px=0.4), samples=2)
        for n in range(first, last + 1):
            light = seen_from(drawn, wide, poses[last], CAMERA, poses[n]).astype(np.float32)
            images.append(expose(light, Sensor(noise=2.0, jpeg_quality=92), np.random.default_rng(n)))
    return Approach(times, poses, images)


@dataclass(frozen=True, eq=False)
class Moment:
    """A result, and what was true. Of a result without a frame there is no truth."""

    time_s: float  # true time of the flight
    truth: Pose | None
    result: FrameResult

    @property
    def accepted(self) -> bool:
        """Whether it goes to an autopilot: USE, by a track that is TRACKING and took it in."""
        track = self.result.track
        return (
            self.result.verdict.decision is Decision.USE
            and track is not None
            and track.state is TrackState.TRACKING
            and track.taken
        )

    @property
    def words(self) -> str:
        """All reasons given."""
        track = self.result.track
        return "; ".join([*self.result.verdict.reasons, *([track.reason] if track is not None else [])])

    @property
    def levels(self) -> Array:
        """Protection levels (3,): along, cross, vertical, m; infinite where there are none."""
        levels = self.result.protection
        return np.full(3, np.inf) if levels is None else np.array(levels.levels[:3])

    def errors_m(self) -> list[Array]:
        """Of the frame's position and of the track's, where there is one, each (3,): along, cross, vertical."""
        poses = [each.pose for each in (self.result.estimate, self.result.track) if each is not None]
        truth = self.truth
        return [np.abs(p.position_m - truth.position_m) for p in poses if p is not None and truth is not None]

    def beyond(self) -> float:
        """The larger of both errors over the protection level, on the worst axis. Of an accepted frame."""
        return max(float((error / self.levels).max()) for error in self.errors_m())


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of a flight with a fault."""

    fault: Fault | None
    begin_s: float
    end_s: float
    moments: list[Moment]
    notes: tuple[str, ...] = ()  # of the flight
    facts: dict[str, Any] = field(default_factory=dict)  # of a fault of the process: what was looked at afterwards

    @property
    def during(self) -> list[Moment]:
        """While the fault was on."""
        return [m for m in self.moments if self.begin_s <= m.time_s < self.end_s]

    @property
    def accepted(self) -> list[Moment]:
        """Of those, what was."""
        return [m for m in self.during if m.accepted]

    @property
    def worst(self) -> float | None:
        """Largest error over protection level of what was accepted meanwhile, of the frame's pose and of the track's;
        None: nothing was.
        """
        return max((m.beyond() for m in self.accepted), default=None)

    @property
    def unbounded(self) -> int:
        """Of what was accepted meanwhile, frames with a level that is infinite: no claim, and none is available."""
        return sum(not np.isfinite(m.levels).all() for m in self.accepted)

    @property
    def largest_error_m(self) -> Array | None:
        """Of what was accepted meanwhile (3,): along, cross, vertical, m; None: nothing was."""
        errors = [error for m in self.accepted for error in m.errors_m()]
        return np.max(errors, axis=0) if errors else None

    def rose_after_s(self, words: str) -> float | None:
        """How long after the fault's begin a frame that was not accepted first said so; None: never."""
        said = [m.time_s for m in self.during if not m.accepted and re.search(words, m.words)]
        return said[0] - self.begin_s if said else None

    @property
    def recovered_after_s(self) -> float | None:
        """How long after the fault's end a frame was accepted again; None: never, or it does not end."""
        good = [m.time_s for m in self.moments if m.time_s >= self.end_s and m.accepted]
        return good[0] - self.end_s if good else None


def fly_with(fault: Fault | None, approach: Approach, folder: Path) -> Outcome:
    """The approach, flown with a fault, or without any (None); its log goes into `folder`.

    Raises InputError where MAVLink is needed (PEER_GONE) and not installed.
    """
    if fault is Fault.CAMERA_GONE:
        return _fly_live(approach, folder)
    model = Path(shutil.copy(shipped_model(), folder / "model.onnx")) if fault is Fault.MODEL_REPLACED else None
    detector = KeypointDetector(model)
    locked = _Locked(detector, approach)
    pipeline = LandingPipeline(
        cast(KeypointDetector, locked) if fault is Fault.TAXIWAY_CORNER else detector,
        _LOADED.get(fault, RUNWAY),
        replace(CAMERA, fx=1.03 * CAMERA.fx, fy=1.03 * CAMERA.fy) if fault is Fault.WRONG_FOCAL else CAMERA,
        tracker=Tracker(),
        integrity_risk=INTEGRITY_RISK,
    )
    keeper = _Keeper(approach)
    sinks: list[Sink] = [keeper, _log(folder, pipeline)]
    trouble = _trouble(fault, folder, pipeline, sinks)

    def before(n: int) -> None:
        """What happens before a frame is looked at."""
        locked.frame = n
        if n == _frame_at(BEGIN_S):
            trouble.begin()
        if n == _frame_at(END_S):
            trouble.end()

    source = _Replay(approach, fault)
    flown = fly(source, pipeline, sinks, progress=lambda number, _: before(number + 1))
    begin, end = (0.0, math.inf) if fault in WHOLE_FLIGHT else (BEGIN_S, END_S)
    if fault is Fault.TIME_BACK:  # from one frame to the next; the clock then runs on
        end = begin + 1.0 / RATE_HZ
    return Outcome(fault, begin, end, keeper.moments, flown.notes, trouble.facts())


def _log(folder: Path, pipeline: LandingPipeline) -> Log:
    model = {"name": shipped_model().name, "sha256": pipeline.detector.sha256}
    return Log(folder, flight_record("scenario", pipeline, model, None, BUDGET_MS), every=0)


def _frame_at(time_s: float) -> int:
    return round(time_s * RATE_HZ)


class _Keeper:
    """A sink that keeps results beside the truth."""

    def __init__(self, approach: Approach) -> None:
        self.approach = approach
        self.moments: list[Moment] = []

    def write(self, frame: int, result: FrameResult, image: Image | None = None) -> None:
        pose = None if image is None else self.approach.poses[frame]
        self.moments.append(Moment(float(self.approach.times_s[frame]), pose, result))

    def close(self) -> None:
        pass


class _Replay:
    """The approach as a source, with what a fault does to pictures and times."""

    live = False

    def __init__(self, approach: Approach, fault: Fault | None) -> None:
        self.approach, self.fault = approach, fault

    def __iter__(self) -> Iterator[TimedFrame]:
        first, last = _frame_at(BEGIN_S), _frame_at(END_S)
        for n, at in enumerate(self.approach.times_s):
            image, told = self.approach.images[n], float(at)
            if first <= n < last:
                image = _spoiled(self.fault, self.approach, n)
                told = self.approach.times_s[first - 1] if self.fault is Fault.TIME_STALLS else told
            if n >= first and self.fault is Fault.TIME_BACK:
                told -= 1.0
            yield TimedFrame(n, float(told), image)


def _spoiled(fault: Fault | None, approach: Approach, n: int) -> Image:
    """The picture of a frame, as the fault leaves it."""
    image, first = approach.images[n], _frame_at(BEGIN_S)
    if fault is Fault.FROZEN:
        return approach.images[first - 1]
    if fault in (Fault.BLACK, Fault.WHITE):
        return np.full_like(image, 0 if fault is Fault.BLACK else 255)
    if fault is Fault.BLUR:
        return np.asarray(cv2.GaussianBlur(image, (0, 0), 8.0), np.uint8)
    if fault is Fault.CORRUPTED:
        return _shuffled(image, _middle_row(approach.poses[n]), np.random.default_rng(n))
    if fault is Fault.OCCLUDED:
        return _smeared(image, project(CAMERA, approach.poses[first], RUNWAY.corners)[1])
    if fault is Fault.RESOLUTION:
        return np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
    return np.ascontiguousarray(image[:, ::-1]) if fault is Fault.MIRRORED else image


def _middle_row(pose: Pose) -> int:
    return int(project(CAMERA, pose, RUNWAY.corners)[:, 1].mean())


def _shuffled(image: Image, top: int, rng: np.random.Generator) -> Image:
    """Below a row, blocks of 16 pixels out of place, as of a stream that lost a packet."""
    spoiled = image.copy()
    rows, columns = (image.shape[0] - top) // 16, image.shape[1] // 16
    part = spoiled[top : top + 16 * rows, : 16 * columns].reshape(rows, 16, columns, 16, 3)
    blocks = part.transpose(0, 2, 1, 3, 4).reshape(-1, 16, 16, 3)
    mixed = blocks[rng.permutation(len(blocks))].reshape(rows, columns, 16, 16, 3).transpose(0, 2, 1, 3, 4)
    spoiled[top : top + 16 * rows, : 16 * columns] = mixed.reshape(16 * rows, 16 * columns, 3)
    return spoiled


def _smeared(image: Image, centre: Array) -> Image:
    """A dark drop on the lens, out of focus, 60 px wide at half its depth."""
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    depth = 1.0 / (1.0 + np.exp((np.hypot(u - centre[0], v - centre[1]) - 30.0) / 3.0))
    return np.asarray(image * (1.0 - 0.9 * depth[..., None]), np.uint8)


class _Locked:
    """A detector whose near-right corner sticks to the taxiway's edge, by as much as that lies aside."""

    def __init__(self, detector: KeypointDetector, approach: Approach) -> None:
        self._detector, self._approach = detector, approach
        self.info, self.calibration, self.sha256 = detector.info, detector.calibration, detector.sha256
        self.searches, self.sharpens = detector.searches, detector.sharpens
        self.frame = 0

    def spots(self, image: Image, windows: Sequence[PixelWindow]) -> list[Spot]:
        return self._detector.spots(image, windows)

    def look(self, image: Image, window: PixelWindow) -> Look:
        look = self._detector.look(image, window)
        return replace(look, keypoints=_moved(look.keypoints, self._shift))

    def sharpened(self, image: Image, keypoints: GaussianKeypoints, looks: int = CORNER_LOOKS) -> GaussianKeypoints:
        true = self._detector.sharpened(image, _moved(keypoints, -self._shift), looks)
        return _moved(true, self._shift)

    @property
    def _shift(self) -> Array:
        """By how much it is off in this frame (4, 2), px."""
        shift = np.zeros((len(RUNWAY.corners), 2))
        if _frame_at(BEGIN_S) <= self.frame < _frame_at(END_S):
            here, there = project(CAMERA, self._approach.poses[self.frame], [RUNWAY.corners[1], _TAXIWAY_EDGE_M])
            shift[1] = there - here
        return shift


def _moved(keypoints: GaussianKeypoints, shift_px: Array) -> GaussianKeypoints:
    return GaussianKeypoints(keypoints.mean_px + shift_px, keypoints.cov_px)


class _Trouble:
    """A fault of the process: how it begins and ends, and what to look at afterwards."""

    def begin(self) -> None:
        """Now."""

    def end(self) -> None:
        """And over."""

    def facts(self) -> dict[str, Any]:
        """What is known after the flight."""
        return {}


def _trouble(fault: Fault | None, folder: Path, pipeline: LandingPipeline, sinks: list[Sink]) -> _Trouble:
    if fault is Fault.RUNWAY_CHANGED:
        return _OtherRunway(pipeline)
    if fault is Fault.MODEL_REPLACED:
        return _OtherModel(folder)
    if fault is Fault.DISK_FULL:
        return _FullDisk(folder)
    return _LostPeer(sinks) if fault is Fault.PEER_GONE else _Trouble()


class _OtherRunway(_Trouble):
    """The pipeline is told to land on a runway that is not in view, and told back."""

    def __init__(self, pipeline: LandingPipeline) -> None:
        self.pipeline = pipeline

    def begin(self) -> None:
        self.pipeline.land_on(OTHER_RUNWAY)

    def end(self) -> None:
        self.pipeline.land_on(RUNWAY)


class _OtherModel(_Trouble):
    """The model's file is overwritten, in place."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def begin(self) -> None:
        (self.folder / "model.onnx").write_bytes(b"no model")

    def facts(self) -> dict[str, Any]:
        flight = json.loads((self.folder / "flight.json").read_text())
        return {"flown": flight["model"]["sha256"], "shipped": sha256_of([shipped_model()])}


class _FullDisk(_Trouble):
    """No file may grow beyond the middle of the next line: the line is cut off there, as on a disk that is full."""

    def __init__(self, folder: Path) -> None:
        import resource

        self.lines = folder / "frames.jsonl"
        self._resource, self._limits = resource, resource.getrlimit(resource.RLIMIT_FSIZE)

    def begin(self) -> None:
        limit = self.lines.stat().st_size + 150
        self._resource.setrlimit(self._resource.RLIMIT_FSIZE, (limit, self._limits[1]))

    def end(self) -> None:
        self._resource.setrlimit(self._resource.RLIMIT_FSIZE, self._limits)

    def facts(self) -> dict[str, Any]:
        """Frames of the whole lines, and how many lines are none."""
        numbers, broken = [], 0
        for line in self.lines.read_bytes().splitlines():
            try:
                numbers.append(json.loads(line)["frame"])
            except ValueError:
                broken += 1
        return {"written": numbers, "broken": broken}


class _LostPeer(_Trouble):
    """An autopilot that stops listening, and listens again on the same port."""

    def __init__(self, sinks: list[Sink]) -> None:
        from shortfinal.stream.mavlink import MavlinkSink

        self._listen(0)
        self.port = self._socket.getsockname()[1]
        self.sink = MavlinkSink(f"udpout:127.0.0.1:{self.port}")
        self.packets: list[bytes] = []
        sinks.append(self.sink)

    def _listen(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self._socket.setblocking(False)

    def begin(self) -> None:
        with suppress(BlockingIOError):
            while True:
                self.packets.append(self._socket.recv(4096))
        self._socket.close()

    def end(self) -> None:
        self._listen(self.port)

    def facts(self) -> dict[str, Any]:
        """Times of the poses that the peer decoded, s; how many messages found nobody, and the words for it."""
        from pymavlink.dialects.v20 import common

        self.begin()
        decoder = common.MAVLink(None)
        messages = [message for packet in self.packets for message in decoder.parse_buffer(packet) or []]
        poses = [m.time_usec * 1e-6 for m in messages if m.get_type() == "ODOMETRY"]
        return {"poses_s": poses, "errors": self.sink.errors, "note": self.sink.note}


def _fly_live(approach: Approach, folder: Path) -> Outcome:
    """The approach in real time from a stream that goes away and comes back."""
    pipeline = LandingPipeline(KeypointDetector(), RUNWAY, CAMERA, tracker=Tracker(), integrity_risk=INTEGRITY_RISK)
    with _Station(approach) as station:
        source = LiveSource(station.address)
        keeper = _LiveKeeper(approach, station)

        def stop(number: int, result: FrameResult) -> None:
            station.begin()
            if station.clock_s() > approach.times_s[-1]:
                source.stop()

        flown = fly(source, pipeline, [keeper, _log(folder, pipeline)], box=approach.box.tolist(), progress=stop)
    return Outcome(Fault.CAMERA_GONE, BEGIN_S, END_S, keeper.moments, flown.notes)


_BITS, _BIT_PX = 7, 16  # a frame's number is painted into its corner


class _Station:
    """A camera on the network: the approach as MJPEG over HTTP, in real time. While it is gone it answers nobody."""

    def __init__(self, approach: Approach) -> None:
        self._jpegs = [_numbered(image, n) for n, image in enumerate(approach.images)]
        self._began_s: float | None = None
        station = self

        class Handler(BaseHTTPRequestHandler):
            def log_message(self, *words: object) -> None:
                """Keep quiet."""

            def do_GET(self) -> None:
                with suppress(OSError):
                    station._serve(self)

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.address = f"http://127.0.0.1:{self._server.server_port}/approach.mjpg"

    def __enter__(self) -> _Station:
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        self._server.shutdown()
        self._server.server_close()

    def clock_s(self) -> float:
        """Time of the flight."""
        return 0.0 if self._began_s is None else time.monotonic() - self._began_s

    def begin(self) -> None:
        """With the first result: until then there is but the first frame, while the pipeline warms up."""
        if self._began_s is None:
            self._began_s = time.monotonic()

    def _serve(self, asked: BaseHTTPRequestHandler) -> None:
        if BEGIN_S <= self.clock_s() < END_S or self.clock_s() > FRAMES / RATE_HZ:
            asked.send_error(503)
            return
        asked.send_response(200)
        asked.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        asked.end_headers()
        for _ in range(2):  # to open a stream takes two
            if self._began_s is None:
                self._send(asked, 0)
        while self._began_s is None:
            time.sleep(0.01)
        for n in range(round(self.clock_s() * RATE_HZ), FRAMES):
            time.sleep(max(n / RATE_HZ - self.clock_s(), 0.0))
            if BEGIN_S <= self.clock_s() < END_S:
                return
            self._send(asked, n)

    def _send(self, asked: BaseHTTPRequestHandler, n: int) -> None:
        head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(self._jpegs[n])}\r\n\r\n"
        asked.wfile.write(head.encode() + self._jpegs[n] + b"\r\n")


def _numbered(image: Image, number: int) -> bytes:
    marked = image.copy()
    for bit in range(_BITS):
        marked[:_BIT_PX, bit * _BIT_PX : (bit + 1) * _BIT_PX] = 255 * (number >> bit & 1)
    return cv2.imencode(".jpg", marked[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, 95))[1].tobytes()


class _LiveKeeper:
    """A sink that keeps results of the station's frames, by the numbers painted into them."""

    def __init__(self, approach: Approach, station: _Station) -> None:
        self.approach, self.station = approach, station
        self.moments: list[Moment] = []

    def write(self, frame: int, result: FrameResult, image: Image | None = None) -> None:
        pose = None
        if image is not None:
            bits = image[_BIT_PX // 2, _BIT_PX // 2 : _BITS * _BIT_PX : _BIT_PX, 0] > 127
            pose = self.approach.poses[int(bits @ (1 << np.arange(_BITS)))]
        self.moments.append(Moment(self.station.clock_s(), pose, result))

    def close(self) -> None:
        pass
