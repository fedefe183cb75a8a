"""The replay page and the live view: what they read, and what they show, in a headless browser."""

import base64
import json
import math
import socket
import time
import urllib.error
import urllib.request

import cv2
import numpy as np
import pytest

import shortfinal as sf
from shortfinal.errors import InputError
from shortfinal.protection import GLIDE_PATH_ORIGIN_M
from shortfinal.view.live import QUEUE, LiveView
from shortfinal.view.page import DECISIONS, full_scale_deg, row_of, write_replay

CAMERA = sf.Camera(640, 480, 1300.0, 1300.0, 319.5, 239.5, (-0.1, 0.02, 0.001, -0.001))
RUNWAY = sf.Runway(1500.0, 45.0, "TEST/09")
FRAMES, STEP_S, BEGIN_S = 120, 0.1, 1000.0
END_M = RUNWAY.length_m
SIGMA_PX = 0.3
LIMITS = {"along_m": 40.0, "cross_m": 40.0, "vertical_m": 35.0}
FAULTY, BLIND = range(40, 50), range(70, 77)  # one corner locked elsewhere; nothing seen
FLIGHT = {
    "format": 1, "source": "approach.mp4",
    "camera": {"width": 640, "height": 480, "fx": 1300.0, "fy": 1300.0, "cx": 319.5, "cy": 239.5,
               "distortion": list(CAMERA.distortion)},
    "runway": {"ident": RUNWAY.ident, "length_m": 1500.0, "width_m": 45.0, "corners_m": RUNWAY.corners.tolist()},
    "model": {"name": "runway.onnx", "sha256": "0123456789abcdef" * 4},
    "settings": {"false_alarm_rate": 1e-3, "integrity_risk": 1e-7, "fault_prior": 1e-4},
    "alert_limits": LIMITS, "stages": {"detect": {"p50": 11.0, "p95": 13.0, "p99": 19.5}},
    "dropped": 2, "budget_ms": 33.0, "misses": 1,
}  # fmt: skip


def pose_at(n, frames=FRAMES):
    t = n / max(frames - 1, 1)
    x = -2500.0 + 2300.0 * t
    z = (GLIDE_PATH_ORIGIN_M - x) * math.tan(math.radians(3.0)) + 6 * math.sin(9 * t)
    return sf.Pose.from_attitude([x, 12 * math.sin(7 * t), z], 0.8 * math.sin(5 * t), -3.2, 3 * math.sin(6 * t))


def record_of(n, rng, frames=FRAMES):
    """A frame of a simulated approach, as `shortfinal run` writes it, with track and truth."""
    truth = pose_at(n, frames)
    timings = {"detect_ms": 11 + rng.random(), "solve_ms": 0.2}
    record = {"frame": n, "timestamp_s": BEGIN_S + n * STEP_S, "timings": timings}
    if n in BLIND:
        record |= {
            "decision": "not-monitored", "reasons": ["no runway in view (its probability is 0.02)"], "statistic": None,
            "p_value": None, "dof": 0, "present": 0.02, "crop": [200.0, 150.0, 90.0, 90.0],
        }  # fmt: skip
    else:
        px = sf.project(CAMERA, truth, RUNWAY.corners)
        sigma = SIGMA_PX * np.array([[1.0, 0.6], [1.2, 0.6], [0.8, 0.5], [0.8, 0.5]])
        seen = px + sigma * rng.normal(size=(4, 2))
        if n in FAULTY:
            seen[1] += [14.0, 3.0]
        cov = np.diag(sigma.ravel() ** 2)
        cov[0, 1] = cov[1, 0] = 0.5 * sigma[0, 0] * sigma[0, 1]
        keypoints = sf.GaussianKeypoints(seen, cov)
        estimate = sf.estimate_pose(keypoints, RUNWAY.corners, CAMERA)
        verdict = sf.check_integrity(estimate)
        levels = sf.protection_levels(estimate, integrity_risk=1e-4)
        low, high = px.min(axis=0), px.max(axis=0)
        side = 1.4 * (high - low).max()
        record |= {
            "decision": verdict.decision.value, "reasons": list(verdict.reasons), "statistic": verdict.statistic,
            "p_value": verdict.p_value, "dof": verdict.dof, "present": 0.999,
            "crop": [*((low + high) / 2 - side / 2), side, side],
            "keypoints_px": keypoints.mean_px.tolist(), "keypoints_cov_px": keypoints.cov_px.tolist(),
            "status": estimate.status.value, "position_m": estimate.pose.position_m.tolist(),
            "attitude_deg": list(estimate.pose.attitude), "pose_cov": estimate.cov.tolist(),
            "protection": levels.to_dict(),
        }  # fmt: skip
    state = "searching" if n < 5 else "degraded" if n in range(72, 80) else "tracking"
    sigma = np.array([4.0, 0.5, 0.5, 1e-3, 1e-3, 1e-3, 1.0, 0.3, 0.3]) * (1 + 0.3 * max(0, n - 69) * (n in BLIND))
    near = truth.plus(0.5 * rng.normal(size=6) * sigma[:6])
    track = {
        "timestamp_s": record["timestamp_s"], "state": state, "reason": "no measurement yet", "position_m": None,
        "velocity_mps": None, "attitude_deg": None, "cov": None, "taken": False, "innovation_p": None,
        "coasting_s": 0.0,
    }  # fmt: skip
    if n >= 5:
        track |= {
            "reason": f"{state} for a reason", "taken": state == "tracking" and record["decision"] == "use",
            "position_m": near.position_m.tolist(), "attitude_deg": list(near.attitude),
            "cov": np.diag(sigma**2).tolist(),
            "velocity_mps": [70.0, 0.0, -3.7], "innovation_p": rng.random(),
            "coasting_s": 0.1 * max(0, n - 69) * (n in BLIND),
        }  # fmt: skip
    record["track"] = track
    record["truth"] = {"position_m": truth.position_m.tolist(), "attitude_deg": list(truth.attitude)}
    return record


