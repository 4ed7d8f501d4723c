"""Killed at any moment: readers see whole runs, and the same command again leaves what one run would have."""

import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from batch_tools import IMPORTABLE, assert_whole, batch, counts, read_tables, start_slip
from batch_works import work_dying

from pipeline.store import Store, list_old


@pytest.fixture(scope="module")
def field(originals: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs that take long enough to be killed at."""
    folder = tmp_path_factory.mktemp("kills") / "season"
    shutil.copytree(originals, folder)
    # Bytes behind the end make a content of its own; the log then has losses, which is a state as well.
    (folder / "e.mcap").write_bytes((folder / "a.mcap").read_bytes() + b"\0")
    return folder


@pytest.fixture(scope="module")
def undisturbed(field: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    batch(field, out)
    return read_tables(out)


def start_batch(field: Path, out: Path) -> Callable[[], None]:
    """A batch in a process of its own, without workers."""
    # A server that has loaded everything forks the batches: no round is spent on starting a program.
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(
        ["pytest", "pipeline.batch.batch_run", "pipeline.analysis.analyze", "pipeline.report.page"]
    )
    process = server.Process(target=batch, args=(field, out))
    process.start()

    def kill() -> None:
        process.kill()
        process.join()

    return kill


def start_command(field: Path, out: Path) -> Callable[[], None]:
    """The command, with two workers."""
    process = start_slip("batch", field, "--results", out, "--jobs", "2", "--settle", "0", "--quiet")

    def kill() -> None:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()

    return kill


# Beside the test of the store that kills at random moments.
@pytest.mark.long
@pytest.mark.parametrize(
    ("start", "rounds", "longest_s"), [(start_batch, 100, 3.0), (start_command, 16, 12.0)]
)
def test_killed_at_random_moments(
    field: Path,
    tmp_path: Path,
    undisturbed: dict[str, bytes],
    start: Callable[[Path, Path], Callable[[], None]],
    rounds: int,
    longest_s: float,
) -> None:
    out, chance = tmp_path / "out", random.Random(rounds)  # noqa: S311 - moments, not secrets
    seen: Counter[int] = Counter()
    for _ in range(rounds):
        kill = start(field, out)
        time.sleep(chance.uniform(0.0, longest_s))
        kill()
        assert_whole(out, undisturbed)
        seen[len(Store(out).runs())] += 1
        if len(Store(out).runs()) == len(list(field.glob("*.mcap"))):
            # Everything is done: begin again, so that every round has something to kill.
            shutil.rmtree(out)
    assert len(seen) > 1, "batches were killed while they published"
    batch(field, out)
    assert read_tables(out) == undisturbed
    # Killed behind its last step a run is done: only the link `latest`, a convenience, may have been left.
    assert all(path.is_symlink() for path in out.glob("runs/*/*/.tmp-*"))


CALLS = tuple(range(1, 40))
"""More calls of the system that change the disk than the work on a log does."""


def name_logs_after_calls(originals: Path, folder: Path, calls: Sequence[int]) -> None:
    folder.mkdir()
    whole = (originals / "a.mcap").read_bytes()
    for call in calls:
        (folder / f"{call}.mcap").write_bytes(whole + bytes(call))


# Beside the tests of the store, which kill at every call.
@pytest.mark.parametrize(
    "calls", [(4, 20, 27), pytest.param(CALLS, marks=pytest.mark.long)], ids=["some", "all"]
)
def test_a_worker_killed_at_any_call_costs_nothing(
    originals: Path, tmp_path: Path, calls: tuple[int, ...]
) -> None:
    season = tmp_path / "season"
    name_logs_after_calls(originals, season, calls)
    batch(season, tmp_path / "clean")
    outcome = batch(season, tmp_path / "out", work=work_dying, executor="local")
    assert len(list(season.glob("*.killed"))) >= min(len(calls), 25)
    # Behind the last calls the results are there already when the log is tried again.
    assert sum(counts(outcome).get(state, 0) for state in ("done", "lossy", "unchanged")) == len(calls)
    assert not outcome.problems
    assert read_tables(tmp_path / "out") == read_tables(tmp_path / "clean")


@pytest.mark.long
@pytest.mark.parametrize("call", CALLS[:27:3])
def test_a_batch_killed_with_all_its_workers_goes_on(originals: Path, tmp_path: Path, call: int) -> None:
    season = tmp_path / "season"
    name_logs_after_calls(originals, season, (call, 50, 60))
    batch(season, tmp_path / "clean")
    process = start_batch_of("work_killing_the_batch", season, tmp_path, DIE_AT=str(call))
    assert process.wait(60) == -signal.SIGKILL
    assert Store(tmp_path / "out").examine().problems == ()
    batch(season, tmp_path / "out")
    assert read_tables(tmp_path / "out") == read_tables(tmp_path / "clean")


@pytest.mark.parametrize("ending", [signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_workers_end_with_their_batch(field: Path, tmp_path: Path, ending: signal.Signals) -> None:
    process = start_batch_of("work_slowly", field, tmp_path, PAUSE_S="600", BEGUN=str(tmp_path))
    wait_until(lambda: len(list(tmp_path.glob("*-*"))) >= 2)
    process.send_signal(ending)
    process.wait(10)
    # A claim ends with the process that holds it.
    assert wait_until(lambda: list_group(process.pid) == []), list_group(process.pid)


def start_batch_of(work: str, logs: Path, folder: Path, **variables: str) -> subprocess.Popen[bytes]:
    """A batch of two workers in a process group of its own, with results in `out` of a folder."""
    code = (
        "import sys; from pathlib import Path; from batch_tools import batch; import batch_works;"
        f"batch(Path(sys.argv[1]), Path(sys.argv[2]), work=batch_works.{work}, executor='local')"
    )
    return subprocess.Popen(
        [sys.executable, "-c", code, logs, folder / "out"],
        start_new_session=True,
        env=os.environ | {"PYTHONPATH": IMPORTABLE, **variables},
    )


def wait_until(is_so: Callable[[], bool], seconds: float = 30.0) -> bool:
    """Whether something becomes so."""
    deadline = time.monotonic() + seconds
    while not is_so() and time.monotonic() < deadline:
        time.sleep(0.1)
    return is_so()


def list_group(group: int) -> list[int]:
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[2]) == group and fields[0] != "Z":
            found.append(int(path.parent.name))
    return found


@pytest.mark.long
def test_two_batches_at_once_do_every_log_once(
    field: Path, tmp_path: Path, undisturbed: dict[str, bytes]
) -> None:
    out = tmp_path / "out"
    both = [
        start_slip("batch", field, "--results", out, "--jobs", "1", "--settle", "0", "--json")
        for _ in range(2)
    ]
    answers = [process.communicate(timeout=120) for process in both]
    assert [process.returncode for process in both] == [3, 3], answers
    assert read_tables(out) == undisturbed
    assert not any(list_old(manifest) for manifest in Store(out).manifests())
