"""The error of this room."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from pipeline.core.errors import SlipError

_UNDOABLE = (ArithmeticError, ValueError, TypeError, LookupError, RecursionError, MemoryError)


class WorkbenchError(SlipError):
    """Something that was asked of the workbench cannot be done."""


@contextmanager
def evaluating(run: str) -> Iterator[None]:
    """Whatever numbers and formulas that somebody typed do to the arithmetic of the block is one clear error.

    Args:
        run: the run that it is about.

    Raises:
        WorkbenchError: ``cannot_evaluate``.
    """
    try:
        with np.errstate(all="ignore"):
            yield
    except _UNDOABLE as error:
        raise WorkbenchError(
            "cannot_evaluate",
            f"that cannot be evaluated on this run ({type(error).__name__})",
            where=run,
            hint="The model is as it was; take other values or another formula.",
        ) from error