def picture_of(n, frames=FRAMES):
    """Sky, ground and the runway as a grey shape: half the camera's size, JPEG."""
    picture = np.full((480, 640, 3), (70, 110, 80), np.uint8)
    picture[: int(239.5 - 1300 * math.tan(math.radians(3.2)))] = (210, 180, 150)
    px = np.round(sf.project(CAMERA, pose_at(n, frames), RUNWAY.corners)).astype(np.int32)
    cv2.fillPoly(picture, [px], (120, 120, 118))
    return cv2.imencode(".jpg", cv2.resize(picture, (320, 240), interpolation=cv2.INTER_AREA))[1].tobytes()


@pytest.fixture(scope="module")
def records():
    rng = np.random.default_rng(11)
    return [record_of(n, rng) for n in range(FRAMES)]


def write_folder(folder, records, flight=FLIGHT, pictures=True, tail=""):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "flight.json").write_text(json.dumps(flight))
    if pictures:
        (folder / "frames").mkdir(exist_ok=True)
    lines = []
    for record in records:
        if pictures:
            name = f"frames/{record['frame']:06d}.jpg"
            (folder / name).write_bytes(picture_of(record["frame"]))
            record = {**record, "image": name, "image_scale": 0.5}
        lines.append(json.dumps(record) + "\n")
    (folder / "frames.jsonl").write_text("".join(lines) + tail)
    return folder


# --- what is read


def test_deviations_and_their_sigma_are_those_of_the_protection_levels():
    # The levels' own sigma to first order, of the same two angles, is computed by other code.
    truth = sf.Pose.from_attitude([-1200.0, 25.0, 90.0], 0.4, -3.0, 1.0)
    keypoints = sf.GaussianKeypoints.from_sigma(sf.project(CAMERA, truth, RUNWAY.corners), SIGMA_PX)
    estimate = sf.estimate_pose(keypoints, RUNWAY.corners, CAMERA)
    place = {"position_m": estimate.pose.position_m.tolist(), "pose_cov": estimate.cov.tolist()}
    numbers = row_of({"timestamp_s": 1.0, "decision": "use", **place}, RUNWAY.length_m).numbers
    sigma = sf.protection_levels(estimate).sigma
    assert numbers["slateral"] == pytest.approx(sigma.lateral_deg, rel=1e-6)
    assert numbers["svertical"] == pytest.approx(sigma.vertical_deg, rel=1e-6)
    # The estimate is of keypoints without error: the truth, to the solver's tolerance.
    assert numbers["lateral"] == pytest.approx(math.degrees(math.atan2(25.0, 2700.0)), abs=1e-4)
    elevation = math.degrees(math.atan2(90.0, math.hypot(1500.0, 25.0)))
    assert numbers["vertical"] == pytest.approx(elevation - 3.0, abs=1e-4)


