"""Before and after a batch: which logs are done and what their runs are called; pages and pruning."""

import hashlib
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path

import msgspec

from pipeline.analysis import Options
from pipeline.analysis.analyze import update_datasets
from pipeline.analysis.work import VERSIONS
from pipeline.batch import BatchError, Pruning, Request
from pipeline.batch.batch_work import WITH_RESULTS, Entry, Ledger, Task, see_nothing
from pipeline.batch.recordings import Recordings
from pipeline.core import SlipError, read_bounded, read_version, walk_files
from pipeline.estimation.stored_diagnosis import STAGE, VERSION
from pipeline.logs import LogError, hash_log, to_location
from pipeline.sources import list_configuration_files, list_presets, match_globs, read_tables
from pipeline.store import (
    LogIdentities,
    Manifest,
    Store,
    StoreError,
    add_digits,
    hash_json,
    name_distinctly,
    path_unread,
    recorded_path,
    see_log,
)
from schemas import contract_of, list_contracts

# Fingerprint of a log: a hash of everything that its results depend on except the log itself.
#
# It covers more than the keys of the stages, so that it is available without opening the log. If it differs,
# the keys decide what has to be computed.

_WITHOUT_INFLUENCE = ("out", "run", "config", "fleet", "listed", "report", "figures", "force")
"""Options without influence on the tables, or whose content is hashed separately."""


class Fingerprinter:
    """Fingerprints of many logs, reading each configuration file once.

    Args:
        options: options of the user.
    """

    def __init__(self, options: Options) -> None:
        self._options = options
        asked = {each.name: getattr(options, each.name) for each in fields(options)}
        asked = {name: value for name, value in asked.items() if name not in _WITHOUT_INFLUENCE}
        self._shared = hash_json([msgspec.to_builtins(asked, enc_hook=str), _fingerprint_program()])
        self._contents: dict[Path, str] = {}

    def find_fingerprint(self, log: Path, listed: Path | None = None) -> str:
        """That of one log; ``listed`` is its path by the links that lead to it, if there are any."""
        given, fleet = self._options.config, self._options.fleet
        files = list_configuration_files(log, given=given, fleet=fleet, listed=listed)
        names = [] if listed is None else [str(listed)]
        return hash_json([self._shared, [[str(file), self._hash_content(file)] for file in files], *names])

    def _hash_content(self, file: Path) -> str:
        known = self._contents.get(file)
        if known is None:
            try:
                known = hashlib.sha256(read_bounded(file)).hexdigest()
            except OSError as error:
                known = f"unreadable: {error.errno}"
            self._contents[file] = known
        return known


@cache
def _fingerprint_program() -> object:
    # The contracts import a table library, which a batch needs anyway.

    return [
        {**VERSIONS, STAGE: VERSION},
        read_version(),
        {contract.name: contract.version for contract in list_contracts()},
        [msgspec.to_builtins(vehicle) for vehicle in list_presets()],
        msgspec.to_builtins(read_tables()),
    ]


# Names of runs for many logs at once: independent of the order and number of workers.
#
# A content keeps its run, whatever its log is called by now, and counts once, under the name of the first. Of
# other logs a path keeps its run. New names have as many folders as tell the logs apart.


@dataclass(frozen=True)
class KnownRun:
    """Run with results: its name; the hash and size [bytes] of its log, and where that is or was."""

    run: str
    sha256: str
    size: int
    path: Path


