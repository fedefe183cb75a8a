import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

import shortfinal as sf
from shortfinal.evaluate.requirements import (
    METRICS,
    Condition,
    Requirement,
    Requirements,
    check,
    is_share,
    passed,
    read_requirements,
)
from shortfinal.evaluate.rows import DO_NOT_USE, USE, Figure, Rows

NAN = math.nan
EXAMPLE = Path(__file__).parents[1] / "examples" / "requirements.toml"


def rows_of(count=40, **changes):
    """Rows of which nothing is known but corners and verdicts, with `changes`."""

    def texts(*values):
        return np.resize(np.array(values, object), count)

    unknown = np.full(count, NAN)
    columns = {field.name: unknown for field in dataclasses.fields(Rows)}
    columns |= {name: texts("") for name in ("picture", "source", "reason")}
    columns |= {"ident": texts("AAAA/09", "BBBB/27"), "airport": texts("AAAA", "BBBB"), "light": texts("bright")}
    columns |= {"decision": texts(USE, USE, USE, DO_NOT_USE), "error_m": np.full((count, 3), NAN)}
    columns |= {"sigma_m": np.full((count, 3), NAN), "level_m": np.full((count, 3), NAN)}
    columns |= {"truth_px": np.zeros((count, 4, 2)), "mean_px": np.ones((count, 4, 2))}
    columns |= {"cov_px": np.tile(np.eye(8), (count, 1, 1))}
    return Rows(**{**columns, **changes})


def the_record(requirement, figure, rows=None):
    figures = {} if figure is None else {requirement.metric: figure}
    [record] = check(Requirements(None, (requirement,)), rows_of() if rows is None else rows, lambda _: figures)
    return record


MOST = Requirement("R", "error_px.mean", at_most=0.6)
LEAST = Requirement("R", "use", at_least=0.9)
BOTH = Requirement("R", "coverage.95", at_least=0.93, at_most=0.97)


@pytest.mark.parametrize(
    ("requirement", "figure", "result", "why"),
    [
        (MOST, (0.5, 0.4, 0.6), "shown", "0.5 px, of 40 rows; the 95 % interval, 0.4 to 0.6 px, lies within at most"),
        (MOST, (0.5, 0.4, 0.6001), "not shown", "the 95 % interval, 0.4 to 0.6001 px, reaches beyond at most 0.6"),
        (MOST, (0.61, 0.4, 0.7), "failed", "0.61 px, of 40 rows; required is at most 0.6"),
        (MOST, (0.61, 0.4, 0.5), "failed", "0.61 px, of 40 rows; required is at most 0.6"),
        (MOST, (0.6000004, 0.4, 0.7), "failed", "0.6 px, of 40 rows; required is at most 0.6"),
        (MOST, (NAN, 0.4, 0.5), "not shown", "the figure is not a number"),
        (MOST, (0.5, NAN, NAN), "not shown", "0.5 px, of 40 rows; too few for an interval"),
        (MOST, (0.5, NAN, 0.6), "not shown", "too few for an interval"),
        (MOST, (0.5, 0.4, math.inf), "not shown", "the 95 % interval, 0.4 to inf px, reaches beyond at most 0.6"),
        (MOST, (math.inf, 0.4, math.inf), "failed", "inf px, of 40 rows; required is at most 0.6"),
        (LEAST, (0.95, 0.9, 0.99), "shown", "lies within at least 0.9"),
        (LEAST, (0.95, 0.89, 0.99), "not shown", "reaches beyond at least 0.9"),
        (LEAST, (0.89, 0.85, 0.95), "failed", "required is at least 0.9"),
        (BOTH, (0.95, 0.93, 0.97), "shown", "lies within at least 0.93 and at most 0.97"),
        (BOTH, (0.95, 0.92, 0.96), "not shown", "reaches beyond at least 0.93 and at most 0.97"),
        (BOTH, (0.95, 0.94, 0.98), "not shown", "reaches beyond"),
        (BOTH, (0.98, 0.97, 0.99), "failed", "required is at least 0.93 and at most 0.97"),
        (BOTH, (0.92, 0.91, 0.96), "failed", "required is at least 0.93 and at most 0.97"),
    ],
)  # fmt: skip
def test_only_a_whole_interval_within_the_bound_shows_it(requirement, figure, result, why):
    unit = "px" if requirement is MOST else ""
    record = the_record(requirement, Figure(*figure, 320, unit))
    assert record["result"] == result
    assert why in record["why"]
    assert passed([record]) == (result == "shown")


