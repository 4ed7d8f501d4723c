"""Every flow of the workbench in a real browser, on a wide and on a narrow screen, and without barriers."""

import json
from contextlib import closing
from pathlib import Path
from typing import cast

import pytest
from barriers import find_barriers
from chrome import LAPTOP, PHONE, Chrome
from workbench_server import ERROR, RUN, SHOWN, Workbench

from pipeline.analysis.analyze import update_datasets
from pipeline.datasets.deployments import draw_up_map
from pipeline.report.datasets_page import write_map
from pipeline.simulate import simulate_case
from pipeline.store import Store

WIDTHS = pytest.mark.parametrize("width", [LAPTOP, PHONE])
SETTLED = (
    f"{SHOWN} && !document.querySelector('.pane.busy, .trying') &&"
    " document.querySelectorAll('.plot.drawn').length === document.querySelectorAll('.plot').length"
)
WIDER = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
REACHED = """(() => {
  const shown = [...document.querySelectorAll('button, a[href], input, select, summary')]
    .filter((node) => node.checkVisibility({ visibilityProperty: true }) && !node.disabled);
  return shown.filter((node) => node.tabIndex < 0).map((node) => node.outerHTML);
})()"""


def open_page(chrome: Chrome, workbench: Workbench, width: int, *, dark: bool = False) -> None:
    chrome.size(width, 900, dark=dark)
    chrome.open(workbench.address)
    chrome.wait(SETTLED)


def look(chrome: Chrome, picture: Path) -> None:
    """Nothing went wrong, nothing is wider than the screen; what is seen is kept."""
    chrome.picture(picture, whole=True)
    assert chrome.errors == []
    assert cast("int", chrome.run(WIDER)) <= 0


@pytest.mark.long
@WIDTHS
def test_add_slide_undo_and_save(chrome: Chrome, workbench: Workbench, pictures: Path, width: int) -> None:
    open_page(chrome, workbench, width)
    before = cast("float", chrome.run(ERROR))
    assert "error" in str(chrome.run("document.querySelector('.glance').innerText"))
    chrome.click(".proposals li[data-effect=effective_track] .add")
    chrome.wait(f"document.querySelector('.card') && {ERROR} < {0.1 * before}")
    chrome.wait(SETTLED)
    look(chrome, pictures / f"flow_added_{width}.png")

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

    # The slider, by keys; a value at its bound is said and red.
    slider = "document.querySelector('.slider input')"
    chrome.run(f"{slider}.focus()")
    for _ in range(10):
        chrome.press("ArrowRight", 39)
    chrome.wait("document.querySelector('.ideal-said').textContent.includes('by hand')")
    assert chrome.run(f"document.activeElement === {slider}")
    chrome.click(".hero .save")
    chrome.wait("document.getElementById('toast').textContent.includes('saved')")
    look(chrome, pictures / f"flow_saved_{width}.png")
    workbench.session(RUN, "set", effect="effective_track", parameter="k", value=10.0)
    chrome.run("location.reload()")
    chrome.wait("document.querySelector('.bound')?.innerText.includes('at its bound')")
    colours = (
        "['.at-bound output', '.bound'].map((part) => getComputedStyle(document.querySelector(part)).color)"
    )
    assert chrome.run(colours) == ["rgb(179, 38, 30)"] * 2
    assert (workbench.results / "workbench/models/field/hidden.toml").is_file()


@pytest.mark.long
@WIDTHS
def test_a_formula_is_added_by_keys(chrome: Chrome, workbench: Workbench, pictures: Path, width: int) -> None:
    open_page(chrome, workbench, width)
    before = cast("float", chrome.run(ERROR))
    chrome.run("document.querySelector('.formula summary').focus()")
    chrome.press("Enter", 13)
    chrome.call("Input.insertText", text="")
    for name, text in (("effect", "my_track"), ("formula", "k * w0"), ("parameters", "k [1] -0.9 .. 0.9")):
        chrome.run(
            "document.querySelector('.formula').open = true,"
            f" document.querySelector('.formula [name={name}]').focus()"
        )
        chrome.call("Input.insertText", text=text)
    chrome.run("document.querySelector('.formula [name=channel]').value = 'v_w'")
    chrome.run("document.querySelector('.formula button').click()")
    chrome.wait(f"document.querySelector('.card[data-effect=my_track]') && {ERROR} < {0.1 * before}")
    chrome.wait(SETTLED)
    assert chrome.run(REACHED) == []
    look(chrome, pictures / f"flow_formula_{width}.png")


