"""The table of deployments: read, checked, added to, merged. The start of a shared database.

The project's own table is `data_samples/deployments.csv` in the repository; an installed package carries it
beside this module.
"""

import tomllib
from pathlib import Path

import polars as pl

from pipeline.core.errors import naming_os_errors
from pipeline.core.tables import format_csv, unquote_formulas
from pipeline.fleet.errors import ComparisonError
from schemas.deployments import Deployments

_NAME = "deployments.csv"
_DIGITS = 6


def find_own_table() -> Path:
    """Where the project's own table is.

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
    """A table of deployments, checked against its schema; columns may be missing, they are empty then.

    Args:
        path: a CSV file with a line of names.

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
    return _check(unquote_formulas(text), str(path))


def add_deployment(table: Path, entry: Path) -> pl.DataFrame:
    """The table with the deployment of a TOML file behind its last row; nothing is written.

    Args:
        table: a CSV file; need not exist yet.
        entry: a TOML file whose keys are columns of the table.

    Raises:
        ComparisonError: ``bad_deployment``; ``bad_deployments``: it breaks the schema, or its key is taken.
    """
    try:
        content = tomllib.loads(entry.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        what = f"the deployment cannot be read: {error}"
        hint = "Write one line `column = value` for each column known; key, year and drive are needed"
        raise ComparisonError("bad_deployment", what, where=str(entry), hint=hint) from error
    row = pl.DataFrame({name: [str(value)] for name, value in content.items()})
    there = (
        read_deployments(table)
        if table.exists()
        else _check(pl.DataFrame(schema={"key": pl.String}), str(table))
    )
    added = _check(_complete_energy(row), str(entry))
    return _join([there, added], f"{table} and {entry}")


def merge_deployments(first: Path, second: Path) -> pl.DataFrame:
    """Two tables as one, sorted by year and key; rows that are the same in both count once.

    Raises:
        ComparisonError: ``bad_deployments``, for example the same key with other values.
    """
    merged = _join([read_deployments(first), read_deployments(second)], f"{first} and {second}")
    return merged.sort("year", "key")


def write_deployments(frame: pl.DataFrame, path: Path) -> None:
    """Write a table as CSV in the place of the one before.

    Raises:
        ComparisonError: ``not_written``, the file cannot be written.
    """
    from pipeline.store.files import replace_file  # noqa: PLC0415 - heavy

    plain = frame.with_columns(pl.col(pl.Float64).round_sig_figs(_DIGITS))
    what, hint = "the table cannot be written", "Choose another file"
    with naming_os_errors(ComparisonError, "not_written", what, where=path, hint=hint):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, format_csv(plain).encode())


def _check(text: pl.DataFrame, where: str) -> pl.DataFrame:
    """Texts as the schema's types; every row that breaks it is an error."""
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
        hint = "Mend them; every value needs a status; schemas/deployments.py says what columns mean"
        raise _refuse(f"rows break the schema: {'; '.join((lost or broken)[:5])}", where, hint)
    return valid


def _complete_energy(row: pl.DataFrame) -> pl.DataFrame:
    """Kinetic energy from mass and speed where it is not given."""
    if "kinetic_energy_j" in row.columns or not {"mass_kg", "speed_mps"} <= set(row.columns):
        return row
    mass, speed = (pl.col(name).cast(pl.Float64, strict=False) for name in ("mass_kg", "speed_mps"))
    energy = (0.5 * mass * speed**2).cast(pl.String).alias("kinetic_energy_j")
    bound = pl.lit("value").alias("kinetic_energy_bound")
    return (
        row.with_columns(energy) if "kinetic_energy_bound" in row.columns else row.with_columns(energy, bound)
    )


def _join(tables: list[pl.DataFrame], where: str) -> pl.DataFrame:
    joined = pl.concat(tables).unique(maintain_order=True)
    twice = joined.filter(pl.col("key").is_duplicated())["key"].unique().sort().to_list()
    if twice:
        what = f"the same key stands for different deployments: {', '.join(twice)}"
        raise _refuse(what, where, "Give one of them another key, or make the rows agree")
    return joined


def _refuse(what: str, where: str, hint: str) -> ComparisonError:
    return ComparisonError("bad_deployments", what, where=where, hint=hint)
