"""Tables against their contracts, as Parquet bytes that carry units and frames, and questions over all runs.

polars drops field metadata when it rewrites a file, so the Arrow schema is built here from the contract and
pyarrow writes it. This module is heavy to import; the rest of the room does so only where tables are touched.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import polars as pl
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from dataframely import FailureInfo

from pipeline.store.names import (
    NO_FACTS,
    QUARANTINE,
    StoreError,
    TableEntry,
    name_damage,
    table_damaged,
)
from schemas import Contract, contract_of, list_contracts

BROKEN_RULES = "broken_rules"

# Arrow's own pool keeps 20 MB of what it freed; tables are made at once, not piecemeal.
pa.set_memory_pool(pa.system_memory_pool())

_ROWS_PER_GROUP = 1 << 17
_ZSTD_LEVEL = 3

_MOST_ROWS_PER_BYTE = 2
"""Of a table's file. The windows of a run ten hours long have 0.22, a clock without anything beside it 0.16:
what has more was made to fill memory, whatever its manifest says."""

_MOST_BYTES_PER_ROW = 2048
_SPARE_BYTES = 64 << 20
"""Of what a table's columns inflate to: a row of the widest contract has 500 bytes, a finding's text 1 kB."""

_WIDTH = 8
"""Bytes of a number, or of the place of a text."""

_LONGEST_NAME_BYTES = 1 << 20
_MOST_PARTS = 1 << 20
"""Of what the end of a Parquet file lists: a table of a season has thousands."""

_ABOUT_BROKEN_RULES = {"description": "rules of the contract that the row breaks"}


@dataclass(frozen=True, kw_only=True)
class CheckedTable:
    """A frame split by its contract.

    Attributes:
        contract: the contract it was held against.
        valid: the rows that keep it.
        broken: the rows that break it, with `BROKEN_RULES`; None when there are none.
        report: the counts.
        facts: numbers of the whole table.
    """

    contract: Contract
    valid: pl.DataFrame
    broken: pl.DataFrame | None
    report: TableEntry
    facts: Mapping[str, float] = field(default_factory=dict)

    def encode(self) -> tuple[bytes, bytes | None]:
        """Parquet bytes of the rows that keep the contract, and of those that break it."""
        broken = None if self.broken is None else encode_parquet(self.contract, self.broken, self.facts)
        return encode_parquet(self.contract, self.valid, self.facts), broken


def find_contract(name: str) -> Contract:
    """The contract of a table.

    Raises:
        StoreError: ``no_such_table``, the message lists those there are.
    """
    try:
        return contract_of(name)
    except KeyError as error:
        known = ", ".join(contract.name for contract in list_contracts())
        raise StoreError(
            "no_such_table", f"no table is called {name!r}", hint=f"The tables are: {known}"
        ) from error


def schema_of(name: str) -> pl.Schema:
    """Columns and types of a table or of its quarantine (``quarantine_<table>``).

    Raises:
        StoreError: ``no_such_table``.
    """
    schema = _list_columns(find_contract(name.removeprefix(QUARANTINE)))
    if name.startswith(QUARANTINE):
        return pl.Schema({**schema, BROKEN_RULES: pl.List(pl.String())})
    return pl.Schema(schema)


def is_of_contract(name: str, version: int, schema: pl.Schema) -> bool:
    """Whether a stored table has the columns that its contract gives it.

    Args:
        name: of the table.
        version: of the contract under which it was written; only of the present one the columns are known.
        schema: columns and types that were found.

    Raises:
        StoreError: ``no_such_table``.
    """
    return version != find_contract(name).version or schema == schema_of(name)


def check_size(path: Path, rows: int | None) -> None:
    """Hold the rows and bytes of a table against its manifest and its file, before any row is handed out.

    Args:
        path: the Parquet file.
        rows: as the manifest has it; None where no manifest speaks of the file.

    Raises:
        StoreError: ``file_missing`` or ``table_damaged``.
    """
    with name_damage(path):
        size = path.stat().st_size
        with pq.ParquetFile(
            path,
            thrift_string_size_limit=_LONGEST_NAME_BYTES,
            thrift_container_size_limit=_MOST_PARTS,
            pre_buffer=False,
        ) as file:
            about = file.metadata
            groups = [about.row_group(group) for group in range(about.num_row_groups)]
            # What is read is what the parts say, whatever the file says of itself.
            rows_read = max(
                about.num_rows,
                sum(group.num_rows for group in groups),
                *(
                    sum(group.column(column).num_values for group in groups)
                    for column in range(about.num_columns)
                    if about.schema.column(column).max_repetition_level == 0
                ),
            )
    if rows is not None and rows_read != rows:
        raise table_damaged(f"it has {rows_read} rows, its manifest says {rows}", path)
    if rows_read > _MOST_ROWS_PER_BYTE * size:
        raise table_damaged(f"{rows_read} rows cannot stand in {size} bytes", path)
    most = _SPARE_BYTES + _MOST_BYTES_PER_ROW * rows_read
    with name_damage(path):
        inflated = 0
        for part in _list_inflated(path, about):
            inflated += part
            if inflated > most:
                break
    if inflated > most:
        what = (
            f"its {rows_read} rows inflate to more than {most >> 20} MB, more than any table that slip writes"
        )
        raise table_damaged(what, path)


def _list_inflated(path: Path, about: pq.FileMetaData) -> Iterator[int]:
    """Bytes that the columns of a table inflate to: first as its metadata say, then of its texts.

    Pages name a text once, however often it occurs: texts are counted a group of rows at a time, without
    repeating them in memory.
    """
    columns = [about.schema.column(number) for number in range(about.num_columns)]
    groups = [about.row_group(number) for number in range(about.num_row_groups)]
    texts = [number for number, column in enumerate(columns) if column.physical_type == "BYTE_ARRAY"]
    chunks = [(group.column(number), number) for group in groups for number in range(about.num_columns)]
    yield sum(max(chunk.total_uncompressed_size, _WIDTH * chunk.num_values) for chunk, _ in chunks)
    # A text is no longer than all pages of its column: most tables need no look at their texts.
    longest = sum(
        chunk.total_uncompressed_size * chunk.num_values for chunk, number in chunks if number in texts
    )
    if longest <= _SPARE_BYTES:
        return
    names = [columns[number].path for number in texts]
    with pq.ParquetFile(path, read_dictionary=names, pre_buffer=False) as file:
        for group in range(about.num_row_groups):
            for name in names:
                yield sum(map(_measure_texts, file.read_row_group(group, columns=[name]).column(0).chunks))


def _measure_texts(array: pa.Array) -> int:
    """Bytes of the texts of a column, of which nested ones have one leaf."""
    while pa.types.is_nested(array.type):
        array = array.field(0) if pa.types.is_struct(array.type) else array.values
    if pa.types.is_dictionary(array.type):
        lengths = pc.binary_length(array.dictionary).cast(pa.int64())
        return int(pc.sum(lengths.take(array.indices)).as_py() or 0)
    return int(array.nbytes)


# Contracts never change while the program runs, and asking one takes as long as checking a small table.
@cache
def _list_columns(contract: Contract) -> Mapping[str, pl.DataType]:
    return contract.schema.create_empty().schema


@cache
def _annotate_columns(contract: Contract) -> Mapping[str, Mapping[str, str]]:
    """Metadata of every field as it stands in the files, sorted by key."""
    names = contract.schema.column_names()
    return {name: dict(sorted(contract.metadata_of(name).items())) for name in names}


def check_table(name: str, frame: pl.DataFrame, facts: Mapping[str, float] = NO_FACTS) -> CheckedTable:
    """Hold a frame against its contract.

    Args:
        name: table name.
        frame: exactly the contract's columns, in any order.
        facts: numbers of the whole table that the contract declares.

    Raises:
        StoreError: ``no_such_table``; ``wrong_columns``: a column is missing, unknown or of another type, or
            a fact is unknown.
    """
    contract = find_contract(name)
    if unknown := sorted(facts.keys() - contract.facts):
        hint = "Declare it in FACTS of the table in schemas/"
        raise StoreError("wrong_columns", f"the table {name} declares no {', '.join(unknown)}", hint=hint)
    schema = schema_of(name)
    if complaints := list_complaints(frame.schema, schema):
        raise StoreError(
            "wrong_columns",
            f"table {name!r} does not fit its contract: {'; '.join(complaints)}",
            where=f"schemas/{name}.py",
            hint="Correct the code that makes the table, or its contract",
        )
    valid, failure = contract.schema.filter(frame.select(schema.names()))
    report = TableEntry(
        rows=valid.height,
        quarantined=len(failure),
        contract_version=contract.version,
        rules=dict(sorted(failure.counts().items())),
    )
    return CheckedTable(
        contract=contract,
        valid=valid,
        broken=name_broken_rules(failure) if len(failure) else None,
        report=report,
        facts=facts,
    )


def name_broken_rules(failure: FailureInfo) -> pl.DataFrame:
    """The rows that failed, with a list of the names of the rules each of them breaks."""
    details = failure.details()
    rows = failure.invalid()
    verdicts = details.select(pl.exclude(rows.columns))
    names = [
        pl.when(pl.col(rule).cast(pl.String()) == "invalid").then(pl.lit(rule))
        for rule in sorted(verdicts.columns)
    ]
    broken = verdicts.select(pl.concat_list(names).list.drop_nulls().alias(BROKEN_RULES))
    return rows.with_columns(broken.to_series())


def to_arrow(contract: Contract, frame: pl.DataFrame, facts: Mapping[str, float] = NO_FACTS) -> pa.Table:
    """A frame as an Arrow table.

    Fields carry unit, frame and description, the schema carries ``contract``, ``contract_version`` and the
    facts.
    """
    table = frame.rechunk().to_arrow(compat_level=pl.CompatLevel.oldest())
    return pa.Table.from_arrays(table.columns, schema=_annotate(contract, table.schema, facts))


def encode_parquet(
    contract: Contract,
    frame: pl.DataFrame,
    facts: Mapping[str, float] = NO_FACTS,
    *,
    compression: str = "zstd",
) -> bytes:
    """A frame as Parquet bytes, described as by `to_arrow`; the same frame gives the same bytes."""
    table = to_arrow(contract, frame, facts)
    sink = pa.BufferOutputStream()
    pq.write_table(
        table,
        sink,
        compression=compression,
        compression_level=_ZSTD_LEVEL if compression == "zstd" else None,
        row_group_size=_ROWS_PER_GROUP,
        # Numbers of a sensor hardly repeat: their dictionaries would be larger than they are.
        use_dictionary=[field.name for field in table.schema if not pa.types.is_floating(field.type)],
    )
    data: bytes = sink.getvalue().to_pybytes()
    return data


def read_facts(path: Path) -> dict[str, float]:
    """Numbers of the whole table in the metadata of its Parquet file, as its contract declares them."""
    with name_damage(path):
        metadata = pq.read_schema(path).metadata or {}
    known = {key.decode(): value.decode() for key, value in metadata.items()}
    return {name: float(known[name]) for name in find_contract(known["contract"]).facts if name in known}


def _annotate(contract: Contract, schema: pa.Schema, facts: Mapping[str, float]) -> pa.Schema:
    fields = []
    described = _annotate_columns(contract)
    for column in schema:
        ours = _ABOUT_BROKEN_RULES if column.name == BROKEN_RULES else described[column.name]
        # polars keeps the values of an Enum in the field's metadata; without them it reads back a category.
        theirs = {key.decode(): value.decode() for key, value in (column.metadata or {}).items()}
        fields.append(column.with_metadata(theirs | dict(ours)))
    about = {"contract": contract.name, "contract_version": str(contract.version)}
    return pa.schema(fields, metadata=about | {name: repr(float(value)) for name, value in facts.items()})


def list_complaints(columns: Mapping[str, object], wanted: Mapping[str, object]) -> list[str]:
    """In which columns a table differs from the one that is wanted; types by name of the column."""
    complaints = [f"column {column} is missing" for column in wanted if column not in columns]
    complaints += [f"column {column} is unknown" for column in columns if column not in wanted]
    complaints += [
        f"column {column} is {columns[column]} instead of {kind}"
        for column, kind in wanted.items()
        if column in columns and columns[column] != kind
    ]
    return complaints
