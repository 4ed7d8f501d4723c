"""Nobody is kept out: pages without serious barriers, ramps that need no colour."""

import json
from pathlib import Path

import pytest
from barriers import find_barriers
from chrome import LAPTOP, PHONE, Chrome
from verbs import print_verb

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.report import CATALOGUE, read_own, render_catalogue, theme, write_page
from pipeline.simulate import simulate_case
from pipeline.store import Store

DRAWN = (
    "document.readyState === 'complete' && (document.documentElement.dataset.drawn === 'yes' ||"
    " !document.querySelector('.plot'))"
)


def lightness(colour: str) -> float:
    """CIE L* of a colour #rrggbb: what is left of it where colours are not told apart."""
    parts = [int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)]
    linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    y = 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
    return 116.0 * (y ** (1 / 3) if y > 0.008856 else 7.787 * y + 16.0 / 116.0) - 16.0


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_more_slip_is_told_by_lightness_alone(*, dark: bool) -> None:
    ramp = [theme.DARK_TWINS.get(colour, colour) if dark else colour for colour in theme.SLIP_RAMP]
    steps = [lightness(colour) for colour in ramp]
    assert steps == sorted(steps, reverse=not dark)
    assert abs(steps[-1] - steps[0]) > 45.0


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One page of each kind."""
    folder = tmp_path_factory.mktemp("pages")
    results = folder / "results"
    for number, terrain in enumerate(("tile", "tile", "ice", "ice")):
        log = folder / f"2026-05-{number + 1:02d}" / f"{terrain}_{number}.mcap"
        log.parent.mkdir()
        simulate_case("husky_tile", out=log, seed=number + 1, duration_s=60.0)
        analyze_log(log, Options(out=results, diagnosis=number == 0, overrides={"run": {"terrain": terrain}}))
    for verb in ("compare", "fleet trend", "fleet map"):
        print_verb(*verb.split(), results, "--quiet")
    print_verb("plan", "--vehicle", "husky_a200", "--time", "120s", "--folder", folder / "plan", "--quiet")
    write_page(Store(results), CATALOGUE, render_catalogue(Store(results)))
    return {
        "report": next(results.glob("runs/*/tile_0/*/report.html")),
        "compare": results / "comparison.html",
        "trend": results / "trend.html",
        "map": results / "map.html",
        "catalogue": results / "index.html",
        "plan": folder / "plan" / "plan.html",
    }


@pytest.mark.long
@pytest.mark.parametrize("name", ["report", "compare", "trend", "map", "catalogue", "plan"])
def test_no_page_has_a_serious_barrier(
    name: str, pages: dict[str, Path], chrome: Chrome, pictures: Path
) -> None:
    for width, dark in ((LAPTOP, False), (PHONE, True)):
        chrome.size(width, 900, dark=dark)
        chrome.open(pages[name].as_uri())
        chrome.wait(DRAWN)
        # What is folded is part of the page.
        chrome.run("document.querySelectorAll('.chapter').forEach((chapter) => (chapter.open = true))")
        chrome.wait("!document.querySelector('.chapter[open] > .figures > figure > .plot:not(.drawn)')")
        chrome.picture(pictures / f"barriers_{name}_{width}.png", whole=True)
        assert find_barriers(chrome) == [], json.dumps([name, width])
        assert chrome.errors == []


@pytest.mark.long
def test_a_long_name_in_a_heading_does_not_widen_a_page(chrome: Chrome, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    style, name = read_own("report/page.css"), "warthog_wheels_gravel_2024_8_6_11h37s32" * 2
    head = f'<meta name="viewport" content="width=device-width"><style>{style}</style>'
    page.write_text(f"{head}<main><h2>run logs/{name}</h2><h3>{name}</h3></main>", "utf-8")
    chrome.size(PHONE, 600)
    chrome.open(page.as_uri())
    chrome.wait("document.querySelector('h3') !== null")
    assert int(str(chrome.run("document.documentElement.scrollWidth"))) <= PHONE
