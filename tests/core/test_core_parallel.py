"""Two processes give what one gives, and leave nothing behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from pipeline.core import python_command
from pipeline.core.compute import both_cores, map_parallel, measure_cpu

if TYPE_CHECKING:
    from numpy.typing import NDArray

pytestmark = pytest.mark.usefixtures("every_core")
two_cores = pytest.mark.skipif(
    sys.platform != "linux" or len(os.sched_getaffinity(0)) < 2, reason="there is no second core"
)


def _multiply(columns: NDArray[np.float64], factor: int) -> NDArray[np.float64]:
    return columns * factor


def _name_process(number: int) -> tuple[int, list[int]]:
    time.sleep(0.02)
    return os.getpid(), map_parallel(_name_inner, [number, number])


def _name_inner(_: int) -> int:
    return os.getpid()


def _refuse(number: int) -> int:
    if number in (3, 5):
        raise ValueError(number)
    return number


def _die_beside(mine: int, number: int) -> int:
    if os.getpid() != mine:
        os._exit(1)
    time.sleep(0.02)
    return number


def _work(seconds: float) -> int:
    begun = time.process_time()
    while time.process_time() < begun + seconds:
        pass
    return os.getpid()


def _name_shared(one: object, _: int) -> object:
    time.sleep(0.02)
    return one


def test_results_come_in_order_and_lie_in_memory_as_they_did() -> None:
    columns = np.random.default_rng(0).normal(size=(5, 40, 3)).transpose(1, 2, 0)
    with both_cores([]):
        found = map_parallel(partial(_multiply, columns), range(3000))
    for factor, result in enumerate(found):
        assert result.strides == columns.strides
        assert (result == columns * factor).all()


@two_cores
def test_two_processes_share_the_work_and_begin_no_others() -> None:
    with both_cores([]):
        found = map_parallel(_name_process, range(20))
    assert len({pid for pid, _ in found}) == 2
    assert all(set(inner) == {pid} for pid, inner in found)


@two_cores
def test_what_both_have_is_not_copied() -> None:
    one = threading.Lock()
    with both_cores([one]):
        assert all(found is one for found in map_parallel(partial(_name_shared, one), range(10)))


def test_the_first_error_in_the_order_of_items_is_raised_and_work_goes_on() -> None:
    with both_cores([]):
        with pytest.raises(ValueError, match="3"):
            map_parallel(_refuse, range(10))
        assert map_parallel(_refuse, [0, 1, 2]) == [0, 1, 2]


def test_a_process_that_dies_costs_no_result() -> None:
    with both_cores([]):
        assert map_parallel(partial(_die_beside, os.getpid()), range(10)) == list(range(10))


def test_what_cannot_be_sent_is_done_here() -> None:
    with both_cores([]):
        assert map_parallel(lambda number: (number, os.getpid()), [1, 2]) == [
            (1, os.getpid()),
            (2, os.getpid()),
        ]


@two_cores
def test_cpu_time_of_both_is_counted_and_stays_counted() -> None:
    before = measure_cpu()
    with both_cores([]):
        assert len(set(map_parallel(_work, [0.1] * 6))) == 2
    assert measure_cpu() - before > 0.55


def test_threads_of_a_server_begin_no_process() -> None:
    found: list[tuple[int, list[int]]] = []

    def serve() -> None:
        with both_cores([]):
            found.extend(map_parallel(_name_process, range(4)))

    thread = threading.Thread(target=serve)
    thread.start()
    thread.join()
    assert {pid for pid, _ in found} == {os.getpid()}


@two_cores
def test_threads_beside_the_main_one_do_not_use_its_process() -> None:
    found: list[tuple[int, list[int]]] = []
    with both_cores([]):
        thread = threading.Thread(target=lambda: found.extend(map_parallel(_name_process, range(10))))
        thread.start()
        thread.join()
    assert {pid for pid, _ in found} == {os.getpid()}


@two_cores
@pytest.mark.parametrize("call", ["pipe", "fork"])
def test_without_room_for_a_process_all_is_done_here(call: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> None:
        raise OSError(call)

    monkeypatch.setattr(os, call, refuse)
    before = len(list(Path("/proc/self/fd").iterdir()))
    with both_cores([]):
        assert map_parallel(_refuse, [0, 1]) == [0, 1]
    assert len(list(Path("/proc/self/fd").iterdir())) == before


@two_cores
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_signal_leaves_no_process(number: signal.Signals) -> None:
    code = (
        "import os, time\n"
        "from pipeline.core.compute import both_cores, map_parallel\n"
        "def wait(seconds):\n"
        "    os.write(1, b'%d\\n' % os.getpid())\n"
        "    time.sleep(seconds)\n"
        "with both_cores([]):\n"
        "    map_parallel(wait, [60, 60])\n"
    )
    with subprocess.Popen(
        python_command("-c", code), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        assert process.stdout is not None
        pids = {int(process.stdout.readline()) for _ in range(2)}
        assert len(pids) == 2
        process.send_signal(number)
        process.wait(10)
        (beside,) = pids - {process.pid}
        left = Path(f"/proc/{beside}")
        ends = time.monotonic() + 5.0
        while left.exists() and time.monotonic() < ends:
            time.sleep(0.01)
        assert not left.exists()
