"""The workbench: a local page to see where a model fails, to add effects, and to see the error decrease.

The server has one session for each side of the page (A and B), in memory; models are saved on request in the
results folder. The figures are those of the report. Logs that are dropped on the page are analyzed in a
process with limits of time and memory.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec
import numpy as np

from pipeline.core import SlipError

LOOPBACK = ("127.0.0.1", "localhost", "::1")
"""Addresses that only this machine reaches."""

Slot = Literal["a", "b"]
Line = Annotated[str, msgspec.Meta(max_length=400, pattern=r"^[^\x00-\x1f\x7f]*$")]
"""A line of text that somebody typed."""


class WorkbenchError(SlipError):
    """A request to the workbench cannot be fulfilled."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of a workbench.

    Attributes:
        log_bytes: largest size of a dropped log.
        timeout_s: time limit of an analysis or a diagnosis [s].
        memory_bytes: memory limit of an analysis or a diagnosis.
    """

    log_bytes: int = 16_000_000_000
    timeout_s: float = 1800.0
    memory_bytes: int = 4_000_000_000


class Ask(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """A change to a session.

    Attributes:
        run: name of the run.
        slot: `a`, or `b` for the second session.
        input: `command` or `measured`; None for that of the session, else the default.
        action: what to do; `preview` shows a value and keeps nothing.
        anyway: add an effect even if it is refused; try others even if the diagnosis identified some.
        effect: id of the effect.
        effects: ids of several effects to add and to fit together.
        parameter: name of the parameter.
        value: new value.
        channel, formula, parameters: fields of a formula, as typed.
        tab: tab of the figures; empty for all.
        stretch: index of the enlarged stretch, 0 for the one with the largest error.
        on: name of another run, to validate the model on.
    """

    run: str
    slot: Slot = "a"
    input: Literal["command", "measured"] | None = None
    action: Literal[
        "open", "add", "drop", "set", "preview", "lock", "fit", "formula", "undo", "redo", "try"
    ] = "open"
    anyway: bool = False
    effect: Line = ""
    effects: tuple[Line, ...] = ()
    parameter: str = ""
    value: float = 0.0
    channel: Literal["v_x", "v_y", "v_w"] = "v_x"
    formula: Line = ""
    parameters: Line = ""
    tab: Literal["", "first", "where", "effects", "residual", "budget"] = ""
    stretch: int = 0
    on: str = ""


@contextmanager
def evaluating(run: str) -> Iterator[None]:
    """Convert every arithmetic error of the block, caused by values or formulas of the user, into one error.

    Args:
        run: the run that the error refers to.

    Raises:
        WorkbenchError: ``cannot_evaluate``.
    """
    try:
        with np.errstate(all="ignore"):
            yield
    except (ArithmeticError, ValueError, TypeError, LookupError, RecursionError, MemoryError) as error:
        raise WorkbenchError(
            "cannot_evaluate",
            f"that cannot be evaluated on this run ({type(error).__name__})",
            where=run,
            hint="The model is unchanged; take other values or another formula.",
        ) from error
