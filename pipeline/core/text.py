"""Texts: errors, numbers with their digits, lengths, durations, shares in words; levels of statistics."""

import json
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import islice
from typing import Any, Literal, TypeVar, get_args

Key = TypeVar("Key")
Item = TypeVar("Item")

_BEGINNING = 3
"""Letters of the beginning that decide between names which are equally near."""
_READABLE = 300
"""Maximum number of characters of quoted text in a sentence: four lines of a screen."""
LONGEST_NAME = 200
"""Maximum number of characters of a name from a file in tables and sentences."""
LONGEST_TEXT = 1000
"""Maximum number of characters of an error or a loss, which may quote a text of any size from a file."""
_FEW = 8
"""Number of names up to which a sentence lists all: about two lines of a screen."""


class SlipError(Exception):
    """An error that the user can correct.

    Args:
        code: stable identifier in snake_case, for example ``log_not_found``.
        what: what is wrong, one sentence without a full stop.
        where: the file, topic, key or line it concerns; empty when there is none.
        hint: what to do about it.
    """

    def __init__(self, code: str, what: str, *, where: str = "", hint: str) -> None:
        super().__init__(what)
        self.code = code
        # Errors quote files, whose texts may have any length.
        self.what = shorten(what, LONGEST_TEXT)
        self.where = where
        self.hint = shorten(hint, LONGEST_TEXT)

    def __str__(self) -> str:
        """One line: where, what, what to do."""
        origin = f"{self.where}: " if self.where else ""
        return f"{origin}{self.what}. {self.hint.rstrip('.')}."

    def _render_traceback_(self) -> list[str]:
        """The same line in place of a traceback in a notebook."""
        return [f"slip: {' '.join(str(self).split())}"]

    def __reduce__(self) -> tuple[object, ...]:
        """Keep every part when the error crosses a process boundary."""
        return _rebuild, (type(self), self.code, self.what, self.where, self.hint)


def shorten(text: str, most: int = _READABLE) -> str:
    """A text; of a long one the first ``most`` characters, and how many it has."""
    return text if len(text) <= most else f"{text[:most]}... (cut, of {len(text):,} characters)"


def make_plain(text: str) -> str:
    """Replace unprintable characters, so that the text fits on one line, or into XML."""
    return "".join(c if c.isprintable() else " " for c in text)


def group_by(pairs: Iterable[tuple[Key, Item]]) -> dict[Key, list[Item]]:
    """The items of every key; keys and items are in the order of the pairs."""
    groups: dict[Key, list[Item]] = {}
    for key, item in pairs:
        groups.setdefault(key, []).append(item)
    return groups


def guess_names(name: str, known: Iterable[str], *, end: str = "") -> str:
    """`Did you mean husky_a200? ` if known names resemble an unknown one; else empty.

    Args:
        name: the unknown name.
        known: the names that there are.
        end: common end of all names, which does not make them alike.
    """
    import difflib  # noqa: PLC0415 - only needed once something is already wrong

    near = difflib.get_close_matches(name.removesuffix(end), [one.removesuffix(end) for one in known], n=3)
    return f"Did you mean {' or '.join(f'{one}{end}' for one in near)}? " if near else ""


def list_nearest(name: str, known: Iterable[str], count: int = 3) -> list[str]:
    """The known names that resemble a name most, as a whole or in their beginning, the nearest first."""
    import difflib  # noqa: PLC0415 - only needed once something is already wrong

    def rate(one: str) -> tuple[float, bool]:
        parts = (one, one[: len(name)])
        alike = max(difflib.SequenceMatcher(None, name, part).ratio() for part in parts)
        return alike, one.startswith(name[:_BEGINNING])

    return sorted(known, key=rate, reverse=True)[:count]


def _rebuild(kind: type[SlipError], code: str, what: str, where: str, hint: str) -> SlipError:
    return kind(code, what, where=where, hint=hint)


@contextmanager
def naming_os_errors(
    make: type[SlipError], code: str, what: str, *, where: object, hint: str
) -> Iterator[None]:
    """Context manager that raises errors of the operating system as `SlipError` with their reason.

    Raises:
        SlipError: of the class `make`.
    """
    try:
        yield
    except OSError as error:
        raise make(code, f"{what}: {error.strerror or error}", where=str(where), hint=hint) from error


def format_count(number: int, word: str) -> str:
    """A number of things in words: `1 run`, `3 runs`."""
    return f"{number} {word}{'s' * (number != 1)}"


