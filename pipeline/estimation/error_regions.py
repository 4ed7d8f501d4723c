"""Regions with excess error of a model, intervals by driving time, and whether the log is long enough."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import finite_or_none, format_angle, format_digits, format_length, format_share
from pipeline.core.arrays import Flags, Floats, Ints
from pipeline.estimation.intervals import narrow_part
from pipeline.estimation.model_fit import Fitted
from pipeline.estimation.window_residuals import WindowResiduals
from pipeline.models.catalogue import find_effect
from pipeline.run.windows import NODE_S

if TYPE_CHECKING:
    from pipeline.estimation.diagnosis import Json, Named


CHANNELS = ("x", "y", "w")
ERROR_WORDS = {"x": "forward error", "y": "lateral error", "w": "yaw error"}
_LEAST_SHARE = 0.2
"""Smallest share of a channel's squared error for reporting a region: a fifth of the total."""
_EXCESS = 1.3
"""Factor over the expected error above which a region has excess error: 30 % more is not specific to it."""
_SHOWN = 3
"""Half of the number of regions that are picked: six, for three channels."""
_STANDING = 0.03
"""Largest ideal speed or yaw rate of a run [m/s, rad/s] up to which it counts as not driven or not turned:
shares are then taken of this value."""
_CHANGE = 0.05
"""Smallest change of a command, as a share of its largest value: the jitter of joysticks is smaller."""
_LARGE_SHARE = 0.5
"""Share of a channel's squared error in the main region: as much as in all other windows."""
_NARROW_SHARE, _NARROW_TIME = 0.75, 1.0 / 3.0
"""Share of the error, and at most of the time, from which on it is an event of its own."""
_CONCENTRATED = 1.5
"""Factor over its share of the time: a region that covers most of the run has most of any error."""
_BEYOND = 1.5
"""Factor over the error expected from the commands, for a time or a place: without an effect of either it
was at most 1.47 on nine simulated runs of 150 s, with a patch of other ground 1.6 to 2.8."""
_RIDGE = 1e-3
"""Ridge penalty as a share of each command's largest square, for poorly determined coefficients."""
_SLOPES_RAD = (math.radians(3.0), math.radians(6.0), math.radians(10.0))
"""Angles above which a region is on a slope: floors are level within a degree."""
_SHAPE_LAGS = (0, 2, 4)
"""Lags, in quarters of a second, at which products of two commands are formed."""


@dataclass(frozen=True)
class Region:
    """A region with its share of the error.

    Attributes:
        channel: x, y or w.
        kind: `command`, `phase`, `slope`, `time` or `place`.
        text: description of the region.
        share: of the channel's squared error.
        time_share: of the windows.
        rms: error in the region [m/s or rad/s].
        expected: expected share of the squared error: the share of the windows, or for a time or a place the
            prediction from the same commands elsewhere.
    """

    channel: str
    kind: str
    text: str
    share: float
    time_share: float
    rms: float
    expected: float

    @property
    def is_excessive(self) -> bool:
        """Whether its share of the error exceeds the expected share."""
        least = _BEYOND if self.kind in _CIRCUMSTANCES else _EXCESS
        return self.share > max(least * self.expected, _EXCESS * self.time_share)

    @property
    def is_narrow(self) -> bool:
        """Whether it has nearly all of the error in little of the time."""
        return self.share >= _NARROW_SHARE and self.time_share <= _NARROW_TIME

    @property
    def sentence(self) -> str:
        """Sentence: region, its share of the error and its share of the time."""
        error = ERROR_WORDS[self.channel]
        share, time = (format_share(one, 0) for one in (self.share, self.time_share))
        return f"{self.text}: {share} of the {error} in {time} of the time"


def map_errors(part: WindowResiduals, residual: Floats, places: Floats) -> list[Region]:
    """Every region of every kind with its share of each channel's error.

    Args:
        part: whose windows they are.
        residual: of a model, shape (n, 3).
        places: x, y [m] in the map at every window, shape (n, 2).
    """
    regions = []
    candidates = [region for region in _list_regions(part, places) if region[2].any()]
    for channel, name in enumerate(CHANNELS):
        limit = math.sqrt(36.0 * float(np.median(residual[:, channel] ** 2)) + 1.0)
        error = np.clip(residual[:, channel], -limit, limit)
        square = error**2
        total = float(square.sum())
        if total <= 0.0:
            continue
        response = _list_responses(part.find_ideal(), channel)
        for kind, text, rows in candidates:
            share, time_share = float(square[rows].sum()) / total, float(rows.mean())
            expected = time_share
            if kind in _CIRCUMSTANCES and share > _EXCESS * time_share and not rows.all():
                inside = _expect_square(response, error, rows)
                expected = inside / (inside + float(square[~rows].sum()))
            rms = float(np.sqrt(square[rows].mean()))
            regions.append(Region(name, kind, text, share, time_share, rms, expected))
    return regions


