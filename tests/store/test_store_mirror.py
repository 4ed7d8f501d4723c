"""Copies of generations on an object store: of one machine, and of two that share it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from store_samples import read_seed, write_generation

from pipeline.store.mirror import Mirror

fsspec = pytest.importorskip("fsspec", reason="the extra s3 is not installed")

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from pipeline.store.files import Manifest

ADDRESS = "memory://field/results"
RUNS = ("drive[1]", "drive1")
"""Read as a pattern, the first is the second."""


@pytest.fixture(autouse=True)
def objects() -> Iterator[fsspec.AbstractFileSystem]:
    memory = fsspec.filesystem("memory")
    memory.store.clear()
    yield memory
    memory.store.clear()


def publish(mirror: Mirror, run: str, key: str, seed: int) -> Manifest:
    manifest = write_generation(mirror.store, run, key, seed)
    mirror.push_run(manifest)
    return manifest


def read_all(folder: Path) -> dict[str, int]:
    """Seed of the current generation of every run, as another machine reads it."""
    reader = Mirror(ADDRESS, folder)
    reader.pull_index()
    for run in reader.store.runs():
        reader.pull_run(run)
    return {run: read_seed(reader.store, run) for run in reader.store.runs()}


def test_runs_are_copied_and_pruned_by_their_names_and_not_as_patterns(tmp_path: Path) -> None:
    mirror = Mirror(ADDRESS, tmp_path / "mirror")
    for run in RUNS:
        publish(mirror, run, "k1", 1)
        publish(mirror, run, "k2", 2)
    assert read_all(tmp_path / "reader") == dict.fromkeys(RUNS, 2)
    removed = mirror.store.prune(0)
    assert mirror.prune(path for path in removed if path.parent.name == RUNS[0]) == 1
    left = {name.removeprefix("runs/").rpartition("/")[0] for name in mirror.names(print)}
    assert left == {RUNS[0], f"{RUNS[0]}/k2", RUNS[1], f"{RUNS[1]}/k1", f"{RUNS[1]}/k2"}
    assert mirror.examine().problems == ()


def test_pruning_leaves_what_another_machine_publishes_meanwhile(
    objects: fsspec.AbstractFileSystem, tmp_path: Path
) -> None:
    one, other = Mirror(ADDRESS, tmp_path / "one"), Mirror(ADDRESS, tmp_path / "other")
    for run in RUNS:
        publish(one, run, "k1", 1)
        publish(one, run, "k2", 2)
    other.pull_run(RUNS[0])
    publish(other, RUNS[0], "k3", 3)
    # The files of a generation whose manifest is still to come.
    objects.pipe_file(f"{ADDRESS}/runs/{RUNS[1]}/k4/slip.parquet", b"x")
    assert one.prune(one.store.prune(0)) == 1
    assert read_all(tmp_path / "reader") == {RUNS[0]: 3, RUNS[1]: 2}
    assert other.examine().problems == ()
    assert objects.exists(f"{ADDRESS}/runs/{RUNS[1]}/k4/slip.parquet")


def test_a_run_is_made_again_where_a_file_of_it_is_gone(
    objects: fsspec.AbstractFileSystem, tmp_path: Path
) -> None:
    manifest = publish(Mirror(ADDRESS, tmp_path / "one"), RUNS[1], "k1", 1)
    objects.rm(f"{ADDRESS}/runs/{RUNS[1]}/k1/{manifest.path('slip').name}")
    mirror = Mirror(ADDRESS, tmp_path / "other")
    mirror.pull_run(RUNS[1])
    publish(mirror, RUNS[1], "k2", 2)
    assert read_all(tmp_path / "reader") == {RUNS[1]: 2}
