"""Names out of logs stay text on every page that many runs share."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
from comparison_store import Run, write_run
from few import few

from pipeline.datasets.compare import compare_results
from pipeline.datasets.compared_runs import Question
from pipeline.datasets.deployments import draw_up_map
from pipeline.datasets.trend import follow_trend
from pipeline.report import render_catalogue
from pipeline.report.datasets_page import write_answer, write_map, write_trend
from pipeline.store import Store

DAY_NS = 86_400_000_000_000
HOSTILE = {
    "script": "<script>alert(1)</script>",
    "quotes": '" onmouseover="alert(1)" \' onfocus=\'alert(2)',
    "template": "{{ 7 * 7 }}{% include 'x' %}{# &lt;b&gt; #}",
    "turned": "a\u202egnp.exe\u2066\u200f\x1b[31m",
    "newline": "one\n--><img src=x onerror=alert(3)>\n<!--",
    "long": "<i>" + "x" * 10_000,
}
INERT = {"script", "style"}


class Seen(HTMLParser):
    """Elements, attributes and shown text of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.elements: list[str] = []
        self.attributes: set[str] = set()
        self.text = ""
        self.data = ""
        self.open: list[dict[str, str | None]] = []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append(tag)
        self.attributes |= {name for name, _ in attrs}
        self.open = [dict(attrs)] if tag in INERT else []

    def handle_endtag(self, tag: str) -> None:
        del tag
        self.open = []

    def handle_data(self, data: str) -> None:
        if not self.open:
            self.text += data
        elif self.open[0].get("id") == "page-data":
            self.data += data


def render_pages(folder: Path, name: str) -> dict[str, str]:
    """All pages over four runs of two datasets with that name for vehicle, terrain and dataset."""
    store = Store(folder)
    for number in range(4):
        label = f"{name}{number % 2}"
        run = Run(
            name=f"run_{number}",
            dataset=f"dataset {label}",
            vehicle=f"vehicle {name}",
            terrain=f"terrain {label}" if number % 2 else "ice",
            median=1.0 + number,
            seconds=20.0,
            start_ns=1_700_000_000_000_000_000 + number * DAY_NS,
        )
        write_run(store, run)
    answer = compare_results(store, Question())
    trend = follow_trend(store, ("vehicle",))
    return {
        "comparison": write_answer(store, answer)["comparison.html"].read_text(encoding="utf-8"),
        "map": write_map(store, draw_up_map(store))["map.html"].read_text(encoding="utf-8"),
        "trend": write_trend(store, trend)["trend.html"].read_text(encoding="utf-8"),
        "catalogue": render_catalogue(store),
    }


@pytest.fixture(scope="module")
def harmless(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return render_pages(tmp_path_factory.mktemp("harmless"), "plain")


@pytest.mark.parametrize("kind", few(HOSTILE, 3))
def test_names_of_vehicles_terrains_and_datasets_stay_text(
    kind: str, tmp_path: Path, harmless: dict[str, str]
) -> None:
    name = HOSTILE[kind]
    shown = re.sub("[\u202e\u2066\u200f\x1b]", "\ufffd", name)
    for page, html in render_pages(tmp_path, name).items():
        seen, usual = Seen(html), Seen(harmless[page])
        assert seen.elements == usual.elements, page
        assert seen.attributes == usual.attributes, page
        assert shown in seen.text, page
        assert not set("\u202e\u2066\u200f\x1b") & set(html), page
        if seen.data:
            assert not set("<>&'\u2028\u2029") & set(seen.data), page
            json.loads(seen.data)