@pytest.mark.long
@WIDTHS
def test_two_models_and_their_difference(
    chrome: Chrome, workbench: Workbench, pictures: Path, width: int
) -> None:
    workbench.session(RUN, "add", effect="effective_track")
    open_page(chrome, workbench, width)
    # Beside a model with an effect stands the ideal one: two things that differ.
    chrome.click("#compare")
    chrome.wait("document.querySelector('[data-slot=b]')?.dataset.drawn")
    chrome.wait(SETTLED)
    cells = "[...document.querySelectorAll('#difference tbody tr')].map((row) => row.innerText)"
    rows = cast("list[str]", chrome.run(cells))
    assert rows[1].startswith("heading error over 2 s [\u00b0]")
    first, second, apart = (text.split()[0] for text in rows[1].split("\t")[1:])
    assert float(apart) == pytest.approx(float(second) - float(first), rel=0.01)
    assert "effective_track.k" in rows[2]
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
@WIDTHS
def test_what_is_no_log_is_refused_beside_the_field_and_a_good_one_opens(
    chrome: Chrome, workbench: Workbench, pictures: Path, tmp_path: Path, width: int
) -> None:
    open_page(chrome, workbench, width)
    bad = tmp_path / "notes.mcap"
    bad.write_bytes(b"this is no recording\n" * 100)
    chrome.drop(bad, "#drop")
    chrome.wait("document.querySelector('.job.failed p')")
    told = str(chrome.run("document.querySelector('.job.failed').innerText"))
    assert "notes.mcap" in told
    assert str(workbench.results) not in told
    assert "workbench/uploads" not in told
    assert find_barriers(chrome) == []
    look(chrome, pictures / f"flow_refused_{width}.png")
    chrome.click(".job.failed .drop")
    chrome.wait("!document.querySelector('.job.failed')")

    good = simulate_case("husky_tile", out=tmp_path / "good.mcap", duration_s=40.0)
    chrome.drop(good, "#drop")
    chrome.wait("document.querySelector('.title h2')?.textContent === 'dropped/good'")
    chrome.wait(SETTLED)
    look(chrome, pictures / f"flow_dropped_{width}.png")


@pytest.mark.long
@WIDTHS
def test_who_has_no_log_is_given_one(chrome: Chrome, pictures: Path, tmp_path: Path, width: int) -> None:
    with closing(Workbench(tmp_path / "nothing yet")) as workbench:
        chrome.size(width, 900)
        chrome.open(workbench.address)
        chrome.wait("document.querySelector('.blank')")
        assert find_barriers(chrome) == []
        chrome.click(".sample")
        chrome.wait("document.querySelector('.job')")
        chrome.wait(SETTLED, patience_s=180.0)
        assert chrome.run("document.querySelector('.title h2').textContent") == "dropped/husky_tile"
        look(chrome, pictures / f"flow_sample_{width}.png")


@pytest.mark.long
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@WIDTHS
def test_no_barrier_on_the_page(chrome: Chrome, workbench: Workbench, width: int, *, dark: bool) -> None:
    open_page(chrome, workbench, width, dark=dark)
    assert find_barriers(chrome) == []
    chrome.click(".proposals .add")
    chrome.wait(f"document.querySelector('.card') && {SETTLED}")
    assert find_barriers(chrome) == []
    chrome.drag("[data-figure=reach] svg", (0.3, 0.5), (0.5, 0.5))
    chrome.wait("!document.querySelector('.marked').hidden")
    assert find_barriers(chrome) == []
    assert chrome.run(REACHED) == []
    assert chrome.errors == []


@pytest.mark.parametrize(
    "served", [True, pytest.param(False, marks=pytest.mark.long)], ids=["served", "from_files"]
)
def test_a_report_leads_to_all_runs_and_they_lead_back(
    chrome: Chrome, workbench: Workbench, results: Path, *, served: bool
) -> None:
    update_datasets(Store(results))
    if served:
        chrome.open(workbench.address)
        chrome.wait("document.querySelector('main')")
        chrome.open(f"{workbench.origin}/report?run={RUN}")
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
    assert chrome.errors == []
