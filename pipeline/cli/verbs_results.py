"""Commands on results: status, verify, query."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from pipeline import core, store
from pipeline.cli.conventions import (
    CLEAN,
    EXPLAINED,
    FAILED,
    All,
    Results,
    explain_logs,
    format_counts,
    open_results,
    print_error,
    print_result,
    show_progress,
    summarize_error,
    tidy_line,
)
from pipeline.core import INPUT_WORDS, SlipError, format_count, format_size, name_state

if TYPE_CHECKING:
    import polars as pl

    from pipeline.batch.batch_check import Status, Verification

_WIDE = 200
_ROWS_AT_ONCE = 1 << 16
"""Rows converted to text at a time, so that the answer is not in memory a second time as text."""
_NAMED = 8
"""Maximum number of files without a checksum that are named: those over all runs of one folder."""


def build_results() -> App:
    """The command and its own commands."""
    from pipeline.cli.verbs_log import stage  # noqa: PLC0415 - only for this command

    app = App(name="results", help="Check and query a folder of results.")
    for command in (status, verify, query, stage):
        app.command(command)
    return app


def query(  # noqa: D417 - arguments document themselves
    sql: Annotated[str, Parameter(help="for example: SELECT * FROM runs")],
    /,
    *,
    results: Results = Path("results"),
    vehicle: str | None = None,
    terrain: str | None = None,
    dataset: str | None = None,
    day: str | None = None,
    to: Literal["table", "csv", "json"] = "table",
    as_json: Annotated[bool, Parameter(name="--json")] = False,
) -> int:
    """Query the tables of all runs with SQL.

    Tables are slip, windows, aggregates, datasets, ..., and `runs` with one row a run.

    Args:
        vehicle: only runs of this vehicle; files of other runs are not opened.
        terrain: only runs on this terrain.
        dataset: only runs of this dataset.
        day: only runs of this day, 2026-07-31, or of a month, 2026-07.
        to: how to print the answer.
        as_json: print one JSON object: columns and rows.
    """
    asked = {"vehicle": vehicle, "terrain": terrain, "dataset": dataset, "day": day}
    answer = open_results(results).query(sql, asked)
    if as_json or to == "json":
        _print_json(answer)
    elif to == "csv":
        _print_csv(answer)
    else:
        _print_table(answer)
    return CLEAN


def _print_table(answer: pl.DataFrame) -> None:
    import polars as pl  # noqa: PLC0415 - heavy

    with pl.Config(tbl_rows=-1, tbl_cols=-1, fmt_str_lengths=_WIDE, tbl_width_chars=_WIDE):
        _write("".join(f"{tidy_line(line)}\n" for line in str(answer).split("\n")))


def _print_csv(answer: pl.DataFrame) -> None:
    import polars as pl  # noqa: PLC0415 - heavy

    try:
        _write(core.format_csv(answer.clear()))
        for part in answer.iter_slices(_ROWS_AT_ONCE):
            _write(core.format_csv(part, header=False))
    except pl.exceptions.PolarsError as error:
        said = str(error).splitlines()[0]
        raise SlipError(
            "no_csv", f"the answer cannot be written as CSV: {said}", hint="Use --to json, or plain columns"
        ) from error


def _print_json(answer: pl.DataFrame) -> None:
    _write(f'{{"columns": {json.dumps(answer.columns)}, "rows": [')
    for number, part in enumerate(answer.iter_slices(_ROWS_AT_ONCE)):
        _write("," * (number > 0) + spell_bytes(part).write_json()[1:-1])
    _write("]}\n")


def _write(text: str) -> None:
    sys.stdout.buffer.write(text.encode())


def spell_bytes(answer: pl.DataFrame) -> pl.DataFrame:
    """The same table with bytes as hexadecimal digits: JSON has no word for them."""
    import polars as pl  # noqa: PLC0415 - heavy

    return answer.with_columns(
        pl.Series(column.name, [_spell(value) for value in column.to_list()], strict=False)
        for column in answer
        if "Binary" in str(column.dtype)
    )


def _spell(value: object) -> object:
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, list):
        return [_spell(each) for each in value]
    if isinstance(value, dict):
        return {name: _spell(each) for name, each in value.items()}
    return value


def status(  # noqa: D417 - arguments document themselves
    run: Annotated[
        str | None, Parameter(help="name of a run, or its log: what its numbers were computed from")
    ] = None,
    /,
    *,
    results: Results = Path("results"),
    everything: All = False,
    json: bool = False,
) -> int:
    """Show the state of all logs, or the log, configuration and corrections behind the numbers of one run.

    Exit codes: 0 the results could be read, whatever became of their logs; 1 some of them cannot be read.

    Args:
        everything: name every log, also of many with the same reason.
        json: print one JSON object.
    """
    from pipeline.batch.batch_check import read_status  # noqa: PLC0415 - only for this verb

    folder = open_results(results)
    if run is not None:
        manifest = store.find_run(run, folder)
        writer = folder.find_writer(manifest)
        content = {"run": manifest.run, "key": manifest.key, "writing": writer, **manifest.details}
        return print_result(content, lambda: _format_origin(manifest, writer), json=json)
    status_now = read_status(folder)
    print_result(_as_json(status_now), lambda: _format_status(status_now, everything=everything), json=json)
    return FAILED if status_now.errors else CLEAN


def _as_json(status_now: Status) -> dict[str, object]:
    batch = status_now.batch
    return {
        **status_now.counts,
        "runs": status_now.runs,
        "bytes": status_now.bytes,
        "old_generations": status_now.old_generations,
        "last": batch.worked,
        "began": batch.began,
        "ended": batch.ended,
        "stopped": batch.stopped,
        **batch.unfinished,
        "failed_before_logs": batch.failed or None,
        "writing": [{"run": run, "holder": holder} for run, holder in status_now.writers.items()],
        "logs": [
            {"path": entry.log.path, **{k: v for k, v in asdict(entry).items() if k != "log"}}
            for entry in status_now.entries
        ],
        "errors": [summarize_error(error.where, error) for error in status_now.errors],
    }


def _format_status(status_now: Status, *, everything: bool) -> list[str]:
    from pipeline.words import describe_batch  # noqa: PLC0415 - only for this verb

    old = format_count(status_now.old_generations, "old generation")
    lines: list[str] = []
    for state in EXPLAINED:
        own = [(one.log.path, one.reason, one.hint) for one in status_now.entries if one.state == state]
        lines += explain_logs(name_state(state), own, everything=everything)
    lines += [f"damaged: {error}" for error in status_now.errors]
    lines += [
        f"runs          {status_now.runs}, {format_size(status_now.bytes)}, {old}",
        f"last batch    {describe_batch(status_now.batch) or 'never'}",
        *(f"writing       {run}, by {holder}" for run, holder in status_now.writers.items()),
    ]
    return lines + format_counts(status_now.counts)


def verify(  # noqa: D417 - arguments document themselves
    results: Results = Path("results"),
    *,
    logs: Annotated[bool, Parameter(negative="--no-logs")] = True,
    follow_remote: bool = False,
    sample: str | None = None,
    seed: str | None = None,
    repair: bool = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Check results and their logs against their checksums.

    Args:
        logs: read the logs, too.
        follow_remote: also read remote logs (s3://) whose address is known from the results alone.
        sample: read only a random share of files and logs, for example 5%, and the manifests of all runs.
        seed: seed of the sample (default: another one every day).
        repair: mark what can be recomputed, for the next batch over its log.
        json: print one JSON object.
        quiet: print nothing but errors.
    """
    from pipeline.batch.batch_check import verify_results  # noqa: PLC0415 - only for this verb

    drawn = parse_sample(sample, seed)
    folder = open_results(results)
    with show_progress("verify", quiet=quiet or json) as notify:
        verification = verify_results(
            folder,
            logs=logs,
            notify=notify,
            repair=repair,
            follow_remote=follow_remote,
            sample=drawn,
        )
    print_result(
        _check_as_json(verification, repair=repair),
        lambda: _format_check(verification),
        json=json,
        quiet=quiet,
    )
    if verification.is_clean:
        return CLEAN
    if quiet:
        what = f"{format_count(len(verification.files) + len(verification.logs), 'file')} changed or damaged"
        print_error(SlipError("damaged", what, where=str(results), hint="Name them: slip results verify"))
    return FAILED


