"""A tiny algebra of units over metre, second and kilogram; radians are plain numbers."""

from __future__ import annotations

import re
from dataclasses import dataclass
from fractions import Fraction

from pipeline.runs.errors import MotionError

_TOKEN = re.compile(r"\s*(?:([A-Za-z]+|1)(?:\s*(?:\^|\*\*)\s*(-?\d{1,2}))?|([*/]))\s*")
_LONGEST = 60


@dataclass(frozen=True)
class Unit:
    """Powers of metre, second and kilogram."""

    metre: Fraction = Fraction(0)
    second: Fraction = Fraction(0)
    kilogram: Fraction = Fraction(0)

    def __mul__(self, other: Unit) -> Unit:
        return Unit(self.metre + other.metre, self.second + other.second, self.kilogram + other.kilogram)

    def __truediv__(self, other: Unit) -> Unit:
        return self * other.power(Fraction(-1))

    def power(self, exponent: Fraction) -> Unit:
        """The unit to a power."""
        return Unit(self.metre * exponent, self.second * exponent, self.kilogram * exponent)

    def __str__(self) -> str:
        above = _write(("m", self.metre), ("kg", self.kilogram), ("s", self.second))
        below = _write(("m", -self.metre), ("kg", -self.kilogram), ("s", -self.second))
        return f"{above or '1'}/{below}" if below else above or "1"


def _write(*parts: tuple[str, Fraction]) -> str:
    return "*".join(name if power == 1 else f"{name}^{power}" for name, power in parts if power > 0)


PLAIN = Unit()
_METRE, _SECOND, _KILOGRAM = Unit(metre=Fraction(1)), Unit(second=Fraction(1)), Unit(kilogram=Fraction(1))
_NEWTON = _KILOGRAM * _METRE / (_SECOND * _SECOND)
_KNOWN = {
    "1": PLAIN,
    "rad": PLAIN,
    "m": _METRE,
    "s": _SECOND,
    "kg": _KILOGRAM,
    "N": _NEWTON,
    "J": _NEWTON * _METRE,
    "W": _NEWTON * _METRE / _SECOND,
    "Hz": PLAIN / _SECOND,
}


def parse_unit(text: str, where: str) -> Unit:
    """Read a unit such as ``m/s^2`` or ``N*m``; what follows a ``/`` is divided by, factor by factor.

    Args:
        text: the unit.
        where: file and line, for the error message.

    Raises:
        MotionError: ``bad_unit``.
    """
    unit, place, divide, expect = PLAIN, 0, False, True
    while place < len(text) <= _LONGEST:
        found = _TOKEN.match(text, place)
        if found is None or (found.group(3) is None) != expect:
            break
        place = found.end()
        if found.group(3) is not None:
            divide, expect = found.group(3) == "/", True
            continue
        name, power = found.group(1), found.group(2)
        if name not in _KNOWN:
            break
        factor = _KNOWN[name].power(Fraction(int(power or 1)))
        unit, expect = (unit / factor if divide else unit * factor), False
    else:
        if not expect:
            return unit
    hint = f"Write products and powers of {', '.join(_KNOWN)}, for example m/s^2."
    raise MotionError("bad_unit", f"{text[:_LONGEST]!r} is not a unit", where=where, hint=hint)
