"""Small notes beside the results, one sealed file each: replaced whole, by many at once without waiting.

A note may be lost, for example in a power cut, and must then only cost time. What must not be lost belongs
into a generation.
"""

import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import cast

from pipeline.store.errors import StoreError
from pipeline.store.files import replace_file
from pipeline.store.manifest import JSON, hash_bytes
from pipeline.store.names import place_inside
from pipeline.store.seals import seal, unseal

LOG_NOTES = "batch/logs"
"""Folder of the notes on logs, the only ones that several machines share."""


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
        place_inside(root, folder)

    def write(self, name: str, content: Mapping[str, JSON]) -> bool:
        """Write a note in the place of the one before; failing to is no error.

        Returns:
            Whether it was written.
        """
        try:
            path = self.path_of(name)
            path.parent.mkdir(parents=True, exist_ok=True)
            # No waiting for the disk: after a power cut an empty note only costs time.
            replace_file(path, seal(content), durable=False)
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
        return place_inside(self._root, f"{self._folder}/{digits[:2]}/{digits[2:]}.json")


def _load(path: Path) -> dict[str, JSON] | None:
    try:
        # Nothing but a file is opened: a pipe would be waited for.
        return cast("dict[str, JSON]", unseal(path.read_bytes())) if path.is_file() else None
    except (OSError, ValueError):
        return None
