"""Pages over many runs in a real browser, as wide as a phone and as a laptop: nothing is cut or overlaps."""

from pathlib import Path
from typing import cast

import pytest
from chrome import Chrome
from comparison_store import Run, write_run
from verbs import print_verb

from pipeline.store import Store

DRAWN = "document.documentElement?.dataset.drawn === 'yes'"
CUT = """[...document.querySelectorAll('.table')].filter((box) => box.scrollWidth > box.clientWidth + 1)
  .map((box) => box.getAttribute('aria-label'))"""
OVERLAPS = """(() => {
  const boxes = [...document.querySelectorAll('[data-figure] .mark-text text')]
    .map((text) => [text.textContent, text.getBoundingClientRect()]).filter(([, box]) => box.width);
  const found = [];
  for (const [i, [one, a]] of boxes.entries()) for (const [other, b] of boxes.slice(i + 1))
    if (a.left < b.right - 1 && b.left < a.right - 1 && a.top < b.bottom - 2 && b.top < a.bottom - 2)
      found.push([one, other]);
  return found;
})()"""


@pytest.fixture
def results(tmp_path: Path) -> Path:
    folder = tmp_path / "results"
    for vehicle, mass in (("warthog", 470.0), ("husky_a200", 75.0)):
        for terrain in ("asphalt", "gravel", "ice", "snow"):
            for number in range(2):
                dataset = f"{vehicle}_{terrain}"
                made = Run(
                    name=f"field/{dataset}_of_a_long_day_{number}",
                    dataset=dataset,
                    vehicle=vehicle,
                    terrain=terrain,
                    mass_kg=mass,
                    sha256=f"{dataset}{number}",
                    estimates=[("effective_track", "k", 1.7 + 0.02 * number, 0.01)],
                )
                write_run(Store(folder), made, seed=number)
    return folder


@pytest.mark.parametrize(
    "verb",
    [
        "compare",
        pytest.param("fleet map", marks=pytest.mark.long),
        pytest.param("fleet trend", marks=pytest.mark.long),
    ],
)
def test_nothing_is_cut_or_overlaps(verb: str, chrome: Chrome, results: Path, pictures: Path) -> None:
    print_verb(*verb.split(), results, "--quiet")
    page = results / {"compare": "comparison.html"}.get(verb, f"{verb.removeprefix('fleet ')}.html")
    for width in (390, 1280):
        chrome.size(width, 900, dark=width < 600)
        chrome.open(page.as_uri())
        chrome.wait(DRAWN)
        chrome.picture(pictures / f"{page.stem}_{width}.png", whole=True)
        assert (
            cast(
                "int",
                chrome.run("document.documentElement.scrollWidth - document.documentElement.clientWidth"),
            )
            <= 0
        )
        assert chrome.run(CUT) == []
        assert chrome.run(OVERLAPS) == []
    assert chrome.errors == []
