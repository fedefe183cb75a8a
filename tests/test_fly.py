"""Flights: sources in the order of time, results on time, failures survived."""

import io
import json
import math
import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise
from urllib.request import urlopen

import cv2
import flights
import numpy as np
import pytest
from test_cli import call, refused

import shortfinal as sf
from shortfinal.demo import CAMERA, RUNWAY, approach_pose, demo_scene
from shortfinal.errors import InputError, JobError
from shortfinal.scene.render import render
from shortfinal.scene.sensor import Sensor
from shortfinal.stream.fly import QUEUE, Stages, Writer, flight_record, fly, warm_up
from shortfinal.stream.frames import FolderSource, LiveSource, Mailbox, PipeSource, TimedFrame, VideoSource, open_source
from shortfinal.stream.sink import AnnotatedVideo, Live, Log

FRAMES = 8
BENCHMARK = "flight_memory"


@pytest.fixture(scope="module")
def pictures():
    scene = demo_scene()
    sensor = Sensor(0.5, 2.0, 92)
    return [render(scene, CAMERA, approach_pose(k), sensor, samples=1, seed=k) for k in range(FRAMES)]


@pytest.fixture(scope="module")
def folder(pictures, tmp_path_factory):
    folder = tmp_path_factory.mktemp("frames")
    for k, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"{k:03d}.png"), picture[..., ::-1])
    (folder / "notes.txt").write_text("no image")
    return folder


@pytest.fixture(scope="module")
def detector():
    return sf.KeypointDetector()


BOX = [*sf.project(CAMERA, approach_pose(0), RUNWAY.corners).min(axis=0),
       *sf.project(CAMERA, approach_pose(0), RUNWAY.corners).max(axis=0)]  # fmt: skip


def pipeline_of(detector):
    return sf.LandingPipeline(detector, RUNWAY, CAMERA, tracker=sf.Tracker())


class Kept:
    """A sink that keeps what it gets; it may fail at a frame, or wait until it may go on."""

    def __init__(self, fails_at=None, may_go_on=None):
        self.records, self.fails_at, self.closed = [], fails_at, False
        self.images, self.times, self.may_go_on, self.entered = [], [], may_go_on, threading.Event()

    def write(self, frame, result, image=None):
        if frame == self.fails_at:
            raise JobError("the disk is full")
        self.entered.set()
        if self.may_go_on is not None:
            assert self.may_go_on.wait(20)
        self.records.append((frame, result))
        self.images.append(image is not None)
        self.times.append(time.monotonic())

    def close(self):
        self.closed = True


class Slow:
    """A live source that does not wait for anybody."""

    live = True

    def __init__(self, pictures, pause_s):
        self.pictures, self.pause_s = pictures, pause_s

    def __iter__(self):
        start = time.monotonic()
        for number, picture in enumerate(self.pictures):
            yield TimedFrame(number, time.monotonic() - start, picture)
            time.sleep(self.pause_s)


def test_a_folder_is_flown_frame_after_frame(folder, detector):
    kept = Kept()
    flown = fly(FolderSource(folder, 10.0), pipeline_of(detector), [kept], box=BOX)
    assert flown.frames == FRAMES
    assert [frame for frame, _ in kept.records] == list(range(FRAMES))
    assert [result.timestamp_s for _, result in kept.records] == pytest.approx(np.arange(FRAMES) / 10)
    assert sum(flown.decisions.values()) == sum(flown.states.values()) == FRAMES
    assert kept.records[-1][1].track.state is sf.TrackState.TRACKING
    error = kept.records[-1][1].track.pose.position_m - approach_pose(FRAMES - 1).position_m
    assert (np.abs(error) < 4 * np.sqrt(np.diag(kept.records[-1][1].track.cov))[:3]).all()
    assert set(flown.stages) == {"detect_ms", "solve_ms", "doubt_ms", "track_ms", "step_ms", "total_ms", "write_ms"}
    assert kept.closed


