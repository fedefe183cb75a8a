"""The pictures of an evaluation: what is drawn is what is so; and the SVG fits a page, light or dark."""

import copy
import dataclasses
import io
import re
import time
import xml.etree.ElementTree as ElementTree

import cv2
import matplotlib
import numpy as np
import pytest
from evidence_small import EDGES_M, small_evidence, small_rows
from matplotlib.colors import to_hex
from matplotlib.container import ErrorbarContainer
from PIL import Image

import shortfinal as sf
from shortfinal.evaluate.rows import DO_NOT_USE, USE
from shortfinal.report import plots
from shortfinal.report.examples import example_pictures, rejection_example
from shortfinal.stream.overlay import COLOURS

SVG = "{http://www.w3.org/2000/svg}"
LINK = "{http://www.w3.org/1999/xlink}href"
BEYOND = np.array(EDGES_M[:-1]) >= 2000  # the bins of distance in which a bias is planted


@pytest.fixture(scope="module")
def rows():
    return small_rows(3000)


@pytest.fixture(scope="module")
def evidence(rows):
    return small_evidence(rows)


@pytest.fixture(scope="module")
def written(rows, evidence, tmp_path_factory):
    out = tmp_path_factory.mktemp("report")
    return out, plots.write_plots(out, evidence, rows)


def test_every_figure_is_written_and_has_a_caption(written):
    out, texts = written
    assert list(texts) == list(plots.CAPTIONS)
    files = sorted(p.name for p in (out / "figures").iterdir())
    assert files == sorted(f"{name}.{kind}" for name in texts for kind in ("svg", "png"))
    for name in texts:
        with Image.open(out / "figures" / f"{name}.png") as picture:
            assert picture.width >= 4.5 * 150  # inches at 150 dpi
            assert picture.convert("RGB").getpixel((0, 0)) == (255, 255, 255)


def test_svg_has_no_colour_of_its_own(written):
    for text in written[1].values():
        root = ElementTree.fromstring(text)
        assert not re.search(r"#[0-9a-fA-F]{3,8}\b(?!\))|rgb\(", re.sub(r'href="#[^"]*"|url\(#[^)]*\)', "", text))
        assert root.find(f".//{SVG}style") is None  # it would hold for the whole page
        for element in root.iter():
            style = dict(re.findall(r"([\w-]+): ([^;]+)", element.get("style", "")))
            for key in ("fill", "stroke"):
                assert re.fullmatch(r"none|var\(--(ink|paper|grid|c[1-6])\)", style.get(key, "none"))
                assert key not in element.attrib
            if element.tag == f"{SVG}text":  # else it is black, which is none of the page's
                assert style["fill"] == "var(--ink)"
                assert style["font-family"] == "sans-serif"
        used = set(re.findall(r"var\(--([^)]*)\)", text))
        assert used <= set(plots.THEME)


def test_a_filled_path_that_says_nothing_would_be_black(written):
    for text in written[1].values():
        root = ElementTree.fromstring(text)
        defined = {e for defs in root.iter(f"{SVG}defs") for e in defs.iter(f"{SVG}path")}
        for path in root.iter(f"{SVG}path"):
            closed = path.get("d", "").rstrip().endswith("z")
            assert path in defined or not closed or "fill: " in path.get("style", "")


def test_ids_are_unique_in_a_page_of_all_figures_and_resolve(written):
    every = []
    for name, text in written[1].items():
        root = ElementTree.fromstring(text)
        ids = [e.get("id") for e in root.iter() if e.get("id")]
        assert all(i.startswith(f"{name}-") for i in ids)
        referred = set(re.findall(r"url\(#([^)]+)\)", text)) | {e.get(LINK)[1:] for e in root.iter(f"{SVG}use")}
        assert referred == set(ids)
        every += ids
    assert len(every) == len(set(every)) > 0


def test_the_file_keeps_its_colours_and_a_ground_to_stand_on(written):
    out, texts = written
    for name in texts:
        alone = (out / "figures" / f"{name}.svg").read_text()
        assert "var(--" not in alone
        assert f"background: {plots.PAPER}" in alone
        assert ElementTree.fromstring(alone).get("viewBox")


def test_figures_are_small(written):
    assert {name: len(text) for name, text in written[1].items() if len(text.encode()) > 150_000} == {}


