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
def dig() -> Iterator[Callable[..., None]]:
    """Makes folders within each other, the last of which holds a file; removes them, which pytest cannot."""
    made: list[Path] = []

    def make(top: Path, levels: int = LEVELS) -> None:
        made.append(top / "d")
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
    for folder in made:
        subprocess.run(["rm", "-rf", str(folder)], check=True)
