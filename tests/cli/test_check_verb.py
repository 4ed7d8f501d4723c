"""`slip check`: exit codes and files, as a user calls it."""

import html
import json
import re
from pathlib import Path

import pytest
from verbs import run_verb

import slip
from pipeline.simulate import simulate_case

HOLD = {"drive_lag": {"tau": 0.3}}
LATE = {"drive_lag": {"tau": 1.2}}
LATE_RUNS = "logs/late.mcap,more/late.mcap"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two drives of a Husky, two late ones, and a model of the first: `a`, `b` and `late`, `more/late`."""
    folder = tmp_path_factory.mktemp("check")
    drives = {"logs/a": HOLD, "logs/b": HOLD, "logs/late": LATE, "more/late": LATE}
    for number, (name, effects) in enumerate(drives.items(), start=1):
        out = folder / f"{name}.mcap"
        simulate_case("ideal_husky", effects, out=out, duration_s=60.0, seed=number)
    run("model", "new", "husky.toml", "drive_lag", "--vehicle", "husky_a200", cwd=folder)
    run("model", "fit", "husky.toml", "--on", "logs/a.mcap", cwd=folder)
    return folder


def run(*arguments: object, cwd: Path, code: int = 0) -> str:
    done = run_verb(*arguments, "--quiet", cwd=cwd)
    assert done.returncode == code, done.stderr
    return done.stdout


def check(place: Path, *arguments: object, code: int) -> str:
    done = run_verb("check", *arguments, cwd=place)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout


def test_the_verdict_comes_first_and_the_exit_code_says_it(place: Path) -> None:
    same = check(place, "husky.toml", "logs/a.mcap,logs/b.mcap", code=0)
    late = check(place, "husky.toml", LATE_RUNS, code=4)
    single = " ".join(check(place, "husky.toml", "logs/late.mcap", "--results", "alone", code=3).split())

    assert same.startswith("No change shown in 1 number")
    assert late.startswith("Changed: lag of the drive 0.3")
    assert "-> 1.2 s" in late
    assert single.startswith("Cannot tell: a model and one run. These recordings differ in lag of the drive")
    assert "how much runs of this robot differ without a change is not known" in single


def test_screen_json_and_python_say_the_same(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    screen = check(place, "husky.toml", LATE_RUNS, code=4)
    content = json.loads(check(place, "husky.toml", LATE_RUNS, "--json", code=4))
    found = slip.check("husky.toml", ["logs/late.mcap", "more/late.mcap"])

    assert content == {**found.to_json(), "errors": []}
    assert f"{found!r}\n" == screen
    assert found.code == content["exit_code"] == 4
    row = found.numbers.row(by_predicate=slip_number("drive_lag.tau"), named=True)
    assert row["status"] == "changed"
    assert found.verdict in html.unescape(found._repr_html_())


def slip_number(name: str) -> object:
    import polars as pl  # noqa: PLC0415

    return pl.col("number") == name


def test_limits_gate_a_build_and_the_report_is_a_file(place: Path) -> None:
    (place / "check.toml").write_text('[parameter]\n"drive_lag.tau" = {max = 0.5}\n', encoding="utf-8")
    options = ("--limits", "check.toml", "--to", "junit", "--file", "check.xml", "--force", "--quiet")

    check(place, "husky.toml", "logs/b.mcap", *options, code=0)
    kept = (place / "check.xml").read_text(encoding="utf-8")
    check(place, "husky.toml", "logs/late.mcap", *options, code=4)
    broken = (place / "check.xml").read_text(encoding="utf-8")

    assert 'failures="0"' in kept
    assert 'failures="1"' in broken
    markdown = check(place, "husky.toml", LATE_RUNS, "--to", "markdown", code=4)
    assert markdown.startswith("**Changed: lag of the drive")


def test_the_page_of_a_check_is_a_file_that_shows_the_table_of_the_screen(place: Path) -> None:
    screen = check(place, "husky.toml", LATE_RUNS, code=4)
    check(place, "husky.toml", LATE_RUNS, "--to", "html", "--file", "check.html", "--quiet", code=4)
    page = (place / "check.html").read_text(encoding="utf-8")

    text = html.unescape(re.sub(r"<[^>]+>", " ", page))
    (row,) = (line for line in screen.splitlines() if line.startswith("changed"))
    for cell in re.split(r" {2,}", row):
        assert cell.replace("->", "\u2192") in text, cell
    assert page.startswith("<!DOCTYPE html>")
    assert "script-src 'none'" in page
    assert (place / "logs/late.mcap").stem in text, "the compared runs are named"


def test_a_folder_stands_for_its_logs(place: Path) -> None:
    content = json.loads(check(place, "husky.toml", "logs", "--json", code=3))

    assert [name.rpartition("/")[2] for name in content["after"]["runs"]] == ["a", "b", "late"]
