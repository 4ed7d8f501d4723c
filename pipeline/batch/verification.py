"""Are results and logs still what they were?"""

from collections.abc import Callable
from dataclasses import dataclass

from pipeline.batch.repair import Repair, repair_results
from pipeline.core.errors import SlipError
from pipeline.logs import hash_log, to_location
from pipeline.store import Mirror, Problem, Store


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
        files: problems of files of the results.
        logs: problems of logs.
        gone: logs that have been moved away since: no damage, but nothing to compute the run from again.
        checked: runs looked at.
        unlisted: names in the results whose right content nothing tells: written before there was a list.
        repairs: what was done, or can be done, about the problems of files; empty where it was not asked for.
    """

    files: tuple[Problem, ...]
    logs: tuple[LogProblem, ...]
    gone: tuple[LogProblem, ...]
    checked: int
    unlisted: tuple[str, ...] = ()
    repairs: tuple[Repair, ...] = ()

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
) -> Verification:
    """Read all files of the results again, and the logs if wanted.

    Args:
        store: the results.
        logs: whether to read the logs, which takes as long as the disk needs for them.
        tell: told the name of each run whose log is about to be read.
        mirror: the mirror that the store is, if the results are on an object store.
        repair: whether to have made again what can be.
    """
    examination = store.examine() if mirror is None else mirror.examine()
    repairs = repair_results(store, examination, mirror) if repair else ()
    manifests = store.survey().manifests
    found: list[LogProblem] = []
    for manifest in manifests if logs else ():
        if log := manifest.part("log"):
            tell(manifest.run)
            problem = _check_log(manifest.run, str(log.get("path")), str(log.get("sha256")))
            found += [] if problem is None else [problem]
    return Verification(
        files=examination.problems,
        logs=tuple(problem for problem in found if problem.code != "log_gone"),
        gone=tuple(problem for problem in found if problem.code == "log_gone"),
        checked=len(manifests),
        unlisted=examination.unlisted,
        repairs=repairs,
    )


def _check_log(run: str, path: str, sha256: str) -> LogProblem | None:
    code, what = "log_changed", "the log is not the one that the results were made of"
    try:
        location = to_location(path)
        # Results may be a stranger's: of what stands under that path, only files are opened.
        if not (location.is_file() or location.is_dir()):
            code, what = "log_gone", "the log is not there any more"
        elif hash_log(path) == sha256:
            return None
    except SlipError as error:
        code, what = error.code, error.what
    return LogProblem(run=run, path=path, code=code, what=what)
