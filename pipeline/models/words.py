"""What effects are called and what a vehicle with one does: templates of `words.toml` and numbers."""

import functools
import math
import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import resources

import msgspec

from pipeline.core import (
    enumerate_texts,
    format_angle,
    format_digits,
    format_length,
    format_share,
    round_digits,
)
from pipeline.models.expression import Expression, parse_expression
from pipeline.models.parameter import PLAIN
from pipeline.sources import Vehicle

_FIELD = re.compile(r"\{([^{}:]+):([^{}]*)\}")
_PART = re.compile(r"(?=, | \()(?![^{]*\})")
_SHORT_S = 0.1
"""Time below which it is said in milliseconds: two digits of them are as short as those of seconds above."""
_FORMATS: Mapping[str, Callable[[float], str]] = {
    "length": format_length,
    "angle": format_angle,
    "share": format_share,
    "time": lambda value: (
        f"{format_digits(value)} s" if value >= _SHORT_S else f"{format_digits(1e3 * value)} ms"
    ),
    "percent": lambda value: format_share(value, 3),
    "less": lambda value: f"{format_share(abs(1.0 - value), 0)} {'less' if value <= 1.0 else 'more'}",
}
MOST_DIGITS = 3
"""Significant digits of the formats that have most."""
_BRISK_MPS = 3.0
"""Speed at which an effect that grows with it is told [m/s]; of a slower vehicle, its largest."""


class Words(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Templates of one effect.

    A template holds fields ``{formula:format}`` over the parameters, ``radius``, ``track`` and ``wheelbase``
    of the vehicle, ``brisk``, a speed that it reaches, and ``others``. A format is one of Python's, one of
    `_FORMATS`, or two words for a positive and a negative number, ``left|right``. Of several templates the
    first applies whose numbers are all known; of the last one, parts after a comma or in brackets with an
    unknown number are left out.

    Attributes:
        motion: name, colon, and what the vehicle does.
        clause: what it does as a predicate of "the robot", or as a clause that begins with "the"; where it is
            empty, the part of `motion` after the colon serves.
        instead: what would show the same where an effect acts in its place that nothing distinguishes from
            it; where it is empty, the names of these effects serve.
        beside: other effects of one factor that change the same motion, and what they are called: `others` is
            the product of their factors, and ``{with}`` names those that act.
    """

    motion: tuple[str, ...] = ()
    clause: tuple[str, ...] = ()
    instead: tuple[str, ...] = ()
    beside: Mapping[str, str] = {}

    @property
    def name(self) -> str:
        """What the effect is called; empty where that is its id."""
        head = self.motion[0].partition(": ")[0] if self.motion else ""
        return "" if "{" in head else head


@functools.cache
def _read_words() -> Mapping[str, Words]:
    text = resources.files("pipeline.models").joinpath("words.toml").read_text("utf-8")
    return msgspec.convert(tomllib.loads(text), dict[str, Words])


def find_words(effect: str) -> Words:
    """The templates of an effect; empty ones for an effect that has none."""
    return _read_words().get(effect, Words())


@dataclass(frozen=True)
class Sentences:
    """What is said of one effect of a model.

    Attributes:
        title: what it is called where its words have no name.
        words: its templates.
        values: its parameters by name.
        vehicle: nominal geometry.
        unknown: names of parameters that are left out.
        beside: first parameters of the other effects of the model, by id.
        digits: significant digits of parameters, by name; a number computed from several has as many as the
            one that has fewest.
    """

    title: str
    words: Words
    values: Mapping[str, float]
    vehicle: Vehicle
    unknown: frozenset[str] = frozenset()
    beside: Mapping[str, float] = field(default_factory=dict)
    digits: Mapping[str, int] = field(default_factory=dict)

    def describe_motion(self) -> str:
        """Name and numbers; the name alone where no number is known."""
        return self._fill(self.words.motion)

    def describe_clause(self) -> str:
        """A clause of a sentence; empty where no number is known."""
        if self.words.clause:
            return self._fill(self.words.clause)
        does = self.describe_motion().partition(": ")[2].removeprefix("the robot ")
        return does.replace("base_link", "the reference point")

    def describe_instead(self) -> str:
        """What would show the same in its place; empty where it has no words for that."""
        return self._fill(self.words.instead) if self.words.instead else ""

    def _fill(self, templates: tuple[str, ...]) -> str:
        acting = {name: self.beside[name] for name in self.words.beside if name in self.beside}
        named = enumerate_texts([self.words.beside[name] for name, value in acting.items() if value != 1.0])
        vehicle = self.vehicle
        geometry = {
            "radius": vehicle.wheel_radius_m,
            "track": math.nan if "track_width_m" in vehicle.stand_ins else vehicle.track_width_m or 1.0,
            "wheelbase": vehicle.wheelbase_m or 1.0,
            "brisk": min(_BRISK_MPS, vehicle.max_speed_mps or math.inf),
        }
        values = {**self.values, **geometry, "others": math.prod(acting.values())}
        unknown = {*self.unknown, *(name for name, value in values.items() if not math.isfinite(value))}

        def is_known(text: str) -> bool:
            used = (_parse(match[1], tuple(values)).names for match in _FIELD.finditer(text))
            return unknown.isdisjoint(frozenset().union(*used))

        chosen = next((text for text in templates if is_known(text)), templates[-1])
        name, colon, numbers = chosen.rpartition(": ")
        text = "".join(filter(is_known, _PART.split(numbers))).removeprefix(", ")
        if colon:
            head = name if is_known(name) else self.title
            text = head + (text and f": {text}")
        text = text.replace("{with}", named and f", with {named}")

        def write(match: re.Match[str]) -> str:
            formula = _parse(match[1], tuple(values))
            digits = [self.digits[name] for name in formula.names if name in self.digits]
            return _format(float(formula.evaluate(values)), match[2], min(digits, default=MOST_DIGITS))

        return _FIELD.sub(write, text)


@functools.lru_cache(maxsize=1024)
def _parse(formula: str, names: tuple[str, ...]) -> Expression:
    return parse_expression(formula, dict.fromkeys(names, PLAIN), "words.toml")


def _format(number: float, spec: str, digits: int) -> str:
    """A number with the digits of its format, or with fewer; it is rounded once."""
    if "|" in spec:
        return spec.split("|")[number < 0.0]
    if digits < MOST_DIGITS:
        number = round_digits(number, digits)
    return _FORMATS[spec](number) if spec in _FORMATS else format(number, spec)
