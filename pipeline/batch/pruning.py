"""Old generations: a few are kept to look back at, none that the disk has no room for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline.batch.errors import BatchError
from pipeline.batch.request import Pruning
from pipeline.store import Store


@dataclass(frozen=True, kw_only=True)
class Pruned:
    """What pruning did.

    Attributes:
        removed: folders of generations that were removed.
        problem: why the results are still larger than the quota; None when they are not.
    """

    removed: tuple[Path, ...]
    problem: BatchError | None = None


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
    keep = pruning.keep
    while pruning.quota_bytes is not None and (size := measure_results(store)) > pruning.quota_bytes:
        if keep == 0:
            return Pruned(removed=tuple(removed), problem=_over_quota(store, size, pruning.quota_bytes))
        keep -= 1
        removed += store.prune(keep)
    return Pruned(removed=tuple(removed))


def _over_quota(store: Store, size: int, quota: int) -> BatchError:
    return BatchError(
        "over_quota",
        f"the results hold {size / 1e9:.3g} GB without any old generation, more than {quota / 1e9:.3g} GB",
        where=str(store.root),
        hint="Raise --quota, or move runs elsewhere",
    )


def measure_results(store: Store) -> int:
    """Bytes that the results take on the disk; what several generations share counts once."""
    seen: set[tuple[int, int]] = set()
    total = 0
    for path in store.root.rglob("*"):
        try:
            status = path.lstat()
        except OSError:
            # Another batch has just removed it.
            continue
        if (status.st_dev, status.st_ino) not in seen and not path.is_dir():
            seen.add((status.st_dev, status.st_ino))
            total += status.st_blocks * 512
    return total
