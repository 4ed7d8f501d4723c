"""A batch of every night: what it keeps, what it tells and how it ends."""

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from batch_tools import IMPORTABLE, batch, counts
from batch_works import work_on_full_disk
from mcap.writer import Writer
from verbs import ask_verb, run_slip

from pipeline.batch.batch_check import read_status
from pipeline.batch.batch_work import judge_error
from pipeline.cli.conventions import group_reasons
from pipeline.core import SlipError
from pipeline.logs import LogError
from pipeline.recording import RecordingError
from pipeline.store import Store, StoreError

INLINE = ("--executor", "inline", "--settle", "0")


@pytest.fixture
def field(originals: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A good log and 18 texts, in the current folder."""
    monkeypatch.chdir(tmp_path)
    logs = tmp_path / "field"
    logs.mkdir()
    (logs / "a.mcap").write_bytes((originals / "a.mcap").read_bytes())
    for number in range(18):
        (logs / f"text{number:02}.mcap").write_text("no log " * (30 + number))
    return logs


@pytest.mark.parametrize("more", [(), ("--keep", "0"), ("--json",)])
def test_old_generations_are_removed_without_logs(field: Path, more: tuple[str, ...]) -> None:
    assert field.is_dir()
    for rate in (20.0, 10.0):
        (field / "run.toml").write_text(f"[velocity]\nrate_hz = {rate}\n")
        run_slip("batch", "field/a.mcap", *INLINE)
    code, told, error = run_slip("batch", "--prune", *more)
    assert (code, error) == (0, "")
    removed = 0 if not more or more == ("--json",) else 1
    assert str(removed) in told
    assert read_status(Store(Path("results"))).old_generations == 1 - removed


def test_what_a_log_cannot_help_is_kept_and_what_the_machine_does_is_tried_again() -> None:
    assert judge_error(RecordingError("no_pose", "no pose", hint="")) == ("refused", True)
    assert judge_error(RecordingError("log_without_messages", "none", hint="")) == ("refused", True)
    assert judge_error(LogError("not_mcap", "a text", hint="")) == ("failed", True)
    assert judge_error(LogError("log_unreachable", "permission", hint="")) == ("failed", False)
    assert judge_error(StoreError("disk_full", "full", hint="")) == ("failed", False)
    assert judge_error(SlipError("other", "other", hint="")) == ("failed", False)


def test_a_dead_log_fails_once_and_is_read_again_when_it_changes(field: Path) -> None:
    assert run_slip("batch", "field", *INLINE)[0] == 1
    answer = ask_verb("batch", "field", *INLINE, code=3)
    assert (answer["failed"], answer["unchanged"]) == (18, 1)
    assert {line["unchanged"] for line in answer["logs"]} == {True}
    assert len(answer["errors"]) == 18
    assert all(set(one) >= {"path", "code", "message", "hint"} for one in answer["errors"])
    assert run_slip("batch", "field", *INLINE, "--quiet") == (3, "", "")
    (field / "text00.mcap").write_text("no log at all " * 9)
    code, _, error = run_slip("batch", "field", *INLINE, "--quiet")
    assert code == 1
    assert error.count("\n") == 1
    assert "text00.mcap" in error
    assert run_slip("batch", "field", *INLINE, "--force")[0] == 1


def test_equal_reasons_are_told_once_with_the_counts_last(field: Path) -> None:
    assert field.is_dir()
    code, told, error = run_slip("batch", "field", *INLINE, "--quiet")
    assert (code, told, error.count("\n")) == (1, "", 1)
    (field / "late.mcap").write_text("no log " * 90)
    lines = run_slip("batch", "field", *INLINE)[1].splitlines()
    assert len(lines) < 30
    assert lines.index("failed, as before") < lines.index("failed, new")
    assert lines[-1].split()[0] == "quarantined"
    assert "  and 15 more (--all lists them)" in lines
    assert sum("text" in line for line in run_slip("batch", "field", *INLINE, "--all")[1].splitlines()) >= 18
    status = run_slip("results", "status")[1].splitlines()
    assert status[-1].split()[0] == "quarantined"
    assert "  and 16 more (--all lists them)" in status


def test_nothing_is_as_before_on_the_first_night(field: Path) -> None:
    (field / "copy.mcap").write_bytes((field / "a.mcap").read_bytes())
    (field / "fleet.toml").write_text('ignore = ["text0*"]\n')
    nights = [run_slip("batch", "field", *INLINE)[1] for _ in range(2)]
    for state in ("copies", "ignored", "failed"):
        assert f"{state}, new\n" in nights[0]
        assert f"{state}, as before\n" in nights[1]
    assert "as before" not in nights[0]
    assert ", new" not in nights[1]


def test_a_hint_for_several_logs_names_none_of_them() -> None:
    logs = [(f"{name}.mcap", "no pose", f"List: slip inspect {name}.mcap") for name in "ab"]
    assert group_reasons(logs[:1]) == [(["a.mcap"], "no pose", "List: slip inspect a.mcap")]
    assert group_reasons(logs) == [(["a.mcap", "b.mcap"], "no pose", "List: slip inspect LOG")]


def test_a_camera_alone_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with (tmp_path / "camera.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()  # type: ignore[no-untyped-call]
    answer = ask_verb("batch", "camera.mcap", *INLINE, code=3)
    assert (answer["refused"], answer["failed"], answer["errors"]) == (1, 0, [])
    assert ask_verb("batch", "camera.mcap", *INLINE, code=3)["refused"] == 1
    status = ask_verb("results", "status")
    assert (status["refused"], status["runs"]) == (1, 0)


def test_a_batch_that_found_nothing_new_leaves_its_time(field: Path) -> None:
    store = Store(Path("results"))
    run_slip("batch", "field", *INLINE)
    first = read_status(store)
    time.sleep(0.01)
    (field / "dead.mcap").symlink_to("nothing")
    run_slip("batch", "field", *INLINE)
    second = read_status(store)
    assert first.batch.ended is not None
    assert second.batch.ended is not None
    assert second.batch.ended > first.batch.ended
    assert second.counts["left_out"] == 1
    assert (first.batch.is_idle, second.batch.is_idle) == (False, True)
    assert "(the last that worked on a log: " in run_slip("results", "status")[1]


def test_a_full_disk_is_told_first_and_those_it_stopped_as_one(field: Path) -> None:
    outcome = batch(field, Path("out"), work=work_on_full_disk)
    errors = outcome.list_errors()
    assert errors[0][1].code == "disk_full"
    assert (errors[-1][1].code, errors[-1][1].what[:19]) == ("not_started", "18 logs not started")
    assert counts(outcome)["not_started"] == 18
    assert ask_verb("results", "status", "--results", "out")["not_started"] == 18
    assert re.search(
        "last batch .*: 18 logs not started$",
        run_slip("results", "status", "--results", "out")[1],
        re.MULTILINE,
    )


def test_results_of_a_log_that_is_gone_can_be_removed(field: Path) -> None:
    run_slip("batch", "field/a.mcap", *INLINE)
    (field / "a.mcap").unlink()
    assert ask_verb("results", "status")["gone"] == 1
    Store(Path("results")).manifests()
    subprocess.run(["rm", "-r", "results/runs/field/a"], check=True)
    assert ask_verb("results", "status")["gone"] == 0


@contextmanager
def working(field: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """A batch at its first text, which takes longer than the test."""
    marker = field.parent / "begun"
    marker.mkdir()
    environment = os.environ | {
        "PYTHONPATH": IMPORTABLE,
        "BEGUN": str(marker),
        "PAUSE_S": "30",
        "SLOW": "text17",
    }
    started = (
        "import batch_works, functools, pipeline.batch.batch_run as run, pipeline.cli as cli;"
        "run.run_batch = functools.partial(run.run_batch, work=batch_works.work_slowly);"
        f"cli.main(['batch', 'field', *{options}])"
    )
    with subprocess.Popen(
        [sys.executable, "-c", started],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        while not any(marker.iterdir()):
            assert process.poll() is None
            time.sleep(0.05)
        yield process
        process.kill()


@pytest.mark.parametrize(
    ("number", "code", "executor"), [(signal.SIGINT, 130, "inline"), (signal.SIGTERM, 143, "local")]
)
def test_a_batch_that_is_stopped_says_what_was_done(
    field: Path, number: int, code: int, executor: str
) -> None:
    """Everywhere in the same words: what was done, at which log it was stopped, and what had not begun."""
    run_slip("batch", "field/text00.mcap", *INLINE)
    options = ("--settle", "0", "--executor", executor, "--jobs", "1", "--json", "--notify", "cat > message")
    with working(field, *options) as process:
        process.send_signal(number)
        told, said = process.communicate(timeout=60)
    assert (said, process.returncode) == ("slip: stopped; the same command continues\n", code)
    answer = json.loads(told)
    counted = {"done": 1, "failed": 1, "interrupted": 1, "not_started": 16}
    assert {state: answer[state] for state in counted} == counted
    assert [one["path"] for one in answer["logs"] if one["state"] == "interrupted"] == [
        str(field / "text17.mcap")
    ]
    assert answer["stopped"] is True
    texts = ["1 log interrupted: the batch was stopped", "16 logs not started: the batch was stopped"]
    assert [one["message"] for one in answer["errors"][-2:]] == texts
    assert json.loads(Path("message").read_text())["notified"][-2:] == texts
    page = Path("results/index.html").read_text()
    assert "field/a" in page
    (said,) = re.findall(r'<p id="batch">The last batch (.*)\.</p>', page)
    assert re.fullmatch(
        "began on .* UTC and was stopped on .* UTC: 1 log interrupted, 16 logs not started", said
    )
    assert f"last batch    {said}\n" in run_slip("results", "status")[1]
    status = ask_verb("results", "status")
    assert {state: status[state] for state in counted} == counted | {"failed": 1}
    assert Path("results/datasets.parquet").is_file()
    assert ask_verb("batch", "field", *INLINE, code=1)["stopped"] is False
    status = ask_verb("results", "status")
    assert (status["stopped"], status["interrupted"], status["not_started"]) == (False, 0, 0)


def test_a_batch_that_is_stopped_twice_ends_at_once(field: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And does not wait for its tables and pages."""
    for place in ("_work_through", "refresh_pools"):
        monkeypatch.setattr(f"pipeline.batch.batch_run.{place}", lambda *_: os.kill(os.getpid(), 15))
    assert field.is_dir()
    assert ask_verb("batch", "field", *INLINE, code=143)["not_started"] == 19
    assert ask_verb("results", "status")["not_started"] == 19


def test_a_batch_that_is_stopped_in_its_search_says_so(field: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_slip("batch", "field/a.mcap", *INLINE)
    assert field.is_dir()
    monkeypatch.setattr("pipeline.batch.batch_run.find_recordings", lambda *_, **__: os.kill(os.getpid(), 15))
    answer = ask_verb("batch", "field", *INLINE, "--notify", "cat > message", code=143)
    assert (answer["stopped"], answer["logs"]) == (True, [])
    (news,) = json.loads(Path("message").read_text())["notified"]
    assert news.startswith("the batch was stopped before it could say what became of its logs")
    assert "and was stopped on" in run_slip("results", "status")[1]


def test_a_batch_that_was_killed_did_not_end(field: Path) -> None:
    run_slip("batch", "field/a.mcap", *INLINE)
    page = Path("results") / "index.html"
    assert re.search(
        r'<p id="batch">The last batch began on .* UTC and ended on .* UTC\.</p>', page.read_text()
    )
    with working(field, *INLINE, "--quiet") as process:
        process.kill()
    assert re.search(r'<p id="batch">The last batch began on .* UTC and did not end: ', page.read_text())
    assert "and did not end: it is still running, or it was killed" in run_slip("results", "status")[1]
    status = ask_verb("results", "status")
    assert (status["ended"], isinstance(status["began"], float)) == (None, True)
    run_slip("batch", "field", *INLINE)
    assert ask_verb("results", "status")["ended"] > status["began"]
    assert "did not end" not in page.read_text()


def test_a_copy_whose_original_is_replaced_gets_its_own_run(originals: Path, tmp_path: Path) -> None:
    """It stayed the copy of a run that holds another content, and nothing held its own."""
    first, second = ((originals / f"{name}.mcap").read_bytes() for name in ("a", "b"))
    for name in ("x", "y"):
        (tmp_path / "two" / name).mkdir(parents=True)
        (tmp_path / "two" / name / "run.mcap").write_bytes(first)
    words = ("batch", str(tmp_path / "two"), "--results", str(tmp_path / "out"), *INLINE)
    assert run_slip(*words)[0] == 0
    (tmp_path / "two" / "x" / "run.mcap").write_bytes(second)
    for _ in range(2):
        assert run_slip(*words)[0] == 0
    held = {manifest.part("log").get("sha256") for manifest in Store(tmp_path / "out").survey().manifests}
    assert held == {hashlib.sha256(content).hexdigest() for content in (first, second)}
