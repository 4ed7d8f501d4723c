"""Commands that put this machine to work: batch, serve; and doctor, which says whether it can."""

from __future__ import annotations

import atexit
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter
from cyclopts.types import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from pipeline.batch import (
    Nightly,
    Pruning,
    Request,
    System,
    count_cores,
    parse_clock,
    parse_memory_limit,
    parse_shard,
    parse_size,
    print_units,
)
from pipeline.cli.conventions import (
    CLEAN,
    FAILED,
    LOSSY,
    Choices,
    Results,
    build_options,
    format_state,
    open_results,
    print_error,
    print_json,
    print_lines,
    print_note,
    print_result,
    summarize_error,
)
from pipeline.core import PACKAGE, SlipError, measure_memory, read_version, slip_command

if TYPE_CHECKING:
    from pipeline.batch.season import Line, Outcome

_MEMORY_SHARE = 0.8
_EXPLAINED = ("refused", "lossy", "failed", "quarantined", "growing", "skipped")


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

    The same command again continues.

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
    from pipeline.batch.season import run_batch  # noqa: PLC0415 - heavy

    with open_watch(quiet=quiet or json) as watch:
        outcome = run_batch(request, watch)
    for problem in outcome.problems:
        print_error(problem)
    if json:
        print_json(_as_json(outcome))
    elif not quiet:
        print_lines(format_outcome(outcome, is_search=bool(logs)))
    if outcome.has_failed:
        return FAILED
    return LOSSY if outcome.has_losses else CLEAN


def _as_json(outcome: Outcome) -> dict[str, object]:
    states = [line.state for line in outcome.lines]
    return {
        **outcome.counts,
        **{name: states.count(name) for name in ("growing", "left", "skipped")},
        "seconds": round(outcome.seconds, 3),
        "removed_generations": outcome.removed,
        "logs": [asdict(line) for line in outcome.lines],
        "errors": [summarize_error("", problem) for problem in outcome.problems],
    }


def format_outcome(outcome: Outcome, *, is_search: bool = True) -> list[str]:
    """The closing table: how many logs came out how, and of those that need a look, why."""
    counts = {state: count for state, count in outcome.counts.items() if count or state != "refused"}
    lines = [f"{format_state(state):<14}{count:>6}" for state, count in counts.items()]
    for state in ("growing", "left", "skipped"):
        count = sum(line.state == state for line in outcome.lines)
        lines += [f"{format_state(state):<14}{count:>6}"] if count else []
    fetched = sum(line.fetched_bytes for line in outcome.lines)
    if fetched:
        whole = sum(line.size_bytes for line in outcome.lines if line.fetched_bytes)
        lines.append(f"fetched {fetched / 1e6:.1f} MB of {whole / 1e6:.1f} MB")
    if outcome.removed or not is_search:
        lines.append(f"{'pruned':<14}{outcome.removed:>6} old generation{'s' * (outcome.removed != 1)}")
    for state in _EXPLAINED:
        noted = [line for line in outcome.lines if state in _list_notes(line)]
        if noted:
            lines += ["", format_state(state), *(text for line in noted for text in _explain(line))]
    copies = [line for line in outcome.lines if _list_notes(line) == ["unchanged"] and line.reason]
    if copies:
        lines += ["", "copies, counted once", *(text for line in copies for text in _explain(line))]
    return lines


def _list_notes(line: Line) -> list[str]:
    """State of a log, and notes on results that did not change."""
    notes = {"refused": line.refused, "lossy": line.lossy}
    return [line.state, *(name for name, is_so in notes.items() if is_so and name != line.state)]


def _explain(line: Line) -> list[str]:
    hint = [f"      {line.hint}"] if line.hint else []
    return [f"  {line.path}", f"      {line.reason}", *hint]


def schedule(  # noqa: D417 - arguments document themselves
    *arguments: Annotated[
        str, Parameter(help="what follows `slip batch`: logs and options", allow_leading_hyphen=True)
    ],
    print: Annotated[System, Parameter(name="--print")] = "systemd",  # noqa: A002 - the promised name
    at: Annotated[str, Parameter(name="--at")] = "02:00",
    lock: Annotated[Path | None, Parameter(name="--lock")] = None,
) -> int:
    """Print units that run `slip batch` every night.

    Runs never overlap, are made up after downtime, and log to the journal.

    Args:
        print: for systemd (a service and its timer) or cron.
        at: time of day, local.
        lock: lock file (default: .slip-batch.lock in this folder).
    """
    hour, minute = parse_clock(at)
    folder = Path.cwd()
    nightly = Nightly(
        program=slip_command(),
        arguments=arguments,
        folder=folder,
        lock=(folder / (lock or ".slip-batch.lock")),
        hour=hour,
        minute=minute,
    )
    sys.stdout.write(print_units(nightly, print))
    return CLEAN


