"""The workbench in a real browser, as a person uses it: look, add, see the error fall, undo, drop, reload."""

import json
from contextlib import closing
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from chrome import LAPTOP, PHONE, Chrome
from workbench_server import ERROR, RUN, SHOWN, TOKEN, TRACK, Workbench, look_for_trouble

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.logs.writer import LogWriter
from pipeline.report import theme
from pipeline.simulate import simulate_case
from pipeline.store import Store

START = 1_700_000_000_000_000_000
EVIL = "<img src=x onerror=\"window.pwned='yes'\"><script>window.pwned='yes'</script>"


def test_a_person_adds_the_hidden_effect_undoes_drops_a_log_and_reloads(
    chrome: Chrome, workbench: Workbench, pictures: Path, tmp_path: Path
) -> None:
    chrome.size(LAPTOP, 900)
    chrome.open(workbench.address)
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
    chrome: Chrome, workbench: Workbench, pictures: Path
) -> None:
    chrome.size(PHONE, 600)
    chrome.open(f"{workbench.origin}/")
    chrome.wait("document.readyState === 'complete' && document.body?.innerText")
    assert "slip serve" in str(chrome.run("document.body.innerText"))
    assert chrome.run("document.scripts.length") == 0
    chrome.picture(pictures / "workbench_refused.png")
    chrome.errors.clear()

    chrome.size(LAPTOP, 900)
    chrome.open(f"{workbench.address}#a={RUN}&b={RUN}")
    chrome.wait(f"{SHOWN} && document.querySelector('[data-slot=b]')?.dataset.drawn")
    # The token is in neither the address nor the reach of a script; the runs are those of the address.
    assert str(chrome.run("location.href")).startswith(f"{workbench.origin}/#")
    assert TOKEN not in str(chrome.run("document.cookie + document.documentElement.outerHTML"))
    chrome.run("location.reload()")
    chrome.wait(f"document.readyState === 'complete' && {SHOWN}")
    look_for_trouble(chrome)


@pytest.mark.long
def test_what_a_diagnosis_named_is_added_at_once(chrome: Chrome, tmp_path: Path) -> None:
    log = tmp_path / "field" / "late.mcap"
    simulate_case(None, {"effective_track": TRACK, "drive_lag": 0.3}, out=log, seed=4, duration_s=90.0)
    husky = {"vehicle": {"preset": "husky_a200"}}
    analyze_log(log, Options(out=tmp_path / "out", report=False, diagnosis=True, overrides=husky))
    with closing(Workbench(tmp_path / "out")) as workbench:
        chrome.size(LAPTOP, 900)
        chrome.open(workbench.address)
        chrome.wait(SHOWN)
        named = (
            "[...document.querySelectorAll('.proposals li[data-named]')].map((entry) => entry.dataset.effect)"
        )
        assert set(chrome.run(named)) == {"effective_track", "drive_lag"}
        manifest = Store(tmp_path / "out").manifest("field/late")
        assert manifest is not None
        told = json.loads(manifest.path("summary.json").read_text())["diagnosis"]["where"][0]["text"]
        assert told in str(chrome.run("document.querySelector('.where').textContent"))
        chrome.click(".add-all")
        chrome.wait("document.querySelectorAll('.card').length === 2")
        chrome.click("[data-tab=effects]")
        chrome.wait("document.querySelectorAll('[data-figure=ladder] .mark-rect path').length === 3")
        chrome.wait("document.querySelector('.said').textContent === '+ all 2 of the diagnosis'")
        look_for_trouble(chrome)


@pytest.mark.long
def test_what_raises_an_error_is_not_taken_unless_it_is_said_again(
    chrome: Chrome, workbench: Workbench
) -> None:
    chrome.size(LAPTOP, 900)
    chrome.open(workbench.address)
    chrome.wait(SHOWN)
    # The list is drawn anew while effects are tried: chosen and said in one breath.
    chrome.run(
        "(() => { document.querySelector('select.catalogue').value = 'wheel_radius';"
        " document.querySelector('.add-chosen').click(); })()"
    )
    chrome.wait("document.getElementById('toast').textContent.includes('is not supported by the data')")
    assert chrome.run("document.querySelectorAll('.card').length") == 0
    chrome.click("#toast .anyway")
    chrome.wait("document.querySelectorAll('.card').length === 1")
    chrome.wait("document.querySelector('.said').textContent === '+ effective wheel radius'")
    assert chrome.run("document.querySelector('select.catalogue').selectedIndex") == 0
    errors = [text for text in chrome.errors if "422" not in text]
    assert errors == []


