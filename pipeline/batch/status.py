"""What is done, failed and quarantined, without looking at a log."""

from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.batch.ledger import Entry, Ledger
from pipeline.batch.pruning import measure_results
from pipeline.logs import RemotePath, to_location
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
        errors: runs that cannot be read.
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
    return Status(
        runs=len(survey.manifests),
        entries=entries,
        counts={state: states.count(state) for state in _COUNTED},
        bytes=measure_results(store),
        old_generations=sum(len(manifest.earlier) for manifest in survey.manifests),
        errors=survey.errors,
        last=max((entry.at for entry in entries), default=None),
    )


def _still_matters(entry: Entry) -> bool:
    log = to_location(entry.log.path)
    return entry.state in {"done", "lossy"} or isinstance(log, RemotePath) or log.exists()
