import base64
import hashlib
import html
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import jinja2
import pytest
from report_synthesis import list_places, make_report

from pipeline import report
from pipeline.report import (
    format_number,
    render_template,
    show_text,
)
from pipeline.report.page import render_report, show_figures
from pipeline.report.pages import Page
from pipeline.report.scene import RunReport

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


def test_text_out_of_a_log_stays_text() -> None:
    for key in ["run", "vehicle", "terrain", "dataset", "topic", "reason", "finding", "where"]:
        page = render_report(make_report(duration_s=20.0, names={key: HOSTILE}))
        outline = outline_of(page)
        assert len(outline.scripts) == 4
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
    values = {"title": "", "page": Page("", [], []), "style": "", "scripts": []}
    page = render_template("report/templates/page.html", data={HOSTILE: [HOSTILE]}, **values)
    outline = outline_of(page)
    packed = outline.scripts[0][1]
    assert not set("<>&'\u2028\u2029") & set(packed)
    assert data_of(outline) == {HOSTILE: [HOSTILE]}
    with pytest.raises(ValueError, match="not JSON compliant"):
        render_template("report/templates/page.html", data={"rows": float("nan")}, **values)


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


def test_a_missing_or_empty_table_costs_only_its_figures(report: RunReport) -> None:
    for empty in [True, False]:
        for gone in ["velocities", "slip", "windows", "aggregates", "findings"]:
            tables = {name: frame for name, frame in report.tables.items() if name != gone}
            if empty:
                tables[gone] = report.tables[gone].clear()
            outline = outline_of(
                render_report(RunReport(report.summary, tables, report.diagnosis, report.motion))
            )
            drawn = {str(found["data-figure"]) for _, found in outline.tags if "data-figure" in found}
            lost: dict[str, set[str]] = {
                "velocities": {"trajectory", "paths", "stretch"},
                "slip": {"modulus", "command_space", "step_response", "stretch"},
                "windows": set(),
                "aggregates": {"split"},
                "findings": set(),
            }
            assert set(list_places()) - drawn == lost[gone]
            assert "h2 How much slip" in outline.headings


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


@pytest.mark.parametrize(
    ("value", "text"), [(0.99997, "1.00"), (9.996, "10.0"), (0.2414, "0.241"), (1234.5, "1,234"), (0.0, "0")]
)
def test_a_number_that_is_rounded_up_has_no_digit_too_many(value: float, text: str) -> None:
    assert format_number(value) == text


def test_a_figure_of_its_own_says_what_is_on_each_axis() -> None:
    shown = {name: figure.to_dict() for name, figure in show_figures(make_report()).items()}
    heads = {
        "signature-effective_track": "yaw rate error [rad/s]",
        "enough": "relative half-width of the 95 % interval",
        "modulus": "[m/s]",
    }
    for name, head in heads.items():
        assert head in " ".join(shown[name]["title"]["subtitle"]), name
    assert shown["ladder"]["title"] == "The error after each effect"
