"""How fast the workbench answers on a 10-minute log: a value moved by hand, an effect added, dropped, undone.

Asks a server over HTTP as the page does, numbers and figures, and prints the median and the slowest answer
in seconds; promised is 0.5 s. Then the same in a browser, where there is one: from the press on *Add* until
number, bar, path, map and *where* have changed on the page. The peer in the same run answers the same
question with nothing kept ready: tables, grid and score anew.
"""

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from itertools import cycle
from pathlib import Path
from typing import cast

# As `slip serve` has it, before numpy is loaded.
os.environ.update({"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"})

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation import EstimationData, choose_input, fit_model
from pipeline.estimation.held_out import score
from pipeline.models import Model, find_effect
from pipeline.run import load_motion_run
from pipeline.simulate import simulate_case
from pipeline.sources.one_vehicle import load_vehicle

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "fixtures"))

from collections.abc import Callable

from chrome import BROWSER, Chrome
from workbench_server import ServedWorkbench as Workbench

from pipeline.store import Manifest

EFFECTS = ("effective_track", "drive_lag", "lateral_skid")
SETTLED = (
    "document.querySelector('.pane')?.dataset.drawn && !document.querySelector('.pane.busy, .trying') &&"
    " document.querySelectorAll('.plot.drawn').length === document.querySelectorAll('.plot').length"
)
# Seconds from the press on a button until each part of the page is another one.
PRESS = """(async () => {
  const part = (selector, read) => () => read(document.querySelector(selector));
  const parts = {
    number: part('.number.t .value', (node) => node.textContent),
    bar: part('.track', (node) => node.style.getPropertyValue('--now')),
    path: part('[data-figure=paths]', (node) => node.innerHTML),
    map: part('[data-figure=trajectory]', (node) => node.innerHTML),
    where: part('.where', (node) => node.textContent),
  };
  const before = Object.fromEntries(Object.entries(parts).map(([name, read]) => [name, read()]));
  const moved = {};
  const start = performance.now();
  document.querySelector(BUTTON).click();
  while (Object.keys(moved).length < Object.keys(parts).length && performance.now() < start + 20000) {
    await new Promise(requestAnimationFrame);
    for (const [name, read] of Object.entries(parts))
      if (!(name in moved) && read() !== before[name]) moved[name] = (performance.now() - start) / 1000;
  }
  return moved;
})()"""


class Desk:
    """A desk as the page uses it."""

    def __init__(self, server: Workbench, run: str) -> None:
        self._server = server
        self._run = run
        self._values = cycle((1.5, 1.6, 1.7))

    def ask(self, action: str, **more: object) -> dict[str, object]:
        return self._server.session(self._run, action, **more)

    def draw(self) -> None:
        self._server.post("/api/figures", run=self._run)

    def change(self, action: str, **more: object) -> None:
        """A change of structure: the model is fitted anew, and what it moves in the figures is sent."""
        self.ask(action, **more)
        self._server.post("/api/rows", run=self._run)

    def slide(self) -> None:
        """A value moved by hand."""
        self.ask("preview", effect="effective_track", parameter="k", value=next(self._values))

    def try_all(self) -> None:
        self.ask("try")

    def is_trying(self) -> bool:
        trial = cast("dict[str, object] | None", self.ask("open")["trial"])
        return trial is not None and not trial["done"]


def measure(
    act: Callable[[], object], runs: int, undo: Callable[[], object] | None = None
) -> list[tuple[float, float]]:
    """Wall and CPU seconds of each of several times; the server works in this process."""
    taken = []
    for _ in range(runs):
        start, worked = time.perf_counter(), time.process_time()
        act()
        taken.append((time.perf_counter() - start, time.process_time() - worked))
        if undo is not None:
            undo()
    return taken