_CIRCUMSTANCES = ("time", "place")
"""Kinds of regions whose commands differ from those elsewhere, which could explain an error there, too."""


def _list_responses(lags: Floats, channel: int) -> Floats:
    """Regressors of a channel's error: commands of the last 2 s, and physically motivated products.

    Args:
        lags: see `WindowResiduals.find_ideal`.
        channel: 0, 1, 2 for x, y, w: products as in the physics of speed, skid and yaw rate.

    Returns:
        Columns, the first of ones, none larger than one; shape (n, columns).
    """
    scaled = lags / np.maximum(np.abs(lags).max(axis=(0, 1)), _STANDING)
    speed, turn = scaled[:, _SHAPE_LAGS, 0], scaled[:, _SHAPE_LAGS, 1]
    own, other = (speed, turn) if channel == 0 else (turn, speed)
    shapes = [speed * turn] if channel == 1 else [own * np.abs(own), own * np.abs(other), own * other**2]
    return np.column_stack([np.ones(lags.shape[0]), scaled.reshape(lags.shape[0], -1), *shapes])


def _expect_square(response: Floats, error: Floats, rows: Flags) -> float:
    """Expected squared error in some windows, predicted from their commands by a fit to all other windows."""
    known, count = response[~rows], response.shape[1]
    penalty = _RIDGE * error.size * np.diag(np.arange(count) > 0).astype(np.float64)
    weights = np.linalg.solve(known.T @ known + penalty, known.T @ error[~rows])
    spread = float(((error[~rows] - known @ weights) ** 2).mean())
    return float(((response[rows] @ weights) ** 2 + spread).sum())


def pick_regions(regions: list[Region], residual: Floats, noise: Floats) -> list[Region]:
    """The few regions with most of the excess error.

    Args:
        regions: all regions.
        residual: of the model, shape (n, 3).
        noise: spread that no model can explain, by channel, shape (3,); at this level nothing is in excess.
    """
    excess = np.sqrt((residual**2).mean(axis=0)) > 1.2 * noise
    picked = []
    for channel, name in enumerate(CHANNELS):
        if not excess[channel]:
            continue
        distinct = [
            region
            for region in regions
            if region.channel == name and region.share >= _LEAST_SHARE and region.is_excessive
        ]
        distinct.sort(key=lambda region: region.time_share - region.share)
        kinds: set[str] = set()
        for region in distinct:
            if region.kind not in kinds:
                kinds.add(region.kind)
                picked.append(region)
    picked.sort(key=lambda region: region.time_share - region.share)
    return picked[: 2 * _SHOWN]


def find_main_region(part: WindowResiduals, residual: Floats, places: Floats) -> Region | None:
    """The region with half of a channel's squared error in much less of the time; None without one.

    Args:
        part: whose windows they are.
        residual: of a model, shape (n, 3).
        places: x, y [m] in the map at every window, shape (n, 2).
    """
    picked = pick_regions(map_errors(part, residual, places), residual, part.noise)
    return next(
        (region for region in picked if region.share >= max(_LARGE_SHARE, _CONCENTRATED * region.time_share)),
        None,
    )


def _list_regions(part: WindowResiduals, places: Floats) -> list[tuple[str, str, Flags]]:
    lags = part.find_ideal()
    speed, turn = lags[:, 0, 0], lags[:, 0, 1]
    regions = _cut_commands(speed, turn)
    for aside in lags[:, 0, 2:].T:
        regions += _cut_sideways(aside)
    changed = np.abs(lags - lags[:, :1, :]).max(axis=1) > _CHANGE * np.abs(lags).max(axis=(0, 1))
    transitory = changed.any(axis=1)
    regions.append(("phase", f"within {NODE_S * (lags.shape[1] - 1):g} s of a change of command", transitory))
    regions.append(("phase", "in steady driving", ~transitory & part.live))
    middle = part.times.mean(axis=1)
    edges = np.linspace(float(middle.min()), float(middle.max()) + 1e-6, 6)
    for low, high in pairwise(edges.tolist()):
        regions.append(("time", f"from {low:.0f} to {high:.0f} s", (middle >= low) & (middle < high)))
    regions += _cut_slopes(part)
    for axis, name in ((0, "x"), (1, "y")):
        cut = float(np.median(places[:, axis]))
        regions.append(("place", f"where {name} > {cut:.1f} m in the map", places[:, axis] > cut))
        regions.append(("place", f"where {name} <= {cut:.1f} m in the map", places[:, axis] <= cut))
    return regions


