"""The catalogue in a real browser: columns sort, the box searches, nothing is blocked or broken."""

import base64
import hashlib
import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from batch_tools import batch

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking")

PROBE = """
const names = () => [...document.querySelectorAll("tbody tr")].filter((row) => !row.hidden)
  .map((row) => row.cells[0].firstChild.textContent.trim());
const click = (title) => [...document.querySelectorAll("thead button")]
  .find((button) => button.textContent.startsWith(title)).click();
const type = (text) => {
  const box = document.querySelector("#wanted");
  box.value = text;
  box.dispatchEvent(new Event("input"));
};
const seen = { first: names() };
click("duration"); seen.up = names();
click("duration"); seen.down = names();
seen.mark = document.querySelectorAll("[aria-sort=descending]").length;
type("WARTHOG ice"); seen.found = names(); seen.count = document.querySelector("#shown").textContent;
type(""); seen.all = names();
const told = document.createElement("pre");
told.id = "seen";
told.textContent = JSON.stringify(seen);
document.body.append(told);
"""


@pytest.mark.long
@pytest.mark.skipif(BROWSER is None, reason="there is no browser here; `make browser` installs one")
def test_columns_sort_and_the_box_searches(season: Path, tmp_path: Path) -> None:
    batch(season, tmp_path / "out")
    page = (tmp_path / "out" / "index.html").read_text()
    digest = base64.b64encode(hashlib.sha256(PROBE.encode()).digest()).decode()
    page = page.replace("script-src ", f"script-src 'sha256-{digest}' ")
    probed = tmp_path / "probed.html"
    probed.write_text(page.replace("</body>", f"<script>{PROBE}</script></body>"))
    shown = subprocess.run(
        [str(BROWSER), *FLAGS, f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", probed.as_uri()],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    told = re.search(r'<pre id="seen">(.*?)</pre>', shown.stdout)
    assert told is not None, shown.stdout[-2000:]
    seen = json.loads(told[1])
    # The logs were simulated a second longer each.
    runs = ["season/a", "season/b", "season/c", "season/d"]
    assert seen["first"] == seen["up"] == runs
    assert seen["down"] == seen["all"] == runs[::-1]
    assert seen["mark"] == 1
    assert (seen["found"], seen["count"]) == (["season/d"], "1 of 4 runs")
