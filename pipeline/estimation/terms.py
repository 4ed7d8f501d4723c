"""Terms for what no effect of the catalogue takes: one-sided and world-frame formulas.

Every term is a formula effect with consistent units, in the syntax that a model file takes. None depends on
place or time: a pattern over the map of one run does not predict the next run over the same ground.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pipeline.models import ANY, FormulaEffect, Parameter, make_parameter

TERM = "term_"
CHANNELS = ("v_x", "v_y", "v_w")
SUGGESTION = "suggested_term"
"""Id of the formula that is suggested for what no effect explains."""
_WIDE = 50.0
"""Bound of a coefficient of a formula, in units of the usual one."""

# Formula and its unit; the catalogue has the others (gains, squares, drifts, slopes).
_SHAPES: Mapping[str, tuple[str, str]] = {
    "forward": ("(v0 + abs(v0))", "m/s"),
    "reverse": ("(v0 - abs(v0))", "m/s"),
    "speed": ("abs(v0)", "m/s"),
    "gain": ("v0", "m/s"),
    "speed_squared": ("v0 * v0", "m^2/s^2"),
    "left": ("(w0 + abs(w0))", "rad/s"),
    "right": ("(w0 - abs(w0))", "rad/s"),
    "turning": ("abs(w0)", "rad/s"),
    "turn_gain": ("w0", "rad/s"),
    "turn_squared": ("w0 * abs(w0)", "rad^2/s^2"),
    "spin_squared": ("w0 * w0", "rad^2/s^2"),
    "curve": ("v0 * w0", "m/s^2"),
    "curve_forward": ("(v0 + abs(v0)) * w0", "m/s^2"),
    "curve_reverse": ("(v0 - abs(v0)) * w0", "m/s^2"),
    "speed_turn": ("abs(v0) * w0", "m/s^2"),
    "speed_turning": ("abs(v0 * w0)", "m/s^2"),
    "sign_forward": ("sign(v0)", "1"),
    "sign_turn": ("sign(w0)", "1"),
    "saturating_turn": ("w0 / hypot(w0, s)", "1"),
    "push_ahead": ("v0_rate", "m/s^2"),
    "push_around": ("w0_rate", "rad/s^2"),
    # Sine and cosine together: which way a map lies must not matter.
    "world": ("(a * sin(yaw) + b * cos(yaw)) * tanh(abs(v0) / u)", "1"),
    "world_still": ("a * sin(yaw) + b * cos(yaw)", "1"),
    "world_two": ("(a * sin(2 * yaw) + b * cos(2 * yaw)) * tanh(abs(v0) / u)", "1"),
    "speed_world": ("v0 * (a * sin(yaw) + b * cos(yaw))", "m/s"),
    "turn_world": ("w0 * (a * sin(yaw) + b * cos(yaw))", "rad/s"),
}
# Once a turn of a wheel, which is out of round or sits off its centre.
_WHEEL_SHAPES: Mapping[str, tuple[str, str]] = {
    "left_wheel": ("left * (a * sin(left_angle) + b * cos(left_angle))", "rad/s"),
    "right_wheel": ("right * (a * sin(right_angle) + b * cos(right_angle))", "rad/s"),
}
_SIDEWAYS_SHAPES: Mapping[str, tuple[str, str]] = {
    "sideways_gain": ("s0", "m/s"),
    "sideways_speed": ("abs(s0)", "m/s"),
    "sideways_squared": ("s0 * abs(s0)", "m^2/s^2"),
    "sideways_curve": ("s0 * w0", "m/s^2"),
    "sideways_turning": ("s0 * abs(w0)", "m/s^2"),
    "diagonal": ("v0 * abs(s0)", "m^2/s^2"),
    "diagonal_aside": ("s0 * abs(v0)", "m^2/s^2"),
    "sign_sideways": ("sign(s0)", "1"),
    "push_aside": ("s0_rate", "m/s^2"),
}
_UNITS = {"v_x": "m/s", "v_y": "m/s", "v_w": "rad/s"}
_FIXED: Mapping[str, Parameter] = {
    "u": Parameter("u", "m/s", (0.01, 1.0), 0.1, "speed below which it fades", 0.1),
    "s": Parameter("s", "rad/s", (0.05, 3.0), 0.5, "yaw rate at which it saturates", 0.5),
}
"""Shapes that are searched by trial, with their bounds."""
# What the catalogue says already, by channel and shape: not unexplained.
_KNOWN = frozenset(
    {
        ("v_x", "gain"), ("v_x", "turn_gain"), ("v_w", "turn_gain"), ("v_w", "gain"), ("v_y", "gain"),
        ("v_y", "turn_gain"), ("v_y", "curve"), ("v_x", "push_ahead"), ("v_w", "push_around"),
        ("v_y", "sideways_gain"), ("v_y", "sideways_squared"), ("v_y", "push_aside"),
    }
)  # fmt: skip


@dataclass(frozen=True)
class Term:
    """A candidate that is a formula; called with values it makes the effect."""

    id: str
    channel: str
    text: str
    parameters: tuple[Parameter, ...]
    kinds: tuple[str, ...] = ANY

    def __call__(self, **values: float) -> FormulaEffect:
        """The formula effect with these values; numbers that only shape it are left alone by fits."""
        return _parse(self).change(**values)


@functools.lru_cache(maxsize=512)
def _parse(term: Term) -> FormulaEffect:
    fixed = [p.name for p in term.parameters if p.name in _FIXED]
    return FormulaEffect(term.id, {term.channel: term.text}, term.parameters, fixed=fixed)


def list_terms(*, sideways: bool = False, wheels: bool = False) -> tuple[Term, ...]:
    """All terms.

    Args:
        sideways: also those of a vehicle that drives so.
        wheels: also those of a wheel's turns: of one run, as in another it starts elsewhere.
    """
    shapes = {**_SHAPES, **(_SIDEWAYS_SHAPES if sideways else {}), **(_WHEEL_SHAPES if wheels else {})}
    return tuple(
        _make_term(channel, name, text, unit)
        for channel in CHANNELS
        for name, (text, unit) in shapes.items()
        if (channel, name) not in _KNOWN
    )


def _make_term(channel: str, name: str, text: str, unit: str) -> Term:
    ratio = _divide(_UNITS[channel], unit)
    sizes = {"a": "sine part", "b": "cosine part"} if "a * sin" in text else {"k": "size"}
    gains = [Parameter(n, ratio, (-_WIDE, _WIDE), 0.0, about, 0.1, step=1e-3) for n, about in sizes.items()]
    shape = tuple(parameter for key, parameter in _FIXED.items() if f" {key})" in text)
    whole = text if len(gains) > 1 else f"k * {text}"
    return Term(f"{TERM}{channel[-1]}_{name}", channel, whole, (*gains, *shape))


def _divide(one: str, other: str) -> str:
    """Unit of a gain; radians are plain numbers."""
    if other == "1":
        return one
    table = {
        ("m/s", "m/s"): "1", ("m/s", "m^2/s^2"): "s/m", ("m/s", "rad/s"): "m", ("m/s", "rad^2/s^2"): "m*s",
        ("m/s", "m/s^2"): "s", ("m/s", "rad/s^2"): "m*s", ("rad/s", "m/s"): "1/m",
        ("rad/s", "m^2/s^2"): "s/m^2", ("rad/s", "rad/s"): "1", ("rad/s", "rad^2/s^2"): "s",
        ("rad/s", "m/s^2"): "s/m", ("rad/s", "rad/s^2"): "s",
    }  # fmt: skip
    return table[one, other]


def is_term(name: str) -> bool:
    """Whether an id is that of a term."""
    return name.startswith(TERM)


def join_formula(terms: Sequence[FormulaEffect]) -> FormulaEffect:
    """Several terms as one formula, as a model file has it."""
    texts: dict[str, list[str]] = {}
    parameters, values, fixed = list[Parameter](), dict[str, float](), set[str]()
    for number, term in enumerate(terms, start=1):
        ((channel, text),) = term.formulas.items()
        for parameter in term.parameters:
            name, value = f"{parameter.name}_{number}", term.values[parameter.name]
            text = _rename(text, parameter.name, name)
            is_fixed = parameter.name in term.fixed
            neutral = value if is_fixed else parameter.neutral
            parameters.append(make_parameter(name, parameter.unit, parameter.bounds, neutral=neutral))
            values[name] = value
            fixed |= {name} if is_fixed else set()
        texts.setdefault(channel, []).append(text)
    formulas = {channel: " + ".join(parts) for channel, parts in texts.items()}
    return FormulaEffect(SUGGESTION, formulas, tuple(parameters), fixed=fixed).change(**values)


def _rename(text: str, old: str, new: str) -> str:
    return re.sub(rf"\b{old}\b", new, text)
