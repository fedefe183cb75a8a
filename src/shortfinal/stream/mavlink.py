"""MAVLink to an autopilot: ODOMETRY and LANDING_TARGET of frames that may be used, and why others may not.

Frames (docs/sinks.md): the local frame is MAV_FRAME_LOCAL_FRD, x along the landing direction, y right,
z down, origin at the centre of the landing threshold; the body is MAV_FRAME_BODY_FRD, the camera's own
axes: x where it looks, y right, z down. Messages are those of the MAVLink 2 dialect "common"
(https://mavlink.io/en/messages/common.html).
"""

from __future__ import annotations

import math
import os
import re
import socket
import struct
import time
from contextlib import suppress
from types import TracebackType
from typing import Any, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from shortfinal.errors import InputError
from shortfinal.geometry import BODY_FROM_CAMERA, Pose, as_array
from shortfinal.integrity import Decision
from shortfinal.pipeline import FrameResult
from shortfinal.tracker import Track, TrackState

Array = NDArray[np.float64]

HEARTBEAT_S = 1.0  # between heartbeats, and at least so long between status texts, by the frames' timestamps
RETRY_S = 0.25  # between attempts to open a serial line that is gone, by the clock on the wall
LONGEST_TEXT = 200  # characters of a status text

_FRD = np.diag([1.0, -1.0, -1.0])  # forward, left, up to forward, right, down, and back
_BODY_FROM_CAMERA: Array = _FRD @ BODY_FROM_CAMERA  # both as MAVLink has them: body FRD
_CHUNK = 50  # bytes of a STATUSTEXT


class _Belief(NamedTuple):
    pose: Pose
    cov: Array  # (6, 6) of the pose, or (9, 9) with the velocity
    velocity_mps: Array | None  # (3,) runway frame


