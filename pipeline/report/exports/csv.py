"""CSV: one file a table, with the units in the heads."""

from pathlib import Path

import polars as pl

from pipeline.core.tables import format_csv
from pipeline.report.errors import writing_export
from pipeline.report.exports.source import ExportSource
from schemas import contract_of


def write_csv(source: ExportSource, folder: Path) -> list[Path]:
    """Write every table of a run as `<table>.csv`.

    A column whose contract gives it a unit carries it in its head, for example `v_x [m/s]`. Rows are read and
    written in batches: memory does not grow with the run.

    Args:
        source: the run.
        folder: made when it is not there.

    Returns:
        The files, sorted.

    Raises:
        ReportError: ``export_not_written``.
    """
    written = []
    with writing_export(where=folder):
        folder.mkdir(parents=True, exist_ok=True)
        for table in sorted(source.manifest.tables):
            path = folder / f"{table}.csv"
            part = path.with_name(f".{path.name}.part")
            heads = {name: _name_column(table, name) for name in source.columns(table)}
            try:
                with part.open("wb") as file:
                    file.write(format_csv(pl.DataFrame(schema=list(heads.values()))).encode())
                    for frame in source.batches(table):
                        file.write(format_csv(frame, header=False).encode())
                part.replace(path)
            finally:
                part.unlink(missing_ok=True)
            written.append(path)
    return written


def _name_column(table: str, name: str) -> str:
    contract = contract_of(table)
    if name not in contract.schema.columns():
        return name
    unit = contract.metadata_of(name).get("unit", "")
    return f"{name} [{unit}]" if unit and unit != "1" else name