def name_runs(
    sizes: Mapping[Path, int],
    known: Sequence[KnownRun],
    others: Collection[Path],
    find_hash: Callable[[Path], str],
    is_present: Callable[[str], bool],
    name_listed: Callable[[Path], Path],
) -> tuple[dict[Path, str], dict[Path, str]]:
    """Name the runs of the logs to work on; no two of them get the same.

    Args:
        sizes: size of each log [bytes].
        known: the runs that have results.
        others: logs of the batch that there is nothing to do for, and that are no copies.
        find_hash: hash of a log, empty if it cannot be read; called where a log may hold what another one
            does or did, by its size, or needs digits of its hash.
        is_present: whether the log of a run with results is still there, unchanged and of this batch.
        name_listed: the path of a log as its folder lists it.

    Returns:
        The run of each log by its path, none for one that cannot be read; and of each log that is a copy, the
        run with the same content.
    """
    alike = Counter(size for _, size in {*sizes.items(), *((each.path, each.size) for each in known)})
    hashes = {path: find_hash(path) for path, size in sizes.items() if alike[size] > 1}
    holders = {each.sha256: each for each in known}
    locations = {each.run: each.path for each in known}
    runs: dict[Path, str] = {}
    copies: dict[Path, str] = {}
    claimed: set[str] = set()
    for path in sorted(hashes):
        if (holder := holders.get(hashes[path])) is not None:
            # A log that was moved keeps its run: its results stay valid.
            is_copy = path != holder.path and (holder.run in claimed or is_present(holder.run))
            (copies if is_copy else runs)[path] = holder.run
            claimed |= set() if is_copy else {holder.run}
    by_path = {each.path: each.run for each in known if each.run not in claimed}
    rest = sorted(sizes.keys() - runs.keys() - copies.keys(), key=lambda path: (path not in by_path, path))
    first: dict[str, Path] = {}
    twins = {path: first.setdefault(hashes.get(path) or str(path), path) for path in rest}
    locations |= {run: path for path, run in runs.items()}
    fresh = [path for path in rest if twins[path] == path and path not in by_path]
    names = name_distinctly({path: name_listed(path) for path in (*locations.values(), *others, *fresh)})
    for path in rest:
        if twins[path] != path:
            copies[path] = runs[twins[path]]
            continue
        run = by_path.get(path) or names[path]
        if path not in by_path and run in locations:
            content = hashes.get(path) or find_hash(path)
            run = add_digits(run, content) if content else ""
        locations[run] = path
        runs[path] = run
    return runs, copies


def make_plan(
    listed: Recordings, store: Store, request: Request
) -> tuple[list[Task], list[Entry], list[str]]:
    """Compare the logs with the results.

    Args:
        listed: recordings, absolute, sorted.
        store: the results.
        request: options of the user.

    Returns:
        The logs to work on, the largest first, so that no worker starts it when the others have finished; and
        the entries of those to skip: done, copies, quarantined, ignored; with a time if a batch before this
        one came to the same; and what is to be ignored and is not there.
    """
    ledger = Ledger(store).read_all()
    manifests = {manifest.run: manifest for manifest in store.survey().manifests}
    # A pipe or a dead link may be ignored like a log.
    odd = [each.path for each in listed.skipped if each.is_entry]
    fleet = request.options.fleet
    matches = {
        path: match_globs(listed.name_listed(path), fleet)
        for path in (*listed.recordings, *listed.growing, *odd)
    }
    ignored = {
        path: _format_rule(*rules[0])
        for path, matching in matches.items()
        if path not in listed.growing
        and (rules := [rule for rule, fits in matching.items() if fits and rule[1] == "ignore"])
    }
    used = {rule for matching in matches.values() for rule, fits in matching.items() if fits}
    # Of the logs of a folder that was not asked for, only some are known.
    unused = [
        f"{_format_rule(*rule)} matched no log"
        for rule in dict.fromkeys(rule for matching in matches.values() for rule in matching)
        if rule not in used and (rule[0] == fleet or listed.covers(rule[0].parent))
    ]
    settled = [_ignore(path, why, ledger, store) for path, why in ignored.items()]
    paths = [path for path in listed.recordings if path not in ignored]
    hasher = Fingerprinter(request.options)
    tasks = [_look_at(path, listed.name_listed(path), hasher, ledger, request.options) for path in paths]
    owners = _find_owners(tasks, manifests)
    settled += [
        task.before for task in tasks if task.before and _is_settled(task, manifests, owners, request)
    ]
    done = {entry.log.path: entry.state for entry in settled}
    runs, copies = _name_tasks(tasks, done, manifests, owners, store, listed)
    todo: list[Task] = []
    for task in tasks:
        if task.path in copies:
            reason = copies[task.path]
            content = LogIdentities(store).lookup(task.path) or ""
            entry = Entry(
                log=task.log, fingerprint=task.fingerprint, state="copy", key=content, reason=reason
            )
            Ledger(store).write(entry)
            settled.append(entry)
        elif task.log.path not in done:
            todo.append(replace(task, options=replace(task.options, run=runs.get(task.path, ""))))
    return sorted(todo, key=lambda task: (-task.log.size, task.path)), settled, unused


