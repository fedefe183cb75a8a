"""What is sent is decoded by a receiver of pymavlink's own, and held against independent arithmetic."""

import math
import os
import pty
import sys
import time

import numpy as np
import pytest
from flights import CAMERA, POSE, VELOCITY, TrackState, covariance, result, track
from scipy.spatial.transform import Rotation

import shortfinal as sf
from shortfinal.errors import InputError
from shortfinal.integrity import Decision
from shortfinal.stream.mavlink import LONGEST_TEXT, MavlinkSink

mavutil = pytest.importorskip("pymavlink.mavutil", reason="needs the extra mavlink: pymavlink")
from pymavlink.dialects.v20 import common  # noqa: E402

REFUSED = (Decision.DO_NOT_USE, Decision.NOT_MONITORED)


class Receiver:
    def __init__(self, port=0):
        self.link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}")
        self.port = self.link.port.getsockname()[1]
        self.connection = f"udpout:127.0.0.1:{self.port}"

    def messages(self, *kinds):
        """All that came, or those of some types. A datagram to this machine is there when `send` returns."""
        found = []
        while (message := self.link.recv_msg()) is not None:
            found.append(message)
        return [m for m in found if not kinds or m.get_type() in kinds]


@pytest.fixture
def receiver():
    there = Receiver()
    yield there
    there.link.close()


def received(receiver, *results):
    with MavlinkSink(receiver.connection) as sink:
        for number, each in enumerate(results):
            sink.write(number, each)
        assert sink.errors == 0
    return receiver.messages()


def only(messages, kind):
    (message,) = [m for m in messages if m.get_type() == kind]
    return message


def attitude(pose):
    """The body's attitude in the local frame. Forward, right, down: aviation's angles are those of the axes."""
    return Rotation.from_euler("ZYX", pose.attitude, degrees=True)


def state_of(pose, velocity=VELOCITY):
    """x, y, z, roll, pitch, yaw in MAVLink's frame, then the velocity in the body's (9,)."""
    x, y, z = pose.position_m
    yaw, pitch, roll = np.radians(pose.attitude)
    speed = attitude(pose).inv().apply([velocity[0], -velocity[1], -velocity[2]])
    return np.array([x, -y, -z, roll, pitch, yaw, *speed])


def propagated(pose, cov):
    """The covariance (9, 9) of `state_of`, by central differences."""
    columns, step = [], 1e-5
    for k in range(9):
        d = step * np.eye(9)[k]
        ends = [state_of(pose.plus(sign * d[:6]), VELOCITY + sign * d[6:]) for sign in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * step))
    jacobian = np.column_stack(columns)
    return jacobian @ cov @ jacobian.T


def test_odometry_is_the_track_in_mavlinks_frames(receiver):
    odometry = only(received(receiver, result(12.25, track=track(12.25))), "ODOMETRY")
    assert (odometry.get_srcSystem(), odometry.get_srcComponent()) == (1, common.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY)
    assert (odometry.time_usec, odometry.frame_id, odometry.child_frame_id) == (12_250_000, 20, 12)
    assert odometry.estimator_type == common.MAV_ESTIMATOR_TYPE_VISION
    assert (odometry.quality, odometry.reset_counter) == (100, 0)
    # 1200 m before the threshold, 30 m left of the centreline, 70 m up.
    assert (odometry.x, odometry.y, odometry.z) == (-1200.0, -30.0, -70.0)
    w, x, y, z = odometry.q
    assert (attitude(POSE).inv() * Rotation.from_quat([x, y, z, w])).magnitude() < 1e-6
    speed = state_of(POSE)[6:]
    np.testing.assert_allclose([odometry.vx, odometry.vy, odometry.vz], speed, rtol=1e-6)
    assert speed[0] > 61
    assert np.linalg.norm(speed) == pytest.approx(np.linalg.norm(VELOCITY))
    assert all(math.isnan(rate) for rate in (odometry.rollspeed, odometry.pitchspeed, odometry.yawspeed))