def _cut_slopes(part: WindowResiduals) -> list[tuple[str, str, Flags]]:
    """Regions by the slope that the vehicle stands on."""
    roll, pitch = part.find_attitude().T
    slopes = (
        ("uphill", -pitch), ("downhill", pitch), ("across a slope to the left", -roll),
        ("across a slope to the right", roll),
    )  # fmt: skip
    regions: list[tuple[str, str, Flags]] = []
    for name, angle in slopes:
        regions += [
            ("slope", f"{name} above {math.degrees(least):.0f} degrees", angle > least)
            for least in _SLOPES_RAD
        ]
    return regions


def _cut_commands(speed: Floats, turn: Floats) -> list[tuple[str, str, Flags]]:
    """Regions of the command space by sign and magnitude of yaw rate, of speed, and of both together."""
    fast, sharp = float(np.abs(speed).max()), float(np.abs(turn).max())
    regions: list[tuple[str, str, Flags]] = []
    signs = ((1.0, "left", "forward"), (-1.0, "right", "backward"))
    for sign, side, direction in signs:
        for share in (0.25, 0.5):
            if sharp > _STANDING:
                text = f"ideal yaw rate to the {side} above {share * sharp:.2g} rad/s"
                regions.append(("command", text, sign * turn > share * sharp))
            if fast > _STANDING:
                text = f"ideal speed {direction} above {share * fast:.2g} m/s"
                regions.append(("command", text, sign * speed > share * fast))
    for share in (0.25, 0.5):
        text = f"ideal yaw rate above {share * sharp:.2g} rad/s"
        regions.append(("command", text, np.abs(turn) > share * max(sharp, _STANDING)))
        text = f"ideal speed above {share * fast:.2g} m/s"
        regions.append(("command", text, np.abs(speed) > share * max(fast, _STANDING)))
        curve = (np.abs(turn) > share * max(sharp, _STANDING)) & (
            np.abs(speed) > share * max(fast, _STANDING)
        )
        text = f"ideal yaw rate above {share * sharp:.2g} rad/s and ideal speed above {share * fast:.2g} m/s"
        regions.append(("command", text, curve))
    slow = (np.abs(speed) < 0.15 * max(fast, _STANDING)) & (np.abs(turn) > 0.25 * max(sharp, _STANDING))
    regions.append(("command", "turning on the spot", slow))
    straight = (np.abs(turn) < 0.1 * max(sharp, _STANDING)) & (np.abs(speed) > 0.25 * max(fast, _STANDING))
    regions.append(("command", "driving straight", straight))
    return regions


def _cut_sideways(aside: Floats) -> list[tuple[str, str, Flags]]:
    """Regions of the command space by sign and magnitude of sideways motion."""
    fast = float(np.abs(aside).max())
    if fast <= _STANDING:
        return []
    regions: list[tuple[str, str, Flags]] = []
    for share in (0.25, 0.5):
        least = share * fast
        regions.append(("command", f"ideal speed to the left above {least:.2g} m/s", aside > least))
        regions.append(("command", f"ideal speed to the right above {least:.2g} m/s", -aside > least))
        regions.append(("command", f"ideal speed sideways above {least:.2g} m/s", np.abs(aside) > least))
    return regions


