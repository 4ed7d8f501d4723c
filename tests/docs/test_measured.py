"""Tables of the handbook: what was measured, at a version that is not too old."""

import json
from collections.abc import Mapping
from pathlib import Path

import measured_tables as tables
import pytest

pytestmark = pytest.mark.lint

ROOT = Path(__file__).parents[2]
FILES = sorted(tables.MEASURED.glob("*.json"))


def test_the_pages_say_what_was_measured() -> None:
    places = [
        found["name"] for page in tables.PAGES for found in tables.BLOCK.finditer(page.read_text("utf-8"))
    ]
    assert set(places) == set(tables.RENDERERS)
    for page in tables.PAGES:
        text = page.read_text(encoding="utf-8")
        assert (
            text.count("<!-- measured:")
            == text.count("<!-- /measured -->")
            == len(tables.BLOCK.findall(text))
        )
        assert tables.fill_page(text) == text, f"{page.relative_to(ROOT)}: make bench NAME=measured_tables"


def test_every_number_that_was_measured_is_shown() -> None:
    assert {path.stem for path in FILES} == {name for names, _ in tables.RENDERERS.values() for name in names}


@pytest.mark.parametrize("name", ["accuracy", "paper"])
def test_no_headline_is_older_than_the_program_by_more_than_a_version(name: str) -> None:
    outdated = tables.find_outdated(tables.read_measured(name), tables.list_versions())
    assert outdated == [], "make bench NAME=measure"


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_table_that_is_older_says_so(path: Path) -> None:
    data = tables.read_measured(path.stem)
    outdated = tables.find_outdated(data, tables.list_versions())
    assert ("**Outdated**" in " ".join(tables.name_origin(data))) == bool(outdated)


def test_a_table_may_be_one_version_older_and_no_more() -> None:
    data = {"versions": {"diagnosis": 7, "slip": 3}}
    assert tables.find_outdated(data, {"diagnosis": 8, "slip": 3, "extract": 9}) == []
    (told,) = tables.find_outdated(data, {"diagnosis": 9, "slip": 3})
    assert told == "diagnosis: measured at version 7, the program has 9"


def test_a_page_that_was_edited_by_hand_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = tables.BLOCK.search((tables.PAGES_FOLDER / "accuracy.md").read_text(encoding="utf-8"))
    assert page is not None
    text = page[0].replace(" of ", " out of ", 1)
    assert tables.fill_page(text) == page[0] != text

    measured = tmp_path / "measured"
    measured.mkdir()
    for path in FILES:
        content: Mapping[str, object] = json.loads(path.read_text(encoding="utf-8"))
        (measured / path.name).write_text(json.dumps({**content, "commit": "0000000"}), encoding="utf-8")
    monkeypatch.setattr(tables, "MEASURED", measured)
    assert "at 0000000 (" in tables.fill_page(page[0])


@pytest.mark.parametrize(
    ("paper", "value", "low", "high", "said"),
    [
        (0.95, 1.23, 1.05, 1.44, "**no**, 29 % above"),
        (1.716, 1.70, 1.51, 1.86, "yes, 1 % below"),
        (2.76, 3.15, 2.88, 3.43, "**no**, 14 % above"),
    ],
)
def test_a_number_of_the_paper_is_reproduced_where_the_interval_holds_it(
    paper: float, value: float, low: float, high: float, said: str
) -> None:
    assert tables.judge(paper, value, low, high) == said
