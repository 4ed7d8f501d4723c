"""`slip status`: what is done, failed and quarantined."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from pipeline.cli.output import CLEAN, FAILED, describe_error, print_result, say_state
from pipeline.cli.results_place import open_results

if TYPE_CHECKING:
    from pipeline.batch.status import Status


def status(  # noqa: D417 - arguments document themselves
    results: Annotated[Path | None, Parameter(help="results folder (default: results)")] = None,
    /,
    *,
    out: Annotated[Path, Parameter(show=False)] = Path("results"),
    json: bool = False,
) -> int:
    """Show what batches have made of the logs, and how large the results are.

    Args:
        json: print one JSON object.
    """
    from pipeline.batch.status import tell_status  # noqa: PLC0415 - only for this verb

    found = tell_status(open_results(results or out).open_store())
    print_result(_as_json(found), lambda: _describe(found), json=json)
    return FAILED if found.errors else CLEAN


def _as_json(found: Status) -> dict[str, object]:
    import msgspec  # noqa: PLC0415 - help does without

    return {
        **found.counts,
        "runs": found.runs,
        "bytes": found.bytes,
        "old_generations": found.old_generations,
        "last": found.last,
        "logs": [
            {"path": entry.log.path, **{k: v for k, v in msgspec.to_builtins(entry).items() if k != "log"}}
            for entry in found.entries
        ],
        "errors": [describe_error(error.where, error) for error in found.errors],
    }


def _describe(found: Status) -> list[str]:
    last = (
        "never" if found.last is None else f"{datetime.fromtimestamp(found.last).astimezone():%Y-%m-%d %H:%M}"
    )
    old = f"{found.old_generations} old generation{'s' * (found.old_generations != 1)}"
    lines = [
        f"runs          {found.runs}, {found.bytes / 1e6:.1f} MB, {old}",
        f"last batch    {last}",
    ]
    lines += [f"{say_state(state):<14}{count}" for state, count in found.counts.items()]
    for entry in found.entries:
        if entry.state in {"lossy", "failed", "quarantined"}:
            lines += ["", f"{say_state(entry.state)}: {entry.log.path}", f"    {entry.reason}"]
            lines += [f"    {entry.hint}"] if entry.hint else []
    lines += [f"damaged: {error}" for error in found.errors]
    return lines
