"""What a batch tells after its logs: what failed and what changed, once, to a command of the user."""

import json
import shutil
from pathlib import Path

import pytest
from verbs import ask_verb, run_slip

import slip
from pipeline.batch import BatchError
from pipeline.batch.notices import Notice, call_command, send_news

INLINE = ("--executor", "inline", "--settle", "0")
TELL = 'printf "%s\\n" "$SLIP_SUBJECT" >> subjects; cat > message; printf "%s" "$SLIP_JSON" > chat'


@pytest.fixture
def field(originals: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a good log and a broken one, in the current folder."""
    monkeypatch.chdir(tmp_path)
    logs = tmp_path / "field"
    logs.mkdir()
    shutil.copy(originals / "a.mcap", logs / "2026-05-03_a.mcap")
    (logs / "broken.mcap").write_bytes(b"no log" * 1000)
    return logs


def list_subjects() -> list[str]:
    path = Path("subjects")
    return path.read_text().splitlines() if path.exists() else []


def test_a_failure_is_told_once_and_what_is_new_is_told(field: Path) -> None:
    for _ in range(2):
        code, out, _ = run_slip("batch", "field", *INLINE, "--trend", "--notify", TELL)
        assert code == 1
        assert "trend  no test is possible" in out
        assert list_subjects() == ["slip: 1 failed (results)"]
    told = Path("message").read_text()
    assert told.startswith("failed  ")
    assert "broken.mcap: this is not an MCAP file" in told
    assert "done               1" in told
    assert json.loads(Path("chat").read_text())["text"].splitlines()[0] == "slip: 1 failed (results)"

    (field / "other.mcap").write_bytes(b"nor this" * 1000)
    assert run_slip("batch", "field", *INLINE, "--notify", TELL)[0] == 1
    assert list_subjects()[1:] == ["slip: 1 failed (results)"]
    assert "other.mcap" in Path("message").read_text()
    assert "as before: 1, reported already" in Path("message").read_text()

    for name in ("broken", "other"):
        (field / f"{name}.mcap").unlink()
    assert run_slip("batch", "field", *INLINE, "--notify", TELL)[0] == 0
    assert len(list_subjects()) == 2


def test_a_missing_folder_of_logs_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, said = run_slip("batch", "mount/logs", "--notify", TELL)
    assert code == 1
    assert "mount/logs: there is no such file" in said
    assert list_subjects() == ["slip: 1 failed (results)"]


def test_an_alert_of_the_trend_is_told_once_and_ends_with_4(field: Path) -> None:
    (field / "broken.mcap").unlink()
    assert run_slip("batch", "field", *INLINE, "--trend", "--notify", TELL)[0] == 0
    assert run_slip("fleet", "trend", "--limit", "median_modulus=0.001")[0] == 4
    for _ in range(2):
        told = ask_verb("batch", "field", *INLINE, "--trend", "--notify", TELL, code=4)
        assert "above the limit of 0.001" in told["alerts"][0]
    assert told["notified"] == []
    assert len(list_subjects()) == 1
    assert Path("message").read_text().startswith("alert   ")


def test_new_runs_are_checked_against_a_model_of_their_vehicle(field: Path, originals: Path) -> None:
    (field / "broken.mcap").unlink()
    slow = (
        slip.Model("husky_a200") + slip.effect("drive_lag", tau=1.2) + slip.effect("effective_track", k=1.8)
    )
    slow.write("husky.toml")
    (slip.Model("warthog") + "drive_lag").write("warthog.toml")
    asked = ("--check", "husky.toml", "--check", "warthog.toml", "--notify", TELL)
    # A single run does not tell how much runs of the robot differ.
    single = ask_verb("batch", "field", *INLINE, *asked, "--results", "single")
    assert "A change is likely" in single["after"][0]["text"]
    assert single["alerts"] == []
    shutil.copy(originals / "b.mcap", field)
    told = ask_verb("batch", "field", *INLINE, *asked, code=4)
    husky, warthog = told["after"]
    assert husky["text"].startswith("Changed: lag of the drive 1.2 -> 0.")
    assert warthog == {"what": "check warthog.toml", "text": "no new run of Clearpath Warthog"}
    assert list_subjects() == ["slip: 1 alert (results)"]
    # Nothing new, nothing to check.
    again = ask_verb("batch", "field", *INLINE, *asked)
    assert again["after"][0]["text"] == "no new run of Clearpath Husky A200"
    (field / "check.toml").write_text('[parameter]\n"drive_lag.tau" = {max = 5}\n')
    limits = ("--limits", field / "check.toml", "--results", "limited")
    kept = ask_verb("batch", "field", *INLINE, *asked, *limits)
    assert kept["alerts"] == []


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--limits", "check.toml"), "Add --check BASELINE"),
        (("--check", "robot.txt"), "a baseline or a model file is needed"),
        (("--check", "gone.json"), "gone.json"),
    ],
)
def test_what_cannot_be_checked_against_is_said_before_the_work(
    arguments: tuple[str, ...], text: str, field: Path
) -> None:
    code, out, said = run_slip("batch", field.name, *INLINE, *arguments)
    assert (code, out) == (1, "")
    assert text in said


def test_a_command_that_fails_is_an_error_and_told_again(field: Path) -> None:
    (field / "broken.mcap").unlink()
    store = field.parent / "results"
    signs = [Notice("failed x", "x: why")]
    with pytest.raises(BatchError, match="ended with exit code 7: no such host"):
        send_news(store, "echo no such host >&2; exit 7", signs, [], code=1)
    assert send_news(store, TELL, signs, [], code=1) == tuple(signs)
    assert send_news(store, TELL, signs, [], code=1) == ()
    code, _, said = run_slip("batch", "nowhere", "--notify", "exit 7")
    assert code == 1
    assert "the command of --notify failed" in said


def test_names_reach_the_command_as_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = "$(touch bad) `touch bad`\n; touch bad \udcff"
    send_news(tmp_path / "results", TELL, [Notice("a", text)] * 200, [], code=1)
    assert not Path("bad").exists()
    lines = Path("message").read_text().splitlines()
    assert lines[0].startswith("failed  $(touch bad)")
    assert lines[50] == "and 150 more"
    call_command("test $SLIP_CODE -eq 3", "subject", [], code=3, results=tmp_path)