def test_without_box_or_prior_the_runway_is_found(folder, detector):
    kept = Kept()
    flown = fly(FolderSource(folder, 10.0), pipeline_of(detector), [kept])
    found = [result.verdict.decision is sf.Decision.USE for _, result in kept.records]
    assert any(found[:3])
    for _, result in kept.records[: found.index(True)]:  # the scene's taxiway can pass for a second one, far out
        assert "searching for" in result.verdict.reasons[0] or "2 runways in view fit" in result.verdict.reasons[0]
    assert "search_ms" in flown.stages


def test_a_video_has_its_own_times(pictures, tmp_path):
    path = tmp_path / "flight.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 12.5, (CAMERA.width, CAMERA.height))
    for picture in pictures:
        writer.write(picture[..., ::-1])
    writer.release()
    frames = list(VideoSource(path, None))
    assert [f.number for f in frames] == list(range(FRAMES))
    assert [f.timestamp_s for f in frames] == pytest.approx(np.arange(FRAMES) / 12.5, abs=2e-3)
    assert np.abs(frames[3].image.astype(int) - pictures[3]).mean() < 6  # compressed, and RGB
    assert [f.timestamp_s for f in VideoSource(path, 50)] == pytest.approx(np.arange(FRAMES) / 50)


def test_a_pipe_carries_raw_frames(pictures):
    pipe = io.BytesIO(b"".join(p.tobytes() for p in pictures[:3]))
    frames = list(PipeSource(pipe, CAMERA))
    assert len(frames) == 3
    assert (frames[2].image == pictures[2]).all()
    with pytest.raises(JobError, match="100 of"):
        list(PipeSource(io.BytesIO(pictures[0].tobytes() + bytes(100)), CAMERA))


@pytest.mark.parametrize(
    "text, says",
    [
        ("nowhere", "no such folder or video"),
        ("camera:x", "camera's number"),
        ("camera:99", "cannot be opened"),
        ("rtsp://127.0.0.1:1/none", "cannot be opened"),
    ],
)
def test_a_source_that_is_none_is_refused(text, says):
    with pytest.raises(InputError, match=says):
        open_source(text, CAMERA)


def test_a_file_that_is_no_video_and_a_folder_without_images(tmp_path):
    (tmp_path / "x.mp4").write_text("text")
    with pytest.raises(InputError, match="not a video"):
        open_source(str(tmp_path / "x.mp4"), CAMERA)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no image in it"):
        open_source(str(tmp_path / "empty"), CAMERA)


def test_of_a_live_source_the_newest_frame_is_taken_and_the_others_counted(pictures):
    mailbox = Mailbox(Slow(pictures, 0.02), newest=True)
    time.sleep(0.02 * FRAMES + 0.3)
    assert mailbox.take(1.0).number == FRAMES - 1
    assert mailbox.dropped == FRAMES - 1
    assert mailbox.take(0.1) is None
    assert mailbox.ended


def test_of_a_file_no_frame_is_dropped(folder):
    mailbox = Mailbox(FolderSource(folder, 30.0), newest=False)
    taken = []
    while (frame := mailbox.take(5.0)) is not None:
        taken.append(frame.number)
        time.sleep(0.01)
    assert taken == list(range(FRAMES))
    assert mailbox.dropped == 0


def test_a_camera_that_falls_silent_is_told_and_the_track_coasts(pictures, detector):
    class Silent(Slow):
        def __iter__(self):
            for frame in super().__iter__():
                if frame.number == FRAMES - 1:
                    time.sleep(0.8)
                yield frame

    kept = Kept()
    fly(Silent(pictures, 0.1), pipeline_of(detector), [kept], box=BOX, newest=False, watchdog_s=0.15)
    silent = [r for _, r in kept.records if any("no frame for" in reason for reason in r.verdict.reasons)]
    assert len(silent) >= 2
    assert all(r.verdict.decision is sf.Decision.NOT_MONITORED and not r.track.taken for r in silent)
    times = [r.timestamp_s for _, r in kept.records]
    assert len(kept.records) >= FRAMES + 2
    assert times[-1] > times[0]