def parse_sample(text: str | None, seed: str | None) -> store.Sample | None:
    """The sample of ``5%``, its seed by default that of the UTC day; None where none is asked for.

    Raises:
        SlipError: ``bad_sample``.
    """
    if text is None:
        if seed is not None:
            raise SlipError("bad_sample", "--seed does nothing by itself", hint="Add --sample, as 5%")
        return None
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*%", text.strip())
    percent = float(match[1]) if match else 0.0
    if not 0.0 < percent <= 100.0:  # noqa: PLR2004 - all of it
        hint = "Write for example 5%"
        raise SlipError("bad_sample", f"{text!r} is not a share of the files", hint=hint)
    return store.Sample(percent / 100.0, seed or f"{datetime.now(UTC):%Y-%m-%d}")


def _check_as_json(verification: Verification, *, repair: bool) -> dict[str, object]:
    files, logs, gone, remote = (
        [
            {"run": problem.run, "path": str(problem.path), "code": problem.code, "message": problem.what}
            for problem in problems
        ]
        for problems in (verification.files, verification.logs, verification.gone, verification.remote)
    )
    answer = {
        "runs": verification.checked,
        "files": files,
        "logs": logs,
        "gone": gone,
        "remote": remote,
        "read": {"files": asdict(verification.examination.files), "logs": asdict(verification.read_logs)},
        "unchecked": list(verification.examination.unchecked),
    }
    return answer | ({"repairs": [asdict(each) for each in verification.repairs]} if repair else {})


