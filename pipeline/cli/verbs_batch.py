"""The batch: the logs of a folder, and what is new afterwards."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.types import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from pipeline.batch import (
    Pruning,
    Request,
    Stop,
    count_cores,
    parse_shard,
    parse_size,
)
from pipeline.cli.conventions import (
    CLEAN,
    EXPLAINED,
    FAILED,
    LOSSY,
    All,
    Asked,
    Choices,
    build_options,
    explain_logs,
    format_counts,
    group_reasons,
    name_some,
    open_results,
    print_error,
    print_json,
    print_lines,
    print_note,
    summarize_error,
)
from pipeline.core import UNFINISHED, SlipError, measure_memory, name_state

if TYPE_CHECKING:
    from pipeline.batch.batch_run import Outcome

_MEMORY_SHARE = 0.8


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
    everything: All = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Analyze the new and changed logs of a folder.

    The same command again continues. Exit codes: 0 all done; 1 a log or a step failed; 3 done, but a log had
    losses, cannot show slip, could not be looked at, failed before and is unchanged, or is gone since the
    batch before; 130 or 143 stopped.

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
            new: a log that failed, had losses, cannot show slip or is gone, or another error.
        everything: name every log, also of many with the same reason.
        json: print one JSON object.
        quiet: print nothing but errors, each reason once.
    """
    from pipeline.cli.screen import open_watch  # noqa: PLC0415 - only for this verb

    if not logs and not prune:
        hint = "Give logs: slip batch LOGS, a folder or a glob"
        raise SlipError("no_logs", "no log is given", hint=hint)
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
        with _ending_on_signals(), open_watch(quiet=quiet or json) as watch:
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
        print_lines(format_outcome(outcome, is_search=bool(logs), everything=everything))
    if json or quiet:
        _print_failures(outcome)
    return outcome.stopped or find_code(outcome)


def find_code(outcome: Outcome) -> int:
    """Exit code of a batch that was not stopped."""
    return FAILED if outcome.has_failed else LOSSY if outcome.has_losses else CLEAN


@contextmanager
def _ending_on_signals() -> Iterator[None]:
    """End with one line and 128 plus the number of the signal, as shells do, when the batch is stopped."""

    def end(number: int, _frame: object) -> None:
        print_note("slip: stopped; the same command continues")
        raise Stop(128 + number)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _print_failures(outcome: Outcome) -> None:
    """One line on stderr for each reason of logs that failed in this batch."""
    new = [line for line in outcome.lines if line.state in {"failed", "quarantined"} and not line.unchanged]
    for paths, reason, hint in group_reasons((line.path, line.reason, line.hint) for line in new):
        print_error(SlipError("failed", reason, where=", ".join(name_some(paths)), hint=hint))


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
        "stopped": bool(outcome.stopped),
        "seconds": round(outcome.seconds, 3),
        "removed_generations": outcome.removed,
        "logs": [asdict(line) for line in outcome.lines],
        "notes": list(outcome.notes),
        "notified": list(outcome.notified),
        "errors": [summarize_error(path, error) for path, error in outcome.list_errors()],
    }


def format_outcome(outcome: Outcome, *, is_search: bool = True, everything: bool = False) -> list[str]:
    """The logs that need a look, and why, what is new last, and below them how many logs came out how.

    Results that were made with other options are said to be replaced.
    """
    lines: list[str] = []
    for is_old in (True, False):
        for state in (*EXPLAINED, *UNFINISHED, "copy"):
            own = [
                (line.path, line.reason, line.hint)
                for line in outcome.lines
                if line.state == state and line.unchanged == is_old
            ]
            title = f"{name_state(state)}, {'as before' if is_old else 'new'}"
            lines += explain_logs(title, own, everything=everything)
    replaced = [
        (line.path, f"earlier results, {line.replaced}", "") for line in outcome.lines if line.replaced
    ]
    lines += explain_logs("replaced", replaced, everything=everything)
    lines += [*outcome.notes, *([""] if outcome.notes else [])]
    lines += format_counts(outcome.counts, width=6)
    if outcome.removed or not is_search:
        lines.append(f"{'pruned':<14}{outcome.removed:>6} old generation{'s' * (outcome.removed != 1)}")
    return lines
