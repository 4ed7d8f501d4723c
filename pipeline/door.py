"""Doors of rooms: the names that a package offers, each loaded from its file when it is asked for."""

import importlib
import re
from collections.abc import Callable
from pathlib import Path

_IMPORT = re.compile(r"^    from (pipeline\S+) import (?:\(([^)]*)\)|(.*))$", re.MULTILINE)


def open_door(room: str, file: str) -> Callable[[str], object]:
    """Make the ``__getattr__`` of a package: a name comes from a file that is loaded when it is asked for.

    The names are those that the package imports for the type checker, so that there is one list of them.

    Args:
        room: name of the package.
        file: path of its ``__init__``.
    """
    files: dict[str, str] = {}

    def load(name: str) -> object:
        if not files:
            for module, several, one in _IMPORT.findall(Path(file).read_text(encoding="utf-8")):
                files.update(dict.fromkeys(re.findall(r"\w+", several or one), module))
        if name not in files:
            raise AttributeError(f"module {room!r} has no attribute {name!r}")
        return getattr(importlib.import_module(files[name]), name)

    return load