class MavlinkSink:
    """Sends what may be used, as it comes; whatever else happens is told in words.

    A frame is sent only if its verdict is USE and, where there is a track, the track is TRACKING and
    took the frame's measurement in. Of any other frame nothing but heartbeats (1 Hz) and status texts
    go out. A peer that is gone neither stops nor delays a flight: nothing waits, `errors` counts what
    was not sent, `note` says why, and sending goes on when the peer is back.
    """

    prompt = True  # a flight writes it first, in its own thread

    def __init__(self, connection: str, *, system: int = 1, target_m: ArrayLike | None = (0.0, 0.0, 0.0)) -> None:
        """`connection`: "udpout:HOST:PORT" or "/dev/DEVICE:BAUD"; `system`: the vehicle's id; `target_m` (3,): the
        point of LANDING_TARGET, runway frame: the threshold's centre if not given; None: no LANDING_TARGET.

        Raises InputError for another connection, a host without an address, a device that cannot be
        opened, or without pymavlink.
        """
        try:
            from pymavlink.dialects.v20 import common
        except ModuleNotFoundError as error:
            raise InputError("MAVLink needs pymavlink: pip install 'shortfinal[mavlink]'") from error
        if not (isinstance(system, int) and 1 <= system <= 255):
            raise InputError(f"MAVLink system: {system!r}; it must be a whole number from 1 to 255")
        self._target: Array | None = None if target_m is None else as_array(target_m, (3,), "target_m")
        self._link = _open(connection)
        self._common = common
        self._mavlink: Any = common.MAVLink(self._link, system, common.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY)
        self.errors = 0  # messages that could not be sent
        self.note = ""  # the last reason
        self._beat_s = self._told_s = math.nan  # when the last heartbeat and status text went
        self._told: tuple[Decision, str | None] | None = None  # of what
        self._texts = self._resets = 0
        self._sent = self._broken = False  # whether anything was sent; whether that track has ended

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        self.close()

    def write(self, frame: int, result: FrameResult, image: NDArray[np.uint8] | None = None) -> None:
        """Send what there is to send of a frame; never raises for what the peer or the frame is like."""
        track = result.track
        state = None if track is None else str(track.state.value)
        now, belief = result.timestamp_s, _may_be_used(result, track)
        if state in ("searching", "lost") and self._sent:
            self._broken = True
        if _due(now, self._beat_s):
            self._beat_s = now
            self._send(self._heartbeat(belief is not None))
        if belief is not None:
            self._send_pose(now, belief)
        key = (result.verdict.decision, state)
        if key != self._told and _due(now, self._told_s):
            self._told, self._told_s = key, now
            self._send_text(_words(result, track), belief is not None)

    def close(self) -> None:
        """Close the connection."""
        self._link.close()

    def _send_pose(self, timestamp_s: float, belief: _Belief) -> None:
        if self._broken:
            self._resets, self._broken = (self._resets + 1) % 256, False
        self._sent = True
        usec = round(1e6 * timestamp_s)
        self._send(self._odometry(usec, belief))
        target = self._landing_target(usec, belief.pose)
        if target is not None:
            self._send(target)

    def _odometry(self, usec: int, belief: _Belief) -> Any:
        common, (pose, cov, velocity) = self._common, belief
        local_from_body = _local_from_body(pose)
        speed, speed_cov = np.full(3, math.nan), np.full((6, 6), math.nan)
        if velocity is not None:
            speed = local_from_body.T @ _FRD @ velocity
            speed_cov = speed_covariance(pose, speed, cov)
        return common.MAVLink_odometry_message(
            usec, common.MAV_FRAME_LOCAL_FRD, common.MAV_FRAME_BODY_FRD, *(_FRD @ pose.position_m),
            _quaternion(local_from_body), *speed, math.nan, math.nan, math.nan,
            _upper(pose_covariance(pose, cov)), _upper(speed_cov),
            self._resets, common.MAV_ESTIMATOR_TYPE_VISION, 100,
        )  # fmt: skip

    def _landing_target(self, usec: int, pose: Pose) -> Any | None:
        """None if there is no target, or it is no longer ahead."""
        common = self._common
        if self._target is None:
            return None
        in_camera = pose.runway_from_camera.T @ (self._target - pose.position_m)
        x, y, z = (float(value) for value in in_camera)
        if z <= 0:
            return None
        body_from_local = _local_from_body(pose).T
        return common.MAVLink_landing_target_message(
            usec, 0, common.MAV_FRAME_BODY_FRD, math.atan2(x, z), math.atan2(y, z), math.hypot(x, y, z), 0.0, 0.0,
            *(_BODY_FROM_CAMERA @ in_camera), _quaternion(body_from_local),
            common.LANDING_TARGET_TYPE_VISION_OTHER, 1,
        )  # fmt: skip

    def _heartbeat(self, usable: bool) -> Any:
        common = self._common
        status = common.MAV_STATE_ACTIVE if usable else common.MAV_STATE_STANDBY
        return common.MAVLink_heartbeat_message(
            common.MAV_TYPE_ONBOARD_CONTROLLER, common.MAV_AUTOPILOT_INVALID, 0, 0, status, 3
        )

    def _send_text(self, words: str, usable: bool) -> None:
        """One STATUSTEXT, or numbered pieces of one; a zero byte ends the last."""
        common = self._common
        text = words.encode("ascii", "replace")[:LONGEST_TEXT]
        severity = common.MAV_SEVERITY_INFO if usable else common.MAV_SEVERITY_WARNING
        number = 0
        if len(text) > _CHUNK:
            self._texts = number = self._texts % 65535 + 1
            text += b"\0"
        for piece in range(0, len(text), _CHUNK):
            message = common.MAVLink_statustext_message(severity, text[piece : piece + _CHUNK], number, piece // _CHUNK)
            self._send(message)

    def _send(self, message: Any) -> None:
        try:
            self._mavlink.send(message)
        except (OSError, struct.error, OverflowError) as error:  # a time before zero, a number beyond a float32
            self.errors += 1
            self.note = (error.strerror if isinstance(error, OSError) else None) or str(error)


def pose_covariance(pose: Pose, cov: Array) -> Array:
    """Covariance (6, 6) of x, y, z (m, local FRD) and roll, pitch, yaw (rad), as MAVLink orders them.

    `cov` (6, 6 or larger): of the local increment of `Pose.plus`; what follows the first six is left
    out. The angles are those of yaw, then pitch, then roll about the body's axes (Z-Y-X), as in
    MAVLink's ATTITUDE: a small turn (p, q, r) of the body changes roll by p + (q sin roll + r cos roll)
    tan pitch, pitch by q cos roll - r sin roll, yaw by (q sin roll + r cos roll) / cos pitch.
    """
    _, pitch, roll = np.radians(pose.attitude)
    sin, cos = math.sin(roll), math.cos(roll)
    euler_from_turn = np.array([
        [1.0, sin * math.tan(pitch), cos * math.tan(pitch)],
        [0.0, cos, -sin],
        [0.0, sin / math.cos(pitch), cos / math.cos(pitch)],
    ])  # fmt: skip
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3], jacobian[3:, 3:] = _FRD, euler_from_turn @ _BODY_FROM_CAMERA
    turned: Array = jacobian @ cov[:6, :6] @ jacobian.T
    return turned


def speed_covariance(pose: Pose, speed: Array, cov: Array) -> Array:
    """Covariance (6, 6) of the velocity in the body's axes, m/s; NaN for the turn rates, which are not known.

    `speed` (3,): that velocity; `cov` (9, 9): a track's. A turn of the body turns the velocity that it
    sees: d(speed) = body_from_local d(velocity) + speed x d(turn).
    """
    x, y, z = speed
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    jacobian = np.hstack([cross @ _BODY_FROM_CAMERA, _local_from_body(pose).T @ _FRD])
    whole = np.full((6, 6), math.nan)
    whole[:3, :3] = jacobian @ cov[3:9, 3:9] @ jacobian.T
    return whole


def _may_be_used(result: FrameResult, track: Track | None) -> _Belief | None:
    """What is believed of a frame, if it may be used."""
    estimate = result.estimate
    if result.verdict.decision is not Decision.USE or estimate is None or estimate.pose is None or estimate.cov is None:
        return None
    if track is None:
        return _Belief(estimate.pose, estimate.cov, None)
    if track.state is not TrackState.TRACKING or not track.taken or track.pose is None or track.cov is None:
        return None
    return _Belief(track.pose, track.cov, track.velocity_mps)


