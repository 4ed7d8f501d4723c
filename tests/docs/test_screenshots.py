"""Every page on a phone and a laptop, light and dark: nobody is kept out, nothing fails or is cut."""

from pathlib import Path

import pytest
from chrome import Chrome
from screen_states import Screen
from screenshots import LOOKS, format_table, photograph, take_all

PAGE = """<!DOCTYPE html><html lang="en"><title>page</title>
<meta name="viewport" content="width=device-width"><body><main><h1>page</h1>{}</main></body></html>"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("flaw", "found"),
    [
        ("<p>words</p>", (0, 0, False)),
        ("<p style='width: 3000px'>words</p>", (0, 0, True)),
        ("<img src='data:image/gif;base64,R0lGODlhAQABAAAAACw='>", (1, 0, False)),
        ("<script>console.error('it broke')</script>", (0, 1, False)),
    ],
)
def test_a_flaw_of_a_page_is_found(
    flaw: str, found: tuple[int, int, bool], chrome: Chrome, tmp_path: Path
) -> None:
    page = tmp_path / "page.html"
    page.write_text(PAGE.format(flaw), encoding="utf-8")
    finding = photograph(chrome, Screen("page", page.as_uri()), "phone", tmp_path, dark=True)
    assert (len(finding.barriers), len(finding.errors), finding.overflow_px > 0) == found
    assert finding.is_sound == (found == (0, 0, False))
    assert {path.read_bytes()[:4] for path in finding.pictures} == {b"\x89PNG"}
    assert ("0 with findings" in format_table([finding])) == finding.is_sound


@pytest.mark.long
@pytest.mark.usefixtures("browser")
def test_no_screen_has_a_barrier_an_error_or_is_wider_than_its_window(pictures: Path) -> None:
    findings = take_all(pictures / "screens")
    states = {one.screen for one in findings}
    assert len([name for name in states if name.startswith("workbench")]) == 12
    assert {"plan", "check", "page_fleet", "page_comparison"} <= states
    assert len(findings) == len(states) * len(LOOKS)
    assert [one for one in findings if not one.is_sound] == [], format_table(findings)
