"""Logs dropped on the page: bounded, whole or not at all, named harmlessly, and analyzed."""

from __future__ import annotations

import contextlib
import socket
import time
from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np
import pytest
from workbench_server import LIMITS, TOKEN, Workbench

from pipeline.logs import LogWriter
from pipeline.workbench.uploads import clean_name

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

START = 1_700_000_000_000_000_000


@pytest.fixture
def empty(tmp_path: Path) -> Iterator[Workbench]:
    server = Workbench(tmp_path / "results", limits=replace(LIMITS, log_bytes=20_000_000))
    yield server
    server.close()


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


def test_a_log_of_an_unknown_vehicle_waits_for_somebody_to_say_it(empty: Workbench, tmp_path: Path) -> None:
    stamps = START + np.arange(600, dtype=np.int64) * 50_000_000
    along = 0.02 * np.arange(600)
    pose = {"pose.pose.position.x": along, "pose.pose.orientation.w": np.ones(600)}
    with LogWriter(tmp_path / "plain.mcap") as log:
        log.write_columns("/cmd_vel", "geometry_msgs/msg/Twist", stamps, {"linear.x": np.full(600, 0.4)})
        log.write_columns("/odom", "nav_msgs/msg/Odometry", stamps, pose, header_time=stamps)
    empty.request("POST", "/api/upload?name=plain.mcap", (tmp_path / "plain.mcap").read_bytes())
    (job,) = empty.wait_for_jobs()
    assert "vehicle" in cast("dict[str, str]", job["error"])["code"]

    status, _, _ = empty.request("POST", f"/api/retry?id={job['id']}&vehicle=jackal", b"{}")
    assert status == 200
    (job,) = empty.wait_for_jobs()
    assert job["error"] is None
    assert job["run"] == "dropped/plain"


def test_what_is_no_log_is_said_so_and_can_be_dismissed(empty: Workbench) -> None:
    empty.request("POST", "/api/upload?name=notes.txt", b"this is no recording\n" * 100)
    (job,) = empty.wait_for_jobs()
    assert job["run"] == ""
    assert cast("dict[str, str]", job["error"])["message"]
    empty.request("POST", f"/api/dismiss?id={job['id']}", b"{}")
    assert empty.get("/api/jobs")["jobs"] == []


def test_too_large_a_log_is_refused_before_it_comes(empty: Workbench) -> None:
    status, _, body = empty.request(
        "POST", "/api/upload?name=x.mcap", b"", headers={"Content-Length": "99000000"}
    )
    assert status == 422
    assert b"slip analyze" in body
    assert files_below(empty.results) == []


def test_a_connection_that_breaks_leaves_nothing(empty: Workbench) -> None:
    with socket.create_connection(("127.0.0.1", empty.port)) as line:
        head = (
            f"POST /api/upload?name=x.mcap HTTP/1.1\r\nHost: 127.0.0.1:{empty.port}\r\n"
            f"Origin: {empty.origin}\r\nCookie: slip-{empty.port}={TOKEN}\r\nContent-Length: 1000000\r\n\r\n"
        )
        line.sendall(head.encode() + b"x" * 1000)
    end = time.monotonic() + 10.0
    while True:
        with contextlib.suppress(OSError):
            if files_below(empty.results) == [] and empty.get("/api/jobs")["jobs"] == []:
                break
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.mark.parametrize(
    ("sent", "kept"),
    [
        ("run.mcap", "run.mcap"),
        ("../../etc/passwd", "passwd.mcap"),
        ("C:\\logs\\run 1.mcap", "run 1.mcap"),
        ("<img src=x onerror=alert(1)>.mcap", "_img src_x onerror_alert_1__.mcap"),
        ("..", "dropped.mcap"),
        ("", "dropped.mcap"),
        (".mcap", "mcap.mcap"),
        ("a" * 300 + ".mcap", "a" * 95 + ".mcap"),
    ],
)
def test_names_of_dropped_files_are_harmless(sent: str, kept: str) -> None:
    assert clean_name(sent) == kept
