"""The workbench in a real browser, as a person uses it: look, add, see the error fall, undo, drop, reload."""

import json
import os
import time
from contextlib import closing
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from barriers import find_barriers
from chrome import LAPTOP, PHONE, Chrome
from workbench_server import (
    ERROR,
    RUN,
    SHOWN,
    TOKEN,
    TRACK,
    ServedWorkbench,
    analyze_another,
    look_for_trouble,
)

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log, update_datasets
from pipeline.datasets.deployments import draw_up_map
from pipeline.logs.writer import LogWriter
from pipeline.report.datasets_page import write_map
from pipeline.simulate import simulate_case
from pipeline.store import Store

START = 1_700_000_000_000_000_000
EVIL = "<img src=x onerror=\"window.pwned='yes'\"><script>window.pwned='yes'</script>"
SETTLED = (
    f"{SHOWN} && !document.querySelector('.pane.busy, .trying') &&"
    " document.querySelectorAll('.plot.drawn').length === document.querySelectorAll('.plot').length"
)
TITLE = "document.querySelector('.title h2')?.textContent"
WIDER = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
TOAST = "document.getElementById('toast')"
END = "document.querySelector('.end')"
GOOD = "rgb(0, 128, 95)"
REACHED = """(() => {
  const shown = [...document.querySelectorAll('button, a[href], input, select, summary')]
    .filter((node) => node.checkVisibility({ visibilityProperty: true }) && !node.disabled);
  return shown.filter((node) => node.tabIndex < 0).map((node) => node.outerHTML);
})()"""
CUT = """[...document.querySelectorAll('.plot svg')].flatMap((svg) => {
  const box = svg.getBoundingClientRect();
  return [...svg.querySelectorAll('text')].filter((text) => {
    const word = text.getBoundingClientRect();
    return word.width && (word.left < box.left - 1 || word.right > box.right + 1);
  }).map((text) => text.textContent);
})"""
OVERLAPPING = """(() => {
  const rooms = ['.hero > *', '.glance > *', '.model > *', '.first-view > *', '.figures > *'];
  const parts = [...document.querySelectorAll(rooms.join())]
    .map((node) => [node.className || node.id, node.getBoundingClientRect()])
    .filter(([, box]) => box.width && box.height);
  const found = [];
  for (const [i, [one, a]] of parts.entries()) for (const [other, b] of parts.slice(i + 1))
    if (a.left < b.right - 1 && b.left < a.right - 1 && a.top < b.bottom - 1 && b.top < a.bottom - 1)
      found.push([one, other]);
  return found;
})()"""


def open_page(
    chrome: Chrome, bench: ServedWorkbench, width: int = LAPTOP, *, state: str = SETTLED, dark: bool = False
) -> None:
    chrome.size(width, 900, dark=dark)
    chrome.open(bench.address)
    chrome.wait(state)


def look(chrome: Chrome, picture: Path) -> None:
    """Nothing went wrong, nothing is cut, overlaps or is wider than the screen, and nobody is kept out."""
    chrome.run("scrollTo(0, 0)")
    chrome.picture(picture, whole=True)
    assert cast("int", chrome.run(WIDER)) <= 0
    for flaws in (CUT, OVERLAPPING, REACHED):
        assert chrome.run(flaws) == []
    assert find_barriers(chrome) == []
    look_for_trouble(chrome)