def test_two_dots_are_an_ils_receivers_full_scale():
    # 0.155 DDM at 0.00145 a metre: 106.9 m beside the threshold, which the far end sees at 2.04 degrees over 3,000 m
    # and at 4.08 over 1,500 m; but a course sector is 6 degrees wide at most. 0.175 DDM at 0.24 of 3 degrees.
    assert full_scale_deg(3000.0)["lateral"] == pytest.approx(2.0407, abs=1e-4)
    assert 3000.0 * math.tan(math.radians(full_scale_deg(3000.0)["lateral"])) == pytest.approx(106.9, abs=0.05)
    assert full_scale_deg(1500.0) == pytest.approx({"lateral": 3.0, "vertical": 0.72})
    # 25 m left of the line 1,200 m before the threshold: 0.17 of the scale, a third of a dot.
    record = {"timestamp_s": 1.0, "decision": "use", "position_m": [-1200.0, 25.0, 90.0], "attitude_deg": [0, 0, 0]}
    share = row_of(record, 3000.0).numbers["lateral"] / full_scale_deg(3000.0)["lateral"]
    assert share == pytest.approx(25.0 / (4200.0 * 106.9 / 3000.0), rel=1e-3)


def test_a_level_that_cannot_be_given_is_infinite_and_one_that_is_not_there_is_absent():
    record = {"timestamp_s": 1.0, "decision": "use", "protection": {"along_m": None, "cross_m": 3.0}}
    numbers = row_of(record, 1500.0).numbers
    assert numbers["level_along_m"] == math.inf
    assert numbers["level_cross_m"] == 3.0
    del record["protection"]
    assert not any(name.startswith("level_") for name in row_of(record, 1500.0).numbers)


def embedded(path):
    text = path.read_text()
    return json.loads(text[text.index('id="data">') + 10 :].partition("</script>")[0])


def column(content, name):
    return np.frombuffer(base64.b64decode(content["numbers"][name]), "<f8" if name in content["wide"] else "<f4")


def test_every_frame_is_embedded(records, tmp_path):
    content = embedded(write_replay(write_folder(tmp_path, records)))
    assert content["count"] == FRAMES
    assert column(content, "t").tolist() == [r["timestamp_s"] for r in records]
    x = column(content, "x")
    assert np.isnan(x[list(BLIND)]).all()
    assert x[100] == np.float32(records[100]["position_m"][0])
    assert column(content, "k2_uv")[3] == np.float32(records[3]["keypoints_cov_px"][4][5])
    assert content["notes"] == []


def test_a_flight_cut_off_by_a_kill_is_read_as_far_as_it_goes(records, tmp_path):
    cut = json.dumps(records[5])[:-40]
    content = embedded(write_replay(write_folder(tmp_path, records[:5], pictures=False, tail=cut)))
    assert content["count"] == 5
    assert len(content["notes"]) == 1
    assert "in the middle of a line" in content["notes"][0]


USE = '{"timestamp_s": 1, "decision": "use", '
DAMAGE = [
    "{not json}", "[1, 2]", "null", '{"decision": "use"}', '{"timestamp_s": 1, "decision": "maybe"}',
    '{"timestamp_s": NaN, "decision": "use"}', USE + '"position_m": [1, 2]}', USE + '"crop": [1, 2, 3]}',
    USE + '"keypoints_px": [[1, 2]], "keypoints_cov_px": [[1]]}', USE + '"track": {"state": "gone"}}',
    USE + '"image": "../../secret.jpg"}', USE + '"timings": [1]}', "\udcff",
]  # fmt: skip


@pytest.mark.parametrize("line", DAMAGE)
def test_a_damaged_line_is_left_out_counted_and_named(line, records, tmp_path):
    folder = write_folder(tmp_path, records[:3], pictures=False)
    with (folder / "frames.jsonl").open("ab") as file:
        file.write(line.encode("utf-8", "surrogateescape") + b"\n" + json.dumps(records[3]).encode() + b"\n")
    content = embedded(write_replay(folder))
    assert content["count"] == 4
    assert content["notes"] == ["frames.jsonl: 1 damaged lines left out (line 4)."]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda f: f.pop("camera"), "camera is missing"),
        (lambda f: f.update(format=2), "format is 2; this version reads 1"),
        (lambda f: f["camera"].update(fx=0), "camera: width, height, fx and fy must be positive"),
        (lambda f: f["camera"].pop("cy"), "camera: no cy"),
        (lambda f: f["runway"].update(corners_m=[[0, 0, 0]]), r"runway: corners_m: expected shape \(4, 3\)"),
    ],
)
def test_a_flight_that_cannot_be_drawn_is_refused_by_its_field(change, said, records, tmp_path):
    flight = json.loads(json.dumps(FLIGHT))
    change(flight)
    folder = write_folder(tmp_path, records[:3], flight, pictures=False)
    with pytest.raises(InputError, match=rf"flight\.json: {said}"):
        write_replay(folder)
    assert not (folder / "replay.html").exists()


