"""A short run of the fuzz target of the command line, and that it notices what it looks for."""

import random
from pathlib import Path

import pytest
from fuzz_cli import Answer, Case, damage_text, describe, judge, run

FINE = Answer(0, out='{"a": 1}')
FILES = {"log.mcap": (3, 1), "out/x": (1, 1)}


@pytest.mark.long
@pytest.mark.parametrize(
    ("answer", "word"),
    [
        (FINE, ""),
        (Answer(1, out="{}", err="slip: what is wrong. What to do.\n"), ""),
        (Answer(None, crash="it hung for 60 s"), "it hung"),
        (Answer(7, out="{}"), "exit code 7"),
        (Answer(1, out="{}", err="Traceback (most recent call last):\n  x"), "Traceback"),
        (Answer(0, out="{}", err="x.py:1: RuntimeWarning: overflow"), "a warning"),
        (Answer(1), "without a word"),
        (Answer(0, out='{"a": NaN}'), "the JSON is none"),
        (Answer(0, out="{} {}"), "the JSON is none"),
        (Answer(1, out="{}", err="slip: " + "x" * 30_000), "30006 characters"),
    ],
)
def test_it_notices_what_it_looks_for(answer: Answer, word: str, tmp_path: Path) -> None:
    found = judge(Case(tmp_path, ["inspect", "log.mcap", "--json"], "log.mcap"), answer, FILES, FILES)
    assert word in found
    assert bool(found) == bool(word)


@pytest.mark.long
def test_it_notices_files_outside_the_out_folder(tmp_path: Path) -> None:
    case = Case(tmp_path, ["inspect", "log.mcap", "--json"], "log.mcap")
    assert not judge(case, FINE, FILES, FILES | {"out/y": (1, 1)})
    for after in (FILES | {"stray": (1, 1)}, FILES | {"log.mcap": (3, 2)}, {"out/x": (1, 1)}):
        assert "outside" in judge(case, FINE, FILES, after)


@pytest.mark.long
def test_damage_is_never_the_end_of_the_fuzz() -> None:
    rng = random.Random(1)  # noqa: S311 - no secret
    for _ in range(300):
        damage_text(damage_text("a = 1\n[b]\n", rng)[:2000] or "x", rng)


@pytest.mark.long
def test_a_damaged_file_never_breaks_the_command_line(tmp_path: Path) -> None:
    tally = run(600.0, 5, tmp_path / "finds", most=60)
    assert not tally.finds, describe(tally, 0.0)
    assert sum(counts.total() for counts in tally.codes.values()) == 60
