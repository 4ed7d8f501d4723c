"""Deployments of the literature and own ones: their position on the map of energy against terrain."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from pipeline.datasets.compared_runs import choose_input, find_material, measure_runs, read_digest
from pipeline.datasets.pooling import MEASURES, ComparisonError, Measure, pool_runs
from pipeline.store import Store
from schemas import Deployments

# Scale of terrain complexity, so that two people rate the same terrain alike.
#
#     C = 10 [1 - (1 - .5 S/4)(1 - .5 R/4)(1 - .7 H/4)(1 - .6 F/4)]
#
# with four scores from 0 to 4: slope S, roughness R (classes of ISO 8608), sinkage over wheel radius H, peak
# friction F. The limits of the scores are in `schemas`. The weights were chosen to reproduce
# the order of Samson et al. 2024: they are a convention, not evidence. With weights varied by 30 % the median
# Kendall tau to that order is 0.93.

SCORES = ("slope_score", "roughness_score", "sinkage_score", "friction_score")
_WEIGHTS = (0.5, 0.5, 0.7, 0.6)
"""Weights of slope, roughness, sinkage and friction: chosen, see above. They set the largest complexity."""
_HIGHEST = 4.0
"""Largest score."""

TERRAINS: dict[str, tuple[float, float, float, float]] = {
    "asphalt": (0, 0, 0, 0),
    "concrete": (0, 0, 0, 0),
    "tile": (0, 0, 0, 1),
    "indoor": (0, 0, 0, 1),
    "wetasphalt": (0, 0, 0, 1),
    "dirt": (0, 0, 1, 1),
    "gravel": (0, 1, 1, 1),
    "grass": (0, 1, 1, 2),
    "wetgrass": (0, 1, 1, 3),
    "ice": (0, 0, 0, 4),
    "sand": (0, 0, 3, 2),
    "snow": (0, 1, 2, 3),
    "mud": (0, 1, 3, 3),
    "forest": (1, 3, 2, 2),
    "deepsnow": (3, 2, 4, 3),
}
"""Scores of flat stretches of common terrains, for runs without given scores."""


def rate_terrain(slope: float, roughness: float, sinkage: float, friction: float) -> float:
    """Complexity from 0 (flat dry asphalt) to 9.7 (all scores 4).

    Args:
        slope: score S, 0 to 4.
        roughness: score R, 0 to 4.
        sinkage: score H, 0 to 4.
        friction: score F, 0 to 4.
    """
    ease = 1.0
    for weight, score in zip(_WEIGHTS, (slope, roughness, sinkage, friction), strict=True):
        ease *= 1.0 - weight * score / _HIGHEST
    return 10.0 * (1.0 - ease)


def rate_name(terrain: str) -> float | None:
    """Complexity of a terrain by its name, ignoring case, spaces and dashes; None for unknown names."""
    scores = TERRAINS.get(re.sub(r"[^a-z]", "", terrain.lower()))
    return None if scores is None else rate_terrain(*scores)


def complexity() -> pl.Expr:
    """Expression of the complexity for a table with the columns `SCORES`; null where a score is."""
    ease = pl.lit(1.0)
    for weight, name in zip(_WEIGHTS, SCORES, strict=True):
        ease = ease * (1.0 - weight * pl.col(name) / _HIGHEST)
    return (10.0 * (1.0 - ease)).alias("complexity")


LOW_STATUSES = ("unconfirmed", "inferred", "placeholder", "second-hand")
ZONES: tuple[tuple[str, float], ...] = (("low", 3.5), ("medium", 4.8), ("high", float("inf")))
"""Upper bounds of the risk zones in log10(energy / J) + complexity / 10. A convention: the three deployments
that Samson et al. 2024 call high-risk (Djeumou, Triest, Han), and no other of theirs with a reliable
position, fall into the last zone."""


def rank_deployments(deployments: pl.DataFrame) -> pl.DataFrame:
    """Points of the map; rows without energy or complexity are omitted.

    Args:
        deployments: a table of deployments.

    Returns:
        ``key``, ``vehicle``, ``terrain``, ``model_type``, ``energy`` [J], ``complexity``, ``bound``,
        ``sure`` (neither mass nor speed is unconfirmed, inferred or second-hand), ``zone``, ``year``.
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


def rank_datasets(datasets: pl.DataFrame, column: str) -> tuple[pl.DataFrame, list[str]]:
    """Own datasets as points of the map, and the reasons why others are not on it.

    Args:
        datasets: table `datasets` of one input.
        column: column to be copied into ``value``.
    """
    placed = datasets.with_columns(
        pl.col("terrain").map_elements(rate_name, return_dtype=pl.Float64).alias("complexity")
    )
    notes = []
    unknown = placed.filter(pl.col("complexity").is_null())["dataset"].to_list()
    if unknown:
        notes.append(
            f"not on the map, because their terrain is not on the complexity scale: {', '.join(unknown)}"
        )
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
    """Map of deployments as tables.

    Attributes:
        deployments: the table of deployments.
        points: those with a position on the map.
        own: own datasets with a position on the map.
        keys: run/generation of the runs of every own dataset.
        notes: what is not on the map, and why.
        input: input u of the own datasets.
        measure: measure shown by their colour.
    """

    deployments: pl.DataFrame
    points: pl.DataFrame
    own: pl.DataFrame
    keys: tuple[str, ...]
    notes: tuple[str, ...]
    input: str
    measure: Measure


