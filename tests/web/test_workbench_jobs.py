"""Logs dropped on the page, and diagnoses: bounded, whole or not at all; what fails costs itself alone."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import cast
from urllib.request import Request, urlopen

import numpy as np
import pytest
from workbench_server import LIMITS, PATIENCE_S, RUN, Workbench, list_files, wait_for
from workbench_works import work_poisoned

from pipeline.logs.writer import LogWriter
from pipeline.web.jobs import clean_name

START = 1_700_000_000_000_000_000


@pytest.fixture
def empty(tmp_path: Path) -> Iterator[Workbench]:
    limits = replace(LIMITS, log_bytes=20_000_000, timeout_s=20.0, memory_bytes=900_000_000)
    bench = Workbench(tmp_path / "results", limits=limits, do=work_poisoned)
    yield bench
    bench.close()


def drop(bench: Workbench, name: str, content: bytes) -> dict[str, object]:
    """Drop a log, and wait until it is worked off."""
    status, _, body = bench.request("POST", f"/api/upload?name={name}", content)
    assert status == 200, body
    return bench.wait_for_jobs()[0]


def list_uploads(bench: Workbench) -> list[str]:
    return list(list_files(bench.results / "workbench" / "uploads"))


def write_plain(path: Path) -> None:
    """A log that does not say its vehicle, and on its straight way does not show a track width."""
    stamps = START + np.arange(600, dtype=np.int64) * 50_000_000
    along = 0.02 * np.arange(600)
    pose = {"pose.pose.position.x": along, "pose.pose.orientation.w": np.ones(600)}
    with LogWriter(path) as log:
        for side in ("left", "right"):
            log.write_columns(f"/{side}_drive/velocity", "std_msgs/msg/Float64", stamps, {"data": 4.0})
        log.write_columns("/odom", "nav_msgs/msg/Odometry", stamps, pose, header_time=stamps)


def test_a_dropped_log_becomes_a_run_and_is_deleted(empty: Workbench, hidden_log: Path) -> None:
    assert empty.get("/api/runs")["runs"] == []
    job = drop(empty, "..%2f..%2fmy%20run.mcap", hidden_log.read_bytes())
    assert (job["error"], job["run"], job["name"]) == (None, "dropped/my run", "../../my run.mcap")
    (run,) = cast("list[dict[str, object]]", empty.get("/api/runs")["runs"])
    assert (run["run"], run["report"]) == (job["run"], True)
    assert list_uploads(empty) == [".lock"]
    assert not [name for name in list_files(empty.results.parent) if name == "my run.mcap"]


def test_what_is_no_log_is_one_notice_and_the_next_log_is_analyzed(
    empty: Workbench, hidden_log: Path
) -> None:
    for name, told in (("notes.mcap", "not an MCAP file"), ("dies.mcap", "its process died")):
        for _ in range(2):
            job = drop(empty, name, b"no log\n")
            assert told in cast("dict[str, str]", job["error"])["message"]
    assert [job["name"] for job in empty.jobs()] == ["dies.mcap", "notes.mcap"]
    assert drop(empty, "good.mcap", hidden_log.read_bytes())["error"] is None


@pytest.mark.long
def test_whatever_a_log_does_to_its_worker_is_one_sentence(empty: Workbench) -> None:
    kinds = {"dies": "worker_died", "leaves": "worker_died", "hangs": "timed_out", "eats": "out_of_memory"}
    for kind, code in {**kinds, "raises": "unexpected_error"}.items():
        error = cast("dict[str, str]", drop(empty, f"{kind}.mcap", b"log")["error"])
        assert error["code"] == code
        assert error["hint"]
        assert str(empty.results) not in error["message"]
        assert len(error["message"].splitlines()) == 1
    assert list_uploads(empty) == [".lock"]


def test_a_log_without_a_vehicle_waits_for_the_one_that_is_chosen(empty: Workbench, tmp_path: Path) -> None:
    write_plain(tmp_path / "plain.mcap")
    job = drop(empty, "plain.mcap", (tmp_path / "plain.mcap").read_bytes())
    error = cast("dict[str, str]", job["error"])
    assert "vehicle" in error["code"]
    assert error["message"].endswith("choose it from the list")
    assert "plain.mcap" in list_uploads(empty)
    empty.request("POST", f"/api/retry?id={job['id']}&vehicle=husky_a200", b"{}")
    (again,) = empty.wait_for_jobs()
    assert (again["id"], again["error"]) == (job["id"], None)
    assert list_uploads(empty) == [".lock"]
    assert empty.request("POST", f"/api/retry?id={job['id']}&vehicle=husky_a200", b"{}")[0] == 404


def test_a_log_that_is_too_large_or_breaks_off_leaves_nothing(
    empty: Workbench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(content: bytes = b"", **headers: str) -> tuple[str, str]:
        status, _, body = empty.request("POST", "/api/upload?name=x.mcap", content, headers=headers)
        assert status == 422
        error = json.loads(body)["error"]
        assert error["hint"]
        return error["code"], error["message"]

    assert refuse(**{"Content-Length": "99000000"})[0] == "too_large"
    assert refuse(**{"Content-Length": "-1"})[0] == "no_length"
    empty.request("POST", "/api/upload?name=x.mcap", b"x", headers={"Content-Length": "1000"})
    usage = shutil.disk_usage(empty.results.parent)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=100_000_000))
    assert refuse(b"x" * 1000)[0] == "disk_full"
    monkeypatch.undo()
    opened = Path.open

    def open_full(path: Path, *words: str, **more: str) -> object:
        # Every write to this one says: no space left on device.
        chosen = (Path("/dev/full"), "wb", 0) if path.name == "x.mcap" else (path, *words)
        return opened(*chosen, **more)  # type: ignore[call-overload]

    monkeypatch.setattr(Path, "open", open_full)
    code, told = refuse(b"x" * 100_000)
    assert (code, told) == ("upload_not_written", "the log cannot be stored: No space left on device")
    assert list_uploads(empty) == [".lock"]
    assert empty.jobs() == []


def test_names_of_dropped_files_are_harmless() -> None:
    for sent, kept in [
        ("run.mcap", "run.mcap"),
        ("../../etc/passwd", "passwd.mcap"),
        ("C:\\logs\\run 1.mcap", "run 1.mcap"),
        ("<img src=x onerror=alert(1)>.mcap", "_img src_x onerror_alert_1__.mcap"),
        ("..", "dropped.mcap"),
        ("", "dropped.mcap"),
        (".mcap", "mcap.mcap"),
        ("a" * 300 + ".mcap", "a" * 95 + ".mcap"),
    ]:
        assert clean_name(sent) == kept


def test_what_is_being_done_is_ended_by_its_notice(workbench: Workbench) -> None:
    before = set(list_files(workbench.results))
    workbench.post("/api/diagnose", run=RUN)
    assert workbench.refuse("/api/diagnose", run=RUN)["code"] == "busy"
    (job,) = workbench.jobs()
    assert (job["words"], job["done"]) == ("estimating effects", False)
    workbench.request("POST", f"/api/dismiss?id={job['id']}", b"{}")
    assert workbench.jobs() == []
    workbench.close()
    assert set(list_files(workbench.results)) == before


@pytest.mark.long
def test_a_diagnosis_that_is_asked_for_is_kept_beside_the_results(workbench: Workbench) -> None:
    assert workbench.session(RUN)["diagnosis"] is None
    workbench.post("/api/diagnose", run=RUN)
    (job,) = workbench.wait_for_jobs()
    assert job["error"] is None
    named = cast("dict[str, list[dict[str, object]]]", workbench.session(RUN)["diagnosis"])
    assert [effect["id"] for effect in named["effects"]] == ["effective_track"]


EVIL = "import pathlib; pathlib.Path({marker!r}).write_text(__name__); raise ImportError\n"


def test_a_server_of_its_own_ends_without_a_trace_and_a_killed_one_is_cleared_up(
    hidden_log: Path, tmp_path: Path
) -> None:
    """`slip serve --json` in a folder that somebody has filled with modules of their own."""
    here, uploads = tmp_path / "here", tmp_path / "here/results/workbench/uploads"
    here.mkdir()
    for name in ("pipeline", "tempfile", "multiprocessing", "pickle", "pebble", "numpy"):
        (here / f"{name}.py").write_text(EVIL.format(marker=str(tmp_path / "ran")))
    slip = os.path.dirname(sys.executable) + "/slip"  # noqa: PTH120 - not resolved
    command = [slip, "serve", "results", "--port", "0", "--json"]
    for ended_by in (signal.SIGINT, signal.SIGKILL):
        process = subprocess.Popen(
            command, cwd=here, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        assert process.stdout is not None
        told = json.loads("".join(iter(process.stdout.readline, "}\n")) + "}")
        assert told["address"].startswith("http://127.0.0.1:")
        headers = {"Authorization": f"Bearer {told['token']}"}
        upload = Request(f"{told['address']}api/upload?name=run.mcap", hidden_log.read_bytes(), headers)  # noqa: S310 - the loopback
        urlopen(upload).close()  # noqa: S310 - likewise
        wait_for(lambda: "stage" in list_files(uploads))
        # Another server that lives keeps its logs.
        Workbench(here / "results").close()
        assert "run.mcap" in list_files(uploads)
        process.send_signal(ended_by)
        _, said = process.communicate(timeout=PATIENCE_S)
        assert ended_by == signal.SIGKILL or "Traceback" not in said
        assert ("run.mcap" in list_files(uploads)) == (ended_by == signal.SIGKILL)
    assert not (tmp_path / "ran").exists()
    # A stranger's results may hold a link out of them.
    (here / "precious").mkdir()
    (here / "precious" / ".lock").write_text("")
    (uploads / ("0" * 16)).symlink_to(here / "precious")
    Workbench(here / "results").close()
    assert list(list_files(uploads)) == []
    assert (here / "precious" / ".lock").exists()
