"""An MCAP file is read back with the mcap package's own readers."""

import base64
import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from flights import CAMERA, POSE, RUNWAY, TrackState, picture, result, survivor, track
from scipy.spatial.transform import Rotation

import shortfinal as sf
from shortfinal.errors import InputError
from shortfinal.integrity import Decision
from shortfinal.stream.mcap import FLUSHED, SCHEMAS, TOPICS, McapSink, reduced

pytest.importorskip("mcap", reason="needs the extra mcap: mcap")
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader

# As published at https://docs.foxglove.dev/docs/sdk/schemas; of a list, the fields of what is in it.
PUBLISHED = {
    "CompressedImage": "timestamp frame_id data format",
    "CameraCalibration": "timestamp frame_id width height distortion_model D K R P",
    "ImageAnnotations": "circles points texts",
    "FrameTransform": "timestamp parent_frame_id child_frame_id translation rotation",
    "PoseInFrame": "timestamp frame_id pose",
}
PUBLISHED_WITHIN = {
    "circles": "timestamp position diameter thickness fill_color outline_color",
    "points": "timestamp type points outline_color outline_colors fill_color thickness",
    "texts": "timestamp position text font_size text_color background_color",
    "pose": "position orientation",
    "timestamp": "sec nsec",
}


def written(folder, *frames, camera=CAMERA):
    path = folder / "flight.mcap"
    with McapSink(path, camera, RUNWAY) as sink:
        for number, (each, image) in enumerate(frames):
            sink.write(number, each, image)
    return path


def read(path):
    """(topic, schema's name, log time in ns, message) of each message."""
    with path.open("rb") as file:
        return [
            (channel.topic, schema.name, message.log_time, json.loads(message.data))
            for schema, channel, message in make_reader(file).iter_messages(log_time_order=False)
        ]


def of(messages, topic):
    return [m for name, _, _, m in messages if name == topic]


def check(value, schema, where):
    """The part of JSON schema that is used here; nothing beyond what a schema names."""
    kinds = {"object": dict, "array": list, "string": str, "integer": int, "number": (int, float), "null": type(None)}
    wanted = schema["type"] if isinstance(schema["type"], list) else [schema["type"]]
    assert any(isinstance(value, kinds[kind]) for kind in wanted), (where, value)
    if isinstance(value, dict) and "properties" in schema:
        assert set(schema["required"]) <= set(value), where
        for name, inner in schema["properties"].items():
            check(value[name], inner, f"{where}.{name}")
    if isinstance(value, list):
        assert schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", 10**6), where
        for item in value:
            check(item, schema["items"], f"{where}[]")
    if "minimum" in schema:
        assert schema["minimum"] <= value <= schema.get("maximum", 2**63), where


def test_the_schemas_have_the_published_names_and_fields():
    assert {f"foxglove.{name}" for name in PUBLISHED} == set(SCHEMAS) - {"shortfinal.Result"}
    for name, fields in PUBLISHED.items():
        properties = SCHEMAS[f"foxglove.{name}"]["properties"]
        assert set(properties) == set(fields.split()), name
        for inner in set(properties) & set(PUBLISHED_WITHIN):
            schema = properties[inner].get("items", properties[inner])
            assert set(schema["properties"]) == set(PUBLISHED_WITHIN[inner].split()), inner


