"""The page in a real browser, from a file, at the widths of a phone and of a laptop."""

import html
import json
import re
from pathlib import Path
from typing import cast

import pytest
from chrome import LAPTOP, PHONE, Chrome
from report_synthesis import list_places, make_report

from pipeline.report.page import render_report

LABELS = "[...document.querySelectorAll('[data-figure={}] .role-axis-label text')].map((t) => t.textContent)"
PLOTS = "[...document.querySelectorAll('.plot[data-figure]')]"
OUTSIDE = """[...document.querySelectorAll(".plot svg")].flatMap((svg) => {
  const room = svg.parentElement.closest(".plot").getBoundingClientRect();
  const box = svg.getBoundingClientRect();
  const cut = [...svg.querySelectorAll("text")].filter((text) => {
    const word = text.getBoundingClientRect();
    return word.width && (word.left < box.left - 1 || word.right > box.right + 1);
  });
  const shrunk = svg.width.baseVal.value > room.width + 1;
  return [...(shrunk || box.right > room.right + 1 ? ["svg"] : []), ...cut.map((text) => text.textContent)];
})"""
NUMBER_ON_MAP = "document.querySelectorAll('[data-figure=trajectory] path').length"


@pytest.fixture(scope="module")
def page() -> str:
    return render_report(make_report(duration_s=120.0))


def open_page(chrome: Chrome, page: str, folder: Path, width: int, anchor: str = "") -> str:
    """Open a page of that width; its address."""
    (folder / "page.html").write_text(page, encoding="utf-8")
    chrome.size(width, 900)
    address = f"{(folder / 'page.html').as_uri()}{anchor}"
    chrome.open(address)
    chrome.wait("document.documentElement?.dataset.drawn === 'yes'")
    return address


@pytest.mark.parametrize("width", [PHONE, pytest.param(LAPTOP, marks=pytest.mark.long)])
def test_every_figure_is_drawn_said_and_whole_without_errors_or_requests(
    width: int, page: str, chrome: Chrome, tmp_path: Path
) -> None:
    address = open_page(chrome, page, tmp_path, width)
    first = chrome.run(f"{PLOTS}.filter((p) => p.classList.contains('drawn')).map((p) => p.dataset.figure)")
    answer = ["paths", "stretch", "ladder", "signature-effective_track", "signature-drive_lag"]
    assert first == answer, "only the answer is open at first"
    chrome.run("document.querySelectorAll('details').forEach((chapter) => (chapter.open = true))")
    chrome.wait("!document.querySelector('.plot:not(.drawn)')")
    paths = f"{PLOTS}.map((p) => [p.dataset.figure, p.querySelectorAll('svg path').length])"
    drawn = dict(cast("list[tuple[str, int]]", chrome.run(paths)))
    assert set(drawn) == set(list_places())
    assert min(drawn.values()) > 3
    labels = chrome.run(f"{PLOTS}.map((p) => [p.dataset.figure, p.role, p.ariaLabel])")
    said = re.findall(r'data-figure="([\w-]+)" role="img" aria-label="([^"]*)"', page)
    assert labels == [[name, "img", html.unescape(words)] for name, words in said]
    size = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
    assert int(str(chrome.run(size))) <= 0
    assert chrome.run(OUTSIDE) == []
    tables = "[...document.querySelectorAll('.table')].every((one) => one.scrollWidth === one.clientWidth)"
    assert chrome.run(tables)
    assert chrome.errors == []
    assert chrome.requests == [address]


def test_a_marked_stretch_shows_on_the_map_and_can_be_zoomed_into(
    page: str, chrome: Chrome, tmp_path: Path
) -> None:
    open_page(chrome, page, tmp_path, PHONE)
    chrome.run("document.querySelectorAll('details').forEach((chapter) => (chapter.open = true))")
    chrome.wait("!document.querySelector('.plot:not(.drawn)')")
    errors, said = LABELS.format("reach"), "document.querySelector('#marked span').textContent"
    empty, before = int(str(chrome.run(NUMBER_ON_MAP))), cast("list[str]", chrome.run(errors))
    chrome.run(
        "document.getElementById('mark-from').value = 10, document.getElementById('mark-to').value = 20"
    )
    chrome.run("document.getElementById('mark-set').click()")
    chrome.wait(f"{NUMBER_ON_MAP} === {empty + 201}")
    assert str(chrome.run(said)).startswith("Marked 10.0\u201320.0 s: 10.0 s, highest slip")
    chrome.run("document.getElementById('zoom-in').click()")
    chrome.wait(f"{errors}.join() !== {json.dumps(before)}.join()")
    chrome.wait(f"{LABELS.format('velocities')}.includes('18')")
    zoomed = cast("list[str]", chrome.run(LABELS.format("velocities")))
    assert "100" in before
    assert "100" not in zoomed
    assert {"12", "18"} <= set(zoomed)
    chrome.press("Escape", 27)
    chrome.press("Escape", 27)
    chrome.wait(f"{NUMBER_ON_MAP} === {empty}")
    # The times with the largest errors can be marked, too.
    chrome.run("document.querySelector('.moment').click()")
    chrome.wait(f"{NUMBER_ON_MAP} > {empty}")
    assert str(chrome.run(said)).startswith("Marked 12.0\u201316.0 s")


