"""Tables and pages over all runs, brought up to date at the end of a batch."""

from __future__ import annotations

from pipeline.analysis.keys import hash_json
from pipeline.store import Mirror, Store

_NOTES = "batch/pooled"
_NOTE = "all runs"
POOLED = ("datasets.parquet", "index.html")
"""Files over all runs."""
_MOST_ROUNDS = 20
_VERSION = 2
"""Raised by whoever changes how the pools are made."""


def refresh_pools(store: Store) -> bool:
    """Bring `datasets.parquet`, the catalogue, and a fleet model and a trend that were asked for up to date.

    Other batches may add runs meanwhile: it is done again until the runs are those that were pooled, so that
    the last one to finish leaves the right tables, whoever wrote last.

    Returns:
        Whether anything had to be written.
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
    """Have the tables and pages over all runs made again by the next batch."""
    store.notes(_NOTES).remove(_NOTE)


def load_libraries() -> None:
    """Load what pooling needs, for whoever has time to do so before."""
    import scipy.special  # noqa: F401, PLC0415 - intervals of pooled runs


def refresh_remote_pools(mirror: Mirror) -> None:
    """As `refresh_pools`, for results on an object store, with the runs that other machines have added.

    A fleet model or a trend that was asked for fetches the tables that it takes. All pages are published, as
    the catalogue links them.
    """
    from pipeline.analysis.fleet import FLEET  # noqa: PLC0415 - heavy
    from pipeline.analysis.trend import TREND  # noqa: PLC0415 - heavy
    from pipeline.report.pages import PAGES  # noqa: PLC0415 - heavy

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
    """What the pools depend on: the runs there are, logs without one, and what is made of them."""
    # The contracts bring a table library along, which help and usage errors do without.
    from pipeline.report.catalogue import list_failed  # noqa: PLC0415
    from schemas import contract_of  # noqa: PLC0415

    runs = [[manifest.run, manifest.key, manifest.folder.name] for manifest in store.survey().manifests]
    return hash_json([_VERSION, contract_of("datasets").version, runs, list_failed(store)])


def _write_pools(store: Store) -> None:
    # A batch with nothing to do needs none of these.
    from pipeline.analysis.analyze import update_datasets  # noqa: PLC0415
    from pipeline.analysis.fleet import update_fleet  # noqa: PLC0415
    from pipeline.analysis.trend import update_trend  # noqa: PLC0415

    update_datasets(store)
    update_fleet(store)
    update_trend(store)
