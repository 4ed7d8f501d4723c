"""What is done, failed and quarantined, without looking at a log."""

from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.batch.ledger import Entry, Ledger
from pipeline.batch.pruning import measure_results
from pipeline.logs import LogError, locate_recorded
from pipeline.store import Store, StoreError

_COUNTED = ("done", "lossy", "failed", "quarantined", "copy")


@dataclass(frozen=True, kw_only=True)
class Status:
    """What the results hold.

    Attributes:
        runs: runs with results.
        entries: what became of each log in batches, sorted by path; without those that gave no results and
            are gone.
        counts: logs by state: done, lossy, failed, quarantined, copy.
        bytes: size of the results, old generations included.
        old_generations: generations that are not current.
        errors: runs that cannot be read, and folders that were not looked into.
        last: when a batch last worked on a log [s since 1970]; None when none has.
    """

    runs: int
    entries: tuple[Entry, ...]
    counts: Mapping[str, int]
    bytes: int
    old_generations: int
    errors: tuple[StoreError, ...]
    last: float | None


def tell_status(store: Store) -> Status:
    """Look at the results and at what batches have noted."""
    survey = store.survey()
    known = (entry for entry in Ledger(store).read_all().values() if _still_matters(entry))
    entries = tuple(sorted(known, key=lambda entry: entry.log.path))
    states = [entry.state for entry in entries]
    size, left_out = measure_results(store)
    return Status(
        runs=len(survey.manifests),
        entries=entries,
        counts={state: states.count(state) for state in _COUNTED},
        bytes=size,
        old_generations=sum(len(manifest.earlier) for manifest in survey.manifests),
        errors=(*survey.errors, *left_out),
        last=max((entry.at for entry in entries), default=None),
    )


def _still_matters(entry: Entry) -> bool:
    if entry.state in {"done", "lossy"}:
        return True
    try:
        return locate_recorded(entry.log.path).exists()
    except LogError:
        # An address is not asked: what it held may still be there.
        return True
