"""Errors of a model as text: their size, where and when they arise, what remains, and the ladder."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pipeline.core import (
    enumerate_texts,
    format_digits,
    format_errors,
    format_length,
    format_share,
)
from pipeline.results.reading import ABOVE_FLOOR, BREVITY, INTERVAL_SHARE
from pipeline.run.windows import HORIZON_S

if TYPE_CHECKING:
    from pipeline.results import Errors, Moments, Region, RunDiagnosis, Span, Unexplained

ERROR_WORDS = {"x": "forward error", "y": "lateral error", "w": "yaw error"}
REGIONS = {
    "left": "ideal yaw rate to the left above {0:.2g} rad/s",
    "right": "ideal yaw rate to the right above {0:.2g} rad/s",
    "forward": "ideal speed forward above {0:.2g} m/s",
    "backward": "ideal speed backward above {0:.2g} m/s",
    "turning": "ideal yaw rate above {0:.2g} rad/s",
    "driving": "ideal speed above {0:.2g} m/s",
    "curve": "ideal yaw rate above {0:.2g} rad/s and ideal speed above {1:.2g} m/s",
    "on_the_spot": "turning on the spot",
    "straight": "driving straight",
    "to_the_left": "ideal speed to the left above {0:.2g} m/s",
    "to_the_right": "ideal speed to the right above {0:.2g} m/s",
    "sideways": "ideal speed sideways above {0:.2g} m/s",
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
_KNOWN_TO = 1.2  # factor to which a noise floor is known: nine of ten drawn logs are within it
# A larger share is rounded to more than 100 %: the error is below the noise floor.
_WHOLE = 1.005
_GOAL = f"{100.0 * INTERVAL_SHARE:.0f} %"
# Smallest unused share of a drive that is reported: in uniform driving it can be a fifth.
_LEAST_SHOWN = 0.25
_MATTERS = 2.0
"""Least factor of an input over all others at which it is said."""
_SPANS = 3
"""Number of spans in a sentence."""
_UNITS = {"x": "m/s", "y": "m/s", "w": "rad/s"}
_CHANNELS = {"x": "forward motion", "y": "lateral motion", "w": "yaw rate"}


def format_step(errors: Errors) -> str:
    """Both errors over 2 s: `1.06 m and 55 degrees`."""
    return format_errors(errors.t_mrmse_m, errors.r_mrmse_rad)


def name_region(region: Region) -> str:
    """A region in words; empty for one of an earlier version."""
    return REGIONS.get(region.id, "").format(*region.limits)


def describe_region(region: Region) -> str:
    """Region, its share of the error and its share of the time."""
    share, time = (format_share(one, 0) for one in (region.share, region.time_share))
    return f"{name_region(region)}: {share} of the {ERROR_WORDS[region.channel]} in {time} of the time"


def describe_moments(moments: Moments) -> str:
    """When half of an error arises: the share of the time, and the spans with the largest shares."""
    return (
        f"half of the remaining squared {moments.quantity} error over {HORIZON_S:g} s arises in "
        f"{format_share(moments.time_share, 0)} of the time; largest parts: "
        f"{enumerate_texts([name_span(span) for span in moments.spans[:_SPANS]])}"
    )


def name_span(span: Span) -> str:
    """A span with its share of the error."""
    return f"{span.t_start:.0f} to {span.t_end:.0f} s ({format_share(span.share, 0)})"


def format_excess(ratio: float) -> str:
    """A remaining error in times the noise floor: `at`, `1.6 times`."""
    text = format_digits(ratio)
    return f"{text} times" if float(text) >= _KNOWN_TO else "at"


def format_remaining_error(error_m: float, floor_m: float, explained: float) -> str:
    """Sentence on the remaining error relative to the noise floor; empty where one of them is unknown.

    Args:
        error_m: held-out position error over 2 s with the model [m].
        floor_m: the noise floor of that error [m].
        explained: share of the error above the floor that the model removes; NaN where none was above.
    """
    if not math.isfinite(error_m + floor_m):
        return ""
    text, floor = f"remaining error {format_length(error_m)}", format_length(floor_m)
    if error_m < floor_m if math.isnan(explained) else explained > _WHOLE:
        return f"{text}, below the estimated noise floor of {floor}"
    if error_m < ABOVE_FLOOR * floor_m:
        beside = "" if floor == format_length(error_m) else f" ({floor})"
        return f"{text}, {format_excess(error_m / floor_m)} the noise floor{beside}"
    removed = f": the effects remove {format_share(max(explained, 0.0), 0)} of the error above it"
    return f"{text}, noise floor {floor}{'' if math.isnan(explained) else removed}"


def describe_structure(rest: Unexplained) -> str:
    """On what the structure of the residual depends."""
    if rest.kind == "formula":
        return f"a formula removes {format_share(rest.share, 0)} of the {ERROR_WORDS[rest.channel]}"
    if rest.kind == "learned":
        matters = (
            f"; {rest.of} matters {rest.times:.0f} times as much as any other"
            if rest.times >= _MATTERS
            else ""
        )
        return (
            f"a learned term removes {format_share(rest.share, 0)} of the {rest.quantity} error over 2 s: it "
            f"depends most on {rest.of}{matters}"
        )
    if rest.kind == "lasting":
        said = [f"{size:.2g} {_UNITS[one]} in {ERROR_WORDS[one]}" for one, size in rest.sizes.items()]
        whose = "the wheels deviate" if rest.found_on == "wheels" else "the motion deviates"
        what = "from the model for seconds at a time, and nothing recorded predicts it"
        return f"{whose} {what}: {enumerate_texts(said)}"
    return "" if rest.region is None else describe_region(rest.region)


def describe_unexplained(rest: Unexplained) -> str:
    """The structure of the residual that no effect explains: its share of the residual, and its dependence.

    A formula is compared with the whole residual, all else with that of one channel.
    """
    channel = "" if rest.formula else f" {_CHANNELS[rest.channel]}"
    what = f"{format_share(rest.share)} of the residual{channel}"
    return f"{what} has a structure that the model does not explain: {describe_structure(rest)}"


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

    A value is known if the half-width of its interval is a twentieth of it, or of a typical value if larger.

    Returns:
        A sentence or two; empty where no identified effect has a growth curve.
    """
    need = run.need
    if need is None:
        return ""
    # A run that is too short does not show what more driving brings.
    is_brief = any(one.id == BREVITY for one in run.findings)
    sentences = []
    if need.known:
        who = need.known[-1] if len(need.known) == 1 else f"{len(need.known)} parameters"
        share = f"{_GOAL}{' of a typical value' if need.is_typical else ''}"
        sentences.append(f"{who} known to {share} after {need.since_s:.0f} s of {need.driven_s:.0f} s")
    if need.vague:
        unit = "" if need.unit == "1" else f" {need.unit}"
        text = f"{need.vague} known to {need.half_width:.2g}{unit}"
        text += f" ({need.others} more not known to {_GOAL})" if need.others else ""
        advice = f"{need.minutes} more minute{'s' * (need.minutes > 1)} of such driving for {_GOAL}"
        advice = advice if need.minutes else "more such driving does not narrow the interval"
        sentences.append(text if is_brief else f"{text}; {advice}")
    if need.open:
        sentences.append(f"{need.open} parameter{'s' * (need.open > 1)} undetermined")
    if need.idle_share >= _LEAST_SHOWN and not is_brief:
        text = f"the last {format_share(need.idle_share)} of the drive"
        sentences.append(f"{text} narrowed no interval by more than a tenth")
    return "; ".join(sentences)