def _format_rule(file: Path, kind: str, glob: str) -> str:
    return f'{file}: {"ignore" if kind == "ignore" else "[[match]] glob"} = "{glob}"'


def _ignore(path: Path, why: str, ledger: Mapping[str, Entry], store: Store) -> Entry:
    """The entry of a log that a fleet file ignores: that of the batch before, if nothing has changed."""
    log = see_nothing(str(path))
    with suppress(OSError, SlipError):
        log = see_log(path)
    entry = Entry(log=log, fingerprint="", state="ignored", reason=why)
    before = ledger.get(log.path)
    if (
        before is not None
        and before.log.is_same_file(log)
        and (before.state, before.reason) == ("ignored", why)
    ):
        return before
    Ledger(store).write(entry)
    return entry


def _look_at(
    path: Path, shown: Path, hasher: Fingerprinter, ledger: Mapping[str, Entry], options: Options
) -> Task:
    # Unreadable logs are processed all the same: this reports what is wrong with them.
    log, fingerprint = see_nothing(str(path)), ""
    options = replace(options, listed=None if shown == path else shown)
    with suppress(OSError, SlipError):
        log = see_log(path)
        fingerprint = hasher.find_fingerprint(path, options.listed)
    before = ledger.get(log.path)
    return Task(path=path, log=log, fingerprint=fingerprint, options=options, before=before)


def _find_owners(tasks: Sequence[Task], manifests: Mapping[str, Manifest]) -> dict[str, str]:
    """Path of the log of each run: the first of those that are there and had its results."""
    owners: dict[str, str] = {}
    for task in sorted(tasks, key=lambda task: task.log.path):
        entry = task.before
        if entry is not None and entry.key and entry.state in WITH_RESULTS and entry.run in manifests:
            owners.setdefault(entry.run, task.log.path)
    return owners


def _is_settled(
    task: Task, manifests: Mapping[str, Manifest], owners: Mapping[str, str], request: Request
) -> bool:
    """Whether there is nothing to do for a log that a batch has seen before."""
    entry = task.before
    manifest = None if entry is None else manifests.get(entry.run)
    is_asked_for = request.options.force or (manifest is not None and manifest.again)
    if entry is None or not entry.fits(task.log, task.fingerprint) or is_asked_for:
        return False
    if entry.state == "quarantined":
        # With more time or memory than it has exceeded it may come to an end.
        return not request.retries_quarantined and request.find_limit(entry.code) <= entry.limit
    if entry.lasts:
        return True
    if entry.state == "copy":
        original = manifests.get(entry.reason)
        log = {} if original is None else original.part("log")
        path = str(log.get("path") or "")
        # The run may hold another content by now.
        return (
            bool(path)
            and entry.key in {"", str(log.get("sha256"))}
            and (entry.reason in owners or "://" in path or Path(path).exists())
        )
    if entry.state not in WITH_RESULTS or manifest is None or owners.get(entry.run) != task.log.path:
        return False
    return manifest.key == entry.key and (entry.has_report or not request.options.report)


def _name_tasks(
    tasks: Sequence[Task],
    done: Mapping[str, str],
    manifests: Mapping[str, Manifest],
    owners: Mapping[str, str],
    store: Store,
    listed: Recordings,
) -> tuple[dict[Path, str], dict[Path, str]]:
    """Runs of the logs to work on, and of those that are copies the run of the same content.

    Args:
        tasks: all logs but the ignored ones.
        done: states of the logs that there is nothing to do for, by path.
        manifests: the results by run.
        owners: path of the log of each run.
        store: the results.
        listed: the recordings.
    """
    identities = LogIdentities(store)
    logs = {run: log for run, manifest in manifests.items() if (log := manifest.part("log"))}
    paths = {run: str(to_location(str(log.get("path")))) for run, log in logs.items()} | dict(owners)
    locations = {task.log.path: task.path for task in tasks}
    known = [
        KnownRun(run, str(log.get("sha256")), size, locations.get(paths[run]) or to_location(paths[run]))
        # Of the runs that a path had, the last is that of its log.
        for run, log in sorted(logs.items(), key=lambda item: item[0] in owners)
        if isinstance(size := log.get("bytes"), int)
    ]

    def find_hash(path: Path) -> str:
        if (content := identities.lookup(path)) is None:
            try:
                seen = see_log(path)
                content = hash_log(path)
            except (LogError, OSError):
                # The later analysis of the log reports the error.
                return ""
            identities.remember(path, content, seen=seen)
        return content

    def is_present(run: str) -> bool:
        location = locations.get(paths[run])
        return location is not None and find_hash(location) == logs[run].get("sha256")

    sizes = {task.path: task.log.size for task in tasks if task.log.path not in done}
    others = [task.path for task in tasks if done.get(task.log.path, "copy") != "copy"]
    return name_runs(sizes, known, others, find_hash, is_present, listed.name_listed)


