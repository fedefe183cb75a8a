"""The report as one HTML file: what it says, that it is safe and small, and that it works in a browser."""

import itertools
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from shortfinal.errors import InputError
from shortfinal.evaluate.rows import DO_NOT_USE, MISSING, NOT_MONITORED, USE, Rows
from shortfinal.report.page import MAX_ROWS, ExamplePicture, chosen_rows, write_page

AIRPORTS = ("BIRK", "EDDM", "LFPO")
JPEG = bytes.fromhex("ffd8ffe000104a46494600010100000100010000ffd9")
VOID = {"meta", "img", "input", "br", "link", "hr"}


def some_rows(count=60, seed=0):
    """Every fifth refused, every seventh not monitored, the last missing; row 3 misleading, row 4 without a level."""
    rng = np.random.default_rng(seed)
    truth = np.array([[900, 1200], [1300, 1200], [1150, 1000], [1050, 1000]], float) + rng.normal(0, 20, (count, 4, 2))
    sigma = rng.uniform(0.3, 1.0, (count, 4, 2))
    cov = np.zeros((count, 8, 8))
    cov[:, np.arange(8), np.arange(8)] = sigma.reshape(count, 8) ** 2
    decision = np.full(count, USE, object)
    decision[::5], decision[::7], decision[-1:] = DO_NOT_USE, NOT_MONITORED, MISSING
    decision[3:5] = USE
    error = rng.normal(0, 1, (count, 3)) * [10, 1, 1]
    level = np.tile([60.0, 8.0, 6.0], (count, 1))
    error[3:4], level[4:5] = 100.0, np.inf
    mean = truth + sigma * rng.standard_normal((count, 4, 2))
    mean[-1:], cov[-1:], error[-1:], level[-1:] = np.nan, np.nan, np.nan, np.nan
    airport = np.array([AIRPORTS[n % 3] for n in range(count)], object)
    nothing = np.full(count, np.nan)
    return Rows(
        picture=np.array([f"{n:06d}.jpg" for n in range(count)], object),
        source=np.array([f"labels.csv: line {n + 2}" for n in range(count)], object),
        ident=np.array([f"{name}/24" for name in airport], object), airport=airport,
        light=np.full(count, "bright", object), truth_px=truth, mean_px=mean, cov_px=cov, enlarged=np.ones(count),
        distance_m=rng.uniform(300, 6000, count), glide_deg=np.full(count, 3.0), lateral_deg=nothing,
        decision=decision, reason=np.full(count, "as drawn", object), present=np.ones(count),
        statistic=rng.chisquare(2, count), dof=np.full(count, 2.0), p_value=rng.uniform(size=count),
        error_m=error, sigma_m=np.abs(error) / 2, level_m=level, latency_ms=np.full(count, 40.0),
        absent=np.full(count, 0.1), caught_184m=np.zeros(count),
    )  # fmt: skip


def metric(by, group, name, value, low, high, unit=""):
    return {"by": by, "group": group, "name": name, "value": value, "low": low, "high": high, "count": 20, "unit": unit}


def requirement(ident, result):
    return {
        "id": ident, "text": f"text of {ident}", "metric": "error_px.median", "where": "all", "bound": "at most 0.6",
        "value": 0.7, "low": 0.65, "high": 0.75, "count": 60, "unit": "px", "result": result, "why": f"why of {ident}",
    }  # fmt: skip


