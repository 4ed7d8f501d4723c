"""What the page may send, checked."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import msgspec

from pipeline.web.errors import WorkbenchError

if TYPE_CHECKING:
    from starlette.requests import Request

MOST_BYTES = 100_000

Slot = Literal["a", "b"]


class Ask(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """A change to a session.

    Attributes:
        run: name of the run.
        slot: `a`, or `b` for the session beside it.
        input: what the model is fed with; None for the usual one.
        action: what to do; `add_named` puts in the model that the diagnosis wrote, fitted as one,
            `add_found` the formula that it found.
        anyway: take an effect though it raises an error.
        effect: id of the effect it concerns.
        parameter: name of the parameter it concerns.
        value: new value.
        channel, formula, parameters: of a formula, as typed.
        area: free ground for a plan, as typed.
    """

    run: str
    slot: Slot = "a"
    input: Literal["command", "measured"] | None = None
    action: Literal[
        "open",
        "add",
        "add_named",
        "add_found",
        "drop",
        "switch",
        "set",
        "preview",
        "lock",
        "fit",
        "formula",
        "undo",
        "redo",
        "try",
    ] = "open"
    anyway: bool = False
    effect: str = ""
    parameter: str = ""
    value: float = 0.0
    channel: str = ""
    formula: str = ""
    area: str = ""
    parameters: str = ""


async def read_ask(request: Request) -> Ask:
    """The body of a request.

    Raises:
        WorkbenchError: ``bad_request``.
    """
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > MOST_BYTES:
            raise _bad("it is too long")
    try:
        ask = msgspec.json.decode(bytes(body), type=Ask)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise _bad(str(error)) from None
    if not math.isfinite(ask.value):
        raise _bad("the value is no number")
    return ask


def _bad(why: str) -> WorkbenchError:
    return WorkbenchError("bad_request", f"the request cannot be read: {why}", hint="Reload the page.")
