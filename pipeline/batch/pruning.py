"""Old generations: a few are kept to look back at, none that the disk has no room for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline.batch.errors import BatchError
from pipeline.batch.request import Pruning
from pipeline.core.errors import SlipError
from pipeline.core.walk import walk_files
from pipeline.store import Store, StoreError
from pipeline.store.errors import left_out


@dataclass(frozen=True, kw_only=True)
class Pruned:
    """What pruning did.

    Attributes:
        removed: folders of generations that were removed.
        problems: why the results are still larger than the quota, and what of them was not measured.
    """

    removed: tuple[Path, ...]
    problems: tuple[SlipError, ...] = ()


def prune_results(store: Store, pruning: Pruning) -> Pruned:
    """Remove generations that are not current.

    First all but the newest of each run that are to be kept; where the results are still larger than the
    quota, the oldest of those too, one more of every run at a time.

    Args:
        store: the results.
        pruning: how many are kept, and how large the results may be.

    Raises:
        StoreError: a run is being written for too long, or the disk refuses.
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
    """Bytes that the results take on the disk, and what of them could not be looked at.

    What several generations share counts once.
    """
    seen: set[tuple[int, int]] = set()
    total = 0
    errors: list[StoreError] = []
    for entry in walk_files(store.root, lambda place, why: errors.append(left_out(place, why))):
        try:
            status = entry.stat(follow_symlinks=False)
        except OSError:
            # Another batch has just removed it.
            continue
        if (status.st_dev, status.st_ino) not in seen:
            seen.add((status.st_dev, status.st_ino))
            total += status.st_blocks * 512
    return total, tuple(errors)
