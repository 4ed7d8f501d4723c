"""The workbench in a real browser, as a person uses it: look, add, see the error fall, undo, drop, reload."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
import pytest
from chrome import LAPTOP, PHONE
from workbench_server import ERROR, RUN, SHOWN, TOKEN, TRACK, Workbench, look_for_trouble

from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.job.run_results import find_peers
from pipeline.logs.writer import LogWriter
from pipeline.report import theme
from pipeline.simulate import simulate_case
from pipeline.store import Store

if TYPE_CHECKING:
    from chrome import Chrome

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
    chrome.drop(other, "#drop")
    chrome.wait("[...document.querySelectorAll('.run')].length === 2")
    # What went well is a notice that goes away by itself.
    chrome.wait("!document.querySelector('.job')")
    chrome.wait("(document.querySelector('.title h2')?.textContent ?? 'field/hidden') !== 'field/hidden'")
    chrome.wait(SHOWN)
    look_for_trouble(chrome)


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


def count_marks(figure: str, pane: str = "a") -> str:
    """How many marked spans or points a figure shows."""
    kinds = "path[stroke='#00b3d6'], path[fill='#00b3d6']"
    plot = f"[data-slot={pane}] [data-figure={figure}]"
    return f"document.querySelector('{plot}').querySelectorAll(\"{kinds}\").length"


@pytest.mark.long
def test_the_signature_of_an_effect_comes_goes_and_follows_its_value(
    chrome: Chrome, workbench: Workbench, pictures: Path
) -> None:
    drawn = "document.querySelector('.plot.drawn[data-figure=signature] .mark-line path')"
    gone = "!document.querySelector('[data-figure=signature]')"
    # How far the curve stands out of its panel [px].
    outside = (
        "(() => { const line = document.querySelector('[data-figure=signature] .mark-line path');"
        " const panel = line.closest('.mark-group').querySelector('.background').getBoundingClientRect();"
        " const { top, bottom } = line.getBoundingClientRect();"
        " return Math.max(panel.top - top, bottom - panel.bottom); })()"
    )
    chrome.size(LAPTOP, 900)
    chrome.open(workbench.address)
    chrome.wait(SHOWN)
    before = cast("float", chrome.run(ERROR))
    assert chrome.run(gone)
    chrome.click("[data-tab=effects]")
    chrome.wait(f"document.querySelector('.plot.drawn[data-figure=ladder]') && {SHOWN}")
    # What stands there when the number has begun to move: the figures are still those of before.
    chrome.run(
        "new MutationObserver((_, watch) => { window.first ??= "
        f"{gone}; watch.disconnect(); }}).observe(document.querySelector('.number.r .value'),"
        " { childList: true, characterData: true, subtree: true })"
    )
    # No other figure is drawn anew: what a person looks at does not flicker.
    chrome.run(
        "window.still = document.querySelector('.plot[data-figure=paths] svg'),"
        " window.whole = document.querySelector('figure[data-id=ladder]')"
    )
    chrome.click(".proposals li[data-effect=effective_track] .add")
    chrome.wait(drawn)
    assert chrome.run("window.first") is True
    assert chrome.run("window.still.isConnected && window.whole.isConnected") is True
    chrome.wait(f"{ERROR} < {0.1 * before}")
    chrome.picture(pictures / "workbench_signature.png", whole=True)
    assert cast("float", chrome.run(outside)) < 1.0

    # While the slider is held at its end the axis grows with the curve; at the neutral value there is none.
    shape = f"{drawn}.getAttribute('d')"
    ticks = "document.querySelector('.plot[data-figure=signature]').textContent"
    fitted = f"{json.dumps(chrome.run(shape))} + {json.dumps(chrome.run(ticks))}"
    slide = (
        "(() => {{ const input = document.querySelector('.slider input'); input.step = 'any';"
        " input.value = {}; for (const kind of {}) input.dispatchEvent(new Event(kind)); }})()"
    )
    chrome.run(slide.format("input.min", "['input']"))
    chrome.wait(f"{drawn} && {shape} + {ticks} !== {fitted}")
    assert cast("float", chrome.run(outside)) < 1.0
    chrome.run(slide.format("1", "['input']"))
    chrome.wait(f"{drawn}.getBBox().height === 0")
    look_for_trouble(chrome)
    chrome.run(slide.format("1", "['change']"))
    chrome.wait(gone)
    chrome.click(".undo")
    chrome.wait(drawn)
    chrome.click(".switch")
    chrome.wait(gone)
    chrome.click(".switch")
    chrome.wait(drawn)
    look_for_trouble(chrome)


@pytest.mark.long
def test_a_stretch_that_is_brushed_shows_on_the_map_and_in_command_space(
    chrome: Chrome, workbench: Workbench, pictures: Path
) -> None:
    chrome.size(LAPTOP, 900)
    chrome.open(workbench.address)
    chrome.wait(SHOWN)
    chrome.wait(
        "document.querySelectorAll('.plot.drawn').length === document.querySelectorAll('.plot').length"
    )
    before = {name: chrome.run(count_marks(name)) for name in ("trajectory", "command_space", "reach")}
    chrome.drag("[data-figure=reach] svg", (0.3, 0.5), (0.5, 0.5))
    chrome.wait("!document.querySelector('.marked').hidden")
    assert "highest slip" in str(chrome.run("document.querySelector('.marked').textContent"))
    for name, count in before.items():
        chrome.wait(f"{count_marks(name)} > {count}")
    chrome.picture(pictures / "workbench_brushed.png", whole=True)
    # The mark outlives a change of the model.
    chrome.click(".proposals .add")
    chrome.wait(
        "document.querySelector('.card') && !document.querySelector('.pane').classList.contains('busy')"
    )
    chrome.wait(f"{count_marks('trajectory')} > {before['trajectory']}")

    # A box on the map marks the times the vehicle was there; beside it the same run follows.
    chrome.click("#compare")
    chrome.wait("document.querySelector('[data-slot=b]')?.dataset.drawn")
    chrome.drag("[data-slot=a] [data-figure=trajectory] svg", (0.3, 0.3), (0.8, 0.8))
    chrome.wait(f"{count_marks('reach', 'b')} > {before['reach']}")
    chrome.press("Escape", 27)
    chrome.wait("[...document.querySelectorAll('.marked')].every((bar) => bar.hidden)")
    chrome.wait(f"{count_marks('trajectory')} === {before['trajectory']}")

    # And by numbers.
    chrome.run("document.querySelector('.mark-from').value = '10'")
    chrome.run("document.querySelector('.mark-to').value = '20'")
    chrome.click(".mark-set")
    chrome.wait("document.querySelector('.marked').textContent.includes('20.0 s: 10.0 s, highest slip')")
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
            "[...document.querySelectorAll('.proposals li')].filter((entry) =>"
            " entry.textContent.includes('identified by the diagnosis')).map((entry) => entry.dataset.effect)"
        )
        assert set(chrome.run(named)) == {"effective_track", "drive_lag"}
        manifest = Store(tmp_path / "out").manifest("field/late")
        assert manifest is not None
        told = json.loads(manifest.path("diagnosis.json").read_text())["where"][0]["text"]
        assert told in str(chrome.run("document.querySelector('.where').textContent"))
        chrome.click(".add-all")
        chrome.wait("document.querySelectorAll('.card').length === 2")
        chrome.click("[data-tab=effects]")
        chrome.wait("document.querySelectorAll('[data-figure=ladder] .mark-rect path').length === 3")
        chrome.wait("document.querySelector('.said').textContent === '+ all 2 of the diagnosis'")
        look_for_trouble(chrome)


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
    chrome.wait("document.querySelector('.said').textContent === '+ wheel_radius'")
    assert chrome.run("document.querySelector('select.catalogue').selectedIndex") == 0
    errors = [text for text in chrome.errors if "422" not in text]
    assert errors == []


@pytest.mark.long
def test_a_run_stands_beside_those_that_its_report_does(chrome: Chrome, workbench: Workbench) -> None:
    store = Store(workbench.results)
    manifest = store.manifest(RUN)
    assert manifest is not None
    own = json.loads(manifest.path("summary.json").read_text()) | {"terrain": "ice", "dataset": "husky_ice"}
    manifest.path("summary.json").write_text(json.dumps(own))
    doubtful = [{"id": "not_moving", "severity": "error", "text": "it does not move"}]
    others: list[dict[str, object]] = [
        {"median_modulus": 0.0, "log": {"sha256": "low"}},
        {"median_modulus": 9.0, "log": {"sha256": "high"}},
        {"median_modulus": 9.0, "log": {"sha256": "high"}},
        {"median_modulus": 0.0, "log": own["log"]},
        {"median_modulus": 0.0, "log": {"sha256": "still"}, "findings": doubtful},
        {"median_modulus": 0.0, "log": {"sha256": "scaled"}, "length_scale_m": 0.5},
        {"median_modulus": 0.0, "log": {"sha256": "grass"}, "dataset": "husky_grass"},
    ]
    for number, other in enumerate(others):
        summary = {**own, "findings": [], "run": f"field/other_{number}", **other}
        with store.open_generation(f"field/other_{number}", "0" * 16) as generation:
            generation.write_text("summary.json", json.dumps(summary))
            generation.commit({"dataset": summary["dataset"], "log": summary["log"]})
    assert len(find_peers(store, own)[own["leading_input"]]) == 2
    chrome.size(LAPTOP, 900)
    chrome.open(workbench.address)
    # Runs that cannot be fitted are passed over.
    chrome.wait(SHOWN)
    chrome.errors.clear()
    chrome.run(f"location.hash = 'a={RUN}'")
    chrome.run("location.reload()")
    chrome.wait(f"document.querySelector('.title h2')?.textContent === '{RUN}' && {SHOWN}")
    facts = str(chrome.run("document.querySelector('.hero .facts').textContent"))
    assert "vs 2 runs of husky_ice: more slip than 1" in facts
    look_for_trouble(chrome)


@pytest.mark.parametrize(
    ("width", "dark"),
    [(PHONE, False), pytest.param(LAPTOP, True, marks=pytest.mark.long)],
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
        chrome.run("document.querySelector('.plan input').value = '2x2m'")
        chrome.click(".plan .ask button")
        chrome.wait("document.querySelector('.job.failed p')?.textContent.includes('area')")
        chrome.run("document.querySelector('.plan input').value = '20x10m'")
        chrome.click(".plan .ask button")
        chrome.wait("document.querySelector('.planned .plot.drawn')", patience_s=60.0)
        assert "icr_offset" in str(chrome.run("document.querySelector('.planned ul').textContent"))
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
