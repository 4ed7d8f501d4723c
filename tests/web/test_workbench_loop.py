"""Compare, see where, learn, add, watch the error fall: the loop of the workbench, on both screens."""

import os
import time
from contextlib import closing
from pathlib import Path
from typing import cast

import pytest
from chrome import LAPTOP, PHONE, Chrome
from workbench_server import ERROR, RUN, SHOWN, Workbench, look_for_trouble

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.simulate import simulate_case
from pipeline.store import Store

GOOD = "rgb(0, 128, 95)"
END = "document.querySelector('.end')"
TITLE = "document.querySelector('.title h2')?.textContent"
MARKED = "[...document.querySelectorAll('.cursor-mark')].map((mark) => mark.parentElement.dataset.figure)"
SAID = "document.querySelector('.moment-said').textContent"


@pytest.mark.long
def test_on_a_phone_the_next_effect_is_in_reach_and_the_end_is_said(
    chrome: Chrome, workbench: Workbench, pictures: Path
) -> None:
    chrome.size(PHONE, 844)
    chrome.open(workbench.address)
    chrome.wait(f"{SHOWN} && document.querySelector('.reach .add')")
    before = cast("float", chrome.run(ERROR))
    assert "times the noise floor; largest from" in str(chrome.run(f"{END}.textContent"))
    assert chrome.run(f"getComputedStyle({END}).color") != GOOD
    button = "document.querySelector('.reach .add').getBoundingClientRect()"
    for top in (0, 800, 100_000):
        chrome.run(f"scrollTo(0, {top})")
        assert chrome.run(f"{button}.top > 0 && {button}.bottom <= innerHeight"), top
    chrome.click(".reach .add")
    chrome.wait(f"{ERROR} < {0.1 * before}")
    chrome.wait(f"{END}.textContent === 'Done: at the noise floor'")
    assert chrome.run(f"getComputedStyle({END}).color") == GOOD
    # What the effect is stands on its card; where nothing changed, this is said.
    assert "turns less than" in str(chrome.run("document.querySelector('.card .about').textContent"))
    chrome.picture(pictures / "loop_phone.png")
    look_for_trouble(chrome)


@pytest.mark.long
def test_one_moment_shows_in_path_velocities_and_map_and_can_be_played(
    chrome: Chrome, shared_workbench: Workbench
) -> None:
    chrome.size(LAPTOP, 900)
    chrome.open(shared_workbench.address)
    chrome.wait(f"{SHOWN} && document.querySelector('[data-figure=trajectory].drawn')")
    chrome.click(".end .look")
    chrome.wait(f"new Set({MARKED}).size >= 3")
    assert {"paths", "stretch", "trajectory"} <= set(cast("list[str]", chrome.run(MARKED)))
    told = str(chrome.run(SAID))
    assert "cm off" in told
    assert "Marked" in str(chrome.run("document.querySelector('.marked').innerText"))
    chrome.click(".play")
    chrome.wait(f"parseFloat({SAID}) > {float(told.split(maxsplit=1)[0]) + 1.0}")
    chrome.click(".play")
    look_for_trouble(chrome)


@pytest.mark.long
def test_a_notice_does_not_stand_over_the_next_step(chrome: Chrome, workbench: Workbench) -> None:
    chrome.size(LAPTOP, 900)
    chrome.open(workbench.address)
    chrome.wait(SHOWN)
    chrome.click(".hero .save")
    chrome.wait("!document.getElementById('toast').hidden")
    chrome.click("#toast .drop")
    assert chrome.run("document.getElementById('toast').hidden")
    chrome.click(".hero .save")
    chrome.wait("!document.getElementById('toast').hidden")
    chrome.click(".proposals .add")
    chrome.wait("document.querySelector('.card') && document.getElementById('toast').hidden")


@pytest.mark.long
def test_why_a_formula_was_refused_stays_until_the_next_step(chrome: Chrome, workbench: Workbench) -> None:
    chrome.size(LAPTOP, 900)
    chrome.open(workbench.address)
    chrome.wait(f"{SHOWN} && !document.querySelector('.trying')")
    chrome.run("document.querySelector('details.formula').open = true")
    for name, value in {"effect": "mine", "formula": "c * v0", "parameters": "c [s] -1 .. 1"}.items():
        chrome.run(f"document.querySelector('.formula [name={name}]').value = '{value}'")
    chrome.click(".formula [type=submit]")
    chrome.wait("!document.getElementById('toast').hidden")
    time.sleep(0.5)
    assert not chrome.run("document.getElementById('toast').hidden")
    assert "m/s" in str(chrome.run("document.getElementById('toast').textContent"))
    # The browser notes a refused request by itself.
    chrome.errors.clear()


@pytest.mark.long
def test_of_a_run_that_cannot_show_slip_no_error_is_said_to_remain(chrome: Chrome, tmp_path: Path) -> None:
    log = simulate_case(None, {"wheel_radius": 0.0}, out=tmp_path / "field" / "lifted.mcap", duration_s=40.0)
    husky = {"vehicle": {"preset": "husky_a200"}}
    analyze_log(log, Options(out=tmp_path / "out", report=False, diagnosis=False, overrides=husky))
    with closing(Workbench(tmp_path / "out")) as server:
        chrome.size(LAPTOP, 900)
        chrome.open(server.address)
        chrome.wait(f"{SHOWN} && document.querySelector('.no-help')")
        assert chrome.run(f"{END}.offsetHeight") == 0
        chrome.open("about:blank")


@pytest.mark.long
def test_it_opens_with_the_run_that_was_analyzed_last(chrome: Chrome, results: Path, tmp_path: Path) -> None:
    log = simulate_case("husky_tile", out=tmp_path / "field" / "later.mcap", duration_s=30.0)
    analyze_log(log, Options(out=results, report=False, diagnosis=False))
    written = {one.run: one.folder.parent / "manifest.json" for one in Store(results).manifests()}
    for newest in ("field/later", RUN):
        os.utime(written[newest])
        with closing(Workbench(results)) as server:
            chrome.open(server.address)
            chrome.wait(f"{TITLE} && {SHOWN}")
            assert chrome.run(TITLE) == newest
            chrome.open("about:blank")
