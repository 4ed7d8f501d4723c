"""Upkeep after a batch: tables and pages over all runs, pruning of old generations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline.batch.request import BatchError, Pruning
from pipeline.core.program import SlipError
from pipeline.core.untrusted import walk_files
from pipeline.job.keys import hash_json
from pipeline.store import Mirror, Store, StoreError
from pipeline.store.names import path_unread

_NOTES = "batch/pooled"
_NOTE = "all runs"
POOLED = ("datasets.parquet", "index.html")
"""Files over all runs."""
_MOST_ROUNDS = 20
_VERSION = 2
"""Version of the pooled files; increase it when their generation changes."""


def refresh_pools(store: Store) -> bool:
    """Update `datasets.parquet`, the catalogue, and the fleet model and trend if they were requested.

    Other batches may add runs meanwhile: it is repeated until the pooled runs are the current ones, so that
    the last batch to finish leaves the right tables.

    Returns:
        Whether any file was written.
    """
    notes = store.notes(_NOTES)
    written = False
    for _ in range(_MOST_ROUNDS):
        runs = _hash_runs(store)
        are_there = all((store.root / name).exists() for name in POOLED)
        if are_there and (notes.read(_NOTE) or {}).get("runs") == runs:
            return written
        _write_pools(store)
        written = True
        if _hash_runs(store) == runs:
            notes.write(_NOTE, {"runs": runs})
            return written
    return written


def forget_pools(store: Store) -> None:
    """Invalidate the tables and pages over all runs, so that the next batch makes them again."""
    store.notes(_NOTES).remove(_NOTE)


def refresh_remote_pools(mirror: Mirror) -> None:
    """As `refresh_pools`, for results on an object store, including runs added by other machines.

    A requested fleet model or trend fetches the tables that it needs. All pages are published, as the
    catalogue links them.
    """
    from pipeline.job.over_runs import TREND  # noqa: PLC0415 - heavy
    from pipeline.job.prediction import FLEET  # noqa: PLC0415 - heavy
    from pipeline.report.page import PAGES  # noqa: PLC0415 - heavy

    mirror.pull_index()
    tables = ["aggregates"]
    if (mirror.store.root / FLEET).is_file():
        tables += ["findings", "estimates"]
    if (mirror.store.root / TREND).is_file():
        tables += ["slip", "findings", "estimates"]
    mirror.pull_tables(tables, mirror.store.manifests())
    forget_pools(mirror.store)
    refresh_pools(mirror.store)
    for name in ("datasets.parquet", "quarantine_datasets.parquet", FLEET, "fleet.parquet", TREND, *PAGES):
        mirror.push_file(name)
    mirror.push_register()


def _hash_runs(store: Store) -> str:
    """Hash of what the pools depend on: versions, runs, and logs without one."""
    # The contracts import a table library, which help and usage errors do not need.
    from pipeline.report.page import list_failed  # noqa: PLC0415
    from schemas import contract_of  # noqa: PLC0415

    runs = [[manifest.run, manifest.key, manifest.folder.name] for manifest in store.survey().manifests]
    return hash_json([_VERSION, contract_of("datasets").version, runs, list_failed(store)])


def _write_pools(store: Store) -> None:
    # A batch without work needs none of these imports.
    from pipeline.job.analyze import update_datasets  # noqa: PLC0415
    from pipeline.job.over_runs import update_trend  # noqa: PLC0415
    from pipeline.job.prediction import update_fleet  # noqa: PLC0415

    update_datasets(store)
    update_fleet(store)
    update_trend(store)


@dataclass(frozen=True, kw_only=True)
class Pruned:
    """Result of pruning.

    Attributes:
        removed: removed folders of generations.
        problems: why the results still exceed the quota, and which of them were not measured.
    """

    removed: tuple[Path, ...]
    problems: tuple[SlipError, ...] = ()


def prune_results(store: Store, pruning: Pruning) -> Pruned:
    """Remove generations that are not current.

    First, all but the newest `keep` of each run are removed. If the results still exceed the quota, the
    oldest of these follow, one more of every run at a time.

    Args:
        store: the results.
        pruning: number to keep, and quota.

    Raises:
        StoreError: a run is being written for too long, or the disk reports an error.
    """
    removed = list(store.prune(pruning.keep))
    if pruning.quota_bytes is None:
        return Pruned(removed=tuple(removed))
    keep = pruning.keep
    size, errors = measure_results(store)
    while size > pruning.quota_bytes and keep > 0:
        keep -= 1
        removed += store.prune(keep)
        size, errors = measure_results(store)
    over = () if size <= pruning.quota_bytes else (_over_quota(store, size, pruning.quota_bytes),)
    return Pruned(removed=tuple(removed), problems=(*errors, *over))


def _over_quota(store: Store, size: int, quota: int) -> BatchError:
    return BatchError(
        "over_quota",
        f"the results hold {size / 1e9:.3g} GB without any old generation, more than {quota / 1e9:.3g} GB",
        where=str(store.root),
        hint="Raise --quota, or move runs elsewhere",
    )


def measure_results(store: Store) -> tuple[int, tuple[StoreError, ...]]:
    """Size of the results on disk [bytes], and the errors of parts that could not be read.

    Files shared by several generations count once.
    """
    seen: set[tuple[int, int]] = set()
    total = 0
    errors: list[StoreError] = []
    for entry in walk_files(store.root, lambda path, why: errors.append(path_unread(path, why))):
        try:
            status = entry.stat(follow_symlinks=False)
        except OSError:
            # Another batch has just removed it.
            continue
        if (status.st_dev, status.st_ino) not in seen:
            seen.add((status.st_dev, status.st_ino))
            total += status.st_blocks * 512
    return total, tuple(errors)
