"""Are results and logs still what they were?"""

from collections.abc import Callable
from dataclasses import dataclass

from pipeline.batch.repair import Repair, repair_results
from pipeline.core.errors import SlipError
from pipeline.logs import hash_log, locate_recorded
from pipeline.store import Examination, Mirror, Problem, Store
from pipeline.store.sampling import Sample, Tally

_NOT_FOLLOWED = "remote_not_followed"


@dataclass(frozen=True, kw_only=True)
class LogProblem:
    """A log that is not what its results were made of.

    Attributes:
        run: its run.
        path: where it stood.
        code: ``log_gone``, ``log_changed``, ``log_unreadable``, ...
        what: one sentence without a full stop.
    """

    run: str
    path: str
    code: str
    what: str


@dataclass(frozen=True, kw_only=True)
class Verification:
    """What was found.

    Attributes:
        logs: problems of logs.
        gone: logs that have been moved away since: no damage, but nothing to compute the run from again.
        remote: logs at addresses that only the results name, and that were not asked.
        checked: runs looked at.
        examination: of the files.
        read_logs: how many logs of how many were read.
        repairs: what was done, or can be done, about the problems of files; empty where it was not asked for.
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
    def unlisted(self) -> tuple[str, ...]:
        """Names in the results whose right content nothing tells: written before there was a list."""
        return self.examination.unlisted

    @property
    def is_clean(self) -> bool:
        """Whether nothing is damaged."""
        return not self.files and not self.logs


def verify_results(
    store: Store,
    *,
    logs: bool,
    tell: Callable[[str], None],
    mirror: Mirror | None = None,
    repair: bool = False,
    follow_remote: bool = False,
    sample: Sample | None = None,
) -> Verification:
    """Read all files of the results again, and the logs if wanted.

    Args:
        store: the results.
        logs: whether to read the logs, which takes as long as the disk needs for them.
        tell: told the name of each run whose log is about to be read.
        mirror: the mirror that the store is, if the results are on an object store.
        repair: whether to have made again what can be.
        follow_remote: whether addresses that the results name are asked for their logs.
        sample: of the files and logs, those that are read; None for all.

    Raises:
        StoreError: the results cannot be written, or the key cannot be read.
    """
    examination = (mirror or store).examine(sample)
    repairs = repair_results(store, examination, mirror, follow_remote=follow_remote) if repair else ()
    manifests = store.survey().manifests
    found: list[LogProblem] = []
    tally = Tally()
    for manifest in manifests if logs else ():
        log = manifest.part("log")
        if log and tally.draws(sample, manifest.run):
            tell(manifest.run)
            path, sha256 = str(log.get("path")), str(log.get("sha256"))
            problem = _check_log(manifest.run, path, sha256, follow_remote=follow_remote)
            found += [] if problem is None else [problem]
    aside = {"log_gone", _NOT_FOLLOWED}
    return Verification(
        logs=tuple(problem for problem in found if problem.code not in aside),
        gone=tuple(problem for problem in found if problem.code == "log_gone"),
        remote=tuple(problem for problem in found if problem.code == _NOT_FOLLOWED),
        checked=len(manifests),
        examination=examination,
        read_logs=tally,
        repairs=repairs,
    )


def _check_log(run: str, path: str, sha256: str, *, follow_remote: bool) -> LogProblem | None:
    code, what = "log_changed", "the log is not the one that the results were made of"
    try:
        location = locate_recorded(path, follow_remote=follow_remote)
        # Results may be a stranger's: of what stands under that path, only files are opened.
        if not (location.is_file() or location.is_dir()):
            code, what = "log_gone", "the log is not there any more"
        elif hash_log(location) == sha256:
            return None
    except SlipError as error:
        code, what = error.code, error.what
    return LogProblem(run=run, path=path, code=code, what=what)