def test_covariances_are_the_upper_triangles_row_by_row(receiver):
    odometry = only(received(receiver, result(track=track())), "ODOMETRY")
    expected = propagated(POSE, covariance())
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    place = 0
    for row in range(6):
        for column in range(row, 6):
            # Central differences of a step of 1e-5, on numbers around 1000, are good to 1e-7 / 1e-5 * 1e-3.
            tolerance = 1e-4 * scale[row, column]
            assert odometry.pose_covariance[place] == pytest.approx(expected[row, column], abs=tolerance), (row, column)
            both = odometry.velocity_covariance[place]
            if column < 3:
                assert both == pytest.approx(expected[6 + row, 6 + column], abs=1e-4 * scale[6 + row, 6 + column])
            else:
                assert math.isnan(both)
            place += 1
    assert place == len(odometry.pose_covariance) == len(odometry.velocity_covariance) == 21


def test_without_a_tracker_the_frames_own_pose_is_sent_and_no_velocity(receiver):
    given = result(1.0)
    odometry = only(received(receiver, given), "ODOMETRY")
    np.testing.assert_allclose([odometry.x, odometry.y, odometry.z], [-1200, -30, -70], atol=1e-3)
    assert math.isnan(odometry.vx)
    assert math.isnan(odometry.velocity_covariance[0])
    # x, y, z as they are, but for the sign of what is between x and the others.
    cov = given.estimate.cov
    assert odometry.pose_covariance[0] == pytest.approx(cov[0, 0], rel=1e-5)
    assert odometry.pose_covariance[1] == pytest.approx(-cov[0, 1], rel=1e-5)
    assert odometry.pose_covariance[7] == pytest.approx(cov[1, 2], rel=1e-5)


def test_landing_target_points_from_the_camera_to_the_threshold(receiver):
    target = only(received(receiver, result(3.5, track=track(3.5))), "LANDING_TARGET")
    assert (target.time_usec, target.frame, target.position_valid) == (3_500_000, 12, 1)
    assert target.type == common.LANDING_TARGET_TYPE_VISION_OTHER
    assert target.distance == pytest.approx(math.hypot(1200, 30, 70))
    w, x, y, z = target.q
    local_from_body = Rotation.from_quat([x, y, z, w]).inv()
    assert (attitude(POSE).inv() * local_from_body).magnitude() < 1e-6
    # Back in the local frame: from 1200 m before, 30 m left and 70 m up, it lies ahead, right and down.
    np.testing.assert_allclose(attitude(POSE).apply([target.x, target.y, target.z]), [1200, 30, 70], atol=1e-3)
    ((u, v),) = sf.project(CAMERA, POSE, [[0.0, 0.0, 0.0]])
    assert math.tan(target.angle_x) == pytest.approx((u - CAMERA.cx) / CAMERA.fx, abs=1e-6)
    assert math.tan(target.angle_y) == pytest.approx((v - CAMERA.cy) / CAMERA.fy, abs=1e-6)


def test_another_target_may_be_given_and_is_not_sent_once_behind(receiver):
    with MavlinkSink(receiver.connection, target_m=[400.0, 0.0, 0.0]) as sink:
        sink.write(0, result(track=track()))
        assert only(receiver.messages(), "LANDING_TARGET").distance == pytest.approx(math.hypot(1600, 30, 70))
        over = sf.Pose.from_attitude([500.0, 0.0, 20.0])
        sink.write(1, result(1.0, track=track(1.0, pose=over)))
        kinds = [m.get_type() for m in receiver.messages()]
    assert "ODOMETRY" in kinds
    assert "LANDING_TARGET" not in kinds


def test_without_a_target_none_is_sent(receiver):
    with MavlinkSink(receiver.connection, target_m=None) as sink:
        sink.write(0, result(track=track()))
    assert {m.get_type() for m in receiver.messages()} == {"HEARTBEAT", "ODOMETRY", "STATUSTEXT"}


@pytest.mark.parametrize(
    ("decision", "of_track"),
    [
        *((decision, None) for decision in REFUSED),
        *((decision, {}) for decision in REFUSED),
        *((Decision.USE, {"state": state}) for state in (TrackState.SEARCHING, TrackState.LOST, TrackState.DEGRADED)),
        (Decision.USE, {"taken": False}),
    ],
)
def test_nothing_usable_is_sent_of_a_frame_that_may_not_be_used(receiver, decision, of_track):
    refused = result(decision=decision, track=None if of_track is None else track(**of_track))
    messages = received(receiver, refused)
    assert {m.get_type() for m in messages} == {"HEARTBEAT", "STATUSTEXT"}
    heartbeat = only(messages, "HEARTBEAT")
    assert (heartbeat.type, heartbeat.autopilot) == (
        common.MAV_TYPE_ONBOARD_CONTROLLER, common.MAV_AUTOPILOT_INVALID,
    )  # fmt: skip
    assert heartbeat.system_status == common.MAV_STATE_STANDBY
    texts = [m for m in messages if m.get_type() == "STATUSTEXT"]
    assert {t.severity for t in texts} == {common.MAV_SEVERITY_WARNING}


