"""The batch: the logs of a folder, and what is new afterwards."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.types import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from pipeline.batch import (
    Pruning,
    Request,
    count_cores,
    parse_shard,
    parse_size,
)
from pipeline.cli.conventions import (
    CLEAN,
    EXPLAINED,
    FAILED,
    LOSSY,
    Asked,
    Choices,
    build_options,
    explain_logs,
    format_counts,
    open_results,
    print_error,
    print_json,
    print_lines,
    summarize_error,
)
from pipeline.core import SlipError, measure_memory, name_state

if TYPE_CHECKING:
    from pipeline.batch.batch_run import Outcome

_MEMORY_SHARE = 0.8
_MOST_REPLACED = 3
"""Logs whose earlier results were replaced that are named: with another option these are all of a season."""


def batch(  # noqa: D417 - the shared choices document themselves
    logs: Annotated[
        list[str] | None,
        Parameter(help="logs, folders, 'globs' and @lists; after -- where a name begins with a dash"),
    ] = None,
    /,
    *,
    choices: Annotated[Choices, Parameter(name="*")] = Choices(),  # noqa: B008 - frozen
    notify: str | None = None,
    jobs: PositiveInt | None = None,
    executor: str = "local",
    shard: str | None = None,
    reports: bool = False,
    diagnosis: bool = False,
    force: bool = False,
    retry_quarantined: bool = False,
    timeout: PositiveFloat = 3600.0,
    asked: Asked,
    settle: NonNegativeFloat = 120.0,
    prune: bool = False,
    keep: NonNegativeInt = 1,
    quota: str | None = None,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Analyze the new and changed logs of a folder.

    The same command again continues. Exit codes: 0 all done; 1 a log or a step failed; 3 done, but a log had
    losses, cannot show slip, or could not be looked at.

    Args:
        jobs: logs processed in parallel (default: the cores it may use).
        executor: local; dask for a cluster on this machine; or a scheduler's address, tcp://host:8786.
        shard: i/n, the i-th of n machines that share the logs.
        reports: write report.html for every log.
        diagnosis: identify the effects that the model lacks in every log, which takes longer.
        force: compute again what is already there.
        retry_quarantined: try logs again that killed their workers.
        timeout: longest time for one log [s].
        settle: an unfinished log that changed within this time [s] counts as being written.
        prune: remove old generations afterwards; without logs, only that.
        keep: old generations to keep of each run.
        quota: with --prune, size of the results above which the oldest go first, for example 200GB.
        notify: command line for the shell that gets the JSON object on its standard input when something is
            new: a log that failed, had losses or cannot show slip, or another error.
        json: print one JSON object.
        quiet: print nothing but errors.
    """
    from pipeline.cli.screen import open_watch  # noqa: PLC0415 - only for this verb

    if not logs and not prune:
        raise SlipError("no_logs", "no log is given", hint="Give logs: slip batch LOGS, a folder or a glob")
    if quota is not None and not prune:
        raise SlipError("quota_alone", "--quota does nothing by itself", hint="Add --prune, or leave it out")
    pruning = Pruning(keep=keep, quota_bytes=None if quota is None else parse_size(quota))
    options = replace(build_options(choices), report=reports, diagnosis=diagnosis, force=force)
    if not logs:
        open_results(choices.results)
    workers = jobs or count_cores()
    request = Request(
        targets=tuple(logs or ()),
        options=replace(options, config=None, fleet=options.config),
        executor=executor,
        jobs=workers,
        shard=None if shard is None else parse_shard(shard),
        timeout_s=timeout,
        memory_bytes=int(measure_memory() * _MEMORY_SHARE / workers)
        if asked.memory is None
        else asked.limit_bytes,
        settle_s=settle,
        retries_quarantined=retry_quarantined,
        pruning=pruning if prune else None,
    )
    from pipeline.batch.batch_run import Outcome, run_batch  # noqa: PLC0415 - heavy

    try:
        with open_watch(quiet=quiet or json) as watch:
            outcome = run_batch(request, watch)
    except Exception as error:
        # No logs, a full disk: nobody looks at the screen of a night.
        what = error if isinstance(error, SlipError) else SlipError("unexpected_error", repr(error), hint="")
        failed = _report(Outcome(lines=(), seconds=0.0, problems=(what,)), choices.results, notify)
        if not (json and isinstance(error, SlipError)):
            raise
        print_error(error)
        print_json(_as_json(failed))
        return FAILED
    for problem in outcome.problems:
        print_error(problem)
    outcome = _report(outcome, choices.results, notify)
    if json:
        print_json(_as_json(outcome))
    elif not quiet:
        print_lines(format_outcome(outcome, is_search=bool(logs)))
    return FAILED if outcome.has_failed else LOSSY if outcome.has_losses else CLEAN


def _report(outcome: Outcome, root: Path, notify: str | None) -> Outcome:
    """The outcome with what is new in it, which the command of ``--notify`` was given, or why it was not."""
    from pipeline.batch import notices  # noqa: PLC0415 - heavy

    if notify is None:
        return outcome
    news = notices.find_news(root, outcome)
    reported = replace(outcome, notified=tuple(news.values()))
    try:
        if news:
            notices.send(root, notify, _as_json(reported), news)
    except SlipError as error:
        print_error(error)
        return replace(outcome, problems=(*outcome.problems, error))
    return reported


def _as_json(outcome: Outcome) -> dict[str, object]:
    return {
        **outcome.counts,
        "seconds": round(outcome.seconds, 3),
        "removed_generations": outcome.removed,
        "logs": [asdict(line) for line in outcome.lines],
        "notified": list(outcome.notified),
        "errors": [summarize_error("", problem) for problem in outcome.problems],
    }


def format_outcome(outcome: Outcome, *, is_search: bool = True) -> list[str]:
    """The closing table: how many logs came out how, and of those that need a look, why.

    Results that were made with other options are said to be replaced.
    """
    lines = format_counts(outcome.counts, width=6)
    if outcome.removed or not is_search:
        lines.append(f"{'pruned':<14}{outcome.removed:>6} old generation{'s' * (outcome.removed != 1)}")
    for state in (*EXPLAINED, "copy"):
        own = [(line.path, line.reason, line.hint) for line in outcome.lines if line.state == state]
        lines += explain_logs(name_state(state), own)
    replaced = [
        (line.path, f"earlier results, {line.replaced}", "") for line in outcome.lines if line.replaced
    ]
    lines += explain_logs("replaced", replaced[:_MOST_REPLACED])
    others = len(replaced) - _MOST_REPLACED
    lines += [f"  and {others} more (--json lists them)"] if others > 0 else []
    return lines
