"""Small JSON files with a checksum of their own, and notes made of them."""

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from pipeline.core import read_bounded
from pipeline.store.files import hash_bytes, replace_file
from pipeline.store.names import StoreError, join_inside

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


# Small notes beside the results, one file with a checksum each: replaced whole, by many at once without
# waiting.
#
# A note may be lost, for example in a power cut, and must then only cost time. What must not be lost belongs
# into a generation.

LOG_NOTES = "batch/logs"
"""Folder of the notes on logs."""
LOG_STATES = ("done", "lossy", "refused", "failed", "quarantined", "copy", "ignored", "left_out", "gone")
"""What became of a log of a batch; each log counts once, and each run has one log."""


NOTES = ("batch/", "identities/")
"""How the names of all notes in the results begin."""


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

    def write(self, name: str, content: Mapping[str, object]) -> bool:
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

    def read(self, name: str) -> dict[str, object] | None:
        """A note; None when there is none that can be read."""
        with suppress(StoreError):
            return _load(self.path_of(name))
        return None

    def read_all(self) -> Iterator[dict[str, object]]:
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


def _load(path: Path) -> dict[str, object] | None:
    try:
        # Nothing but a file is opened: a pipe would be waited for.
        return decode_checked(read_bounded(path)) if path.is_file() else None
    except (OSError, ValueError):
        return None
