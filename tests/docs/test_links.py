"""Every link of README and handbook leads somewhere, in a checkout and in the built handbook."""

import posixpath
import re
from pathlib import Path

import pytest
from markdown.extensions.toc import slugify
from reference import SOURCES, find_page, write_reference

pytestmark = pytest.mark.lint

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs" / "pages"
TEXTS = [
    *sorted(ROOT.glob("*.md")),
    *sorted(PAGES.rglob("*.md")),
    *(ROOT / name / "README.md" for name in ("data_samples", "examples")),
]
FENCE = re.compile(r"^(```|~~~).*?^\1", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"!?\[(?:[^\[\]]|\[[^\]]*\])*\]\(\s*<?([^)\s>]+)|^\[[^\]]+\]:\s*(\S+)", re.MULTILINE)
HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)
WITH_SCHEME = re.compile(r"[a-z]+:")


def list_links(text: str) -> list[str]:
    """Targets of a text's links and pictures, fenced blocks and inline code left out."""
    plain = re.sub(r"`[^`\n]*`", "``", FENCE.sub("", text))
    return [one or other for one, other in LINK.findall(plain)]


def list_anchors(text: str) -> set[str]:
    """Anchors of a text's headings, as GitHub and the handbook both make them of plain words."""
    return {slugify(re.sub(r"[`*]", "", heading), "-") for heading in HEADING.findall(FENCE.sub("", text))}


def find_dead(path: Path) -> list[str]:
    """Links of a text that lead nowhere."""
    dead = []
    for link in list_links(path.read_text(encoding="utf-8")):
        if WITH_SCHEME.match(link):
            continue
        name, _, anchor = link.partition("#")
        target = path.parent / name if name else path
        if not target.exists() or (anchor and anchor not in list_anchors(target.read_text(encoding="utf-8"))):
            dead.append(link)
    return dead


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_every_link_leads_somewhere(path: Path) -> None:
    assert find_dead(path) == []


def test_a_link_out_of_the_pages_has_its_page_in_the_handbook() -> None:
    made = {*write_reference(), *(f"notebooks/{path.name}" for path in (ROOT / "examples").glob("*.ipynb"))}
    found = [
        (page.name, posixpath.normpath((page.parent.relative_to(ROOT) / link.partition("#")[0]).as_posix()))
        for page in PAGES.rglob("*.md")
        for link in list_links(page.read_text(encoding="utf-8"))
        if not WITH_SCHEME.match(link) and not (page.parent / link).resolve().is_relative_to(PAGES)
    ]
    assert len(found) > 50
    assert [(name, source) for name, source in found if find_page(source) not in made] == []


def test_all_sources_of_generated_pages_are_there() -> None:
    pages = write_reference()
    assert set(SOURCES) == {page for page in pages if not page.startswith("effects/")} | {"effects/index.md"}
    assert all((ROOT / source).exists() for source in SOURCES.values())
    effects = sorted(page for page in pages if page.startswith("effects/") and page not in SOURCES)
    folder = SOURCES["effects/index.md"]
    sources = [f"{folder}/{page.removeprefix('effects/').removesuffix('.md')}.py" for page in effects]
    assert [source for source in sources if not (ROOT / source).exists()] == []
    assert [find_page(source) for source in sources] == effects


def test_what_leads_nowhere_is_noticed(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "# One and two\n[a](#one-and-two) [b](#three) [c](gone.md) ![d](page.md) `[e](no)` [f](https://x.org)\n"
        "```\n[g](no)\n```\n[h][i]\n\n[i]: lost.md\n"
    )
    assert find_dead(page) == ["#three", "gone.md", "lost.md"]