def test_a_person_adds_the_hidden_effect_undoes_drops_a_log_and_reloads(
    chrome: Chrome, served: ServedWorkbench, pictures: Path, tmp_path: Path
) -> None:
    chrome.size(LAPTOP, 900)
    chrome.open(served.address)
    chrome.wait(SHOWN)
    before = cast("float", chrome.run(ERROR))
    chrome.picture(pictures / "workbench_opened.png")

    chrome.click(".proposals li[data-effect=effective_track] .add")
    chrome.wait("document.querySelector('.card[data-effect=effective_track]')")
    chrome.wait(f"{ERROR} < {0.1 * before}")
    chrome.click("[data-tab=effects]")
    chrome.wait("document.querySelectorAll('[data-figure=ladder] .mark-rect path').length === 2")
    assert "%" in str(chrome.run("document.querySelector('.number.r .fall').textContent"))
    chrome.picture(pictures / "workbench_added.png", whole=True)

    # The slider, by keyboard: the value goes with it at once, the number a moment later.
    chrome.run("document.querySelector('.slider input').focus()")
    for _ in range(40):
        chrome.press("ArrowRight", 39)
    chrome.wait(f"{ERROR} > {0.1 * before}")
    chrome.wait("document.querySelector('.ideal-said').textContent.includes('by hand')")

    chrome.wait("!document.querySelector('.pane').classList.contains('busy')")
    for _ in range(40):
        if chrome.run("document.querySelector('.undo').disabled"):
            break
        chrome.click(".undo")
        chrome.wait("!document.querySelector('.pane').classList.contains('busy')")
    chrome.wait(f"Math.abs({ERROR} - {before}) < 1e-6")
    assert chrome.run("document.querySelectorAll('.card').length") == 0

    chrome.click(".redo")
    chrome.wait("document.querySelector('.card')")
    chrome.run("location.reload()")
    chrome.wait(f"document.querySelector('.card') && {SHOWN}")
    assert str(chrome.run("location.hash")).endswith("hidden")

    other = simulate_case("husky_tile", out=tmp_path / "other.mcap", duration_s=40.0)
    chrome.run("scrollTo(0, 0)")
    # Seconds in which a person reads pass at once.
    chrome.run("(() => { const wait = setTimeout; window.setTimeout = (work) => wait(work, 200); })()")
    chrome.drop(other, "#drop")
    chrome.wait("[...document.querySelectorAll('.run')].length === 2")
    # What went well is a notice that goes away by itself.
    chrome.wait("!document.querySelector('.job')")
    chrome.wait("(document.querySelector('.title h2')?.textContent ?? 'field/hidden') !== 'field/hidden'")
    chrome.wait(SHOWN)
    look_for_trouble(chrome)


@pytest.mark.long
def test_without_the_token_the_page_is_a_sentence_and_with_it_stays_open(
    chrome: Chrome, served: ServedWorkbench, pictures: Path
) -> None:
    chrome.size(PHONE, 600)
    chrome.open(f"{served.origin}/")
    chrome.wait("document.readyState === 'complete' && document.body?.innerText")
    assert "slip serve" in str(chrome.run("document.body.innerText"))
    assert chrome.run("document.scripts.length") == 0
    chrome.picture(pictures / "workbench_refused.png")
    chrome.errors.clear()

    chrome.open(f"{served.address}#a={RUN}&b={RUN}")
    chrome.wait(f"{SHOWN} && document.querySelector('[data-slot=b]')?.dataset.drawn")
    # The token is in neither the address nor the reach of a script; the runs are those of the address.
    assert str(chrome.run("location.href")).startswith(f"{served.origin}/#")
    assert TOKEN not in str(chrome.run("document.cookie + document.documentElement.outerHTML"))
    chrome.run("location.reload()")
    chrome.wait(f"document.readyState === 'complete' && {SHOWN}")
    look_for_trouble(chrome)


@pytest.mark.long
def test_what_a_diagnosis_named_is_added_at_once(chrome: Chrome, stored_run: Path) -> None:
    with closing(ServedWorkbench(stored_run / "results")) as served:
        open_page(chrome, served, state=SHOWN)
        named = "[...document.querySelectorAll('.proposals li[data-named]')].map((row) => row.dataset.effect)"
        assert set(chrome.run(named)) == {"effective_track", "drive_lag"}
        assert str(chrome.run("document.querySelector('.where').textContent")).startswith("Where: ")
        chrome.click(".add-all")
        chrome.wait("document.querySelectorAll('.card').length === 2")
        chrome.click("[data-tab=effects]")
        chrome.wait("document.querySelectorAll('[data-figure=ladder] .mark-rect path').length === 3")
        chrome.wait("document.querySelector('.said').textContent === '+ all 2 of the diagnosis'")
        look_for_trouble(chrome)