def test_a_folder_without_a_flight_is_refused(records, tmp_path):
    with pytest.raises(InputError, match=r"no flight\.json there; give the folder"):
        write_replay(tmp_path)
    folder = write_folder(tmp_path / "empty", [], pictures=False)
    with pytest.raises(InputError, match="no frame to show: it holds no whole line"):
        write_replay(folder)
    (folder / "frames.jsonl").unlink()
    with pytest.raises(InputError, match=r"no frames\.jsonl there"):
        write_replay(folder)


# --- in a browser


@pytest.fixture
def opened(chromium):
    """Opens a page; fails at the end if anything was wrong with it, or if it asked for what is not its own."""
    wrong, contexts = [], []

    def open_page(url, width=1280, height=800, scheme="light"):
        context = chromium.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
        contexts.append(context)
        page = context.new_page()
        own = ("file:", "data:") if url.startswith(("file:", "about:")) else (url, "data:")
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("console", lambda said: wrong.append(said.text) if said.type in ("error", "warning") else None)
        page.on("request", lambda asked: None if asked.url.startswith(own) else wrong.append(asked.url))
        page.goto(url)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert wrong == []


@pytest.fixture(scope="module")
def replay(records, tmp_path_factory):
    return write_replay(write_folder(tmp_path_factory.mktemp("flight"), records))


def frame_of(page):
    return int(page.get_attribute("#timeline", "aria-valuenow")) - 1


def press(page, *keys):
    for key in keys:
        page.keyboard.press(key)
    return frame_of(page)


def until(page, true, seconds=20):
    """Wait for something of the page; its policy forbids Playwright's own way."""
    deadline = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < deadline, "it did not come"
        page.wait_for_timeout(20)


def number(text):
    return float(text.split("±")[0].replace("✕", "").replace("−", "-").split("/")[0].split()[0])


def check_shown(page, record):
    """The words and figures on the page against the line of frames.jsonl."""
    words = {"use": "USE", "do-not-use": "DO NOT USE", "not-monitored": "NOT MONITORED"}
    parts = ("word", "chip", "reason", "state", "state-reason")
    word, chip, reason, state, state_reason = page.evaluate(
        "ids => ids.map(id => document.getElementById(id).innerText)", parts
    )
    assert word == chip == words[record["decision"]]
    assert reason == "; ".join(record["reasons"])
    assert state == record["track"]["state"].upper()
    assert record["track"]["reason"] in state_reason
    rows = page.evaluate(
        "[...document.querySelectorAll('#rows tr')].map(row => [...row.querySelectorAll('td')].map(c => c.innerText))"
    )
    position, track = record.get("position_m"), record["track"]["position_m"]
    for axis, name in ((0, "along_m"), (2, "vertical_m")):
        own, tracked, level, error = rows[axis]
        for shown, known in ((own, position), (tracked, track)):
            assert shown == "–" if known is None else number(shown) == pytest.approx(known[axis], abs=0.51)
        if "protection" in record:
            # rounded to 0.1 of a single-precision number
            assert number(level) == pytest.approx(record["protection"][name], abs=0.051)
        best = position if track is None else track
        expected = None if best is None else best[axis] - record["truth"]["position_m"][axis]
        assert error == "–" if expected is None else number(error) == pytest.approx(expected, abs=0.051)
    if position is not None:
        assert number(rows[1][0]) == pytest.approx(abs(position[1]), abs=0.051)
        assert rows[1][0].split()[-3 if "±" in rows[1][0] else -1] == ("L" if position[1] >= 0 else "R")
        sigma = math.sqrt(record["pose_cov"][2][2])
        assert float(rows[2][0].split("±")[1]) == pytest.approx(2 * sigma, abs=0.051)
    best = position if track is None else track
    for needle, name in (("loc", "lateral"), ("gs", "vertical")):
        shown = page.evaluate("id => document.getElementById(id).innerText", needle)
        if best is None:
            assert shown.endswith("–")
        else:
            angle = row_of(
                {"timestamp_s": 0.0, "decision": "use", "position_m": best, "attitude_deg": [0, 0, 0]}, END_M
            )
            expected = 2 * abs(angle.numbers[name]) / full_scale_deg(END_M)[name]
            assert float(shown.split("(")[1].split()[0]) == pytest.approx(expected, abs=0.051)