def serve(  # noqa: D417 - the results folder documents itself
    results: Results = Path("results"),
    *,
    port: int = 8321,
    host: str = "127.0.0.1",
    diagnosis: Annotated[bool, Parameter(negative="--no-diagnosis")] = True,
    timeout: PositiveFloat = 1800.0,
    memory: str | None = None,
    open_browser: Annotated[bool, Parameter(name="--open")] = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Serve the workbench: add an effect, watch the error fall.

    The page needs the token of the printed address; a script sends it as the header
    `Authorization: Bearer TOKEN`.

    Args:
        port: port to listen on; 0 takes any that is free.
        host: address to listen on; anything but this machine's own opens it to the network.
        diagnosis: diagnose logs that are dropped on the page.
        timeout: longest time for an analysis or a diagnosis [s].
        memory: memory limit for one, for example 2GB (default: half of the machine's).
        open_browser: open the page in the browser.
        json: print address and token as one JSON object.
        quiet: print nothing.
    """
    from pipeline.web import Limits, is_loopback  # noqa: PLC0415 - heavy
    from pipeline.web.server import serve as serve_workbench  # noqa: PLC0415 - heavy

    def notify(address: str, token: str) -> None:
        whole = f"{address}?token={token}"
        if json:
            print_json({"address": address, "token": token})
        elif not quiet:
            print(f"workbench  {whole}    (Ctrl-C ends it)")
        sys.stdout.flush()
        if open_browser:
            _open_browser(whole)

    if not is_loopback(host):
        print_note(
            f"slip: {host} can be reached from the network: whoever has the token, or reads it on its way, "
            "can read these results and change models. Leave --host out to serve this machine only."
        )
    limits = Limits(
        timeout_s=timeout,
        memory_bytes=measure_memory() // 2 if memory is None else parse_memory_limit(memory),
    )
    serve_workbench(results, host=host, port=port, notify=notify, limits=limits, diagnosis=diagnosis)
    return CLEAN


def _open_browser(address: str) -> None:
    """Open a secret address, which must not be a command-line argument: all users can read these."""
    import tempfile  # noqa: PLC0415 - only where asked
    import webbrowser  # noqa: PLC0415 - likewise

    with tempfile.NamedTemporaryFile("w", prefix="slip-", suffix=".html", delete=False) as file:
        file.write(f'<meta http-equiv="refresh" content="0; url={address}">')
    atexit.register(Path(file.name).unlink, missing_ok=True)
    webbrowser.open(Path(file.name).as_uri())


_PYTHON = (3, 11)
_LEAST_FREE_BYTES = 3_000_000_000
"""Smallest free space for a season of logs [bytes]: four minutes of the samples produce 2.2 MB of tables
(`du` of their runs), so 100 hours need 3 GB."""
_BROWSERS = ("chromium", "chromium-browser", "google-chrome")
_REQUIREMENT = re.compile(r"([\w.-]+)(?:\[[^\]]*\])?>=([\d.]+)")


@dataclass(frozen=True)
class Check:
    """Result of one check.

    Attributes:
        name: what was looked at.
        state: `optional` where only something that few need is missing.
        text: what is there.
        hint: what to do; empty where nothing is to be done.
    """

    name: str
    state: Literal["ok", "optional", "problem"]
    text: str
    hint: str = ""


def doctor(  # noqa: D417 - the results folder documents itself
    results: Results = Path("results"), *, json: bool = False, quiet: bool = False
) -> int:
    """Check the installation, the disk and the folder of results.

    Looks at Python, packages, compiled loops, Chromium, free space, permissions, locale and time zone.

    Args:
        json: print one JSON object.
        quiet: print nothing; the exit code is 1 where there is a problem.
    """
    checks = list(_look(results))
    is_well = all(check.state != "problem" for check in checks)
    content = {"ok": is_well, "checks": [asdict(check) for check in checks]}
    print_result(content, lambda: map(_format_check, checks), json=json, quiet=quiet)
    return CLEAN if is_well else FAILED


def _format_check(check: Check) -> str:
    return f"{check.state:<10}{check.name:<16}{'. '.join(filter(None, (check.text, check.hint)))}"


def _look(results: Path) -> Iterator[Check]:
    yield _judge(
        "Python",
        f"{sys.version.split()[0]}, {sys.executable}",
        "" if sys.version_info >= _PYTHON else "Install slip with Python 3.11 or newer",
    )
    yield _look_at_packages()
    yield _look_at_loops()
    yield _look_for_browser()
    # A missing folder is created in its nearest existing parent.
    parent = next(folder for folder in (results.absolute(), *results.absolute().parents) if folder.is_dir())
    yield _look_at_disk(parent)
    yield _look_at_permission(parent)
    yield _look_at_locale()
    yield _look_at_clock()


def _judge(name: str, text: str, hint: str) -> Check:
    return Check(name, "problem" if hint else "ok", text, hint)


def _look_at_packages() -> Check:
    needed = [
        match.groups()
        for text in metadata.requires(PACKAGE) or ()
        if "extra ==" not in text and (match := _REQUIREMENT.match(text))
    ]
    wrong = []
    for name, least in needed:
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            wrong.append(f"{name} is missing")
            continue
        if _read_numbers(version) < _read_numbers(least):
            wrong.append(f"{name} is {version}, older than {least}")
    what = ": ".join(filter(None, (f"slip {read_version()}, {len(needed)} packages", ", ".join(wrong))))
    return _judge("packages", what, "Install slip again, as its handbook says" if wrong else "")


def _read_numbers(version: str) -> list[int]:
    return [int(part) for part in re.findall(r"\d+", version.partition("+")[0])]


def compile_every_loop() -> int:
    """Compile the loops of the estimation and of every effect; the number of loops compiled."""
    import pipeline.estimation  # noqa: F401, PLC0415 - heavy; loops are known where they are imported
    from pipeline.core.machine_code import count_loops  # noqa: PLC0415
    from pipeline.models import list_effects  # noqa: PLC0415

    list_effects()
    return count_loops()


def _look_at_loops() -> Check:
    from pipeline.core.machine_code import list_caches  # noqa: PLC0415 - heavy

    name = "compiled loops"
    count = compile_every_loop()
    caches = list_caches()
    if not caches:
        what = f"{count} loops run as Python, 100 times slower"
        return Check(name, "problem", what, "Unset NUMBA_DISABLE_JIT")
    if None in caches:
        where = "beside the installation or in the user's cache"
        hint = "Set NUMBA_CACHE_DIR to a folder that you may write to"
        return Check(name, "problem", f"every process compiles {count} loops: none can be kept {where}", hint)
    folders = ", ".join(sorted(str(folder) for folder in caches))
    return Check(name, "ok", f"{count} kept in {folders}")


def _look_for_browser() -> Check:
    path = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if path:
        return Check("Chromium", "ok", path)
    what = "not found; reports and figures do without it"
    return Check("Chromium", "optional", what, "For pictures of pages and their tests: make browser")


def _look_at_disk(folder: Path) -> Check:
    free = shutil.disk_usage(folder).free
    hint = "" if free >= _LEAST_FREE_BYTES else "Free some, or name another disk with --results"
    return _judge("disk", f"{free / 1e9:.1f} GB free at {folder}", hint)


def _look_at_permission(folder: Path) -> Check:
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        hint = "Give your user the right to write there, or name another folder with --results"
        return Check("permission", "problem", f"{folder} cannot be written to: {error.strerror}", hint)
    return Check("permission", "ok", f"{folder} can be written to")


def _look_at_locale() -> Check:
    names, screen = sys.getfilesystemencoding(), sys.stdout.encoding
    hint = "" if {names.lower(), screen.lower()} == {"utf-8"} else "Set LC_ALL=C.UTF-8, or PYTHONUTF8=1"
    return _judge("locale", f"file names in {names}, screen in {screen}", hint)


def _look_at_clock() -> Check:
    from zoneinfo import ZoneInfo  # noqa: PLC0415 - only here

    named = os.environ.get("TZ", "").removeprefix(":")
    zone = time.strftime("%Z, UTC%z")
    if named:
        try:
            ZoneInfo(named)
        except (OSError, ValueError, LookupError):
            hint = "Set TZ to a name such as Europe/Berlin, or unset it"
            return Check("time zone", "problem", f"TZ={named} is not known, times are shown in UTC", hint)
    return Check("time zone", "ok", f"{zone}; results are in UTC")