def test_signals_of_ones_choice_are_drawn_and_zoomed_with_the_others(
    page: str, chrome: Chrome, tmp_path: Path
) -> None:
    open_page(chrome, page, tmp_path, PHONE)
    chrome.click("#signals > summary")
    chrome.wait("!document.querySelector('#signals .plot:not(.drawn)')")
    paths = "document.querySelectorAll('[data-figure=signals] .mark-line path')"
    lines = f"[...{paths}].map((path) => path.getAttribute('d'))"
    first = cast("list[str]", chrome.run(lines))
    assert len(first) == 2
    assert all("NaN" not in line and len(line) > 500 for line in first)
    chrome.run(
        "{const choice = document.querySelectorAll('.signal')[1];"
        " choice.value = 'g_w'; choice.dispatchEvent(new Event('change'))}"
    )
    chrome.wait(f"{lines}[1] !== {json.dumps(first[1])}")
    drawn = cast("list[str]", chrome.run(lines))
    assert drawn[0] == first[0]
    assert "NaN" not in drawn[1]
    said = str(chrome.run("document.querySelector('[data-figure=signals]').getAttribute('aria-label')"))
    assert said == "Over time: v_x of velocities and g_w of slip from commands."
    chrome.drag("[data-figure=signals]", (0.4, 0.2), (0.7, 0.2))
    chrome.wait("!document.getElementById('marked').hidden")
    chrome.click("#zoom-in")
    chrome.wait(f"{lines}[0] !== {json.dumps(first[0])}")
    chosen = cast(
        "list[str]", chrome.run("[...document.querySelectorAll('.signal')].map((one) => one.value)")
    )
    assert chosen == ["v_x", "g_w"], "zooming keeps what was chosen"
    assert chrome.errors == []


@pytest.mark.long
def test_the_strip_of_the_whole_run_chooses_what_is_drawn_large(
    page: str, chrome: Chrome, tmp_path: Path
) -> None:
    open_page(chrome, page, tmp_path, LAPTOP)
    chrome.click("#how-bad > summary")
    chrome.wait("!document.querySelector('#how-bad .plot:not(.drawn)')")
    large, whole = map(LABELS.format, ("velocities", "modulus"))
    first = chrome.run(large)
    strip = chrome.run(whole)
    chrome.drag("[data-figure=modulus]", (0.5, 0.3), (0.75, 0.3))
    chrome.wait(f"{large}.join() !== {json.dumps(first)}.join()")
    assert {"70", "80"} <= set(chrome.run(large))  # type: ignore[call-overload]
    dragged = chrome.run(large)
    chrome.run("document.querySelector('[data-figure=modulus]').focus()")
    chrome.press("ArrowLeft", 37)
    chrome.wait(f"{large}.join() !== {json.dumps(dragged)}.join()")
    assert {"50", "60"} <= set(chrome.run(large))  # type: ignore[call-overload]
    assert chrome.run(whole) == strip, "the strip stays whole"
    chrome.click("#zoom-out")
    chrome.wait(f"{large}.join() === {json.dumps(first)}.join()")
    assert chrome.errors == []


BROKEN = """
[...document.querySelectorAll("main li, main p, main dd, main td")].flatMap((place) => {
  const texts = document.createTreeWalker(place, NodeFilter.SHOW_TEXT), found = [];
  while (texts.nextNode()) for (const option of texts.currentNode.data.matchAll(/--[a-z][a-z-]*/g)) {
    const range = document.createRange();
    range.setStart(texts.currentNode, option.index);
    range.setEnd(texts.currentNode, option.index + option[0].length);
    const lines = new Set([...range.getClientRects()].map((box) => Math.round(box.top)));
    found.push([option[0], lines.size]);
  }
  return found;
})
"""


@pytest.mark.long
def test_names_of_options_do_not_break_at_their_hyphens(page: str, chrome: Chrome, tmp_path: Path) -> None:
    open_page(chrome, page, tmp_path, LAPTOP)
    options = []
    # One of these widths would end a line inside of each option.
    for width in range(300, 420, 6):
        chrome.size(width, 900)
        options += cast("list[tuple[str, int]]", chrome.run(BROKEN))
    assert {"--apply", "--to", "--on"} & {option for option, _ in options}
    assert [option for option, lines in options if lines > 1] == []


@pytest.mark.long
def test_one_moment_shows_in_every_figure_and_can_be_played(
    page: str, chrome: Chrome, tmp_path: Path
) -> None:
    open_page(chrome, page, tmp_path, LAPTOP, "#where")
    chrome.wait(
        "document.querySelector('#where')?.open && !document.querySelector('#where .plot:not(.drawn)')"
    )
    marked = "[...document.querySelectorAll('.cursor-mark')].map((mark) => mark.parentElement.dataset.figure)"
    assert chrome.run(marked) == []
    # By keys, as by the pointer.
    chrome.run("document.querySelector('.moment-slider').focus()")
    for _ in range(80):
        chrome.press("ArrowRight", 39)
    chrome.wait("document.querySelector('.moment-said').textContent.startsWith('4.0 s')")
    chrome.wait(f"new Set({marked}).size > 2")
    assert {"paths", "stretch", "trajectory"} <= set(cast("list[str]", chrome.run(marked)))
    told = str(chrome.run("document.querySelector('.moment-said').textContent"))
    assert "forward [m/s] measured" in told
    assert "cm off" in told
    slider = "Number(document.querySelector('.moment-slider').value)"
    chrome.click(".play")
    chrome.wait(f"{slider} > 6")
    chrome.click(".play")
    stopped = chrome.run(slider)
    assert chrome.run("document.querySelector('.play').textContent") == "Play"
    assert chrome.run(slider) == stopped
    assert chrome.errors == []
