"""Every page on a phone and a laptop, light and dark, and what is wrong with it.

python docs/tools/screenshots.py FOLDER [--results RESULTS] [--logs LOGS] [--only NAME ...]

Each page is photographed in pieces that can be read, and searched for barriers (axe), console errors, and
what is wider than the window. Exit code 1 says that something was found.
"""

from __future__ import annotations

import argparse
import base64
import os
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, cast

from pictures import ROOT, SLIP, open_browser, serve_results
from screen_states import LIFTED, SAMPLES, Screen, list_states

sys.path += [str(ROOT / "tests" / "fixtures")]

from barriers import find_barriers
from chrome import BROWSER, Chrome
from comparison_store import Run, make_budget, write_run

from pipeline.store import Store

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

RECORDINGS = ("warthog_gravel_1", "husky_snow_boreal")
"""Real recordings whose reports are looked at, too, where they are."""
HANDBOOK = ("index", "screen", "effects/effective_track", "symptoms/turns-too-little")
SIZES = {"phone": (390, 844), "laptop": (1280, 800)}
LOOKS = tuple(product(SIZES, (False, True)))
"""Windows, and whether they are dark."""
PIECE_PX = 2400
"""Height of a piece of a long page: what is taller cannot be read at a glance."""
REST_S = 0.7
"""Numbers run to where they are for half a second."""


@dataclass(frozen=True)
class Finding:
    """What is wrong with a screen in one window.

    Attributes:
        screen: its name.
        look: the window, as `phone dark`.
        barriers: serious and critical findings of axe.
        errors: console errors and warnings, exceptions, refused requests.
        overflow_px: by how much the page is wider than the window.
        pictures: files, from top to bottom.
    """

    screen: str
    look: str
    barriers: Sequence[str]
    errors: Sequence[str]
    overflow_px: int
    pictures: Sequence[Path]

    @property
    def is_sound(self) -> bool:
        """Whether nothing was found."""
        return not self.barriers and not self.errors and self.overflow_px <= 0


def photograph(chrome: Chrome, screen: Screen, size: str, folder: Path, *, dark: bool) -> Finding:
    """Open a screen in a window, take its pictures, and look for what is wrong."""
    look = f"{size} {'dark' if dark else 'light'}"
    chrome.size(*SIZES[size], dark=dark)
    # Another part of one page would not be loaded anew.
    chrome.open("about:blank")
    chrome.errors.clear()
    chrome.open(screen.address)
    chrome.wait(screen.ready)
    screen.act(chrome)
    time.sleep(REST_S)
    errors = [text for text in chrome.errors if not screen.said or screen.said not in text]
    # On a phone the inner width grows with the page.
    overflow = cast("int", chrome.run("document.documentElement.scrollWidth")) - SIZES[size][0]
    stem = folder / f"{screen.name}_{look.replace(' ', '_')}"
    pictures = list(_take_pictures(chrome, stem))
    return Finding(screen.name, look, find_barriers(chrome), errors, overflow, pictures)


def _take_pictures(chrome: Chrome, stem: Path) -> Iterator[Path]:
    """The whole page in pieces."""
    height, width, window = cast(
        "list[int]", chrome.run("[document.documentElement.scrollHeight, innerWidth, innerHeight]")
    )
    stem.parent.mkdir(parents=True, exist_ok=True)
    chrome.run("scrollTo(0, 0)")
    for number, top in enumerate(range(0, height, PIECE_PX), start=1):
        clip = {
            "x": 0,
            "y": top,
            "width": width,
            "height": min(PIECE_PX, max(height, window) - top),
            "scale": 1,
        }
        answer = chrome.call("Page.captureScreenshot", format="png", captureBeyondViewport=True, clip=clip)
        path = stem.with_name(f"{stem.name}_{number}.png")
        path.write_bytes(base64.b64decode(str(answer["data"])))
        yield path


