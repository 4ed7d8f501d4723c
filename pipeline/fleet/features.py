"""Features of deployments in one shareable file: writing, reading untrusted files, merging.

A file from others is not trusted: it is read whole and only if it is small, uncompressed, and has exactly the
columns, types and ranges of its contract. Parquet can expand without compression, too: texts are read as
dictionaries, so that a text shared by many rows is in memory once, and their lengths are checked before they
are expanded. The actual encoding of pages may differ from the declared one, so callers limit the memory as
well.
"""

from __future__ import annotations

import os
import stat
from typing import TYPE_CHECKING

import polars as pl

from pipeline.core.program import naming_os_errors
from pipeline.fleet.runs import ComparisonError
from schemas.contract import contract_of
from schemas.pooled_tables import Features

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import pyarrow as pa

MAGIC = b"PAR1"
LARGEST_BYTES = 64 * 2**20
"""Largest size of a file from elsewhere [bytes]; it is read into memory at once."""
MOST_ROWS = 100_000
"""Most rows (one per run and input) of a file from elsewhere: ten times a season of 5,000 runs."""
_ENCODINGS = frozenset({"PLAIN", "RLE", "RLE_DICTIONARY", "PLAIN_DICTIONARY", "BIT_PACKED"})
_LONGEST_TEXT = 1024
"""Longest text in a file from elsewhere [bytes]; names of vehicles and terrains have some tens."""
_LARGEST_PART = 10**9
"""Upper limit of the parts of a version number: larger ones compare as equal."""
_PARTS = ("sha256", "input")
_STORED = {pl.String(): "BYTE_ARRAY", pl.Float64(): "DOUBLE", pl.Int64(): "INT64"}


def write_features(frame: pl.DataFrame, path: Path) -> None:
    """Write features and replace the previous file.

    Raises:
        ComparisonError: ``not_written``.
    """
    from pipeline.store.files import replace_file  # noqa: PLC0415 - heavy
    from pipeline.store.parquet_tables import encode_parquet  # noqa: PLC0415

    what, hint = "the file cannot be written", "Choose another file."
    with naming_os_errors(ComparisonError, "not_written", what, where=path, hint=hint):
        replace_file(path, encode_parquet(contract_of("features"), frame, compression="none"))


def check_features(frame: pl.DataFrame, where: str) -> pl.DataFrame:
    """Return the rows if all of them satisfy the contract.

    Raises:
        ComparisonError: ``bad_features``.
    """
    valid, failure = Features.filter(frame)
    if len(failure):
        rules = ", ".join(sorted(failure.counts()))
        raise _refuse(where, f"{len(failure)} of {frame.height} rows break the contract ({rules})")
    return valid


def read_features(path: Path) -> pl.DataFrame:
    """Read features from an untrusted file.

    Raises:
        ComparisonError: ``bad_features``: the reason for the rejection.
    """
    import pyarrow as pa  # noqa: PLC0415 - heavy

    data = _read_small(path)
    try:
        table = _open_table(data, str(path))
        table = _write_out_texts(table, str(path))
        # Invalid UTF-8, in rows or in the schema, would end the program later.
        table.validate(full=True)
        frame = pl.from_arrow(pa.Table.from_arrays(table.columns, names=table.column_names))
    except (pa.ArrowException, OSError, ValueError, KeyError, TypeError, pl.exceptions.PolarsError) as error:
        lines = str(error).splitlines()[:1] or [type(error).__name__]
        raise _refuse(str(path), f"it cannot be read: {lines[0][:200]}") from error
    wanted = Features.create_empty().schema
    if not isinstance(frame, pl.DataFrame) or dict(frame.schema) != dict(wanted):
        raise _refuse(str(path), "its columns are of other types than the contract's")
    return check_features(frame.select(wanted.names()), str(path))


