import csv
import io
import json
from dataclasses import replace
from functools import reduce

import numpy as np
import pymap3d
import pytest
from rich.console import Console
from scipy.stats import binom
from test_lard import EARTH_STUDIO, RUNWAYS, SAMPLE, SWAPS, TEST_SYNTH, V2_HEAD, needs_data, v1_row, v2_row, write

import shortfinal as sf
from shortfinal.audit import Finding, audit_file, audit_labels, render_summary, report_as_dict, write_report
from shortfinal.data.lard import RunwayLabel, read_labels
from shortfinal.runway import lard_database, load_database

CORNERS = sf.Runway(2500, 45).corners
SIGMA_PX = 12**-0.5


def lard_entry(heading_deg=57.0):
    """CORNERS as LARD's database has them, by a route of its own."""
    h = np.radians(heading_deg)
    along, left, up = CORNERS.T
    east, north = along * np.sin(h) - left * np.cos(h), along * np.cos(h) + left * np.sin(h)
    lla = np.column_stack(pymap3d.enu2geodetic(east, north, up, 45.0, 7.0, 200.0))
    keys = ("latitude", "longitude", "altitude")
    return {c: {"coordinate": dict(zip(keys, lla[k]))} for c, k in zip("CDBA", range(4))}


ENTRIES = {"TEST": {"01": lard_entry()}}
DATABASE = lard_database(ENTRIES, "database")
RUNWAY = DATABASE.find("TEST/01")


def approach(rng):
    """A pose of LARD's approach cone, 0.6 to 6 km out, that keeps the runway in the picture."""
    distance = np.exp(rng.uniform(np.log(600), np.log(6000)))
    height = (distance + 305) * np.tan(np.radians(rng.uniform(2.2, 3.8)))
    position = [-distance, distance * np.tan(np.radians(rng.uniform(-3, 3))), height]
    return sf.Pose.from_attitude(position, *rng.uniform([-4, -6, -10], [4, 0, 10]))


def label_of(line, px, distance_m):
    return RunwayLabel(line, f"{line}.jpeg", "TEST/01", px, EARTH_STUDIO, distance_m, 0.0, True, SIGMA_PX)


def labels_with(noise, count, seed=1):
    """Labels of random approaches, whose corners `noise(rng, px)` makes imperfect."""
    rng = np.random.default_rng(seed)
    poses = [approach(rng) for _ in range(count)]
    seen = [sf.project(EARTH_STUDIO, pose, RUNWAY.corners) for pose in poses]
    distances = [float(np.linalg.norm(pose.position_m)) for pose in poses]
    return [label_of(k + 2, noise(rng, px), d) for k, (px, d) in enumerate(zip(seen, distances))]


def gaussian(rng, px):
    return px + rng.normal(0, SIGMA_PX, (4, 2))


def whole_pixels(rng, px):
    return np.round(px)


def named(report, finding):
    return {a.label.line for a in report.labels if finding in a.findings}


def poisson_binomial(probabilities, level=0.99):
    """The central interval of how many of these independent events occur."""
    pmf = reduce(np.convolve, [[1 - p, p] for p in probabilities])
    cdf = np.cumsum(pmf)
    low, high = np.searchsorted(cdf, [(1 - level) / 2, (1 + level) / 2])
    return int(low), int(high)


def shifted(labels, database, rng, size_px=5.0):
    """Labels with one corner moved in a random direction, and how likely RAIM is to name each."""
    moved, chances = [], []
    for label in labels:
        keypoints = sf.GaussianKeypoints.from_sigma(label.corners_px, SIGMA_PX)
        runway = database.find(label.ident)
        estimate = sf.estimate_pose(keypoints, runway.corners, label.camera)
        angle, shift = rng.uniform(0, 2 * np.pi), np.zeros((4, 2))
        shift[rng.integers(4)] = size_px * np.cos(angle), size_px * np.sin(angle)
        moved.append(replace(label, corners_px=label.corners_px + shift))
        chances.append(sf.detection_probability(estimate, shift, 1e-3))
    return moved, chances


def test_poisson_binomial_agrees_with_the_binomial():
    assert poisson_binomial([0.3] * 50) == tuple(binom.interval(0.99, 50, 0.3))