def test_a_flight_reads_back_as_its_schemas_say(tmp_path):
    frames = [
        (result(0.0, track=track(0.0)), picture()),
        (result(1 / 3, Decision.DO_NOT_USE, track=track(1 / 3)), picture()),
        (result(0.5, Decision.NOT_MONITORED, track=track(0.5, TrackState.LOST)), picture()),
        (result(0.75), None),
    ]
    path = written(tmp_path, *frames)
    messages = read(path)
    assert {topic for topic, *_ in messages} == set(TOPICS)
    for topic, schema, _, message in messages:
        assert schema == TOPICS[topic]
        check(message, SCHEMAS[schema], topic)
        if schema != "shortfinal.Result":
            assert set(message) == set(SCHEMAS[schema]["properties"])
    assert sorted({time for _, _, time, _ in messages}) == [0, 333_333_333, 500_000_000, 750_000_000]
    assert of(messages, "/camera/image")[1]["timestamp"] == {"sec": 0, "nsec": 333_333_333}
    assert len(of(messages, "/camera/image")) == len(of(messages, "/camera/calibration")) == 3
    records = of(messages, "/result")
    assert [r["frame"] for r in records] == [0, 1, 2, 3]
    assert [r["decision"] for r in records] == ["use", "do-not-use", "not-monitored", "use"]
    assert [r["track"] and r["track"]["state"] for r in records] == ["tracking", "tracking", "lost", None]
    assert records[0]["position_m"] == frames[0][0].to_dict()["position_m"]
    with path.open("rb") as file:
        reader = make_reader(file)
        assert reader.get_summary().statistics.message_count == len(messages)
        assert all(s.encoding == "jsonschema" for s in reader.get_summary().schemas.values())
        assert all(c.message_encoding == "json" for c in reader.get_summary().channels.values())
        (metadata,) = reader.iter_metadata()
    assert json.loads(metadata.metadata["camera"])["fx"] == 1200.0
    assert json.loads(metadata.metadata["runway"])["corners_m"] == RUNWAY.corners.tolist()


def test_poses_are_those_of_camera_and_body_in_the_runway_frame(tmp_path):
    messages = read(written(tmp_path, (result(track=track()), None)))
    (transform,), (pose,) = of(messages, "/tf"), of(messages, "/pose/track")
    yaw, pitch, roll = POSE.attitude
    # Forward, left, up: the aviation angles turn about -z, -y and x.
    body = Rotation.from_euler("ZYX", [-yaw, -pitch, roll], degrees=True)
    assert (transform["parent_frame_id"], transform["child_frame_id"], pose["frame_id"]) == (
        "runway",
        "camera",
        "runway",
    )
    assert list(transform["translation"].values()) == list(pose["pose"]["position"].values()) == [-1200.0, 30.0, 70.0]
    given = Rotation.from_quat([pose["pose"]["orientation"][k] for k in "xyzw"])
    assert (given.inv() * body).magnitude() < 1e-9
    camera = Rotation.from_quat([transform["rotation"][k] for k in "xyzw"])
    for of_camera, of_body in (([0, 0, 1], [1, 0, 0]), ([1, 0, 0], [0, -1, 0]), ([0, 1, 0], [0, 0, -1])):
        np.testing.assert_allclose(camera.apply(of_camera), body.apply(of_body), atol=1e-9)


def test_a_refused_frames_pose_is_kept_apart_from_the_tracks(tmp_path):
    elsewhere = sf.Pose.from_attitude([-1150.0, 0.0, 60.0])
    messages = read(written(tmp_path, (result(decision=Decision.DO_NOT_USE, track=track(pose=elsewhere)), None)))
    assert of(messages, "/pose/track")[0]["pose"]["position"]["x"] == -1150.0
    assert of(messages, "/pose/frame")[0]["pose"]["position"]["x"] != -1150.0
    assert of(messages, "/tf")[0]["translation"]["x"] == -1150.0


