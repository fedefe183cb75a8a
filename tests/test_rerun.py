"""A recording is read back with Rerun's own reader."""

import sys

import cv2
import numpy as np
import pytest
from flights import CAMERA, POSE, RUNWAY, TrackState, picture, result, survivor, track

import shortfinal as sf
from shortfinal.errors import InputError
from shortfinal.integrity import Decision
from shortfinal.stream.mcap import FLUSHED
from shortfinal.stream.rerun import RerunSink

pytest.importorskip("rerun", reason="needs the extra rerun: rerun-sdk")
import pyarrow
from rerun.chunk import RrdReader


def read(path):
    """{entity: [{column: value}]}, a row of what was logged under each name at each time; times in ns."""
    rows = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        columns = {name: batch.column(name) for name in batch.schema.names}
        # As a number: Python's own durations end at microseconds.
        columns = {name: c.cast("int64") if str(c.type) == "duration[ns]" else c for name, c in columns.items()}
        rows.setdefault(chunk.entity_path, []).extend(pyarrow.table(columns).to_pylist())
    return rows


def column(rows, name):
    """The values of a component, of the rows that have it."""
    return [value for row in rows for key, value in row.items() if key.endswith(f":{name}") and value is not None]


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    path = tmp_path_factory.mktemp("rerun") / "flight.rrd"
    with RerunSink(path, CAMERA, RUNWAY) as sink:
        sink.write(0, result(0.0, track=track(0.0)), picture())
        sink.write(1, result(1 / 3, Decision.DO_NOT_USE, track=track(1 / 3)), picture())
        sink.write(2, result(0.5, Decision.NOT_MONITORED, track=track(0.5, TrackState.LOST)), picture())
        sink.write(3, result(0.75))
    return read(path)


def test_each_frame_has_its_time_in_nanoseconds_and_its_number(flight):
    rows = flight["/verdict"]
    assert [row["frame"] for row in rows] == [0, 1, 2, 3]
    assert [row["time"] for row in rows] == [0, 333_333_333, 500_000_000, 750_000_000]
    texts = [text for (text,) in column(rows, "text")]
    assert texts[0].startswith("use: residual")
    assert texts[0].endswith("tracking: measurement taken in (p = 0.4)")
    assert texts[2].startswith("not-monitored: no runway in view")
    assert [level for (level,) in column(rows, "level")] == ["INFO", "WARN", "WARN", "INFO"]


def test_the_camera_stands_where_it_was_and_the_runway_where_it_is(flight):
    translations, matrices = column(flight["/camera"], "translation"), column(flight["/camera"], "mat3x3")
    assert len(translations) == 3  # there is no pose of the frame without a runway
    np.testing.assert_allclose(translations[0][0], POSE.position_m)
    # Rerun stores columns one after another.
    np.testing.assert_allclose(np.reshape(matrices[0][0], (3, 3)).T, POSE.runway_from_camera, atol=1e-6)
    ((outline,),) = column(flight["/runway"], "strips")
    np.testing.assert_allclose(outline, RUNWAY.corners[[0, 1, 2, 3, 0]])
    assert len(column(flight["/path/track"], "positions")) == 2
    own = column(flight["/path/frame"], "positions")
    assert len(own) == 3
    np.testing.assert_allclose(own[0][0], POSE.position_m, atol=1e-3)


def test_picture_and_keypoints_fit_the_pinhole(flight):
    rows = flight["/camera/image"]
    ((matrix,),) = column(rows, "image_from_camera")
    ((size,),) = column(rows, "resolution")
    k = np.reshape(matrix, (3, 3)).T
    assert size == [960.0, 540.0]
    blobs = column(rows, "blob")
    assert len(blobs) == 3
    image = cv2.imdecode(np.frombuffer(bytes(blobs[0][0]), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    expected = cv2.resize(picture(), (960, 540), interpolation=cv2.INTER_AREA)
    assert np.abs(image.astype(int) - expected).mean() < 2  # of 255: JPEG
    points = column(flight["/camera/image/keypoints"], "positions")
    assert len(points) == 3
    # Rerun's pixels are its pinhole's: no half of one is in between. Single precision.
    seen = sf.Camera(960, 540, k[0, 0], k[1, 1], k[0, 2], k[1, 2])
    np.testing.assert_allclose(points[0], sf.project(seen, POSE, RUNWAY.corners), atol=1e-3)
    ellipses = column(flight["/camera/image/keypoints/ellipses"], "strips")[0]
    assert len(ellipses) == 4
    # Two sigma of half a pixel each, three quarters as large.
    np.testing.assert_allclose(np.linalg.norm(np.array(ellipses[2]) - points[0][2], axis=1), 0.75, atol=1e-3)
    assert len(column(flight["/camera/image/keypoints/outline"], "strips")) == 3


def test_what_is_no_longer_seen_is_cleared(flight):
    cleared = [row["frame"] for row in flight["/camera/image/keypoints"] if column([row], "is_recursive")]
    assert cleared == [2]


def test_the_figures_are_those_of_the_result(flight):
    given = result(0.0)
    assert column(flight["/p_value"], "scalars")[0] == [given.verdict.p_value]
    assert len(column(flight["/p_value"], "scalars")) == 3
    assert column(flight["/level/vertical_m"], "scalars")[0] == [pytest.approx(given.protection.vertical_m)]
    assert column(flight["/position/z_m"], "scalars")[0] == [70.0]


@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # it is written at the end
def test_a_kill_leaves_all_but_the_last_half_second(tmp_path):
    path = tmp_path / "flight.rrd"
    opening = "sink = RerunSink(sys.argv[1], CAMERA, RUNWAY)"
    done = survivor("from shortfinal.stream.rerun import RerunSink", opening, path, 2 * FLUSHED + 5)
    frames = [row["frame"] for row in read(path)["/verdict"]]
    assert frames == list(range(len(frames)))
    assert len(frames) >= done - FLUSHED >= FLUSHED


def test_what_cannot_be_written_is_one_clear_line(tmp_path):
    with pytest.raises(InputError, match=r"flight\.rrd: cannot be written: No such file or directory$"):
        RerunSink(tmp_path / "nowhere" / "flight.rrd", CAMERA, RUNWAY)


def test_without_rerun_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(InputError, match=r"pip install 'shortfinal\[rerun\]'"):
        RerunSink(tmp_path / "flight.rrd", CAMERA, RUNWAY)
    assert not (tmp_path / "flight.rrd").exists()
