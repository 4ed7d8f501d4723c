"""Terms for what no effect of the catalogue takes: one-sided, world-frame and position-dependent formulas.

Every term is a formula effect with consistent units, in the syntax that a model file takes.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.identification.proposals import TERM
from pipeline.models.effect import ANY, Parameter, Search
from pipeline.models.formula.formula_effect import FormulaEffect

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.diagnosis.selection import CandidateModel, Selection

Floats = NDArray[np.float64]

CHANNELS = ("v_x", "v_y", "v_w")
_WIDE = 50.0
_WAVE_NUMBERS = np.geomspace(0.15, 6.0, 60)

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
    "world_sin": ("sin(yaw) * tanh(abs(v0) / u)", "1"),
    "world_cos": ("cos(yaw) * tanh(abs(v0) / u)", "1"),
    "world_sin_still": ("sin(yaw)", "1"),
    "world_cos_still": ("cos(yaw)", "1"),
    "world_sin_two": ("sin(2 * yaw) * tanh(abs(v0) / u)", "1"),
    "world_cos_two": ("cos(2 * yaw) * tanh(abs(v0) / u)", "1"),
    "speed_world_sin": ("v0 * sin(yaw)", "m/s"),
    "speed_world_cos": ("v0 * cos(yaw)", "m/s"),
    "turn_world_sin": ("w0 * sin(yaw)", "rad/s"),
    "turn_world_cos": ("w0 * cos(yaw)", "rad/s"),
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


def list_terms(*, sideways: bool = False) -> tuple[Term, ...]:
    """All terms that do not depend on where the vehicle is; ``sideways`` of one that drives so, too."""
    shapes = {**_SHAPES, **_SIDEWAYS_SHAPES} if sideways else _SHAPES
    return tuple(
        _make_term(channel, name, text, unit)
        for channel in CHANNELS
        for name, (text, unit) in shapes.items()
        if (channel, name) not in _KNOWN
    )


def _make_term(channel: str, name: str, text: str, unit: str) -> Term:
    ratio = _divide(_UNITS[channel], unit)
    gain = Parameter("k", ratio, (-_WIDE, _WIDE), 0.0, "size", 0.1, step=1e-3)
    shape = tuple(parameter for key, parameter in _FIXED.items() if f" {key})" in text)
    return Term(f"{TERM}{channel[-1]}_{name}", channel, f"k * {text}", (gain, *shape))


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


def list_waves(
    selection: Selection, final: CandidateModel, places: Floats, mark: str = ""
) -> tuple[Term, ...]:
    """Terms that repeat along the map's axes, with the wave numbers that fit the residuals best.

    Args:
        selection: where models are judged.
        final: the model so far.
        places: x, y [m] in the map at every window, shape (n, 2).
        mark: tells terms of several models apart.
    """
    lags = selection.part.find_ideal()[:, 0, :]
    rest = selection.weights.weigh(final.fit.residual)
    found = []
    for channel, name in enumerate(CHANNELS):
        for axis, place in zip("xy", places.T, strict=True):
            if np.ptp(place) < 1.0:
                continue
            for factor, values in (("v0", lags[:, 0]), ("w0", lags[:, 1])):
                if (name == "v_w") != (factor == "w0"):
                    continue
                wave = _best_wave(rest[:, channel], values, place)
                found.append(_make_wave(name, factor, axis + mark, wave))
    return tuple(found)


def _best_wave(rest: Floats, factor: Floats, place: Floats) -> float:
    best, number = -1.0, 1.0
    for wave in _WAVE_NUMBERS.tolist():
        design = np.column_stack((factor * np.sin(wave * place), factor * np.cos(wave * place)))
        taken = float(rest @ design @ np.linalg.pinv(design.T @ design) @ design.T @ rest)
        if taken > best:
            best, number = taken, wave
    return number


def _make_wave(channel: str, factor: str, axis: str, wave: float) -> Term:
    text = f"{factor} * (a * sin(q * {axis[0]}) + b * cos(q * {axis[0]}))"
    size = {"a": "sine part", "b": "cosine part"}
    parameters = [Parameter(n, "1", (-_WIDE, _WIDE), 0.0, about, 0.1, step=1e-3) for n, about in size.items()]
    number = Parameter(
        "q",
        "1/m",
        (0.5 * wave, 2.0 * wave),
        wave,
        "wave number",
        wave,
        search=Search.STARTS,
        starts=(wave,),
        step=1e-3,
    )
    return Term(f"{TERM}{channel[-1]}_{factor}_along_{axis}", channel, text, (*parameters, number))


def is_term(name: str) -> bool:
    """Whether an id is that of a term."""
    return name.startswith(TERM)


def join_formula(terms: Sequence[FormulaEffect]) -> dict[str, object]:
    """Several terms as one formula effect, ready for a model file.

    Returns:
        ``id``, a text for each channel, and the parameters {name: {value, unit, bounds}}.
    """
    texts: dict[str, list[str]] = {}
    parameters: dict[str, dict[str, object]] = {}
    for number, term in enumerate(terms, start=1):
        ((channel, text),) = term.formulas.items()
        for parameter in term.parameters:
            name = f"{parameter.name}_{number}"
            text = _rename(text, parameter.name, name)
            parameters[name] = {
                "value": float(f"{term.values[parameter.name]:.6g}"),
                "unit": parameter.unit,
                "bounds": list(parameter.bounds),
                "fixed": parameter.name in term.fixed,
            }
        texts.setdefault(channel, []).append(text)
    return {
        "id": "unexplained",
        **{channel: " + ".join(parts) for channel, parts in texts.items()},
        "parameters": parameters,
    }


def _rename(text: str, old: str, new: str) -> str:
    import re  # noqa: PLC0415 - only for what is unexplained

    return re.sub(rf"\b{old}\b", new, text)
