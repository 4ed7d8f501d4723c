"""Answers of the server: JSON, also of numbers that are none, and errors that tell nothing of its disk."""

from collections.abc import Callable, Mapping

import msgspec
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response

from pipeline.core.errors import SlipError
from pipeline.web.places import Places

_NOT_FOUND = ("no_such_run", "no_such_desk", "no_such_job")


def answer(content: Mapping[str, object], status_code: int = 200) -> Response:
    """JSON; numbers that are not finite become null."""
    body = msgspec.json.encode(content, enc_hook=_make_plain)
    return Response(body, status_code=status_code, media_type="application/json")


def make_handlers(places: Places) -> dict[type[Exception], Callable[[Request, Exception], Response]]:
    """What errors become.

    Args:
        places: what the page is not told.
    """

    def tell(_: Request, error: Exception) -> Response:
        told = error if isinstance(error, SlipError) else _name_defect(error)
        said = {"message": places.hide(told.what), "where": places.hide(told.where), "hint": told.hint}
        status = 404 if told.code in _NOT_FOUND else 500 if told is not error else 422
        return answer({"error": {"code": told.code, **said}}, status)

    def ignore(_: Request, __: Exception) -> Response:
        # Nobody is there any more to read it.
        return Response(status_code=400)

    return {SlipError: tell, ClientDisconnect: ignore, Exception: tell}


def _name_defect(error: Exception) -> SlipError:
    hint = "The server tells more where it was started; nothing was changed."
    return SlipError("defect", f"something went wrong that should not ({type(error).__name__})", hint=hint)


def _make_plain(value: object) -> object:
    """A number of numpy as one of Python."""
    item = getattr(value, "item", None)
    if item is None:
        raise NotImplementedError(f"{type(value).__name__} is no JSON")
    return item()