def test_a_sink_that_fails_is_left_out_and_the_flight_goes_on(folder, detector):
    bad, good = Kept(fails_at=3), Kept()
    flown = fly(FolderSource(folder, 10.0), pipeline_of(detector), [bad, good], box=BOX)
    assert len(bad.records) == 3
    assert len(good.records) == FRAMES
    assert flown.notes == ("frame 3: the disk is full; left out from here on",)
    assert bad.closed


def test_a_frame_that_cannot_be_read_ends_the_flight_with_what_was_written(folder, detector, tmp_path):
    bad = tmp_path / "bad"
    bad.mkdir()
    for k in range(4):
        content = (folder / f"{k:03d}.png").read_bytes()
        (bad / f"{k:03d}.png").write_bytes(content if k < 3 else content[:500])
    log = Log(tmp_path / "out", flight_record("bad", pipeline_of(detector), {}, None, 33.0))
    with pytest.raises(InputError, match=r"003\.png"):
        fly(FolderSource(bad, 10.0), pipeline_of(detector), [log], box=BOX)
    assert len((tmp_path / "out" / "frames.jsonl").read_text().splitlines()) == 3


def test_a_frame_of_another_size_is_no_measurement_and_the_next_one_is_again(folder, detector, tmp_path):
    for k in range(4):
        picture = cv2.imread(str(folder / f"{k:03d}.png"))
        cv2.imwrite(str(tmp_path / f"{k}.png"), cv2.resize(picture, None, fx=0.5, fy=0.5) if k == 2 else picture)
    kept = Kept()
    fly(FolderSource(tmp_path, 10.0), pipeline_of(detector), [kept], box=BOX)
    decisions = [result.verdict.decision for _, result in kept.records]
    assert decisions == [sf.Decision.USE, sf.Decision.USE, sf.Decision.NOT_MONITORED, sf.Decision.USE]
    assert "480 x 360 pixels; the camera has 960 x 720" in kept.records[2][1].verdict.reasons[0]
    (tmp_path / "0.png").write_bytes((tmp_path / "2.png").read_bytes())
    with pytest.raises(InputError, match="480 x 360"):
        fly(FolderSource(tmp_path, 10.0), pipeline_of(detector), [], box=BOX)


def arguments(folder, tmp_path):
    lens = tmp_path / "camera.toml"
    names = ("width", "height", "fx", "fy", "cx", "cy")
    lens.write_text("\n".join(f"{name} = {getattr(CAMERA, name)}" for name in names))
    size = f"{RUNWAY.length_m:g}x{RUNWAY.width_m:g}"
    box = ",".join(f"{edge:.1f}" for edge in BOX)
    return ["run", folder, "--camera", lens, "--size", size, "--box", box, "--out", tmp_path / "out"]


def test_the_command_flies_and_its_folder_says_everything(folder, tmp_path, capsys):
    status, out, _ = call(capsys, *arguments(folder, tmp_path), "--fps", "10", "--copies", "2", "--json")
    assert status == 0
    assert json.loads(out)["frames"] == FRAMES
    lines = [json.loads(line) for line in (tmp_path / "out" / "frames.jsonl").read_text().splitlines()]
    assert [line["frame"] for line in lines] == list(range(FRAMES))
    assert lines[-1]["track"]["state"] == "tracking"
    assert ["image" in line for line in lines] == [k % 2 == 0 for k in range(FRAMES)]
    picture = cv2.imread(str(tmp_path / "out" / lines[2]["image"]))
    assert picture.shape[1] == round(lines[2]["image_scale"] * CAMERA.width)
    flight = json.loads((tmp_path / "out" / "flight.json").read_text())
    assert flight["runway"]["length_m"] == RUNWAY.length_m
    assert flight["stages"]["step_ms"]["p50"] > 0
    assert flight["model"]["name"] == "runway.onnx"