@pytest.mark.long
@pytest.mark.parametrize(
    ("width", "dark"),
    [(PHONE, False), (LAPTOP, True)],
    ids=["phone", "laptop-dark"],
)
def test_nothing_is_cut_or_overlaps(
    chrome: Chrome, workbench: Workbench, pictures: Path, width: int, *, dark: bool
) -> None:
    workbench.session(RUN, "add", effect="effective_track")
    chrome.size(width, 844, dark=dark)
    chrome.open(workbench.address)
    chrome.wait(SHOWN)
    chrome.picture(pictures / f"workbench_{width}{'_dark' if dark else ''}.png", whole=True)
    assert (
        cast("int", chrome.run("document.documentElement.scrollWidth - document.documentElement.clientWidth"))
        <= 0
    )
    cut = """[...document.querySelectorAll('.plot svg')].flatMap((svg) => {
      const box = svg.getBoundingClientRect();
      return [...svg.querySelectorAll('text')].filter((text) => {
        const word = text.getBoundingClientRect();
        return word.width && (word.left < box.left - 1 || word.right > box.right + 1);
      }).map((text) => text.textContent);
    })"""
    assert chrome.run(cut) == []
    overlapping = """(() => {
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
    assert chrome.run(overlapping) == []
    assert chrome.run("document.querySelector('.numbers').getBoundingClientRect().bottom < innerHeight")
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
    server = Workbench(results)
    try:
        chrome.size(LAPTOP, 900)
        chrome.open(server.address)
        chrome.wait(SHOWN)
        chrome.picture(pictures / "workbench_markup.png")
        assert EVIL in str(chrome.run("document.querySelector('.hero .facts').textContent"))
        assert "<img src=x" in str(chrome.run("document.querySelector('.title h2').textContent"))
        assert chrome.run("document.querySelectorAll('img, b[onclick]').length") == 0
        assert chrome.run("window.pwned ?? null") is None
        look_for_trouble(chrome)
        report = Path(str(outcome.summary["report"]))
        chrome.open(report.as_uri())
        chrome.wait("document.documentElement?.dataset.drawn === 'yes'")
        chrome.picture(pictures / "report_markup.png", whole=True)
        assert EVIL in str(chrome.run("document.body.textContent"))
        assert chrome.run("document.querySelectorAll('img').length") == 0
        assert chrome.run("window.pwned ?? null") is None
        assert chrome.errors == []
    finally:
        server.close()


@pytest.mark.long
def test_an_empty_folder_asks_for_a_log(chrome: Chrome, tmp_path: Path, pictures: Path) -> None:
    server = Workbench(tmp_path / "nothing yet")
    try:
        chrome.size(PHONE, 844)
        chrome.open(server.address)
        chrome.wait("document.querySelector('.blank')")
        chrome.picture(pictures / "workbench_empty.png")
        assert chrome.run("document.querySelector('#drop').getBoundingClientRect().height > 80")
        look_for_trouble(chrome)
    finally:
        server.close()
    assert not (tmp_path / "nothing yet").exists()


SLOW_LISTS = """(() => {
  const ask = window.fetch;
  window.fetch = async (address, ...rest) => {
    if (String(address).startsWith("/api/runs")) await new Promise((done) => setTimeout(done, 2000));
    return ask(address, ...rest);
  };
})()"""


@pytest.mark.long
def test_a_drive_is_planned_on_request_and_its_files_are_there(
    chrome: Chrome, pictures: Path, tmp_path: Path
) -> None:
    hidden: dict[str, object] = {"effective_track": 1.6, "drive_lag": 0.25, "lateral_skid": 0.1}
    log = simulate_case(
        None, hidden, out=tmp_path / "circle.mcap", seed=9, duration_s=40.0, vehicle="husky", program="circle"
    )
    husky = {"vehicle": {"preset": "husky_a200"}}
    analyze_log(log, Options(out=tmp_path / "out", report=False, diagnosis=True, overrides=husky))
    with closing(Workbench(tmp_path / "out")) as workbench:
        chrome.size(LAPTOP, 900)
        chrome.open(workbench.address)
        chrome.wait("document.querySelector('.plan .ask button')")
        # The next drive is ordered while the page still reads its lists anew after the one that failed.
        chrome.run(SLOW_LISTS)
        chrome.run("document.querySelector('.plan input').value = '1x1m'")
        chrome.click(".plan .ask button")
        chrome.wait("document.querySelector('.job.failed p')?.textContent.includes('area')")
        chrome.run("document.querySelector('.plan input').value = '20x10m'")
        chrome.click(".plan .ask button")
        chrome.wait("document.querySelector('.planned .plot.drawn')", patience_s=60.0)
        assert "centre of rotation" in str(chrome.run("document.querySelector('.planned table').textContent"))
        run = workbench.get("/api/runs")["runs"][0]["run"]  # type: ignore[index]
        for name, start in (("plan.mcap", b"\x89MCAP"), ("plan.html", b"<!doctype html>")):
            status, _, body = workbench.request("GET", f"/plan?run={run}&file={name}")
            assert status == 200
            assert body[: len(start)].lower() == start.lower()
        for width, dark in ((LAPTOP, False), (PHONE, False), (PHONE, True)):
            chrome.size(width, 900, dark=dark)
            # Drawn anew for the width and the colours.
            twin = theme.DARK_TWINS[theme.GRID] if dark else theme.GRID
            chrome.wait(f"document.querySelector('.planned svg').outerHTML.includes('{twin}')")
            chrome.wait("document.querySelector('.planned svg').clientWidth <= innerWidth")
            chrome.run("document.querySelector('.planned').scrollIntoView()")
            assert chrome.run("document.documentElement.scrollWidth <= document.documentElement.clientWidth")
            chrome.picture(pictures / f"workbench_plan_{width}_{'dark' if dark else 'light'}.png")
        chrome.wait(SHOWN, patience_s=60.0)
        look_for_trouble(chrome)
