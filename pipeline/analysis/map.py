"""The deployment map: the literature with the user's own datasets on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import polars as pl

from pipeline.analysis.compared_runs import find_material
from pipeline.fleet import add_measures, gather_runs, measure_difficulty, pool_runs
from pipeline.fleet.deployments import find_own_table, read_deployments
from pipeline.fleet.place import place_datasets, place_deployments

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.analysis.options import FigureFormat
    from pipeline.store import Store


@dataclass(frozen=True)
class DeploymentMap:
    """The map as tables.

    Attributes:
        deployments: the table of deployments.
        points: those that can be placed.
        own: own datasets that can be placed.
        keys: run/generation of the runs of every own dataset.
        notes: what is not on the map, and why.
    """

    deployments: pl.DataFrame
    points: pl.DataFrame
    own: pl.DataFrame
    keys: tuple[str, ...]
    notes: tuple[str, ...]


def draw_up_map(store: Store, table: Path | None = None) -> DeploymentMap:
    """Place the literature and the results' datasets (slip on the measured wheels where there are any).

    Args:
        store: the results; may be empty.
        table: a table of deployments; by default the project's own.

    Raises:
        ComparisonError: the table is not there or breaks its schema.
    """
    deployments = read_deployments(table or find_own_table())
    compared = find_material(store, ("dataset",), trusted_only=True)
    datasets = pl.DataFrame()
    if compared.manifests:
        names = list(compared.manifests)
        runs = gather_runs(
            compared.scan("aggregates").filter(pl.col("run").is_in(names)).collect(), compared.labels
        )
        scales = runs.unique("run").select("run", "length_scale")
        vehicles = compared.labels.select("run", "mass", "inertia").join(scales, on="run")
        slip = compared.scan("slip").filter(pl.col("run").is_in(names))
        datasets = pool_runs(add_measures(runs, measure_difficulty(slip, vehicles)), ("dataset",))
    own, notes = _empty_own(), list(compared.notes)
    keys: tuple[str, ...] = ()
    if not datasets.is_empty():
        # On measured wheels, slip is what the ground did; the drivetrain's share would move with the command.
        chosen = datasets.sort("input", descending=True).unique("dataset", keep="first").sort("dataset")
        own, told = place_datasets(chosen)
        notes += told
        keys = tuple(f"{row['dataset']}: {row['keys']}" for row in chosen.iter_rows(named=True))
    return DeploymentMap(deployments, place_deployments(deployments), own, keys, tuple(notes))


def write_map(store: Store, drawn: DeploymentMap, figures: FigureFormat | None = None) -> Path:
    """Write `map.html`, and the figure for papers where a format is given; the path of the page."""
    from pipeline.report.deployments import picture_map, render_map  # noqa: PLC0415 - heavy
    from pipeline.report.pages import write_page  # noqa: PLC0415 - heavy

    page = render_map(drawn.deployments, drawn.points, drawn.own, notes=drawn.notes, keys=drawn.keys)
    path = write_page(store, "map.html", page)
    if figures:
        from pipeline.report.export import write_pictures  # noqa: PLC0415 - heavy

        write_pictures([picture_map(drawn.points, drawn.own)], store.root / "figures", figures)
    return path


def _empty_own() -> pl.DataFrame:
    texts, numbers = ("dataset", "vehicle", "terrain", "zone"), ("energy", "complexity", "slip")
    schema = dict.fromkeys(texts, pl.String()) | dict.fromkeys(numbers, pl.Float64()) | {"runs": pl.Int64()}
    return pl.DataFrame(schema=pl.Schema(schema))
