"""The contract of every table: columns, types, units, frames and rules.

A table is a subclass of `Table` with a ``VERSION``, called as the class; it is found by being in this
folder. Units and frames stand in the columns' metadata and reach the Parquet files from there.
"""

import functools
import importlib
import pkgutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import dataframely as dy
import polars as pl

LARGEST_NS = 2**62


def source(description: str = "input u: the command or the measured wheels") -> dy.Enum:
    """Which input a row speaks of."""
    return choice(("command", "measured"), description)


def choice(words: Sequence[str], description: str) -> dy.Enum:
    """One of some words, never null."""
    return dy.Enum(words, metadata={"description": description})


def count(description: str, least: int = 0, *, nullable: bool = False) -> dy.Int64:
    """A whole number."""
    return dy.Int64(min=least, nullable=nullable, metadata={"description": description})


def name(description: str) -> dy.String:
    """A text that is never empty."""
    return dy.String(min_length=1, metadata={"description": description})


def stamp(frame: str = "log clock", description: str = "stamp of the sample") -> dy.Int64:
    """Time stamp, in the clock of the log if no other is said."""
    metadata = {"unit": "ns", "frame": frame, "description": description}
    return dy.Int64(min=-LARGEST_NS, max=LARGEST_NS, metadata=metadata)


def log_time() -> dy.Int64:
    """When the recorder wrote the message."""
    return stamp("recorder clock", "log time of the message")


def seconds(description: str = "time since the run's first sample") -> dy.Float64:
    """Seconds since the start of the run."""
    return number("s", description, frame="log clock")


def number(unit: str, description: str, *, frame: str = "", nullable: bool = False) -> dy.Float64:
    """A finite number with a unit; null only where ``nullable`` says so."""
    metadata = {"unit": unit, "description": description}
    if frame:
        metadata["frame"] = frame
    return dy.Float64(nullable=nullable, check=lambda value: value.is_finite(), metadata=metadata)


optional = partial(number, nullable=True)
"""A finite number with a unit, or null."""


def vector(unit: str, description: str, frame: str, size: int = 3) -> Iterator[dy.Float64]:
    """The components of a vector in a frame."""
    return (number(unit, description, frame=frame) for _ in range(size))


def bounded(
    unit: str,
    description: str,
    low: float | None = None,
    high: float | None = None,
    *,
    nullable: bool = False,
) -> dy.Float64:
    """A number with a unit within what can be; one without bounds may be anything."""
    metadata = {"unit": unit, "description": description}
    return dy.Float64(nullable=nullable, min=low, max=high, metadata=metadata)


def body(unit: str, description: str, *, nullable: bool = False) -> dy.Float64:
    """A finite number in the body frame (x forward, y left, z up; REP-103)."""
    return number(unit, description, frame="base_link", nullable=nullable)


def text(description: str) -> dy.String:
    """A text that is always there, possibly empty."""
    return dy.String(metadata={"description": description})


def flag(description: str) -> dy.Bool:
    """Yes or no, never null."""
    return dy.Bool(metadata={"description": description})


def segment() -> dy.Int32:
    """Stretch without gap, clock jump or pose jump."""
    return dy.Int32(min=0, metadata={"description": "number of the segment; nothing crosses its ends"})


def step() -> dy.Int32:
    """Stretch of one command."""
    return dy.Int32(min=0, metadata={"description": "number of the command step within the run"})


def drive_is_complete() -> pl.Expr:
    """Either both wheel speeds or speed and steering angle are there."""
    wheels = pl.col("left").is_not_null() & pl.col("right").is_not_null()
    return wheels | (pl.col("speed").is_not_null() & pl.col("steering").is_not_null())


class Table(dy.Schema):
    """Columns that every table has: which run a row belongs to.

    The table is called as the class, in small letters.
    """

    VERSION: ClassVar[int]

    run = dy.String(metadata={"description": "run the row belongs to"})
    dataset = dy.String(metadata={"description": "runs of one vehicle on one terrain"})
    vehicle = dy.String(metadata={"description": "vehicle name"})
    terrain = dy.String(metadata={"description": "terrain name, `unknown` where none was given"})


@dataclass(frozen=True)
class Contract:
    """A table's contract as the store needs it.

    Attributes:
        name: table name, a plural noun; the file is ``<name>.parquet``.
        version: raised whenever a column or a rule changes its meaning.
        schema: the dataframely schema with columns and rules.
    """

    name: str
    version: int
    schema: type[Table]

    def metadata_of(self, column: str) -> dict[str, str]:
        """Unit, frame and description of a column; absent ones are left out."""
        metadata: dict[str, Any] = self.schema.columns()[column].metadata or {}
        return {key: str(value) for key, value in metadata.items()}


@functools.cache
def list_contracts() -> tuple[Contract, ...]:
    """All contracts of this folder, sorted by name."""
    contracts = []
    for module in pkgutil.iter_modules([str(Path(__file__).parent)]):
        content = vars(importlib.import_module(f"schemas.{module.name}"))
        contracts += [
            Contract(table.__name__.lower(), table.VERSION, table)
            for table in content.values()
            if isinstance(table, type) and issubclass(table, Table) and "VERSION" in vars(table)
        ]
    return tuple(sorted(contracts, key=lambda contract: contract.name))


def contract_of(name: str) -> Contract:
    """The contract of a table.

    Raises:
        KeyError: there is no such table; the message lists those there are.
    """
    for contract in list_contracts():
        if contract.name == name:
            return contract
    known = ", ".join(contract.name for contract in list_contracts())
    raise KeyError(f"no table is called {name!r}; there are: {known}")


def tabulate(table: str, rows: Iterable[Mapping[str, object]]) -> pl.DataFrame:
    """Rows as a table, without the columns that every table has; missing values are null."""
    kinds = contract_of(table).schema.create_empty().schema
    own = {name: kind for name, kind in kinds.items() if name not in Table.column_names()}
    return pl.DataFrame(list(rows), schema=own, orient="row")
