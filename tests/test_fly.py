"""Flights: sources in the order of time, results on time, failures survived."""

import io
import json
import os
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
from test_cli import call, refused

import shortfinal as sf
from shortfinal.demo import CAMERA, RUNWAY, approach_pose, demo_scene
from shortfinal.errors import InputError, JobError
from shortfinal.scene.render import render
from shortfinal.scene.sensor import Sensor
from shortfinal.stream.fly import Log, flight_record, fly
from shortfinal.stream.frames import FolderSource, Mailbox, PipeSource, TimedFrame, VideoSource, open_source

FRAMES = 8


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
    """A sink that keeps what it gets; it may fail at a frame."""

    def __init__(self, fails_at=None):
        self.records, self.fails_at, self.closed = [], fails_at, False

    def write(self, frame, result, image=None):
        if frame == self.fails_at:
            raise JobError("the disk is full")
        self.records.append((frame, result))

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
    assert set(flown.stages) == {"detect_ms", "solve_ms", "doubt_ms", "track_ms", "step_ms", "write_ms"}
    assert kept.closed


def test_without_box_or_prior_it_says_what_is_missing(folder, detector):
    kept = Kept()
    fly(FolderSource(folder, 10.0), pipeline_of(detector), [kept])
    assert all(result.verdict.decision is sf.Decision.NOT_MONITORED for _, result in kept.records)
    assert "where to look is not known" in kept.records[0][1].verdict.reasons[0]


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
