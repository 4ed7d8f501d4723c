"""Pictures of the report and of the workbench, made by the current code from a sample log.

python docs/tools/pictures.py [FOLDER]
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "fixtures"))

from chrome import BROWSER, Chrome  # noqa: E402 - found where the tests have it
from moving_picture import join_frames  # noqa: E402 - beside this file

if TYPE_CHECKING:
    from collections.abc import Iterator

FOLDER = ROOT / "docs" / "pages" / "pictures"
LOG = "data_samples/warthog_ice.mcap"
SLIP = Path(sys.executable).parent / "slip"
WIDTH, HEIGHT = 1280, 800
DRAWN = "document.querySelector('.plot') && !document.querySelector('.plot:not(.drawn)')"
CARDS = "document.querySelectorAll('.card').length"
SETTLED = (
    f"document.querySelector('.pane')?.dataset.drawn && !document.querySelector('.pane.busy') && {DRAWN}"
)


STEPS = 3
"""Effects that the moving picture adds, one a frame."""
FRAME_MS = 2000


def draw_pictures(folder: Path) -> list[Path]:
    """Make the pictures in a folder: report, workbench, the error as effects are added.

    Raises:
        RuntimeError: there is no Chromium.
    """
    if BROWSER is None:
        raise RuntimeError("pictures need Chromium: `make browser` installs it")
    with tempfile.TemporaryDirectory() as work, open_browser(Path(work)) as chrome:
        results = Path(work) / "results"
        subprocess.run([SLIP, "analyze", LOG, "--results", results, "--quiet"], cwd=ROOT, check=True)  # noqa: S603
        (page,) = results.rglob("report.html")
        chrome.size(WIDTH, HEIGHT)
        chrome.call("Emulation.setScrollbarsHidden", hidden=True)
        chrome.open(page.as_uri())
        chrome.wait("document.querySelectorAll('svg, canvas').length > 3")
        chrome.picture(folder / "report.png")
        with serve_results(results) as address:
            chrome.open(address)
            frames = []
            for count in range(STEPS + 1):
                if count:
                    chrome.click(".proposals .add")
                chrome.wait(f"{CARDS} === {count} && {SETTLED}")
                # Where this machine keeps its files is nobody's business.
                chrome.run("document.getElementById('results').textContent = 'results'")
                chrome.run("scrollTo(0, 0); document.getElementById('side').scrollTop = 0")
                # Numbers run to where they are, and what was pressed is left.
                chrome.call("Input.dispatchMouseEvent", type="mouseMoved", x=1, y=1)
                time.sleep(1.0)
                frames.append(Path(work) / f"frame_{count}.png")
                chrome.picture(frames[-1])
        shutil.copy(frames[2], folder / "workbench.png")
        (folder / "falling.png").write_bytes(join_frames([frame.read_bytes() for frame in frames], FRAME_MS))
    names = ("report.png", "workbench.png", "falling.png")
    return [folder / name for name in names]


@contextmanager
def open_browser(work: Path) -> Iterator[Chrome]:
    """A page of a browser whose profile lies in a folder."""
    chrome = Chrome(work / "profile")
    try:
        yield chrome
    finally:
        chrome.close()


@contextmanager
def serve_results(results: Path) -> Iterator[str]:
    """The address of a workbench, with its token."""
    server = subprocess.Popen(  # noqa: S603
        [SLIP, "serve", "--results", results, "--port", "0", "--json"],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    with server:
        try:
            text = ""
            for line in server.stdout or ():
                text += line
                if line.startswith("}"):
                    break
            told = json.loads(text)
            yield f"{told['address']}?token={told['token']}"
        finally:
            os.killpg(server.pid, signal.SIGTERM)


def main() -> int:
    """Make the pictures of the handbook, or in the folder that is named."""
    for path in draw_pictures(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER):
        print(f"{path}  {path.stat().st_size / 1e3:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
