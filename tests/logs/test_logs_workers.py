"""Reading keeps busy what it may, and no more."""

import os
import threading

import pytest

from pipeline.core.compute import map_in_order, usable_threads


def test_a_limit_of_threads_is_respected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("POLARS_MAX_THREADS", raising=False)
    cores = usable_threads()
    assert 1 <= cores <= (os.cpu_count() or 1)
    for said, expected in (("1", 1), ("0", 1), ("9999", cores), ("many", cores)):
        monkeypatch.setenv("POLARS_MAX_THREADS", said)
        assert usable_threads() == expected


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_results_come_in_order_and_no_more_run_than_asked(threads: int) -> None:
    running, most, lock = [0], [0], threading.Lock()

    def square(number: int) -> int:
        with lock:
            running[0] += 1
            most[0] = max(most[0], running[0])
        with lock:
            running[0] -= 1
        return number * number

    assert list(map_in_order(square, range(50), threads)) == [number * number for number in range(50)]
    assert 1 <= most[0] <= threads


@pytest.mark.parametrize("threads", [1, 3])
def test_an_error_of_a_worker_reaches_the_caller(threads: int) -> None:
    def fail(number: int) -> int:
        if number == 7:
            raise ValueError("seven")
        return number

    with pytest.raises(ValueError, match="seven"):
        list(map_in_order(fail, range(20), threads))
