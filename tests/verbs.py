"""Verbs of the command line: called here, or as the program that a shell starts."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import patch

import pytest

from pipeline.cli import main


def run_verb(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Call a verb in this process, which saves the second in which Python starts and imports.

    Only what `main` itself catches becomes an exit code: any other exception goes on to the test.
    """
    out, errors = (io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True) for _ in range(2))
    words = [str(argument) for argument in arguments]
    with (
        chdir(cwd or Path.cwd()),
        patch.dict(os.environ),
        redirect_stdout(out),
        redirect_stderr(errors),
        pytest.raises(SystemExit) as left,
    ):
        main(words)
    assert isinstance(left.value.code, int)
    said, told = (stream.detach().getvalue().decode() for stream in (out, errors))  # type: ignore[attr-defined]
    return subprocess.CompletedProcess(words, left.value.code, said, told)


def run_program(
    *arguments: object, cwd: Path | None = None, timeout: float | None = None
) -> subprocess.CompletedProcess[str]:
    """Run `slip` in a process of its own, for what only the whole program shows."""
    command = [sys.executable, "-m", "pipeline", *map(str, arguments)]
    # readline sets COLUMNS behind Python's back, and a process that is given no environment inherits it.
    return subprocess.run(
        command, capture_output=True, text=True, cwd=cwd, check=False, timeout=timeout, env={**os.environ}
    )