def test_keys_step_through_the_frames_and_the_figures_are_those_of_the_file(opened, replay, records):
    page = opened(replay.as_uri())
    check_shown(page, records[0])
    assert press(page, "ArrowRight") == 1
    check_shown(page, records[1])
    assert press(page, *["Shift+ArrowRight"] * 4, "ArrowRight") == 42
    check_shown(page, records[42])
    assert press(page, "ArrowLeft", "Shift+ArrowLeft") == 31
    check_shown(page, records[31])
    assert press(page, "End", "ArrowRight") == FRAMES - 1
    check_shown(page, records[-1])
    assert press(page, "Home", "ArrowLeft") == 0
    assert press(page, *["Shift+ArrowRight"] * 7, *["ArrowRight"] * 4) == 74
    check_shown(page, records[74])


def test_n_and_p_go_to_the_changes_of_verdict_and_state(opened, replay, records):
    said = [(r["decision"], r["track"]["state"]) for r in records]
    changes = [n for n in range(1, FRAMES) if said[n] != said[n - 1]]
    assert len(changes) == 7  # searching ends; fault and blindness, begin and end; degraded, begin and end
    page = opened(replay.as_uri())
    assert [press(page, "n") for _ in changes] == changes
    assert press(page, "n") == FRAMES - 1
    assert [press(page, "p") for _ in changes] == changes[::-1]
    assert press(page, "p") == 0
    page.click("#next")
    page.click("#forward")
    assert frame_of(page) == changes[0] + 1
    page.click("#back")
    page.click("#previous")
    assert frame_of(page) == 0


def test_clicks_and_drags_on_the_timeline_and_the_charts_scrub(opened, replay, records):
    page = opened(replay.as_uri())
    box = page.locator("#timeline").bounding_box()
    begin = 46  # of the lanes, behind their names
    at = lambda n: box["x"] + begin + n / (FRAMES - 1) * (box["width"] - begin - 1)  # noqa: E731
    page.mouse.click(at(45), box["y"] + 15)
    assert frame_of(page) == 45
    check_shown(page, records[45])
    page.mouse.move(at(10), box["y"] + 15)
    page.mouse.down()
    seen = []
    for n in (20, 60, 100):
        page.mouse.move(at(n), box["y"] + 15, steps=4)
        seen.append(frame_of(page))
    page.mouse.up()
    assert seen == [20, 60, 100]
    page.mouse.move(at(5), box["y"] + 15)  # the button is up: nothing follows
    assert frame_of(page) == 100
    chart = page.locator("#chart-p canvas")
    chart.scroll_into_view_if_needed()
    chart.click(position={"x": 44 + 1, "y": 60})
    assert frame_of(page) == 0
    page.click("#by-distance")
    assert page.locator("#chart-distance").is_hidden()
    page.locator("#chart-height canvas").click(position={"x": 44 + 1, "y": 60})
    assert frame_of(page) == 0
    width = page.locator("#chart-height canvas").bounding_box()["width"]
    page.locator("#chart-height canvas").click(position={"x": width - 9, "y": 60})
    assert frame_of(page) == FRAMES - 1


def test_space_plays_by_the_timestamps_and_stops_at_the_end(opened, replay):
    page = opened(replay.as_uri())
    press(page, *["Shift+ArrowRight"] * 10)
    begin = time.monotonic()
    page.keyboard.press(" ")
    until(page, lambda: frame_of(page) == FRAMES - 1)
    assert time.monotonic() - begin > 1.85  # 19 steps of 0.1 s take 1.9 s, and the browser's clock is rounded
    until(page, lambda: page.get_attribute("#play", "aria-label").startswith("Play"))
    page.keyboard.press(" ")  # from the end: again from the first
    until(page, lambda: 0 < frame_of(page) < FRAMES - 1)
    page.keyboard.press(" ")
    stopped = frame_of(page)
    page.wait_for_timeout(350)
    assert frame_of(page) == stopped