def test_what_a_flight_lacks_is_said_in_one_line(folder, tmp_path, capsys):
    full = arguments(folder, tmp_path)
    without_camera = [*full[:2], *full[4:]]
    assert "needs its camera" in refused(capsys, *without_camera)
    without_size = [*full[:4], *full[6:]]
    assert "needs its runway" in refused(capsys, *without_size)
    assert "--box" in refused(capsys, *full[:6], "--box", "5,5,1,1", *full[8:])
    assert "--fps" in refused(capsys, *full, "--fps", "0")


class AtOnce(Kept):
    """One that is written in the flight's own thread."""

    prompt, errors, note = True, 0, ""


def test_a_sink_that_hangs_holds_up_neither_the_flight_nor_what_is_sent():
    may_go_on = threading.Event()
    slow, prompt = Kept(may_go_on=may_go_on), AtOnce()
    writer, image, result = Writer([slow, prompt], patient=False), flights.picture(), flights.result()
    writer.give(0, result, image)
    assert slow.entered.wait(10)
    for frame in range(1, 3 * QUEUE):
        writer.give(frame, result, image)
    assert [frame for frame, _ in prompt.records] == list(range(3 * QUEUE))
    assert slow.records == []
    may_go_on.set()
    writer.drain()
    assert [frame for frame, _ in slow.records] == list(range(3 * QUEUE))  # no result is lost
    assert slow.images == [frame <= QUEUE for frame in range(3 * QUEUE)]
    assert writer.pictures_dropped == 2 * QUEUE - 1
    assert slow.closed
    assert prompt.closed
    assert writer.notes == []


def test_where_the_source_waits_the_flight_waits_for_its_sinks():
    may_go_on, given = threading.Event(), []
    slow = Kept(may_go_on=may_go_on)
    writer, image, result = Writer([slow], patient=True), flights.picture(), flights.result()

    def fly_on():
        for frame in range(3 * QUEUE):
            writer.give(frame, result, image)
            given.append(frame)

    flight = threading.Thread(target=fly_on)
    flight.start()
    assert slow.entered.wait(10)
    flight.join(0.3)
    assert len(given) == QUEUE + 1  # one is being written
    may_go_on.set()
    flight.join()
    writer.drain()
    assert slow.images == [True] * (3 * QUEUE)
    assert writer.pictures_dropped == 0


def test_a_sink_that_hangs_for_good_costs_results_but_no_memory(monkeypatch):
    monkeypatch.setattr("shortfinal.stream.fly.BACKLOG", 10)
    may_go_on = threading.Event()
    slow, result = Kept(may_go_on=may_go_on), flights.result()
    writer = Writer([slow], patient=False)
    writer.give(0, result, None)
    assert slow.entered.wait(10)
    for frame in range(1, 31):
        writer.give(frame, result, None)
    may_go_on.set()
    writer.drain()
    assert [frame for frame, _ in slow.records] == list(range(11))
    assert writer.notes == ["20 results not written: the sinks were 10 behind"]


def test_a_live_flight_goes_on_while_a_sink_hangs(pictures, detector):
    over, before = threading.Event(), []

    class Ending(Slow):
        def __iter__(self):
            yield from super().__iter__()
            over.set()

    slow = Kept(may_go_on=over)
    flown = fly(Ending(pictures, 0.15), pipeline_of(detector), [slow], box=BOX,
                progress=lambda *_: before.append(not over.is_set()))  # fmt: skip
    assert sum(before) >= 2
    assert len(slow.records) == sum(flown.decisions.values())