@pytest.mark.long
def test_what_is_refused_is_said_until_the_next_step(chrome: Chrome, served: ServedWorkbench) -> None:
    open_page(chrome, served)
    # The list is drawn anew while effects are tried: chosen and said in one breath.
    chrome.run(
        "(() => { document.querySelector('select.catalogue').value = 'wheel_radius';"
        " document.querySelector('.add-chosen').click(); })()"
    )
    chrome.wait(f"{TOAST}.textContent.includes('is not supported by the data')")
    assert chrome.run("document.querySelectorAll('.card').length") == 0
    chrome.click("#toast .anyway")
    chrome.wait("document.querySelector('.said').textContent === '+ effective wheel radius'")
    assert chrome.run("document.querySelector('select.catalogue').selectedIndex") == 0
    chrome.click(".hero .save")
    chrome.wait(f"{TOAST}.textContent.includes('saved')")
    chrome.click("#toast .drop")
    assert chrome.run(f"{TOAST}.hidden")
    chrome.click(".hero .save")
    chrome.wait(f"!{TOAST}.hidden")
    chrome.click(".card .remove")
    chrome.wait(f"!document.querySelector('.card') && {TOAST}.hidden && {SETTLED}")
    write_formula(chrome, effect="mine", formula="c * v0", parameters="c [s] -1 .. 1")
    chrome.wait(f"{TOAST}.textContent.includes('rad/s')")
    # The browser notes a refused request by itself.
    assert [text for text in chrome.errors if "422" not in text] == []


def write_formula(chrome: Chrome, **fields: str) -> None:
    chrome.run("document.querySelector('.formula summary').focus()")
    chrome.press("Enter", 13)
    for name, text in fields.items():
        chrome.run(
            f"document.querySelector('.formula').open = true,"
            f" document.querySelector('.formula [name={name}]').focus()"
        )
        chrome.call("Input.insertText", text=text)
    chrome.run("document.querySelector('.formula [name=channel]').value = 'v_w'")
    chrome.run("document.querySelector('.formula button').click()")


@pytest.mark.long
@pytest.mark.parametrize("width", [PHONE, LAPTOP])
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_add_slide_undo_and_save(
    chrome: Chrome, served: ServedWorkbench, pictures: Path, width: int, *, dark: bool
) -> None:
    open_page(chrome, served, width, dark=dark)
    before = cast("float", chrome.run(ERROR))
    look(chrome, pictures / f"workbench_opened_{width}_{dark}.png")
    chrome.click(".proposals li[data-effect=effective_track] .add")
    chrome.wait(f"document.querySelector('.card') && {ERROR} < {0.1 * before} && {SETTLED}")
    chrome.drag("[data-figure=reach] svg", (0.3, 0.5), (0.5, 0.5))
    chrome.wait("!document.querySelector('.marked').hidden")
    look(chrome, pictures / f"workbench_added_{width}_{dark}.png")
    chrome.click(".mark-clear")

    # The error stays in sight, however far one scrolls, and undo moves nothing else.
    drawn = "document.querySelector('[data-figure=trajectory]')"
    chrome.run(f"{drawn}.scrollIntoView({{ block: 'center' }})")
    place = f"{drawn}.getBoundingClientRect().top"
    before_undo = cast("list[object]", chrome.run(f"[{place}, {drawn}.innerHTML]"))
    glance = "(({ top, bottom }) => [top, bottom])(document.querySelector('.glance').getBoundingClientRect())"
    top, bottom = cast("list[float]", chrome.run(glance))
    assert 0.0 <= top < bottom < 300.0
    chrome.run("document.querySelector('.formula').open = true")
    chrome.run("document.querySelector('.undo').click()")
    chrome.wait(f"!document.querySelector('.card') && Math.abs({ERROR} - {before}) < 1e-6")
    chrome.wait(f"{drawn}.innerHTML !== {json.dumps(before_undo[1])}")
    assert chrome.run(place) == pytest.approx(before_undo[0], abs=60.0)
    assert chrome.run("document.querySelector('.formula').open")
    chrome.run("document.querySelector('.redo').click()")
    chrome.wait("document.querySelector('.card')")
    # A value at its bound is said and red.
    served.session(RUN, "set", effect="effective_track", parameter="k", value=10.0)
    chrome.run("location.reload()")
    chrome.wait("document.querySelector('.bound')?.innerText.includes('at its bound')")
    chrome.click(".card .remove")
    chrome.wait(f"!document.querySelector('.card') && {SETTLED}")
    write_formula(chrome, effect="my_track", formula="k * w0", parameters="k [1] -0.9 .. 0.9")
    chrome.wait("document.querySelector('.card[data-effect=my_track]')")
    look_for_trouble(chrome)


