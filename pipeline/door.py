"""Doors of rooms: the names that a package offers, each loaded from its file when it is asked for."""

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module


def open_door(room: str, files: Mapping[str, Sequence[str]]) -> Callable[[str], object]:
    """Make the ``__getattr__`` of a package whose files take longer to load than help takes to print.

    Args:
        room: name of the package.
        files: the names that it offers, by the file that has them.
    """
    file_of = {name: file for file, names in files.items() for name in names}

    def load(name: str) -> object:
        if name not in file_of:
            raise AttributeError(f"module {room!r} has no attribute {name!r}")
        return getattr(import_module(f"{room}.{file_of[name]}"), name)

    return load
