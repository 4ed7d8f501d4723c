"""What stands in a run's folder besides its manifest: generations, the link ``latest``, leftovers."""

from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from pipeline.store.files import remove_folder, temporary_beside
from pipeline.store.manifest import MARKER, Manifest

LATEST = "latest"


def name_free_folder(home: Path, key: str, taken: Collection[str] = ()) -> Path:
    """The folder for a new generation: the key, with a number behind it where the key is taken.

    A generation made again under the same key gets a folder of its own, because a folder cannot be replaced
    in one moment, and the readers of the old one must not find the new one's files in it.

    Args:
        home: the run's folder.
        key: key of the generation.
        taken: names that the manifest knows: a generation that somebody deleted still has its own.
    """
    folder, number = home / key, 1
    while folder.name in taken or folder.exists():
        number += 1
        folder = home / f"{key}.{number}"
    return folder


def point_latest(home: Path, folder: str) -> None:
    """Point the link ``latest`` at a generation; it is a convenience, so failing is no error."""
    temporary = temporary_beside(home / LATEST)
    with suppress(OSError):
        temporary.symlink_to(folder, target_is_directory=True)
        try:
            temporary.replace(home / LATEST)
        except OSError:
            temporary.unlink()


def remove_orphans(home: Path, current: Manifest | None) -> None:
    """Remove generations that no manifest names: of writers killed just before their last step.

    Call only under the run's lock.
    """
    named = {current.folder.name, *current.earlier} if current else set()
    for marker in sorted(home.glob(f"*/{MARKER}")):
        if marker.parent.name not in named and not marker.parent.is_symlink():
            remove_folder(marker.parent)
