"""Loops that are compiled at set-up are not compiled again when they are called."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

COMPILE = (
    "import pipeline.estimation, pipeline.models.filters, pipeline.core.compute as c; list(c.compile_loops())"
)
CALL = """
import numpy as np
from pipeline.estimation.parts import _sum_costs
from pipeline.models.filters import _lag
from pipeline.run.windows import average_spans
ones, first = np.ones(9), np.zeros(3, dtype=np.int64)
_lag(ones, ones, 0.3, 0.02)
average_spans(ones, 0.02, first, np.zeros(3), first + 5, np.zeros(3), np.ones(3))
_sum_costs(np.ones((4, 3)), np.ones((4, 3)), np.ones((4, 3)))
"""


def _run(cache: Path, *command: str | Path) -> set[str]:
    """What is kept of compiled loops after a command."""
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_DISABLE_JIT"}
    done = [sys.executable, *map(str, command)]
    subprocess.run(done, env=environment | {"NUMBA_CACHE_DIR": str(cache)}, check=True, capture_output=True)
    return {path.name for path in cache.rglob("*.nbc")}


@pytest.mark.long
def test_what_set_up_compiles_is_what_a_diagnosis_calls(samples: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    compiled = _run(cache, "-c", COMPILE)
    assert len(compiled) > 10
    assert _run(cache, "-c", CALL) == compiled
    log, out = samples / "husky_tile.mcap", tmp_path / "out"
    assert _run(cache, "-m", "pipeline", "diagnose", log, "--out", out, "--quiet") == compiled