def align_rows(rows: Sequence[Sequence[str]], *, right: Collection[int] = (), gap: int = 2) -> list[str]:
    """Rows of texts as lines with aligned columns; those in ``right`` at their right ends."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        (" " * gap)
        .join(f"{text:{'>' if k in right else '<'}{widths[k]}}" for k, text in enumerate(row))
        .rstrip()
        for row in rows
    ]


_MINUTE, _HOUR = 60.0, 3600.0  # seconds
_DAYS = 3
"""Days from which a duration is told in days: an experiment of 48 h is one of hours."""
_LEAST_CM = 0.01
"""Length below which it is told in millimetres [m]."""
_LEAST_PART = 0.001
"""Part of a whole below which its digits say nothing: intervals of budgets are wider."""
_NEARLY_ALL = 0.95
"""Share of the recording below which the compared duration is shown as well."""

INPUTS = ("command", "measured")
UNFINISHED = (INTERRUPTED, NOT_STARTED) = ("interrupted", "not_started")
"""States of logs that a batch was to work on and did not finish: of those it began, and of the others."""
_STATES = {
    "lossy": "with losses", "copy": "copies", "growing": "being written",
}  # fmt: skip


def name_state(state: str) -> str:
    """What a log of a batch came out as, in words."""
    return _STATES.get(state, state.replace("_", " "))


INPUT_WORDS = {"command": "from commands", "measured": "from wheel encoders"}
"""Text for each input of the ideal model."""

FigureFormat = Literal["svg", "pdf", "png"]
FIGURES: tuple[FigureFormat, ...] = get_args(FigureFormat)


def suffix_unit(unit: object) -> str:
    """A unit as the suffix of a number; empty for a plain number, or one of unknown unit."""
    return "" if unit in {None, "", "1"} else f" {unit}"


def mark_finding(severity: object) -> str:
    """Mark in front of a finding: `!!` forbids conclusions, `!` is a warning."""
    return {"error": "!! ", "warning": "!  "}.get(str(severity), "   ")


def format_section(section: str, lines: Iterable[str]) -> str:
    """One line of TOML that gives keys of a section: it can be pasted as it stands.

    Args:
        section: its name.
        lines: ``key = value`` of each.
    """
    return f"{section} = {{{', '.join(lines)}}}"


def format_line(key: str, value: object) -> str:
    """`key = value` in a line of TOML: texts, numbers to six digits, lists and tables."""
    return f"{key} = {_format_toml(value)}"


def _format_toml(value: object) -> str:
    if isinstance(value, Mapping):
        return f"{{{', '.join(format_line(json.dumps(key), one) for key, one in value.items())}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_format_toml, value))}]"
    return f"{value:g}" if isinstance(value, float) else json.dumps(value, ensure_ascii=False)


def enumerate_texts(texts: Sequence[str]) -> str:
    """Texts as a list in a sentence: `a, b and c`; empty where there are none."""
    return " and ".join(filter(None, [", ".join(texts[:-1]), *texts[-1:]]))


def name_first(names: Collection[str], most: int = _FEW) -> str:
    """Names as a list in a sentence, long ones shortened: `a, b and c`, or `a, b and 41,000 more`.

    Args:
        names: what is listed, such as topics, types, frames or fields.
        most: number up to which all are listed; of more the first ones are.
    """
    shown = len(names) if len(names) <= most else most - 1
    first = [shorten(name, LONGEST_NAME) for name in islice(names, shown)]
    return enumerate_texts(first if shown == len(names) else [*first, f"{len(names) - shown:,} more"])


def format_digits(value: float, digits: int = 2) -> str:
    """A number of so many significant digits, at least those before the point; a whole number for 0."""
    leading = math.floor(math.log10(abs(value))) if value and math.isfinite(value) else 0
    places = max(digits - 1 - leading, 0) if digits else 0
    text = f"{value:z.{places}f}"
    return text.rstrip("0").rstrip(".") if places else text


def format_two(value: float) -> str:
    """A number of two significant digits, zeros included: 2.0 and 0.50; 4.8e-10 for one that is tiny."""
    text = f"{value:.1e}"
    if not math.isfinite(value) or "e-" in f"{value:.2g}":
        return text
    leading = int(text.partition("e")[2])
    return f"{value:z.{max(1 - leading, 0)}f}"


_LEAST_UNITS = 3.55
"""Least half of an interval in units of the last digit of its value, as of the Particle Data Group: rounding
moves a value by a seventh of that half at most; with twice as many a digit is chance, with half a quarter is
lost."""
_UNEVEN = 0.1
"""Least half of an interval over the other half for the digits to follow it: one may be cut at a bound."""
_NOTHING = 1e-3
"""Part of an interval's half that a value has no digit below."""


def count_places(half: float) -> int:
    """Places behind the point that the half of an interval supports, negative for tens and hundreds."""
    return -math.floor(math.log10(half / _LEAST_UNITS))


def split_interval(value: float, low: float, high: float) -> tuple[str, str, str]:
    """A value and the ends of its interval with the digits that the interval supports.

    The last digit is that of the narrower half, so that both ends differ from the value as printed; a value
    has one digit at least, unless it is smaller than a thousandth of that.
    """
    halves = value - low, high - value
    half = max(min(halves), _UNEVEN * max(halves))
    if not 0.0 < half < math.inf:
        return f"{value:.3g}", f"{low:.3g}", f"{high:.3g}"
    # Whole numbers at the coarsest: in tens, an end near zero would be zero.
    places = max(count_places(half), 0)
    if abs(value) > _NOTHING * half:
        places = max(places, -math.floor(math.log10(abs(value))))
    value_text, low_text, high_text = (f"{one:z.{places}f}" for one in (value, low, high))
    return value_text, low_text, high_text


