"""Where things stand on the server's disk, which the page is not told."""

import sys
import tempfile
from pathlib import Path


class Places:
    """Folders of the server, and what the page is told in their place.

    Args:
        results: the results folder, as it was given.
    """

    def __init__(self, results: Path) -> None:
        told = {
            str(results.resolve()): str(results),
            str(Path.cwd()): ".",
            str(Path(__file__).parents[2]): "slip",
            sys.prefix: "python",
            sys.base_prefix: "python",
            str(Path.home()): "~",
            tempfile.gettempdir(): "temporary folder",
        }
        # A folder inside another one goes first.
        self._told = sorted(told.items(), key=lambda item: -len(item[0]))

    def hide(self, text: str) -> str:
        """The text without folders that the user has not named."""
        for folder, said in self._told:
            if folder != "/":
                text = text.replace(folder, said)
        return text