def test_picture_calibration_and_outline_fit_together(tmp_path):
    messages = read(written(tmp_path, (result(), picture())))
    (image,), (calibration,) = of(messages, "/camera/image"), of(messages, "/camera/calibration")
    small = cv2.imdecode(np.frombuffer(base64.b64decode(image["data"]), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert image["format"] == "jpeg"
    assert small.shape == (540, 960, 3) == (calibration["height"], calibration["width"], 3)
    expected = cv2.resize(picture(), (960, 540), interpolation=cv2.INTER_AREA)
    assert np.abs(small.astype(int) - expected).mean() < 2  # of 255: JPEG
    k = calibration["K"]
    seen = sf.Camera(960, 540, k[0], k[4], k[2], k[5])
    outline, *ellipses = of(messages, "/camera/annotations")[0]["points"]
    assert outline["type"] == 2
    drawn = np.array([[p["x"], p["y"]] for p in outline["points"]])
    # The picture's own camera sees the corners there; Foxglove counts half a pixel more. To the 1/1000 px written.
    np.testing.assert_allclose(drawn, sf.project(seen, POSE, RUNWAY.corners) + 0.5, atol=2e-3)
    assert len(ellipses) == 4
    around = np.array([[p["x"], p["y"]] for p in ellipses[2]["points"]])
    # Two sigma of half a pixel each, three quarters as large.
    np.testing.assert_allclose(np.linalg.norm(around - drawn[2], axis=1), 0.75, atol=2e-3)


@pytest.mark.parametrize(
    ("distortion", "model", "count"),
    [((), "plumb_bob", 5), ((0.1, 0.01, 1e-3, 2e-3), "plumb_bob", 5), ((0.1,) * 5, "plumb_bob", 5),
     ((0.1,) * 8, "rational_polynomial", 8)],
)  # fmt: skip
def test_the_lens_is_named_as_foxglove_knows_it(tmp_path, distortion, model, count):
    camera = sf.Camera(1280, 720, 1200.0, 1200.0, 639.5, 359.5, distortion)
    (calibration,) = of(read(written(tmp_path, (result(), picture()), camera=camera)), "/camera/calibration")
    assert calibration["distortion_model"] == model
    assert calibration["D"] == [*distortion, *[0.0] * (count - len(distortion))]


@pytest.mark.parametrize(
    ("width", "height", "size"), [(640, 480, (640, 480)), (1920, 1080, (960, 540)), (5000, 1, (960, 1))]
)
def test_pictures_are_reduced_but_never_magnified(width, height, size):
    window = reduced(sf.Camera(width, height, 500.0, 500.0, 0.0, 0.0))
    assert (window.out_width, window.out_height) == size


def test_a_kill_leaves_all_but_the_last_half_second(tmp_path):
    path = tmp_path / "flight.mcap"
    script = "sink = McapSink(sys.argv[1], CAMERA, RUNWAY)"
    done = survivor("from shortfinal.stream.mcap import McapSink", script, path, 3 * FLUSHED + 5)
    numbers = []
    with path.open("rb") as file, pytest.raises(EndOfFile):
        topics = {}
        for record in StreamReader(file).records:
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message) and topics[record.channel_id] == "/result":
                numbers.append(json.loads(record.data)["frame"])
    assert numbers == list(range(len(numbers)))
    assert len(numbers) >= done - FLUSHED >= 2 * FLUSHED


def test_an_error_in_flight_leaves_a_whole_file(tmp_path):
    path = tmp_path / "flight.mcap"
    with pytest.raises(KeyboardInterrupt), McapSink(path, CAMERA, RUNWAY) as sink:
        sink.write(0, result())
        raise KeyboardInterrupt
    assert len(of(read(path), "/result")) == 1


def test_what_cannot_be_written_is_one_clear_line(tmp_path):
    with pytest.raises(InputError, match=r"flight\.mcap: cannot be written: No such file or directory$"):
        McapSink(tmp_path / "nowhere" / "flight.mcap", CAMERA, RUNWAY)
    with McapSink(tmp_path / "flight.mcap", CAMERA, RUNWAY) as sink:
        with pytest.raises(InputError, match=r"^frame 7: timestamp_s is -1\.0; MCAP knows no time before 0$"):
            sink.write(7, result(-1.0))
        sink.write(8, result(0.0))
    assert [r["frame"] for r in of(read(tmp_path / "flight.mcap"), "/result")] == [8]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's device that is always full")
def test_a_full_disk_is_one_clear_line():
    sink = McapSink("/dev/full", CAMERA, RUNWAY)
    frame = result()
    with pytest.raises(InputError, match=r"^/dev/full: cannot be written: No space left on device$"):
        for number in range(FLUSHED):
            sink.write(number, frame)
    with pytest.raises(InputError, match="frame 99 comes after"):
        sink.write(99, frame)
    sink.close()
    with pytest.raises(InputError, match="No space left"), McapSink("/dev/full", CAMERA, RUNWAY) as short:
        short.write(0, frame)


def test_without_mcap_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    with pytest.raises(InputError, match=r"pip install 'shortfinal\[mcap\]'"):
        McapSink(tmp_path / "flight.mcap", CAMERA, RUNWAY)
    assert not (tmp_path / "flight.mcap").exists()
