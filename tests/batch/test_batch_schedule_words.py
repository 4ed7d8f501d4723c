"""No path and no argument can add a line, a word or a setting to what `slip batch schedule` prints."""

import ast
import re
import shlex
import subprocess
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.batch import BatchError
from pipeline.batch.schedule import Nightly, print_units

HOSTILE = (
    "a b",
    "100% of it",
    "%h%n",
    "$HOME ${PATH} $$",
    "`id` $(id)",
    "it's",
    'say "hi"',
    "back\\slash \\\\two \\% \\n end\\",
    "; ; && id | id > x",
    "#no comment",
    "-dash",
    "~",
    "é ü 雪",
    "",
    "'\\''\\%'",
)
WORDS = st.lists(
    st.one_of(
        st.sampled_from(HOSTILE),
        st.text(st.characters(exclude_categories=["Cc", "Cs"]), max_size=12),
        st.text("a'\"\\%$ ;{}#~`&|<>()*?[]!-\t"[:-1], max_size=12),
    ),
    min_size=1,
    max_size=4,
)


def make_nightly(words: list[str], folder: str = "/data") -> Nightly:
    return Nightly(
        program=("/usr/bin/printf", "%s\\0"),
        arguments=words,
        folder=Path(folder),
        lock=Path("/l"),
        hour=3,
        minute=5,
    )


def split_as_systemd(line: str) -> list[str]:
    """A command line by the rules of systemd.service(5): quotes, C escapes, specifiers, variables."""
    words, word, quote, place = [], None, "", 0
    while place < len(line):
        c = line[place]
        place += 1
        if c == "\\":
            word, place = (word or "") + line[place], place + 1
            assert line[place - 1] in '\\"', "an escape that means another character"
        elif quote:
            word, quote = (word or "") + (c if c != quote else ""), "" if c == quote else quote
        elif c in "\"'":
            word, quote = word or "", c
        elif c == " ":
            words, word = [*words, *([] if word is None else [word])], None
        else:
            assert c != ";", "a semicolon of its own begins another command"
            word = (word or "") + c
    assert not quote
    words += [] if word is None else [word]
    for raw in words:
        assert "%" not in raw.replace("%%", "")
        assert "$" not in raw.replace("$$", "")
    return [raw.replace("%%", "%").replace("$$", "$") for raw in words]


def unescape_cron(line: str, *, keeps_backslash: bool) -> str:
    """What cron hands to the shell: up to the first bare percent sign; its kinds differ in backslashes."""
    done, place = "", 0
    while place < len(line):
        pair = line[place : place + 2]
        if pair[0] == "\\" and len(pair) > 1:
            done += pair if keeps_backslash or pair[1] not in "%\\" else pair[1]
            place += 2
            continue
        if pair[0] == "%":
            break
        done, place = done + pair[0], place + 1
    return done


@settings(max_examples=200)
@given(WORDS)
def test_systemd_gets_the_words_as_they_are(words: list[str]) -> None:
    text = print_units(make_nightly(words), "systemd")
    (line,) = [line for line in text.split("\n") if line.startswith("ExecStart=")]
    assert not line.endswith("\\")
    found = split_as_systemd(line.removeprefix("ExecStart="))
    assert found[found.index("batch") + 1 :] == ["run", *words]


@pytest.mark.parametrize("keeps_backslash", [False, True])
def test_every_cron_hands_the_shell_the_words_as_they_are(*, keeps_backslash: bool) -> None:
    text = print_units(make_nightly(list(HOSTILE)), "cron")
    (line,) = [line for line in text.split("\n") if line.startswith("5 3 ")]
    command = unescape_cron(line.removeprefix("5 3 * * * "), keeps_backslash=keeps_backslash)
    shell = command[command.index("/usr/bin/printf") :].removesuffix(" 2>&1 | logger --tag slip-batch")
    said = subprocess.run(["/bin/sh", "-c", shell], capture_output=True, check=True, cwd="/").stdout
    assert tuple(said.decode().split("\0")[1:-1]) == ("run", *HOSTILE)


@settings(max_examples=200)
@given(WORDS, st.booleans())
def test_no_cron_ends_a_command_early_or_joins_backslashes(words: list[str], keeps_backslash: bool) -> None:  # noqa: FBT001
    text = print_units(make_nightly(words), "cron")
    (line,) = [line for line in text.split("\n") if line.startswith("5 3 ")]
    assert not re.search(r"\\\\", line)
    assert unescape_cron(line, keeps_backslash=True) == line
    assert unescape_cron(line, keeps_backslash=keeps_backslash).endswith("| logger --tag slip-batch")


@pytest.mark.parametrize("system", ["systemd", "cron", "airflow", "github"])
@pytest.mark.parametrize(
    "bad", ["a\nExecStartPre=/bin/evil", "a\r* * * * * evil", "a\x85b", "a\x00b", "\udcff"]
)
def test_what_cannot_stand_in_one_line_is_refused(system: str, bad: str) -> None:
    for nightly in (make_nightly([bad]), make_nightly(["ok"], folder=f"/data/{bad}")):
        with pytest.raises(BatchError, match="Rename") as caught:
            print_units(nightly, system)  # type: ignore[arg-type]
        assert "\n" not in str(caught.value)


@settings(max_examples=200)
@given(WORDS)
def test_a_dag_and_a_workflow_hold_the_words_as_they_are(words: list[str]) -> None:
    text = print_units(make_nightly([*words, "${{ secrets.X }}"]), "airflow")
    (line,) = [line for line in text.split("\n") if line.startswith("COMMAND = ")]
    found = ast.literal_eval(line.removeprefix("COMMAND = "))
    assert found[found.index("batch") + 1 :] == ["run", *words, "${{ secrets.X }}"]

    workflow = print_units(make_nightly([*words, "${{ secrets.X }}"]), "github")
    script = yaml.safe_load(workflow)["jobs"]["batch"]["steps"][0]["run"]
    expressions = re.findall(r"\$\{\{.*?\}\}", script)
    assert set(expressions) <= {"${{ '${{' }}"}, "nothing of a name is an expression"
    shell = re.sub(r"\$\{\{ '([^']*)' \}\}", lambda match: match[1], script)
    found = shlex.split(shell.removesuffix(" || [ $? -eq 3 ]"))
    assert found[found.index("batch") + 1 :] == ["run", *words, "${{ secrets.X }}"]


def test_a_folder_that_ends_in_a_backslash_does_not_swallow_the_next_line() -> None:
    text = print_units(make_nightly(["x"], folder="/data/odd\\"), "systemd")
    assert "WorkingDirectory=/data/odd\\/\nExecStart=" in text
