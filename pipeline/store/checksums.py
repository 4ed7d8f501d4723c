"""Small JSON files with a checksum of their own: the manifest of a run, and notes."""

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

from pipeline.core import PathError, read_bounded, resolve_inside
from pipeline.store.files import JSON, MANIFEST, FileEntry, Manifest, TableEntry, hash_bytes, replace_file
from pipeline.store.names import StoreError, is_file_name, is_key, join_inside

# Small JSON files that carry a checksum of themselves, so that no byte of them changes unnoticed.
#
# The checksum stands first and covers every other byte.

_START = b'{"checksum": "'
_DIGITS = 64
_END = b'",'


def encode_checked(content: Mapping[str, object], *, indent: int | None = None) -> bytes:
    """JSON, sorted, with its checksum: the same bytes for the same content.

    Args:
        content: at least one key.
        indent: spaces that each level is set in; None for one line.

    Raises:
        ValueError: a number that JSON has no word for.
        TypeError: something else that it has none for.
    """
    # Names of files need not be text: what is none stands escaped.
    text = json.dumps(content, allow_nan=False, indent=indent, sort_keys=True)
    body = text.encode("ascii")
    return _START + hash_bytes(body).encode() + _END + body[1:]


def check_checksum(data: bytes) -> None:
    """Refuse the content of a file that is not what was written.

    Raises:
        ValueError: it has no checksum, or another one.
    """
    body = b"{" + data[len(_START) + _DIGITS + len(_END) :]
    if data != _START + hash_bytes(body).encode() + _END + body[1:]:
        raise ValueError("its checksum is not that of its content")


def decode_checked(data: bytes) -> dict[str, object]:
    """The content of a file with a checksum.

    Raises:
        ValueError: it is not what was written.
    """
    check_checksum(data)
    try:
        content: dict[str, object] = json.loads(data)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    content.pop("checksum")
    return content


FORMAT = 1
"""Raised when an older version could not read what a newer one writes."""


def encode_manifest(manifest: Manifest) -> bytes:
    """The manifest as the content of its file.

    Raises:
        StoreError: ``bad_details``, the details hold something JSON has no word for.
    """
    try:
        return encode_checked(
            {"format": FORMAT, **asdict(manifest), "folder": manifest.folder.name}, indent=1
        )
    except (TypeError, ValueError) as error:
        hint = "Give texts, finite numbers, lists and mappings with text keys only"
        raise StoreError(
            "bad_details", f"the details of a generation must be JSON: {error}", where=manifest.run, hint=hint
        ) from error


def load_manifest(home: Path) -> Manifest | None:
    """The manifest in a run's folder; None when there is none.

    Raises:
        StoreError: ``manifest_damaged``; ``manifest_too_new``, a newer version wrote it; ``not_a_file``;
            ``file_outside``, it is a link that leads away.
        OSError: the file cannot be read.
    """
    try:
        data = read_bounded(join_inside(home, MANIFEST))
    except (FileNotFoundError, NotADirectoryError):
        return None
    return parse_manifest(data, home)


def parse_manifest(data: bytes, home: Path) -> Manifest:
    """The manifest in the content of its file.

    Args:
        data: the content.
        home: the run's folder.

    Raises:
        StoreError: ``manifest_damaged``, or ``manifest_too_new`` when a newer version wrote it.
    """
    import msgspec  # noqa: PLC0415 - heavy, and `slip --help` imports this room

    path = home / MANIFEST
    try:
        written_in = msgspec.json.decode(data, type=_Header).format
        if written_in > FORMAT:
            raise StoreError(
                "manifest_too_new",
                f"the results are in format {written_in}, this version reads up to {FORMAT}",
                where=str(path),
                hint="Use the newer version, or another folder with --results",
            )
        stored = msgspec.json.decode(data, type=_Stored)
        _check_names(stored)
        check_checksum(data)
        folder = resolve_inside(home, stored.folder)
    except (msgspec.DecodeError, ValueError, RecursionError, PathError) as error:
        said = error.what if isinstance(error, PathError) else " ".join(str(error).split())
        hint = "Delete this one file and analyze its log again"
        raise StoreError(
            "manifest_damaged", f"the manifest is damaged ({said})", where=str(path), hint=hint
        ) from error
    content = {key: value for key, value in vars(stored).items() if key != "format"}
    return Manifest(**content | {"folder": folder})


@dataclass(frozen=True)
class _Header:
    format: int


@dataclass(frozen=True)
class _Stored:
    format: int
    run: str
    key: str
    folder: str
    tables: dict[str, TableEntry]
    files: dict[str, FileEntry]
    details: dict[str, Any]
    earlier: tuple[str, ...]


def _check_names(stored: _Stored) -> None:
    # Files are read and old folders removed by these names: an edited one must not lead elsewhere.
    for name in (stored.folder, *stored.earlier, *stored.tables, *stored.files):
        if not is_file_name(name) or ("/" in name and name not in stored.files):
            raise ValueError(f"it names {name!r}")
    for table in stored.tables:
        if f"{table}.parquet" not in stored.files:
            raise ValueError(f"it names no file for the table {table!r}")
    if not is_key(stored.key):
        raise ValueError(f"its key is {stored.key!r}")


# Small notes beside the results, one file with a checksum each: replaced whole, by many at once without
# waiting.
#
# A note may be lost, for example in a power cut, and must then only cost time. What must not be lost belongs
# into a generation.

LOG_NOTES = "batch/logs"
"""Folder of the notes on logs."""


NOTES = ("batch/", "identities/")
"""How the names of all notes in the results begin."""

AGAIN_NOTES = "batch/again"
"""Folder of the notes on runs that are to be made again."""


class Notes:
    """Notes by name in one folder.

    Args:
        root: the results folder.
        folder: where they stand in it; made when the first is written.

    Raises:
        StoreError: ``file_outside``, a link leads out of the results.
    """

    def __init__(self, root: Path, folder: str) -> None:
        self._root = root
        self._folder = folder
        join_inside(root, folder)

    def write(self, name: str, content: Mapping[str, JSON]) -> bool:
        """Write a note in the place of the one before; failing to is no error.

        Returns:
            Whether it was written.
        """
        try:
            path = self.path_of(name)
            path.parent.mkdir(parents=True, exist_ok=True)
            # No waiting for the disk: after a power cut an empty note only costs time.
            replace_file(path, encode_checked(content), durable=False)
        except (StoreError, OSError):
            return False
        return True

    def read(self, name: str) -> dict[str, JSON] | None:
        """A note; None when there is none that can be read."""
        with suppress(StoreError):
            return _load(self.path_of(name))
        return None

    def read_all(self) -> Iterator[dict[str, JSON]]:
        """Every note that can be read, in no order that matters."""
        for path in sorted((self._root / self._folder).glob("*/*.json")):
            content = _load(path)
            if content is not None:
                yield content

    def remove(self, name: str) -> None:
        """Forget a note, which need not be there."""
        with suppress(OSError, StoreError):
            self.path_of(name).unlink()

    def path_of(self, name: str) -> Path:
        """File of a note, which may be called anything.

        Raises:
            StoreError: ``file_outside``, a link leads out of the results; ``not_a_file``.
        """
        digits = hash_bytes(os.fsencode(name))
        return join_inside(self._root, f"{self._folder}/{digits[:2]}/{digits[2:]}.json")


def _load(path: Path) -> dict[str, JSON] | None:
    try:
        # Nothing but a file is opened: a pipe would be waited for.
        return cast("dict[str, JSON]", decode_checked(read_bounded(path))) if path.is_file() else None
    except (OSError, ValueError):
        return None
