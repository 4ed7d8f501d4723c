"""What stands over the list itself: which entries it has, and whether a key seals it.

Both are files over all runs like any other, and on the list. The register keeps an entry from going
unnoticed; it is renewed whenever a file over all runs is written, so that writers of runs never wait for each
other.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.store.errors import StoreError
from pipeline.store.listing import LIST, entry_name, parse_entry
from pipeline.store.manifest import hash_bytes
from pipeline.store.seals import seal, unseal

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from pipeline.store.keys import Key
    from pipeline.store.listing import Entry

REGISTER = "listed.json"
KEY_MARK = "sealed.json"


def parse_register(data: bytes | None) -> dict[str, str]:
    """Names of the files that are on the list, by the names of their entries; none where it is damaged."""
    try:
        entries = unseal(data or b"").get("entries")
    except ValueError:
        return {}
    found = entries.items() if isinstance(entries, dict) else ()
    return {name: path for name, path in found if isinstance(path, str) and entry_name(path) == name}


def renew_register(
    read: Callable[[str], bytes | None], names: Iterable[str], *, key: Key | None, without: str = ""
) -> bytes | None:
    """The register with the entries that were added to the list since.

    A register that is not what was written is left as it is, for whoever verifies the results.

    Args:
        read: the content of a file of the results by its name; None when there is none.
        names: names in the results of all entries.
        key: of the results.
        without: an entry that is about to be removed.

    Returns:
        The new content; None where nothing is to be written.
    """
    data = read(REGISTER)
    own = _read_entry(read, entry_name(REGISTER), key)
    if (data is None) != (own is None) or (data and own and hash_bytes(data) not in own.sha256):
        return None
    old = parse_register(data)
    new = {**old, entry_name(REGISTER): REGISTER}
    for name in names:
        if name not in new and name.startswith(f"{LIST}/") and name.endswith(".json"):
            entry = _read_entry(read, name, key)
            new |= {} if entry is None else {name: entry.path}
    new.pop(without, None)
    return None if new == old else seal({"entries": new})


def _read_entry(read: Callable[[str], bytes | None], name: str, key: Key | None) -> Entry | None:
    data = read(name)
    try:
        entry = None if data is None else parse_entry(data, name)
    except ValueError:
        return None
    return entry if entry is not None and entry.is_sealed_with(key) else None


def encode_mark(key: Key) -> bytes:
    """What says that results are sealed with a key, and with which."""
    return seal({"key": key.id})


def parse_mark(data: bytes | None) -> str | None:
    """Name of the key that results are sealed with; None where none seals them.

    Raises:
        ValueError: it is damaged.
    """
    return None if data is None else str(unseal(data).get("key"))


def require_key(data: bytes | None, key: Key | None, where: str) -> bool:
    """Refuse to write without the key of the results, or with another one: a seal must not get lost.

    Args:
        data: content of the mark; None when there is none.
        key: of whoever writes.
        where: the results.

    Returns:
        Whether nothing is left to do; not where there is a key and no mark.

    Raises:
        StoreError: ``key_missing``, ``other_key``, ``mark_damaged``.
    """
    try:
        found = parse_mark(data)
    except ValueError as error:
        what = f"{KEY_MARK}, which says what key seals the results, is damaged ({error})"
        hint = "Put the results back from a copy, or write to another folder with --out"
        raise StoreError("mark_damaged", what, where=where, hint=hint) from None
    if found is None:
        return key is None
    if key is None:
        what, hint = "the results are sealed with a key", "Name its file: --key FILE, or SLIP_KEY_FILE"
        raise StoreError("key_missing", what, where=where, hint=hint)
    if found != key.id:
        what, hint = "the results are sealed with another key", "Give that one, or another folder with --out"
        raise StoreError("other_key", what, where=where, hint=hint)
    return True


def not_sealed(where: str) -> StoreError:
    """The error for results that no key seals yet, of whoever writes with one."""
    return StoreError(
        "not_sealed",
        "there are results that no key seals",
        where=where,
        hint="Seal them as they are: slip verify RESULTS --key FILE --seal; or use a new folder with --out",
    )


def require_unsealed(data: bytes | None, key: Key | None, where: str) -> Key:
    """The key that results are about to be sealed with.

    Args:
        data: content of the mark; None when there is none.
        key: of whoever seals.
        where: the results.

    Raises:
        StoreError: ``no_key``, ``sealed_already``.
    """
    if key is None:
        raise StoreError("no_key", "no key is given", where=where, hint="Add --key FILE")
    if data is not None:
        what, hint = "the results are sealed with a key already", "Leave --seal out to check them with it"
        raise StoreError("sealed_already", what, where=where, hint=hint)
    return key