def pixels(page, canvas):
    """What is on a canvas, (h, w, 3), and how many of its pixels make one of the page's."""
    url = page.evaluate("id => document.getElementById(id).toDataURL()", canvas)
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8), cv2.IMREAD_COLOR)
    return picture[..., ::-1].astype(int)


def near_colour(picture, colour, within=230):
    """Centres (n, 2) of the pixels that are more of this colour than of the ground, 460 away."""
    coloured = np.ptp(picture, axis=2) > np.ptp(colour) / 2  # words and borders are grey
    return np.argwhere((np.abs(picture - colour).sum(axis=2) < within) & coloured)[:, ::-1] + 0.5


def test_the_overlay_lies_where_project_puts_it(opened, records, tmp_path):
    # Without pictures, so that the canvas may be read; one layer at a time.
    page = opened(write_replay(write_folder(tmp_path, records, pictures=False)).as_uri())
    press(page, *["Shift+ArrowRight"] * 10)
    layers = ("crop", "outline", "ellipse", "pose", "truth")
    for layer in layers:
        page.uncheck(f"#layer-{layer}")
    page.check("#layer-truth")
    picture = pixels(page, "frame")
    scale = min(picture.shape[1] / CAMERA.width, picture.shape[0] / CAMERA.height)
    border = (np.array(picture.shape[1::-1]) - scale * np.array([CAMERA.width, CAMERA.height])) / 2

    def farthest(points, marked):
        drawn = (np.asarray(points) + 0.5) * scale + border
        apart = np.linalg.norm(drawn[:, None] - marked[None], axis=2)
        return apart.min(axis=1).max(), apart.min(axis=0).max()

    def outline(corners):
        share = np.linspace(0, 1, 401)[:, None]
        return np.vstack([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0))])

    truth = sf.project(CAMERA, pose_at(100), outline(RUNWAY.corners))
    # A line of 1.5 px covers more than half of a pixel only within 0.75 px of it, and half a pixel's
    # diagonal; the near half of a side, 400 points along 1,500 m, has them up to 0.7 px apart.
    near = 0.75 + 0.71 + 0.7
    assert max(farthest(truth, near_colour(picture, (255, 80, 255)))) < near
    page.uncheck("#layer-truth")
    page.check("#layer-outline")
    found = outline(np.array(records[100]["keypoints_px"]))
    assert max(farthest(found, near_colour(pixels(page, "frame"), (64, 220, 110)))) < near
    press(page, "Home", *["Shift+ArrowRight"] * 4)  # the locked corner: in the colour of DO NOT USE
    found = outline(np.array(records[40]["keypoints_px"]))
    assert max(farthest(found, near_colour(pixels(page, "frame"), (255, 72, 60)))) < near
    page.uncheck("#layer-outline")
    assert np.ptp(pixels(page, "frame"), axis=2).max() < 40  # nothing coloured is left
    page.check("#layer-ellipse")
    # The first ellipse: centred on its keypoint, as wide and high as 2 sigma and the line's width.
    marked = near_colour(pixels(page, "zoom"), (255, 236, 110))
    crop, (u, v) = records[40]["crop"], records[40]["keypoints_px"][0]
    found = np.array(records[40]["keypoints_px"])
    low, high = np.minimum(found.min(axis=0), crop[:2]), np.maximum(found.max(axis=0), np.array(crop[:2]) + crop[2:])
    side = 1.06 * (high - low).max()
    zoom = page.locator("#zoom").bounding_box()["width"] / side
    centre = (np.array([u, v]) + 0.5 - ((low + high) / 2 - side / 2)) * zoom
    mine = marked[np.linalg.norm(marked - centre, axis=1) < 4 * SIGMA_PX * zoom]
    assert mine.mean(axis=0) == pytest.approx(centre, abs=0.6)
    sigma = np.sqrt(np.diag(records[40]["keypoints_cov_px"])[:2])
    assert np.ptp(mine, axis=0) == pytest.approx(4 * sigma * zoom, abs=2.5)
    page.uncheck("#layer-ellipse")
    assert len(near_colour(pixels(page, "zoom"), (255, 236, 110))) == 0


