"""A formula as typed on the page: parsed into an effect, never run as text."""

import inspect
import math
import re

from pipeline.models import Parameter, list_effects
from pipeline.models.formula import FormulaEffect
from pipeline.models.formula.formula_effect import CHANNELS, make_parameter
from pipeline.web.errors import WorkbenchError

_LONGEST = 400
_ID = re.compile(r"[a-z][a-z0-9_]{0,39}")
_NUMBER = r"[-+]?(?:\d{1,30}(?:\.\d{0,30})?|\.\d{1,30})(?:[eE][-+]?\d{1,3})?"
_PARAMETER = re.compile(
    r"(?P<name>[A-Za-z][A-Za-z0-9_]{0,39})\s*\[(?P<unit>[^\[\]]{0,40})\]\s*"
    rf"(?P<low>{_NUMBER})\s*(?:\.\.|to)\s*(?P<high>{_NUMBER})",
    re.ASCII,
)
_TAKEN = {"id", "note", *CHANNELS, *inspect.signature(FormulaEffect.__init__).parameters}
"""Names that mean something else in a model file, or to an effect."""


def make_formula(name: str, channel: str, text: str, parameters: str) -> FormulaEffect:
    """An effect out of what was typed.

    Args:
        name: id of the effect, in snake_case.
        channel: `v_x`, `v_y` or `v_w`.
        text: arithmetic over signals and parameters, for example `c * v0 * w0`.
        parameters: for example `c [s] -0.5 .. 0.5, d [1] 0 .. 2`.

    Raises:
        WorkbenchError: a field that cannot be read.
        MotionError: the formula cannot be parsed, or its unit is not the channel's.
    """
    if not _ID.fullmatch(name):
        hint = "Use small letters, digits and _, a letter first, at most 40."
        raise WorkbenchError("bad_name", f"{name!r} cannot name an effect", hint=hint)
    if channel not in CHANNELS:
        raise WorkbenchError("bad_channel", f"there is no velocity {channel!r}", hint="Use v_x, v_y or v_w.")
    if max(len(text), len(parameters)) > _LONGEST:
        raise WorkbenchError(
            "too_long", "the formula is too long", hint=f"Use at most {_LONGEST} characters."
        )
    if not text.isprintable():
        raise WorkbenchError("bad_formula", "the formula is not one line of text", hint="Write one line.")
    if name in {effect.id for effect in list_effects()}:
        raise WorkbenchError(
            "bad_name", f"an effect of the catalogue is called {name!r}", hint="Choose another name."
        )
    found = tuple(_read_parameter(part.strip()) for part in parameters.split(",") if part.strip())
    if len({parameter.name for parameter in found}) < len(found):
        raise WorkbenchError(
            "bad_parameter", "two parameters have the same name", hint="Give each a name of its own."
        )
    return FormulaEffect(name, {channel: text}, found, where=name)


def _read_parameter(text: str) -> Parameter:
    match = _PARAMETER.fullmatch(text)
    if match is None:
        hint = "Write name [unit] low .. high, for example: c [s] -0.5 .. 0.5"
        raise WorkbenchError("bad_parameter", f"{text!r} is no parameter", hint=hint)
    if match["name"] in _TAKEN:
        raise WorkbenchError(
            "bad_parameter", f"{match['name']!r} cannot name a parameter", hint="Choose another name."
        )
    low, high = float(match["low"]), float(match["high"])
    if not (low < high and math.isfinite(high - low)):
        raise WorkbenchError(
            "bad_parameter",
            f"the bounds of {match['name']!r} are {low:g} and {high:g}",
            hint="Give two finite numbers, the smaller one first.",
        )
    neutral = 0.0 if low <= 0.0 <= high else low
    return make_parameter(match["name"], match["unit"].strip() or "1", (low, high), neutral=neutral)
