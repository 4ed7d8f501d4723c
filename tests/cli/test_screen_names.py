"""Names of files and topics reach the screen as what they are, and do nothing to it."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.cli import main
from pipeline.cli.conventions import fold_line, print_error, print_lines, tidy_line
from pipeline.core import SlipError


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
        main(["batch", str(log), "--results", str(out), "--executor", "inline", "--settle", "0"])
    with pytest.raises(SystemExit):
        main(["results", "status", "--results", str(out)])
    with pytest.raises(SystemExit):
        main(["analyze", str(log), "--results", str(out)])
    text = "".join(capsys.readouterr())
    assert "\x1b" not in text
    assert "all is well" in text
    assert not any(line.startswith("all is well") for line in text.splitlines())


ROW = "effects   drive_lag           tau = 0.304 s [0.274, 0.333]  0.187 -> 0.133 m, 0.355 -> 0.304 rad"
FOLDED = """\
effects   drive_lag           tau = 0.304 s [0.274, 0.333]
                              0.187 -> 0.133 m, 0.355 -> 0.304 rad"""


def test_folding_loses_nothing_and_ends() -> None:
    for width in [40, 80]:
        for line in ["", " " * 200, "x" * 200, "report    " + "/x" * 100, "a  " * 60, "  b c" * 40]:
            parts = fold_line(line, width)
            assert "".join(parts).replace(" ", "") == line.replace(" ", "")
            assert all(len(part) <= width or " " not in part.strip() or "/" in part for part in parts)


def test_a_screen_of_80_columns_is_kept_to_and_a_file_takes_in_whole_lines(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    print_lines([ROW])
    assert capsys.readouterr().out == f"{ROW}\n"
    monkeypatch.setenv("COLUMNS", "80")
    print_lines([ROW])
    assert capsys.readouterr().out == f"{FOLDED}\n"
