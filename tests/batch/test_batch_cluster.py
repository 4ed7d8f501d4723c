"""On a dask cluster: the same bytes, also when a worker is killed in the middle."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from batch_tools import IMPORTABLE, batch, counts, read_tables
from batch_works import work_poisoned, work_slowly

from pipeline.batch import BatchError

distributed = pytest.importorskip("distributed", reason="the extra dask is not installed")

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture
def scheduler(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[str]:
    """A scheduler with two worker processes over TCP, as somebody else may have started it."""
    begun = tmp_path / "begun"
    begun.mkdir()
    monkeypatch.setenv("BEGUN", str(begun))
    monkeypatch.setenv("PYTHONPATH", IMPORTABLE)
    monkeypatch.setenv("POLARS_MAX_THREADS", "1")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, protocol="tcp://", dashboard_address=None, silence_logs=50
    ) as cluster:
        yield cluster.scheduler_address


CLUSTER = """
import distributed, sys
if __name__ == "__main__":
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, protocol="tcp://", dashboard_address=None, silence_logs=50
    ) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""


@contextlib.contextmanager
def start_cluster() -> Iterator[tuple[str, int]]:
    """A scheduler and a worker in a process of their own: its address and the process."""
    process = subprocess.Popen(
        [sys.executable, "-c", CLUSTER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    try:
        yield process.stdout.readline().strip(), process.pid
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def kill_first_worker(begun: Path, killed: list[int]) -> None:
    """Kill the first worker that has begun with a log."""
    deadline = time.monotonic() + 30.0
    while not killed and time.monotonic() < deadline:
        for marker in begun.iterdir():
            killed.append(int(marker.name.rpartition("-")[2]))
            os.kill(killed[0], signal.SIGKILL)
            return
        time.sleep(0.02)


@pytest.mark.long
def test_a_worker_killed_in_the_middle_costs_nothing(scheduler: str, season: Path, tmp_path: Path) -> None:
    batch(season, tmp_path / "here")
    killed: list[int] = []
    killer = threading.Thread(target=kill_first_worker, args=(tmp_path / "begun", killed))
    killer.start()
    outcome = batch(season, tmp_path / "cluster", work=work_slowly, executor=scheduler)
    killer.join()
    assert len(killed) == 1
    begun = [marker.name.rpartition("-")[0] for marker in (tmp_path / "begun").iterdir()]
    assert len(begun) > len(set(begun)), "the log of the killed worker was begun again"
    assert counts(outcome) == {"done": 4}
    assert read_tables(tmp_path / "cluster") == read_tables(tmp_path / "here")


@pytest.mark.long
def test_poison_on_a_cluster_of_our_own_is_named(
    season: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", IMPORTABLE)
    for number, kind in enumerate(("raises", "hangs", "eats", "dies")):
        (season / f"{kind}.mcap").write_bytes((season / "a.mcap").read_bytes() + bytes(number + 1))
    outcome = batch(
        season,
        tmp_path / "out",
        work=work_poisoned,
        executor="dask",
        timeout_s=8.0,
        memory_bytes=900_000_000,
    )
    found = {Path(line.path).stem: (line.state, line.code) for line in outcome.lines}
    assert {name: found[name] for name in ("raises", "hangs", "eats", "dies")} == {
        "raises": ("failed", "unexpected_error"),
        "hangs": ("quarantined", "timed_out"),
        "eats": ("quarantined", "out_of_memory"),
        "dies": ("quarantined", "worker_died"),
    }
    # What a worker had done and not yet told when it died is there when the log is tried again.
    assert counts(outcome)["done"] + counts(outcome).get("unchanged", 0) == 4


def test_a_scheduler_that_does_not_answer_is_said(
    season: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.batch.executors._CONNECT_S", 0.5)
    with pytest.raises(BatchError) as caught:
        batch(season, tmp_path / "out", executor="tcp://127.0.0.1:9")
    assert caught.value.code == "cluster_not_reached"
    with pytest.raises(BatchError, match="no executor is called 'slurm'"):
        batch(season, tmp_path / "out", executor="slurm")


def test_a_scheduler_that_is_silent_is_not_waited_for(
    season: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.batch.executors._CONNECT_S", 0.5)
    started = time.monotonic()
    with socket.create_server(("127.0.0.1", 0)) as place, pytest.raises(BatchError) as caught:
        batch(season, tmp_path / "out", executor=f"tcp://127.0.0.1:{place.getsockname()[1]}")
    assert caught.value.code == "cluster_not_reached"
    for address in ("tcp://", "tls://127.0.0.1:9", "tcp://no.such.host:1"):
        with pytest.raises(BatchError) as caught:
            batch(season, tmp_path / "out", executor=address)
        assert caught.value.code == "cluster_not_reached"
        assert "\n" not in str(caught.value)
    assert time.monotonic() - started < 10.0


@pytest.mark.long
def test_a_scheduler_lost_in_the_middle_ends_the_batch(
    season: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = tmp_path / "begun"
    begun.mkdir()
    monkeypatch.setenv("BEGUN", str(begun))
    monkeypatch.setenv("PAUSE_S", "60")
    monkeypatch.setenv("PYTHONPATH", IMPORTABLE)
    with start_cluster() as (address, pid):

        def lose() -> None:
            deadline = time.monotonic() + 60.0
            while not list(begun.iterdir()) and time.monotonic() < deadline:
                time.sleep(0.05)
            os.kill(pid, signal.SIGKILL)

        loser = threading.Thread(target=lose)
        loser.start()
        outcome = batch(season, tmp_path / "out", work=work_slowly, executor=address)
        loser.join()
    assert {(line.state, line.code) for line in outcome.lines} == {("failed", "cluster_lost")}
    # None of them is to blame: the next batch does them all.
    assert counts(batch(season, tmp_path / "out")) == {"done": 4}