def test_the_errors_on_another_run_stand_beside_those_of_this_one_and_follow_the_model(
    chrome: Chrome, served: ServedWorkbench, tmp_path: Path
) -> None:
    other = analyze_another(served.results, "other", tmp_path, effective_track=TRACK)
    open_page(
        chrome, served, PHONE, state=f"{SHOWN} && document.querySelector('.validate').options.length > 1"
    )
    if chrome.run(TITLE) != RUN:
        chrome.click("[data-tab=runs]")
        chrome.run(f"document.querySelector('.run[title=\"{RUN}\"]').click()")
        chrome.wait(f"{TITLE} === '{RUN}' && {SHOWN}")
    said = "document.querySelector('.validated').textContent"
    choose = (
        "{const choice = document.querySelector('.validate'); choice.value = '%s';"
        " choice.dispatchEvent(new Event('change'))}"
    )
    chrome.run(choose % other)
    chrome.wait(f"{said}.endsWith('with the ideal model.')")
    before = str(chrome.run(said))
    assert before.startswith(f"{other}: position ")
    chrome.click(".proposals li[data-effect=effective_track] .add")
    chrome.wait(f"{said}.endsWith('The model holds there.')")
    assert "(ideal model " in str(chrome.run(said))
    chrome.run(choose % "")
    chrome.wait(f"{said} === ''")
    assert cast("int", chrome.run(WIDER)) <= 0
    look_for_trouble(chrome)


@pytest.mark.long
@pytest.mark.parametrize("width", [LAPTOP, PHONE])
def test_two_models_and_their_difference(
    chrome: Chrome, served: ServedWorkbench, pictures: Path, width: int
) -> None:
    served.session(RUN, "add", effect="effective_track")
    open_page(chrome, served, width)
    # Beside a model with an effect stands the ideal one: two things that differ.
    chrome.click("#compare")
    chrome.wait("document.querySelector('[data-slot=b]')?.dataset.drawn")
    chrome.wait(SETTLED)
    cells = "[...document.querySelectorAll('#difference tbody tr')].map((row) => row.innerText)"
    rows = cast("list[str]", chrome.run(cells))
    assert rows[1].startswith("heading error over 2 s [\u00b0]")
    first, second, apart = (text.split()[0] for text in rows[1].split("\t")[1:])
    assert float(apart) == pytest.approx(float(second) - float(first), rel=0.01)
    assert "effective_track" in rows[2]
    assert "not in it" in rows[2]
    # When they are apart: two lines over time, which follow both models, of one run only.
    lines = "[...document.querySelectorAll('#apart .mark-line path')].map((line) => line.getAttribute('d'))"
    chrome.wait(f"{lines}.length === 2 && {lines}[0] !== {lines}[1]")
    before = cast("list[str]", chrome.run(lines))
    chrome.click("[data-slot=b] .proposals li[data-effect=effective_track] .add")
    chrome.wait(f"{lines}[1] !== {json.dumps(before[1])}")
    chrome.wait(SETTLED)
    assert chrome.run(f"{lines}[0]") == before[0]
    look(chrome, pictures / f"flow_compared_{width}.png")
    assert find_barriers(chrome) == []


