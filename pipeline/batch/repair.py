"""What can be made again of results that are not what was written, and having it made by the next batch."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

from pipeline.batch.ledger import Ledger
from pipeline.batch.pooling import POOLED, forget_pools
from pipeline.logs import LogError, locate_recorded
from pipeline.store import Examination, Mirror, Problem, Store
from pipeline.store.listing import entry_name, is_run_manifest
from pipeline.store.manifest import MANIFEST
from pipeline.store.manifest_file import parse_manifest
from pipeline.store.names import encode_run
from pipeline.store.register import KEY_MARK, REGISTER
from pipeline.store.verification import DiskFiles

_UNSEALED = "without the right key nothing tells whether it is what was written"
_LEFT = {
    "left_out": "look at who made it, and remove it",
    "not_sealed": _UNSEALED,
    "other_key": _UNSEALED,
    KEY_MARK: _UNSEALED,
}
"""What is said of files that nobody but the user can mend, by code or name."""
_UNREADABLE = ("manifest_damaged", "name_clash")
_VERBS = {"comparison": "slip compare", "trend": "slip trend", "map": "slip map"}
"""What makes the files over all runs whose names begin so."""


@dataclass(frozen=True, kw_only=True)
class Repair:
    """What was done about something.

    Attributes:
        subject: a run, or the name of a file in the results.
        action: ``queued``: the next batch over its log makes it again; ``listed``: it is on the list now;
            ``removed``: nobody could use it; ``lost``: it cannot be made again; ``left``: see ``what``.
        what: one sentence without a full stop.
    """

    subject: str
    action: str
    what: str


def repair_results(
    store: Store, examination: Examination, mirror: Mirror | None = None, *, follow_remote: bool = False
) -> tuple[Repair, ...]:
    """Have made again what can be; no result that somebody may still use is removed.

    Args:
        store: the results.
        examination: what is wrong with them.
        mirror: the mirror that the store is, if the results are on an object store.
        follow_remote: whether addresses that the results name are asked for their logs.

    Raises:
        StoreError: the results cannot be written.
    """
    return tuple(_Repairer(store, examination, mirror, follow_remote=follow_remote).repair())


class _Repairer:
    def __init__(
        self, store: Store, examination: Examination, mirror: Mirror | None, *, follow_remote: bool
    ) -> None:
        self._store = store
        self._follow_remote = follow_remote
        self._place = mirror or store
        self._files = mirror or DiskFiles(store.root)
        self._examination = examination
        entries = Ledger(store).read_all().values()
        self._logs: Mapping[str, str] = {
            f"runs/{encode_run(entry.run)}": entry.log.path for entry in entries if entry.run
        }

    def repair(self) -> Iterator[Repair]:
        problems = self._examination.problems
        for problem in problems:
            if not problem.home:
                yield self._repair_mark(problem) or self._repair_file(problem)
        of_runs = sorted((each for each in problems if each.home), key=lambda each: each.home)
        for home, some in groupby(of_runs, key=lambda each: each.home):
            yield self._repair_run(home, list(some))
        for name in self._examination.unlisted if self._examination.seal == "none" else ():
            if is_run_manifest(name) or "/" not in name:
                self._place.put_on_list(name)
                yield Repair(subject=name, action="listed", what="it is on the list as it is")

    def _repair_file(self, problem: Problem) -> Repair:
        name = problem.path.relative_to(self._store.root).as_posix()
        left = _LEFT.get(KEY_MARK if name == KEY_MARK else problem.code)
        if left is not None:
            return Repair(subject=name, action="left", what=left)
        if name == REGISTER:
            # The entry first: a register that the list does not speak of is not renewed meanwhile.
            for each in (entry_name(REGISTER), REGISTER):
                self._place.remove(each)
            what = "the next `slip batch` makes it again, of the entries that there are"
            return Repair(subject=name, action="removed", what=what)
        if problem.code in {"list_damaged", "note_damaged"}:
            self._place.remove(name)
            forget_pools(self._store)
            return Repair(subject=name, action="removed", what="nothing is lost by it")
        if name in POOLED:
            forget_pools(self._store)
            return Repair(subject=name, action="queued", what="the next `slip batch` makes it again")
        verb = next((verb for start, verb in _VERBS.items() if name.startswith(start)), "slip batch")
        if problem.code == "file_missing":
            self._place.remove(entry_name(name))
            what = f"it is off the list; `{verb}` makes it again"
            return Repair(subject=name, action="removed", what=what)
        return Repair(subject=name, action="left", what=f"`{verb}` makes it again")

    def _repair_mark(self, problem: Problem) -> Repair | None:
        """List what says which key seals the results, where that is at hand and only the entry is gone."""
        is_mark = problem.path == self._store.root / KEY_MARK
        codes = {each.code for each in self._examination.problems if each.path == problem.path}
        if not is_mark or self._examination.seal != "checked" or codes != {"not_listed"}:
            return None
        self._place.put_on_list(KEY_MARK)
        return Repair(subject=KEY_MARK, action="listed", what="it names the key; it is on the list as it is")

    def _repair_run(self, home: str, problems: Sequence[Problem]) -> Repair:
        subject = problems[0].run
        codes = {problem.code for problem in problems}
        if codes == {"not_listed"} and self._examination.seal != "none":
            codes.add("not_sealed")
        if codes == {"not_listed"}:
            self._place.put_on_list(f"{home}/{MANIFEST}")
            return Repair(
                subject=subject, action="listed", what="all its files are whole; it is on the list as it is"
            )
        left = _tell_left(codes)
        if left:
            return Repair(subject=subject, action="left", what=left)
        log = self._find_log(home)
        try:
            location = locate_recorded(log, follow_remote=self._follow_remote) if log else None
        except LogError as error:
            return Repair(subject=subject, action="left", what=f"its log is at {log}: {error.what}")
        if location is None or not (location.is_file() or location.is_dir()):
            return self._give_up(subject, home, codes, log)
        self._queue(home, codes)
        return Repair(subject=subject, action="queued", what=f"the next batch over {log} makes it again")

    def _give_up(self, subject: str, home: str, codes: set[str], log: str) -> Repair:
        why = f"its log {log} is gone" if log else "its log is not known"
        if codes == {"run_missing"}:
            self._place.remove(entry_name(f"{home}/{MANIFEST}"))
            why = f"{why}; it is off the list"
        return Repair(subject=subject, action="lost", what=f"it cannot be made again: {why}")

    def _queue(self, home: str, codes: set[str]) -> None:
        name = f"{home}/{MANIFEST}"
        if codes & set(_UNREADABLE):
            # No reader could use it, and no writer would go past it.
            self._place.remove(name)
        elif "run_missing" not in codes:
            data = self._files.read(name)
            if data is not None:
                self._store.ask_again(parse_manifest(data, self._store.root / home))

    def _find_log(self, home: str) -> str:
        name = f"{home}/{MANIFEST}"
        entry = self._examination.entries.get(name)
        return (entry.log if entry is not None else "") or self._logs.get(home, "")


def _tell_left(codes: set[str]) -> str:
    """What is said of a run that needs not be made again, or cannot be; empty for another."""
    if "manifest_too_new" in codes:
        return "a newer version wrote it: use that one"
    if not codes <= {"old_generation", "not_listed", "extra_file"}:
        return ""
    if "extra_file" in codes:
        return "all that was written is whole; remove the files that were not written with it"
    return "the current results are whole; remove old ones with `slip batch --prune --keep 0`"