_NOTES = "batch/pooled"
_NOTE = "all runs"
POOLED = ("datasets.parquet", "index.html")
"""Files over all runs."""
_MOST_ROUNDS = 20
_VERSION = 5
"""Version of the pooled files; increase it when their generation changes."""


def refresh_pools(store: Store) -> None:
    """Update `datasets.parquet`, the catalogue, and the fleet model and trend if they were requested.

    Other batches may add runs meanwhile: it is repeated until the pooled runs are the current ones, so that
    the last batch to finish leaves the right tables.
    """
    notes = store.notes(_NOTES)
    are_there = all((store.root / name).exists() for name in POOLED)
    pooled = (notes.read(_NOTE) or {}).get("runs") if are_there else None
    for _ in range(_MOST_ROUNDS):
        if (runs := _hash_runs(store)) == pooled:
            return
        update_datasets(store)
        notes.write(_NOTE, {"runs": runs})
        pooled = runs


def forget_pools(store: Store) -> None:
    """Invalidate the tables and pages over all runs, so that the next batch makes them again."""
    store.notes(_NOTES).remove(_NOTE)


def _hash_runs(store: Store) -> str:
    """Hash of what the pools depend on: versions, runs, and logs without one."""
    # The contracts import a table library, which help and usage errors do not need.
    from pipeline.report import list_noted  # noqa: PLC0415

    runs = [
        [manifest.run, manifest.key, manifest.folder.name, recorded_path(manifest)]
        for manifest in store.survey().manifests
    ]
    return hash_json([_VERSION, contract_of("datasets").version, runs, list_noted(store)])


def prune_results(store: Store, pruning: Pruning) -> tuple[int, list[SlipError]]:
    """Remove generations that are not current.

    First, all but the newest `keep` of each run are removed. If the results still exceed the quota, the
    oldest of these follow, one more of every run at a time.

    Args:
        store: the results.
        pruning: number to keep, and quota.

    Returns:
        How many were removed; and why the results still exceed the quota, and what was not measured.

    Raises:
        StoreError: a run is being written for too long, or the disk reports an error.
    """
    removed, quota = 0, pruning.quota_bytes
    size, problems = 0, list[SlipError]()
    for keep in range(pruning.keep, -1, -1):
        removed += len(store.prune(keep))
        if quota is None:
            return removed, []
        size, errors = measure_results(store)
        problems = [*errors]
        if size <= quota:
            return removed, problems
    held, most = (f"{one / 1e9:.3g} GB" for one in (size, quota or 0))
    what = f"the results hold {held} without any old generation, more than {most}"
    hint = "Raise --quota, or move runs elsewhere"
    return removed, [*problems, BatchError("over_quota", what, where=str(store.root), hint=hint)]


def measure_results(store: Store) -> tuple[int, tuple[StoreError, ...]]:
    """Size of the results on disk [bytes], and the errors of parts that could not be read.

    Files shared by several generations count once.
    """
    seen: set[tuple[int, int]] = set()
    total = 0
    errors: list[StoreError] = []
    for entry in walk_files(store.root, lambda path, why: errors.append(path_unread(path, why))):
        try:
            status = entry.stat(follow_symlinks=False)
        except OSError:
            # Another batch has just removed it.
            continue
        if (status.st_dev, status.st_ino) not in seen:
            seen.add((status.st_dev, status.st_ino))
            total += status.st_blocks * 512
    return total, tuple(errors)
