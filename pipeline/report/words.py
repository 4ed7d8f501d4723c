"""Text for pages and screens: numbers with units, distances, dates."""

import math
from datetime import UTC, datetime

MISSING = "\u2013"
_KILOMETRE = 1000.0
_MOST_PLACES = 3
_EARLIEST_YEAR = 2000


def begin_large(text: str) -> str:
    """The text with a capital at its start; a name of ours (`drive_lag.tau`) stays as it is written."""
    first = text.split(maxsplit=1)[0].rstrip(".,:;") if text.strip() else ""
    return text if "_" in first or "." in first else text[:1].upper() + text[1:]


def say_number(value: float | None, *, digits: int = 3) -> str:
    """A number with so many significant digits, at most three decimals; a dash when there is none."""
    if value is None or not math.isfinite(value):
        return MISSING
    if value == 0.0:
        return "0"
    places = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:,.{min(places, _MOST_PLACES)}f}".replace("-", "\u2212")


def say_share(value: float | None) -> str:
    """A share as a percentage, a dash when there is none."""
    return MISSING if value is None else f"{value:z.0%}".replace("-", "\u2212").replace("%", "\u202f%")


def say_split(drivetrain: float, ground: float, cross: float) -> str:
    """How the mean square of the slip on command splits; in words where the parts cancel each other.

    Args:
        drivetrain: share of what happens between command and wheels.
        ground: share of what happens between wheels and body.
        cross: share of twice their product.
    """
    if max(drivetrain, ground) <= 1.0:
        shares = zip(("drivetrain", "ground", "cross"), (drivetrain, ground, cross), strict=True)
        return ", ".join(f"{name} {share:z.0%}" for name, share in shares)
    one, two = (say_number(math.sqrt(share), digits=2) for share in (drivetrain, ground))
    return (
        f"drivetrain and ground cancel in part: {one} and {two} times the slip that is left (rms), "
        "so shares would mean nothing"
    )


def say_distance(metres: float | None) -> str:
    """A distance in m or km."""
    if metres is None:
        return MISSING
    return f"{metres / _KILOMETRE:.2f} km" if metres >= _KILOMETRE else f"{metres:.0f} m"


def say_date(nanoseconds: int | None) -> str:
    """Day and time (UTC) of a stamp; empty where the clock was never set."""
    if nanoseconds is None:
        return ""
    try:
        day = datetime.fromtimestamp(nanoseconds / 1e9, UTC)
    except (OverflowError, OSError, ValueError):
        return ""
    return day.strftime("%Y-%m-%d %H:%M UTC") if day.year >= _EARLIEST_YEAR else ""


def say_bytes(count: float | None) -> str:
    """A size in bytes, kB or MB."""
    if count is None:
        return MISSING
    for unit, size in (("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count:.0f} B"
