"""Logs dropped on the page: bounded, whole or not at all, named harmlessly, and analyzed."""

import json
import shutil
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from workbench_server import LIMITS, TOKEN, Workbench

from pipeline.logs.writer import LogWriter
from pipeline.web.stored_runs import clean_name

START = 1_700_000_000_000_000_000


@pytest.fixture
def empty(tmp_path: Path) -> Iterator[Workbench]:
    server = Workbench(tmp_path / "results", limits=replace(LIMITS, log_bytes=20_000_000))
    yield server
    server.close()


def write_plain(path: Path) -> None:
    """A log that does not say its vehicle, and on its straight way does not show a track width."""
    stamps = START + np.arange(600, dtype=np.int64) * 50_000_000
    along = 0.02 * np.arange(600)
    pose = {"pose.pose.position.x": along, "pose.pose.orientation.w": np.ones(600)}
    with LogWriter(path) as log:
        for side in ("left", "right"):
            log.write_columns(f"/{side}_drive/velocity", "std_msgs/msg/Float64", stamps, {"data": 4.0})
        log.write_columns("/odom", "nav_msgs/msg/Odometry", stamps, pose, header_time=stamps)


def begin_upload(server: Workbench, name: str, size: int) -> socket.socket:
    """Announce a log, send a little of it, and no more."""
    line = socket.create_connection(("127.0.0.1", server.port))
    head = (
        f"POST /api/upload?name={name} HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n"
        f"Origin: {server.origin}\r\nCookie: slip-{server.port}={TOKEN}\r\nContent-Length: {size}\r\n\r\n"
    )
    line.sendall(head.encode() + b"x" * 100)
    return line


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def files_below(folder: Path) -> list[str]:
    return [path.name for path in folder.rglob("*") if path.is_file()]


def test_a_dropped_log_becomes_a_run(empty: Workbench, hidden_log: Path) -> None:
    assert empty.get("/api/runs")["runs"] == []
    status, _, _ = empty.request("POST", "/api/upload?name=my%20run.mcap", hidden_log.read_bytes())
    assert status == 200
    (job,) = empty.wait_for_jobs()
    assert job["error"] is None
    assert job["run"] == "dropped/my run"
    (run,) = cast("list[dict[str, object]]", empty.get("/api/runs")["runs"])
    assert run["run"] == job["run"]
    assert run["report"]


def test_what_failed_twice_under_one_name_is_one_notice(empty: Workbench) -> None:
    for _ in range(2):
        assert empty.request("POST", "/api/upload?name=notes.mcap", b"no log\n")[0] == 200
        (job,) = empty.wait_for_jobs()
        assert "not an MCAP file" in str(job["error"])


def test_too_large_a_log_is_refused_before_it_comes(empty: Workbench) -> None:
    status, _, body = empty.request(
        "POST", "/api/upload?name=x.mcap", b"", headers={"Content-Length": "99000000"}
    )
    assert status == 422
    assert b"slip analyze" in body
    assert files_below(empty.results) == []


def test_logs_that_wait_have_a_quota_in_number_and_size(tmp_path: Path) -> None:
    limits = replace(LIMITS, log_bytes=1_000_000, all_bytes=1_500_000, logs=2, silence_s=3.0)
    server = Workbench(tmp_path / "results", limits=limits)
    try:
        with begin_upload(server, "first.mcap", 900_000):
            wait_for(lambda: len(server.get("/api/jobs")["jobs"]) == 1)  # type: ignore[arg-type]
            for name, size in (("big.mcap", 700_000), ("huge.mcap", 1_000_001)):
                announced = {"Content-Length": str(size)}
                status, _, body = server.request("POST", f"/api/upload?name={name}", headers=announced)
                assert status == 422
                assert name.encode() in body
            with begin_upload(server, "second.mcap", 1000):
                wait_for(lambda: len(server.get("/api/jobs")["jobs"]) == 2)  # type: ignore[arg-type]
                status, _, body = server.request("POST", "/api/upload?name=third.mcap", b"x")
                assert status == 422
                assert b"2 logs" in body
            # Those that fall silent are given up.
            wait_for(lambda: server.get("/api/jobs")["jobs"] == [])
        assert files_below(server.results) == [".lock"]
        assert server.request("POST", "/api/upload?name=third.mcap", b"x")[0] == 200
    finally:
        server.close()


def test_a_disk_that_fills_up_is_one_sentence_and_leaves_nothing(
    empty: Workbench, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(empty.results.parent)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=100_000_000))
    status, _, body = empty.request("POST", "/api/upload?name=x.mcap", b"x" * 1000)
    assert (status, json.loads(body)["error"]["code"]) == (422, "disk_full")
    monkeypatch.undo()

    opened = Path.open

    def open_full(path: Path, *words: str, **more: str) -> object:
        # Every write to this one says: no space left on device.
        chosen = (Path("/dev/full"), "wb", 0) if path.name == "log.mcap" else (path, *words)
        return opened(*chosen, **more)  # type: ignore[call-overload]

    monkeypatch.setattr(Path, "open", open_full)
    status, _, body = empty.request("POST", "/api/upload?name=x.mcap", b"x" * 100_000)
    assert (status, json.loads(body)["error"]["code"]) == (422, "upload_not_written")
    assert b"No space left" in body
    assert str(empty.results).encode() not in body
    monkeypatch.undo()
    assert files_below(empty.results) == [".lock"]
    assert empty.get("/api/jobs")["jobs"] == []


def test_a_log_named_as_a_path_stays_inside_and_is_deleted_when_it_is_worked_off(
    empty: Workbench, hidden_log: Path, tmp_path: Path
) -> None:
    uploads = empty.results / "workbench" / "uploads"
    empty.request("POST", "/api/upload?name=..%2f..%2fescape.mcap", hidden_log.read_bytes())
    empty.request("POST", "/api/upload?name=bad.mcap", b"no log")
    bad, good = empty.wait_for_jobs()
    assert bad["error"]
    assert str(tmp_path) not in str(bad["error"])
    assert good["run"] == "dropped/escape"
    assert files_below(uploads) == [".lock"]
    assert not list(tmp_path.rglob("*escape.mcap"))

    write_plain(tmp_path / "plain.mcap")
    empty.request("POST", "/api/upload?name=plain.mcap", (tmp_path / "plain.mcap").read_bytes())
    job, *_ = empty.wait_for_jobs()
    assert "vehicle" in cast("dict[str, str]", job["error"])["code"]
    assert str(tmp_path) not in str(job["error"])
    assert "log.mcap" in files_below(uploads)
    empty.request("POST", f"/api/dismiss?id={job['id']}", b"{}")
    assert files_below(uploads) == [".lock"]


def test_a_connection_that_breaks_leaves_nothing(empty: Workbench) -> None:
    with begin_upload(empty, "x.mcap", 1_000_000):
        wait_for(lambda: len(empty.get("/api/jobs")["jobs"]) == 1)  # type: ignore[arg-type]
    wait_for(lambda: files_below(empty.results) == [".lock"] and empty.get("/api/jobs")["jobs"] == [])


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
