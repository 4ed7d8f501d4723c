"""A formula as typed on the page: parsed into an effect, never run as text."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from pipeline.motion.formula import FormulaEffect
from pipeline.motion.formula.formula_effect import make_parameter
from pipeline.workbench.errors import WorkbenchError

if TYPE_CHECKING:
    from pipeline.motion import Parameter

_LONGEST = 400
_ID = re.compile(r"[a-z][a-z0-9_]{0,39}")
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_PARAMETER = re.compile(
    rf"\s*(?P<name>[A-Za-z_]\w*)\s*\[(?P<unit>[^\]]*)\]\s*(?P<low>{_NUMBER})\s*(?:\.\.|to)\s*(?P<high>{_NUMBER})\s*"
)


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
        raise WorkbenchError(
            "bad_name",
            f"{name!r} cannot name an effect",
            hint="Use small letters, digits and _, a letter first, at most 40.",
        )
    if channel not in {"v_x", "v_y", "v_w"}:
        raise WorkbenchError("bad_channel", f"there is no velocity {channel!r}", hint="Use v_x, v_y or v_w.")
    if len(text) > _LONGEST:
        raise WorkbenchError(
            "too_long", "the formula is too long", hint=f"Use at most {_LONGEST} characters."
        )
    found = tuple(_read_parameter(part) for part in parameters.split(",") if part.strip())
    return FormulaEffect(name, {channel: text}, found, where=name)


def _read_parameter(text: str) -> Parameter:
    match = _PARAMETER.fullmatch(text)
    if match is None:
        raise WorkbenchError(
            "bad_parameter",
            f"{text.strip()!r} is no parameter",
            hint="Write name [unit] low .. high, for example: c [s] -0.5 .. 0.5",
        )
    low, high = float(match["low"]), float(match["high"])
    if not low < high:
        raise WorkbenchError(
            "bad_parameter",
            f"the bounds of {match['name']!r} are {low:g} and {high:g}",
            hint="Give the smaller one first.",
        )
    neutral = 0.0 if low <= 0.0 <= high else low
    return make_parameter(match["name"], match["unit"].strip() or "1", (low, high), neutral=neutral)