def run_slip(*arguments: object) -> None:
    """Run a verb; it may say that a log had losses, or that something changed.

    Raises:
        RuntimeError: it failed.
    """
    done = subprocess.run(  # noqa: S603
        [SLIP, *map(str, arguments)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if done.returncode not in {0, 3, 4}:
        raise RuntimeError(f"slip {' '.join(map(str, arguments))}\n{done.stdout}{done.stderr}")


def analyze_logs(results: Path, work: Path, logs: Path | None) -> list[Path]:
    """Bring the samples, a run with its wheels in the air, and recordings into results; their reports."""
    lifted = work / f"{LIFTED}.mcap"
    run_slip("simulate", "--effect", "wheel_radius=0", "--duration", 60, "--file", lifted, "--force")
    paths = [ROOT / "data_samples" / f"{name}.mcap" for name in (*SAMPLES, "mystery_3")]
    paths += [logs / f"{name}.mcap" for name in RECORDINGS if logs and (logs / f"{name}.mcap").is_file()]
    # Each its own call: of several logs the diagnosis is joint.
    run_slip("analyze", lifted, "--vehicle", "husky_a200", "--results", results, "--quiet")
    for path in paths:
        run_slip("analyze", path, "--results", results, "--quiet")
    return [max(results.glob(f"runs/**/{path.stem}/*/report.html")) for path in (*paths, lifted)]


def make_up_fleet(results: Path) -> None:
    """Runs of two vehicles on four terrains with what a diagnosis named."""
    for vehicle, mass in (("warthog", 470.0), ("husky_a200", 75.0)):
        for number, terrain in enumerate(("asphalt", "gravel", "ice", "snow") * 2):
            name = f"{vehicle}_{terrain}_{number}"
            track = 1.5 + 0.1 * (number % 4) + 0.02 * (number // 4)
            run = Run(
                name=f"field/{name}",
                dataset=f"{vehicle}_{terrain}",
                vehicle=vehicle,
                terrain=terrain,
                mass_kg=mass,
                sha256=name,
                start_ns=1_700_000_000_000_000_000 + number * 86_400 * 1_000_000_000,
                estimates=[("effective_track", "k", track, 0.01), ("drive_lag", "tau", 0.3, 0.02)],
                budget=make_budget({"effective_track": track - 1.0, "drive_lag": 0.3, "disturbance": 0.1}),
            )
            write_run(Store(results), run, seed=number)


def write_pages(results: Path) -> Iterator[Screen]:
    """The pages over many runs."""
    fleet = (("fleet", "fit"), ("fleet", "trend"), ("fleet", "map"), ("compare",), ("compare", "--causes"))
    for verb in fleet:
        run_slip(*verb, "--results", results, "--quiet")
    for name in ("fleet", "trend", "map", "comparison", "causes", "index"):
        if (results / f"{name}.html").is_file():
            yield Screen(f"page_{name}", (results / f"{name}.html").as_uri())


def write_plan(work: Path) -> Screen:
    """The page of a plan for a vehicle that no log is of."""
    folder = work / "plan"
    places = ("--folder", folder, "--results", work / "none")
    run_slip("plan", "--vehicle", "husky_a200", "--time", "120s", *places, "--quiet")
    return Screen("plan", (folder / "plan.html").as_uri())


def write_check(results: Path, work: Path) -> Screen:
    """The page of `slip check`."""
    before, after, page = ROOT / "data_samples" / "husky_tile.mcap", work / "later.mcap", work / "check.html"
    run_slip("simulate", "husky_tile", "--effect", "drive_lag=0.6", "--seed", 9, "--file", after, "--force")
    run_slip("check", before, after, "--to", "html", "--file", page, "--results", results, "--force")
    return Screen("check", page.as_uri())


def build_handbook(work: Path) -> list[Screen]:
    """Pages of the handbook."""
    site = work / "handbook"
    build = ["build", "--quiet", "--config-file", "docs/mkdocs.yml", "--site-dir", str(site)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    subprocess.run([sys.executable, "-m", "mkdocs", *build], cwd=ROOT, env=environment, check=True)  # noqa: S603
    return [
        Screen(f"handbook_{name.replace('/', '_')}", (site / f"{name}.html").as_uri()) for name in HANDBOOK
    ]


class Studio:
    """What the screens are made of, made when they are asked for.

    Args:
        stack: ends the servers.
        work: folder for what is not kept.
        kept: results to use and to add to, whose runs also fill the pages over many runs; without them
            the samples are analyzed, and those pages are of a fleet that is made up.
        logs: folder with real recordings.
    """

    def __init__(self, stack: ExitStack, work: Path, kept: Path | None, logs: Path | None) -> None:
        self._stack, self._work, self._logs = stack, work, logs
        self._results = (kept or work / "results").resolve()
        self._fleet = self._results
        if kept is None:
            self._fleet = work / "fleet"
            make_up_fleet(self._fleet)
        self.kinds: dict[str, Callable[[], Iterable[Screen]]] = {
            "report": self._list_reports,
            "workbench": self._list_workbench,
            "page": lambda: write_pages(self._fleet),
            "plan": lambda: [write_plan(work)],
            "check": lambda: [write_check(self._results, work)],
            "handbook": lambda: build_handbook(work),
        }

    @cached_property
    def _reports(self) -> list[Path]:
        return analyze_logs(self._results, self._work, self._logs)

    def _list_reports(self) -> list[Screen]:
        return [Screen(f"report_{page.parts[-3]}", page.as_uri()) for page in self._reports]

    def _list_workbench(self) -> list[Screen]:
        self._list_reports()
        text, log = self._work / "notes.mcap", self._work / "dropped.mcap"
        text.write_text("no log\n", encoding="utf-8")
        run_slip("simulate", "husky_tile", "--duration", 60, "--seed", 9, "--file", log, "--force")
        empty = self._stack.enter_context(serve_results(self._work / "empty"))
        address = self._stack.enter_context(serve_results(self._results))
        blank = Screen("workbench_empty", empty, "document.querySelector('.sample')")
        return [blank, *list_states(address, self._results, log, text)]


def take_all(
    folder: Path, kept: Path | None = None, logs: Path | None = None, only: Sequence[str] = ()
) -> list[Finding]:
    """Photograph screens in all windows.

    Args:
        folder: of the pictures.
        kept: as in `Studio`.
        logs: folder with real recordings.
        only: beginnings of the names of screens; all without any.

    Raises:
        RuntimeError: there is no Chromium, or a command failed.
    """
    if BROWSER is None:
        raise RuntimeError("screenshots need Chromium: `make browser` installs it")
    wanted = tuple(only) or ("",)
    with ExitStack() as stack:
        work = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        kinds = Studio(stack, work, kept, logs).kinds
        asked = [
            make for kind, make in kinds.items() if any(kind.startswith(one.split("_")[0]) for one in wanted)
        ]
        screens = [screen for make in asked for screen in make() if screen.name.startswith(wanted)]
        chrome = stack.enter_context(open_browser(work))
        return [
            photograph(chrome, screen, size, folder, dark=dark)
            for screen, (size, dark) in product(screens, LOOKS)
        ]


def format_table(findings: Sequence[Finding]) -> str:
    """What was found, a line a screen and window, and the findings themselves below."""
    width = max(len(one.screen) for one in findings) + 2
    lines = [f"{'screen':<{width}}{'window':<14}{'axe':>5}{'console':>9}{'wider [px]':>12}"]
    for one in findings:
        counts = f"{len(one.barriers):>5}{len(one.errors):>9}{max(one.overflow_px, 0):>12}"
        lines.append(f"{one.screen:<{width}}{one.look:<14}{counts}")
        lines += [f"  ! {text[:400]}" for text in (*one.barriers, *one.errors)]
    wrong = sum(not one.is_sound for one in findings)
    pictures = sum(len(one.pictures) for one in findings)
    return "\n".join([*lines, f"{len(findings)} looks, {pictures} pictures, {wrong} with findings"])


def main() -> int:
    """Photograph all screens into a folder and print what is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="of the pictures")
    parser.add_argument("--results", type=Path, help="results to use and to add to")
    parser.add_argument("--logs", type=Path, default=ROOT.parent / "shared" / "logs", help="real recordings")
    parser.add_argument("--only", nargs="+", default=[], help="beginnings of names of screens")
    options = parser.parse_args()
    findings = take_all(options.folder, options.results, options.logs, options.only)
    print(format_table(findings))
    return int(not all(one.is_sound for one in findings))


if __name__ == "__main__":
    sys.exit(main())
