"""Errors of a model as text: their size, where and when they arise, what remains, and the ladder."""

import math
import re
from collections.abc import Callable, Sequence
from contextlib import suppress

from pipeline.core import (
    INPUT_WORDS,
    enumerate_texts,
    format_angle,
    format_count,
    format_digits,
    format_errors,
    format_length,
    format_share,
    group_by,
)
from pipeline.models import FEW_STRETCHES, TOO_SHORT
from pipeline.results import (
    ABOVE_FLOOR,
    BREVITY,
    CHANCE,
    ERRORS_OVER_2S,
    INTERVAL_SHARE,
    Errors,
    Moments,
    Region,
    RunDiagnosis,
    Step,
    Stretch,
    Unexplained,
    list_excess,
    list_rises,
)
from pipeline.run import HORIZON_S

ERROR_WORDS = {"x": "forward error", "y": "lateral error", "w": "yaw error"}
REGIONS = {
    "left": "turning left faster than {0:.2g} rad/s",
    "right": "turning right faster than {0:.2g} rad/s",
    "forward": "forward above {0:.2g} m/s",
    "backward": "backward above {0:.2g} m/s",
    "turning": "turning faster than {0:.2g} rad/s",
    "driving": "above {0:.2g} m/s",
    "curve": "turning faster than {0:.2g} rad/s while driving above {1:.2g} m/s",
    "on_the_spot": "turning on the spot",
    "straight": "driving straight",
    "to_the_left": "to the left above {0:.2g} m/s",
    "to_the_right": "to the right above {0:.2g} m/s",
    "sideways": "sideways above {0:.2g} m/s",
    "change": "within {0:g} s of a change of command",
    "steady": "in steady driving",
    "between": "from {0:.0f} to {1:.0f} s",
    "uphill": "uphill above {0:.0f} degrees",
    "downhill": "downhill above {0:.0f} degrees",
    "slope_left": "across a slope to the left above {0:.0f} degrees",
    "slope_right": "across a slope to the right above {0:.0f} degrees",
    "x_above": "where x > {0:.1f} m in the map",
    "x_below": "where x <= {0:.1f} m in the map",
    "y_above": "where y > {0:.1f} m in the map",
    "y_below": "where y <= {0:.1f} m in the map",
}
"""Regions in words, with their limits."""
_REPEATS = {
    "left_angle": "with every turn of the left wheel (where it stands at the start is that of this run)",
    "right_angle": "with every turn of the right wheel (where it stands at the start is that of this run)",
    "yaw": "with the heading in the map",
}
"""What the inputs of a formula say of where the error comes from."""
_KNOWN_TO = 1.2  # factor to which a noise floor is known: nine of ten drawn logs are within it
# A larger share is rounded to more than 100 %: the error is below the noise floor.
_WHOLE = 1.005
_GOAL = f"{100.0 * INTERVAL_SHARE:.0f} %"
# Smallest unused share of a drive that is reported: in uniform driving it can be a fifth.
_LEAST_SHOWN = 0.25
_SPANS = 3
"""Number of spans in a sentence."""
_UNITS = {"x": "m/s", "y": "m/s", "w": "rad/s"}


def format_step(errors: Errors) -> str:
    """Both errors over 2 s: `1.06 m and 55 degrees`."""
    return format_errors(errors.t_mrmse_m, errors.r_mrmse_rad)


def name_region(region: Region) -> str:
    """A region in words; empty where a stored diagnosis names none of those there are, or not its limits."""
    with suppress(IndexError):
        return REGIONS.get(region.id, "").format(*region.limits)
    return ""


def describe_region(region: Region) -> str:
    """Region, its share of the error and its share of the time."""
    return next(iter(describe_regions([region])), "")


def describe_regions(regions: Sequence[Region]) -> list[str]:
    """Regions with their shares of the time and of each error; one region of several errors is said once."""
    alike = group_by(((region.id, region.limits), region) for region in regions if region.id)
    return [
        f"{name_region(ones[0])} ({format_share(ones[0].time_share, 0)} of the time): {_join_shares(ones)}"
        for ones in alike.values()
    ]


def _join_shares(regions: Sequence[Region]) -> str:
    """Shares of errors: `68 % of the lateral and 65 % of the forward error`."""
    names = [ERROR_WORDS[one.channel].removesuffix(" error") for one in regions]
    shares = [f"{format_share(one.share, 0)} of the {name}" for one, name in zip(regions, names, strict=True)]
    return f"{enumerate_texts(shares)} error"


