"""Loops that are compiled at set-up are not compiled again, and are what their Python source says."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline.models.filters import _lag

MAKEFILE = Path(__file__).parents[2] / "Makefile"
CALL = """
import sys
import numpy as np
from pipeline.models.servo_walk import walk_each
from pipeline.models import filters
from pipeline.run.windows import average_spans

rng = np.random.default_rng(3)
signal, first = rng.normal(size=300), np.zeros(2, dtype=np.int64)
means = np.zeros(2)
average_spans(signal, 0.02, first, np.array([0.2, 0.7]), first + 7, np.array([0.1, 0.3]), means)
states = np.full(300, np.nan)
states[0] = 0.5
lagged, limited, swung = np.empty(300), np.empty(300), np.empty(300)
filters._lag(signal, states, 0.3, 0.02, lagged)
filters._limit(signal, states, 0.2, limited)
filters._swing(signal, states, 0.3, 0.7, 0.0, 0.02, swung)
asked, starts = np.stack([signal, -signal, np.zeros(300)])[None], np.zeros((1, 3, 1))
numbers = [[3.0, 1.0, 0.2, 3.0, 3.0, 0.05, 0.01, 0.02, 0.3, 0.5]] * 3
rolled = walk_each(numbers, [0, 0, 0], asked, np.zeros(1, dtype=np.int64), starts, 0.02)
for values in (means, lagged, limited, swung, rolled):
    print(float(np.sum(values)))
"""


def _run(cache: Path, *command: str | Path, **variables: str) -> str:
    """What a command prints, with a cache of its own."""
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_DISABLE_JIT"}
    environment |= {"NUMBA_CACHE_DIR": str(cache), **variables}
    words = [sys.executable, *map(str, command)]
    return subprocess.run(words, env=environment, check=True, capture_output=True, text=True).stdout


def _list_cached(cache: Path) -> set[str]:
    return {path.name for path in cache.rglob("*.nbc")}


@pytest.mark.long
def test_what_set_up_compiles_is_what_a_diagnosis_calls(samples: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    (compile_all,) = re.findall(r'-c "(.*compile_every_loop.*)"', MAKEFILE.read_text())
    _run(cache, "-c", compile_all)
    compiled = _list_cached(cache)
    assert len(compiled) > 10
    _run(
        cache,
        "-m",
        "pipeline",
        "diagnose",
        samples / "husky_tile.mcap",
        "--results",
        tmp_path / "out",
        "--quiet",
    )
    assert _list_cached(cache) == compiled


@pytest.mark.long
def test_the_python_source_gives_the_numbers_of_the_machine_code(tmp_path: Path) -> None:
    cache = Path(os.environ.get("NUMBA_CACHE_DIR", tmp_path))
    compiled = [float(line) for line in _run(cache, "-c", CALL).split()]
    interpreted = [float(line) for line in _run(cache, "-c", CALL, NUMBA_DISABLE_JIT="1").split()]
    assert np.isfinite(compiled).all()
    assert np.allclose(compiled, interpreted, rtol=1e-12)


def test_arrays_that_the_machine_code_would_misread_are_refused() -> None:
    ones = np.ones(8)
    for wrong in (ones[::2], ones.astype(np.float32), ones.reshape(2, 4), ones.astype(int)):
        with pytest.raises(TypeError, match="No matching definition"):
            _lag(wrong, ones, 0.3, 0.02, np.empty(8))
