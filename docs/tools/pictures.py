"""Pictures of the report and of the workbench, made by the current code from a sample log: `make pictures`.

python docs/tools/pictures.py [FOLDER]
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))

from chrome import BROWSER, Chrome  # noqa: E402 - found where the tests have it

if TYPE_CHECKING:
    from collections.abc import Iterator

FOLDER = ROOT / "docs" / "pages" / "pictures"
LOG = "data_samples/warthog_ice.mcap"
SLIP = Path(sys.executable).parent / "slip"
WIDTH, HEIGHT = 1280, 800
DRAWN = "document.querySelectorAll('.plot.drawn').length === document.querySelectorAll('.plot').length"
CARDS = "document.querySelectorAll('.card').length"
SETTLED = (
    f"document.querySelector('.pane')?.dataset.drawn && !document.querySelector('.pane.busy') && {DRAWN}"
)


def draw_pictures(folder: Path) -> list[Path]:
    """Make both pictures in a folder.

    Raises:
        RuntimeError: there is no Chromium.
    """
    if BROWSER is None:
        raise RuntimeError("pictures need Chromium: `make browser` installs it")
    with tempfile.TemporaryDirectory() as work, _open_browser(Path(work)) as chrome:
        results = Path(work) / "results"
        subprocess.run([SLIP, "analyze", LOG, "--results", results, "--quiet"], cwd=ROOT, check=True)  # noqa: S603
        (page,) = results.rglob("report.html")
        chrome.size(WIDTH, HEIGHT)
        chrome.call("Emulation.setScrollbarsHidden", hidden=True)
        chrome.open(page.as_uri())
        chrome.wait("document.querySelectorAll('svg, canvas').length > 3")
        chrome.picture(folder / "report.png")
        with _serve(results) as address:
            chrome.open(address)
            chrome.wait(SETTLED)
            for count in (1, 2):
                chrome.click(".proposals .add")
                chrome.wait(f"{CARDS} === {count} && {SETTLED}")
            # Where this machine keeps its files is nobody's business.
            chrome.run("document.getElementById('results').textContent = 'results'")
            chrome.run("scrollTo(0, 0)")
            chrome.picture(folder / "workbench.png")
    return [folder / "report.png", folder / "workbench.png"]


@contextmanager
def _open_browser(work: Path) -> Iterator[Chrome]:
    chrome = Chrome(work / "profile")
    try:
        yield chrome
    finally:
        chrome.close()


@contextmanager
def _serve(results: Path) -> Iterator[str]:
    server = subprocess.Popen(  # noqa: S603
        [SLIP, "serve", results, "--port", "0", "--json"],
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