def test_the_same_data_give_the_same_bytes(rows, evidence, written):
    again = plots.draw(copy.deepcopy(evidence), rows.select(np.arange(len(rows))))
    for name in ("calibration", "stanford_along", "bias_by_distance"):
        assert plots.as_svg(again[name], name) == written[1][name]
        assert "metadata" not in written[1][name]  # it would hold the date
    plots.as_svg(again["latency"], "latency")
    again["latency"].set_layout_engine("none")  # as laid out for the SVG
    assert plots._png(again["latency"]) == (written[0] / "figures" / "latency.png").read_bytes()


def test_no_global_state_is_left_changed(rows, evidence):
    before = dict(matplotlib.rcParams)
    plots.draw(evidence, rows.select(np.arange(200)))
    assert dict(matplotlib.rcParams) == before


@pytest.mark.parametrize(
    ("missing", "left_out"),
    [
        ("calibration", {"calibration"}),
        ("sharpness", {"sharpness"}),
        ("statistic", {"statistic"}),
        ("faults", {"detection"}),
        ("roc", {"roc"}),
        ("navigation", {"error_by_distance"}),
        ("metrics", {"error_by_group"}),
        ("stanford", {"stanford_along", "stanford_cross", "stanford_vertical"}),
    ],
)
def test_what_the_evidence_lacks_is_not_drawn(rows, evidence, missing, left_out):
    some = rows.select(np.arange(300))
    assert set(plots.CAPTIONS) - set(plots.draw(evidence | {missing: None}, some)) == left_out


def test_what_the_rows_lack_is_not_drawn(rows):
    some = rows.select(np.arange(300))
    nothing = {
        field: getattr(some, field) * np.nan for field in ("mean_px", "cov_px", "error_m", "level_m", "latency_ms")
    }
    assert list(plots.draw({}, some)) == ["latency", "bias_by_distance"]
    assert plots.draw({}, dataclasses.replace(some, **nothing)) == {}


def test_null_is_a_gap(rows, evidence):
    broken = copy.deepcopy(evidence)
    broken["calibration"]["observed"][3] = None
    line = _line(_one("calibration", broken, rows).axes[0], "observed")
    assert np.isnan(line.get_ydata()[3])
    assert np.isfinite(np.delete(line.get_ydata(), 3)).all()


def test_calibration_draws_the_evidence(rows, evidence):
    line = _line(_one("calibration", evidence, rows).axes[0], "observed")
    np.testing.assert_array_equal(line.get_xdata(), evidence["calibration"]["nominal"])
    np.testing.assert_array_equal(line.get_ydata(), evidence["calibration"]["observed"])


def test_sharpness_tells_near_from_far(rows, evidence):
    labels = [text.get_text() for text in _one("sharpness", evidence, rows).axes[0].get_legend().get_texts()]
    near, far = (float(re.search(r"median ([\d.]+) px", label)[1]) for label in labels)
    # The generator's far corners are 0.7 times as doubtful.
    assert far / near == pytest.approx(0.7, rel=0.1)


def test_planted_bias_is_drawn_where_it_is():
    # A 3 px bias of the far corners in v, beyond 2 km. Intervals hold the truth with 95 %: 28 of them, and each
    # is widened half as much again (2.94 sigma: 1 in 300), so that chance fails the test one time in ten seeds.
    rows = small_rows(6000, seed=1, far_bias_px=3.0)
    panels = _one("bias_by_distance", {"navigation": {"edges_m": EDGES_M, "axes": _no_axes()}}, rows).axes
    for panel, coordinate in zip(panels, "uv"):
        for end, (mean, half) in _series(panel).items():
            planted = np.where(BEYOND & (end == "far corners") & (coordinate == "v"), 3.0, 0.0)
            assert (np.abs(mean - planted) < 1.5 * half).all()
            assert (half < 0.25).all()  # tight enough to tell 3 px from none


def test_an_airport_whose_sigma_is_halved_stands_out():
    rows = small_rows(3000, seed=2, halved="LFPO")
    axes = _one("error_by_group", small_evidence(rows), rows).axes
    names = [label.get_text() for label in axes[0].get_yticklabels()]
    assert names[0] == "LFPO"  # the worst coverage comes first
    red = {names[round(float(y)) - 1] for y in _markers(axes[1], plots.RED)}
    assert red == {"LFPO"}
    calm = small_rows(3000, seed=2)
    assert _markers(_one("error_by_group", small_evidence(calm), calm).axes[1], plots.RED) == []


