"""Logs that come through the page: bounded in size and number, and gone when they are worked off.

They stand in a folder of this server's own, under names that this server makes up. What a server that was
killed has left behind goes when the next one starts.
"""

import asyncio
import hashlib
import os
import re
import secrets
import shutil
from collections.abc import AsyncIterator, Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from pipeline.core.errors import SlipError, naming_os_errors
from pipeline.core.paths import resolve_inside
from pipeline.store.locks import hold_lock
from pipeline.web.errors import WorkbenchError
from pipeline.web.limits import Limits
from pipeline.web.session import FOLDER

_LOCK = ".lock"
_NAME_BYTES = 8
_OWN_NAME = re.compile(rf"[0-9a-f]{{{2 * _NAME_BYTES}}}")
_SPARE_BYTES = 200_000_000
_LOST_NAME = "dropped.mcap"
_PLAIN = re.compile(r"[^0-9A-Za-z._ -]")


@dataclass(frozen=True)
class Upload:
    """A log that was taken in, or is.

    Attributes:
        folder: its own, which goes with it.
        name: as the browser sent it, for people; never a path.
        total: bytes that were announced.
    """

    folder: Path
    name: str
    total: int

    @property
    def path(self) -> Path:
        """Where the log stands."""
        return self.folder / "log.mcap"

    @property
    def notes(self) -> Path:
        """Where its analysis says how far it is."""
        return self.folder / "stage"


class Uploads:
    """All logs that were taken in and are not worked off.

    Args:
        results: the results folder.
        limits: how many and how large.
    """

    def __init__(self, results: Path, limits: Limits) -> None:
        self._results = results
        self._limits = limits
        self._known: dict[str, Upload] = {}
        self._held = ExitStack()
        self._folder: Path | None = None
        self._root = resolve_inside(results.resolve(), f"{FOLDER}/uploads")
        _sweep(self._root)

    async def take(
        self,
        name: str,
        total: int,
        chunks: AsyncIterator[bytes],
        begin: Callable[[], None],
        tell: Callable[[int], None],
    ) -> tuple[Upload, str]:
        """Take a log in, piece by piece.

        Args:
            name: as the browser sent it.
            total: bytes that were announced.
            chunks: the content.
            begin: called once when it is let in.
            tell: called with the number of bytes that have come.

        Returns:
            The log and its SHA-256.

        Raises:
            WorkbenchError: too large or too many, no room on the disk, or the connection broke; nothing of
                it is left then.
        """
        what, hint = "the log cannot be kept", "Free some space."
        with naming_os_errors(WorkbenchError, "upload_not_written", what, where=name, hint=hint):
            upload = self.make_room(name, total)
            try:
                begin()
                return upload, await self._fill(upload, chunks, tell)
            except BaseException:
                self.remove(upload)
                raise

    def make_room(self, name: str, total: int) -> Upload:
        """A folder for a log.

        Args:
            name: of the log, for people.
            total: bytes that it needs.

        Raises:
            WorkbenchError: too large or too many, or no room on the disk.
            OSError: the folder cannot be made.
        """
        self._check_quota(name, total)
        self._check_room(name, total)
        upload = Upload(self._open() / secrets.token_hex(_NAME_BYTES), name, total)
        upload.folder.mkdir()
        self._known[upload.folder.name] = upload
        return upload

    def remove(self, upload: Upload) -> None:
        """Delete a log."""
        self._known.pop(upload.folder.name, None)
        shutil.rmtree(upload.folder, ignore_errors=True)

    def close(self) -> None:
        """Delete all of them."""
        for upload in tuple(self._known.values()):
            self.remove(upload)
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
        self._held.close()

    def _open(self) -> Path:
        """This server's folder, for nobody else to look into; locked, so that no other server sweeps it."""
        if self._folder is None or not self._folder.is_dir():
            folder = self._root / secrets.token_hex(_NAME_BYTES)
            folder.mkdir(parents=True, mode=0o700)
            self._held.enter_context(hold_lock(folder / _LOCK, patience_s=0.0))
            self._folder = folder
        return self._folder

    async def _fill(self, upload: Upload, chunks: AsyncIterator[bytes], tell: Callable[[int], None]) -> str:
        received, digest = 0, hashlib.sha256()
        with upload.path.open("xb") as file:
            try:
                while True:
                    async with asyncio.timeout(self._limits.silence_s):
                        chunk = await anext(chunks, None)
                    if chunk is None:
                        break
                    received += len(chunk)
                    if received > upload.total:
                        break
                    digest.update(chunk)
                    file.write(chunk)
                    tell(received)
            except TimeoutError:
                pass
        if received != upload.total:
            hint = "Drop it again."
            raise WorkbenchError(
                "upload_broken", f"{received} of {upload.total} bytes came", where=upload.name, hint=hint
            )
        return digest.hexdigest()

    def _check_quota(self, name: str, total: int) -> None:
        held = sum(upload.total for upload in self._known.values())
        if total > self._limits.log_bytes:
            raise WorkbenchError(
                "too_large",
                f"more than {self._limits.log_bytes / 1e6:.0f} MB are not taken in",
                where=name,
                hint="Run `slip analyze` on the file where it is; it appears here by itself.",
            )
        if len(self._known) >= self._limits.logs or held + total > self._limits.all_bytes:
            raise WorkbenchError(
                "too_many",
                f"{len(self._known)} logs of together {held / 1e6:.0f} MB wait here already",
                where=name,
                hint="Wait until they are analyzed, or dismiss those that failed.",
            )

    def _check_room(self, name: str, total: int) -> None:
        self._results.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(self._results).free
        if total + _SPARE_BYTES > free:
            raise WorkbenchError(
                "disk_full",
                f"the log has {total / 1e6:.0f} MB, the disk {free / 1e6:.0f} MB left",
                where=name,
                hint="Free some space, or run `slip analyze` on the file where it is.",
            )


def _sweep(root: Path) -> None:
    """Remove what servers have left that are gone: nobody holds its lock any more."""
    for folder in root.glob("*"):
        # The results may be a stranger's: nothing is followed out of them, and nothing else removed.
        if not _OWN_NAME.fullmatch(folder.name) or (folder / _LOCK).resolve() != folder / _LOCK:
            continue
        try:
            with hold_lock(folder / _LOCK, patience_s=0.0):
                shutil.rmtree(folder, ignore_errors=True)
        except SlipError:
            # Its server lives.
            continue


def clean_name(name: str) -> str:
    """A file name out of whatever a browser sends: its last part, plain characters, one suffix."""
    last = os.path.basename(name.replace("\\", "/"))  # noqa: PTH119 - the text need not be a path here
    plain = _PLAIN.sub("_", last).strip(". ")[-100:]
    stem = plain.removesuffix(".mcap").strip(". ") or _LOST_NAME.removesuffix(".mcap")
    return f"{stem}.mcap"
