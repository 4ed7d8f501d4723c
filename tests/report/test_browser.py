"""The page in a real browser, from a file, at the widths of a phone and of a laptop."""

import base64
import hashlib
import html
import json
import queue
import re
import subprocess
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import cast

import pytest
from chrome import BROWSER, FLAGS, LAPTOP, PHONE, Chrome
from report_synthesis import list_places, make_report

from pipeline.report.page import render_report

WINDOW = "--window-size=1400,1000"
PATIENCE_S = 40.0

# Runs before anything else of the page, tries it as a reader would, and tells its parent what it saw.
PROBE = """
(() => {
  const seen = {errors: [], blocked: []};
  addEventListener("error", (event) => seen.errors.push(String(event.message)));
  addEventListener("unhandledrejection", (event) => seen.errors.push(String(event.reason)));
  addEventListener("securitypolicyviolation", (event) => seen.blocked.push(event.blockedURI));
  for (const kind of ["error", "warn"]) console[kind] = (...said) => seen.errors.push(said.join(" "));
  const wait = (ready) => new Promise((done) => {
    const look = () => (ready() ? done() : setTimeout(look, 20));
    look();
  });
  const plot = (id) => document.querySelector(`[data-figure=${id}]`);
  const words = (selector) => [...document.querySelectorAll(selector)].map((text) => text.textContent);
  const labels = (id) => words(`[data-figure=${id}] .role-axis-label text`);
  const outside = () => [...document.querySelectorAll(".plot svg")].flatMap((svg) => {
    const room = svg.parentElement.closest(".plot").getBoundingClientRect();
    const box = svg.getBoundingClientRect();
    const cut = [...svg.querySelectorAll("text")].filter((text) => {
      const word = text.getBoundingClientRect();
      return word.width && (word.left < box.left - 1 || word.right > box.right + 1);
    });
    const shrunk = svg.width.baseVal.value > room.width + 1;
    return [...(shrunk || box.right > room.right + 1 ? ["svg"] : []), ...cut.map((text) => text.textContent)];
  });
  addEventListener("load", async () => {
    await wait(() => document.documentElement.dataset.drawn === "yes");
    seen.first = [...document.querySelectorAll(".plot.drawn")].map((place) => place.dataset.figure);
    for (const chapter of document.querySelectorAll("details")) chapter.open = true;
    await wait(() => !document.querySelector(".plot:not(.drawn)"));
    seen.drawn = Object.fromEntries([...document.querySelectorAll("[data-figure]")].map(
      (place) => [place.dataset.figure, place.querySelectorAll("svg path").length]));
    seen.labels = Object.fromEntries([...document.querySelectorAll("[data-figure]")].map(
      (place) => [place.dataset.figure, `${place.role}: ${place.ariaLabel}`]));
    seen.wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
    seen.outside = outside();
    seen.scrolled = [...document.querySelectorAll(".table")].map(
      (table) => table.scrollWidth - table.clientWidth);
    seen.before = labels("reach");
    seen.large = labels("velocities");
    const empty = plot("trajectory").querySelectorAll("path").length;
    document.getElementById("mark-from").value = "10";
    document.getElementById("mark-to").value = "20";
    document.getElementById("mark-set").click();
    await wait(() => plot("trajectory").querySelectorAll("path").length > empty);
    seen.marked = document.querySelector("#marked span").textContent;
    seen.onMap = plot("trajectory").querySelectorAll("path").length - empty;
    document.getElementById("zoom-in").click();
    await wait(() => labels("reach").join() !== seen.before.join());
    await wait(() => labels("velocities").join() !== seen.large.join());
    seen.zoomed = labels("velocities");
    dispatchEvent(new KeyboardEvent("keydown", {key: "Escape"}));
    document.dispatchEvent(new KeyboardEvent("keydown", {key: "Escape"}));
    await wait(() => plot("trajectory").querySelectorAll("path").length === empty);
    document.querySelector(".moment").click();
    await wait(() => plot("trajectory").querySelectorAll("path").length > empty);
    seen.moment = document.querySelector("#marked span").textContent;
    seen.requests = performance.getEntriesByType("resource").map((entry) => entry.name);
    parent.postMessage(JSON.stringify(seen), "*");
  });
})();
"""

FRAME = """<!DOCTYPE html><html><body><iframe src="page.html" width="{width}" height="900"></iframe>
<script>addEventListener("message", (event) => fetch("{listener}", {{
  method: "POST", mode: "no-cors", body: event.data,
}}));</script></body></html>"""


class Listener(BaseHTTPRequestHandler):
    told: queue.Queue[bytes]

    def do_POST(self) -> None:
        self.told.put(self.rfile.read(int(self.headers["Content-Length"])))
        self.send_response(204)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