def _words(result: FrameResult, track: Track | None) -> str:
    """Decision, state, and the reasons: of a frame that is refused its own, then the track's."""
    verdict = result.verdict
    known, reasons = [verdict.decision.value], list(verdict.reasons)
    if track is not None:
        known.append(track.state.value)
        reasons = [*(reasons if verdict.decision is not Decision.USE else []), track.reason]
    return f"shortfinal: {', '.join(known)}: {'; '.join(reasons)}"


def _due(now: float, last: float) -> bool:
    """Whether the time is up; it is too after a clock that went back."""
    return not last <= now < last + HEARTBEAT_S


def _local_from_body(pose: Pose) -> Array:
    turn: Array = _FRD @ pose.runway_from_camera @ _BODY_FROM_CAMERA.T
    return turn


def _quaternion(matrix: Array) -> list[float]:
    """w, x, y, z with w >= 0."""
    return [float(q) for q in Rotation.from_matrix(matrix).as_quat(canonical=True, scalar_first=True)]


def _upper(matrix: Array) -> list[float]:
    """The upper triangle (21) of (6, 6), row by row."""
    return [float(value) for value in matrix[np.triu_indices(6)]]


class _Link(Protocol):
    def write(self, packet: bytes) -> None:
        """Send at once or raise OSError."""

    def close(self) -> None:
        """Let go."""


def _open(connection: str) -> _Link:
    udp = re.fullmatch(r"udpout:\[?([^\[\]]+)\]?:(\d+)", connection)
    if udp and 0 < int(udp[2]) < 65536:
        return _Udp(connection, udp[1], int(udp[2]))
    serial = re.fullmatch(r"(/[^:]+):(\d+)", connection)
    if serial:
        return _Serial(serial[1], int(serial[2]))
    raise InputError(f"MAVLink connection {connection!r}: expected udpout:HOST:PORT or /dev/DEVICE:BAUD")


class _Udp:
    """A socket tied to its peer: only such a one is told that nobody listens. pymavlink's own keeps that to itself."""

    def __init__(self, connection: str, host: str, port: int) -> None:
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, kind, protocol)
            self._socket.setblocking(False)
            self._socket.connect(address)
        except (OSError, UnicodeError) as error:
            words = getattr(error, "strerror", None) or str(error)
            raise InputError(f"MAVLink connection {connection!r}: {words}") from error

    def write(self, packet: bytes) -> None:
        self._socket.send(packet)

    def close(self) -> None:
        self._socket.close()


class _Serial:
    """A serial line, raw, 8N1. pyserial's write waits, or spins, when a line takes no more; this one does neither."""

    def __init__(self, path: str, baud: int) -> None:
        try:
            import termios
        except ModuleNotFoundError as error:
            raise InputError(f"{path}: serial lines need Linux or macOS; use udpout:HOST:PORT") from error
        self._termios, self._path = termios, path
        speed = getattr(termios, f"B{baud}", None)
        if not speed:
            raise InputError(f"{path}: {baud} baud is no rate of a serial line here; use 115200, 230400 or 921600")
        self._speed: int = speed
        self._rest, self._tried_s = b"", -math.inf
        try:
            self._fd: int | None = self._opened()
        except OSError as error:
            raise InputError(f"{path}: cannot be opened as a serial line: {error.strerror}") from error

    def write(self, packet: bytes) -> None:
        try:
            self._write(packet)
        except BlockingIOError:
            raise BlockingIOError(None, f"{self._path}: the line takes no more; raise its baud rate") from None
        except OSError:
            if self._fd is not None:
                self._drop()
            raise

    def close(self) -> None:
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None

    def _write(self, packet: bytes) -> None:
        if self._fd is None:
            if time.monotonic() < self._tried_s + RETRY_S:
                raise OSError(None, f"{self._path}: the serial line is gone")
            self._tried_s = time.monotonic()
            self._fd = self._opened()
        # What was cut off goes first: half a packet would spoil the next as well.
        while self._rest:
            self._rest = self._rest[os.write(self._fd, self._rest) :]
        self._rest = packet[os.write(self._fd, packet) :]

    def _drop(self) -> None:
        if self._fd is not None:
            with suppress(self._termios.error):  # else closing waits for what will never go out
                self._termios.tcflush(self._fd, self._termios.TCOFLUSH)
            with suppress(OSError):
                self.close()
        self._fd, self._rest, self._tried_s = None, b"", time.monotonic()

    def _opened(self) -> int:
        termios = self._termios
        fd = os.open(self._path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            characters = termios.tcgetattr(fd)[6]
            control = termios.CS8 | termios.CREAD | termios.CLOCAL
            termios.tcsetattr(fd, termios.TCSANOW, [0, 0, control, 0, self._speed, self._speed, characters])
        except termios.error as error:
            os.close(fd)
            raise OSError(*error.args) from error
        return fd