@pytest.mark.long
def test_an_empty_folder_asks_for_a_log_and_says_what_is_none(
    chrome: Chrome, pictures: Path, tmp_path: Path
) -> None:
    with closing(ServedWorkbench(tmp_path / "nothing yet")) as served:
        open_page(chrome, served, PHONE, state="document.querySelector('.blank')")
        assert not (tmp_path / "nothing yet").exists()
        assert chrome.run("document.querySelector('#drop').getBoundingClientRect().height > 80")
        look(chrome, pictures / "workbench_empty.png")
        bad = tmp_path / "notes.mcap"
        bad.write_bytes(b"this is no recording\n" * 100)
        chrome.drop(bad, "#drop")
        chrome.wait("document.querySelector('.job.failed p')")
        told = str(chrome.run("document.querySelector('.job.failed').innerText"))
        assert "notes.mcap" in told
        assert str(served.results) not in told
        # The page reads its lists anew once a job has ended.
        time.sleep(1.0)
        chrome.run("document.querySelector('.job.failed .drop').click()")
        chrome.wait("!document.querySelector('.job.failed')")
        chrome.click(".sample")
        chrome.wait("document.querySelector('.job')")
        chrome.wait(SETTLED, patience_s=180.0)
        assert chrome.run(TITLE) == "dropped/husky_tile"
        look_for_trouble(chrome)


@pytest.mark.long
def test_markup_in_a_log_is_shown_as_text(chrome: Chrome, tmp_path: Path, pictures: Path) -> None:
    folder = tmp_path / "<b onclick=alert(1)>field"
    folder.mkdir()
    log = folder / "<img src=x onerror=window.pwned=1>.mcap"
    rng = np.random.default_rng(4)
    stamps = START + np.arange(1600, dtype=np.int64) * 50_000_000
    speed = np.repeat(rng.uniform(0.2, 0.9, 20), 80)
    turn = np.repeat(rng.uniform(-0.8, 0.8, 20), 80)
    yaw = np.cumsum(0.6 * turn) * 0.05
    pose = {
        "header.frame_id": EVIL,
        "pose.pose.position.x": np.cumsum(speed * np.cos(yaw)) * 0.05,
        "pose.pose.position.y": np.cumsum(speed * np.sin(yaw)) * 0.05,
        "pose.pose.orientation.z": np.sin(0.5 * yaw),
        "pose.pose.orientation.w": np.cos(0.5 * yaw),
    }
    with LogWriter(log) as writer:
        writer.metadata("deployment", {"vehicle": "husky_a200", "terrain": EVIL})
        command = {"linear.x": speed, "angular.z": turn}
        writer.write_columns(f"/{EVIL}/cmd_vel", "geometry_msgs/msg/Twist", stamps, command)
        writer.write_columns(f"/{EVIL}/icp_odom", "nav_msgs/msg/Odometry", stamps, pose, header_time=stamps)
    results = tmp_path / "results"
    outcome = analyze_log(log, Options(out=results))
    assert EVIL in str(outcome.summary["terrain"])
    with closing(ServedWorkbench(results)) as served:
        open_page(chrome, served, state=SHOWN)
        assert EVIL in str(chrome.run("document.querySelector('.hero .facts').textContent"))
        assert "<img src=x" in str(chrome.run(TITLE))
        look_for_trouble(chrome)
        pages = [str(chrome.run("location.href")), Path(str(outcome.summary["report"])).as_uri()]
        for number, page in enumerate(pages):
            chrome.open(page)
            chrome.wait(f"document.documentElement?.dataset.drawn === 'yes' || {SHOWN}")
            chrome.picture(pictures / f"markup_{number}.png", whole=True)
            assert EVIL in str(chrome.run("document.body.textContent"))
            assert chrome.run("document.querySelectorAll('img, b[onclick]').length") == 0
            assert chrome.run("window.pwned ?? null") is None
            assert chrome.errors == []


