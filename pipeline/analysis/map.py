"""The deployment map: the literature with the user's own datasets on it."""

from collections.abc import Sequence
from pathlib import Path

import polars as pl

from pipeline.analysis.compare import choose_input, measure_runs
from pipeline.analysis.compare_files import write_figures
from pipeline.analysis.compared_runs import find_material, read_digest
from pipeline.analysis.options import FigureFormat
from pipeline.fleet.datasets import pool_runs
from pipeline.fleet.deployments import find_own_table, read_deployments
from pipeline.fleet.measures import MEASURES
from pipeline.fleet.place import DeploymentMap, place_datasets, place_deployments
from pipeline.store import Store

_SHARED = " (shared)"


def draw_up_map(
    store: Store,
    table: Path | None = None,
    *,
    fed: str | None = None,
    show: str = "slip",
    shared: pl.DataFrame | None = None,
) -> DeploymentMap:
    """Place the literature and the results' datasets.

    Args:
        store: the results; may be empty.
        table: a table of deployments; by default the project's own.
        fed: what u is; None: as `compare_results` chooses it.
        show: key of `MEASURES` that colours the datasets.
        shared: table `features` of others; what is of the results' own logs does not count twice.

    Raises:
        ComparisonError: the table is not there or breaks its schema.
    """
    deployments = read_deployments(table or find_own_table())
    compared, runs, _ = measure_runs(find_material(store, ("dataset",), trusted_only=True))
    chosen = fed or ("command" if runs.is_empty() else choose_input(runs))
    own, notes = _empty_own(), list(compared.notes)
    keys: tuple[str, ...] = ()
    parts = [] if runs.is_empty() else [pool_runs(runs, ("dataset",))]
    own_logs = [read_digest(manifest) for manifest in compared.manifests.values()]
    if shared is not None:
        parts.append(_pool_shared(shared, own_logs))
    if parts:
        pooled = pl.concat(
            [part.with_columns(pl.col("input").cast(pl.String)) for part in parts], how="diagonal"
        )
        datasets = pooled.filter(pl.col("input") == chosen).sort("dataset")
        missing = sorted(set(pooled["dataset"]) - set(datasets["dataset"]))
        notes += (
            [f"not on the map, because there is no {chosen} input: {', '.join(missing)}"] if missing else []
        )
        own, told = place_datasets(datasets, MEASURES[show].column)
        notes += told
        if shared is not None:
            notes.append(_count_shared(shared, own_logs, own))
        keys = tuple(f"{row['dataset']}: {row['keys']}" for row in datasets.iter_rows(named=True))
    return DeploymentMap(
        deployments, place_deployments(deployments), own, keys, tuple(notes), chosen, MEASURES[show]
    )


def _pool_shared(features: pl.DataFrame, own: Sequence[str]) -> pl.DataFrame:
    others = features.filter(~pl.col("sha256").is_in(list(own))).with_columns(
        pl.format("{}" + _SHARED, "dataset").alias("group"),
        pl.col("from_results").alias("key"),
        pl.lit(None, pl.Float64).alias("published_norm"),
    )
    return pool_runs(others, ("dataset",))


def _count_shared(features: pl.DataFrame, own_logs: Sequence[str], placed: pl.DataFrame) -> str:
    """How many runs of others are on the map."""
    digests = features["sha256"].unique()
    drawn = placed.filter(pl.col("dataset").str.ends_with(_SHARED))["runs"].sum()
    twice = digests.is_in(list(own_logs)).sum()
    known = f"; {twice} of them are of your own logs and count once" if twice else ""
    return f"{drawn} of {digests.len()} shared runs drawn{known}"


def write_map(store: Store, drawn: DeploymentMap, figures: FigureFormat | None = None) -> Path:
    """Write `map.html`, and the figure for papers where a format is given; the path of the page."""
    from pipeline.report.deployments import picture_map, render_map  # noqa: PLC0415 - heavy
    from pipeline.report.pages import write_page  # noqa: PLC0415 - heavy

    path = write_page(store, "map.html", render_map(drawn))
    write_figures(store, lambda: [picture_map(drawn)], figures)
    return path


def _empty_own() -> pl.DataFrame:
    texts, numbers = ("dataset", "vehicle", "terrain", "zone"), ("energy", "complexity", "value")
    schema = dict.fromkeys(texts, pl.String()) | dict.fromkeys(numbers, pl.Float64()) | {"runs": pl.Int64()}
    return pl.DataFrame(schema=pl.Schema(schema))
