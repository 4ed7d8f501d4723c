"""A writer killed at any moment leaves the old results or the new ones; finishing later gives the same."""

import random
import signal
import time
from pathlib import Path

import pytest
from store_samples import read_seed, write_generation
from store_writer import StartWriter

from pipeline.store import STEPS, Store

RUN = "2026/husky"
OLD, NEW = 1, 2

FILES = 4
"""Files a generation of `store_samples.write_generation` has: two tables, a quarantine, a text."""

MOMENTS = [("new", step, 1) for step in STEPS if step != "file_written"]
MOMENTS += [("new", "file_written", count) for count in range(1, FILES + 1)]
MOMENTS += [("old", step, 1) for step in STEPS[STEPS.index("folder_synced") :]]
"""Key, step and count; before the commit it does not matter whether the key is the current one."""

BOTH_SIDES = {("new", "manifest_written", 1), ("new", "manifest_replaced", 1)}
"""Of these moments `make test` asks, of the others `make test-long`."""


def assert_tidy(store: Store) -> None:
    manifest = store.manifest(RUN)
    assert manifest is not None
    home = manifest.folder.parent
    expected = {manifest.folder.name, *manifest.earlier, "manifest.json", "latest", ".lock"}
    assert {path.name for path in home.iterdir()} == expected
    assert (home / "latest").resolve() == manifest.folder


def tables_of(store: Store) -> dict[str, bytes]:
    manifest = store.manifest(RUN)
    assert manifest is not None
    return {path.name: path.read_bytes() for path in manifest.folder.iterdir()}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    store = Store(tmp_path_factory.mktemp("undisturbed") / "results")
    write_generation(store, RUN, "new", NEW)
    return tables_of(store)


@pytest.mark.parametrize(
    "moment",
    [pytest.param(one, marks=[] if one in BOTH_SIDES else pytest.mark.long) for one in MOMENTS],
    ids=lambda moment: "-".join(map(str, moment)),
)
def test_killed_at_a_step_the_run_is_whole_and_can_be_finished(
    store: Store, start_writer: StartWriter, undisturbed: dict[str, bytes], moment: tuple[str, str, int]
) -> None:
    key, step, count = moment
    write_generation(store, RUN, "old", OLD)
    writer = start_writer("die", store.root, RUN, key, NEW, step, count)
    assert writer.wait(30) == -signal.SIGKILL

    is_published = STEPS.index(step) >= STEPS.index("manifest_replaced")
    assert read_seed(store, RUN) == (NEW if is_published else OLD)
    assert store.examine().problems == ()

    write_generation(store, RUN, key, NEW)
    assert read_seed(store, RUN) == NEW
    assert tables_of(store) == undisturbed
    assert_tidy(store)


def kill_at_random(store: Store, start_writer: StartWriter, *, rounds: int, seed: int) -> None:
    chance = random.Random(seed)  # noqa: S311 - moments, not secrets
    begun = 0
    unfinished = 0
    for _ in range(rounds):
        writer = start_writer("loop", store.root, RUN, begun, 10_000)
        told = [int(writer.stdout.readline()) for _ in range(chance.randint(1, 3))]
        time.sleep(chance.uniform(0.0, 0.03))
        writer.kill()
        told += [int(line) for line in writer.stdout.read().split()]
        assert writer.wait(30) == -signal.SIGKILL

        seed_now = read_seed(store, RUN)
        assert seed_now in (told[-1], told[-1] + 1)
        assert told == list(range(begun, told[-1] + 1))
        assert store.examine().problems == ()
        begun = seed_now + 1
        unfinished += any((store.root / "runs" / RUN).glob(".tmp-*"))
    assert unfinished > rounds // 10
    write_generation(store, RUN, "last", begun)
    assert read_seed(store, RUN) == begun
    assert_tidy(store)


@pytest.mark.long
def test_killed_at_random_moments_the_run_is_whole(store: Store, start_writer: StartWriter) -> None:
    kill_at_random(store, start_writer, rounds=10, seed=7)


@pytest.mark.long
def test_killed_at_two_hundred_random_moments_the_run_is_whole(
    store: Store, start_writer: StartWriter
) -> None:
    kill_at_random(store, start_writer, rounds=200, seed=11)


def test_exception_leaves_the_old_results_and_nothing_else(store: Store, tmp_path: Path) -> None:
    write_generation(store, RUN, "old", OLD)
    before = sorted(tmp_path.rglob("*"))

    def interrupt() -> None:
        with store.open_generation(RUN, "new") as generation:
            generation.write_text("summary.json", "half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupt()
    assert sorted(tmp_path.rglob("*")) == before
    assert read_seed(store, RUN) == OLD
