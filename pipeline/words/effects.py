"""Effects as text: what the vehicle does by them, their possible causes, and their values."""

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache

from pipeline.core import format_interval, round_digits, split_interval, suffix_unit
from pipeline.models import (
    Effect,
    Late,
    Level,
    Meaning,
    Number,
    find_effect,
    list_effects,
    name_term,
    suggest_manoeuvre,
)
from pipeline.results import Named, RunDiagnosis, Undecided, read_model

CAUSE = ". Cause: "
"""Separator between an effect and its possible causes in the sentence of a named effect."""
_TIGHT = 10.0
"""Expected range between runs over the interval in this run above which a row says so: a limit that clips the
samples of one run is known to a fraction of a percent there, and not in the next run."""
_MOST_ALTERNATIVES = 3
"""Alternatives of an effect that it names."""


def restore_known(name: str, values: Mapping[str, Number]) -> Effect:
    """The effect for text: digits that intervals support, and of several values those that are known.

    A value that is estimated to be neutral stays; so does a single parameter.
    """
    new = find_effect(name)()
    effect = new.change(**{key: one.value for key, one in values.items()})
    effect = effect.limit_digits({key: one.digits for key, one in values.items()})
    if len(new.parameters) == 1:
        return effect
    unknown = {key: one for key, one in values.items() if one.is_open(new.parameter(key))}
    return effect.omit_open(
        key
        for key, one in unknown.items()
        if one.value != new.parameter(key).neutral or not math.isfinite(one.half)
    )


def is_open(effect: str, name: str, number: Number) -> bool:
    """Whether the runs do not tell how large a number of an effect is."""
    kind = _list_known().get(effect)
    return number.is_undetermined if kind is None else number.is_open(kind().parameter(name))


def _list_ends(effect: Named) -> list[Mapping[str, Number]]:
    """The values between which an effect is, in their order.

    Where runs or grounds have their own, those that are determined; of one number that its interval leaves
    open, both ends of it.
    """
    values = effect.parameters
    if own := sorted(effect.own):
        known = [one for one in effect.by_run if not any(value.is_undetermined for value in one.values())]
        return sorted(known, key=lambda one: one[own[0]].value) or [values]
    wide = [key for key, one in values.items() if not one.is_undetermined and is_open(effect.id, key, one)]
    if len(values) != 1 or not wide:
        return [values]
    return [{key: Number(end)} for key in wide for end in (values[key].low, values[key].high)]


def describe_motion(effect: Named, run: RunDiagnosis) -> str:
    """What the vehicle does by an effect, with its values beside the other effects of the model.

    Where runs or grounds have their own values, it is a range, or says by what they differ.
    """
    vehicle = run.vehicle
    if vehicle is None or effect.id not in _list_known():
        return name_term(effect.id)
    effects = [restore_known(effect.id, one) for one in _list_ends(effect)]
    texts = [one.describe_motion(vehicle, _list_beside(run), run.asked) for one in effects]
    joined = "" if len(effect.own) > 1 else _join_range(texts)
    otherwise = f"{name_term(effect.id).capitalize()}: its values differ {name_scope(effect)}"
    return joined or (otherwise if effect.own else " to ".join(texts))


def describe_clause(effect: Named, run: RunDiagnosis) -> str:
    """What the vehicle does by an effect, as a clause; empty where its vehicle is unknown.

    Where runs or grounds have their own values, or where the run leaves its only number open, it is a range:
    `turns at 40 to 52 % of the ideal rate`.
    """
    vehicle = run.vehicle
    if vehicle is None or effect.id not in _list_known():
        return ""
    effects, beside = [restore_known(effect.id, one) for one in _list_ends(effect)], _list_beside(run)
    texts = [one.describe_clause(vehicle, beside, run.asked) for one in effects]
    return "" if len(effect.own) > 1 else _join_range(texts)


def describe_instead(effect: Named, run: RunDiagnosis) -> str:
    """What no recording like this one distinguishes from an effect, in a few words; empty without that."""
    if not effect.equivalent_to:
        return ""
    text, vehicle = "", run.vehicle
    if vehicle is not None and effect.id in _list_known() and not effect.own:
        text = restore_known(effect.id, effect.parameters).describe_instead(vehicle)
    return f"or {text or ' or '.join(map(name_term, effect.equivalent_to))}"


@lru_cache(maxsize=8)
def _read_effects(model: str) -> tuple[Effect, ...]:
    file = read_model(RunDiagnosis(model=model))
    return () if file is None else file.model.effects


def _list_beside(run: RunDiagnosis) -> tuple[Effect, ...]:
    """All effects of the model of a diagnosis."""
    return () if run.model is None else _read_effects(run.model)


