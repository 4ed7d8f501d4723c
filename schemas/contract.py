"""What a contract is, and where contracts are found."""

import functools
import importlib
import pkgutil
from dataclasses import dataclass
from typing import Any, ClassVar

import dataframely as dy

import schemas


class Table(dy.Schema):
    """Columns that every table has: which run a row belongs to.

    The table is called as the class, in small letters.
    """

    VERSION: ClassVar[int]

    run = dy.String(metadata={"description": "run the row belongs to"})
    dataset = dy.String(metadata={"description": "runs of one vehicle on one terrain"})
    vehicle = dy.String(metadata={"description": "vehicle name"})
    terrain = dy.String(metadata={"description": "terrain name, `unknown` when nobody said"})


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
        found: dict[str, Any] = self.schema.columns()[column].metadata or {}
        return {key: str(value) for key, value in found.items()}


@functools.cache
def list_contracts() -> tuple[Contract, ...]:
    """All contracts of this folder, sorted by name."""
    found = []
    for module in pkgutil.iter_modules(schemas.__path__):
        if module.name == "contract":
            continue
        content = vars(importlib.import_module(f"schemas.{module.name}"))
        found += [
            Contract(table.__name__.lower(), table.VERSION, table)
            for table in content.values()
            if isinstance(table, type) and issubclass(table, Table) and "VERSION" in vars(table)
        ]
    return tuple(sorted(found, key=lambda contract: contract.name))


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
