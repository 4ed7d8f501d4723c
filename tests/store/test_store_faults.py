"""Memory refused at any allocation, a disk that fails at any call: the old results or the new ones, whole."""

import multiprocessing
import os
import sys
from pathlib import Path

import pytest
from store_samples import read_seed, write_generation

from pipeline.core import SlipError
from pipeline.store import Store

pytest.importorskip("_testcapi", reason="this Python cannot refuse memory on purpose")

from multiprocessing.context import ForkServerContext

from faults import DISK, MEMORY, Fault, arm, draw_faults

RUN = "2026/husky"
WRITTEN, REFUSED = 0, 3
PATIENCE_S = 60.0
MOST = {MEMORY: 30_000, DISK: 100}
"""More allocations and calls than a generation, a table and a page over all runs take: 55 to 81 calls."""


def write_everything(store: Store, key: str, seed: int) -> None:
    write_generation(store, RUN, key, seed)
    store.write_results_text("index.html", f"{seed}")
    store.prune(1)


def write_under(fault: Fault, root: Path, key: str, seed: int) -> None:
    """In a process of its own: the libraries may well die of what is done to them here."""
    # Panics of polars are long, and are not what is looked at here.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())
    store = Store(root, patience_s=10.0)
    try:
        with arm(fault):
            write_everything(store, key, seed)
    except (SlipError, MemoryError):
        sys.exit(REFUSED)


def run_rounds(store: Store, rounds: int) -> None:
    server: ForkServerContext = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(["test_store_faults", "pipeline.store.parquet_tables"])
    write_everything(store, "first", 0)
    outcomes = []
    for seed, fault in enumerate(draw_faults(rounds, most=MOST, seed=rounds)):
        new = (f"key{seed % 3}", seed + 1)
        process = server.Process(target=write_under, args=(fault, store.root, *new), daemon=True)
        process.start()
        process.join(PATIENCE_S)
        process.kill()
        process.join()
        found = read_seed(store, RUN)
        assert found in {seed, seed + 1}, fault
        assert store.examine().problems == (), fault
        assert (store.root / "index.html").read_text() in {f"{seed}", f"{seed + 1}"}
        if process.exitcode == WRITTEN:
            assert found == seed + 1
        outcomes.append(process.exitcode)
        # Whatever was left, the same again succeeds.
        write_everything(store, *new)
        assert read_seed(store, RUN) == seed + 1
    assert store.examine().problems == ()
    assert not list(store.root.rglob(".tmp-*"))
    assert outcomes.count(REFUSED) > rounds // 3, "faults were met"


def test_memory_and_disk_fail_in_thirty_rounds(store: Store) -> None:
    run_rounds(store, 30)


@pytest.mark.long
def test_memory_and_disk_fail_in_five_hundred_rounds(store: Store) -> None:
    run_rounds(store, 500)


def test_the_faults_are_real(tmp_path: Path) -> None:
    store = Store(tmp_path / "results")
    with pytest.raises(MemoryError), arm(Fault(MEMORY, 2000)):
        write_everything(store, "k", 1)
    with pytest.raises(SlipError, match="full"), arm(Fault(DISK, 5)):
        write_everything(store, "k", 1)
    with arm(Fault(DISK, 10_000)) as count:
        write_everything(store, "k", 1)
    assert 20 < count() < MOST[DISK]