def _read_small(path: Path) -> bytes:
    """Bytes of a regular file of limited size; never blocks on pipes or devices."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    except OSError as error:
        raise _refuse(str(path), f"it cannot be opened: {error.strerror}") from error
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise _refuse(str(path), "it is not a regular file")
    with os.fdopen(descriptor, "rb") as file:
        data = file.read(LARGEST_BYTES + 1)
    if len(data) > LARGEST_BYTES:
        raise _refuse(str(path), f"it is larger than {LARGEST_BYTES >> 20} MB")
    if data[:4] != MAGIC:
        raise _refuse(str(path), "it is not a Parquet file")
    return data


def _open_table(data: bytes, where: str) -> pa.Table:
    import pyarrow as pa  # noqa: PLC0415 - heavy
    import pyarrow.parquet as pq  # noqa: PLC0415 - heavy

    texts = [name for name, kind in Features.create_empty().schema.items() if kind == pl.String]
    file = pq.ParquetFile(
        pa.BufferReader(data), thrift_string_size_limit=2**20, thrift_container_size_limit=2**16,
        read_dictionary=texts,
    )  # fmt: skip
    about, contract = file.metadata, contract_of("features")
    metadata = {key: value for key, value in (about.metadata or {}).items() if key != b"ARROW:schema"}
    version = metadata.get(b"contract_version", b"").decode("utf-8", "replace")[:20]
    if metadata.get(b"contract") != b"features" or version != str(contract.version):
        raise _refuse(where, f"it is not of version {contract.version} of the contract `features`")
    if about.num_rows > MOST_ROWS:
        raise _refuse(where, f"it has more than {MOST_ROWS} rows")
    if sorted(file.schema_arrow.names) != sorted(Features.column_names()):
        raise _refuse(where, "its columns are not those of the contract")
    stored = {
        column.path: column.physical_type
        for column in (about.schema.column(i) for i in range(about.num_columns))
    }
    if stored != {name: _STORED[kind] for name, kind in Features.create_empty().schema.items()}:
        raise _refuse(where, "its columns are of other types than the contract's")
    ours = contract.metadata_of
    theirs = {
        name: (file.schema_arrow.field(name).metadata or {}).get(b"unit", b"")
        for name in file.schema_arrow.names
    }
    if wrong := sorted(name for name, unit in theirs.items() if unit != ours(name).get("unit", "").encode()):
        raise _refuse(where, f"units are others than the contract's: of {', '.join(wrong)}")
    groups = [about.row_group(group) for group in range(about.num_row_groups)]
    chunks = [group.column(column) for group in groups for column in range(about.num_columns)]
    # Chunk metadata decides what is read, not the totals that the file declares.
    if sum(chunk.num_values for chunk in chunks) != about.num_rows * about.num_columns:
        raise _refuse(where, "its parts hold other numbers of rows than it says")
    if sum(chunk.total_compressed_size for chunk in chunks) > len(data):
        raise _refuse(where, "its parts hold more bytes than it has")
    if any(chunk.compression != "UNCOMPRESSED" for chunk in chunks):
        raise _refuse(where, "a part of it is compressed, and might be anything")
    if odd := {encoding for chunk in chunks for encoding in chunk.encodings} - _ENCODINGS:
        raise _refuse(where, f"a part of it is encoded as {min(odd)}, and might be anything")
    # An error in one of several threads can abort the process.
    return file.read(use_threads=False)


def _write_out_texts(table: pa.Table, where: str) -> pa.Table:
    """Expand the dictionaries of the table to plain texts, if none of these is long."""
    import pyarrow as pa  # noqa: PLC0415 - heavy
    import pyarrow.compute as pc  # noqa: PLC0415 - heavy

    for index, field in enumerate(table.schema):
        if pa.types.is_dictionary(field.type):
            column = table.column(index)
            if any(
                (pc.max(pc.binary_length(chunk.dictionary)).as_py() or 0) > _LONGEST_TEXT
                for chunk in column.chunks
            ):
                raise _refuse(where, f"a text of {field.name} is longer than {_LONGEST_TEXT} bytes")
            table = table.set_column(index, field.name, column.cast(pa.large_string()))
    return table


def merge_features(frames: Sequence[pl.DataFrame], where: str) -> tuple[pl.DataFrame, int]:
    """Merge features of several files, sorted; return them and the number of duplicate rows.

    A log is identified by the hash of its content. If two versions of slip give different results for one
    log, the row of the later version remains. The results that a row comes from do not matter.

    Raises:
        ComparisonError: ``bad_features``: one version has different rows for the same log.
    """
    columns = [name for name in Features.column_names() if name != "from_results"]
    joined = pl.concat(frames).sort("from_results").unique(columns, keep="first", maintain_order=True)
    newest = pl.col("made_by").map_elements(_order_version, return_dtype=pl.List(pl.Int64))
    ranked = joined.with_columns(newest.alias("order")).sort(*_PARTS, "order")
    last = ranked.filter(pl.col("order") == pl.col("order").last().over(_PARTS)).drop("order")
    twice = last.filter(last.select(_PARTS).is_duplicated())
    if twice.height:
        logs = ", ".join(twice["run"].unique().sort().head(5))
        counts = twice.group_by(_PARTS).n_unique()
        differ = ", ".join(name for name in columns if name not in _PARTS and (counts[name] > 1).any())
        raise _refuse(where, f"they contradict each other on the logs {logs}, in {differ}")
    return last, sum(frame.height for frame in frames) - last.height


def _order_version(text: str) -> list[int]:
    return [min(int(part), _LARGEST_PART) if part.isdigit() else -1 for part in text.split(".")][:8]


def _refuse(where: str, why: str) -> ComparisonError:
    return ComparisonError(
        "bad_features", f"these features are not taken: {why}", where=where,
        hint="Have them made again: slip fleet share --file features.parquet.",
    )  # fmt: skip