def test_of_many_airports_the_worst_are_drawn():
    rows = small_rows(6000, seed=2, halved="LFPO")
    other = np.array([f"A{n % 50:03d}" for n in range(len(rows))], object)
    rows = dataclasses.replace(rows, airport=np.where(rows.airport == "LFPO", rows.airport, other))
    names = [t.get_text() for t in _one("error_by_group", small_evidence(rows), rows).axes[0].get_yticklabels()]
    assert names[0] == "LFPO"
    assert names[30] == "and 21 better"
    assert len(names) == 31 + len(EDGES_M) - 1


def test_error_by_distance_draws_rms_against_sigma(rows, evidence):
    axes = _one("error_by_distance", evidence, rows).axes
    for panel, axis in zip(axes, ("along", "cross", "vertical")):
        assert panel.get_title(loc="left") == axis
        table = evidence["navigation"]["axes"][axis]
        np.testing.assert_array_equal(_line(panel, "error, RMS").get_ydata(), table["rms_m"])
        np.testing.assert_array_equal(_line(panel, "predicted σ, RMS").get_ydata(), table["sigma_rms_m"])
        np.testing.assert_array_equal(_line(panel, "protection level, median").get_ydata(), table["level_median_m"])


@pytest.mark.parametrize("limits", [None, (150.0, 20.0, 12.0)])
def test_stanford_counts_and_draws_misleading_information(limits):
    rows = small_rows(2000, seed=3)
    evidence = small_evidence(rows, limits)
    axes = _one("stanford_cross", evidence, rows).axes[0]
    counts = evidence["stanford"]["cross"]
    said = {" ".join(t.get_text().split("\n")[:-1]): t.get_text().split("\n")[-1] for t in axes.texts}
    wanted = ("nominal", "misleading") if limits is None else ("nominal", "misleading", "hazardous", "unavailable")
    assert {name: said[name] for name in wanted} == {name: f"{counts[name]:,}" for name in wanted}
    assert ("unavailable, misleading" in said) == (limits is not None)
    # Every planted error lies in a red cell, and no other does.
    which = rows.accepted & (np.abs(rows.error_m[:, 1]) > rows.level_m[:, 1])
    places = np.column_stack([np.abs(rows.error_m[which, 1]), rows.level_m[which, 1]])
    cells = [p.get_path() for p in axes.patches if to_hex(p.get_facecolor()) == plots.RED and p.get_alpha() > 0.5]
    assert which.sum() >= 2
    assert all(any(_holds(path, place) for path in cells) for place in places)
    assert sum(len(path.vertices) // 5 for path in cells) <= which.sum()


def test_no_misleading_cell_without_one():
    rows = small_rows(2000, seed=3)
    rows = rows.select(~(np.abs(rows.error_m) > rows.level_m).any(axis=1))
    evidence = small_evidence(rows)
    for axis in ("along", "cross", "vertical"):
        axes = _one(f"stanford_{axis}", evidence, rows).axes[0]
        assert not [p for p in axes.patches if to_hex(p.get_facecolor()) == plots.RED and p.get_alpha() > 0.5]


def test_merged_cells_cover_each_counted_cell_once():
    counts = np.random.default_rng(0).poisson(0.7, (12, 12)).astype(float)
    axes = plots._panels("", (3, 3))[1][0]
    plots._draw_cells(axes, np.arange(13.0), counts, plots.BLUE, 0.2)
    covered = np.zeros((12, 12), int)
    strength = np.zeros((12, 12))
    for patch in axes.patches:
        for corners in patch.get_path().vertices.reshape(-1, 5, 2).astype(int):
            (left, bottom), (right, top) = corners[0], corners[2]
            covered[left:right, bottom:top] += 1
            strength[left:right, bottom:top] = patch.get_alpha()
    np.testing.assert_array_equal(covered, counts > 0)
    order = np.argsort(counts, axis=None)
    assert (np.diff(strength.ravel()[order]) >= 0).all()  # the more, the stronger


def test_latency_curve_ends_at_the_slowest(rows, evidence):
    axes = _one("latency", evidence, rows).axes[0]
    curve = axes.lines[0]
    assert curve.get_xdata()[-1] == rows.latency_ms.max()
    assert curve.get_ydata()[-1] == 1
    assert axes.texts[0].get_text() == f"50 %: {np.median(rows.latency_ms):.3g} ms"


@pytest.mark.slow
def test_100000_rows_are_drawn_in_time_and_small():
    rows = small_rows(100_000, far_bias_px=3.0)
    evidence = small_evidence(rows)
    start = time.process_time()
    texts = {name: plots.as_svg(figure, name) for name, figure in plots.draw(evidence, rows).items()}
    # A minute for the whole evaluation; the pictures may take a third of it.
    assert time.process_time() - start < 20
    assert max(len(text.encode()) for text in texts.values()) < 150_000


# --- examples


def _picture(_):
    return np.full((2650, 2450, 3), 90, np.uint8)


def test_examples_go_from_the_surest_to_the_least_sure_then_the_refused_and_the_misleading():
    rows = small_rows(400, seed=5)
    examples = example_pictures(rows, _picture, count=9)
    refused = [n for n, e in enumerate(examples) if "refused" in e.title]
    misleading = [n for n, e in enumerate(examples) if "misleading" in e.title]
    sigma = np.sqrt((rows.sigma_px**2).mean(axis=(1, 2)))
    ordered = [sigma[e.row] for e in examples[:9]]
    assert ordered == sorted(ordered)
    assert ordered[0] == np.nanmin(sigma)
    assert ordered[-1] == np.nanmax(sigma)
    assert refused + misleading == list(range(9, len(examples)))
    assert {str(rows.decision[examples[n].row]) for n in refused} <= {DO_NOT_USE}
    for n in misleading:
        row = examples[n].row
        assert rows.decision[row] == USE
        assert (np.abs(rows.error_m[row]) > rows.level_m[row]).any()
    assert misleading


def test_none_is_called_misleading_within_its_level():
    rows = small_rows(300, seed=5)
    rows = rows.select(~(np.abs(rows.error_m) > rows.level_m).any(axis=1))
    assert not [e for e in example_pictures(rows, _picture, count=2) if "misleading" in e.title]


def test_the_refused_example_is_the_least_likely():
    rows = small_rows(300, seed=6)
    decision, p = rows.decision.copy(), rows.p_value.copy()
    decision[[10, 20, 30]], p[[10, 20, 30]] = DO_NOT_USE, [1e-5, 1e-9, 1e-7]
    rows = dataclasses.replace(rows, decision=decision, p_value=p)
    titles = {e.row: e.title for e in example_pictures(rows, _picture, count=1) if "refused" in e.title}
    assert list(titles) == [20, 30]
    assert "p = 1e-09" in titles[20]


def test_a_close_up_shows_outline_ellipses_and_truth_in_a_small_jpeg():
    rows = small_rows(60, seed=7)
    rows = rows.select(rows.distance_m > 1500)  # nearer, the ellipses are smaller than a pixel of the close-up
    for example in example_pictures(rows, _picture, count=3):
        with Image.open(io.BytesIO(example.jpeg)) as image:
            tile = np.asarray(image.convert("RGB")).astype(int)
        assert tile.shape == (320, 320, 3)
        assert len(example.jpeg) < 30_000
        colour = np.array(COLOURS[sf.Decision(rows.decision[example.row])])
        assert np.abs(tile[1, 160] - colour).max() < 40  # the frame, as the decision
        inside = tile[30:-6, 6:-6]
        yellow = (inside[..., 0] > 170) & (inside[..., 1] > 170) & (inside[..., 2] < 150)
        magenta = (inside[..., 0] > 150) & (inside[..., 1] < 130) & (inside[..., 2] > 150)
        assert yellow.any()
        assert magenta.any()


def test_a_picture_that_is_gone_leaves_its_row_out():
    rows = small_rows(50)
    assert example_pictures(rows, lambda _: None) == []
    shown = example_pictures(rows, lambda row: _picture(row) if row % 2 else None, count=10)
    assert shown
    assert all(e.row % 2 for e in shown)


def test_nothing_predicted_has_no_example():
    rows = small_rows(20)
    nothing = dataclasses.replace(rows, mean_px=rows.mean_px * np.nan, cov_px=rows.cov_px * np.nan)
    assert example_pictures(nothing, _picture) == []


def test_a_prediction_far_astray_does_not_shrink_the_runway():
    rows = small_rows(1, seed=1)
    astray = dataclasses.replace(rows, mean_px=rows.mean_px + 1500.0, decision=np.array([USE], object))
    (example,) = example_pictures(astray, _picture, count=1)[:1]
    tile = cv2.imdecode(np.frombuffer(example.jpeg, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)[30:-6, 6:-6]
    crosses = np.argwhere((tile[..., 0] > 150) & (tile[..., 1] < 130) & (tile[..., 2] > 150))
    assert np.ptp(crosses, axis=0).max() > 320 / 3 - 2


CAMERA = sf.Camera(width=2448, height=2648, fx=3401.6, fy=3401.6, cx=1223.5, cy=1323.5)
RUNWAY = sf.Runway(length_m=1500.0, width_m=45.0)


def _seen(distance_m, sigma_px):
    """Exact corners from 3 degrees above: p = 1 as it is."""
    pose = sf.Pose.from_attitude([-distance_m, 0.0, distance_m * np.tan(np.radians(3))], 0.0, -3.0, 0.0)
    return sf.GaussianKeypoints.from_sigma(sf.project(CAMERA, pose, RUNWAY.corners), sigma_px)


def test_rejection_example_shows_what_was_refused():
    # docs: on 1,500 m with sigma 0.3 px, from 1 km, the 184 m fault is always detected.
    image = rejection_example(_picture(0), _seen(1000.0, 0.3), RUNWAY, CAMERA, size=200)
    assert image.shape == (400, 400, 3)
    left, right = image[:, :200].astype(int), image[:, 200:].astype(int)
    green, red = (np.array(COLOURS[d]) for d in (sf.Decision.USE, sf.Decision.DO_NOT_USE))
    for half, own, other in ((left, green, red), (right, red, green)):
        assert (np.abs(half - own).max(axis=2) < 10).sum() > 4 * 190  # two frames
        assert not (np.abs(half - other).max(axis=2) < 10).any()
    # Below, the far end: as it is the outline runs through the keypoints; of the refused estimate it is narrower.
    widths = []
    for half, own in ((left, green), (right, red)):
        drawn = np.argwhere(np.abs(half[230:396, 5:-5] - own).max(axis=2) < 60)
        widths.append(np.ptp(drawn[drawn[:, 0] <= drawn[:, 0].min() + 1, 1]))  # of its far edge
    assert widths[1] < widths[0]


def test_no_rejection_example_of_what_is_not_refused():
    assert rejection_example(_picture(0), _seen(3000.0, 2.0), RUNWAY, CAMERA) is None  # too far to see it
    assert rejection_example(_picture(0), _seen(1000.0, 0.3), RUNWAY, CAMERA, nearer_m=0.0) is None


# --- what they share


def _one(name, evidence, rows):
    """One figure; all of them take a second."""
    with matplotlib.rc_context(plots._STYLE):
        return plots._DRAWN[name](evidence, rows)


def _line(axes, label):
    return next(line for line in axes.lines if line.get_label() == label)


def _series(axes):
    """{end: (means, halves of the intervals)} of a panel with error bars."""
    out = {}
    for bars in (c for c in axes.containers if isinstance(c, ErrorbarContainer)):
        segments = bars.lines[2][0].get_segments()
        out[bars.get_label()] = bars.lines[0].get_ydata(), np.array([np.ptp(s[:, 1]) / 2 for s in segments])
    return out


def _markers(axes, colour):
    """Heights of the triangles of a colour."""
    return [line.get_ydata()[0] for line in axes.lines if line.get_marker() == "^" and line.get_color() == colour]


def _holds(path, place):
    """Whether a path of rectangles holds a place."""
    boxes = path.vertices.reshape(-1, 5, 2)
    return ((boxes.min(axis=1) <= place) & (place <= boxes.max(axis=1))).all(axis=1).any()


def _no_axes():
    nothing = [None] * (len(EDGES_M) - 1)
    keys = ("count", "rms_m", "sigma_rms_m", "q95_m", "level_median_m")
    return {axis: dict.fromkeys(keys, nothing) for axis in ("along", "cross", "vertical")}
