"""What there is to do: which logs are done, which are left alone, which run each of the rest will be."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from pipeline.batch.basis import BasisHasher
from pipeline.batch.ledger import Entry, Ledger
from pipeline.batch.naming import KnownRun, assign_names, list_doubtful
from pipeline.batch.request import Request
from pipeline.core.errors import SlipError
from pipeline.logs import LogError, hash_log, to_location
from pipeline.store import LogIdentities, LogSighting, Manifest, Store, see_log


@dataclass(frozen=True, kw_only=True)
class Item:
    """One log of a batch.

    Attributes:
        path: the recording.
        log: what its file looks like; empty when it cannot be looked at.
        basis: hash of everything else its results depend on.
        before: what became of it the last time, in this shape or another.
        run: name of its run; empty until it is named.
        copy_of: run of the same content, where it is only a copy.
    """

    path: Path
    log: LogSighting
    basis: str
    before: Entry | None = None
    run: str = ""
    copy_of: str = ""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What there is to do.

    Attributes:
        todo: logs to work on.
        settled: logs to leave alone, with their entries: done, copies, quarantined.
    """

    todo: tuple[Item, ...]
    settled: tuple[Entry, ...]


def make_plan(paths: Sequence[Path], store: Store, request: Request) -> Plan:
    """Compare the logs with the results.

    Args:
        paths: recordings, absolute, sorted.
        store: the results.
        request: what the user asked for.
    """
    ledger = Ledger(store).read_all()
    manifests = {manifest.run: manifest for manifest in store.survey().manifests}
    asked_again = {run for run, manifest in manifests.items() if store.is_asked_again(manifest)}
    hasher = BasisHasher(request.options)
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
            entry = Entry(log=item.log, basis=item.basis, state="copy", reason=item.copy_of)
            Ledger(store).write(entry)
            settled.append(entry)
    todo = (item for item in named if not item.copy_of)
    # The longest first: the last worker must not begin with the largest log when the others are done.
    return Plan(
        todo=tuple(sorted(todo, key=lambda item: (-item.log.size, item.path))), settled=tuple(settled)
    )


def _look_at(path: Path, hasher: BasisHasher, ledger: Mapping[str, Entry]) -> Item:
    # What cannot be looked at is worked on all the same: that says what is wrong with it.
    log, basis = LogSighting(path=str(path), size=0, mtime_ns=0, inode=0, seen_ns=0), ""
    with suppress(OSError, SlipError):
        log = see_log(path)
        basis = hasher.hash_basis(path)
    return Item(path=path, log=log, basis=basis, before=ledger.get(log.path))


def _is_settled(item: Item, entry: Entry, manifests: Mapping[str, Manifest], request: Request) -> bool:
    if not entry.fits(item.log, item.basis) or request.options.force:
        return False
    if entry.state == "quarantined":
        return not request.retries_quarantined
    if entry.state == "copy":
        return entry.reason in manifests
    if entry.state not in {"done", "lossy"}:
        return False
    manifest = manifests.get(entry.run)
    is_current = manifest is not None and manifest.key == entry.key
    return is_current and (entry.has_report or not request.options.report)


def _name_items(
    open_items: Sequence[Item], items: Sequence[Item], manifests: Mapping[str, Manifest], store: Store
) -> list[Item]:
    identities = LogIdentities(store)
    logs = _list_logs(manifests)
    runs = {_path_of(log): run for run, log in logs.items()}
    runs |= {item.log.path: item.before.run for item in items if item.before and item.before.run in manifests}
    new = {item.path: item.log.size for item in open_items if item.log.path not in runs}
    looks = {item.log.path: item for item in items}
    known = [_know_run(run, log, looks, identities, set(new.values())) for run, log in logs.items() if new]
    hashes = _hash_logs(list_doubtful(new, known), identities)
    names = assign_names(list(new), hashes, known)
    return [
        replace(
            item,
            run=runs.get(item.log.path) or names.runs.get(item.path, ""),
            copy_of=names.copies.get(item.path, ""),
        )
        for item in open_items
    ]


def _know_run(
    run: str,
    log: Mapping[str, object],
    looks: Mapping[str, Item],
    identities: LogIdentities,
    sizes: Collection[int],
) -> KnownRun:
    size = log.get("bytes")
    item = looks.get(_path_of(log))
    # Only a run that a new log could be a copy of is worth another look.
    is_alike = item is not None and (not isinstance(size, int) or size in sizes)
    content = _hash_logs([item.path], identities).get(item.path) if is_alike and item is not None else None
    return KnownRun(
        run=run,
        sha256=str(log.get("sha256")),
        size=size if isinstance(size, int) else None,
        is_present=content is not None and content == log.get("sha256"),
    )


def _list_logs(manifests: Mapping[str, Manifest]) -> dict[str, Mapping[str, object]]:
    return {run: log for run, manifest in manifests.items() if (log := manifest.part("log"))}


def _path_of(log: Mapping[str, object]) -> str:
    return str(to_location(str(log.get("path"))))


def _hash_logs(paths: Sequence[Path], identities: LogIdentities) -> dict[Path, str]:
    hashes: dict[Path, str] = {}
    for path in paths:
        known = identities.lookup(path)
        if known is None:
            try:
                seen = see_log(path)
                known = hash_log(path)
            except (LogError, OSError):
                # Whoever works on it will say what is wrong with it.
                continue
            identities.remember(path, known, seen=seen)
        hashes[path] = known
    return hashes