@pytest.mark.parametrize(
    ("value", "result"), [(0.5, "shown"), (0.6, "shown"), (0.61, "failed"), (NAN, "not shown"), (math.inf, "failed")]
)
def test_the_estimate_alone_may_be_judged(value, result):
    requirement = dataclasses.replace(MOST, judge="estimate")
    assert the_record(requirement, Figure(value, NAN, NAN, 320, "px"))["result"] == result


@pytest.mark.parametrize("judge", ["interval", "estimate"])
def test_too_few_rows_show_nothing(judge):
    requirement = dataclasses.replace(MOST, judge=judge, fewest=40)
    good = Figure(0.5, 0.4, 0.55, 320, "px")
    assert the_record(requirement, good)["result"] == "shown"
    record = the_record(dataclasses.replace(requirement, fewest=41), good)
    assert (record["result"], record["why"]) == ("not shown", "0.5 px, of 40 rows; at least 41 rows are needed")
    # Three predicted rows are 24 coordinates, but three rows; and one figure of rows is of three of them.
    mean = np.full((40, 4, 2), NAN)
    mean[:3] = 1
    record = the_record(MOST, Figure(0.5, 0.4, 0.55, 24, "px"), rows_of(mean_px=mean))
    assert (record["result"], record["why"]) == ("not shown", "0.5 px, of 3 rows; at least 20 rows are needed")
    assert the_record(LEAST, Figure(0.95, 0.92, 0.99, 3, ""))["result"] == "not shown"


def test_a_record_says_all_and_holds_no_nan():
    record = the_record(dataclasses.replace(BOTH, text="honest"), Figure(0.95, NAN, math.inf, 320, ""))
    assert record == {
        "id": "R", "text": "honest", "metric": "coverage.95", "where": "all", "bound": "at least 0.93 and at most 0.97",
        "value": 0.95, "low": None, "high": None, "count": 320, "unit": "", "result": "not shown",
        "why": "0.95, of 40 rows; too few for an interval",
    }  # fmt: skip
    absent = the_record(MOST, None)
    assert [absent[name] for name in ("value", "low", "high", "count", "unit")] == [None, None, None, 0, ""]


POSED = {"distance_m": np.full(40, 1e3)}
SOLVED = {**POSED, "error_m": np.zeros((40, 3))}
LEVELS = {**SOLVED, "level_m": np.full((40, 3), 9.0), "decision": np.array([DO_NOT_USE] * 40, object)}


@pytest.mark.parametrize(
    ("metric", "known", "why"),
    [
        ("along_m.q95", {}, "no true poses in the data, of 40 rows"),
        ("hazardous", {}, "no true poses in the data, of 40 rows"),
        ("along_m.q95", POSED, "no row was solved to a pose, of 40 rows"),
        ("over_level", SOLVED, "no protection level could be given, of 40 rows"),
        ("over_level", LEVELS, "no row was accepted, of 40 rows"),
        ("level.cross_m.median", POSED, "no protection level could be given, of 40 rows"),
        ("alarm", {}, "no row was monitored, of 40 rows"),
        ("detection.far_threshold_184m", {}, "no row was monitored, of 40 rows"),
        ("latency_ms.q95", {}, "no times were measured, of 40 rows"),
        ("error_input_px.mean", {}, "the scale of the crops is not known, of 40 rows"),
        ("error_px.mean", {"mean_px": np.full((40, 4, 2), NAN)}, "no corners were predicted, of 40 rows"),
        ("error_px.mean", {}, "error_px.mean could not be computed of these 40 rows"),
    ],
)
def test_an_absent_figure_is_not_shown_and_says_why(metric, known, why):
    record = the_record(Requirement("R", metric, at_most=0.5), None, rows_of(**known))
    assert (record["result"], record["why"]) == ("not shown", why)