@pytest.mark.long
@pytest.mark.parametrize("is_served", [True, False], ids=["served", "from_files"])
def test_a_report_leads_to_all_runs_and_they_lead_back(
    chrome: Chrome, served: ServedWorkbench, results: Path, *, is_served: bool
) -> None:
    update_datasets(Store(results))
    if is_served:
        chrome.open(served.address)
        chrome.wait("document.querySelector('main')")
        chrome.open(f"{served.origin}/report?run={RUN}")
    else:
        chrome.open(next(results.glob("runs/**/report.html")).as_uri())
    for _ in range(2):
        chrome.wait("document.documentElement?.dataset.drawn === 'yes'")
        chrome.click("#pages a")
        chrome.wait("document.querySelector('#shown')?.textContent === '1 of 1 runs'")
        chrome.click("tbody th a")
    chrome.wait(f"document.querySelector('h1')?.textContent === {json.dumps(RUN)}")

    # No page is offered that is not there; what is made later is reached by way of all runs.
    report = str(chrome.run("location.href"))
    offered = "[...document.querySelectorAll('#pages a')].map((link) => link.textContent)"
    assert chrome.run(offered) == ["All runs"]
    write_map(Store(results), draw_up_map(Store(results)))
    chrome.open(report)
    chrome.wait("document.documentElement?.dataset.drawn === 'yes'")
    chrome.click("#pages a")
    chrome.wait(f"{offered}.join() === 'Map'")
    chrome.click("#pages a")
    chrome.wait("document.querySelector('h1')?.textContent === 'Deployment map'")
    chrome.wait("document.documentElement?.dataset.drawn === 'yes'")
    assert chrome.errors == []


@pytest.mark.long
def test_on_a_phone_the_next_effect_is_in_reach_and_the_end_is_said(
    chrome: Chrome, served: ServedWorkbench, pictures: Path
) -> None:
    chrome.size(PHONE, 844)
    chrome.open(served.address)
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
    chrome: Chrome, served: ServedWorkbench
) -> None:
    marked = "[...document.querySelectorAll('.cursor-mark')].map((mark) => mark.parentElement.dataset.figure)"
    said = "document.querySelector('.moment-said').textContent"
    chrome.size(LAPTOP, 900)
    chrome.open(served.address)
    chrome.wait(f"{SHOWN} && document.querySelector('[data-figure=trajectory].drawn')")
    chrome.click(".end .look")
    chrome.wait(f"new Set({marked}).size >= 3")
    assert {"paths", "stretch", "trajectory"} <= set(cast("list[str]", chrome.run(marked)))
    told = str(chrome.run(said))
    assert "cm off" in told
    assert "Marked" in str(chrome.run("document.querySelector('.marked').innerText"))
    chrome.click(".play")
    chrome.wait(f"parseFloat({said}) > {float(told.split(maxsplit=1)[0]) + 1.0}")
    chrome.click(".play")
    look_for_trouble(chrome)


@pytest.mark.long
def test_it_opens_with_the_run_that_was_analyzed_last_also_one_that_cannot_show_slip(
    chrome: Chrome, results: Path, tmp_path: Path
) -> None:
    log = simulate_case(None, {"wheel_radius": 0.0}, out=tmp_path / "field" / "lifted.mcap", duration_s=40.0)
    husky = {"vehicle": {"preset": "husky_a200"}}
    analyze_log(log, Options(out=results, report=False, diagnosis=False, overrides=husky))
    written = {one.run: one.folder.parent / "manifest.json" for one in Store(results).manifests()}
    with closing(ServedWorkbench(results)) as served:
        for newest in (RUN, "field/lifted"):
            os.utime(written[newest])
            open_page(chrome, served, state=f"{TITLE} === {json.dumps(newest)} && {SHOWN}")
            chrome.open("about:blank")
        open_page(chrome, served, state=f"{SHOWN} && document.querySelector('.no-help')")
        # Of a run that cannot show slip, no error is said to remain.
        assert chrome.run(f"{END}.offsetHeight") == 0
        look_for_trouble(chrome)
