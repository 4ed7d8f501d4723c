"""Loops over signals, written as plain Python and compiled at their first call.

The machine code is kept beside the source, or in the user's cache where the installation is read-only, and in
no place where neither can be written. `NUMBA_DISABLE_JIT=1` runs the Python itself, with the same numbers.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, ParamSpec, TypeVar

if TYPE_CHECKING:
    from collections.abc import Iterator

Given = ParamSpec("Given")
Result = TypeVar("Result")

_loops: list[tuple[Callable[..., object], str]] = []


def compiled(signature: str) -> Callable[[Callable[Given, Result]], Callable[Given, Result]]:
    """Compile a loop when it is first called; the compiler is imported no sooner.

    Args:
        signature: types of result and arguments in Numba's words, for compiling at set-up.
    """

    def decorate(loop: Callable[Given, Result]) -> Callable[Given, Result]:
        @functools.cache
        def compile_loop() -> Callable[Given, Result]:
            return _compile(loop)

        @functools.wraps(loop)
        def call(*args: Given.args, **kwargs: Given.kwargs) -> Result:
            return compile_loop()(*args, **kwargs)

        _loops.append((compile_loop, signature))
        return call

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
    for compile_loop, signature in _loops:
        made = compile_loop()
        compile_for = getattr(made, "compile", None)
        if compile_for is not None:
            compile_for(signature)
        yield getattr(made, "__name__", "")
