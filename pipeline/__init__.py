"""From the MCAP logs of field robots to knowledge about their motion.

In Python: ``import slip``, which has what `__all__` lists here; all else may change.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.api import Check, Diagnosis, Fit, Model, Run, SlipError, analyze, check, effect, load, table

__all__ = [
    "Check", "Diagnosis", "Fit", "Model", "Run", "SlipError", "analyze", "check", "effect", "load", "table",
]  # fmt: skip


def __getattr__(name: str) -> object:
    """A public name; what it needs is loaded when it is first asked for, so that verbs start without it."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module("pipeline.api"), name)


def __dir__() -> list[str]:
    return __all__
