"""HTML out of the templates that stand beside the code; every text in it is escaped.

A template is named by its path below `pipeline`. What may stand in a page as it is, is marked `safe` in
`base.html` and nowhere else: our own style and scripts.
"""

from __future__ import annotations

import base64
import functools
import hashlib
import unicodedata
from importlib.resources import files
from typing import TYPE_CHECKING

from pipeline.report import words

if TYPE_CHECKING:
    from jinja2 import Environment

_REPLACEMENT = "\ufffd"


def render_template(name: str, **values: object) -> str:
    """A template filled with values; a name that the template uses and does not get is an error.

    Args:
        name: path of the template below `pipeline`.
        values: what it shows; texts are escaped, and control characters in them, also those that turn the
            writing direction, become visible marks.
    """
    return _environment().get_template(name).render(values)


def read_own(name: str) -> str:
    """A file beside the code, by its path below `pipeline`."""
    return files("pipeline").joinpath(name).read_text(encoding="utf-8")


@functools.cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined  # noqa: PLC0415 - only pages need it

    environment = Environment(
        loader=PackageLoader("pipeline", ""),
        autoescape=True,
        finalize=show_text,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "bytes": words.say_bytes,
        "capital": words.begin_large,
        "distance": words.say_distance,
        "number": words.say_number,
        "sha256": lambda text: base64.b64encode(hashlib.sha256(text.encode()).digest()).decode(),
        "share": words.say_share,
    }
    environment.policies["json.dumps_kwargs"] = {
        "allow_nan": False,
        "separators": (",", ":"),
        "sort_keys": True,
    }
    return environment


def show_text(value: object) -> object:
    """A text with its control characters made visible; what is no text, or is HTML already, as it is."""
    if not isinstance(value, str) or value.isprintable() or hasattr(value, "__html__"):
        return value
    return "".join(_REPLACEMENT if _is_control(mark) else mark for mark in value)


def _is_control(mark: str) -> bool:
    return unicodedata.category(mark).startswith("C") and mark not in "\n\t"