def describe_moments(moments: Moments) -> str:
    """When half of an error arises: the share of the time, and the spans with the largest shares."""
    return (
        f"half of the remaining squared {moments.quantity} error over {HORIZON_S:g} s arises in "
        f"{format_share(moments.time_share, 0)} of the time; largest parts: "
        f"{enumerate_texts([name_span(span) for span in moments.spans[:_SPANS]])}"
    )


def name_span(span: Stretch) -> str:
    """A span with its share of the error."""
    return f"{span.t_start:.0f} to {span.t_end:.0f} s ({format_share(span.share, 0)})"


def format_excess(ratio: float) -> str:
    """A remaining error in times the noise floor: `at`, `1.6 times`."""
    text = format_digits(ratio)
    return f"{text} times" if float(text) >= _KNOWN_TO else "at"


def format_rises(before: Errors, after: Errors) -> str:
    """`position error rises by 2.0%, heading error by 5.0%`; empty where none rises by more than chance."""
    phrases: list[str] = []
    for key in list_rises(before, after, CHANCE):
        old, new = getattr(before, key), getattr(after, key)
        by = f" by {format_share(new / old - 1.0)}" if old else ""
        phrases.append(f"{ERRORS_OVER_2S[key][0]} error{'' if phrases else ' rises'}{by}")
    return ", ".join(phrases)


def format_fall(old: float, new: float, key: str) -> str | None:
    """`1.73 -> 1.2 m`, with both units where they differ; None if unknown.

    A change by more than chance has digits enough to show it; it is empty where there is none and the texts
    agree.
    """
    if not math.isfinite(old + new):
        return None
    render = format_length if ERRORS_OVER_2S[key][1] == "m" else format_angle
    texts = [render(value) for value in (old, new)]
    if texts[0] == texts[1]:
        if not any(list_rises({key: one}, {key: other}, CHANCE) for one, other in ((old, new), (new, old))):
            return ""
        texts = [render(value, 1) for value in (old, new)]
    (number, unit), (_, other) = (text.split() for text in texts)
    same = unit.rstrip("s") == other.rstrip("s")
    return f"{number if same else texts[0]} -> {texts[1]}"


def describe_end(last: Step, floor: Errors | None) -> tuple[bool, str]:
    """Whether a model is done, and what remains with it, in one clause.

    Args:
        last: the model's errors.
        floor: the noise floor; None if unknown.
    """
    excess = list_excess(RunDiagnosis(ladder=(last,), noise_floor=floor))
    if not excess:
        return False, f"{format_step(last)} remain; the noise floor of this run is not known"
    most = max(excess, key=excess.__getitem__)
    times = format_excess(excess[most])
    if times == "at":
        return True, "Done: at the noise floor"
    of, unit = ERRORS_OVER_2S[most]
    size = (format_length if unit == "m" else format_angle)(getattr(last, most))
    return False, f"{size}{'' if unit == 'm' else f' in {of}'} remain, {times} the noise floor"


def list_remaining_errors(run: RunDiagnosis) -> list[str]:
    """What remains of each error over 2 s beside its noise floor: a clause each, of position first.

    Empty without an effect, and where the floor is unknown.
    """
    if len(run.ladder) <= 1 or run.noise_floor is None:
        return []
    last, floor = run.ladder[-1], run.noise_floor
    position = _compare_to_floor(last.t_mrmse_m, floor.t_mrmse_m, format_length, run.explained_share)
    heading = _compare_to_floor(last.r_mrmse_rad, floor.r_mrmse_rad, format_angle)
    return [*filter(None, (position, heading.replace(",", " in heading,", 1)))]


def _compare_to_floor(
    error: float, least: float, render: Callable[[float], str], explained: float = math.nan
) -> str:
    """A remaining error relative to its noise floor; empty where one of them is unknown.

    Args:
        error: held-out error over 2 s with the model.
        least: the noise floor of that error.
        render: either as text.
        explained: share of the error above the floor that the model removes; NaN if unknown.
    """
    if not (math.isfinite(error) and least > 0.0):
        return ""
    size, floor = render(error), render(least)
    if error < least if math.isnan(explained) else explained > _WHOLE:
        return f"{size}, below the estimated noise floor of {floor}"
    beside = "" if floor == size else f" ({floor})"
    text = f"{size}, {format_excess(error / least)} the noise floor{beside}"
    share = format_share(explained, 0)
    if error < ABOVE_FLOOR * least or not explained > 0.0 or share == format_share(0.0, 0):
        return text
    return f"{text}: the effects remove {share} of the error above it"


