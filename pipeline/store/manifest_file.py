"""The manifest's file: JSON, strict in reading, the same bytes for the same manifest."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from pipeline.store.errors import StoreError
from pipeline.store.manifest import MANIFEST, FileEntry, Manifest, TableEntry
from pipeline.store.names import is_file_name

if TYPE_CHECKING:
    from pathlib import Path

FORMAT = 1
"""Raised when an older version could not read what a newer one writes."""


def encode_manifest(manifest: Manifest) -> bytes:
    """The manifest as the content of its file.

    Raises:
        StoreError: ``bad_details``, the details hold something JSON has no word for.
    """
    content = {
        "format": FORMAT,
        "run": manifest.run,
        "key": manifest.key,
        "folder": manifest.folder.name,
        "tables": {name: asdict(entry) for name, entry in manifest.tables.items()},
        "files": {name: asdict(entry) for name, entry in manifest.files.items()},
        "details": manifest.details,
        "earlier": manifest.earlier,
    }
    try:
        text = json.dumps(content, allow_nan=False, ensure_ascii=False, indent=1, sort_keys=True)
        return text.encode() + b"\n"
    except (TypeError, ValueError) as error:
        raise StoreError(
            "bad_details",
            f"the details of a generation must be JSON: {error}",
            where=manifest.run,
            hint="Give texts, finite numbers, lists and mappings with text keys only",
        ) from error


def load_manifest(home: Path) -> Manifest | None:
    """The manifest in a run's folder; None when there is none.

    Raises:
        StoreError: ``manifest_damaged``, or ``manifest_too_new`` when a newer version wrote it.
        OSError: the file cannot be read.
    """
    import msgspec  # noqa: PLC0415 - heavy, and `slip --help` imports this room

    path = home / MANIFEST
    try:
        data = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return None
    try:
        written_in = msgspec.json.decode(data, type=_Header).format
        stored = msgspec.json.decode(data, type=_Stored) if written_in <= FORMAT else None
        if stored is not None:
            _check_names(stored)
    except (msgspec.DecodeError, ValueError) as error:
        raise StoreError(
            "manifest_damaged",
            f"the manifest is damaged ({error})",
            where=str(path),
            hint="Delete this one file and analyze its log again",
        ) from error
    if stored is None:
        raise StoreError(
            "manifest_too_new",
            f"the results are in format {written_in}, this version reads up to {FORMAT}",
            where=str(path),
            hint="Use the newer version, or another folder with --out",
        )
    return Manifest(
        run=stored.run,
        key=stored.key,
        folder=home / stored.folder,
        tables=stored.tables,
        files=stored.files,
        details=stored.details,
        earlier=stored.earlier,
    )


@dataclass(frozen=True)
class _Header:
    format: int


@dataclass(frozen=True)
class _Stored:
    run: str
    key: str
    folder: str
    tables: dict[str, TableEntry]
    files: dict[str, FileEntry]
    details: dict[str, Any]
    earlier: tuple[str, ...]


def _check_names(stored: _Stored) -> None:
    # Files are read and old folders removed by these names: an edited one must not lead elsewhere.
    folders = (stored.folder, *stored.earlier)
    files = (*stored.files, *(entry.file for entry in stored.tables.values()))
    for name in (*folders, *files):
        if not is_file_name(name) or (name in folders and "/" in name):
            raise ValueError(f"it names {name!r}")
