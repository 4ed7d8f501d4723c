"""Loops over signals, written as plain Python and compiled by Numba when they are called for the first time.

The machine code is cached in ``NUMBA_CACHE_DIR``, else beside the source of a checkout, or in the folder of
`find_cache_folder` for an installation, whose own folders pip must find as it made them; `slip doctor` says
where. ``NUMBA_DISABLE_JIT=1`` runs the Python source instead, with the same results, as it
is where Numba is not installed: fits are refused then (`require_compiler`). A loop allocates nothing: it
writes into its array arguments.
"""

from __future__ import annotations

import functools
import importlib
import sysconfig
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pipeline.core.processes import find_cache_folder, require_package

if TYPE_CHECKING:
    from numpy.typing import NDArray

Function = TypeVar("Function", bound=Callable[..., Any])

LANES = 16
"""Most walks through a signal in one loop: the numbers of twice as many do not fit the fastest memory."""

_HOW: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False}
_loops: list[_Loop] = []


class _Loop:
    """A loop that is compiled when it is first called; those that it calls are so in its file."""

    def __init__(self, function: Callable[..., Any], signature: str | None) -> None:
        functools.update_wrapper(self, function)
        self._function, self.signature = function, signature

    def __call__(self, *values: Any) -> Any:  # noqa: ANN401 - of any loop
        return self.made(*values)

    @functools.cached_property
    def made(self) -> Any:  # noqa: ANN401 - Numba has no types
        """The machine code; the function itself where Numba is not installed."""
        function, names = self._function, self._function.__globals__
        if find_spec("numba") is None:
            return function
        for name in function.__code__.co_names:
            if isinstance(loop := names.get(name), _Loop):
                names[name] = loop.made
        numba = importlib.import_module("numba")
        if not numba.config.CACHE_DIR and Path(__file__).is_relative_to(sysconfig.get_path("purelib")):
            numba.config.CACHE_DIR = str(find_cache_folder() / "loops")
        compile_it = functools.partial(numba.njit, *filter(None, [self.signature]))
        try:
            return compile_it(cache=True, **_HOW)(function)
        except RuntimeError:  # no directory of the cache can be written to
            return compile_it(**_HOW)(function)


def compiled(signature: str | None = None) -> Callable[[Function], Function]:
    """Decorator that compiles a loop.

    Args:
        signature: types of its arguments in Numba's notation, for example ``void(float64[::1], int64)``; a
            call with other types raises TypeError. None for a loop that only other loops call.
    """

    def decorate(function: Function) -> Function:
        loop = _Loop(function, signature)
        if signature:
            _loops.append(loop)
        return loop  # type: ignore[return-value]

    return decorate


def require_compiler(*, otherwise: str = "") -> None:
    """Refuse what takes hours where loops run as Python because Numba is not installed.

    Args:
        otherwise: how to do without it.

    Raises:
        SlipError: ``no_numba``.
    """
    require_package("numba", "", "a fit of effects", otherwise=otherwise)


def list_caches() -> set[str | None]:
    """Directories with cached loops, None for loops that are not cached; empty if loops run as Python."""
    if find_spec("numba") is None or importlib.import_module("numba").config.DISABLE_JIT:
        return set()
    paths = (loop.made.stats.cache_path for loop in _loops)
    return {None if path is None else str(path) for path in paths}


def compile_loops() -> int:
    """Compile the loops of all files imported so far; their number."""
    return len([loop.made for loop in _loops])


def deal_lanes(count: int) -> Iterator[tuple[int, NDArray[np.int64], int]]:
    """Walks through a signal dealt to loops that take some of them at once.

    A walk waits for its own roots and divisions in each cell; the processor does those of several walks
    meanwhile, if the loop has ``for k in range(lanes)`` around few statements, without a branch, on rows of
    one array that are `LANES` apart. Each walk ends at the same numbers, to the last bit, as it does alone.

    Yields:
        The first walk of a loop; the walk of every lane, the last one repeated in a pack that is not full;
        how many of the lanes are wanted.
    """
    pack = _find_pack()
    for first in range(0, count, LANES):
        wanted = min(count - first, LANES)
        lanes = -(-wanted // pack) * pack if wanted > 1 else 1
        yield first, first + np.minimum(np.arange(lanes), wanted - 1), wanted


@functools.cache
def _find_pack() -> int:
    """Walks that the processor computes at a time: a loop of another count does the rest one by one."""
    if find_spec("numba") is None:
        return 1
    import llvmlite.binding  # noqa: PLC0415 - comes with Numba

    return 8 if llvmlite.binding.get_host_cpu_features().get("avx512f") else 4