# Table of deployments: read and checked.
#
# The project's own table is `data_samples/deployments.csv` in the repository; an installed package has it
# beside this module.

_NAME = "deployments.csv"


def find_own_table() -> Path:
    """Path of the project's own table.

    Raises:
        ComparisonError: ``no_deployments``, the installation lacks it.
    """
    places = (Path(__file__).with_name(_NAME), Path(__file__).parents[2] / "data_samples" / _NAME)
    for path in places:
        if path.is_file():
            return path
    what = "the project's table of deployments is not installed"
    hint = "Install the package again, or give a table with --deployments"
    raise ComparisonError("no_deployments", what, where=str(places[0]), hint=hint)


def read_deployments(path: Path) -> pl.DataFrame:
    """Read a table of deployments and check it against its schema; missing columns are empty.

    Args:
        path: a CSV file with a header line.

    Raises:
        ComparisonError: ``no_deployments``, ``bad_deployments`` (which row, which rule).
    """
    try:
        text = pl.read_csv(path, infer_schema=False)
    except FileNotFoundError as error:
        raise ComparisonError(
            "no_deployments", "there is no such table", where=str(path), hint="Give a CSV file"
        ) from error
    except (pl.exceptions.PolarsError, OSError, UnicodeDecodeError) as error:
        what = f"the table cannot be read: {str(error).splitlines()[0]}"
        raise _refuse(what, str(path), "Write it as CSV, UTF-8, with a line of names") from error
    return _check(text, str(path))


def _check(text: pl.DataFrame, where: str) -> pl.DataFrame:
    """Convert text columns to the schema's types; every row that breaks the schema is an error."""
    schema = Deployments.create_empty().schema
    unknown = [name for name in text.columns if name not in schema]
    if unknown:
        hint = f"The columns are: {', '.join(schema)}"
        raise _refuse(f"unknown columns: {', '.join(unknown)}", where, hint)
    typed = text.select(
        (pl.col(name).replace("", None) if name in text.columns else pl.lit(None, pl.String))
        .cast(kind, strict=False)
        .alias(name)
        for name, kind in schema.items()
    )
    lost = [
        f"{name} of {key!r} is {value!r}"
        for name in text.columns
        for key, value in text.filter(pl.col(name).replace("", None).is_not_null() & typed[name].is_null())
        .select(
            pl.col("key") if "key" in text.columns else pl.lit("?").alias("key"), pl.col(name).alias("value")
        )
        .iter_rows()
    ]
    valid, failure = Deployments.filter(typed)
    keys = ", ".join(failure.invalid()["key"].fill_null("?").unique().sort())
    broken = [f"{keys} break {'; '.join(sorted(failure.counts()))}"]
    if lost or len(failure):
        hint = "Correct them; every value needs a status; schemas/__init__.py says what columns mean"
        raise _refuse(f"rows break the schema: {'; '.join((lost or broken)[:5])}", where, hint)
    return valid


def _refuse(what: str, where: str, hint: str) -> ComparisonError:
    return ComparisonError("bad_deployments", what, where=where, hint=hint)


_SHARED = " (shared)"


def draw_up_map(
    store: Store,
    table: Path | None = None,
    *,
    fed: str | None = None,
    show: str = "slip",
    shared: pl.DataFrame | None = None,
) -> DeploymentMap:
    """Map the deployments of the literature and the datasets of the results.

    Args:
        store: the results; may be empty.
        table: a table of deployments; by default the project's own.
        fed: input u; None: as `compare_results` chooses it.
        show: key of `MEASURES` for the colour of the datasets.
        shared: table `features` of others; runs of the results' own logs are dropped from it.

    Raises:
        ComparisonError: the table does not exist or violates its schema.
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
        own, comments = rank_datasets(datasets, MEASURES[show].column)
        notes += comments
        if shared is not None:
            notes.append(_count_shared(shared, own_logs, own))
        keys = tuple(f"{row['dataset']}: {row['keys']}" for row in datasets.iter_rows(named=True))
    return DeploymentMap(
        deployments, rank_deployments(deployments), own, keys, tuple(notes), chosen, MEASURES[show]
    )


def _pool_shared(features: pl.DataFrame, own: Sequence[str]) -> pl.DataFrame:
    others = features.filter(~pl.col("sha256").is_in(list(own))).with_columns(
        pl.format("{}" + _SHARED, "dataset").alias("group"),
        pl.col("from_results").alias("key"),
        pl.lit(None, pl.Float64).alias("published_norm"),
        pl.lit(None, pl.Float64).alias("equal_modulus"),
    )
    return pool_runs(others, ("dataset",))


def _count_shared(features: pl.DataFrame, own_logs: Sequence[str], placed: pl.DataFrame) -> str:
    """Text with the number of shared runs on the map."""
    digests = features["sha256"].unique()
    drawn = placed.filter(pl.col("dataset").str.ends_with(_SHARED))["runs"].sum()
    twice = digests.is_in(list(own_logs)).sum()
    known = f"; {twice} of them are of your own logs and count once" if twice else ""
    return f"{drawn} of {digests.len()} shared runs drawn{known}"


def _empty_own() -> pl.DataFrame:
    texts, numbers = ("dataset", "vehicle", "terrain", "zone"), ("energy", "complexity", "value")
    schema = dict.fromkeys(texts, pl.String()) | dict.fromkeys(numbers, pl.Float64()) | {"runs": pl.Int64()}
    return pl.DataFrame(schema=pl.Schema(schema))
