"""Deployments as points of the map: kinetic energy against terrain complexity."""

from dataclasses import dataclass

import polars as pl

from pipeline.fleet.measures import Measure
from pipeline.fleet.terrain import complexity, rate_name

LOW_STATUSES = ("unconfirmed", "inferred", "placeholder", "second-hand")
ZONES: tuple[tuple[str, float], ...] = (("low", 3.5), ("medium", 4.8), ("high", float("inf")))
"""Risk zones end where log10(energy / J) + complexity / 10 passes these. A convention that puts the three
deployments which Samson et al. 2024 call high-risk (Djeumou, Triest, Han), and no other of theirs that can be
placed surely, into the last."""


def place_deployments(deployments: pl.DataFrame) -> pl.DataFrame:
    """Points of the map; rows without energy or complexity are left out, never guessed.

    Args:
        deployments: a table of deployments.

    Returns:
        ``key``, ``vehicle``, ``terrain``, ``model_type``, ``energy`` [J], ``complexity``, ``bound``,
        ``sure`` (nothing of mass and speed is unconfirmed, inferred or second-hand), ``zone``, ``year``.
    """
    doubtful = [
        pl.col(f"{name}_status").cast(pl.String).is_in(LOW_STATUSES) for name in ("mass", "speed")
    ] + [
        pl.col("scores_status").cast(pl.String) == "placeholder",
        pl.col("kinetic_energy_bound") == "uncertain",
    ]
    return (
        deployments.with_columns(complexity())
        .filter(pl.col("complexity").is_not_null(), pl.col("kinetic_energy_j") > 0.0)
        .select(
            "key",
            "year",
            pl.col("vehicle").fill_null("vehicle unknown"),
            pl.col("terrain").fill_null("terrain unknown"),
            pl.col("model_type").cast(pl.String).fill_null("unknown"),
            pl.col("kinetic_energy_j").alias("energy"),
            "complexity",
            pl.col("kinetic_energy_bound").cast(pl.String).alias("bound"),
            (~pl.any_horizontal(doubtful)).alias("sure"),
        )
        .with_columns(_name_zone())
        .sort("year", "key")
    )


def place_datasets(datasets: pl.DataFrame, column: str) -> tuple[pl.DataFrame, list[str]]:
    """Own datasets as points of the map, and why some are not on it.

    Args:
        datasets: table `datasets` of one input.
        column: of it, which is put into ``value``.
    """
    placed = datasets.with_columns(
        pl.col("terrain").map_elements(rate_name, return_dtype=pl.Float64).alias("complexity")
    )
    notes = []
    unknown = placed.filter(pl.col("complexity").is_null())["dataset"].to_list()
    if unknown:
        notes.append(f"not on the map, because the scale does not know their terrain: {', '.join(unknown)}")
    weightless = placed.filter(pl.col("largest_kinetic_energy").is_null())["dataset"].to_list()
    if weightless:
        notes.append(f"not on the map, because the mass is not known: {', '.join(weightless)}")
    points = placed.filter(pl.col("complexity").is_not_null(), pl.col("largest_kinetic_energy") > 0.0)
    return (
        points.select(
            "dataset",
            "vehicle",
            "terrain",
            "runs",
            pl.col("largest_kinetic_energy").alias("energy"),
            "complexity",
            pl.col(column).alias("value"),
        ).with_columns(_name_zone()),
        notes,
    )


def _name_zone() -> pl.Expr:
    risk = pl.col("energy").log10() + pl.col("complexity") / 10.0
    named = pl.lit(ZONES[-1][0])
    for name, end in reversed(ZONES[:-1]):
        named = pl.when(risk < end).then(pl.lit(name)).otherwise(named)
    return named.alias("zone")


@dataclass(frozen=True)
class DeploymentMap:
    """The map as tables.

    Attributes:
        deployments: the table of deployments.
        points: those that can be placed.
        own: own datasets that can be placed.
        keys: run/generation of the runs of every own dataset.
        notes: what is not on the map, and why.
        input: what u is of the own datasets.
        measure: what colours them.
    """

    deployments: pl.DataFrame
    points: pl.DataFrame
    own: pl.DataFrame
    keys: tuple[str, ...]
    notes: tuple[str, ...]
    input: str
    measure: Measure
