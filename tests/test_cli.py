"""Wrong input is one line that names what is wrong, exit status 2, and nothing half-written."""

import json
import shutil
import sys

import cv2
import numpy as np
import pytest

import shortfinal as sf
from shortfinal.cli import main
from shortfinal.crops import box_around
from shortfinal.data.dataset import read_dataset
from shortfinal.data.formats import open_dataset
from shortfinal.demo import CAMERA, RUNWAY, approach_pose, demo_scene, render_frame

CORNERS = sf.project(CAMERA, approach_pose(60), RUNWAY.corners)
CAMERA_FIELDS = {"width": 960, "height": 720, "fx": CAMERA.fx, "fy": CAMERA.fy, "cx": CAMERA.cx, "cy": CAMERA.cy}
PROBLEM = {
    "camera": CAMERA_FIELDS,
    "runway": {"length_m": RUNWAY.length_m, "width_m": RUNWAY.width_m},
    "keypoints_px": CORNERS.tolist(),
    "sigma_px": 0.5,
}


def call(capsys, *arguments):
    """Exit status, standard output, standard error."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["shortfinal", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
    out, err = capsys.readouterr()
    return end.value.code or 0, out, err


def refused(capsys, *arguments):
    """The one line of a refusal."""
    status, out, err = call(capsys, *arguments)
    assert status == 2
    assert "Traceback" not in out + err
    assert err.startswith("shortfinal: ")
    assert err.count("\n") == 1
    return err


@pytest.fixture(scope="module")
def pictures():
    """Two frames of the demo."""
    scene = demo_scene()
    return {number: render_frame(scene, number) for number in (60, 80)}


@pytest.fixture
def folder(tmp_path, pictures):
    """Two frames with boxes, and their camera."""
    lines = ["image,left,top,right,bottom"]
    for number, picture in pictures.items():
        cv2.imwrite(str(tmp_path / f"{number}.png"), picture[..., ::-1])
        box = box_around(sf.project(CAMERA, approach_pose(number), RUNWAY.corners))
        lines.append(f"{number}.png," + ",".join(f"{v:.1f}" for v in box))
    (tmp_path / "labels.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "camera.toml").write_text("\n".join(f"{k} = {v}" for k, v in CAMERA_FIELDS.items()))
    return tmp_path


def run_arguments(folder):
    return ("run", folder, "--camera", folder / "camera.toml", "--size", "1500x45", "--out", folder / "out")


def problem_file(tmp_path, **changes):
    path = tmp_path / "problem.json"
    path.write_text(json.dumps(PROBLEM | changes))
    return path


def test_run_over_a_folder(folder, capsys):
    status, out, _ = call(capsys, *run_arguments(folder), "--json")
    assert status == 0
    assert json.loads(out)["decisions"]["use"] == 2
    lines = [json.loads(line) for line in (folder / "out" / "frames.jsonl").read_text().splitlines()]
    assert [line["image"] for line in lines] == ["60.png", "80.png"]
    for line, number in zip(lines, (60, 80)):
        error = np.array(line["position_m"]) - approach_pose(number).position_m
        assert abs(error / np.sqrt(np.diag(line["pose_cov"])[:3])).max() < 4
    assert cv2.imread(str(folder / "out" / "contact_sheet.png")) is not None
    assert not list((folder / "out").glob("*partial*"))


def test_a_survey_that_is_in_doubt_leaves_more_doubt(folder, frames, tmp_path, capsys):
    def widths(*arguments):
        assert call(capsys, *arguments, "--out", tmp_path / "out", "--json")[0] == 0
        lines = [json.loads(line) for line in (tmp_path / "out" / "frames.jsonl").read_text().splitlines()]
        corners = [line["keypoints_cov_px"] for line in lines]
        return np.array([np.diag(line["pose_cov"])[:3] for line in lines]), corners

    labelled = ("run", frames, "--labels", frames / "lard.csv", "--runways", frames / "runways.json")
    for arguments in (run_arguments(folder), labelled):
        (sharp, seen), (wide, again) = widths(*arguments), widths(*arguments, "--survey-sigma", "2")
        assert (wide > sharp).all()
        assert seen == again  # what the camera saw is what it was
    assert "survey_sigma_m is -1.0" in refused(capsys, *run_arguments(folder), "--survey-sigma=-1")
    runway = {"length_m": RUNWAY.length_m, "width_m": RUNWAY.width_m}
    cov = [
        json.loads(call(capsys, "solve", problem_file(tmp_path, runway=runway | more), "--json")[1])["cov"]
        for more in ({}, {"survey_sigma_m": 2.0})
    ]
    assert (np.diag(cov[1]) > 1.1 * np.diag(cov[0])).all()


def test_run_prints_a_table_for_people(folder, capsys):
    status, out, _ = call(capsys, *run_arguments(folder))
    assert status == 0
    assert "2 frames: 2 use" in out


def test_solve(tmp_path, capsys):
    status, out, _ = call(capsys, "solve", problem_file(tmp_path), "--json")
    assert status == 0
    record = json.loads(out)
    assert record["position_m"] == pytest.approx(approach_pose(60).position_m, abs=1e-5)
    assert record["decision"] == "use"
    assert record["excluded"] == []
    assert record["levels"]["vertical_m"] > 2 * record["cov"][2][2] ** 0.5
    assert call(capsys, "solve", problem_file(tmp_path))[0] == 0


def test_three_corners_are_solved_but_not_monitored(tmp_path, capsys):
    changes = {"keypoints_px": CORNERS[:3].tolist(), "points_m": RUNWAY.corners[:3].tolist()}
    status, out, _ = call(capsys, "solve", problem_file(tmp_path, **changes), "--json")
    assert status == 0
    assert json.loads(out)["decision"] == "not-monitored"


POSE = approach_pose(60)
# What the other sensors would say of that pose: three rows each for attitude and position, one, and four.
SENSORS = {
    "attitude_prior": {**POSE.attitude._asdict(), "sigma_deg": 0.05},
    "position_prior": {"position_m": POSE.position_m.tolist(), "sigma_m": [5, 2, 2]},
    "altitude": {"height_m": POSE.position_m[2], "sigma_m": 0.5},
    "lines": {
        "rho_px": sf.project_lines(CAMERA, POSE, RUNWAY.edges)[:, 0].tolist(),
        "theta_deg": np.degrees(sf.project_lines(CAMERA, POSE, RUNWAY.edges)[:, 1]).tolist(),
        "sigma_px": 0.5,
        "sigma_deg": 0.1,
    },
}


@pytest.mark.parametrize(
    ("name", "rows"), [("attitude_prior", 3), ("position_prior", 3), ("altitude", 1), ("lines", 4)]
)
def test_solve_with_other_sensors(tmp_path, capsys, name, rows):
    _, plain, _ = call(capsys, "solve", problem_file(tmp_path), "--json")
    status, out, _ = call(capsys, "solve", problem_file(tmp_path, **{name: SENSORS[name]}), "--json")
    record, without = json.loads(out), json.loads(plain)
    assert status == 0
    assert record["dof"] == 2 + rows
    assert record["position_m"] == pytest.approx(POSE.position_m, abs=1e-4)
    assert np.trace(record["cov"]) < np.trace(without["cov"])


COLLINEAR = [[100.0 + 50 * k, 300.0 + 10 * k] for k in range(4)]
NEGATIVE = np.diag([1.0, 1, 1, -1, 1, 1, 1, 1]).tolist()
SKEW = (np.eye(8) + np.diag([0.5] * 7, 1)).tolist()
BEHIND = [[-5000.0, 22.5, 300], [-5000, -22.5, 300], [-7000, -22.5, 300], [-7000, 22.5, 300]]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"keypoints_px": CORNERS[:2].tolist(), "points_m": RUNWAY.corners[:2].tolist()}, "at least three"),
        ({"keypoints_px": COLLINEAR}, "all lie on one line"),
        ({"points_m": [[1000.0 * k, 0, 0] for k in range(4)]}, "no pose"),
        ({"keypoints_px": (CORNERS * [1, -1] + [0, 720]).tolist()}, "no pose"),
        ({"sigma_px": 0}, "keypoint 0 u is 0"),
        ({"sigma_px": -0.5}, "keypoint 0 u is -0.5"),
        ({"cov_px": NEGATIVE}, "variance of keypoint 1 v is -1"),
        ({"cov_px": SKEW}, "not symmetric"),
        ({"keypoints_px": [[1.0, float("nan")], *CORNERS[1:].tolist()]}, r"mean_px: entry \[0, 1\] is nan"),
        ({"keypoints_px": "corners"}, "mean_px: expected"),
        ({"camera": {"width": 9}}, "camera: "),
        ({"camera": CAMERA_FIELDS | {"fx": -3}}, "must be positive"),
        ({"camera": CAMERA_FIELDS | {"fx": "wide"}}, "camera"),
        ({"runway": {"length_m": -5, "width_m": 45}}, "length_m is -5"),
        ({"points_m": [["a", 0, 0]] * 4}, "points"),
        ({"runway": 7}, "runway: expected an object"),
        ({"camera": CAMERA_FIELDS | {"zoom": 2}}, "camera: expected an object"),
        ({"camera": CAMERA_FIELDS | {"distortion": "abcd"}}, "camera: distortion"),
        ({"camera": CAMERA_FIELDS | {"fx": 10**400}}, "camera: fx"),
        ({"camera": CAMERA_FIELDS | {"width": float("nan")}}, "camera: width"),
        ({"points_m": [[1, 2, 3], [1, 2]]}, "points_m: expected"),
        ({"keypoints_px": [[10**400, 1], *CORNERS[1:].tolist()]}, "mean_px: expected numbers"),
        ({"keypoints_px": (CORNERS * 1e150).tolist()}, "no pixel of any camera"),
        ({"runway": {"length_m": 1e300, "width_m": 45}}, "length_m is 1e\\+300"),
        ({"altitude": {"height_m": 80}}, "altitude: expected an object with height_m, sigma_m"),
        ({"altitude": {"height_m": 80, "sigma_m": 0}}, "sigma_m is 0"),
        ({"attitude_prior": SENSORS["attitude_prior"] | {"sigma_deg": [0.1, 0.1, -0.0]}}, "attitude_prior"),
        ({"attitude_prior": SENSORS["attitude_prior"] | {"sigma_deg": [0.1, 0.1]}}, "attitude_prior: sigma"),
        (
            {"position_prior": SENSORS["position_prior"], "altitude": {"height_m": 900, "sigma_m": 1}},
            "contradict|apart",
        ),
        ({"lines": SENSORS["lines"] | {"theta_deg": [1.0]}}, "2 rho_px for 1 theta_deg"),
        ({"lines": SENSORS["lines"] | {"slope": 1}}, "lines: expected an object"),
    ],
)
def test_problems_that_are_none(tmp_path, capsys, changes, message):
    err = refused(capsys, "solve", problem_file(tmp_path, **changes))
    assert "problem.json" in err
    import re

    assert re.search(message, err), err


def test_points_behind_the_camera(tmp_path, capsys):
    # Left and right exchanged: only a camera behind the image, or under the ground, sees it so.
    mirrored = CORNERS[[1, 0, 3, 2]].tolist()
    err = refused(capsys, "solve", problem_file(tmp_path, keypoints_px=mirrored))
    assert "no pose" in err
    assert "behind" in err


def test_files_that_are_missing_or_not_what_they_should_be(folder, capsys):
    assert "no such folder" in refused(capsys, "run", folder / "nowhere")
    assert "cannot read the problem" in refused(capsys, "solve", folder / "absent.json")
    (folder / "text.json").write_text("{")
    assert "not a JSON file" in refused(capsys, "solve", folder / "text.json")
    (folder / "list.json").write_text("[]")
    assert "expected a JSON object" in refused(capsys, "solve", folder / "list.json")
    assert "cannot read the labels" in refused(
        capsys, "audit", folder / "absent.csv", "--runways", folder / "labels.csv"
    )
    assert "no column" in refused(capsys, "audit", folder / "labels.csv", "--runways", folder / "labels.csv")
    assert "no such model" in refused(capsys, *run_arguments(folder), "--model", folder / "absent.onnx")
    assert "not an ONNX model" in refused(capsys, *run_arguments(folder), "--model", folder / "labels.csv")
    (folder / "file").write_text("")
    arguments = [*run_arguments(folder)[:-1], folder / "file"]
    assert "cannot make the output folder" in refused(capsys, *arguments)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("60.png,nan,1,5,5", "line 2: left is 'nan'"),
        ("60.png,a,1,5,5", "line 2: left is 'a'"),
        ("60.png,9,1,5,5", "line 2: the box must have"),
        ("60.png,1,1,5", "line 2: 4 cells under 5 columns"),
        ("60.png,1,1,5,5,5", "line 2: 6 cells under 5 columns"),
        ("61.png,1,1,5,5", "line 2: image '61.png' is not in"),
        (",1,1,5,5", "line 2: image '' is not in"),
    ],
)
def test_box_files(folder, capsys, line, message):
    (folder / "labels.csv").write_text(f"image,left,top,right,bottom\n{line}\n")
    err = refused(capsys, *run_arguments(folder))
    assert "labels.csv" in err
    assert message in err
    assert not (folder / "out" / "frames.jsonl").exists()


def test_a_column_twice(folder, capsys):
    (folder / "labels.csv").write_text("image, left, top, right, bottom, left\n60.png,1,1,5,5,2\n")
    assert "column 'left' stands there twice" in refused(capsys, *run_arguments(folder))


def test_a_truncated_jpeg(folder, capsys):
    picture = cv2.imread(str(folder / "80.png"))
    cv2.imwrite(str(folder / "80.jpg"), picture)
    (folder / "80.jpg").write_bytes((folder / "80.jpg").read_bytes()[:20_000])
    (folder / "labels.csv").write_text((folder / "labels.csv").read_text().replace("80.png", "80.jpg"))
    assert "80.jpg: truncated JPEG" in refused(capsys, *run_arguments(folder))


def test_an_unreadable_picture_leaves_nothing_behind(folder, capsys):
    (folder / "80.png").write_bytes((folder / "80.png").read_bytes()[:40])
    assert "80.png: cannot be read as an image" in refused(capsys, *run_arguments(folder))
    assert list((folder / "out").iterdir()) == []


def test_a_picture_of_another_size(folder, capsys):
    cv2.imwrite(str(folder / "80.png"), np.zeros((10, 20, 3), np.uint8))
    assert "80.png: 20 x 10 pixels, but the camera has 960 x 720" in refused(capsys, *run_arguments(folder))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("width = 960", "lacks height"),
        ("width = [", "not a TOML file"),
        (None, "cannot read the camera"),
        ("width=960\nheight=720\nfx=1.0\nfy=-1.0\ncx=0\ncy=0", "must be positive"),
        ("width=960\nheight=720\nfx='a'\nfy=1.0\ncx=0\ncy=0", "fx is 'a'"),
        ("width=960.5\nheight=720\nfx=1.0\nfy=1.0\ncx=0\ncy=0", "width is 960.5; it must be a whole number"),
        ("width=960\nheight=720\nfx=1.0\nfy=1.0\ncx=0\ncy=0\nzoom=2", "unknown field 'zoom'"),
        ("width=960\nheight=720\nfx=1.0\nfy=1.0\ncx=0\ncy=0\ndistortion=3", "distortion is 3"),
        ("width=960\nheight=720\nfx=1.0\nfy=1.0\ncx=0\ncy=0\ndistortion=[1,2]", "2 coefficients"),
    ],
)
def test_camera_files(folder, capsys, text, message):
    (folder / "camera.toml").unlink()
    if text is not None:
        (folder / "camera.toml").write_text(text)
    err = refused(capsys, *run_arguments(folder))
    assert "camera.toml" in err
    assert message in err


def test_runways_that_are_unknown(folder, capsys, monkeypatch):
    monkeypatch.delenv("SHORTFINAL_RUNWAYS", raising=False)
    base = ("run", folder, "--camera", folder / "camera.toml", "--out", folder / "out")
    assert "no runway; pass --runway" in refused(capsys, *base)
    assert "no runway database" in refused(capsys, *base, "--runway", "LFPO/24")
    (folder / "runways.json").write_text('{"LFPO": {"06": {}}}')
    err = refused(capsys, *base, "--runway", "LFPO/24", "--runways", folder / "runways.json")
    assert "unknown runway 'LFPO/24'; nearest: LFPO/06" in err
    assert "--size: '2000'" in refused(capsys, *base, "--size", "2000")


def test_an_option_that_does_not_exist(capsys):
    assert "--speed" in refused(capsys, "demo", "--speed", "3")
    assert "COUNT" in refused(capsys, "data", "render").upper()
    assert call(capsys, "--help")[0] == 0


LENS = "width = 96\nheight = 96\nfx = 133.4\nfy = 123.3\ncx = 47.5\ncy = 47.5\ndistortion = [-0.1, 0.02, 0.0, 0.0]\n"


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Four whole frames with their labels, by the command."""
    folder = tmp_path_factory.mktemp("frames")
    (folder / "lens.toml").write_text(LENS)
    with pytest.MonkeyPatch.context() as patch:
        command = [
            "data",
            "render",
            "--count",
            "4",
            "--seed",
            "6",
            "--camera",
            folder / "lens.toml",
            "--out",
            folder / "set",
        ]
        patch.setattr(sys, "argv", ["shortfinal", *map(str, command)])
        with pytest.raises(SystemExit):
            main()
    return folder / "set"


