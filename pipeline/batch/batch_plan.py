"""Before and after a batch: which logs are done and what their runs are called; pages and pruning."""

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path

import msgspec

from pipeline.analysis import Options
from pipeline.analysis.analyze import update_datasets
from pipeline.analysis.work import VERSIONS
from pipeline.batch import BatchError, Pruning, Request
from pipeline.batch.batch_work import WITH_RESULTS, Entry, Ledger
from pipeline.core import SlipError, read_bounded, read_version, walk_files
from pipeline.estimation.stored_diagnosis import STAGE, VERSION
from pipeline.logs import LogError, hash_log, to_location
from pipeline.sources import list_configuration_files, list_presets, read_tables
from pipeline.store import (
    LogIdentities,
    LogSighting,
    Manifest,
    Store,
    StoreError,
    hash_json,
    name_plainly,
    path_unread,
    see_log,
)
from schemas import contract_of, list_contracts

# Fingerprint of a log: a hash of everything that its results depend on except the log itself.
#
# It covers more than the keys of the stages, so that it is available without opening the log. If it differs,
# the keys decide what has to be computed.

_WITHOUT_INFLUENCE = ("out", "run", "config", "fleet", "report", "figures", "force")
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

    def find_fingerprint(self, log: Path) -> str:
        """That of one log."""
        files = list_configuration_files(log, given=self._options.config, fleet=self._options.fleet)
        return hash_json([self._shared, [[str(file), self._hash_content(file)] for file in files]])

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
# A log keeps its name. Equal content counts once, under the name of the first. Of new logs with the same name
# the first by path gets the plain name and the others get eight digits of their hash appended.

_DIGITS = 8


@dataclass(frozen=True)
class KnownRun:
    """Run with results: its name, and the hash and size [bytes] of its log."""

    run: str
    sha256: str
    size: int


def name_runs(
    sizes: Mapping[Path, int],
    known: Sequence[KnownRun],
    find_hash: Callable[[Path], str],
    is_present: Callable[[str], bool],
) -> tuple[dict[Path, str], dict[Path, str]]:
    """Name the runs of new logs.

    Args:
        sizes: size of every new log [bytes].
        known: the runs that have results.
        find_hash: hash of a log, empty if it cannot be read; called where a log may be a copy of another one,
            by its size, or needs digits of its hash.
        is_present: whether the log of a run with results is still there, unchanged and of this batch.

    Returns:
        The run of each log by its path; and of each log that is a copy, the run with the same content.
    """
    alike = Counter([*sizes.values(), *(run.size for run in known)])
    alike_named = Counter([*map(name_plainly, sizes), *(run.run for run in known)])
    hashes = {
        path: find_hash(path)
        for path, size in sizes.items()
        if alike[size] > 1 or alike_named[name_plainly(path)] > 1
    }
    holders = {run.sha256: run.run for run in known}
    runs: dict[Path, str] = {}
    copies: dict[Path, str] = {}
    for path in sorted(hashes):
        holder = holders.get(hashes[path])
        if holder is not None:
            # A log that was moved keeps its run: its results stay valid.
            is_copy = holder in runs.values() or is_present(holder)
            (copies if is_copy else runs)[path] = holder
    taken = {run.run for run in known}
    first: dict[str, str] = {}
    for path in sorted(set(sizes) - set(runs) - set(copies)):
        content, plain = hashes.get(path, ""), name_plainly(path)
        if content in first:
            copies[path] = first[content]
            continue
        runs[path] = plain if plain not in taken else f"{plain}-{content[:_DIGITS]}"
        taken.add(runs[path])
        if content:
            first[content] = runs[path]
    return runs, copies