def said(messages):
    """Status texts put together from their pieces, as a ground station does."""
    texts, open_pieces = [], {}
    for m in messages:
        if m.get_type() != "STATUSTEXT":
            continue
        if m.id == 0:
            texts.append(m.text)
            continue
        pieces = open_pieces.setdefault(m.id, [])
        assert m.chunk_seq == len(pieces)
        pieces.append(m.text)
        if len(m.text) < 50:  # a zero byte ended it
            texts.append("".join(open_pieces.pop(m.id)))
    assert not open_pieces
    return texts


@pytest.mark.parametrize("length", [1, 20, 50, 51, 99, 100, 101, 150, 199, 200, 400])
def test_the_reason_arrives_whole_in_pieces(receiver, length):
    # "shortfinal: use, lost: " goes before a reason.
    reason = ("0123456789" * 40)[:length]
    (text,) = said(received(receiver, result(track=track(state=TrackState.LOST, reason=reason))))
    assert text == f"shortfinal: use, lost: {reason}"[:LONGEST_TEXT]


def test_a_refused_frames_own_reason_comes_before_the_tracks(receiver):
    refused = result(
        decision=Decision.NOT_MONITORED, track=track(state=TrackState.LOST, reason="nothing taken in for 3 s")
    )
    (text,) = said(received(receiver, refused))
    assert text == (
        "shortfinal: not-monitored, lost: no runway in view (its probability is 0.03); nothing taken in for 3 s"
    )


def test_reasons_are_told_when_they_change_and_once_a_second_at_most(receiver):
    frames = []
    for k in range(90):  # three seconds of 30 frames/s: each differs from the last for two, then all are refused
        decision = Decision.USE if k % 2 and k < 60 else Decision.DO_NOT_USE
        frames.append(result(100 + k / 30, decision))
    messages = received(receiver, *frames)
    assert len([m for m in messages if m.get_type() == "HEARTBEAT"]) == 3
    texts = said(messages)
    assert 2 <= len(texts) <= 3
    assert "do-not-use" in texts[-1]
    assert "the keypoints do not fit the runway" in texts[-1]
    assert len([m for m in messages if m.get_type() == "ODOMETRY"]) == 30


def test_heartbeats_go_on_after_a_clock_that_went_back(receiver):
    messages = received(receiver, *(result(t, Decision.NOT_MONITORED) for t in (50.0, 50.5, 3.0, 3.5, 4.0)))
    assert [m.get_type() for m in messages].count("HEARTBEAT") == 3  # at 50, 3 and 4 s


def test_the_reset_counter_counts_tracks_begun_anew(receiver):
    states = {state.name[0]: state for state in TrackState}
    frames = [result(k / 30, track=track(k / 30, states[letter])) for k, letter in enumerate("STTDTLSTTLT")]
    messages = received(receiver, *frames)
    assert [m.reset_counter for m in messages if m.get_type() == "ODOMETRY"] == [0, 0, 0, 1, 1, 2]


def test_a_time_that_mavlink_cannot_tell_stops_nothing(receiver):
    with MavlinkSink(receiver.connection) as sink:
        sink.write(0, result(-5.0))
        assert sink.errors == 2
        assert sink.note
        sink.write(1, result(1.0))
        assert sink.errors == 2
    assert [m.time_usec for m in receiver.messages("ODOMETRY")] == [1_000_000]


def test_a_receiver_that_comes_and_goes_is_survived():
    first = Receiver()
    port, frames = first.port, iter(range(10**6))

    def fly(sink, count):
        begin = time.perf_counter()
        for _ in range(count):
            k = next(frames)
            sink.write(k, frame_of[k % 30])
        return time.perf_counter() - begin

    frame_of = [result(k / 30, track=track(k / 30)) for k in range(30)]
    with MavlinkSink(first.connection) as sink:
        fly(sink, 5)
        assert len(first.messages("ODOMETRY")) == 5
        first.link.close()
        # Nothing waits: a frame takes a fraction of a millisecond; a second is for a busy machine.
        assert fly(sink, 50) < 1.0
        assert sink.errors >= 25
        assert "refused" in sink.note
        again, errors = Receiver(port), sink.errors
        fly(sink, 5)
        assert len(again.messages("ODOMETRY")) >= 4  # the first send may still learn of the peer that was gone
        assert sink.errors <= errors + 1
        again.link.close()