def answer_anew(manifest: Manifest) -> None:
    """What a moved value does to the error, with nothing kept ready."""
    vehicle = load_vehicle(manifest)
    run = load_motion_run(manifest, vehicle)
    data = EstimationData([run], vehicle, choose_input([run]).source)
    fit_model(data, Model(vehicle))
    model = Model(vehicle, (find_effect("effective_track")(k=1.6),))
    score(data, data.start_state(model))


def press_in_browser(server: Workbench, run: str) -> None:
    """From *Add* and *Undo* until the page has changed: a line each with the seconds of every part."""
    with tempfile.TemporaryDirectory() as folder:
        chrome = Chrome(Path(folder))
        try:
            chrome.size(1280, 900)
            chrome.open(f"{server.address}#a={run}")
            for effect in EFFECTS:
                chrome.wait(SETTLED)
                button = f".add[data-keep='add {effect}']"
                if chrome.run(f"Boolean(document.querySelector({json.dumps(button)}))"):
                    moved = chrome.run(PRESS.replace("BUTTON", json.dumps(button)))
                    print(f"  Add {effect}: {say(moved)}", flush=True)
            chrome.wait(SETTLED)
            print(f"  Undo: {say(chrome.run(PRESS.replace('BUTTON', json.dumps('.undo'))))}", flush=True)
        finally:
            chrome.close()


def say(moved: object) -> str:
    parts = cast("dict[str, float]", moved)
    return ", ".join(f"{name} {seconds:.2f}" for name, seconds in parts.items())


def show(title: str, taken: list[tuple[float, float]]) -> None:
    wall, cpu = zip(*taken, strict=True)
    print(
        f"{title:<44}{statistics.median(wall):>8.2f}{max(wall):>9.2f}{statistics.median(cpu):>8.2f}",
        flush=True,
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--log", type=Path, help="log to open; by default one of 10 minutes is simulated")
    parser.add_argument("--vehicle", help="its vehicle, where the log does not say it")
    parser.add_argument("--runs", type=int, default=5)


def run(chosen: argparse.Namespace) -> None:
    with tempfile.TemporaryDirectory() as name:
        log = chosen.log or simulate_case("husky_tile", out=Path(name) / "ten_minutes.mcap", duration_s=600.0)
        overrides = {"vehicle": {"preset": chosen.vehicle}} if chosen.vehicle else {}
        options = Options(out=Path(name) / "results", report=False, diagnosis=False, overrides=overrides)
        manifest = analyze_log(log, options).manifest
        server = Workbench(options.out)
        try:
            desk = Desk(server, manifest.run)
            print(f"{log.name}, median and slowest of {chosen.runs}")
            print(f"{'':<44}{'median s':>8}{'slowest':>9}{'CPU s':>8}")
            show("open a run (once)", measure(lambda: desk.ask("open"), 1))
            show("draw all figures, the first time", measure(desk.draw, 1))
            for effect in EFFECTS:
                add = measure(lambda name=effect: desk.change("add", effect=name, anyway=True), 1)
                show(f"add {effect}: refit, numbers, figures", add)
            undo, redo = (lambda action=action: desk.change(action) for action in ("undo", "redo"))
            show("undo", measure(undo, chosen.runs, redo))
            show(f"fit all {len(EFFECTS)} effects anew", measure(lambda: desk.change("fit"), 1))
            show("move a value: numbers and figures", measure(desk.slide, chosen.runs))
            desk.try_all()
            show("the same while every effect is tried", measure(desk.slide, chosen.runs))
            print("" if desk.is_trying() else "(the trial of every effect ended before the measurement did)")
            show(
                "peer: the error alone, nothing kept ready",
                measure(lambda: answer_anew(manifest), chosen.runs),
            )
        finally:
            server.close()
        if BROWSER is not None:
            # A server that has fitted nothing yet.
            server = Workbench(options.out)
            try:
                print("in a browser, seconds until a part of the page has changed")
                press_in_browser(server, manifest.run)
            finally:
                server.close()