_KNOWN_TO = 1.2  # factor to which a noise floor is known: nine of ten drawn logs are within it
ABOVE_FLOOR = 1.5
"""Factor over the (estimated) noise floor above which an error over 2 s is not noise."""
# A larger share is rounded to more than 100 %: the error is below the noise floor.
_WHOLE = 1.005
# A smaller relative reduction of an interval is no reduction.
_NO_NARROWER = 0.1
# Longest suggested driving, as a multiple of the time driven.
_TOO_LONG = 10.0
INTERVAL_SHARE = 0.05
"""Target half-width of a 95 % interval as a share of the parameter's size."""
_POINTS = 60
"""Maximum number of points of a curve in a figure."""
_GOAL = f"{100.0 * INTERVAL_SHARE:.0f} %"
# Smallest unused share of a drive that is reported: in uniform driving it can be a fifth.
_LEAST_SHOWN = 0.25
BREVITY = "little_driving"
"""Finding of a run with less driving than effects can be trusted on."""
_DIGITS = 4
"""Significant digits of a curve in JSON: a figure shows three."""


@dataclass(frozen=True)
class Growth:
    """Evidence and interval widths of an effect by driving time.

    Attributes:
        evidence: t of the effect; None where it was not searched for.
        widths: half-width of the 95 % interval by parameter.
    """

    evidence: Curve | None
    widths: Mapping[str, Curve]

    def to_json(self) -> dict[str, Json]:
        """Curves of at most sixty points each."""
        return {
            "evidence": None if self.evidence is None else _list_points(self.evidence, "t"),
            "parameters": {name: _list_points(one, "half_width") for name, one in self.widths.items()},
        }


def _list_points(curve: Curve, name: str) -> dict[str, Json]:
    places = pick_points(curve.seconds.size)
    return {
        "seconds": [round(float(one), 1) for one in curve.seconds[places]],
        name: [finite_or_none(one, _DIGITS) for one in curve.values[places]],
    }


def format_enough(effects: Sequence[Named], findings: Sequence[Mapping[str, object]] = ()) -> str:
    """How well the driven time determines the parameters of a diagnosis, and how much more is needed.

    A value is known if the half-width of its interval is a twentieth of it, or of a typical value if larger,
    and open if the interval is as wide as that value itself.

    Args:
        effects: identified effects.
        findings: findings of the run; one that is too short does not show what more driving brings.

    Returns:
        A sentence or two; empty where no identified effect has a growth curve.
    """
    known, vague, needed, driven, small, open_ones = [], [], 0.0, 0.0, False, 0
    for effect in effects:
        for name, curve in () if effect.growth is None else effect.growth.widths.items():
            value = effect.parameters.get(name)
            if value is None:
                continue
            label, half = f"{effect.id}.{name}", float(curve.values[-1])
            goal = find_goal(effect.id, name, value.value)
            if value.is_undetermined or not half < goal / INTERVAL_SHARE:
                open_ones += 1
                continue
            since = last_until(curve, goal)
            driven = max(driven, float(curve.seconds[-1]))
            needed = max(needed, last_until(curve, half * (1.0 + _NO_NARROWER)))
            if math.isfinite(since):
                known.append((since, label))
                small |= half > INTERVAL_SHARE * abs(value.value)
            else:
                vague.append((half / goal, f"{label} known to {half:.2g}{value.suffix}", curve, goal))
    is_brief = any(one.get("id") == BREVITY for one in findings)
    sentences = []
    if known:
        since, label = max(known)
        who = label if len(known) == 1 else f"{len(known)} parameters"
        share = f"{_GOAL}{' of a typical value' if small else ''}"
        sentences.append(f"{who} known to {share} after {since:.0f} s of {driven:.0f} s")
    if vague:
        _, text, curve, goal = max(vague, key=lambda one: one[0])
        text += f" ({len(vague) - 1} more not known to {_GOAL})" if len(vague) > 1 else ""
        seconds = extrapolate(curve, goal)
        minutes = math.ceil((seconds - driven) / 60.0) if seconds < _TOO_LONG * driven else 0
        advice = f"{minutes} more minute{'s' * (minutes > 1)} of such driving for {_GOAL}"
        advice = advice if minutes else "more such driving does not narrow the interval"
        sentences.append(text if is_brief else f"{text}; {advice}")
    if open_ones:
        sentences.append(f"{open_ones} parameter{'s' * (open_ones > 1)} undetermined")
    idle = 1.0 - needed / driven if driven else 0.0
    if idle >= _LEAST_SHOWN and not is_brief:
        text = f"the last {format_share(idle)} of the drive"
        sentences.append(f"{text} narrowed no interval by more than a tenth")
    return "; ".join(sentences)


