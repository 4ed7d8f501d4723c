"""`slip explain`: where a number came from."""

from __future__ import annotations

import json as encoder
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from pipeline.cli.output import print_result

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.store import Manifest


def explain(  # noqa: D417 - arguments document themselves
    run: Annotated[str, Parameter(help="name of a run, or its log")],
    column: Annotated[str | None, Parameter(help="a column, as table.column, to be told what it is")] = None,
    /,
    *,
    out: Path = Path("results"),
    json: bool = False,
) -> int:
    """Say from which log, configuration and versions a run's numbers came.

    Args:
        out: results folder.
        json: print one JSON object.
    """
    from pipeline.analysis.lookup import find_run  # noqa: PLC0415 - heavy
    from pipeline.store import Store  # noqa: PLC0415 - heavy

    manifest = find_run(run, Store(out))
    about = _describe_column(column) if column else {}
    content = {"run": manifest.run, "key": manifest.key, **manifest.details, "column": about or None}
    told = ["", f"{column}: " + ", ".join(f"{key} {value}" for key, value in about.items())] if about else []
    return print_result(content, lambda: [*_describe(manifest), *told], json=json)


def _describe_column(column: str) -> dict[str, str]:
    """Unit, frame and description of a column, from its contract."""
    from pipeline.core.errors import SlipError  # noqa: PLC0415 - only on the way to an error
    from schemas import list_contracts  # noqa: PLC0415 - heavy

    table, _, name = column.partition(".")
    for contract in list_contracts():
        if contract.name == table and name in contract.schema.columns():
            return contract.metadata_of(name)
    known = ", ".join(contract.name for contract in list_contracts())
    hint = f"Write table.column; the tables are {known}."
    raise SlipError("no_such_column", f"no contract has the column {column!r}", hint=hint)


def _describe(manifest: Manifest) -> list[str]:
    details = manifest.details
    log = manifest.part("log")
    lines = [
        f"run            {manifest.run}",
        f"generation     {manifest.key}    {manifest.folder}",
        f"log            {log.get('path')}",
        f"sha256         {log.get('sha256')}",
        f"vehicle        {manifest.part('vehicle').get('name')}, dataset {details.get('dataset')}",
        "versions       " + ", ".join(f"{name} {text}" for name, text in manifest.part("versions").items()),
        "stages",
    ]
    for stage, entry in manifest.part("stages").items():
        key = entry.get("key") if isinstance(entry, dict) else ""
        lines.append(f"  {stage:<13}{key}")
    lines += _describe_alignment(manifest)
    lines.append("tables")
    for table, stored in sorted(manifest.tables.items()):
        quarantined = f", {stored.quarantined} in quarantine" if stored.quarantined else ""
        contract = f"contract {stored.contract_version}"
        lines.append(f"  {table:<13}{stored.rows} rows{quarantined}    {contract}    {stored.sha256[:16]}")
    lines.append("configuration")
    lines.append("  " + encoder.dumps(_without_defaults(manifest.part("configuration"))))
    return lines


def _describe_alignment(manifest: Manifest) -> list[str]:
    """What was put right before anything was computed, and the slip before and after."""
    if not {"alignments", "aggregates"} <= set(manifest.tables):
        return []
    row = manifest.read("alignments").row(0, named=True)
    lines = ["put right      (table alignments; latency, outlier and *_aligned stand in poses and commands)"]
    for name, value in row.items():
        if isinstance(value, float) and not name.startswith("recorded_modulus"):
            unit = _describe_column(f"alignments.{name}").get("unit", "1").removesuffix("1")
            lines.append(f"  {name:<20}{value:.6g} {unit}".rstrip())
    aggregates = manifest.read("aggregates")
    for name in ("command", "measured"):
        before = row[f"recorded_modulus_{name}"]
        after = aggregates.filter((aggregates["input"] == name) & (aggregates["subset"] == "all"))
        if before is not None and not after.is_empty():
            now = after["median_modulus"][0]
            lines.append(
                f"  slip on {name:<12}{before:.4g} m/s as recorded, {now:.4g} m/s put right (medians)"
            )
    return lines


def _without_defaults(configuration: Mapping[str, object]) -> dict[str, object]:
    """What the configuration says beyond empty values."""
    kept: dict[str, object] = {}
    for key, value in configuration.items():
        inner = _without_defaults(value) if isinstance(value, dict) else value
        if inner not in (None, {}, []):
            kept[key] = inner
    return kept
