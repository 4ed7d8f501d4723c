"""What a batch tells after its logs: what failed, once, to a command of the user."""

import json
import shutil
from pathlib import Path

import pytest
from verbs import run_slip

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
        code, _, _ = run_slip("batch", "field", *INLINE, "--notify", TELL)
        assert code == 1
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
