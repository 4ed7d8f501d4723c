"""Folders nested more deeply than Python's stack has frames."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

LEVELS = 1500


@pytest.fixture
def dig(tmp_path: Path) -> Iterator[Callable[..., None]]:
    """Makes folders within each other in the test's own, the last of which holds a file.

    The test's folder is removed afterwards, which pytest cannot: wherever the program has moved them in it.
    """

    def make(top: Path, levels: int = LEVELS) -> None:
        assert top.is_relative_to(tmp_path)
        before = os.open(".", os.O_RDONLY)
        try:
            os.chdir(top)
            for _ in range(levels):
                Path("d").mkdir()
                os.chdir("d")
            Path("deepest").write_text("x")
        finally:
            os.fchdir(before)
            os.close(before)

    yield make
    subprocess.run(["rm", "-rf", str(tmp_path)], check=True)
