"""A log that dies, hangs or eats memory costs itself: the page says so in a sentence, the server lives on."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import cast
from urllib.request import Request, urlopen

import pytest
from test_workbench_upload import files_below
from workbench_server import LIMITS, PATIENCE_S, RUN, Workbench
from workbench_works import work_poisoned, work_slowly


@pytest.fixture
def poisoned(results: Path) -> Iterator[Workbench]:
    limits = replace(LIMITS, timeout_s=10.0, memory_bytes=900_000_000)
    server = Workbench(results, limits=limits, work=work_poisoned)
    yield server
    server.close()


@pytest.mark.long
def test_whatever_a_log_does_to_its_worker_is_one_sentence(poisoned: Workbench) -> None:
    kinds = {"dies": "worker_died", "leaves": "worker_died", "hangs": "timed_out", "eats": "out_of_memory"}
    kinds |= {"raises": "unexpected_error"}
    for kind in kinds:
        status, _, body = poisoned.request("POST", f"/api/upload?name={kind}.mcap", b"log")
        assert status == 200, body
    # Meanwhile the page is answered.
    assert poisoned.get("/api/runs")["runs"]
    assert poisoned.session(RUN)["session"]
    jobs = {str(job["name"]).removesuffix(".mcap"): job for job in poisoned.wait_for_jobs()}
    told = {kind: cast("dict[str, str]", job["error"]) for kind, job in jobs.items()}
    assert {kind: error["code"] for kind, error in told.items()} == kinds
    assert "10 s" in told["hangs"]["message"]
    assert "0.9 GB" in told["eats"]["message"]
    for error in told.values():
        assert error["hint"]
        assert str(poisoned.results) not in error["message"]
        assert len(error["message"].splitlines()) == 1
    assert "raises.mcap" in told["raises"]["message"]
    assert files_below(poisoned.results / "workbench" / "uploads") == [".lock"]


def test_after_a_death_the_next_log_is_analyzed(poisoned: Workbench, hidden_log: Path) -> None:
    poisoned.request("POST", "/api/upload?name=dies.mcap", b"log")
    poisoned.request("POST", "/api/upload?name=good.mcap", hidden_log.read_bytes())
    good, bad = poisoned.wait_for_jobs()
    assert bad["error"]
    # Equal content counts once: it is the run that is there.
    assert (good["error"], good["run"]) == (None, RUN)


EVIL = "import pathlib; pathlib.Path({marker!r}).write_text(__name__); raise ImportError\n"


@pytest.fixture
def slip_serve(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], Path]]:
    """`slip serve --json` in a folder that somebody has filled with modules of their own."""
    here = tmp_path / "here"
    here.mkdir()
    for name in ("pipeline", "tempfile", "multiprocessing", "pickle", "pebble", "numpy"):
        (here / f"{name}.py").write_text(EVIL.format(marker=str(tmp_path / "ran")))
    command = [os.path.dirname(sys.executable) + "/slip", "serve", "results", "--port", "0", "--json"]  # noqa: PTH120 - not resolved
    process = subprocess.Popen(command, cwd=here, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    yield process, here
    process.kill()
    process.communicate()


def read_object(process: subprocess.Popen[str]) -> dict[str, str]:
    assert process.stdout is not None
    lines = []
    while not lines or lines[-1].strip() != "}":
        lines.append(process.stdout.readline())
        assert lines[-1], "it ended"
    return cast("dict[str, str]", json.loads("".join(lines)))


def test_a_script_finds_its_way_in_and_nothing_is_left_at_the_end(
    slip_serve: tuple[subprocess.Popen[str], Path], hidden_log: Path, tmp_path: Path
) -> None:
    process, here = slip_serve
    told = read_object(process)
    assert told["address"].startswith("http://127.0.0.1:")

    def ask(path: str, body: bytes | None = None) -> dict[str, object]:
        headers = {"Authorization": f"Bearer {told['token']}"}
        with urlopen(Request(told["address"] + path, body, headers)) as answer:  # noqa: S310 - the loopback
            return cast("dict[str, object]", json.loads(answer.read()))

    ask("api/upload?name=run.mcap", hidden_log.read_bytes())
    uploads = here / "results" / "workbench" / "uploads"
    assert "log.mcap" in files_below(uploads)
    # It is ended in the middle of the work.
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=PATIENCE_S)
    assert "Traceback" not in said
    assert files_below(uploads) == []
    assert not (tmp_path / "ran").exists()


@pytest.mark.long
def test_what_a_killed_server_has_left_goes_when_the_next_one_starts(
    slip_serve: tuple[subprocess.Popen[str], Path], hidden_log: Path
) -> None:
    process, here = slip_serve
    told = read_object(process)
    headers = {"Authorization": f"Bearer {told['token']}"}
    upload = Request(f"{told['address']}api/upload?name=run.mcap", hidden_log.read_bytes(), headers)  # noqa: S310 - the loopback
    urlopen(upload).close()  # noqa: S310 - the loopback
    uploads = here / "results" / "workbench" / "uploads"
    own = next(uploads.iterdir())
    # A stranger's results may hold a link out of them.
    outside = here / "precious"
    outside.mkdir()
    (outside / ".lock").write_text("")
    (uploads / ("0" * 16)).symlink_to(outside)
    second = Workbench(here / "results")
    second.close()
    assert own.exists(), "another server that lives keeps its logs"
    process.kill()
    process.communicate()
    third = Workbench(here / "results")
    third.close()
    assert not own.exists()
    assert (outside / ".lock").exists()


def test_a_plan_tells_what_it_does_and_ends_when_it_is_cancelled(results: Path, hidden_log: Path) -> None:
    server = Workbench(results, work=work_slowly)
    try:
        before = files_below(results)
        server.post("/api/plan", run=RUN, area="20x10m")
        end = time.monotonic() + PATIENCE_S
        while (job := _find_only_job(server)) is None or job["words"] != "rehearsing manoeuvres":
            assert time.monotonic() < end
            time.sleep(0.05)
        assert job["stops"]
        server.request("POST", f"/api/dismiss?id={job['id']}", b"{}")
        while _find_only_job(server) is not None:
            assert time.monotonic() < end
            time.sleep(0.05)
        assert files_below(results) == before
        # The next task gets a new worker.
        server.request("POST", "/api/upload?name=good.mcap", hidden_log.read_bytes())
        (good,) = server.wait_for_jobs()
        assert (good["error"], good["run"]) == (None, RUN)
    finally:
        server.close()


def _find_only_job(server: Workbench) -> dict[str, object] | None:
    jobs = cast("list[dict[str, object]]", server.get("/api/jobs")["jobs"])
    return jobs[0] if jobs else None