def test_conditions_select_rows():
    distance = np.array([100.0, 500, 1000, NAN])
    rows = rows_of(
        4, distance_m=distance, glide_deg=np.array([2.9, 3.0, 3.1, 3.2]),
        light=np.array(["night", "dim", "bright", ""], object),
    )  # fmt: skip
    for condition, chosen in [
        (Condition(), [0, 1, 2, 3]),
        (Condition(distance_m=(100.0, 1000.0)), [0, 1]),  # low belongs to it, high does not
        (Condition(distance_m=(0.0, math.inf)), [0, 1, 2]),  # not known: not among them
        (Condition(glide_deg=(3.0, 3.15)), [1, 2]),
        (Condition(airport=("AAAA",)), [0, 2]),
        (Condition(airport=("AAAA", "BBBB")), [0, 1, 2, 3]),
        (Condition(ident=("BBBB/27",)), [1, 3]),
        (Condition(light=("night", "dim")), [0, 1]),
        (Condition(decision=(DO_NOT_USE,)), [3]),
        (Condition(decision=(USE,), airport=("BBBB",)), [1]),
        (Condition(airport=("CCCC",)), []),
    ]:
        assert np.flatnonzero(condition.select(rows)).tolist() == chosen, condition


def test_each_condition_gets_the_figures_of_its_own_rows():
    seen = []

    def figures(rows):
        seen.append(len(rows))
        share = float(np.mean(rows.decision == USE))
        return {"use": Figure(share, share - 0.01, share + 0.01, len(rows), "")}

    there = Condition(airport=("AAAA",))
    wanted = (
        Requirement("all", "use", at_least=0.7), Requirement("a", "use", at_least=0.9, where=there),
        Requirement("a again", "use", at_most=0.9, where=there),
        Requirement("b", "use", at_least=0.7, where=Condition(airport=("BBBB",))),
    )  # fmt: skip
    records = check(Requirements(None, wanted), rows_of(80), figures)  # A: all used; B: every other
    assert [r["result"] for r in records] == ["shown", "shown", "failed", "failed"]
    assert [r["where"] for r in records] == ["all", "airport AAAA", "airport AAAA", "airport BBBB"]
    assert [r["value"] for r in records] == [0.75, 1.0, 1.0, 0.5]
    assert seen == [80, 40, 40]  # computed once for each condition
    assert passed(records[:2])
    assert not passed(records)


@pytest.mark.parametrize(
    ("condition", "why"),
    [
        (Condition(airport=("CCCC", "DDDD")), "no rows with airport CCCC, DDDD; the data has airport AAAA, BBBB"),
        (Condition(light=("night",)), "no rows with light night; the data has light bright"),
        (Condition(glide_deg=(2.0, 3.0)), "no rows with glide angle 2 to 3 degrees; no glide angle is known"),
        (Condition(distance_m=(2e3, math.inf)),
         "no rows with distance from 2000 m; the data has distance 500 to 1500 m"),
        (Condition(airport=("AAAA",), decision=(DO_NOT_USE,)), "no rows with airport AAAA; decision do-not-use"),
    ],
)  # fmt: skip
def test_a_condition_without_rows_is_not_shown(condition, why):
    rows = rows_of(distance_m=np.resize([500.0, 1500.0], 40))
    requirements = Requirements(None, (Requirement("R", "use", at_least=0.1, where=condition, fewest=1),))
    [record] = check(requirements, rows, lambda _: pytest.fail("there are no rows to make figures of"))
    assert record["result"] == "not shown"
    assert record["why"].startswith(why)
    assert not passed([record])


def test_no_rows_and_no_requirements_pass_nothing():
    record = the_record(MOST, Figure(0.1, 0.1, 0.1, 320, "px"), rows_of(0))
    assert (record["result"], record["why"]) == ("not shown", "no rows")
    assert not passed([])


def test_the_example_is_read():
    read = read_requirements(EXAMPLE)
    assert read.alert_limits == sf.AlertLimits(along_m=40, cross_m=40, vertical_m=35)
    by_id = {r.id: r for r in read.requirements}
    assert list(by_id) == [f"R{n}" for n in range(1, 10)]
    assert by_id["R1"] == Requirement(
        "R1", "error_px.q90", "corners are found to two pixels, nine times out of ten", at_most=2.0
    )
    assert by_id["R3"].where == Condition(distance_m=(2000.0, math.inf))
    assert by_id["R4"].where == Condition(light=("night", "dim"))
    assert (by_id["R4"].fewest, by_id["R9"].judge) == (50, "estimate")
    assert str(by_id["R8"].where) == "distance 0 to 2000 m; glide angle 2.5 to 3.5 degrees"


