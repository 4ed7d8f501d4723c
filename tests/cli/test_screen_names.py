"""Names of files and topics reach the screen as what they are, and do nothing to it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.cli import main
from pipeline.cli.output import print_error, print_lines, tidy_line
from pipeline.cli.screen import describe_run
from pipeline.core.errors import SlipError

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("plain é 雪.mcap", "plain é 雪.mcap"),
        ("two\nlines", "two\\nlines"),
        ("red\x1b[31m", "red\\x1b[31m"),
        ("turned\u202egpj", "turned\\u202egpj"),
        ("bytes\udcff", "bytes\\xff"),
        ("half\ud83d", "half\\ud83d"),
    ],
)
def test_what_is_no_text_is_spelled_out(name: str, shown: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert tidy_line(name) == shown
    print_lines([name, "next"])
    print_error(SlipError("code", f"cannot read {name}", where=name, hint=""))
    out, err = capsys.readouterr()
    assert out == f"{shown}\nnext\n"
    assert len(err.splitlines()) == 1
    assert "\x1b" not in err


@given(st.text(alphabet=st.characters()))
def test_a_line_stays_a_line_that_can_be_written(text: str) -> None:
    tidy = tidy_line(text)
    assert len(tidy.splitlines()) <= 1
    assert tidy.encode("utf-8").decode("utf-8") == tidy
    assert tidy_line(tidy) == tidy


def test_a_log_cannot_write_lines_of_its_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "a\nall is well\x1b[2J.mcap"
    log.write_text("no recording\n" * 5)
    out = tmp_path / "out"
    with pytest.raises(SystemExit):
        main(["batch", str(log), "--out", str(out), "--executor", "inline", "--settle", "0"])
    with pytest.raises(SystemExit):
        main(["status", str(out)])
    with pytest.raises(SystemExit):
        main(["analyze", str(log), "--out", str(out)])
    text = "".join(capsys.readouterr())
    assert "\x1b" not in text
    assert "all is well" in text
    assert not any(line.startswith("all is well") for line in text.splitlines())


def test_a_summary_keeps_to_its_lines() -> None:
    log = {"losses": [], "duration_s": 1.0}
    summary = {"run": "a\nb", "vehicle": "v\x1b", "terrain": "t", "log": log, "segments": 1}
    text = describe_run(summary, unchanged=False)
    assert "run                       a\\nb" in text
    assert "\x1b" not in text
