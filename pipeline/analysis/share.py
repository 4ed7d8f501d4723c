"""What the results share with others: features of every run, without data, names of files or places."""

import polars as pl

from pipeline.analysis.compare import measure_runs
from pipeline.analysis.compared_runs import find_material, read_digest
from pipeline.analysis.errors import ANALYZE_FIRST, lack_runs
from pipeline.core.version import read_version
from pipeline.fleet.features import check_features
from pipeline.store import Store
from schemas.features import Features

_HASH = 64


def gather_features(store: Store) -> tuple[pl.DataFrame, tuple[str, ...]]:
    """The table `features` of the results, and notes on what is left out.

    Raises:
        JobError: ``nothing_to_share``.
        ComparisonError: ``bad_features``: a number is out of range.
    """
    compared, runs, told = measure_runs(find_material(store, ("dataset",), trusted_only=True))
    digests = {run: read_digest(manifest) for run, manifest in compared.manifests.items()}
    nameless = sorted(run for run, digest in digests.items() if len(digest) != _HASH)
    notes = [*compared.notes, *told[1:]]
    if nameless:
        notes.append(f"left out, the hash of the log is not known: {', '.join(nameless)}")
    known = runs.filter(~pl.col("run").is_in(nameless)) if not runs.is_empty() else runs
    if known.is_empty():
        raise lack_runs("nothing_to_share", "there is no run to share", store.root, ANALYZE_FIRST, notes)
    schema = Features.create_empty().schema
    shared = known.with_columns(
        pl.col("run").replace_strict(digests, return_dtype=pl.String).alias("sha256"),
        pl.col("input").cast(pl.String),
        pl.lit(read_version()).alias("made_by"),
        pl.col("key").alias("from_results"),
        (pl.col("mass") * pl.col("squared_gyration")).alias("inertia"),
    ).with_columns(pl.col("sha256").str.slice(0, 16).alias("run"))
    typed = shared.select(pl.col(name).cast(kind) for name, kind in schema.items())
    return check_features(typed.sort("sha256", "input"), str(store.root)), tuple(notes)