def test_good_labels_are_named_at_the_stated_rate():
    labels, rate = labels_with(gaussian, 1500), 0.05
    report = audit_labels(labels, DATABASE, false_alarm_rate=rate)
    low, high = binom.interval(0.999, len(labels), rate)
    assert low <= len(named(report, Finding.RESIDUAL)) <= high
    # The distance keeps its promise too; its allowance makes it cautious.
    assert len(named(report, Finding.DISTANCE)) <= high
    assert report.expected_false_alarms == pytest.approx(75)
    assert not report.not_checked


def test_whole_pixels_have_the_sigma_of_whole_pixels():
    report = audit_labels(labels_with(whole_pixels, 1000), DATABASE)
    # 2000 squared residuals: the ratio's own standard deviation is below 1 / sqrt(4000).
    assert report.sigma_ratio == pytest.approx(1, abs=0.06)
    assert len(report.contradicting) <= binom.ppf(0.999, 1000, 2e-3)


@pytest.mark.parametrize("row", [v1_row, v2_row])
def test_of_200_labels_with_two_corners_swapped_all_are_named(tmp_path, row):
    names = "ABCD" if row is v1_row else ("BL", "BR", "TR", "TL")
    labels, rows = labels_with(whole_pixels, 400, seed=2), []
    for k, label in enumerate(labels):
        cells = row(label.corners_px, slant_distance=str(label.distance_m / 1852), image=label.image)
        if k % 2:
            a, b = (names[i] for i in SWAPS[k // 2 % len(SWAPS)])
            for axis in "xy":
                cells[f"{axis}_{a}"], cells[f"{axis}_{b}"] = cells[f"{axis}_{b}"], cells[f"{axis}_{a}"]
        rows.append(cells)
    read = read_labels(write(tmp_path / "labels.csv", rows), EARTH_STUDIO)
    report = audit_labels(read, DATABASE)
    spoiled = {label.line for label in labels[1::2]}
    assert len(spoiled) == 200
    assert spoiled == {a.label.line for a in report.contradicting} == named(report, Finding.ORDER)


def test_swapped_corners_are_seen_by_the_geometry_alone():
    """Without the order of the columns, the residual and the solver name every swap by themselves."""
    labels = labels_with(whole_pixels, 200, seed=3)
    spoiled = []
    for k, label in enumerate(labels):
        px = label.corners_px.copy()
        px[list(SWAPS[k % 6])] = px[list(SWAPS[k % 6])[::-1]]
        spoiled.append(replace(label, corners_px=px))
    report = audit_labels(spoiled, DATABASE)
    assert named(report, Finding.RESIDUAL) | named(report, Finding.UNSOLVABLE) == {s.line for s in spoiled}


@pytest.mark.parametrize("noise", [gaussian, whole_pixels])
@pytest.mark.parametrize("seed", [4, 5])
def test_of_200_labels_with_a_corner_shifted_as_many_are_named_as_predicted(noise, seed):
    moved, chances = shifted(labels_with(noise, 200, seed), DATABASE, np.random.default_rng(seed))
    found = len(named(audit_labels(moved, DATABASE, false_alarm_rate=1e-3), Finding.RESIDUAL))
    low, high = poisson_binomial(chances)
    assert low <= found <= high
    assert 20 < low < high < 200  # neither hopeless nor trivial


def test_blind_spots_are_those_of_integrity():
    (label,) = labels_with(gaussian, 1)
    (audited,) = audit_labels([label], DATABASE).labels
    estimate = sf.estimate_pose(
        sf.GaussianKeypoints.from_sigma(label.corners_px, SIGMA_PX), RUNWAY.corners, EARTH_STUDIO
    )
    angles = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    for corner in range(4):
        directions = np.zeros((720, 4, 2))
        directions[:, corner] = np.column_stack([np.cos(angles), np.sin(angles)])
        smallest = [sf.minimal_detectable_bias(estimate, d, 1e-3, power=0.99) for d in directions]
        assert audited.smallest_found_px[corner] == pytest.approx(max(smallest), rel=1e-3)
    everywhere = [
        1 - sf.detection_probability(estimate, d, 1e-3)
        for corner in range(4)
        for d in 5 * np.eye(4)[corner][:, None] * np.column_stack([np.cos(angles), np.sin(angles)])[::10, None]
    ]
    assert audited.shift_missed == pytest.approx(np.mean(everywhere), rel=1e-2)


def test_the_share_missed_is_what_the_audit_says():
    """The blind spots, told from good labels, hold for labels that were then spoiled."""
    labels = labels_with(gaussian, 400, seed=6)
    told = audit_labels(labels, DATABASE).shift_missed
    moved, _ = shifted(labels, DATABASE, np.random.default_rng(6))
    missed = 1 - len(named(audit_labels(moved, DATABASE), Finding.RESIDUAL)) / 400
    assert missed == pytest.approx(told, abs=2.6 * np.sqrt(told * (1 - told) / 400))


def test_a_recorded_distance_that_does_not_fit_is_named():
    labels = labels_with(whole_pixels, 20)
    wrong = replace(labels[7], distance_m=1.1 * labels[7].distance_m)
    missing = replace(labels[8], distance_m=None)
    report = audit_labels([*labels[:7], wrong, missing, *labels[9:]], DATABASE)
    assert [a.label.line for a in report.contradicting] == [wrong.line]
    assert report.labels[0].findings == (Finding.DISTANCE,)


def test_the_tolerance_is_sigma_rounding_and_allowance():
    label = replace(labels_with(whole_pixels, 1)[0], distance_step_m=20.0)
    (audited,) = audit_labels([label], DATABASE, false_alarm_rate=0.0027).labels
    estimate = sf.estimate_pose(
        sf.GaussianKeypoints.from_sigma(label.corners_px, SIGMA_PX), RUNWAY.corners, EARTH_STUDIO
    )
    towards = estimate.pose.position_m / np.linalg.norm(estimate.pose.position_m)
    sigma = np.sqrt(towards @ estimate.cov[:3, :3] @ towards)
    # Three sigma for 0.27 %, half a step of 20 m, 0.2 %.
    assert audited.distance_tolerance_m == pytest.approx(3 * sigma + 10 + 0.002 * audited.distance_m, rel=1e-4)


def test_what_could_not_be_checked_never_passes():
    labels = labels_with(whole_pixels, 10)
    stranger, blind = replace(labels[3], ident="TEST/19"), replace(labels[4], camera=None)
    report = audit_labels([*labels[:3], stranger, blind, *labels[5:]], DATABASE)
    assert {a.label.line for a in report.not_checked} == {stranger.line, blind.line}
    assert {a.verdict for a in report.not_checked} == {"not checked"}
    assert report.expected_false_alarms == pytest.approx(8e-3)
    notes = sorted(a.note for a in report.not_checked)
    assert notes[0] == "camera unknown: pass --camera"
    assert "unknown runway 'TEST/19'" in notes[1]
    assert "nearest: TEST/01" in notes[1]


def test_nothing_checked_is_told_as_such():
    report = audit_labels([replace(label, ident="XXXX/09") for label in labels_with(whole_pixels, 5)], DATABASE)
    text = screen(report)
    assert "5 could not be checked" in text
    assert "0 passed, 5 not checked" in text
    assert np.isnan(report.sigma_ratio)
    assert report_as_dict(report)["shift_missed"] is None
    assert "passed" not in {row["verdict"] for row in report_as_dict(report)["rows"]}


@pytest.mark.parametrize(
    "corners", [[[10, 10], [20, 10], [30, 10], [40, 10]], [[50, 50]] * 4, [[50, 50], [50, 50], [60, 20], [60, 20]]]
)
def test_corners_that_no_pose_explains_are_unsolvable(corners):
    (label,) = labels_with(whole_pixels, 1)
    (audited,) = audit_labels([replace(label, corners_px=np.array(corners, float))], DATABASE).labels
    assert audited.findings == (Finding.UNSOLVABLE,)
    assert audited.verdict == "contradicts"
    assert "solver ended" in audited.note


def screen(report):
    console = Console(width=120, file=io.StringIO())
    console.print(render_summary(report))
    return console.file.getvalue()


def spoiled_report(count=60):
    labels = labels_with(whole_pixels, count)
    px = labels[9].corners_px.copy()
    px[3] += 9
    labels[9] = replace(labels[9], corners_px=px, image="[bold]x.jpeg")
    return audit_labels(labels, DATABASE)


def test_worst_come_first_and_the_summary_is_one_screen():
    report = spoiled_report()
    assert report.labels[0].label.line == 11
    passed = [a.statistic for a in report.labels if a.verdict == "passed"]
    assert passed == sorted(passed, reverse=True)
    text = screen(report)
    assert "1 of 60 labels contradict the runway" in text
    assert "sigma 0.289 px" in text
    assert "[bold]x.jpeg" in text
    assert "would pass here" in text
    assert len(text.splitlines()) < 30


def test_the_written_report(tmp_path):
    report = spoiled_report()
    out = tmp_path / "a" / "b"
    write_report(report, out)
    assert sorted(path.name for path in out.iterdir()) == ["audit.csv", "audit.json", "audit.png"]
    with open(out / "audit.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 60
    assert (rows[0]["line"], rows[0]["verdict"]) == ("11", "contradicts")
    assert "residual" in rows[0]["findings"]
    content = json.loads((out / "audit.json").read_text(), parse_constant=pytest.fail)
    assert content["contradicting"] == 1
    assert content["findings"]["residual"] == 1
    for end in ("near", "far"):
        columns = [f"smallest_found_px_{end}_{side}" for side in ("left", "right")]
        shifts = [float(row[column]) for row in rows if row["verdict"] == "passed" for column in columns]
        expected = np.percentile(shifts, [50, 90, 100])
        np.testing.assert_allclose(list(content["smallest_found_px"][end].values()), expected, rtol=1e-5)
    assert (out / "audit.png").read_bytes().startswith(b"\x89PNG")


def test_a_file_from_end_to_end(tmp_path):
    labels = labels_with(whole_pixels, 30)
    rows = [
        v1_row(label.corners_px, slant_distance=f"{label.distance_m / 1852:.2f}", image=label.image) for label in labels
    ]
    path = write(tmp_path / "labels.csv", rows)
    runways = tmp_path / "runways.json"
    runways.write_text(json.dumps(ENTRIES))
    report = audit_file(path, runways, tmp_path / "out")
    assert not report.contradicting
    assert not report.not_checked
    assert report.source == str(path)
    assert (tmp_path / "out" / "audit.png").exists()


@pytest.mark.parametrize(
    "options, words",
    [
        ({"sigma_px": 0.0}, "sigma_px"),
        ({"sigma_px": float("nan")}, "sigma_px"),
        ({"false_alarm_rate": 0.0}, "false_alarm_rate"),
        ({"false_alarm_rate": 1.0}, "false_alarm_rate"),
    ],
)
def test_options_out_of_range_are_refused(options, words):
    with pytest.raises(sf.InputError, match=words):
        audit_labels(labels_with(whole_pixels, 1), DATABASE, **options)


def test_labels_without_a_camera_are_listed_as_not_checked(tmp_path):
    labels = labels_with(whole_pixels, 2)
    path = write(tmp_path / "labels.csv", [v2_row(label.corners_px, image=label.image) for label in labels])
    (tmp_path / "runways.json").write_text(json.dumps(ENTRIES))
    report = audit_file(path, tmp_path / "runways.json", tmp_path / "out")
    assert [a.note for a in report.not_checked] == ["camera unknown of flight_simulator pictures: pass --camera"] * 2
    assert "0 of 2 labels contradict the runway, 0 passed, 2 not checked" in screen(report)


def test_refused_rows_are_told_and_never_pass(tmp_path):
    labels = labels_with(whole_pixels, 8)
    rows = [v1_row(label.corners_px, slant_distance="", image=label.image) for label in labels]
    rows[2]["x_B"], rows[5]["airport"] = "12,5", ""
    path = write(tmp_path / "labels.csv", rows)
    (tmp_path / "runways.json").write_text(json.dumps(ENTRIES))
    report = audit_file(path, tmp_path / "runways.json", tmp_path / "out")
    assert [r.line for r in report.refused] == [4, 7]
    assert len(report.labels) == 6
    text = screen(report).replace("\n", "")
    assert "0 of 6 labels contradict the runway, 6 passed, 0 not checked" in text
    assert "2 rows are no labels, and were left out" in text
    assert "line 4: x_B is '12,5'" in text
    content = json.loads((tmp_path / "out" / "audit.json").read_text())
    assert (content["labels"], content["refused"]) == (6, 2)
    with open(tmp_path / "out" / "audit.csv", newline="") as file:
        written = {row["line"]: row for row in csv.DictReader(file)}
    assert {line for line, row in written.items() if row["verdict"] == "passed"} == {"2", "3", "5", "6", "8", "9"}
    for line in ("4", "7"):
        assert written[line]["verdict"] == "refused"
        assert f"line {line}" in written[line]["note"]
        assert written[line]["p_value"] == ""


def test_a_real_picture_without_a_runway_is_not_checked():
    label = replace(labels_with(whole_pixels, 1)[0], ident="")
    assert audit_labels([label], DATABASE).not_checked[0].note == "the label names no runway"


def test_a_tiny_rate_has_a_finite_tolerance():
    (audited,) = audit_labels(labels_with(whole_pixels, 1), DATABASE, false_alarm_rate=1e-18).labels
    assert np.isfinite(audited.distance_tolerance_m)


def test_files_that_cannot_be_used_are_refused(tmp_path):
    px = labels_with(whole_pixels, 1)[0].corners_px
    path, runways = write(tmp_path / "labels.csv", [v2_row(px)]), tmp_path / "runways.json"
    runways.write_text(json.dumps(ENTRIES))
    with pytest.raises(sf.InputError, match=r"missing\.json"):
        audit_file(path, tmp_path / "missing.json", tmp_path / "out", camera=EARTH_STUDIO)
    with pytest.raises(sf.InputError, match=r"labels\.csv: cannot make the output folder"):
        audit_file(path, runways, path, camera=EARTH_STUDIO)


# Real labels, where they are at hand.


@pytest.fixture(scope="module")
def real():
    return read_labels(TEST_SYNTH), load_database(RUNWAYS)


@needs_data
@pytest.mark.parametrize("path", [TEST_SYNTH, SAMPLE])
def test_the_real_labels_do_not_contradict_their_runways(path):
    """Their sigma is that of whole pixels; uniform errors have no tails, so none is named by chance."""
    report = audit_labels(read_labels(path), load_database(RUNWAYS))
    assert not report.contradicting
    assert not report.not_checked
    assert report.sigma_ratio == pytest.approx(1, abs=3 / np.sqrt(4 * len(report.labels)))


@needs_data
def test_a_runway_missing_from_the_database_is_told():
    report = audit_labels(read_labels(V2_HEAD), load_database(RUNWAYS), camera=EARTH_STUDIO)
    assert len(report.not_checked) == 3
    assert "unknown runway 'CYEG/20'" in report.not_checked[0].note
    assert "LARD's runways_db_V2_FLSim.json has the runways of these labels" in report.not_checked[0].note


@needs_data
@pytest.mark.parametrize("path", [TEST_SYNTH, SAMPLE])
def test_200_swaps_in_a_real_file_are_all_named(tmp_path, path):
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file, delimiter=";"))
    names = "ABCD" if path == TEST_SYNTH else ("BL", "BR", "TR", "TL")
    rng = np.random.default_rng(7)
    rows = [dict(rows[i]) for i in rng.integers(len(rows), size=200)]
    for k, row in enumerate(rows):
        row["image"] = f"{k}.jpeg"
        a, b = rng.choice(list(names), 2, replace=False)
        for axis in "xy":
            row[f"{axis}_{a}"], row[f"{axis}_{b}"] = row[f"{axis}_{b}"], row[f"{axis}_{a}"]
    report = audit_labels(read_labels(write(tmp_path / "labels.csv", rows)), load_database(RUNWAYS))
    assert len(report.contradicting) == 200


@needs_data
def test_200_shifts_of_real_labels_are_named_as_often_as_predicted(real):
    labels, database = real
    rng = np.random.default_rng(8)
    chosen = [labels[i] for i in rng.choice(len(labels), 200, replace=False)]
    moved, chances = shifted(chosen, database, rng)
    found = len(named(audit_labels(moved, database), Finding.RESIDUAL))
    low, high = poisson_binomial(chances)
    assert low <= found <= high