def format_interval(value: float, low: float, high: float, unit: object = None) -> str:
    """A value with its unit and its interval: `14.401 rad/s [14.378, 14.424]`."""
    text, *ends = split_interval(value, low, high)
    return f"{text}{suffix_unit(unit)} [{', '.join(ends)}]"


def format_share(share: float, digits: int = 2) -> str:
    """A share as text in percent: `56 %`, `8.6 %`, `0.5 %`.

    Args:
        share: 1 is the whole.
        digits: see `format_digits`.
    """
    return f"{format_digits(100.0 * share, digits)} %"


def format_part(share: float) -> str:
    """A part of a whole in percent: `56 %`, `0.4 %`, `-2 %`, and `< 0.1 %` of either sign below that."""
    return "< 0.1 %" if 0.0 < abs(share) < _LEAST_PART else format_share(share, 1)


def format_length(metres: float, extra: int = 0) -> str:
    """A length as text: `1.06 m`, below one metre `5.7 cm`, below one centimetre `1.8 mm`.

    Args:
        metres: the length [m].
        extra: number of digits beyond these.
    """
    if metres >= 1.0:
        return f"{format_digits(metres, 3 + extra)} m"
    return (
        f"{format_digits(100.0 * metres, 2 + extra)} cm"
        if metres >= _LEAST_CM
        else f"{format_digits(1000.0 * metres, 2 + extra)} mm"
    )


def format_angle(radians: float, extra: int = 0) -> str:
    """An angle as text: `1 degree`, `0.8 degrees`, `12 degrees`; or with more digits."""
    text = format_digits(math.degrees(radians), 2 + extra)
    return f"{text} degree{'s' * (text != '1')}"


def format_errors(metres: float, radians: float) -> str:
    """Errors of position and heading as text: `1.06 m and 55 degrees`; one that is NaN is left out."""
    sizes = [format_length(metres)] if math.isfinite(metres) else []
    sizes += [format_angle(radians)] if math.isfinite(radians) else []
    return " and ".join(sizes) or "by an unknown amount"


def format_size(count: float) -> str:
    """A size in bytes, kB or MB: `1.8 MB`."""
    for unit, size in (("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:,.1f} {unit}"
    return f"{count:.0f} B"


def format_duration(seconds: float) -> str:
    """A duration in its two largest units: `3.2 s`, `10 min 48 s`, `2 h 03 min`, `30 days 2 h`."""
    seconds = round_digits(seconds)
    if seconds < _MINUTE:
        return f"{round(seconds, 1) or float(f'{seconds:.1g}'):g} s"
    whole = round(seconds)
    if whole < _HOUR:
        return f"{whole // 60} min {whole % 60:02d} s"
    if whole < _DAYS * 24 * _HOUR:
        return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    return f"{whole // 86400} days {whole % 86400 // 3600} h"


def format_recorded(recorded_s: float, compared_s: object = None) -> str:
    """Duration of a log, and of its part with slip if that is clearly less."""
    text = format_duration(recorded_s)
    if isinstance(compared_s, int | float) and compared_s < _NEARLY_ALL * recorded_s:
        text += f", {format_duration(compared_s)} of it compared"
    return text


# Levels of statistics that several rooms share, and numbers as they stand in JSON.

NORMAL_95 = 1.959964
"""Half of a normal distribution's 95 % interval, in standard deviations."""


CONFIDENCE = 0.95
"""Coverage probability of intervals: the convention of the published comparisons."""


FEWEST_OF_SPREAD = 3
"""Fewest values, runs or stretches for a spread: the difference of two does not determine one."""


FOLDS = 5
"""Number of folds of a cross-validation: each is fitted to four fifths of the run."""


JSON_DIGITS = 6
"""Significant digits of estimates in JSON, more than any estimate has."""


def round_digits(value: float, digits: int = JSON_DIGITS) -> float:
    """A number of that many significant digits."""
    return float(f"{value:.{digits}g}")


def finite_or_none(value: float, digits: int | None = None) -> float | None:
    """A number, rounded to ``digits`` significant digits if given; None if it is not finite."""
    if not math.isfinite(value):
        return None
    return value if digits is None else round_digits(value, digits)


def round_numbers(value: object, digits: int | None = JSON_DIGITS) -> object:
    """An object with numbers of so many digits, by default of JSON; None for those that are not finite."""
    if isinstance(value, float):
        return finite_or_none(value, digits)
    if isinstance(value, dict):
        return {key: round_numbers(one, digits) for key, one in value.items()}
    return [round_numbers(one, digits) for one in value] if isinstance(value, list | tuple) else value


def pick(item: object, *names: str) -> dict[str, Any]:
    """Selected fields of an object by name."""
    return {name: getattr(item, name) for name in names}


def pick_finite(item: object, *names: str, digits: int | None = None) -> dict[str, float | None]:
    """Selected numbers of an object by name, as `finite_or_none`."""
    return {name: finite_or_none(getattr(item, name), digits) for name in names}
