"""Every command of README and handbook prints what stands below it; every picture is of the current code."""

import base64
from pathlib import Path
from typing import cast

import pytest
from blocks import check_page, list_pages, read_commands
from chrome import Chrome
from pictures import FOLDER, draw_pictures

ROOT = Path(__file__).parents[2]
WITH_COMMANDS = [page for page in list_pages() if read_commands(page.read_text(encoding="utf-8"))]

# Both pictures on a small canvas, where letters and edges do not count: mean difference of a channel.
COMPARE = """
Promise.all(SOURCES.map((source) => new Promise((done, failed) => {
  const image = new Image();
  image.onload = () => {
    const canvas = Object.assign(document.createElement("canvas"), { width: 64, height: 40 });
    const drawn = canvas.getContext("2d");
    drawn.drawImage(image, 0, 0, 64, 40);
    done({ size: [image.width, image.height], data: drawn.getImageData(0, 0, 64, 40).data });
  };
  image.onerror = failed;
  image.src = source;
}))).then(([one, other]) => String(one.size) === String(other.size)
  ? one.data.reduce((sum, value, i) => sum + Math.abs(value - other.data[i]), 0) / one.data.length : 255)
"""
MOST = 6.0


@pytest.mark.long
@pytest.mark.parametrize("page", WITH_COMMANDS, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_commands_of_a_page_print_what_it_shows(page: Path, tmp_path: Path) -> None:
    assert check_page(page, tmp_path / "slip") == []


@pytest.mark.long
def test_the_pictures_show_the_current_pages(chrome: Chrome, tmp_path: Path) -> None:
    made = draw_pictures(tmp_path / "pictures")
    kept = [FOLDER / path.name for path in made]
    assert {path.name for path in FOLDER.glob("*.png")} == {path.name for path in made}
    for one, other in zip(made, kept, strict=True):
        assert other.stat().st_size < 300_000
        assert _difference(chrome, one, other) < MOST, f"{other.name} is old: run docs/tools/pictures.py"
    assert _difference(chrome, made[0], kept[1]) > MOST


def _difference(chrome: Chrome, one: Path, other: Path) -> float:
    sources = [
        f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}" for path in (one, other)
    ]
    return cast("float", chrome.run(COMPARE.replace("SOURCES", str(sources))))