def test_the_frames_picture_is_shown(opened, replay):
    page = opened(replay.as_uri())
    for n in (0, 60):
        if n:
            press(page, *["Shift+ArrowRight"] * 6)
        page.wait_for_timeout(300)
        box = page.locator("#frame").bounding_box()
        seen = cv2.imdecode(np.frombuffer(page.screenshot(clip=box), np.uint8), cv2.IMREAD_COLOR)
        given = cv2.imdecode(np.frombuffer(picture_of(n), np.uint8), cv2.IMREAD_COLOR)
        scale = min(box["width"] / CAMERA.width, box["height"] / CAMERA.height)
        left = (box["width"] - scale * CAMERA.width) / 2
        sky, grass = (40, 20), (300, 460)  # of the camera's frame
        for u, v in (sky, grass):
            shown = seen[round(v * scale), round(left + u * scale)].astype(int)
            assert np.abs(shown - given[v // 2, u // 2]).max() < 4


@pytest.mark.parametrize("width", [360, 400, 768])
def test_a_narrow_page_does_not_scroll_sideways(opened, replay, width):
    page = opened(replay.as_uri(), width=width)
    for _ in range(5):
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        press(page, "n")


def test_controls_have_names_and_take_the_focus(opened, replay):
    page = opened(replay.as_uri())
    names = page.evaluate(
        "[...document.querySelectorAll('button, select, canvas')].map(e => e.getAttribute('aria-label') || e.innerText)"
    )
    assert len(names) > 15
    assert all(names)
    page.focus("#timeline")
    assert press(page, "ArrowRight") == 1
    assert page.get_attribute("#timeline", "aria-valuetext") == "frame 1, use, searching"
    page.focus("#play")
    page.keyboard.press("Enter")
    assert page.get_attribute("#play", "aria-label").startswith("Pause")
    page.keyboard.press(" ")  # of the button that has the focus, not of the page as well
    assert page.get_attribute("#play", "aria-label").startswith("Play")


def test_light_and_dark(opened, replay):
    page = opened(replay.as_uri(), scheme="dark")
    ground = "getComputedStyle(document.body).backgroundColor"
    dark = page.evaluate(ground)
    page.click("#theme")
    light = page.evaluate(ground)
    assert [sum(map(int, c[4:-1].split(","))) > 380 for c in (dark, light)] == [False, True]


def test_a_flight_without_track_truth_pictures_or_limits_is_shown(opened, records, tmp_path):
    bare = [{k: v for k, v in r.items() if k not in ("track", "truth")} for r in records[:60]]
    bare[7]["reasons"] = ["</script><script>alert(1)</script> & <b>bold</b>"]
    flight = {"format": 1, "camera": FLIGHT["camera"], "runway": FLIGHT["runway"], "stages": None, "alert_limits": None}
    page = opened(write_replay(write_folder(tmp_path, bare, flight, pictures=False)).as_uri())
    press(page, *["ArrowRight"] * 7)
    assert page.inner_text("#reason") == bare[7]["reasons"][0]
    assert page.locator("#track").is_hidden()
    assert page.locator(".of-truth:visible, .of-track:visible").count() == 0
    press(page, "n")
    assert page.inner_text("#ils-source") == "flagged: not for use"
    assert page.inner_text("#word") == "DO NOT USE"


def test_clocks_that_stall_or_jump_back_leave_every_frame_within_reach(opened, records, tmp_path):
    odd = [dict(r) for r in records[:12]]
    for n, t in enumerate([5.0, 5.1, 5.1, 5.1, 4.0, 4.1, 4.2, 1e9, 1e9 + 0.1, 1e9 + 0.2, 0.0, 0.1]):
        odd[n]["timestamp_s"] = t
    page = opened(write_replay(write_folder(tmp_path, odd, pictures=False)).as_uri())
    assert [press(page, "ArrowRight") for _ in range(11)] == list(range(1, 12))
    still = [dict(r, timestamp_s=3.0) for r in records[:4]]
    page = opened(write_replay(write_folder(tmp_path / "still", still, pictures=False)).as_uri())
    box = page.locator("#timeline").bounding_box()
    page.mouse.click(box["x"] + box["width"] - 2, box["y"] + 15)
    assert frame_of(page) == 3


@pytest.mark.slow
def test_twenty_thousand_frames_open_in_two_seconds(opened, records, tmp_path):
    many = [{**records[n * FRAMES // 20_000], "frame": n, "timestamp_s": n / 30} for n in range(20_000)]
    path = write_replay(write_folder(tmp_path, many, pictures=False))
    assert path.stat().st_size < 12e6
    page = opened("about:blank")
    session = page.context.new_cdp_session(page)
    session.send("Performance.enable", {"timeDomain": "threadTicks"})  # the processor's time: others may be busy too
    page.goto(path.as_uri())
    took = {each["name"]: each["value"] for each in session.send("Performance.getMetrics")["metrics"]}
    assert 0 < took["TaskDuration"] < 2.0
    assert press(page, "End") == 19_999


# --- live


@pytest.fixture
def live():
    view = LiveView(FLIGHT)
    yield view
    view.close()


def fetched(url, host=None):
    request = urllib.request.Request(url, headers={"Host": host} if host else {})
    with urllib.request.urlopen(request, timeout=5) as answer:
        return answer.read()


def test_the_live_page_shows_frames_as_they_come(opened, live, records):
    page = opened(live.url)
    assert page.inner_text("#reason") == "waiting for the first frame"
    for n in (0, 1, 41):
        live.write({**records[n], "image": "frames/000000.jpg"}, picture_of(n))
        until(page, lambda: page.inner_text("#when").startswith(f"frame {n} "))  # noqa: B023, called at once
        check_shown(page, records[n])
    # Looking back holds the page where it is; End follows again.
    assert press(page, "ArrowLeft") == 1
    live.write(records[42], None)
    until(page, lambda: "of 4 " in page.inner_text("#where"))
    assert page.inner_text("#when").startswith("frame 1 ")
    press(page, "End")
    live.write(records[43], picture_of(43))
    until(page, lambda: page.inner_text("#when").startswith("frame 43 "))
    box = page.locator("#frame").bounding_box()
    page.wait_for_timeout(300)
    seen = cv2.imdecode(np.frombuffer(page.screenshot(clip=box), np.uint8), cv2.IMREAD_COLOR)
    sky = seen[20, round(box["width"] / 2)].astype(int)
    assert np.abs(sky - [210, 180, 150]).max() < 4
    live.close()
    until(page, lambda: "The flight has ended" in page.inner_text("#notes"))


def test_a_browser_that_reads_nothing_does_not_hold_up_the_flight(live, records):
    port = int(live.url.rstrip("/").rpartition(":")[2])
    with socket.socket() as stuck:
        stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stuck.connect(("127.0.0.1", port))
        stuck.sendall(b"GET /events HTTP/1.0\r\nHost: 127.0.0.1\r\n\r\n")
        while not live._browsers:
            time.sleep(0.01)
        (waiting,) = live._browsers
        # 6,000 events are some 11 MB: more than a loopback connection buffers, so that its thread does stall.
        longest = 0.0
        for n in range(6000):
            begin = time.perf_counter()
            live.write({**records[n % FRAMES], "frame": n}, None)
            longest = max(longest, time.perf_counter() - begin)
            assert waiting.qsize() <= QUEUE
        assert longest < 2.0  # the socket's patience is 10 s: had a write waited, it would show
        assert waiting.qsize() == QUEUE
        newest = [json.loads(waiting.get()[6:])["numbers"]["frame"] for _ in range(QUEUE)]
        assert newest == list(range(6000 - QUEUE, 6000))


def test_a_browser_that_left_is_forgotten(live, records):
    port = int(live.url.rstrip("/").rpartition(":")[2])
    with socket.create_connection(("127.0.0.1", port)) as gone:
        gone.sendall(b"GET /events HTTP/1.0\r\nHost: localhost\r\n\r\n")
        assert gone.recv(4096).startswith(b"HTTP/1.0 200")
    deadline = time.monotonic() + 20
    while live._browsers and time.monotonic() < deadline:
        live.write(records[0], None)
        time.sleep(0.02)
    assert not live._browsers


def test_only_the_newest_pictures_are_kept_and_only_this_machine_is_answered(live, records):
    for n in range(12):
        live.write(records[n], bytes([n]))
    assert fetched(live.url + "frame/12.jpg") == bytes([11])
    for path, host, status in (("frame/1.jpg", None, 404), ("etc", None, 404), ("", "example.com", 403)):
        with pytest.raises(urllib.error.HTTPError) as refused:
            fetched(live.url + path, host)
        assert refused.value.code == status
        refused.value.close()
    assert b"connect-src 'self'" in fetched(live.url, "localhost:80")


def test_a_port_in_use_and_a_record_that_is_none_are_refused(live):
    port = int(live.url.rstrip("/").rpartition(":")[2])
    with pytest.raises(InputError, match=rf"port {port}: cannot serve the live view"):
        LiveView(FLIGHT, port)
    with pytest.raises(InputError, match="record: not a frame's"):
        live.write({"decision": DECISIONS[0]}, None)
    live.close()
    live.close()
