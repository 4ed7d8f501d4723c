from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import jinja2
import polars as pl
import pytest
from report_synthesis import join_commands, list_places, make_report

from pipeline import report
from pipeline.core import format_duration, format_recorded
from pipeline.models.parameter import AT_BOUND, UNDETERMINED
from pipeline.report import (
    begin_large,
    format_date,
    format_known_share,
    format_number,
    format_split,
    render_template,
    show_text,
)
from pipeline.report.page import format_standing, render_report
from pipeline.report.scene import RunReport
from pipeline.report.sections_why import _list_parameters

TEMPLATES = Path(report.__file__).parents[1]
HOSTILE = "</script><script>alert(1)</script><!-- <img src=x onerror=alert(2)> \u2028 \" ' & \u202e"

# Names of formats and an unused link to an editor inside the bundle; nothing fetches them.
INERT = re.compile(
    r"https?://(www\.w3\.org/|vega\.github\.io/(schema|editor)/|github\.com/vega/vega-lite/issues/)"
)
VOID = {"meta", "input", "br", "img", "link", "hr"}


class Outline(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.headings: list[str] = []
        self.scripts: list[tuple[dict[str, str | None], str]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.tags.append((tag, found))
        if found.get("id"):
            self.ids.append(str(found["id"]))
        if tag == "script":
            self.scripts.append((found, ""))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] in {"h1", "h2", "h3"}:
            self.headings.append(f"{self.open[-1]} {data}")
        if self.open and self.open[-1] == "script":
            attributes, text = self.scripts[-1]
            self.scripts[-1] = (attributes, text + data)


def outline_of(page: str) -> Outline:
    outline = Outline()
    outline.feed(page)
    outline.close()
    return outline


def data_of(outline: Outline) -> dict[str, dict[str, dict[str, object]]]:
    texts = [text for attributes, text in outline.scripts if attributes.get("id") == "page-data"]
    found: dict[str, dict[str, dict[str, object]]] = json.loads(texts[0])
    return found


@pytest.fixture(scope="module")
def report() -> RunReport:
    return make_report()


@pytest.fixture(scope="module")
def page(report: RunReport) -> str:
    return render_report(report)


@pytest.fixture(scope="module")
def outline(page: str) -> Outline:
    return outline_of(page)


def test_page_answers_the_questions_from_top_to_bottom(outline: Outline) -> None:
    questions = [words for words in outline.headings if words.startswith("h2")]
    assert questions == [
        "h2 At a glance",
        "h2 How bad",
        "h2 Where",
        "h2 Why",
        "h2 What now",
        "h2 Data health",
        "h2 Provenance",
    ]
    assert outline.headings[0] == "h1 field/2026-11-02_warthog"
    assert outline.open == [], "every element is closed"
    assert len(outline.ids) == len(set(outline.ids))


def test_the_first_screen_answers_all_four_in_short(page: str) -> None:
    first = page[page.index('<section id="glance"') : page.index('<section id="how-bad"')]
    for anchor in ("how-bad", "where", "why", "what-now"):
        assert f'href="#{anchor}"' in first
    assert (
        '<p class="verdict">Over 2 s the ideal model is 1.06 m and 55 degrees off. The robot turns at 56 % '
        "of the ideal rate and follows commands with a time constant of 1.1 s; with both in the model 31 cm "
        "and 5.7 degrees remain, 1.6 times the noise floor in position and 1.4 times in heading. "
        "No known effect explains the rest.</p>"
    ) in first
    assert "<b>Turning faster than 1 rad/s</b>: 74 % of the yaw error in 21 % of the time" in first
    assert (
        "<li>Effective track 1.93 m (nominal 1.08): the robot turns at 56 % of the ideal rate</li>" in first
    )
    assert 'data-figure="trajectory"' in first
    assert "slip diagnose field/2026-11-02_warthog --apply model.toml" in join_commands(first)
    assert "Undecided: lateral skid or centre of rotation. To separate them: drive circles" in first
    assert "<code>effective_track</code><br>Cause: skidding or a wrong track width" in page
    told = "remaining error 31 cm, noise floor 19 cm: the effects remove 86 % of the error above it"
    assert told not in first
    assert told in page
    assert re.findall(r"<h3><a href=[^>]*>([^<]+)</a>", first) == ["How bad", "Where", "Why", "What now"]


def test_a_run_stands_beside_those_it_can_be_compared_with(report: RunReport) -> None:
    name = str(report.summary["dataset"])
    assert format_standing(report) == ""
    one = replace(report, peers={"command": [0.01]})
    assert format_standing(one) == f"more than the one other run of {name}: 0.010 m/s"
    many = replace(report, peers={"command": [0.01, 0.02, 99.0, 98.0, 97.0], "measured": [1.0]})
    assert format_standing(many) == f"vs 5 runs of {name}: more slip than 2; their median 97.0 m/s"
    assert format_standing(many) in render_report(many)
    assert render_report(many) == render_report(many)


def test_every_figure_has_a_place_and_words_for_those_who_cannot_see_it(outline: Outline) -> None:
    places = {str(found["data-figure"]): found for _, found in outline.tags if "data-figure" in found}
    assert list(places) == list_places()
    for found in places.values():
        assert found["role"] == "img"
        assert len(str(found["aria-label"])) > 40
    assert set(data_of(outline)["figures"]) == set(places)


def test_every_row_block_that_a_figure_names_is_there_once(outline: Outline) -> None:
    data = data_of(outline)
    named = set(re.findall(r'"data":\{"name":"(\w+)"', json.dumps(data["figures"], separators=(",", ":"))))
    assert named == set(data["rows"])
    for name, columns in data["rows"].items():
        lengths = {len(c["codes"] if isinstance(c, dict) else c) for c in columns.values()}  # type: ignore[arg-type]
        assert len(lengths) == 1, name


def test_shares_that_cancel_are_put_into_words() -> None:
    assert format_split(0.35, 0.63, 0.02) == "drivetrain 35 %, ground 63 %, cross 2 %"
    told = format_split(6.96, 5.92, -11.88)
    assert "%" not in told
    assert "2.6 and 2.4 times the RMS of their sum" in told


def test_numbers_of_both_inputs_are_told(page: str, report: RunReport) -> None:
    by_input = report.part("by_input")
    for name in ("command", "measured"):
        numbers = by_input[name]
        assert isinstance(numbers, dict)
        for key in ("median_modulus", "median_window_norm", "steady_median_modulus"):
            assert format_number(numbers[key]) in page


def test_medians_of_the_figures_leave_suspect_stretches_out(report: RunReport, page: str) -> None:
    slip = report.tables["slip"].filter(pl.col("input").cast(str) == "command")
    sound = slip.filter(~pl.col("suspect"))["modulus"].median()
    assert isinstance(sound, float)
    assert slip["suspect"].any()
    assert f"from commands, median {sound:.2f} m/s" in page


def test_no_request_can_leave_the_page(outline: Outline, page: str) -> None:
    policy = [found for tag, found in outline.tags if found.get("http-equiv") == "Content-Security-Policy"]
    told = str(policy[0]["content"])
    assert told.startswith("default-src 'none';")
    assert "unsafe-eval" not in told
    assert "http" not in told
    assert "'unsafe-inline'" not in told.split("script-src")[1].split(";", maxsplit=1)[0]
    for tag, found in outline.tags:
        assert tag not in {"link", "iframe", "object", "embed", "base", "img"}
        assert "src" not in found
        assert str(found.get("href", "#")).startswith("#")
        assert not any(name.startswith("on") for name in found)
    urls = re.findall(r"https?://[^\s\"'`)\\<]+", page)
    assert [url for url in urls if not INERT.match(url)] == []


def test_only_our_scripts_may_run(outline: Outline) -> None:
    policy = next(str(found["content"]) for _, found in outline.tags if found.get("http-equiv"))
    runnable = [text for attributes, text in outline.scripts if attributes.get("type") is None]
    assert len(runnable) == 2
    allowed = re.findall(r"'sha256-([^']+)'", policy)
    assert allowed == [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in runnable]


@pytest.mark.parametrize(
    "key", ["run", "vehicle", "terrain", "dataset", "topic", "reason", "finding", "where"]
)
def test_text_out_of_a_log_stays_text(key: str) -> None:
    page = render_report(make_report(duration_s=20.0, names={key: HOSTILE}))
    outline = outline_of(page)
    assert len(outline.scripts) == 3
    assert not any(tag == "img" for tag, _ in outline.tags)
    assert outline.open == []
    assert "alert(1)</script>" not in page
    assert "\u202e" not in page
    assert html.escape("<img src=x onerror=alert(2)>") in page or key == "dataset"
    data_of(outline)


def render_without_figures(**names: str) -> str:
    report = make_report(duration_s=20.0, names=names)
    return render_report(RunReport(report.summary, {}, report.diagnosis))


def test_names_of_any_length_and_several_lines_stay_in_their_places() -> None:
    name = "<b>\n" + "\u200fx\"'" * 3000
    usual = outline_of(render_without_figures())
    outline = outline_of(render_without_figures(vehicle=name, terrain=name, topic=name, reason=name))
    assert [tag for tag, _ in outline.tags] == [tag for tag, _ in usual.tags]
    assert [set(found) for _, found in outline.tags] == [set(found) for _, found in usual.tags]


def test_rows_of_figures_can_neither_end_their_element_nor_start_a_comment() -> None:
    values = {"title": "", "facts": [], "style": "", "scripts": []}
    page = render_template("report/templates/figures.html", data={HOSTILE: [HOSTILE]}, **values)
    outline = outline_of(page)
    packed = outline.scripts[0][1]
    assert not set("<>&'\u2028\u2029") & set(packed)
    assert data_of(outline) == {HOSTILE: [HOSTILE]}
    with pytest.raises(ValueError, match="not JSON compliant"):
        render_template("report/templates/figures.html", data={"rows": float("nan")}, **values)


def test_what_cannot_be_seen_is_shown_and_a_lone_surrogate_can_be_written() -> None:
    assert show_text("a\x00b\u202ec\ud800\n\u202f") == "a\ufffdb\ufffdc\ufffd\n\u202f"
    page = render_without_figures(topic="/a\ud800")
    assert "/a\ufffd" in page
    page.encode()


def test_only_our_style_and_scripts_stand_in_a_page_unescaped() -> None:
    templates = {path.name: path.read_text(encoding="utf-8") for path in TEMPLATES.rglob("*.html")}
    trusted = {name: re.findall(r"\{\{([^}]*\|\s*safe\b[^}]*)\}\}", text) for name, text in templates.items()}
    assert {name: found for name, found in trusted.items() if found} == {
        "base.html": [" style | safe ", " script | safe "]
    }
    # The live page's script is a constant of its template: a block is not escaped, so it holds no value.
    assert len(re.findall(r"\{%-?\s*set\b", templates["watch.html"])) == 1
    assert re.search(r"\{% set script %\}[^{]*\{% endset %\}", templates["watch.html"])
    assert not any(re.search(r"autoescape|Markup", text) for text in templates.values())


def test_a_value_that_a_template_does_not_get_is_an_error() -> None:
    with pytest.raises(jinja2.UndefinedError, match="'title' is undefined"):
        render_template("report/templates/base.html", style="", scripts=[])


def test_same_tables_give_the_same_bytes(page: str) -> None:
    assert render_report(make_report()) == page


def test_a_long_log_stays_small() -> None:
    page = render_report(make_report(duration_s=1350.0))
    assert len(page.encode()) < 3_000_000
    assert "Drawn from" in page


def test_a_short_log_is_drawn_whole() -> None:
    page = render_report(make_report(duration_s=20.0))
    assert "Drawn from" not in outline_text(page)


def outline_text(page: str) -> str:
    return join_commands(page.split("<script", 1)[0])


@pytest.mark.parametrize(
    "gone", ["velocities", "slip", "windows", "aggregates", "findings"], ids=lambda name: f"without_{name}"
)
@pytest.mark.parametrize("empty", [True, False], ids=["empty", "missing"])
def test_a_missing_or_empty_table_costs_only_its_figures(
    report: RunReport, gone: str, *, empty: bool
) -> None:
    tables = {name: frame for name, frame in report.tables.items() if name != gone}
    if empty:
        tables[gone] = report.tables[gone].clear()
    outline = outline_of(render_report(RunReport(report.summary, tables, report.diagnosis, report.motion)))
    drawn = {str(found["data-figure"]) for _, found in outline.tags if "data-figure" in found}
    lost: dict[str, set[str]] = {
        "velocities": {"trajectory"},
        "slip": {"modulus", "distribution", "command_space", "navigator", "step_response"},
        "windows": {"window_norms"},
        "aggregates": {"split"},
        "findings": set(),
    }
    assert set(list_places()) - drawn == lost[gone]
    assert "h2 How bad" in outline.headings


def test_without_a_diagnosis_the_page_proposes_one_and_draws_no_model(report: RunReport) -> None:
    page = render_report(RunReport(report.summary, report.tables))
    drawn = {str(found["data-figure"]) for _, found in outline_of(page).tags if "data-figure" in found}
    signatures = {"signature-effective_track", "signature-drive_lag"}
    of_models = {
        "enough",
        "ladder",
        "budget",
        "residuals",
        "autocorrelation",
        "crosscorrelation",
        "reach",
        *signatures,
    }
    assert set(list_places()) - drawn == of_models
    assert "slip diagnose field/2026-11-02_warthog" in outline_text(page)
    assert "slip serve" not in outline_text(page)


def test_what_a_diagnosis_names_is_told_with_its_numbers(page: str) -> None:
    told = outline_text(page)
    assert "effective_track" in told
    assert "1.74 to 1.84" in told
    assert "x 13" in told
    assert "from command to wheels" in told
    assert "held-out squared error over half a second without it" in told
    assert "Easily confused with wheel_radius." in told
    assert "lateral skid or centre of rotation: drive circles" in told
    assert "not observable in this log" in told
    assert "ideal model 1.06 m and 55 degrees; with the named effects 31 cm" in told
    assert "slip diagnose field/2026-11-02_warthog --apply model.toml" in told


def test_a_run_of_which_nothing_is_known_still_has_a_page() -> None:
    outline = outline_of(render_report(RunReport({}, {})))
    assert outline.open == []
    assert "h2 How bad" in outline.headings
    assert [attributes for attributes, _ in outline.scripts if attributes.get("type") is None] == []


def test_summary_of_odd_kinds_is_no_reason_to_fail() -> None:
    odd = {
        "run": 7,
        "log": None,
        "by_input": [],
        "split": "no",
        "findings": {"a": 1},
        "topics": 3,
        "held_poses": "x",
    }
    assert outline_of(render_report(RunReport(odd, {}))).open == []


@pytest.mark.parametrize("larger", ["drivetrain", "ground"])
def test_the_larger_part_of_the_slip_is_not_called_most_of_it(larger: str) -> None:
    report = make_report(duration_s=20.0)
    split = {"drivetrain": 0.32, "ground": 0.32, "cross": 0.19, larger: 0.49}
    page = outline_text(render_report(RunReport({**report.summary, "split": split}, report.tables)))
    names = ["drivetrain (command to wheels)", "ground (wheels to body)"]
    first, second = names if larger == "drivetrain" else names[::-1]
    assert (
        f"More of the slip from commands arises in the {first} than in the {second}; mean squares: " in page
    )


def test_without_measured_wheels_nothing_is_said_about_the_ground() -> None:
    page = outline_text(render_report(make_report(duration_s=20.0, measured=False)))
    assert "from wheel encoders" not in page
    assert "ground (wheels to body)" not in page
    assert "drivetrain" not in page


def test_a_grave_finding_stands_before_the_numbers() -> None:
    report = make_report(duration_s=20.0)
    grave = {"id": "not_moving", "severity": "error", "text": "the vehicle does not move", "where": ""}
    page = render_report(RunReport({**report.summary, "findings": [grave]}, report.tables))
    warned = page.index("Do not draw conclusions")
    assert warned < page.index("The vehicle does not move") < page.index("median slip")
    assert "slip compare" not in outline_text(page)


def test_a_lone_peak_does_not_flatten_a_figure_and_is_told(page: str) -> None:
    assert re.search(r"peaks cut; the furthest is (9\.0|8\.9)\d m/s at 5\.00 s", page)


def test_losses_and_findings_are_told_gravest_first(page: str) -> None:
    assert "log has losses (1)" in page
    assert "48.2 kB" in page
    assert "quaternion_has_unit_length" in page
    assert page.index("take care") < page.index(">note<")


@pytest.mark.parametrize(
    ("value", "words"),
    [(1234.5, "1,234"), (0.0534, "0.053"), (-2.0, "\u22122.00"), (None, "\u2013"), (0.0, "0")],
)
def test_numbers_keep_three_digits(value: float | None, words: str) -> None:
    assert format_number(value) == words


def test_durations_shares_and_dates_are_said_in_words() -> None:
    assert format_duration(648.2) == "10 min 48 s"
    assert format_duration(3.25) == "3.2 s"
    assert format_duration(7380.0) == "2 h 03 min"
    assert format_recorded(646.0, 629.0) == "10 min 46 s"
    assert format_recorded(646.0, 230.0) == "10 min 46 s, 3 min 50 s of it compared"
    assert format_known_share(0.385) == "38\u202f%"
    assert format_known_share(-0.004) == "\u22120.4\u202f%"
    assert format_date("a", 0) == ""
    assert format_date("a", 2**62) == "2116-02-20 23:53 UTC"


def test_names_of_ours_stay_as_they_are_written() -> None:
    written = ("drive_lag.tau of warthog moved.", "husky_a200_wetgrass: 3 runs", "warnings rose", "")
    assert [begin_large(text) for text in written] == [*written[:2], "Warnings rose", ""]


def test_numbers_that_a_run_does_not_determine_are_marked() -> None:
    """A no-load speed of 100 m/s, the limit of the search, stood in the table as if it were measured."""
    open_number = {"value": 0.1, "low": None, "high": None, "unit": "s", "undetermined": True}
    parameters = {
        "tau": {**open_number, "at_bound": False},
        "limit": {**open_number, "value": 100.0, "at_bound": True},
        "drag": {"value": 0.1, "low": 0.05, "high": 0.2, "unit": "m/s", "undetermined": False},
    }
    rows = _list_parameters({"id": "wheel_servo", "parameters": parameters})
    marks = [row[1].notes for row in rows if not isinstance(row[1], str)]
    assert marks == [[UNDETERMINED], [AT_BOUND], []]


def test_an_undecided_effect_is_an_effect(report: RunReport) -> None:
    alone = {**report.diagnosis, "effects": []}
    shown = render_report(RunReport(report.summary, {}, alone))
    assert shown.count("An effect acts, and this log does not decide which") == 2
    assert "No significant effect" not in shown
    none = render_report(RunReport(report.summary, {}, {**alone, "undecided": []}))
    assert none.count("No significant effect") == 2