def evidence_of(rows):
    decisions = {name: int((rows.decision == name).sum()) for name in set(rows.decision)}
    metrics = [
        metric("all", "all", "error_px.median", 0.5, 0.45, 0.55, "px"),
        metric("all", "all", "coverage.90", 0.9, 0.88, 0.92),
        metric("all", "all", "nees", None, None, None),
        metric("all", "all", "over_level", 0.0123, 0.002, 0.03),
        metric("airport", "BIRK", "coverage.90", 0.61, 0.55, 0.67),
        metric("airport", "EDDM", "coverage.90", 0.97, 0.85, 0.99),
        metric("airport", "LFPO", "error_px.median", 0.9, 0.8, 1.0, "px"),
        metric("distance", "0–500 m", "error_px.median", 0.5, None, None, "px"),
    ]
    return {
        "format": 1, "title": "A trial", "created": "2026-01-01T00:00:00Z", "version": "0.1.0",
        "subject": {"kind": "model", "name": "runway.onnx", "sha256": "ab" * 32, "sigma": "the network's own",
                    "model": {"size": 224}},
        "data": {"name": "approaches", "format": "LARD v1", "pictures": len(rows), "labels": len(rows),
                 "airports": dict.fromkeys(AIRPORTS, len(rows) // 3), "sha256": "cd" * 32},
        "settings": {"false_alarm_rate": 1e-3, "integrity_risk": 1e-7, "fault_prior": 1e-4,
                     "alert_limits_m": [80.0, 10.0, 8.0]},
        "counts": {"labels": len(rows), "predicted": len(rows) - 1, "missing": 1, "unmatched": 2,
                   "problems": {"NaN sigma": 3}, "decisions": decisions},
        "problems": [{"kind": "NaN sigma", "file": "p.csv", "row": 7, "field": "sigma_u", "what": "not a number",
                      "mend": "write one", "picture": "000007.jpg"}],
        "notes": ["Sigma was fitted here."], "metrics": metrics,
        "stanford": {axis: {"nominal": 40, "misleading": 1, "hazardous": 0, "unavailable": 1,
                            "unavailable_misleading": 0, "not_accepted": 18}
                     for axis in ("along", "cross", "vertical")},
        "requirements": [requirement("R1", "shown"), requirement("R2", "failed"), requirement("R3", "not shown")],
        "compare": {"name": "older.onnx", "metrics": [metric("all", "all", "coverage.90", 0.77, 0.75, 0.79)]},
    }  # fmt: skip


PLOT = '<svg viewBox="0 0 10 10" width="10pt" height="10pt"><path stroke="var(--c1)" d="M0 0L9 9"/></svg>'


class Page(HTMLParser):
    """A page's elements, refused if they are not nested, with the words outside styles and scripts."""

    def __init__(self, path):
        super().__init__()
        self.text = path.read_text(encoding="utf-8")
        self.open, self.tags, self.ids, self.links, self.words = [], [], [], [], []
        self.feed(self.text)
        self.close()
        assert self.open == []
        self.said = " ".join(" ".join(self.words).split())
        self.data = json.loads(re.search(r'id="data">(.*?)</script>', self.text, re.DOTALL)[1])
        self.rows = [dict(zip(self.data["fields"], values)) for values in self.data["rows"]]

    def handle_starttag(self, tag, attributes):
        self.handle_startendtag(tag, attributes)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        attributes = dict(attributes)
        self.tags.append((tag, attributes))
        self.ids += [attributes["id"]] if "id" in attributes else []
        self.links += [attributes["href"]] if "href" in attributes else []

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] not in (["script"], ["style"]):
            self.words.append(data)


@pytest.fixture
def page_of(tmp_path):
    def write(evidence, rows, plots=None, examples=()):
        return Page(write_page(tmp_path, evidence, rows, plots or {}, examples))

    return write


def test_page_is_whole_and_asks_for_nothing(page_of):
    page = page_of(evidence_of(some_rows()), some_rows(), {"calibration": PLOT}, [ExamplePicture(3, "worst", JPEG)])
    assert len(page.ids) == len(set(page.ids))
    rows = {f"#row-{row['row']}" for row in page.rows} | {f"#airport-{name}" for name in AIRPORTS}
    assert {link for link in page.links if link not in rows} <= {f"#{ident}" for ident in page.ids}
    assert set(re.findall(r"https?://[^\"' )<]*", page.text)) == {"http://www.w3.org/2000/svg"}  # a name, no address
    policy = next(a["content"] for tag, a in page.tags if a.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none'; img-src data:;")
    assert not [a for tag, a in page.tags if tag in ("link", "iframe", "object") or any(n.startswith("on") for n in a)]
    levels = [int(tag[1]) for tag, _ in page.tags if re.fullmatch("h[1-6]", tag)]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(below - above <= 1 for above, below in itertools.pairwise(levels))


def test_verdict_says_what_failed_first(page_of):
    page = page_of(evidence_of(some_rows()), some_rows())
    said = page.said
    assert said.index("1 of 3 requirements failed, 1 could not be shown.") < said.index("R2 failed.")
    assert said.index("R2 failed.") < said.index("R3 not shown.") < said.index("Where σ does not hold")
    # BIRK's interval lies 0.9 − 0.67 = 0.23 from nominal; EDDM's holds it.
    assert "airport BIRK: 61.0 % of the errors of all corners lie within their 90 % interval (55.0 to 67.0 %)" in said
    assert "airport EDDM:" not in said
    assert "why of R2" in said
    assert "60 labelled" in said
    assert "older.onnx" in said


@pytest.mark.parametrize(
    ("results", "tone", "sentence"),
    [
        (None, "none", "No requirements were given"),
        ([], "none", "No requirements were given"),
        (["shown"], "good", "The requirement is shown."),
        (["shown", "shown"], "good", "All 2 requirements are shown."),
        (["shown", "not shown"], "warn", "None of 2 requirements failed, but 1 could not be shown."),
        (["failed"], "bad", "1 of 1 requirement failed."),
    ],
)
def test_verdict_has_the_colour_of_the_worst(page_of, results, tone, sentence):
    evidence = evidence_of(some_rows())
    evidence["requirements"] = None if results is None else [requirement("R", result) for result in results]
    page = page_of(evidence, some_rows())
    assert sentence in page.said
    assert f"verdict tone-{tone}" in [a.get("class") for _, a in page.tags]


def test_groups_off_the_mark_are_coloured(page_of):
    page = page_of(evidence_of(some_rows()), some_rows())

    def cells(group):
        return re.search(rf"<tr>(<th scope=\"row\"><a href=\"#airport-{group}\">.*?)</tr>", page.text)[1]

    assert "flag-bad" in cells("BIRK")
    assert "▼" in cells("BIRK")
    assert "flag-" not in cells("EDDM")  # its interval holds 90 %
    assert "flag-bad" in cells("LFPO")  # 0.8 to 1.0 px, where 0.5 is usual


def test_everything_from_outside_is_escaped(page_of):
    evil = "</script ></script><script>alert(1)</script><!-- <b id='evil' onclick=\"x\"> & $title \ud800"

    def spoil(value):
        if isinstance(value, dict):
            return {name: item if name in KEPT else spoil(item) for name, item in value.items()}
        if isinstance(value, list):
            return [spoil(item) for item in value]
        return value + evil if isinstance(value, str) else value

    KEPT = ("by", "name", "result", "metric")  # of a closed set, but for the names that follow
    rows = some_rows()
    for column in (rows.picture, rows.source, rows.ident, rows.airport, rows.reason):
        column[:] = evil
    evidence = spoil(evidence_of(rows))
    evidence["subject"]["name"] = evidence["data"]["name"] = evidence["compare"]["name"] = evil
    evidence["data"]["airports"] = evidence["counts"]["problems"] = {evil: 3}
    evidence["settings"][evil] = evil
    evidence["metrics"] += [metric("all", "all", evil, 1.0, 0.5, 2.0, evil)]
    page = page_of(evidence, rows, {evil: PLOT}, [ExamplePicture(0, evil, JPEG)])
    assert [tag for tag, _ in page.tags].count("script") == 2
    assert "evil" not in page.ids
    assert not any("onclick" in attributes for _, attributes in page.tags)
    assert page.rows[0]["picture"] == evil
    assert not set("<>&") & set(re.search(r'id="data">(.*?)</script>', page.text, re.DOTALL)[1])
    assert "A trial" in page.said  # and the title, which ends in $title, is not filled in again
    assert page.said.count("& $title") > 10


def test_rows_keep_what_is_not_known_apart_from_what_is_infinite(page_of):
    page = page_of(evidence_of(some_rows()), some_rows())
    rows = {row["row"]: row for row in page.rows}
    assert sorted(rows) == list(range(60))
    assert rows[4]["level_m"] == ["inf", "inf", "inf"]
    assert rows[59]["mean_px"] is None
    assert rows[59]["level_m"] is None
    assert rows[0]["lateral_deg"] is None
    assert rows[5]["source"] == "labels.csv: line 7"
    np.testing.assert_allclose(rows[5]["truth_px"], some_rows().truth_px[5].ravel(), rtol=5e-7)  # seven digits
    np.testing.assert_allclose(rows[5]["error_m"], some_rows().error_m[5], rtol=5e-5)


def test_figures_not_known_are_dashes(page_of):
    page = page_of(evidence_of(some_rows()), some_rows())
    assert "Normalised error squared – (no interval)" in page.said
    assert not re.search(r"\b(NaN|nan|None|null|inf)\b", page.said.replace("NaN sigma", ""))


def test_no_truth_no_requirements_no_predictions(page_of):
    rows = some_rows(0)
    page = page_of({"format": 1, "metrics": [], "requirements": None}, rows)
    for words in (
        "No requirements were given",
        "No labelled runway",
        "No figure could be computed",
        "There are no rows",
    ):
        assert words in page.said
    assert "stanford" not in page.said.lower()
    assert page.rows == []
    rows = some_rows(4)
    for column in (rows.mean_px, rows.cov_px, rows.error_m, rows.level_m, rows.sigma_m):
        column[:] = np.nan
    rows.decision[:] = MISSING
    page = page_of(evidence_of(rows), rows)
    assert "4 missing (100 %)" in page.said
    assert len(page.rows) == 4


def test_hundred_thousand_rows_and_large_pictures_stay_under_five_megabytes(page_of):
    rows = some_rows(100_000)
    rows.picture[:] = [f"{name}-" + "跑" * 1000 for name in rows.picture]
    plots = dict.fromkeys(("calibration", "sharpness", "roc"), PLOT + " " * 900_000)
    examples = [ExamplePicture(n, "large", JPEG + bytes(300_000)) for n in range(10)]
    page = page_of(evidence_of(rows), rows, plots, examples)
    assert 3_000_000 < len(page.text.encode()) < 5_000_000
    assert "Plots too large for this file, to be found beside it: sharpness, roc." in page.said
    assert "of 10 example pictures are left out" in page.said
    assert 300 < len(page.rows) < MAX_ROWS
    assert page.data["total"] == 100_000
    shown = {int(link.removeprefix("#row-")) for link in page.links if link.startswith("#row-")}
    assert shown <= {row["row"] for row in page.rows}
    assert "It is no fair sample" in page.said


def test_chosen_rows_are_the_telling_ones():
    rows = some_rows(2000)
    some = chosen_rows(rows, 200, [1999])
    assert len(set(some.tolist())) == 200
    assert some[:2].tolist() == [1999, 3]  # what was asked for, then the one that misleads
    worst = np.nanargmax(np.linalg.norm(rows.error_px, axis=2).max(axis=1))
    assert worst in some
    assert 60 <= (rows.decision[some] != USE).sum() <= 160  # 100 by rule; some of the rest, but not all
    np.testing.assert_array_equal(some, chosen_rows(rows, 200, [1999]))
    assert len(chosen_rows(rows, 5000)) == 2000


def test_a_folder_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"report\.html: cannot be written"):
        write_page(tmp_path / "none", evidence_of(some_rows()), some_rows(), {}, ())


# --- in a browser


@pytest.fixture
def opened(chromium, tmp_path):
    """Opens the page; fails at the end if it asked for anything, or if anything was wrong."""
    wrong, contexts = [], []

    def open_page(evidence=None, rows=None, width=1200, scheme="light", plots=None):
        rows = some_rows() if rows is None else rows
        evidence = evidence_of(rows) if evidence is None else evidence
        path = write_page(
            tmp_path, evidence, rows, plots or {}, [ExamplePicture(3, "worst", JPEG)] if len(rows) else ()
        )
        context = chromium.new_context(viewport={"width": width, "height": 800}, color_scheme=scheme)
        contexts.append(context)
        page = context.new_page()
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("console", lambda said: wrong.append(said.text) if said.type in ("error", "warning") else None)
        page.on(
            "request", lambda asked: wrong.append(asked.url) if not asked.url.startswith(("file:", "data:")) else None
        )
        page.goto(path.as_uri())
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert wrong == []


def cells(page, column):
    """The texts of a column of the rows shown, by its heading."""
    heads = [text.rstrip(" ▼▲") for text in page.locator("#table thead th").all_inner_texts()]
    return page.locator(f"#table tbody td:nth-child({heads.index(column) + 1})").all_inner_texts()


def test_rows_sort_filter_and_open(opened):
    page = opened()
    assert page.locator("#table tbody tr").count() == 50
    worst = [float(text) for text in cells(page, "Worst corner, px")]
    assert worst == sorted(worst, reverse=True)
    page.locator("#table th button", has_text="Row").click()
    assert cells(page, "Row")[0] == "59"
    page.keyboard.press("Enter")  # the heading keeps the focus
    assert cells(page, "Row")[:3] == ["0", "1", "2"]
    page.locator("#table th button", has_text="Distance").click()
    page.locator("#by-decision").select_option(NOT_MONITORED)
    assert set(cells(page, "Decision")) == {NOT_MONITORED}
    assert page.locator("#table tbody tr").count() == (some_rows().decision == NOT_MONITORED).sum()
    page.locator("#by-airport").select_option("LFPO")
    assert set(cells(page, "Runway")) == {"LFPO/24"}
    page.locator("#clear").click()
    page.locator("#by-text").fill("line 7")
    assert cells(page, "Picture") == ["000005.jpg"]
    page.locator("#table td.name button").press("Enter")  # by keyboard
    said = page.locator("#detail").inner_text()
    rows = some_rows()
    assert "labels.csv: line 7 · row 5" in said
    assert f"{rows.truth_px[5, 0, 0]:.6g}" in said
    assert f"{rows.p_value[5]:.3f}" in said
    assert page.evaluate("location.hash") == "#row-5"
    page.keyboard.press("Escape")
    assert not page.locator("#detail").is_visible()
    assert page.evaluate("document.activeElement.textContent") == "000005.jpg"  # back where it was
    page.locator("#clear").click()
    page.locator("#next").click()
    assert page.locator("#table tbody tr").count() == 10


def test_links_lead_to_rows(opened):
    page = opened()
    page.locator(".examples a").first.click()
    page.wait_for_function("document.querySelector('#detail').innerText.includes('row 3')")
    assert page.locator("#table tr.chosen").get_attribute("data-row") == "3"
    page.locator("#close").click()
    page.locator(".groups a", has_text="BIRK").click()
    page.wait_for_function(
        "![...document.querySelectorAll('#table tbody tr')].some(r => /EDDM|LFPO/.test(r.innerText))"
    )
    assert set(cells(page, "Runway")) == {"BIRK/24"}


def test_missing_and_infinite_are_shown_as_such(opened):
    page = opened()
    page.evaluate("location.hash = '#row-59'")
    page.wait_for_function("document.querySelector('#detail h3')?.textContent === '000059.jpg'")
    said = page.locator("#detail").inner_text()
    assert "missing" in said
    assert not re.search(r"NaN|undefined|null|Infinity", said)
    page.evaluate("location.hash = '#row-4'")
    page.wait_for_function("document.querySelector('#detail h3')?.textContent === '000004.jpg'")
    assert page.locator("#detail").inner_text().count("none") == 3


def test_stanford_diagram_answers_to_pointer_and_keys(opened):
    page = opened()
    rows = some_rows()
    accepted = (rows.decision == USE).sum()
    assert page.locator("#chart .point").count() == accepted
    assert page.locator("#chart .misleading").count() == 1
    page.locator("#chart .misleading").hover()
    tip = page.locator("#tip").inner_text()
    for words in ("000003.jpg", "labels.csv: line 5", "error 100 m, level 60.0 m", "use: as drawn"):
        assert words in tip
    page.locator("#chart .misleading").click()
    assert "row 3" in page.locator("#detail").inner_text()
    page.locator("#close").click()
    page.get_by_role("radio", name="vertical").check()
    page.get_by_role("checkbox", name="also rows not accepted").check()
    assert page.locator("#chart .refused").count() == 60 - accepted - 1  # one was not predicted
    page.locator("#chart svg").focus()
    page.keyboard.press("ArrowRight")
    assert "error 100 m, level 6.00 m" in page.locator("#tip").inner_text()  # the worst first
    page.keyboard.press("ArrowRight")
    assert "000003.jpg" not in page.locator("#tip").inner_text()
    page.keyboard.press("Enter")
    assert page.locator("#detail").is_visible()


def paper(page):
    return page.evaluate("getComputedStyle(document.body).backgroundColor")


@pytest.mark.parametrize(("scheme", "other"), [("light", "dark"), ("dark", "light")])
def test_theme_follows_the_system_and_the_button(opened, scheme, other):
    page = opened(scheme=scheme)
    colours = {"light": "rgb(255, 255, 255)", "dark": "rgb(20, 23, 28)"}
    assert paper(page) == colours[scheme]
    page.locator("#theme").click()
    assert paper(page) == colours[other]
    page.locator("#theme").click()
    assert paper(page) == colours[scheme]
    page.emulate_media(media="print")
    assert paper(page) == colours["light"]


@pytest.mark.parametrize("width", [400, 1200])
def test_nothing_is_wider_than_the_window(opened, width):
    rows = some_rows()
    rows.picture[:] = "a" * 300
    wide = PLOT.replace('width="10pt"', 'width="900pt"')
    page = opened(evidence_of(rows), rows, width, plots={"error_by_distance": wide})
    assert page.evaluate("document.documentElement.scrollWidth") == width
    page.locator("#table td.name button").first.click()
    assert page.evaluate("document.documentElement.scrollWidth") == width


def test_prints_unfolded(opened, tmp_path):
    rows = some_rows()
    evidence = evidence_of(rows)
    evidence["problems"] *= 30
    page = opened(evidence, rows)
    assert page.locator("details:not([open])").count() == 2
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert page.locator("details:not([open])").count() == 0
    page.evaluate("dispatchEvent(new Event('afterprint'))")
    assert page.locator("details:not([open])").count() == 2
    page.emulate_media(media="print")
    page.set_viewport_size({"width": 690, "height": 800})  # A4 less margins
    assert page.evaluate("document.documentElement.scrollWidth") <= 690
    # Nothing that scrolls on the screen is cut off on paper.
    assert page.evaluate("[...document.querySelectorAll('.scroll')].every(e => e.scrollWidth <= e.clientWidth + 1)")
    page.emulate_media(media=None)
    assert page.pdf(format="A4").startswith(b"%PDF")


def test_works_without_anything(opened):
    page = opened({"format": 1, "metrics": [], "requirements": None}, some_rows(0))
    assert "No requirements were given" in page.locator("#verdict").inner_text()
    page.locator("#theme").click()
