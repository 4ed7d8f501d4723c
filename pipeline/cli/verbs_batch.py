"""The batch: the logs of a folder, what is new afterwards, and recipes that run it every night."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, CycloptsError, Parameter
from cyclopts.types import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from pipeline.batch import (
    Pruning,
    Request,
    count_cores,
    parse_memory_limit,
    parse_shard,
    parse_size,
)
from pipeline.batch.schedule import Nightly, System, parse_clock, print_units
from pipeline.cli.conventions import (
    CLEAN,
    EXPLAINED,
    FAILED,
    LOSSY,
    Choices,
    build_options,
    explain_logs,
    format_counts,
    format_state,
    open_results,
    print_error,
    print_json,
    print_lines,
    summarize_error,
)
from pipeline.core import SlipError, measure_memory, slip_command

if TYPE_CHECKING:
    from pipeline.batch.batch_run import Line, Outcome
    from pipeline.batch.notices import Notice

_MEMORY_SHARE = 0.8


def build_batch() -> App:
    """The command, which brings results up to date by itself, and its own commands."""
    app = App(name="batch", help="Analyze the new and changed logs of a folder.")
    app.default(run)
    app.command(run)
    app.command(schedule)
    return app


def run(  # noqa: D417 - the shared choices document themselves
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
    memory: str | None = None,
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
        memory: memory limit for one log, for example 2GB (default: a fair share of the machine's).
        settle: an unfinished log that changed within this time [s] counts as being written.
        prune: remove old generations afterwards; without logs, only that.
        keep: old generations to keep of each run.
        quota: with --prune, size of the results above which the oldest go first, for example 200GB.
        notify: command line for the shell that gets new failures: the message on its standard input, and
            $SLIP_SUBJECT, $SLIP_JSON.
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
    opened = open_results(choices.results)
    if not logs:
        opened.open_store()
    workers = jobs or count_cores()
    request = Request(
        targets=tuple(logs or ()),
        options=replace(options, out=opened.root, config=None, fleet=options.config),
        address=None if opened.mirror is None else opened.mirror.address,
        executor=executor,
        jobs=workers,
        shard=None if shard is None else parse_shard(shard),
        timeout_s=timeout,
        memory_bytes=int(measure_memory() * _MEMORY_SHARE / workers)
        if memory is None
        else parse_memory_limit(memory),
        settle_s=settle,
        retries_quarantined=retry_quarantined,
        pruning=pruning if prune else None,
    )
    from pipeline.batch.batch_run import run_batch  # noqa: PLC0415 - heavy

    try:
        with open_watch(quiet=quiet or json) as watch:
            outcome = run_batch(request, watch)
    except Exception as error:
        # No logs, a full disk: nobody looks at the screen of a night.
        if notify is not None:
            from pipeline.batch.notices import note_error, send_news  # noqa: PLC0415 - heavy

            send_news(opened.root, notify, [note_error(error)], [], code=FAILED)
        raise
    lines = format_outcome(outcome, is_search=bool(logs))
    code = FAILED if outcome.has_failed else LOSSY if outcome.has_losses else CLEAN
    news, problems = ((), ()) if notify is None else _tell(outcome, opened.root, notify, lines, code)
    for problem in (*outcome.problems, *problems):
        print_error(problem)
    if json:
        print_json(_as_json(outcome, news, problems))
    elif not quiet:
        print_lines(lines)
    return FAILED if problems else code


def _tell(
    outcome: Outcome, root: Path, notify: str, lines: Sequence[str], code: int
) -> tuple[Sequence[Notice], Sequence[SlipError]]:
    """Send the news of a batch: what was sent, and why it was not."""
    from pipeline.batch import notices  # noqa: PLC0415 - heavy

    try:
        # The counts alone: the notices say which logs failed.
        counts = lines[: lines.index("")] if "" in lines else lines
        report = [*counts, "", f"page    {root.absolute() / 'index.html'}"]
        return notices.send_news(root, notify, notices.list_failures(outcome), report, code=code), ()
    except SlipError as error:
        return (), (error,)


def _as_json(outcome: Outcome, news: Sequence[Notice], problems: Sequence[SlipError]) -> dict[str, object]:
    states = [line.state for line in outcome.lines]
    return {
        **outcome.counts,
        **{name: states.count(name) for name in ("growing", "left", "skipped")},
        "seconds": round(outcome.seconds, 3),
        "removed_generations": outcome.removed,
        "logs": [asdict(line) for line in outcome.lines],
        "notified": [each.text for each in news],
        "errors": [summarize_error("", problem) for problem in (*outcome.problems, *problems)],
    }


def format_outcome(outcome: Outcome, *, is_search: bool = True) -> list[str]:
    """The closing table: how many logs came out how, and of those that need a look, why."""
    states = Counter(line.state for line in outcome.lines)
    rare = {state: states[state] for state in ("growing", "left", "skipped") if states[state]}
    lines = format_counts({**outcome.counts, **rare}, width=6)
    fetched = sum(line.fetched_bytes for line in outcome.lines)
    if fetched:
        whole = sum(line.size_bytes for line in outcome.lines if line.fetched_bytes)
        lines.append(f"fetched {fetched / 1e6:.1f} MB of {whole / 1e6:.1f} MB")
    if outcome.removed or not is_search:
        lines.append(f"{'pruned':<14}{outcome.removed:>6} old generation{'s' * (outcome.removed != 1)}")
    noted = [(_list_notes(line), (line.path, line.reason, line.hint)) for line in outcome.lines]
    for state in EXPLAINED:
        lines += explain_logs(format_state(state), [row for states, row in noted if state in states])
    copies = [row for states, row in noted if states == ["unchanged"] and row[1]]
    return lines + explain_logs("copies, counted once", copies)


def _list_notes(line: Line) -> list[str]:
    """State of a log, and notes on results that did not change."""
    notes = {"refused": line.refused, "lossy": line.lossy}
    return [line.state, *(name for name, is_so in notes.items() if is_so and name != line.state)]


def schedule(  # noqa: D417 - arguments document themselves
    *arguments: Annotated[
        str, Parameter(help="what follows `slip batch`: logs and options", allow_leading_hyphen=True)
    ],
    print: Annotated[System, Parameter(name="--print")] = "systemd",  # noqa: A002 - the promised name
    at: Annotated[str, Parameter(name="--at")] = "02:00",
    lock: Annotated[Path | None, Parameter(name="--lock")] = None,
    notify: Annotated[str | None, Parameter(name="--notify")] = None,
) -> int:
    """Print a recipe that runs `slip batch` every night.

    Runs never overlap. With systemd and cron, nights that the machine slept through are made up for, and the
    journal has what was printed.

    Args:
        print: systemd (a service and its timer), cron, airflow (a DAG) or github (a workflow of its Actions).
        at: time of day; local for systemd and cron, UTC for the others.
        notify: command line for the shell that gets new failures.
        lock: lock file (default: .slip-batch.lock in this folder).
    """
    hour, minute = parse_clock(at)
    # A misspelt option would fail every night, where nobody looks.
    try:
        build_batch().parse_args(list(arguments), exit_on_error=False, print_error=False)
    except CycloptsError as error:
        why = str(error).strip().partition(". ")[0].rstrip(".")
        what = f"slip batch does not take what would be run every night: {why}"
        raise SlipError("usage", what, hint="It takes the folders and options of `slip batch`.") from error
    folder = Path.cwd()
    nightly = Nightly(
        program=slip_command(),
        arguments=arguments,
        folder=folder,
        lock=(folder / (lock or ".slip-batch.lock")),
        hour=hour,
        minute=minute,
        notify=notify,
    )
    sys.stdout.write(print_units(nightly, print))
    return CLEAN
