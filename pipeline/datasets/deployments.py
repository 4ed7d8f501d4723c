"""Deployments of the literature and own datasets: kinetic energy against terrain complexity."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from pipeline.datasets.compared_runs import choose_input, find_material, measure_runs
from pipeline.datasets.pooling import MEASURES, ComparisonError, Measure, pool_runs
from pipeline.store import Store
from schemas import Deployments

_SCORES = {"slope_score": 0.5, "roughness_score": 0.5, "sinkage_score": 0.7, "friction_score": 0.6}
"""Scores from 0 to 4 of slope S, roughness R (classes of ISO 8608), sinkage over wheel radius H and friction
F, and how much of the ease of a terrain the largest score takes:

    C = 10 [1 - (1 - .5 S/4)(1 - .5 R/4)(1 - .7 H/4)(1 - .6 F/4)]

The weights were chosen to reproduce the order of Samson et al. 2024: they are a convention, not evidence."""
_HIGHEST = 4.0
"""Largest score."""
_TERRAINS: dict[str, tuple[float, float, float, float]] = {
    **dict.fromkeys(("asphalt", "concrete"), (0, 0, 0, 0)),
    **dict.fromkeys(("tile", "indoor", "wetasphalt"), (0, 0, 0, 1)),
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
"""Scores of flat stretches of common terrains, for own runs."""
_DOUBTFUL = ("unconfirmed", "inferred", "placeholder", "second-hand")


def rate_terrains(scores: pl.DataFrame) -> pl.Series:
    """Complexity from 0 (flat dry asphalt) to 9.7 (all scores 4) of rows of scores; null without them."""
    ease = pl.lit(1.0)
    for name, weight in _SCORES.items():
        ease = ease * (1.0 - weight * pl.col(name) / _HIGHEST)
    return scores.select((10.0 * (1.0 - ease)).alias("complexity")).to_series()


def rate_names(terrains: Sequence[str]) -> pl.Series:
    """Complexity of terrains by their names, ignoring case, spaces and dashes; null for unknown names."""
    unknown = (None,) * len(_SCORES)
    rows = [_TERRAINS.get(re.sub(r"[^a-z]", "", name.lower()), unknown) for name in terrains]
    return rate_terrains(pl.DataFrame(rows, schema=dict.fromkeys(_SCORES, pl.Float64), orient="row"))


@dataclass(frozen=True)
class DeploymentMap:
    """Deployments by energy and complexity.

    Attributes:
        points: of the literature: ``key``, ``vehicle``, ``terrain``, ``energy`` [J], ``complexity``,
            ``bound``, ``sure`` (mass, speed and terrain are known well), ``title``, ``year``.
        own: own datasets: ``dataset``, ``vehicle``, ``terrain``, ``runs``, ``energy``,
            ``complexity``, ``value``.
        missing: deployments whose energy or complexity is not published.
        notes: what is not on the map, and why.
        keys: run/generation of the own runs.
        input: input u of the own datasets.
        measure: what ``value`` is.
    """

    points: pl.DataFrame
    own: pl.DataFrame
    missing: tuple[str, ...]
    notes: tuple[str, ...]
    keys: tuple[str, ...]
    input: str
    measure: Measure


def draw_up_map(
    store: Store, table: Path | None = None, *, fed: str | None = None, show: str = "slip"
) -> DeploymentMap:
    """Map the deployments of the literature and the datasets of the results.

    Args:
        store: the results; may be empty.
        table: a table of deployments; by default the project's own.
        fed: input u; None: as `compare_results` chooses it.
        show: key of `MEASURES` for the value of own datasets.

    Raises:
        ComparisonError: the table does not exist or breaks its schema.
    """
    deployments = read_deployments(table or find_own_table())
    is_placed = pl.col("complexity").is_not_null() & (pl.col("energy") > 0.0)
    known = [~pl.col(f"{name}_status").cast(pl.String).is_in(_DOUBTFUL) for name in ("mass", "speed")]
    known += [pl.col("scores_status") != "placeholder", pl.col("kinetic_energy_bound") != "uncertain"]
    rated = deployments.with_columns(
        rate_terrains(deployments),
        pl.col("kinetic_energy_j").alias("energy"),
        pl.col("kinetic_energy_bound").cast(pl.String).alias("bound"),
        pl.all_horizontal(one.fill_null(value=True) for one in known).alias("sure"),
    )
    columns = ("key", "vehicle", "terrain", "energy", "complexity", "bound", "sure", "title", "year")
    points = rated.filter(is_placed).select(columns).sort("year", "key")
    missing = rated.filter(is_placed.not_().fill_null(value=True))["key"].to_list()
    compared, runs, _ = measure_runs(find_material(store, ("dataset",), trusted_only=True))
    chosen = fed or ("command" if runs.is_empty() else choose_input(runs))
    notes, measure = [*compared.count_omitted(len(compared.keys)), *compared.notes], MEASURES[show]
    kinds = dict.fromkeys(("dataset", "vehicle", "terrain"), pl.String) | {"runs": pl.Int64}
    own = pl.DataFrame(schema=kinds | dict.fromkeys(("energy", "complexity", "value"), pl.Float64))
    if not runs.is_empty():
        pooled = pool_runs(runs, ("dataset",)).filter(pl.col("input").cast(pl.String) == chosen)
        all_own = pooled.select(
            *kinds,
            pl.col("largest_kinetic_energy").alias("energy"),
            rate_names(pooled["terrain"].to_list()),
            pl.col(measure.column).alias("value"),
        )
        for column, why in (
            ("complexity", "their terrain is not on the complexity scale"),
            ("energy", "the mass is not known"),
        ):
            lacking = all_own.filter(pl.col(column).is_null())["dataset"].to_list()
            notes += [f"not on the map, because {why}: {', '.join(lacking)}"] if lacking else []
        own = all_own.filter(is_placed).sort("energy", descending=True)
    return DeploymentMap(points, own, tuple(missing), tuple(notes), compared.keys, chosen, measure)


_NAME = "deployments.csv"


def find_own_table() -> Path:
    """Path of the project's own table: in the repository, or beside this module of an installed package.

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
    schema, where = Deployments.create_empty().schema, str(path)
    try:
        text = pl.read_csv(path, infer_schema=False)
    except FileNotFoundError as error:
        what = "there is no such table"
        raise ComparisonError("no_deployments", what, where=where, hint="Give a CSV file") from error
    except (pl.exceptions.PolarsError, OSError, UnicodeDecodeError) as error:
        what = f"the table cannot be read: {str(error).splitlines()[0]}"
        hint = "Write it as CSV, UTF-8, with a line of names"
        raise ComparisonError("bad_deployments", what, where=where, hint=hint) from error
    if unknown := [name for name in text.columns if name not in schema]:
        what, hint = f"unknown columns: {', '.join(unknown)}", f"The columns are: {', '.join(schema)}"
        raise ComparisonError("bad_deployments", what, where=where, hint=hint)
    missing = [pl.lit(None, pl.String).alias(name) for name in schema if name not in text.columns]
    given = text.with_columns(*missing).select(pl.col(name).replace("", None) for name in schema)
    typed = given.cast(schema, strict=False)
    lost = [
        f"{name} of {key!r} is {value!r}"
        for name in text.columns
        for key, value in given.filter(given[name].is_not_null() & typed[name].is_null())
        .select("key", pl.col(name).alias("value"))
        .iter_rows()
    ]
    valid, failure = Deployments.filter(typed)
    if len(failure):
        keys = ", ".join(failure.invalid()["key"].fill_null("?").unique().sort())
        lost = lost or [f"{keys} break {'; '.join(sorted(failure.counts()))}"]
    if lost:
        what = f"rows break the schema: {'; '.join(lost[:5])}"
        hint = "Correct them; every value needs a status; schemas/__init__.py says what columns mean"
        raise ComparisonError("bad_deployments", what, where=where, hint=hint)
    return valid
