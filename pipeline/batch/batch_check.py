"""Status of a batch (done, failed, quarantined), and verification and repair of results."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import groupby

from pipeline.batch.batch_plan import forget_pools, measure_results
from pipeline.batch.batch_work import Entry, Ledger, see_nothing
from pipeline.core import SlipError
from pipeline.logs import LogError, hash_log, locate_recorded
from pipeline.report import count_logs, list_noted
from pipeline.store import (
    MANIFEST,
    RUNS,
    UPLOADS,
    Examination,
    LastBatch,
    Manifest,
    Problem,
    Sample,
    Store,
    StoreError,
    Tally,
    encode_run,
    list_old,
    read_last_batch,
)

_UNREADABLE = {"manifest_damaged", "name_clash"}


@dataclass(frozen=True, kw_only=True)
class Repair:
    """Action taken for a problem.

    Attributes:
        subject: a run, or the name of a file in the results.
        action: ``queued``: the next batch over its log makes it again; ``removed``: it was unusable;
            ``lost``: it cannot be made again; ``left``: see ``what``.
        what: one sentence without a full stop.
    """

    subject: str
    action: str
    what: str


def repair_results(
    store: Store, examination: Examination, *, follow_remote: bool = False
) -> tuple[Repair, ...]:
    """Schedule or perform all possible repairs; no usable result is removed.

    Args:
        store: the results.
        examination: problems of the results.
        follow_remote: whether to look for logs at addresses that the results contain.

    Raises:
        StoreError: the results cannot be written.
    """
    repairs = [_repair_file(store, problem) for problem in examination.problems if not problem.home]
    entries = Ledger(store).read_all().values()
    logs = {f"{RUNS}/{encode_run(entry.run)}": entry.log.path for entry in entries if entry.run}
    manifests = {one.home: one for one in store.survey().manifests}
    of_runs = sorted((each for each in examination.problems if each.home), key=lambda each: each.home)
    for home, some in groupby(of_runs, key=lambda each: each.home):
        problems = list(some)
        codes = {problem.code for problem in problems}
        manifest = manifests.get(store.root / home)
        log = logs.get(home, "") or ("" if manifest is None else str(manifest.part("log").get("path") or ""))
        action, what = _repair_run(store, home, codes, (manifest, log), follow_remote=follow_remote)
        repairs.append(Repair(subject=problems[0].run, action=action, what=what))
    return tuple(repairs)


def _repair_file(store: Store, problem: Problem) -> Repair:
    name = problem.path.relative_to(store.root).as_posix()
    if problem.code == "left_out":
        return Repair(subject=name, action="left", what="find out who made it, and remove it")
    store.remove(name)
    forget_pools(store)
    return Repair(subject=name, action="removed", what="no result is lost")


def _repair_run(
    store: Store, home: str, codes: set[str], known: tuple[Manifest | None, str], *, follow_remote: bool
) -> tuple[str, str]:
    """Action and its text for the problems of a run, whose manifest and path of the log are known."""
    if "other_version" in codes:
        return "left", "another version of slip wrote it: use that one"
    if codes == {"extra_file"}:
        return "left", "all that was written is intact; remove the files that were not written with it"
    manifest, log = known
    try:
        location = locate_recorded(log, follow_remote=follow_remote) if log else None
    except LogError as error:
        return "left", f"its log is at {log}: {error.what}"
    if location is None or not (location.is_file() or location.is_dir()):
        why = f"its log {log} is gone" if log else "its log is not known"
        return "lost", f"it cannot be made again: {why}"
    if codes & _UNREADABLE:
        # No reader can use it, and no writer can replace it.
        store.remove(f"{home}/{MANIFEST}")
    elif manifest is not None:
        store.ask_again(manifest)
    return "queued", f"the next batch over {log} makes it again"


_NOT_FOLLOWED = "remote_not_followed"


@dataclass(frozen=True, kw_only=True)
class LogProblem:
    """Mismatch between a log and the results made from it.

    Attributes:
        run: name of the run.
        path: recorded path of the log.
        code: ``log_gone``, ``log_changed``, ``log_unreadable``, ...
        what: one sentence without a full stop.
    """

    run: str
    path: str
    code: str
    what: str


@dataclass(frozen=True, kw_only=True)
class Verification:
    """Result of a verification.

    Attributes:
        logs: problems of logs.
        gone: logs moved away since: the results are intact, but the run cannot be computed again.
        remote: logs at addresses that only the results contain, which were not contacted.
        checked: number of runs checked.
        examination: examination of the files.
        read_logs: number of logs read, and their total.
        repairs: repairs done or possible for the problems of files; empty if not requested.
    """

    logs: tuple[LogProblem, ...]
    gone: tuple[LogProblem, ...]
    remote: tuple[LogProblem, ...]
    checked: int
    examination: Examination
    read_logs: Tally
    repairs: tuple[Repair, ...] = ()

    @property
    def files(self) -> tuple[Problem, ...]:
        """Problems of files of the results."""
        return self.examination.problems

    @property
    def is_clean(self) -> bool:
        """Whether nothing is damaged."""
        return not self.files and not self.logs


def verify_results(
    store: Store,
    *,
    logs: bool,
    notify: Callable[[str], None],
    repair: bool = False,
    follow_remote: bool = False,
    sample: Sample | None = None,
) -> Verification:
    """Read all files of the results again, and the logs on request.

    Args:
        store: the results.
        logs: whether to read the logs, which takes as long as reading them from disk.
        notify: called with the name of each run before its log is read.
        repair: whether to repair what can be repaired.
        follow_remote: whether to look for logs at addresses that the results contain.
        sample: sample of the files and logs to read; None for all.

    Raises:
        StoreError: the results cannot be written.
    """
    examination = store.examine(sample)
    repairs = repair_results(store, examination, follow_remote=follow_remote) if repair else ()
    manifests = store.survey().manifests
    problems: list[LogProblem] = []
    tally = Tally()
    for manifest in manifests if logs else ():
        log = manifest.part("log")
        if log and tally.draws(sample, manifest.run):
            notify(manifest.run)
            path, sha256 = str(log.get("path")), str(log.get("sha256"))
            problem = _check_log(manifest.run, path, sha256, follow_remote=follow_remote)
            # The workbench deletes uploaded logs after their analysis.
            deleted = problem is not None and problem.code == "log_gone" and f"/{UPLOADS}/" in path
            problems += [] if problem is None or deleted else [problem]
    aside = {"log_gone", _NOT_FOLLOWED}
    return Verification(
        logs=tuple(problem for problem in problems if problem.code not in aside),
        gone=tuple(problem for problem in problems if problem.code == "log_gone"),
        remote=tuple(problem for problem in problems if problem.code == _NOT_FOLLOWED),
        checked=len(manifests),
        examination=examination,
        read_logs=tally,
        repairs=repairs,
    )


def _check_log(run: str, path: str, sha256: str, *, follow_remote: bool) -> LogProblem | None:
    code, what = "log_changed", "the log is not the one that the results were made of"
    try:
        location = locate_recorded(path, follow_remote=follow_remote)
        # Results may be untrusted: under that path, only files are opened.
        if not (location.is_file() or location.is_dir()):
            code, what = "log_gone", "the log is not there any more"
        elif hash_log(location) == sha256:
            return None
    except SlipError as error:
        code, what = error.code, error.what
    return LogProblem(run=run, path=path, code=code, what=what)


@dataclass(frozen=True, kw_only=True)
class Status:
    """Summary of the results.

    Attributes:
        runs: runs with results.
        writers: who writes which run now, by the folder of the run.
        entries: batch outcome of each log, sorted by path; without logs that gave no results and no longer
            exist.
        counts: logs by state, each of `LOG_STATES`.
        bytes: size of the results, old generations included.
        old_generations: generations that are not current.
        errors: runs that cannot be read, and folders that were not read.
        batch: the last batch.
    """

    runs: int
    writers: Mapping[str, str]
    entries: tuple[Entry, ...]
    counts: Mapping[str, int]
    bytes: int
    old_generations: int
    errors: tuple[StoreError, ...]
    batch: LastBatch


def read_status(store: Store) -> Status:
    """Read the status from the results and the ledger."""
    survey = store.survey()
    known = Ledger(store).read_all()
    noted = list_noted(store)
    # What no batch could look at has no entry.
    entries = tuple(
        replace(
            known.get(path := note["path"]) or Entry(log=see_nothing(path), fingerprint="", state=""),
            state=note["state"],
            reason=note["reason"],
            hint=note["hint"],
        )
        for note in noted
    )
    size, unread = measure_results(store)
    return Status(
        runs=len(survey.manifests),
        writers=store.list_writers(),
        entries=entries,
        counts=count_logs(noted),
        bytes=size,
        old_generations=sum(len(list_old(manifest)) for manifest in survey.manifests),
        errors=(*survey.errors, *unread),
        batch=read_last_batch(store),
    )