def describe_structure(rest: Unexplained) -> str:
    """On what the structure of the residual depends."""
    if rest.kind == "formula":
        names = set(re.findall(r"\w+", rest.formula or ""))
        repeats = [words for name, words in _REPEATS.items() if name in names]
        source = f", {INPUT_WORDS[rest.path]}" if rest.path in INPUT_WORDS else ""
        error = f"mean square {ERROR_WORDS[rest.channel]} over half a second{source}"
        text = f"a formula removes {format_share(rest.share)} of the {error}"
        return f"{text}: it repeats {enumerate_texts(repeats)}" if repeats else text
    if rest.kind == "lasting":
        whose = "the wheels' " if rest.path == "wheels" else "the "
        sizes = {
            f"{whose}{ERROR_WORDS[one]}": f"({size:.2g} {_UNITS[one]})" for one, size in rest.sizes.items()
        }
        if len(sizes) == 1:
            ((error, size),) = sizes.items()
            return f"{error} wanders for seconds at a time {size}; nothing that was tried explains it"
        said = enumerate_texts([" ".join(one) for one in sizes.items()])
        return f"{said} wander for seconds at a time; nothing that was tried explains them"
    return "" if rest.region is None else describe_region(rest.region)


def describe_unexplained(rest: Unexplained) -> str:
    """The structure of the residual that no effect explains, by what describes it."""
    if rest.kind == "region":
        return f"the {ERROR_WORDS[rest.channel]} is not spread evenly: {describe_structure(rest)}"
    return describe_structure(rest) or f"{format_share(rest.share)} of the residual has an unknown structure"


def describe_lead(run: RunDiagnosis) -> str:
    """Where the remaining error is concentrated; empty where it is spread evenly."""
    if run.concentrated is None:
        return ""
    return f"the remaining error is not spread evenly: {describe_region(run.concentrated)}"


def describe_rest(run: RunDiagnosis) -> str:
    """Sentence on the residual, apart from what is unexplained."""
    if run.unexplained is not None:
        return "Apart from this dependence, the residual is disturbance and localization noise"
    error, floor = (
        one.t_mrmse_m if one else math.nan for one in ((run.ladder or (None,))[-1], run.noise_floor)
    )
    if run.concentrated is None and floor > 0.0 and error / floor > ABOVE_FLOOR:
        times = f"{error / floor:.1f} times the noise floor"
        return f"The remaining error is {times}, and no term that was tried predicts it"
    even = "The residual does not depend on any recorded signal: disturbance and localization noise"
    return describe_lead(run) or even


def describe_need(run: RunDiagnosis) -> str:
    """How well the driven time determines the parameters of a diagnosis, and how much more is needed.

    A value is known if no doubt is about it and the half-width of its interval is a twentieth of it, or of a
    typical value if larger.

    Returns:
        A sentence or two; empty where no identified effect has a number that was fitted.
    """
    need = run.need
    if need is None:
        return ""
    # A run that is too short does not show what more driving brings.
    is_brief = any(one.id == BREVITY for one in run.findings)
    known, count = len(need.known), len(need.known) + need.open + (need.others + 1 if need.vague else 0)
    verb = "is" if known == 1 else "are"
    who = need.known[0] if known == count == 1 else f"{known} of {count} parameters"
    scale = " (a small one: of a usual value)" if need.is_typical else ""
    sentences = [f"{who} {verb} known within {_GOAL}{scale}"]
    if known == 0 and count == 1:
        sentences = [f"the one parameter is not known within {_GOAL}"]
    if known == count and math.isfinite(need.since_s):
        sentences[0] += f", after {need.since_s:.0f} s of {need.driven_s:.0f} s"
    few = group_by(
        (number.reason, f"{effect.id}.{name}")
        for effect in run.effects
        for name, number in effect.parameters.items()
        if number.doubt in {FEW_STRETCHES, TOO_SHORT}
    )
    sentences += [f"{', '.join(labels)}: {reason}" for reason, labels in few.items()]
    others = "the others" if known else "it" if count == 1 else "them"
    if need.vague and not is_brief:
        sentences.append(
            f"{format_count(need.minutes, 'more minute')} of such driving for {_GOAL} of all"
            if need.minutes
            else f"more such driving does not narrow {others}"
        )
    if need.idle_share >= _LEAST_SHOWN and not is_brief:
        text = f"the last {format_share(need.idle_share)} of the drive"
        sentences.append(f"{text} narrowed no interval by more than a tenth")
    return "; ".join(sentences)