def test_whatever_a_sink_raises_the_flight_goes_on(folder, detector):
    class Broken(Kept):
        def write(self, frame, result, image=None):
            raise KeyError("frame_id")

        def close(self):
            raise OSError(5, "Input/output error")

    good = Kept()
    flown = fly(FolderSource(folder, 10.0), pipeline_of(detector), [Broken(), good], box=BOX)
    assert len(good.records) == FRAMES
    assert "frame 0: KeyError: 'frame_id'; left out from here on" in flown.notes
    assert len(flown.notes) == 2  # and that it could not be closed


@contextmanager
def files_no_larger_than(size):
    """As on a disk that is full: what does not fit is written in part, then refused."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_log_without_room_loses_whole_lines_and_goes_on_when_there_is_room(tmp_path):
    path = tmp_path / "frames.jsonl"
    log, result, image = Log(tmp_path, {"alert_limits": None}), flights.result(), flights.picture()
    log.write(0, result, image)
    size = path.stat().st_size
    with files_no_larger_than(size + size // 2):
        log.write(1, result, image)
        assert path.stat().st_size == size  # half a line was written, and taken back
        log.write(2, result, image)
    assert log.errors == 2
    assert "File too large" in log.note
    log.write(3, result, image)
    with files_no_larger_than(3 * size):  # room for a line, not for a picture
        log.write(4, result, image)
    log.close()
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [line["frame"] for line in lines] == [0, 3, 4]
    assert ["image" in line for line in lines] == [True, True, False]
    assert log.errors == 3
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == ["000000.jpg", "000003.jpg"]


def test_a_full_disk_does_not_end_a_flight(folder, detector, tmp_path):
    pipeline = pipeline_of(detector)
    warm_up(pipeline)  # what is compiled is stored, too
    log = Log(tmp_path, flight_record("folder", pipeline, {}, None, 33.0), every=0)
    with files_no_larger_than(4 * len(json.dumps(flights.result().to_dict()))):
        flown = fly(FolderSource(folder, 10.0), pipeline, [log], box=BOX)
    frames = [json.loads(line)["frame"] for line in (tmp_path / "frames.jsonl").read_text().splitlines()]
    assert flown.frames == FRAMES
    assert 0 < len(frames) < FRAMES
    (note,) = flown.notes
    assert note.startswith(f"Log: {FRAMES - len(frames)} lost, frames {frames[-1] + 1} to {FRAMES - 1}: ")
    assert json.loads((tmp_path / "flight.json").read_text())["notes"] == [note]


def test_a_video_that_finds_no_room_says_so(tmp_path):
    video = AnnotatedVideo(tmp_path / "flight.mp4", flights.CAMERA, flights.RUNWAY, 10.0)
    noise = np.random.default_rng(0).integers(0, 256, (flights.CAMERA.height, flights.CAMERA.width, 3), np.uint8)
    with files_no_larger_than(100_000):
        for frame in range(5):
            video.write(frame, flights.result(), noise)
        with pytest.raises(JobError, match="could not be written whole"):
            video.close()
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(InputError, match=r"flight\.mp4: cannot be written"):
        AnnotatedVideo(tmp_path / "nowhere" / "flight.mp4", flights.CAMERA, flights.RUNWAY, 10.0)


def test_a_peer_that_is_not_there_is_noted(folder, detector):
    mavlink = pytest.importorskip("shortfinal.stream.mavlink")
    pytest.importorskip("pymavlink", reason="needs the extra mavlink: pymavlink")
    kept = Kept()
    flown = fly(FolderSource(folder, 10.0), pipeline_of(detector), [kept, mavlink.MavlinkSink("udpout:127.0.0.1:9")],
                box=BOX)  # fmt: skip
    assert len(kept.records) == FRAMES
    (note,) = flown.notes
    assert note.startswith("MavlinkSink: ")
    assert note.endswith("refused")


def test_a_browser_that_leaves_does_not_end_the_live_page(folder, detector):
    pipeline = pipeline_of(detector)
    live = Live(flight_record("folder", pipeline, {}, sf.AlertLimits(vertical_m=35.0), 33.0))
    events = urlopen(f"{live.url}events")

    def leave(frame, result):
        if frame == 2:
            assert b'"decision"' in events.readline()
            events.close()

    kept = Kept()
    flown = fly(FolderSource(folder, 10.0), pipeline, [live, kept], box=BOX, progress=leave)
    assert len(kept.records) == FRAMES
    assert flown.notes == ()


class Camera:
    """A network camera: JPEG pictures over HTTP, one after the other, at 10 a second."""

    def __init__(self, pictures, port=0):
        there, self.sending = self, True
        parts = [b"--next\r\nContent-Type: image/jpeg\r\n\r\n" + cv2.imencode(".jpg", p[..., ::-1])[1].tobytes()
                 + b"\r\n" for p in pictures]  # fmt: skip

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=next")
                self.end_headers()
                with suppress(OSError):
                    while there.sending:
                        for part in parts:
                            self.wfile.write(part)
                            time.sleep(0.1)
                there.hold.wait(20)

            def log_message(self, *_):
                pass

        class Server(ThreadingHTTPServer):
            daemon_threads, block_on_close = True, False

        self.hold = threading.Event()
        self.server = Server(("127.0.0.1", port), Handler)
        self.port = self.server.server_address[1]
        threading.Thread(target=self.server.serve_forever, args=(0.01,), daemon=True).start()

    def leave(self, *, silently):
        """Closing its connections, or leaving them as they are, without a word."""
        self.sending = False
        if not silently:
            self.hold.set()
        self.server.shutdown()
        self.server.server_close()


@pytest.mark.parametrize("silently", [False, True])
def test_a_network_camera_that_goes_and_comes_back_is_seen_again_within_a_second(pictures, detector, silently):
    shown = [
        cv2.add(pictures[0], np.full_like(pictures[0], step)) for step in range(4)
    ]  # no two the same, as a sensor's
    first = Camera(shown)
    source, kept, back = LiveSource(f"http://127.0.0.1:{first.port}/"), Kept(), []

    def seen():
        return sum(r.crop is not None for _, r in kept.records)

    def gone():
        return [r for _, r in kept.records if "no frame for" in r.verdict.reasons[0]]

    def wait_until(what):
        until = time.monotonic() + 20
        while not what() and time.monotonic() < until:
            time.sleep(0.01)

    def happen():
        wait_until(lambda: seen() >= 6)
        first.leave(silently=silently)
        wait_until(lambda: len(gone()) >= 4)
        again, before = Camera(shown, first.port), seen()
        back.append(time.monotonic())
        wait_until(lambda: seen() >= before + 5)
        source.stop()
        again.leave(silently=False)

    events = threading.Thread(target=happen)
    events.start()
    flown = fly(source, pipeline_of(detector), [kept], box=BOX)
    events.join()
    returned = min(t for t, (_, r) in zip(kept.times, kept.records, strict=True) if t > back[0] and r.crop is not None)
    assert returned - back[0] < 1.0
    assert len(gone()) >= 4
    assert all(r.verdict.decision is sf.Decision.NOT_MONITORED for r in gone())
    assert any("the first after" in note for note in flown.notes)


def test_a_pipe_that_breaks_off_leaves_what_was_flown(pictures, detector, tmp_path):
    reading, writing = os.pipe()

    def pour():
        with os.fdopen(writing, "wb") as pipe:
            pipe.write(b"".join(p.tobytes() for p in pictures[:3]) + bytes(1000))

    pouring = threading.Thread(target=pour)
    pouring.start()
    log = Log(tmp_path, flight_record("-", pipeline_of(detector), {}, None, 33.0))
    with os.fdopen(reading, "rb") as pipe, pytest.raises(JobError, match="1000 of"):
        fly(PipeSource(pipe, CAMERA), pipeline_of(detector), [log], box=BOX)
    pouring.join()
    assert json.loads((tmp_path / "frames.jsonl").read_text().splitlines()[-1])["frame"] == 2


def test_percentiles_of_an_hour_are_good_to_a_percent():
    rng, stages = np.random.default_rng(3), Stages()
    times = {"fast_ms": rng.lognormal(-3.0, 1.0, 20_000), "slow_ms": rng.lognormal(4.0, 0.7, 20_000)}
    for fast, slow in zip(*times.values(), strict=True):
        stages.add({"fast_ms": fast, "slow_ms": slow})
    summary = stages.summary()
    for stage, each in times.items():
        for q in (50, 95, 99):
            exact = np.percentile(each, q, method="inverted_cdf")
            # Half a bin of 2 %, and the third digit after the point.
            assert summary[stage][f"p{q}"] == pytest.approx(exact, rel=0.01, abs=6e-4)
    stages.add({"odd_ms": 0.0})
    stages.add({"odd_ms": 1e9})
    assert stages.summary()["odd_ms"]["p50"] == pytest.approx(1e-3, abs=6e-4)


@pytest.mark.parametrize(("leak_kb", "flat"), [(0.0, True), (1.0, False)])
def test_memory_that_grows_is_told_from_memory_that_varies(benchmark, leak_kb, flat):
    frames = np.arange(1000, 20_001, 1000)
    warm = 300 - 80 * np.exp(-frames / 1000)
    noise = np.random.default_rng(2).normal(0, 0.5, len(frames))
    found = benchmark.verdict(frames, warm + noise + leak_kb / 1024 * frames)
    assert found["flat"] is flat
    # Of 15,000 frames, give or take 0.5 MB times sqrt(12 / 15): three sigma and what the pools leave.
    assert found["rise_mb"] == pytest.approx(15_000 * leak_kb / 1024, abs=2.0)


@pytest.mark.slow
def test_the_memory_of_a_flight_is_read(benchmark, tmp_path, monkeypatch):
    monkeypatch.setattr(benchmark, "PICTURES", 2)
    found = benchmark.measure(40, 5, 10, tmp_path)
    assert found["frames"] == list(range(5, 41, 5))
    assert sum(found["decisions"].values()) == len((tmp_path / "frames.jsonl").read_text().splitlines()) == 40
    assert found["states"]["tracking"] > 20
    assert found["notes"] == ()


def test_a_warm_up_leaves_the_pipeline_as_it_was(pictures, detector):
    pipeline = pipeline_of(detector)
    assert warm_up(pipeline) > 0
    assert pipeline.tracker.predict(1e3) is None
    assert pipeline.tracker.update(0.0, None, pipeline.coast(0.0, "no frame").verdict).coasting_s == 0
    assert pipeline.step(pictures[0], 0.1, box=BOX).verdict.decision is sf.Decision.USE


def test_a_flight_as_a_video_with_limits(folder, tmp_path, capsys):
    path = tmp_path / "flight.mp4"
    status, _, _ = call(capsys, *arguments(folder, tmp_path), "--fps", "10", "--copies", "0", "--json", "--video", path,
                        "--alert-limits", "1e6,inf,1e6")  # fmt: skip
    assert status == 0
    video = cv2.VideoCapture(str(path))
    assert (video.get(cv2.CAP_PROP_FRAME_COUNT), video.get(cv2.CAP_PROP_FPS)) == (FRAMES, 10)
    shown = [video.read()[1] for _ in range(FRAMES)]
    assert all(np.abs(a.astype(int) - b).mean() > 0.05 for a, b in pairwise(shown))
    flight = json.loads((tmp_path / "out" / "flight.json").read_text())
    assert flight["alert_limits"] == {"along_m": 1e6, "cross_m": None, "vertical_m": 1e6, "lateral_deg": None,
                                      "vertical_deg": None}  # fmt: skip
    lines = [json.loads(line) for line in (tmp_path / "out" / "frames.jsonl").read_text().splitlines()]
    for line in lines:
        levels = [line.get("protection", {}).get(axis) or math.inf for axis in ("along_m", "vertical_m")]
        assert line["available"] is (line["decision"] == "use" and max(levels) <= 1e6)


def test_available_is_what_may_be_used_with_every_level_within_its_limit(tmp_path):
    levels = flights.result().protection
    tight = sf.AlertLimits(vertical_m=0.99 * levels.vertical_m)
    wide = sf.AlertLimits(vertical_m=1.01 * levels.vertical_m)
    frames = [flights.result(decision=decision) for decision in sf.Decision]
    for limits, expected in ((wide, [True, False, False]), (tight, [False, False, False])):
        bounds = {name: getattr(limits, name) for name in ("along_m", "cross_m", "vertical_m")}
        log = Log(tmp_path, {"alert_limits": {k: v if math.isfinite(v) else None for k, v in bounds.items()}})
        for number, frame in enumerate(frames):
            log.write(number, frame)
        log.close()
        lines = [json.loads(line) for line in (tmp_path / "frames.jsonl").read_text().splitlines()]
        assert [line["available"] for line in lines] == expected


def test_a_flight_is_not_written_over_itself(folder, tmp_path, capsys):
    flight = tmp_path / "flight.mp4"
    flight.write_bytes(b"all there is")
    there = tmp_path / "out" / "frames"
    shutil.copytree(folder, there)
    before = sorted(path.name for path in there.iterdir())
    common = arguments(folder, tmp_path)[2:]
    for option in ("--video", "--mcap", "--rerun"):
        assert "the flight itself" in refused(capsys, "run", flight, *common, option, tmp_path / "." / "flight.mp4")
    assert "would be deleted" in refused(capsys, "run", there, *common)
    assert flight.read_bytes() == b"all there is"
    assert sorted(path.name for path in there.iterdir()) == before


@pytest.mark.parametrize("text", ["40,35", "40,0,35", "a,b,c", "nan,1,1"])
def test_limits_that_are_none_are_refused(text, folder, tmp_path, capsys):
    assert "--alert-limits" in refused(capsys, *arguments(folder, tmp_path), "--alert-limits", text)


@pytest.mark.slow
def test_the_first_frame_pays_for_nothing(folder, tmp_path):
    command = [sys.executable, "-m", "shortfinal.cli", *map(str, arguments(folder, tmp_path)), "--json"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    lines = [json.loads(line) for line in (tmp_path / "out" / "frames.jsonl").read_text().splitlines()]
    times = [sum(line["timings"].values()) for line in lines]
    # Loading the stored kernels takes some 300 ms; a first call of the network some 20.
    assert times[0] < 3 * np.median(times[1:]) + 10
    assert json.loads((tmp_path / "out" / "flight.json").read_text())["warm_up_s"] > 0


@pytest.mark.slow
def test_what_was_written_is_readable_after_a_kill(folder, tmp_path):
    many = tmp_path / "many"
    many.mkdir()
    for k in range(400):
        os.link(folder / f"{k % FRAMES:03d}.png", many / f"{k:03d}.png")
    command = [sys.executable, "-m", "shortfinal.cli", *map(str, arguments(many, tmp_path))]
    flight = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    lines = tmp_path / "out" / "frames.jsonl"
    until = time.monotonic() + 120
    while time.monotonic() < until and not (lines.exists() and lines.read_bytes().count(b"\n") > 20):
        time.sleep(0.02)
    flight.send_signal(signal.SIGKILL)
    flight.wait()
    whole = lines.read_bytes().split(b"\n")[:-1]
    assert 20 < len(whole) < 400
    assert [json.loads(line)["frame"] for line in whole] == list(range(len(whole)))
    json.loads((tmp_path / "out" / "flight.json").read_text())