def _join_range(texts: Sequence[str]) -> str:
    """Texts of ascending values of one number as one text with its ranges; empty where they differ otherwise.

    They differ in numbers, perhaps with unit and side: `poses are stamped 20 ms early to 0.25 s late`.
    """
    rows = [text.split(" ") for text in texts]
    if len({len(row) for row in rows}) != 1:
        return ""
    words: list[str] = []
    end = 0
    for first, last in _list_unlike(rows):
        values = [row[first:last] for row in rows]
        try:
            numbers = [float(number) for number, *_ in values]
        except ValueError:
            return ""
        if last - first == 1:
            # A share may fall where the value grows.
            values = [one for _, one in sorted(zip(numbers, values, strict=True))]
        words += [*rows[0][end:first], *values[0], "to", *values[-1]]
        end = last
    return " ".join([*words, *rows[0][end:]])


def _list_unlike(rows: Sequence[Sequence[str]]) -> list[tuple[int, int]]:
    """First word and end of each part in which rows of words differ; one common word does not part them."""
    parts: list[tuple[int, int]] = []
    for number, column in enumerate(zip(*rows, strict=True)):
        if len(set(column)) > 1:
            near = parts and number - parts[-1][1] <= 1
            parts[-1:] = [(parts[-1][0], number + 1)] if near else [*parts[-1:], (number, number + 1)]
    return parts


def describe_number(effect: str, parameter: str) -> str:
    """What a parameter is, as `effective over nominal track`; empty for an effect that is not known here."""
    kind = _list_known().get(effect)
    return "" if kind is None else kind().parameter(parameter).about.partition(" (")[0]


def list_readings(effect: Named) -> tuple[Meaning, ...]:
    """Its meanings as a property of the vehicle, the ground or the run, which one run cannot separate."""
    kind = _list_known().get(effect.id)
    known = () if kind is None else kind.readings
    if effect.corrected:
        # The delay comes from the gyro, so it is that of the pose clock and not of the body.
        known = tuple(one for one in known if one.name == effect.id)
    level = Level.RUN if is_clock(effect) else Level.TERRAIN
    return tuple(one for one in known if one.level is level) if effect.by_run else known


def is_clock(effect: Named) -> bool:
    """Whether it is a clock, of which each run has its own."""
    kind = _list_known().get(effect.id)
    return kind is not None and kind.late is Late.POSES


def name_scope(effect: Named) -> str:
    """Between what its own values differ."""
    return "by run" if is_clock(effect) else "by terrain"


def describe_cause(effect: Named) -> str:
    """Possible causes of an effect where one run cannot separate them; else empty."""
    texts = {reading.name: reading.text for reading in reversed(list_readings(effect))}
    if len(texts) <= 1:
        return ""
    between = ", or " if any(" or " in text for text in texts.values()) else " or "
    return f"{between.join(texts.values())}; a run on another surface separates them."


def describe_effect(effect: Named, run: RunDiagnosis) -> str:
    """An effect with its values, and its possible causes."""
    motion, cause = describe_motion(effect, run), describe_cause(effect)
    return f"{motion}{CAUSE}{cause}" if cause else motion


def describe_separation(item: Undecided) -> str:
    """The manoeuvre that distinguishes alternatives."""
    return suggest_drive(*item.candidates)


def suggest_drive(*names: str) -> str:
    """Manoeuvres that excite effects; nothing for those that are not loaded."""
    known = _list_known()
    return suggest_manoeuvre(*(known[name]() for name in names if name in known))


def _list_known() -> dict[str, type[Effect]]:
    return {kind.id: kind for kind in list_effects()}


def name_group(candidates: Sequence[str]) -> str:
    """Alternatives in words: `body inertia or lateral skid`; of many the first two, and how many more."""
    names = list_names(candidates)
    return " or ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))


def list_names(candidates: Sequence[str]) -> list[str]:
    """Alternatives by their terms; of many the first two, and how many more."""
    names = [name_term(name) for name in candidates]
    return [*names[:2], f"{len(names) - 2} others"] if len(names) > _MOST_ALTERNATIVES else names


def format_value(value: Number) -> str:
    """A value with its interval where there is one, and whether it is at its bound."""
    text = f"{round_digits(value.value, value.digits):.3g}{suffix_unit(value.unit)}"
    if math.isfinite(value.high - value.low):
        text = format_interval(value.value, value.low, value.high, value.unit)
    elif math.isfinite(value.low):
        text += f" [{value.low:.3g}, {value.high:.3g}]"
    return f"{text} ({value.mark})" if value.doubt else text


def format_with_range(value: Number) -> str:
    """A value; where its interval says little about another run, that it is this run's.

    The range between runs stands beside it where it was measured how much runs differ.
    """
    low, high = value.another_run.low, value.another_run.high
    if not high - low > _TIGHT * (value.high - value.low):
        return format_value(value)
    _, *ends = split_interval(value.value, low, high)
    return f"{format_value(value)} this run" + (
        f", [{', '.join(ends)}] another" if value.is_spread_measured else ""
    )


def format_numbers(numbers: Mapping[str, Number]) -> str:
    """Values of an effect by parameter, with their intervals."""
    return ", ".join(f"{name} = {format_value(value)}" for name, value in numbers.items())
