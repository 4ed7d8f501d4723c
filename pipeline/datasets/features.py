"""Features of deployments in one file that can be shared: gathered, checked, read and merged.

The file is Parquet under the schema of the table `features`. Its version, columns and number of rows are
checked before it is read, its values afterwards: they have the types and ranges of the table.
"""

from collections.abc import Sequence
from pathlib import Path

import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.core import make_plain, naming_os_errors, read_version
from pipeline.datasets.compared_runs import find_material, measure_runs, read_digest
from pipeline.datasets.pooling import ComparisonError
from pipeline.store import ANALYZE_FIRST, Store, encode_parquet, lack_runs, list_complaints, replace_file
from schemas import Features, contract_of

_HASH = 64


def gather_features(store: Store) -> tuple[pl.DataFrame, tuple[str, ...]]:
    """The table `features` of the results, and notes on excluded runs.

    Raises:
        ComparisonError: ``nothing_to_share``.
        ComparisonError: ``bad_features``: a value is out of range.
    """
    compared, runs, comments = measure_runs(find_material(store, ("dataset",), trusted_only=True))
    digests = {run: read_digest(manifest) for run, manifest in compared.manifests.items()}
    nameless = sorted(run for run, digest in digests.items() if len(digest) != _HASH)
    notes = [*compared.notes, *comments[1:]]
    if nameless:
        notes.append(f"left out, the hash of the log is not known: {', '.join(nameless)}")
    known = runs.filter(~pl.col("run").is_in(nameless)) if not runs.is_empty() else runs
    if known.is_empty():
        raise lack_runs("nothing_to_share", "there is no run to share", store.root, ANALYZE_FIRST, notes)
    schema = Features.create_empty().schema
    shared = known.with_columns(
        pl.col("run").replace_strict(digests, return_dtype=pl.String).alias("sha256"),
        pl.col("input").cast(pl.String),
        pl.lit(read_version()).alias("made_by"),
        pl.col("key").alias("from_results"),
        (pl.col("mass") * pl.col("squared_gyration")).alias("inertia"),
    ).with_columns(pl.col("sha256").str.slice(0, 16).alias("run"))
    typed = shared.select(pl.col(name).cast(kind) for name, kind in schema.items())
    return check_features(typed.sort("sha256", "input"), str(store.root)), tuple(notes)


MOST_ROWS = 100_000
"""Most rows (one per run and input) of a file from elsewhere: ten times a season of 5,000 runs."""


_LARGEST_PART = 10**9
"""Upper limit of the parts of a version number: larger ones compare as equal."""


_PARTS = ("sha256", "input")


def write_features(frame: pl.DataFrame, path: Path) -> None:
    """Write features and replace the previous file.

    Raises:
        ComparisonError: ``not_written``.
    """
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
    """Read features that others shared.

    Raises:
        ComparisonError: ``bad_features``: the reason for the rejection.
    """
    # Opening a pipe could block forever.
    if not path.is_file():
        raise _refuse(str(path), "there is no such file")
    try:
        with pq.ParquetFile(path) as file:
            names = _check_schema(file, str(path))
            # An error in one of several threads can abort the process.
            table = file.read(use_threads=False)
        # Invalid UTF-8 would end the program later.
        table.validate(full=True)
        frame = pl.DataFrame(pa.Table.from_arrays(table.columns, names=names))
    except (pa.ArrowException, OSError, ValueError, KeyError, TypeError, pl.exceptions.PolarsError) as error:
        lines = str(error).splitlines()[:1] or [type(error).__name__]
        raise _refuse(str(path), f"it cannot be read: {lines[0][:200]}") from error
    return check_features(frame.select(Features.column_names()), str(path))


def _check_schema(file: pq.ParquetFile, where: str) -> list[str]:
    """Return the names of the columns if the end of the file is that of features of this version."""
    about, contract = file.metadata.metadata or {}, contract_of("features")
    if about.get(b"contract") != b"features":
        raise _refuse(where, "it is not a table of features")
    version = about.get(b"contract_version", b"").decode()
    if version != str(contract.version):
        what = f"it is of version {version[:20]} of the table `features`, not of {contract.version}"
        raise _refuse(where, what)
    if file.metadata.num_rows > MOST_ROWS:
        raise _refuse(where, f"it has {file.metadata.num_rows} rows, more than {MOST_ROWS}")
    theirs, ours = (
        {field.name: str(field.type).removeprefix("large_") for field in schema}
        for schema in (
            file.schema_arrow,
            Features.create_empty().to_arrow(compat_level=pl.CompatLevel.oldest()).schema,
        )
    )
    if complaints := list_complaints(theirs, ours):
        raise _refuse(where, "; ".join(complaints))
    names: list[str] = file.schema_arrow.names
    return names


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
        "bad_features", f"these features are not taken: {make_plain(why)}", where=where,
        hint="Have them made again, by this version of slip: slip fleet share --file features.parquet.",
    )  # fmt: skip
