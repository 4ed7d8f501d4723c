"""Requests of the page, answers of the server, and limits of both."""

from __future__ import annotations

import math
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response

from pipeline.core.program import SlipError

_UNDOABLE = (ArithmeticError, ValueError, TypeError, LookupError, RecursionError, MemoryError)


class WorkbenchError(SlipError):
    """A request to the workbench cannot be fulfilled."""


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
    except _UNDOABLE as error:
        raise WorkbenchError(
            "cannot_evaluate",
            f"that cannot be evaluated on this run ({type(error).__name__})",
            where=run,
            hint="The model is unchanged; take other values or another formula.",
        ) from error


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of a workbench.

    Attributes:
        log_bytes: largest size of an uploaded log.
        all_bytes: largest total size of the uploaded logs that are not yet processed.
        logs: largest number of these logs.
        silence_s: timeout of an upload without data [s].
        timeout_s: time limit of an analysis or a diagnosis [s].
        memory_bytes: memory limit of an analysis or a diagnosis.
    """

    log_bytes: int = 16_000_000_000
    all_bytes: int = 32_000_000_000
    logs: int = 20
    silence_s: float = 60.0
    timeout_s: float = 1800.0
    memory_bytes: int = 4_000_000_000


class ServerFolders:
    """Folders of the server, and the texts that replace them on the page.

    Args:
        results: the results folder, as the user gave it.
    """

    def __init__(self, results: Path) -> None:
        replaced = {
            str(results.resolve()): str(results),
            str(Path.cwd()): ".",
            str(Path(__file__).parents[2]): "slip",
            sys.prefix: "python",
            sys.base_prefix: "python",
            str(Path.home()): "~",
            tempfile.gettempdir(): "temporary folder",
        }
        # Nested folders are replaced before the folders that contain them.
        self._replaced = sorted(replaced.items(), key=lambda item: -len(item[0]))

    def hide(self, text: str) -> str:
        """Replace the folders in a text that the user has not named."""
        for folder, said in self._replaced:
            if folder != "/":
                text = text.replace(folder, said)
        return text


MOST_BYTES = 100_000

Slot = Literal["a", "b"]


class Ask(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """A change to a session.

    Attributes:
        run: name of the run.
        slot: `a`, or `b` for the second session.
        input: `command` or `measured`; None for the default.
        action: the action; `add_named` adds the effects of the diagnosis and fits them jointly, `add_found`
            adds its formula.
        anyway: add an effect even if it is refused; try others even if the diagnosis identified some.
        effect: id of the effect.
        parameter: name of the parameter.
        value: new value.
        channel, formula, parameters: fields of a formula, as typed.
        area: free area for a plan, as typed.
        tab: tab of the figures; empty for all.
        stretch: index of the enlarged stretch, 0 for the one with the largest error.
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
    tab: str = ""
    stretch: int = 0


async def read_ask(request: Request) -> Ask:
    """Parse the body of a request.

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
        raise _bad("the value is not a number")
    return ask


def _bad(why: str) -> WorkbenchError:
    return WorkbenchError("bad_request", f"the request cannot be read: {why}", hint="Reload the page.")


_NOT_FOUND = ("no_such_run", "no_such_desk", "no_such_job")


def answer(content: Mapping[str, object], status_code: int = 200) -> Response:
    """JSON response; numbers that are not finite become null."""
    body = msgspec.json.encode(content, enc_hook=_make_plain)
    return Response(body, status_code=status_code, media_type="application/json")


def make_handlers(places: ServerFolders) -> dict[type[Exception], Callable[[Request, Exception], Response]]:
    """Handlers that turn errors into responses.

    Args:
        places: folders to hide from the page.
    """

    def respond(_: Request, error: Exception) -> Response:
        shown = error if isinstance(error, SlipError) else _name_defect(error)
        said = {"message": places.hide(shown.what), "where": places.hide(shown.where), "hint": shown.hint}
        status = 404 if shown.code in _NOT_FOUND else 500 if shown is not error else 422
        return answer({"error": {"code": shown.code, **said}}, status)

    def ignore(_: Request, __: Exception) -> Response:
        # The client has disconnected.
        return Response(status_code=400)

    return {SlipError: respond, ClientDisconnect: ignore, Exception: respond}


def _name_defect(error: Exception) -> SlipError:
    hint = "See the log of the server; nothing was changed."
    return SlipError("defect", f"an internal error occurred ({type(error).__name__})", hint=hint)


def _make_plain(value: object) -> object:
    """Convert a NumPy number to a Python number."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} is not JSON")