def look_at(page: str, folder: Path, width: int) -> dict[str, object]:
    digest = base64.b64encode(hashlib.sha256(PROBE.encode()).digest()).decode()
    probed = page.replace("script-src ", f"script-src 'sha256-{digest}' ", 1)
    probed = probed.replace("<title>", f"<script>{PROBE}</script><title>", 1)
    (folder / "page.html").write_text(probed, encoding="utf-8")
    told: queue.Queue[bytes] = queue.Queue()
    with HTTPServer(("127.0.0.1", 0), type("Told", (Listener,), {"told": told})) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        frame = FRAME.format(width=width, listener=f"http://127.0.0.1:{server.server_port}/")
        (folder / "frame.html").write_text(frame, encoding="utf-8")
        browser = subprocess.Popen(
            [
                str(BROWSER),
                *FLAGS,
                WINDOW,
                f"--user-data-dir={folder / 'profile'}",
                (folder / "frame.html").as_uri(),
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            seen: dict[str, object] = json.loads(told.get(timeout=PATIENCE_S))
        finally:
            browser.terminate()
            browser.wait(timeout=PATIENCE_S)
            server.shutdown()
    return seen


@pytest.fixture(scope="module")
def page() -> str:
    return render_report(make_report(duration_s=120.0))


@pytest.fixture(
    scope="module", params=[PHONE, pytest.param(LAPTOP, marks=pytest.mark.long)], ids=["phone", "laptop"]
)
def seen(
    request: pytest.FixtureRequest, page: str, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, object]:
    if BROWSER is None:
        pytest.skip("no Chromium here to open the page with")
    return look_at(page, tmp_path_factory.mktemp("browser"), request.param)


def test_the_page_opens_without_errors_or_requests(seen: dict[str, object]) -> None:
    assert seen["errors"] == []
    assert seen["blocked"] == []
    assert seen["requests"] == []


def test_every_figure_is_drawn(seen: dict[str, object]) -> None:
    drawn = seen["drawn"]
    assert isinstance(drawn, dict)
    assert set(drawn) == set(list_places())
    assert min(drawn.values()) > 3


def test_every_drawn_figure_says_to_a_screen_reader_what_it_shows(page: str, seen: dict[str, object]) -> None:
    figures = re.findall(r'data-figure="([\w-]+)" role="img" aria-label="([^"]*)"', page)
    assert seen["labels"] == {name: f"img: {html.unescape(words)}" for name, words in figures}


def test_only_the_answer_is_open_at_first(seen: dict[str, object]) -> None:
    drawn = ["paths", "stretch", "ladder", "signature-effective_track", "signature-drive_lag"]
    assert seen["first"] == drawn


def test_nothing_is_cut_or_wider_than_the_screen(seen: dict[str, object]) -> None:
    assert isinstance(seen["wide"], int)
    assert seen["wide"] <= 0
    assert seen["outside"] == []
    assert set(seen["scrolled"]) == {0}  # type: ignore[call-overload]


def test_a_marked_stretch_shows_on_the_map_and_can_be_zoomed_into(seen: dict[str, object]) -> None:
    assert str(seen["marked"]).startswith("Marked 10.0\u201320.0 s: 10.0 s, highest slip")
    assert seen["onMap"] == 201
    # The times with the largest errors can be marked, too.
    assert str(seen["moment"]).startswith("Marked 12.0\u201316.0 s")
    assert "100" in seen["before"]  # type: ignore[operator]
    assert "100" not in seen["zoomed"]  # type: ignore[operator]
    assert {"12", "18"} <= set(seen["zoomed"])  # type: ignore[call-overload]


@pytest.mark.long
def test_the_strip_of_the_whole_run_chooses_what_is_drawn_large(
    page: str, chrome: Chrome, tmp_path: Path
) -> None:
    (tmp_path / "page.html").write_text(page, encoding="utf-8")
    chrome.size(LAPTOP, 900)
    chrome.open((tmp_path / "page.html").as_uri())
    chrome.wait("document.documentElement?.dataset.drawn === 'yes'")
    chrome.click("#how-bad > summary")
    chrome.wait("!document.querySelector('#how-bad .plot:not(.drawn)')")
    words = "[...document.querySelectorAll('[data-figure={}] .role-axis-label text')].map((t) => t.{})"
    large, whole = (words.format(name, "textContent") for name in ("velocities", "modulus"))
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
def test_names_of_options_do_not_break_at_their_hyphens(tmp_path: Path, chrome: Chrome) -> None:
    report = make_report(duration_s=120.0)
    (tmp_path / "page.html").write_text(render_report(report), encoding="utf-8")
    chrome.open((tmp_path / "page.html").as_uri())
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
    (tmp_path / "page.html").write_text(page, encoding="utf-8")
    chrome.size(LAPTOP, 900)
    chrome.open(f"{(tmp_path / 'page.html').as_uri()}#where")
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
