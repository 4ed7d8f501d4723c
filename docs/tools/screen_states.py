"""What screenshots.py looks at, and the states of the workbench with what a person does to reach them."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlencode

from chrome import Chrome

from pipeline.store import Store

SAMPLES = ("warthog_ice", "husky_tile")
LIFTED = "wheels_in_the_air"
"""A run that is refused."""
_REFUSAL = "422"
"""The status of what the workbench refuses; the browser notes it on the console by itself."""

DRAWN = (
    "document.readyState === 'complete' && (document.documentElement.dataset.drawn === 'yes' ||"
    " !document.querySelector('.plot'))"
)
_PLOTS = "[...document.querySelectorAll('.plot')].every((one) => one.matches('.drawn') || !one.clientWidth)"
_SETTLED = (
    f"document.querySelector('.pane')?.dataset.drawn && !document.querySelector('.pane.busy, .trying')"
    f" && {_PLOTS}"
)
# Every state begins with the ideal model on both sides.
_FORGET = """(async () => {
  for (const slot of ["a", "b"]) for (let undo = ""; undo !== null; ) {
    const body = JSON.stringify({ run: RUN, slot, action: "undo" });
    undo = (await (await fetch("/api/session", { method: "POST", body })).json()).session.undo;
  }
})()"""
_REFUSED = "document.querySelector('.verdict.refused')"


def _rest(_: Chrome) -> None:
    """Leave a page as it opened."""


@dataclass(frozen=True)
class Screen:
    """A page, or a state of one.

    Attributes:
        name: of its pictures.
        address: where it is.
        ready: what holds once it is drawn.
        act: what a person does there before looking.
        said: what the console may say.
    """

    name: str
    address: str
    ready: str = DRAWN
    act: Callable[[Chrome], None] = _rest
    said: str = ""


def list_states(address: str, results: Path, log: Path, text: Path) -> list[Screen]:
    """The workbench in its states.

    Args:
        address: of the workbench, with its token.
        results: its results folder.
        log: that is dropped on the page.
        text: a file that is no log, dropped there, too.
    """
    names = {run.rpartition("/")[2]: run for run in Store(results).runs()}
    run, other = (names[name] for name in SAMPLES)

    def show(name: str, opened: str, *acts: Callable[[Chrome], None], said: str = "") -> Screen:
        def act(chrome: Chrome) -> None:
            chrome.run(_FORGET.replace("RUN", json.dumps(opened)))
            # The page that is left would be taken for the one that comes.
            chrome.run("window.left = true; location.reload()")
            chrome.wait(f"!window.left && document.readyState === 'complete' && ({_SETTLED})")
            for one in acts:
                one(chrome)

        place = f"{address}#{urlencode({'a': opened})}"
        return Screen(f"workbench_{name}", place, _SETTLED, act, said)

    return [
        show("runs", run, _open("runs")),
        show("first_view", run),
        show("effects", run, _add, _open("effects")),
        show("refused_effect", other, _add_all, _refuse, said=_REFUSAL),
        show("formula", run, _add, _write, said=_REFUSAL),
        show("compare", run, _add, _open("compare")),
        show("beside", run, _add, _open("compare"), _set_beside),
        show("budget", run, _add, _open("budget")),
        show("upload", run, _drop(log, ".job .progress")),
        show("upload_refused", run, _drop(text, ".job.failed"), said=_REFUSAL),
        show("refused_run", names[LIFTED]),
    ]


def _open(tab: str) -> Callable[[Chrome], None]:
    def open_tab(chrome: Chrome) -> None:
        chrome.click(f"[data-tab={tab}]")
        chrome.wait(_SETTLED)

    return open_tab


def _add(chrome: Chrome) -> None:
    chrome.click(".proposals .add")
    chrome.wait(f"document.querySelector('.card') && {_SETTLED}")


def _add_all(chrome: Chrome) -> None:
    chrome.click(".add-all")
    chrome.wait(f"document.querySelector('.card') && {_SETTLED}")


def _refuse(chrome: Chrome) -> None:
    # The list is built anew while effects are tried: chosen and said in one breath.
    chrome.run(
        "(() => { document.querySelector('select.catalogue').value = 'wheel_radius';"
        " document.querySelector('.add-chosen').click(); })()"
    )
    chrome.wait("!document.getElementById('toast').hidden")


def _write(chrome: Chrome) -> None:
    fields = {
        "effect": "my_skid",
        "formula": "c * v0 * w0",
        "parameters": "c [s] -0.5 .. 0.5",
        "channel": "v_y",
    }
    chrome.run("document.querySelector('details.formula').open = true")
    for name, value in fields.items():
        chrome.run(f"document.querySelector('.formula [name={name}]').value = '{value}'")
    chrome.click(".formula [type=submit]")
    written = "document.querySelector('.card[data-effect=my_skid]')"
    # A notice goes by itself, and effects may still be tried then.
    chrome.wait(f"{written} || !document.getElementById('toast').hidden")
    chrome.wait(_SETTLED)


def _set_beside(chrome: Chrome) -> None:
    chrome.click(".rival")
    chrome.wait(f"document.querySelector('[data-slot=b]')?.dataset.drawn && {_SETTLED}")


def _drop(path: Path, state: str) -> Callable[[Chrome], None]:
    def drop_file(chrome: Chrome) -> None:
        chrome.drop(path, "#drop")
        chrome.wait(f"document.querySelector('{state}')")

    return drop_file