def format_remaining_error(error_m: object, floor_m: object, explained: float | None) -> str:
    """Sentence on the remaining error relative to the noise floor; empty where one of them is unknown.

    Args:
        error_m: held-out position error over 2 s with the model [m].
        floor_m: the noise floor of that error [m].
        explained: share of the error above the floor that the model removes; unknown where none was above.
    """
    if not isinstance(error_m, int | float) or not isinstance(floor_m, int | float):
        return ""
    text, floor = f"remaining error {format_length(error_m)}", format_length(floor_m)
    share = math.nan if explained is None else explained
    if error_m < floor_m if math.isnan(share) else share > _WHOLE:
        return f"{text}, below the estimated noise floor of {floor}"
    if error_m < ABOVE_FLOOR * floor_m:
        beside = "" if floor == format_length(error_m) else f" ({floor})"
        return f"{text}, {format_excess(error_m / floor_m)} the noise floor{beside}"
    removed = f": the effects remove {format_share(max(share, 0.0), 0)} of the error above it"
    return f"{text}, noise floor {floor}{'' if math.isnan(share) else removed}"


def format_excess(ratio: float) -> str:
    """A remaining error in times the noise floor: `at`, `1.6 times`."""
    text = format_digits(ratio)
    return f"{text} times" if float(text) >= _KNOWN_TO else "at"


def format_errors(errors: Mapping[str, object]) -> str:
    """Both 2 s errors as text: `1.06 m and 55 degrees`.

    Args:
        errors: ``t_mrmse_m`` [m] and ``r_mrmse_rad`` [rad]; one that is not known is left out.
    """
    metres, angle = errors.get("t_mrmse_m"), errors.get("r_mrmse_rad")
    sizes = [format_length(metres)] if isinstance(metres, int | float) else []
    sizes += [format_angle(angle)] if isinstance(angle, int | float) else []
    return " and ".join(sizes) or "by an unknown amount"


@dataclass(frozen=True)
class Curve:
    """Values by the seconds of driving, both of shape (k,)."""

    seconds: Floats
    values: Floats


def pick_points(count: int) -> Ints:
    """Indices of the points of a curve that are reported: at most sixty, including the first and the last."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, _POINTS)).round().astype(np.int64))


def narrow_intervals(fitted: Fitted) -> dict[str, Curve]:
    """Half-widths of the 95 % intervals of all smooth parameters of effects, by label ``effect.name``.

    See `narrow_part`; parameters of single runs are excluded.
    """
    curves: dict[str, Curve] = {}
    for fit in fitted.fits:
        if not fit.free:
            continue
        seconds, halves = narrow_part(fit)
        curves |= {
            number.label: Curve(seconds, halves[:, index])
            for index, number in enumerate(fit.free)
            if number.effect and number.run is None and number.is_smooth
        }
    return curves


def find_goal(effect: str, name: str, value: float) -> float:
    """Target half-width for a parameter: a share of its size, or of its typical size if that is larger."""
    parameter = find_effect(effect)().parameter(name)
    neutral = parameter.neutral if math.isfinite(parameter.neutral) else 0.0
    return INTERVAL_SHARE * max(abs(value), abs(parameter.typical - neutral))


def last_until(curve: Curve, goal: float) -> float:
    """Seconds after which a curve stays at or below a goal; infinite if it ends above it."""
    above = np.flatnonzero(~(curve.values <= goal))
    if above.size == 0:
        return float(curve.seconds[0])
    if above[-1] == curve.seconds.size - 1:
        return math.inf
    return float(curve.seconds[above[-1] + 1])


def extrapolate(curve: Curve, goal: float) -> float:
    """Seconds of such driving after which a width would reach a goal; infinite if it never would.

    The square of a width is the sum of a part that falls with the driving time, and of a constant: more
    driving does not reduce the clock errors. Both are fitted to the later half of the curve.
    """
    seconds, squares = curve.seconds, curve.values**2
    later = np.isfinite(squares) & (seconds >= 0.5 * seconds[-1])
    if later.sum() < 2:  # noqa: PLR2004 - two numbers are read from it
        return float(seconds[-1] * squares[-1] / goal**2)
    slope, stays = np.polyfit(1.0 / seconds[later], squares[later], 1)
    # The extrapolation begins at the last width, even if the fit deviates from it.
    falls = float(np.clip(slope / seconds[-1], 0.0, squares[-1]))
    stays = float(squares[-1]) - falls
    return math.inf if stays >= goal**2 else float(seconds[-1]) * falls / (goal**2 - stays)
