"""Frames as Parquet, read back with pyarrow."""

import dataclasses
import math
import sys

import numpy as np
import pytest
from flights import CAMERA, POSE, RUNWAY, TrackState, covariance, result, survivor, track

import shortfinal as sf
from shortfinal.errors import InputError
from shortfinal.integrity import Decision
from shortfinal.stream.parquet import ROWS, ParquetSink, row_of

parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra data: pyarrow")


def test_a_row_holds_what_the_result_holds(tmp_path):
    given = result(1 / 3, track=track(1 / 3))
    with ParquetSink(tmp_path) as sink:
        sink.write(7, given)
    (row,) = parquet.read_table(tmp_path).to_pylist()
    record = given.to_dict()
    assert (row["frame"], row["timestamp_ns"], row["decision"], row["status"]) == (7, 333_333_333, "use", "converged")
    assert row["reasons"] == record["reasons"][0]
    assert [row[n] for n in ("statistic", "dof", "p_value")] == [record[n] for n in ("statistic", "dof", "p_value")]
    assert [row[n] for n in ("x_m", "y_m", "z_m")] == record["position_m"]
    assert [row[n] for n in ("yaw_deg", "pitch_deg", "roll_deg")] == record["attitude_deg"]
    assert row["near_left_u_px"] == record["keypoints_px"][0][0]
    assert row["far_left_v_px"] == record["keypoints_px"][3][1]
    assert row["sigma_y_m"] == pytest.approx(math.sqrt(record["pose_cov"][1][1]))
    assert row["level_vertical_m"] == record["protection"]["vertical_m"]
    assert [row[f"crop_{n}"] for n in ("left", "top", "width", "height")] == [500.0, 300.0, 224.0, 224.0]
    assert dict(row["timings_ms"]) == record["timings"]
    assert (row["track_state"], row["track_taken"], row["track_coasting_s"]) == ("tracking", True, 0.0)
    assert [row[f"track_{n}"] for n in ("x_m", "y_m", "z_m")] == POSE.position_m.tolist()
    assert [row[f"track_v{n}_mps"] for n in "xyz"] == [62.0, -1.5, -3.2]
    for name, matrix in (
        ("keypoints_cov_px2", given.keypoints.cov_px),
        ("pose_cov", given.estimate.cov),
        ("track_cov", covariance()),
    ):
        expected = [matrix[i, j] for i in range(len(matrix)) for j in range(i, len(matrix))]
        assert row[name] == expected, name


def test_what_is_not_known_is_null_and_what_is_no_level_is_infinite(tmp_path):
    level = result().protection
    unbounded = dataclasses.replace(result(1.0), protection=dataclasses.replace(level, along_m=math.inf))
    with ParquetSink(tmp_path) as sink:
        sink.write(0, result(0.0, Decision.NOT_MONITORED))
        sink.write(1, unbounded)
        sink.write(2, result(2.0, track=track(2.0, TrackState.LOST)))
    rows = parquet.read_table(tmp_path).to_pylist()
    known = {name for name, value in rows[0].items() if value is not None}
    assert known == {"frame", "timestamp_ns", "decision", "reasons", "dof", "timings_ms"}
    assert rows[1]["level_along_m"] == math.inf
    assert rows[1]["track_state"] is None
    assert (rows[2]["track_state"], rows[2]["track_x_m"], rows[2]["track_cov"]) == ("lost", None, None)


def test_every_value_has_a_column(tmp_path):
    names = set()
    for each in (result(track=track()), result(decision=Decision.NOT_MONITORED)):
        names |= set(row_of(0, each))
    with ParquetSink(tmp_path) as sink:
        sink.write(0, result())
    assert names == set(parquet.read_table(tmp_path).column_names)


def test_further_keypoints_leave_the_corners_columns_as_they_are():
    px = np.vstack([sf.project(CAMERA, POSE, RUNWAY.corners), [[600.0, 400.0]]])
    more = dataclasses.replace(result(), keypoints=sf.GaussianKeypoints.from_sigma(px, np.arange(1.0, 6.0)[:, None]))
    row = row_of(0, more)
    assert len(row["keypoints_cov_px2"]) == 36
    assert (row["keypoints_cov_px2"][0], row["keypoints_cov_px2"][-1]) == (1.0, 16.0)


def test_files_are_whole_and_read_as_one_table_while_they_grow(tmp_path):
    frame = result()
    with ParquetSink(tmp_path) as sink:
        for number in range(2 * ROWS + 5):
            sink.write(number, frame)
            if number == ROWS + 50:
                assert parquet.read_table(tmp_path)["frame"].to_pylist() == list(range(ROWS))
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"frames-0000{k}.parquet" for k in range(3)]
    assert parquet.read_table(tmp_path)["frame"].to_pylist() == list(range(2 * ROWS + 5))


def test_a_kill_leaves_whole_files(tmp_path):
    done = survivor(
        "from shortfinal.stream.parquet import ParquetSink", "sink = ParquetSink(sys.argv[1])", tmp_path, ROWS + 20
    )
    frames = parquet.read_table(tmp_path)["frame"].to_pylist()
    assert frames == list(range(len(frames)))
    assert len(frames) >= done - ROWS > 0
    assert len(frames) % ROWS == 0


def test_what_could_not_be_written_is_written_later(tmp_path, monkeypatch):
    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    frame, sink = result(), ParquetSink(tmp_path)
    with monkeypatch.context() as disk:
        disk.setattr(parquet, "write_table", full)
        with pytest.raises(InputError, match=r"frames-00000\.parquet: cannot be written: No space left on device$"):
            for number in range(ROWS):
                sink.write(number, frame)
    assert list(tmp_path.iterdir()) == []
    sink.write(ROWS, frame)
    sink.close()
    assert parquet.read_table(tmp_path)["frame"].to_pylist() == list(range(ROWS + 1))


def test_the_frames_of_another_flight_are_not_mixed_in(tmp_path):
    with ParquetSink(tmp_path) as sink:
        sink.write(0, result())
    with pytest.raises(InputError, match="another flight; choose an empty folder"):
        ParquetSink(tmp_path)


def test_without_pyarrow_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"pip install 'shortfinal\[data\]'"):
        ParquetSink(tmp_path)