@dataclass(frozen=True, kw_only=True)
class Item:
    """One log of a batch.

    Attributes:
        path: the recording.
        log: state of its file; empty if it cannot be read.
        fingerprint: hash of everything else its results depend on.
        before: previous ledger entry, whether or not the log has changed since.
        run: name of its run; empty until it is assigned.
        copy_of: run of the same content, if the log is a copy.
    """

    path: Path
    log: LogSighting
    fingerprint: str
    before: Entry | None = None
    run: str = ""
    copy_of: str = ""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Work to be done.

    Attributes:
        todo: logs to work on.
        settled: logs to skip, with their entries: done, copies, quarantined.
    """

    todo: tuple[Item, ...]
    settled: tuple[Entry, ...]


def make_plan(paths: Sequence[Path], store: Store, request: Request) -> Plan:
    """Compare the logs with the results.

    Args:
        paths: recordings, absolute, sorted.
        store: the results.
        request: options of the user.
    """
    ledger = Ledger(store).read_all()
    manifests = {manifest.run: manifest for manifest in store.survey().manifests}
    asked_again = {run for run, manifest in manifests.items() if manifest.again}
    hasher = Fingerprinter(request.options)
    items = [_look_at(path, hasher, ledger) for path in paths]
    settled: list[Entry] = []
    open_items: list[Item] = []
    for item in items:
        entry = item.before
        is_asked_again = entry is not None and entry.run in asked_again
        if entry is not None and not is_asked_again and _is_settled(item, entry, manifests, request):
            settled.append(entry)
        else:
            open_items.append(item)
    named = _name_items(open_items, items, manifests, store)
    for item in named:
        if item.copy_of:
            entry = Entry(log=item.log, fingerprint=item.fingerprint, state="copy", reason=item.copy_of)
            Ledger(store).write(entry)
            settled.append(entry)
    todo = (item for item in named if not item.copy_of)
    # Largest logs first, so that no worker starts the largest one when the others have finished.
    return Plan(
        todo=tuple(sorted(todo, key=lambda item: (-item.log.size, item.path))), settled=tuple(settled)
    )


def _look_at(path: Path, hasher: Fingerprinter, ledger: Mapping[str, Entry]) -> Item:
    # Unreadable logs are processed all the same: this reports what is wrong with them.
    log, fingerprint = LogSighting(path=str(path), size=0, mtime_ns=0, inode=0, seen_ns=0), ""
    with suppress(OSError, SlipError):
        log = see_log(path)
        fingerprint = hasher.find_fingerprint(path)
    return Item(path=path, log=log, fingerprint=fingerprint, before=ledger.get(log.path))


def _is_settled(item: Item, entry: Entry, manifests: Mapping[str, Manifest], request: Request) -> bool:
    if not entry.fits(item.log, item.fingerprint) or request.options.force:
        return False
    if entry.state == "quarantined":
        return not request.retries_quarantined
    if entry.state == "copy":
        return entry.reason in manifests
    if entry.state not in WITH_RESULTS:
        return False
    manifest = manifests.get(entry.run)
    is_current = manifest is not None and manifest.key == entry.key
    return is_current and (entry.has_report or not request.options.report)


def _name_items(
    open_items: Sequence[Item], items: Sequence[Item], manifests: Mapping[str, Manifest], store: Store
) -> list[Item]:
    identities = LogIdentities(store)
    logs = {run: log for run, manifest in manifests.items() if (log := manifest.part("log"))}
    paths = {run: str(to_location(str(log.get("path")))) for run, log in logs.items()}
    runs = {path: run for run, path in paths.items()}
    runs |= {item.log.path: item.before.run for item in items if item.before and item.before.run in manifests}
    new = {item.path: item.log.size for item in open_items if item.log.path not in runs}
    locations = {item.log.path: item.path for item in items}
    known = [
        KnownRun(run, str(log.get("sha256")), size)
        for run, log in logs.items()
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

    named, copies = name_runs(new, known, find_hash, is_present)
    return [
        replace(
            item,
            run=runs.get(item.log.path) or named.get(item.path, ""),
            copy_of=copies.get(item.path, ""),
        )
        for item in open_items
    ]


_NOTES = "batch/pooled"
_NOTE = "all runs"
POOLED = ("datasets.parquet", "index.html")
"""Files over all runs."""
_MOST_ROUNDS = 20
_VERSION = 2
"""Version of the pooled files; increase it when their generation changes."""


def refresh_pools(store: Store) -> bool:
    """Update `datasets.parquet`, the catalogue, and the fleet model and trend if they were requested.

    Other batches may add runs meanwhile: it is repeated until the pooled runs are the current ones, so that
    the last batch to finish leaves the right tables.

    Returns:
        Whether any file was written.
    """
    notes = store.notes(_NOTES)
    written = False
    for _ in range(_MOST_ROUNDS):
        runs = _hash_runs(store)
        are_there = all((store.root / name).exists() for name in POOLED)
        if are_there and (notes.read(_NOTE) or {}).get("runs") == runs:
            return written
        _write_pools(store)
        written = True
        if _hash_runs(store) == runs:
            notes.write(_NOTE, {"runs": runs})
            return written
    return written


def forget_pools(store: Store) -> None:
    """Invalidate the tables and pages over all runs, so that the next batch makes them again."""
    store.notes(_NOTES).remove(_NOTE)


def _hash_runs(store: Store) -> str:
    """Hash of what the pools depend on: versions, runs, and logs without one."""
    # The contracts import a table library, which help and usage errors do not need.
    from pipeline.report import list_failed  # noqa: PLC0415

    runs = [[manifest.run, manifest.key, manifest.folder.name] for manifest in store.survey().manifests]
    return hash_json([_VERSION, contract_of("datasets").version, runs, list_failed(store)])


def _write_pools(store: Store) -> None:
    update_datasets(store)


@dataclass(frozen=True, kw_only=True)
class Pruned:
    """Result of pruning.

    Attributes:
        removed: removed folders of generations.
        problems: why the results still exceed the quota, and which of them were not measured.
    """

    removed: tuple[Path, ...]
    problems: tuple[SlipError, ...] = ()


def prune_results(store: Store, pruning: Pruning) -> Pruned:
    """Remove generations that are not current.

    First, all but the newest `keep` of each run are removed. If the results still exceed the quota, the
    oldest of these follow, one more of every run at a time.

    Args:
        store: the results.
        pruning: number to keep, and quota.

    Raises:
        StoreError: a run is being written for too long, or the disk reports an error.
    """
    removed = list(store.prune(pruning.keep))
    if pruning.quota_bytes is None:
        return Pruned(removed=tuple(removed))
    keep = pruning.keep
    size, errors = measure_results(store)
    while size > pruning.quota_bytes and keep > 0:
        keep -= 1
        removed += store.prune(keep)
        size, errors = measure_results(store)
    problems: list[SlipError] = [*errors]
    if size > pruning.quota_bytes:
        held, quota = (f"{one / 1e9:.3g} GB" for one in (size, pruning.quota_bytes))
        what = f"the results hold {held} without any old generation, more than {quota}"
        hint = "Raise --quota, or move runs elsewhere"
        problems.append(BatchError("over_quota", what, where=str(store.root), hint=hint))
    return Pruned(removed=tuple(removed), problems=tuple(problems))


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