class Line:
    """A serial line: a pseudo terminal under a name, as udev would give it."""

    def __init__(self, name):
        self.master, self.slave = pty.openpty()
        os.set_blocking(self.master, False)
        name.unlink(missing_ok=True)
        name.symlink_to(os.ttyname(self.slave))
        self.parser = common.MAVLink(None)
        self.parser.robust_parsing = True

    def messages(self):
        found = []
        while True:
            try:
                data = os.read(self.master, 4096)
            except BlockingIOError:
                return found
            found += self.parser.parse_buffer(data) or []

    def unplug(self):
        os.close(self.slave)
        os.close(self.master)


def test_a_serial_line_carries_the_same_and_may_be_unplugged(tmp_path):
    name = tmp_path / "ttyACM0"
    line = Line(name)
    with MavlinkSink(f"{name}:115200") as sink:
        sink.write(0, result(0.0, track=track()))
        assert only(line.messages(), "ODOMETRY").z == -70.0
        line.unplug()
        begin = time.perf_counter()
        for k in range(1, 50):
            sink.write(k, result(k / 30, track=track()))
        assert time.perf_counter() - begin < 2.0
        assert sink.errors >= 90
        assert sink.note
        line, found, begin = Line(name), [], time.monotonic()
        for k in range(50, 110):
            sink.write(k, result(k / 30, track=track()))
            if found := [m for m in line.messages() if m.get_type() == "ODOMETRY"]:
                break
            time.sleep(1 / 30)
        assert found[0].time_usec == round(1e6 * k / 30)
        assert time.monotonic() - begin < 1.0
        line.unplug()


def test_a_line_that_takes_no_more_neither_waits_nor_spoils_what_follows(tmp_path):
    name = tmp_path / "ttyACM0"
    line, frame = Line(name), result(0.0, track=track())
    with MavlinkSink(f"{name}:115200") as sink:
        begin = time.perf_counter()
        for k in range(400):  # 120 kB and more, which nobody reads
            sink.write(k, frame)
        assert time.perf_counter() - begin < 5.0
        assert sink.errors > 100
        assert "takes no more" in sink.note
        before = line.messages()
        sink.write(400, frame)
        after = line.messages()
    # What was cut off is finished first, so that every packet which arrived can be read.
    kinds = {m.get_type() for m in (*before, *after)}
    assert kinds == {"HEARTBEAT", "ODOMETRY", "LANDING_TARGET", "STATUSTEXT"}
    assert [m.get_type() for m in after][-2:] == ["ODOMETRY", "LANDING_TARGET"]
    line.unplug()


@pytest.mark.parametrize(
    ("connection", "words"),
    [
        ("", "expected udpout:HOST:PORT or /dev/DEVICE:BAUD"),
        ("127.0.0.1:14550", "expected udpout"),
        ("tcp:127.0.0.1:14550", "expected udpout"),
        ("udpout:127.0.0.1", "expected udpout"),
        ("udpout:127.0.0.1:99999", "expected udpout"),
        ("udpout:no such host.invalid:14550", "no such host.invalid"),
        ("/dev/no-such-line:115200", "/dev/no-such-line: cannot be opened as a serial line: No such file"),
        ("/dev/null:115200", "/dev/null: cannot be opened as a serial line"),
        ("/dev/null:12345", "12345 baud is no rate"),
    ],
)
def test_a_wrong_connection_is_one_clear_line(connection, words):
    with pytest.raises(InputError) as caught:
        MavlinkSink(connection)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("system", [0, 256, 1.5])
def test_a_wrong_system_is_refused(system):
    with pytest.raises(InputError, match="system"):
        MavlinkSink("udpout:127.0.0.1:14550", system=system)


def test_without_pymavlink_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20", None)
    with pytest.raises(InputError, match=r"pip install 'shortfinal\[mavlink\]'"):
        MavlinkSink("udpout:127.0.0.1:14550")