def _format_check(verification: Verification) -> list[str]:
    lines = [f"{verification.checked} runs checked"]
    files, read_logs = verification.examination.files, verification.read_logs
    is_sample = (files.looked_at, read_logs.looked_at) != (files.all, read_logs.all)
    unchecked = verification.examination.unchecked
    read = "all other files" if unchecked else "all files"
    if is_sample or verification.remote:
        read = "all files that were read"
    if is_sample:
        lines.append(
            f"sample   {files.looked_at} of {files.all} files and "
            f"{read_logs.looked_at} of {read_logs.all} logs were read"
        )
    lines += [f"damaged  {problem.path}: {problem.what}" for problem in verification.files]
    lines += [f"log      {problem.path}: {problem.what} ({problem.run})" for problem in verification.logs]
    lines += [f"gone     {problem.path} ({problem.run})" for problem in verification.gone]
    lines += [f"remote   {problem.path} ({problem.run})" for problem in verification.remote]
    if verification.remote:
        lines.append("These addresses are known from the results alone; --follow-remote reads them.")
    lines += [f"{each.action:<8} {each.subject}: {each.what}" for each in verification.repairs]
    if unchecked:
        others = f" and {len(unchecked) - _NAMED} more" if len(unchecked) > _NAMED else ""
        lines.append(f"no checksum covers {', '.join(unchecked[:_NAMED])}{others}")
    if verification.is_clean:
        lines.append(f"{read} are unchanged")
    else:
        if any(each.action == "queued" for each in verification.repairs):
            lines.append("`slip batch` over those logs makes it again.")
        elif verification.files and not verification.repairs:
            lines.append(
                "`slip results verify --repair` has the next batch over its log make again what can be."
            )
        lines += ["Copy changed logs from their origin."] if verification.logs else []
    return lines


def _format_origin(manifest: store.Manifest, writer: str) -> list[str]:
    details = manifest.details
    log = manifest.part("log")
    lines = [
        f"run            {manifest.run}",
        *([f"writing        new results are being written, by {writer}"] if writer else []),
        f"generation     {manifest.key}    {manifest.folder}",
        *(f"earlier        {folder}" for folder in store.list_old(manifest)),
        f"log            {log.get('path')}",
        f"sha256         {log.get('sha256')}",
        f"vehicle        {manifest.part('vehicle').get('name')}, dataset {details.get('dataset')}",
        "versions       " + ", ".join(f"{name} {text}" for name, text in manifest.part("versions").items()),
        "stages",
    ]
    for stage, entry in manifest.part("stages").items():
        key = entry.get("key") if isinstance(entry, dict) else ""
        lines.append(f"  {stage:<13}{key}")
    lines += _format_alignment(manifest)
    lines.append("tables")
    for table, stored in sorted(manifest.tables.items()):
        quarantined = f", {stored.quarantined} in quarantine" if stored.quarantined else ""
        contract = f"contract {stored.contract_version}"
        digest = manifest.files[f"{table}.parquet"].sha256[:16]
        lines.append(f"  {table:<13}{stored.rows} rows{quarantined}    {contract}    {digest}")
    lines.append("configuration")
    lines.append("  " + json.dumps(_without_defaults(manifest.part("configuration"))))
    return lines


def _format_alignment(manifest: store.Manifest) -> list[str]:
    """Lines of the alignment values, and the slip before and after alignment."""
    if not {"alignments", "aggregates"} <= set(manifest.tables):
        return []
    import polars as pl  # noqa: PLC0415 - takes a fifth of a second

    from schemas import contract_of  # noqa: PLC0415 - likewise

    row = manifest.read("alignments").row(0, named=True)
    about = contract_of("alignments")
    lines = [
        "aligned        (table alignments; latency, outlier, *_aligned: columns of poses, wheels, commands)"
    ]
    for name, value in row.items():
        if isinstance(value, float):
            unit = about.metadata_of(name).get("unit", "1").removesuffix("1")
            lines.append(f"  {name:<25}{value:.6g} {unit}".rstrip())
    aggregates = manifest.read("aggregates").filter(pl.col("subset") == "all")
    medians = aggregates.select("input", "median_recorded_modulus", "median_modulus")
    lines += [
        f"  slip {INPUT_WORDS[name]:<20}{before:.4g} m/s as recorded, {now:.4g} m/s aligned (medians)"
        for name, before, now in medians.iter_rows()
        if before is not None
    ]
    return lines


def _without_defaults(configuration: Mapping[str, object]) -> dict[str, object]:
    """The configuration without empty values."""
    differing: dict[str, object] = {}
    for key, value in configuration.items():
        inner = _without_defaults(value) if isinstance(value, dict) else value
        if inner not in (None, {}, []):
            differing[key] = inner
    return differing
