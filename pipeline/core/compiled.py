"""Loops over signals, written as plain Python and compiled at their first call.

The machine code is kept beside the source, or in the user's cache where the installation is read-only, and in
no place where neither can be written. `NUMBA_DISABLE_JIT=1` runs the Python itself, with the same numbers.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, ParamSpec, TypeVar

if TYPE_CHECKING:
    from collections.abc import Iterator

Given = ParamSpec("Given")
Result = TypeVar("Result")

_loops: list[Loop[Any, Any]] = []


class Loop(Generic[Given, Result]):
    """A function that is compiled when it is first called, by Python or by another loop that is compiled.

    Args:
        loop: in Python.
        signature: types of result and arguments in Numba's words, for compiling at set-up.
    """

    def __init__(self, loop: Callable[Given, Result], signature: str) -> None:
        self._loop = loop
        self.signature = signature
        functools.update_wrapper(self, loop)

    @cached_property
    def machine_code(self) -> Callable[Given, Result]:
        """The compiled function; the compiler is imported no sooner."""
        return _compile(self._loop)

    @property
    def _numba_type_(self) -> object:
        """What the compiler takes it for in another loop."""
        return getattr(self.machine_code, "_numba_type_", None)

    def __call__(self, *args: Given.args, **kwargs: Given.kwargs) -> Result:
        """Call the compiled function."""
        return self.machine_code(*args, **kwargs)


def compiled(signature: str) -> Callable[[Callable[Given, Result]], Callable[Given, Result]]:
    """Compile a loop when it is first called.

    Args:
        signature: types of result and arguments in Numba's words, for compiling at set-up.
    """

    def decorate(function: Callable[Given, Result]) -> Callable[Given, Result]:
        loop = Loop(function, signature)
        _loops.append(loop)
        return loop

    return decorate


def _compile(loop: Callable[Given, Result]) -> Callable[Given, Result]:
    import numba  # noqa: PLC0415 - a quarter of a second

    try:
        kept: Callable[Given, Result] = numba.njit(cache=True)(loop)
    except RuntimeError:
        # There is no place to keep what is compiled.
        made: Callable[Given, Result] = numba.njit(cache=False)(loop)
        return made
    return kept


def compile_loops() -> Iterator[str]:
    """Compile all loops that are imported and are not kept yet; their names."""
    for loop in _loops:
        made = loop.machine_code
        compile_for = getattr(made, "compile", None)
        if compile_for is not None:
            compile_for(loop.signature)
        yield getattr(made, "__name__", "")