def test_one_text_or_several(tmp_path):
    path = tmp_path / "r.toml"
    path.write_text(f'{GOOD}\nwhere = {{ airport = "AAAA", ident = ["A/1", "B/2"], decision = "use" }}')
    read = read_requirements(path)
    assert read.alert_limits is None
    assert read.requirements[0].where == Condition(airport=("AAAA",), ident=("A/1", "B/2"), decision=("use",))


def test_every_metric_can_be_required(tmp_path):
    path = tmp_path / "r.toml"
    tables = [f'[[requirement]]\nid = "{name}"\nmetric = "{name}"\nat_most = 0.5' for name in METRICS]
    path.write_text("\n".join(["[alert_limits]\nalong_m = 1.0", *tables]))
    assert [r.metric for r in read_requirements(path).requirements] == list(METRICS)
    assert len(set(METRICS)) == len(METRICS)
    assert is_share("far_coverage.99")
    assert not is_share("nees")


GOOD = '[[requirement]]\nid = "R1"\nmetric = "coverage.95"\nat_least = 0.9'
ERROR = GOOD.replace("coverage.95", "error_px.mean")
LIMITS = "[alert_limits]\n"


def where(text):
    return f"{GOOD}\nwhere = {{ {text} }}"


# What is damaged, and what the one line must say.
DAMAGE = [
    (None, "cannot read the requirements: No such file or directory"),
    (b"\xff\xfe", "not a TOML file: "),
    ("[[requirement]", "not a TOML file: "),
    (f"{GOOD}\nat_least = 1", "not a TOML file: "),
    ("", "no requirement in it; write each under [[requirement]]"),
    ("requirement = 3", "requirement: expected tables, each under [[requirement]]"),
    (GOOD.replace("[[requirement]]", "[requirement]"), "requirement: expected tables, each under [[requirement]]"),
    (GOOD.replace("requirement", "requirements"), "requirements: no such field; did you mean requirement?"),
    (f"x = 1\n{GOOD}", "x: no such field; there are alert_limits, requirement"),
    (f"{LIMITS}{GOOD}", "alert_limits: expected a table of along_m, cross_m, vertical_m, in metres; {}"),
    (f"alert_limits = 40\n{GOOD}", "alert_limits: expected a table of along_m, cross_m, vertical_m, in metres; 40"),
    (f"{LIMITS}lateral_m = 4\n{GOOD}", "alert_limits: lateral_m: no such field; "),
    (f"{LIMITS}along_m = 0\n{GOOD}", "alert_limits: along_m: 0; expected metres, over 0"),
    (f"{LIMITS}along_m = nan\n{GOOD}", "alert_limits: along_m: nan; expected metres, over 0"),
    (f"{LIMITS}along_m = '40'\n{GOOD}", "alert_limits: along_m: '40'; expected metres, over 0"),
    (f"{LIMITS}along_m = true\n{GOOD}", "alert_limits: along_m: True; expected metres, over 0"),
    (
        f"{LIMITS}along_m = inf\n{GOOD}",
        "alert_limits: along_m: inf; expected metres, over 0; leave out an axis without",
    ),
    (GOOD.replace('id = "R1"', ""), "requirement 1: id: missing"),
    (GOOD.replace('"R1"', "7"), "requirement 1: id: 7; expected a text"),
    (GOOD.replace('"R1"', '" "'), "requirement 1: id: ' '; expected a text"),
    (f"{GOOD}\n{GOOD}", "requirement 'R1': id: there are two of this name; requirement 2 needs another"),
    (GOOD.replace('metric = "coverage.95"', ""), "requirement 'R1': metric: missing; name the figure"),
    (GOOD.replace('"coverage.95"', "95"), "requirement 'R1': metric: 95; expected a text"),
    (
        GOOD.replace("coverage", "covrage"),
        "requirement 'R1': metric: no figure is called 'covrage.95'; did you mean cov",
    ),
    (GOOD.replace("coverage.95", "?"), "requirement 'R1': metric: no figure is called '?'"),
    (
        GOOD.replace("coverage.95", "hazardous"),
        "requirement 'R1': metric: hazardous needs the operation's [alert_limits]",
    ),
    (
        GOOD.replace("coverage.95", "available"),
        "requirement 'R1': metric: available needs the operation's [alert_limits]",
    ),
    (GOOD.replace("at_least = 0.9", ""), "requirement 'R1': at_most, at_least: missing; give one of them, or both"),
    (GOOD.replace("at_least", "at_last"), "requirement 'R1': at_last: no such field; did you mean at_least"),
    (GOOD.replace("0.9", "'0.9'"), "requirement 'R1': at_least: '0.9'; expected a number"),
    (GOOD.replace("0.9", "nan"), "requirement 'R1': at_least: nan; expected a number"),
    (GOOD.replace("0.9", "true"), "requirement 'R1': at_least: True; expected a number"),
    (ERROR.replace("0.9", "-0.1"), "requirement 'R1': at_least: -0.1; error_px.mean is never negative"),
    (ERROR.replace("0.9", "inf"), "requirement 'R1': at_least: inf; expected a number"),
    (GOOD.replace("0.9", "95"), "requirement 'R1': at_least: 95; coverage.95 is a share, expected a number over 0, up"),
    (GOOD.replace("0.9", "0"), "requirement 'R1': at_least: 0; coverage.95 is a share, expected a number over 0, up"),
    (
        f"{GOOD}\nat_most = 1",
        "requirement 'R1': at_most: 1; coverage.95 is a share, expected a number from 0 to below 1",
    ),
    (f"{GOOD}\nat_most = 0.8", "requirement 'R1': at_least: 0.9 is above at_most, 0.8: nothing satisfies both"),
    (f"{GOOD}\ntext = 3", "requirement 'R1': text: 3; expected a text"),
    (f"{GOOD}\nfewest = 0", "requirement 'R1': fewest: 0; expected a whole number of rows, 1 or more"),
    (f"{GOOD}\nfewest = 20.5", "requirement 'R1': fewest: 20.5; expected a whole number of rows"),
    (f"{GOOD}\nfewest = true", "requirement 'R1': fewest: True; expected a whole number of rows"),
    (f"{GOOD}\njudge = 'mean'", "requirement 'R1': judge: 'mean'; expected interval or estimate"),
    (f"{GOOD}\njudge = ['interval']", "requirement 'R1': judge: ['interval']; expected interval or estimate"),
    (
        f"{GOOD}\nwhere = 'AAAA'",
        "requirement 'R1': where: 'AAAA'; expected a table of airport, ident, light, decision, ",
    ),
    (where(""), "requirement 'R1': where: {}; expected a table of airport, "),
    (where("airfield = 'AAAA'"), "requirement 'R1': where: airfield: no such field; "),
    (where("airport = []"), "requirement 'R1': where: airport: []; expected one or a list of texts"),
    (where("airport = ['']"), "requirement 'R1': where: airport: ['']; expected one or a list of texts"),
    (where("ident = 24"), "requirement 'R1': where: ident: 24; expected one or a list of texts"),
    (where("light = 'dusk'"), "requirement 'R1': where: light: 'dusk'; expected one or a list of night, dim, bright"),
    (
        where("decision = 'accept'"),
        "requirement 'R1': where: decision: 'accept'; expected one or a list of use, do-not-use",
    ),
    (where("distance_m = 500"), "requirement 'R1': where: distance_m: 500; expected [low, high], low below high"),
    (where("distance_m = [500, 500]"), "requirement 'R1': where: distance_m: [500, 500]; expected [low, high]"),
    (where("distance_m = [900, 500]"), "requirement 'R1': where: distance_m: [900, 500]; expected [low, high]"),
    (where("distance_m = [1, 2, 3]"), "requirement 'R1': where: distance_m: [1, 2, 3]; expected [low, high]"),
    (where("glide_deg = ['2', '4']"), "requirement 'R1': where: glide_deg: ['2', '4']; expected [low, high]"),
    (where("glide_deg = [nan, 4]"), "requirement 'R1': where: glide_deg: [nan, 4]; expected [low, high]"),
]


@pytest.mark.parametrize(("content", "message"), DAMAGE, ids=[message[:50] for _, message in DAMAGE])
def test_damage_is_one_line_that_names_file_requirement_and_field(tmp_path, content, message):
    path = tmp_path / "r.toml"
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(sf.InputError) as refusal:
        read_requirements(path)
    assert str(refusal.value).startswith(f"{path}: {message}")
    assert "\n" not in str(refusal.value)