def test_rendered_frames_are_fit_to_train_on(frames, tmp_path, capsys):
    status, out, err = call(capsys, "data", "check", frames, "--out", tmp_path, "--json")
    report = json.loads(out)
    assert status == 0, err
    assert report["pictures"] == report["labels"] == 4
    written = {p.name for p in tmp_path.iterdir()}
    assert written == {"check.json", "problems.csv", "check.png", "contact_sheet.png"}


def test_a_data_set_with_problems_ends_with_1(frames, tmp_path, capsys):
    broken = tmp_path / "set"
    shutil.copytree(frames, broken)
    (broken / "images" / "000002.png").write_bytes(b"not a picture")
    status, _, err = call(capsys, "data", "check", broken, "--out", tmp_path / "out", "--json")
    assert status == 1
    assert "1 image" in err
    assert "000002.png" in (tmp_path / "out" / "problems.csv").read_text()
    assert "not a data set" in refused(capsys, "data", "check", tmp_path / "out", "--out", tmp_path / "out2")


def test_frames_in_the_formats_of_others(frames, tmp_path, capsys):
    truth = [example.corners_px for example in read_dataset(frames)]
    for to in ("coco", "yolo"):
        status, out, err = call(capsys, "data", "convert", frames, tmp_path / to, "--to", to, "--json")
        assert status == 0, err
        assert json.loads(out)["labels"] == 4
        there = open_dataset(tmp_path / to)
        assert there.format.lower().startswith(to)
        for picture, corners in zip(sorted(there.pictures, key=lambda p: p.name), truth, strict=True):
            np.testing.assert_allclose(picture.labels[0].corners_px, corners, atol=1e-5)
    assert "--split" in refused(capsys, "data", "convert", frames, tmp_path / "x", "--to", "coco", "--split", "most")


def test_the_audit_reads_rendered_frames(frames, tmp_path, capsys):
    status, out, _ = call(
        capsys, "audit", frames / "lard.csv", "--runways", frames / "runways.json", "--out", tmp_path, "--json"
    )
    assert status == 0
    report = json.loads(out)
    assert (report["labels"], report["contradicting"], report["not_checked"]) == (4, 0, 0)


def test_a_bad_row_is_told_and_the_rest_is_run(frames, tmp_path, capsys):
    lines = (frames / "lard.csv").read_text().splitlines()
    column = lines[0].split(";").index("x_TL")
    cells = lines[2].split(";")
    lines[2] = ";".join([*cells[:column], "left", *cells[column + 1 :]])
    (tmp_path / "labels.csv").write_text("\n".join(lines))
    arguments = ["run", frames, "--labels", tmp_path / "labels.csv", "--runways", frames / "runways.json"]
    status, out, err = call(capsys, *arguments, "--out", tmp_path / "out")
    assert status == 0, err
    assert "line 3: x_TL is 'left'" in " ".join(out.split())
    status, out, _ = call(capsys, *arguments, "--out", tmp_path / "out", "--json")
    assert json.loads(out)["frames"] == 3
    assert json.loads(out)["rows_refused"] == 1
