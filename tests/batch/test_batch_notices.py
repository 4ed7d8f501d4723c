"""What a batch tells after its logs, once, to a command of the user."""

import json
import re
import shutil
from html import escape
from pathlib import Path
from typing import Any

import pytest
from verbs import ask_verb, run_slip

INLINE = ("--executor", "inline", "--settle", "0")
TELL = "echo told >> count; cat > message"


@pytest.fixture
def field(originals: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a good log, one with losses and a broken one, in the current folder."""
    monkeypatch.chdir(tmp_path)
    logs = tmp_path / "field"
    logs.mkdir()
    whole = (originals / "a.mcap").read_bytes()
    (logs / "a.mcap").write_bytes(whole)
    (logs / "cut.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    (logs / "broken.mcap").write_bytes(b"no log" * 1000)
    return logs


def count_told() -> int:
    path = Path("count")
    return len(path.read_text().splitlines()) if path.exists() else 0


def read_message() -> dict[str, Any]:
    message: dict[str, Any] = json.loads(Path("message").read_text())
    return message


def test_what_is_new_is_told_once_as_the_json_of_the_batch(field: Path, originals: Path) -> None:
    words = ("batch", "field", *INLINE, "--notify", TELL)
    answer = ask_verb(*words, code=1)
    assert read_message() == answer
    broken, cut = answer["notified"]
    assert "broken.mcap: it is a text, not an MCAP file" in broken
    assert "cut.mcap: the chunk" in cut
    assert ask_verb(*words, code=3)["notified"] == []
    assert count_told() == 1

    (field / "other.mcap").write_bytes(b"nor this" * 1000)
    assert run_slip(*words)[0] == 1
    assert ["other.mcap" in text for text in read_message()["notified"]] == [True]

    # A night without it, and it is news again.
    for name in ("broken", "other"):
        (field / f"{name}.mcap").rename(name)
    shutil.copy(originals / "b.mcap", field)
    assert run_slip(*words)[0] == 3
    assert count_told() == 2
    Path("broken").rename(field / "broken.mcap")
    assert run_slip(*words)[0] == 3
    assert count_told() == 3


def test_a_missing_folder_of_logs_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        assert run_slip("batch", "mount/logs", "--notify", TELL)[0] == 1
    assert "mount/logs: there is no such file" in read_message()["notified"][0]
    assert read_message()["errors"][0]["code"] == "logs_not_found"
    assert count_told() == 1


def test_a_command_that_fails_is_an_error_and_told_again(field: Path) -> None:
    (field / "broken.mcap").unlink()
    answer = ask_verb("batch", "field", *INLINE, "--notify", "echo no such host >&2; exit 7", code=1)
    assert (answer["lossy"], answer["notified"]) == (1, [])
    assert "ended with exit code 7: no such host" in answer["errors"][0]["message"]
    assert len(ask_verb("batch", "field", *INLINE, "--notify", TELL, code=3)["notified"]) == 1
    assert "the command of --notify failed" in run_slip("batch", "nowhere", "--notify", "exit 7")[2]


def test_names_reach_the_command_as_data(field: Path) -> None:
    for number, name in enumerate(("$(touch bad).mcap", "`touch bad`.mcap", "a\n; touch bad.mcap")):
        (field / name).write_bytes(b"no log" * (100 + number))
    assert run_slip("batch", "field", *INLINE, "--notify", TELL)[0] == 1
    assert not Path("bad").exists()
    assert len(read_message()["notified"]) == 5


def test_logs_that_are_gone_are_told_once(field: Path, originals: Path) -> None:
    """Of the folder that was searched; one that was moved is not gone."""
    for name in ("cut", "broken"):
        (field / f"{name}.mcap").unlink()
    (field / "robot_b").mkdir()
    for name in ("b", "c"):
        shutil.copy(originals / f"{name}.mcap", field / "robot_b")
    words = ("batch", "field", *INLINE, "--notify", TELL)
    assert ask_verb(*words)["gone"] == 0
    (field / "robot_b" / "c.mcap").rename(field / "moved.mcap")
    shutil.rmtree(field / "robot_b")
    assert ask_verb("batch", "field/a.mcap", *INLINE)["gone"] == 0
    answer = ask_verb(*words, code=3)
    assert answer["gone"] == 1
    (line,) = [one for one in answer["logs"] if one["state"] == "gone"]
    assert (line["path"], line["run"]) == (str(field / "robot_b" / "b.mcap"), "robot_b/b")
    assert answer["notified"] == [f"{line['path']}: the log is not there any more; its results are kept"]
    again = ask_verb(*words)
    assert (again["gone"], again["notified"], count_told()) == (1, [], 1)
    screen = run_slip(*words)[1]
    assert "gone, as before" in screen
    assert "gone               1" in screen
    assert ask_verb("results", "status")["gone"] == 1


def test_what_is_left_out_again_is_said_as_before(field: Path) -> None:
    (field / "dead.mcap").symlink_to("nothing")
    words = ("batch", "field", *INLINE)
    assert "left out, new" in run_slip(*words)[1]
    assert "left out, as before" in run_slip(*words)[1]
    (field / "dead.mcap").unlink()
    assert "left out" not in run_slip(*words)[1]
    (field / "dead.mcap").symlink_to("nothing")
    assert "left out, new" in run_slip(*words)[1]


def test_a_night_with_a_broken_fleet_file_makes_nothing_new_again(field: Path) -> None:
    """It is told itself, in the status and on the index as well."""
    words = ("batch", "field", *INLINE, "--notify", TELL)
    (field / "<b>").mkdir()
    (field / "broken.mcap").rename(field / "<b>" / "broken.mcap")
    assert len(ask_verb(*words, code=1)["notified"]) == 2
    fleet = field / "<b>" / "fleet.toml"
    fleet.write_text("ignore = [\n")
    (told,) = ask_verb(*words, code=1)["notified"]
    assert "fleet.toml" in told
    assert "fleet.toml" in ask_verb("results", "status")["failed_before_logs"]
    (said,) = re.findall("last batch    (.*)", run_slip("results", "status")[1])
    assert re.match("began on .* UTC and failed on .* UTC: .*fleet.toml", said)
    assert f">The last batch {escape(said)}.<" in Path("results/index.html").read_text()
    fleet.unlink()
    assert ask_verb(*words, code=3)["notified"] == []
    assert ask_verb("results", "status")["failed_before_logs"] is None
