"""What is left when everything with a name is taken: structure, as words and formula; or a disturbance."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.diagnosis.diagnosis import Json, Unexplained
from pipeline.diagnosis.error_regions import CHANNELS
from pipeline.diagnosis.library import join_formula
from pipeline.diagnosis.materiality import LEAST_TURN_RAD, LEAST_WAY_SHARE
from pipeline.diagnosis.unexplained import (
    LEAST_OF_DRIVE,
    collect_terms,
    describe_windows,
    is_explainable,
    measure_asked,
)
from pipeline.identification.parts import count_seconds
from pipeline.identification.persistence import Makeup, split_residuals
from pipeline.runs.windows import HORIZON_S, WINDOW_S

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.diagnosis.diagnose import Explored


_BINS = 8
_PART = 0.3
# What lasts is structure where it is much of the residual, and of the motion that was asked for.
_LEAST_SHARE = 0.5
_LEAST_OF_MOTION = 0.05
_LEAST_REPEAT = 0.28
_FEWEST_WINDOWS = 200
_SURE = 2.0
_WORDS = {
    "wheels": "wheels that stay ahead or behind for seconds, beyond every effect",
    "body": "motion that lasts for seconds and is not a function of anything recorded",
}


def describe(ways: Sequence[Explored]) -> Unexplained | None:
    """Structure that no effect takes; None where there is none.

    A formula where one was found; else the larger, against the motion that was asked for, of what can be
    predicted from what was recorded and of motion that lasts though nothing that was recorded tells of it.
    """
    body = ways[0]
    selection, final = body.search.selection, body.search.final
    terms = collect_terms(final)
    if terms:
        without = selection.drop(final, [term.id for term in terms])
        share = 1.0 - selection.weights.loss(final.held) / selection.weights.loss(without.held)
        signal = without.fit.residual - final.fit.residual
        return _describe_signal(body, signal, share, write_formula(join_formula(terms)))
    found: list[tuple[float, Unexplained]] = []
    for way in ways:
        found += [one for one in (_find_explainable(way), _find_lasting(way)) if one is not None]
    return max(found, key=lambda item: item[0])[1] if found else None


def is_felt(channel: str, size: float, part: float) -> bool:
    """Whether a planner feels a push of this rms over two seconds: least sizes are those of effects.

    Args:
        channel: x, y or w.
        size: [m/s] or [rad/s].
        part: of the motion that was asked for in that channel.
    """
    return size * HORIZON_S >= LEAST_TURN_RAD if channel == "w" else part >= LEAST_WAY_SHARE


def _find_explainable(way: Explored) -> tuple[float, Unexplained] | None:
    """What can be predicted from what was recorded, and its size against the motion asked for."""
    explainable = way.explainable
    if explainable is None or not is_explainable(explainable):
        return None
    selection = way.search.selection
    signal = explainable.predicted * np.where(explainable.shares > 0.0, selection.weights.scale, 0.0)
    left = _describe_signal(way, signal, 0.0, None)
    channel = CHANNELS.index(left.channel)
    left = replace(left, share=float(explainable.shares[channel]))
    size = float(np.sqrt((signal[:, channel] ** 2).mean()))
    part = size / float(measure_asked(selection)[channel])
    # Encoders have next to no noise: what their stamps and steps make of nothing can be predicted, too.
    least = LEAST_OF_DRIVE if way.search.way == "wheels" else 0.0
    return (part, left) if part >= least and is_felt(left.channel, size, part) else None


def _describe_signal(body: Explored, signal: Floats, share: float, formula: str | None) -> Unexplained:
    """What a push of x, y, w at every window depends on most."""
    sizes = np.sqrt(((signal / body.search.selection.weights.scale) ** 2).mean(axis=0))
    channel = int(np.argmax(sizes))
    name, table = _depend(body, signal[:, channel])
    every = tuple(CHANNELS[i] for i in np.argsort(-sizes) if sizes[i] > _PART * sizes[channel])
    unit = _unit(channel)
    low, high = min(table, key=lambda row: row[1]), max(table, key=lambda row: row[1])
    whose = " of the wheels" if body.search.way == "wheels" else ""
    where = (
        f"the {CHANNELS[channel]} error{whose} depends on {name}: {high[1]:+.3g} {unit} near {high[0]:.3g}, "
        f"{low[1]:+.3g} {unit} near {low[0]:.3g}"
    )
    partial: Mapping[str, Json] = {
        "of": name,
        "unit": unit,
        "table": [{"at": round(at, 6), "mean_error": round(mean, 6)} for at, mean in table],
    }
    return Unexplained(share, CHANNELS[channel], every, where, formula, partial, body.search.way)


def _find_lasting(way: Explored) -> tuple[float, Unexplained] | None:
    """Motion that lasts longer than noise and random motion do, and its size against the motion asked for."""
    held = way.search.final.held
    if held.shape[0] < _FEWEST_WINDOWS:
        return None
    shares, repeats = _share_lasting(way)
    sizes = np.sqrt(shares * (held**2).mean(axis=0))
    parts = sizes / measure_asked(way.search.selection)
    # Standard error of a correlation, of windows of half a second that do not overlap (Bartlett 1946).
    error = 1.0 / math.sqrt(count_seconds(way.search.selection.part).sum() / WINDOW_S)
    sure = np.where((shares >= _LEAST_SHARE) & (repeats - _SURE * error >= _LEAST_REPEAT), parts, 0.0)
    channel = int(np.argmax(sure))
    if sure[channel] < _LEAST_OF_MOTION:
        return None
    # Where one channel has a cause that nobody knows, less evidence says that another has its share of it.
    lasts = (shares >= 0.5 * _LEAST_SHARE) & (repeats >= 0.5 * _LEAST_REPEAT) & (parts >= _LEAST_OF_MOTION)
    every = tuple(CHANNELS[i] for i in np.argsort(-parts) if lasts[i])
    told = [f"{sizes[i]:.2g} {_unit(i)} in {CHANNELS[i]}" for i in np.flatnonzero(lasts).tolist()]
    where = f"{_WORDS.get(way.search.way, _WORDS['body'])}: {', '.join(told)}"
    left = Unexplained(float(shares[channel]), CHANNELS[channel], every, where, None, {}, way.search.way)
    return float(parts[channel]), left


def _share_lasting(way: Explored) -> tuple[Floats, Floats]:
    """Of x, y, w: share of the residual's variance that lasts, and correlation over one to two seconds."""
    makeup = _split(way)
    seen = np.isin(np.arange(3), way.search.selection.part.channels)
    shares = np.array([part.lasting_share for part in makeup])
    # Random motion that is forgotten within half a second repeats itself by 0.1 over that time.
    repeats = np.array([part.correlation[1:4].mean() for part in makeup])
    return np.where(seen, shares, 0.0), np.where(seen, repeats, 0.0)


def _split(way: Explored) -> tuple[Makeup, Makeup, Makeup]:
    return split_residuals(way.search.selection.part.comparisons, way.search.final.held)


def _unit(channel: int) -> str:
    return "rad/s" if CHANNELS[channel] == "w" else "m/s"


def write_formula(joined: Mapping[str, object]) -> str:
    """A formula effect as text of a model file."""
    lines = ["[[effect]]", f'id = "{joined["id"]}"']
    lines += [f'{key} = "{joined[key]}"' for key in ("v_x", "v_y", "v_w") if key in joined]
    parameters = joined["parameters"]
    for name, entry in parameters.items() if isinstance(parameters, dict) else ():
        low, high = entry["bounds"]
        neutral = f", neutral = {entry['value']:g}" if entry["fixed"] or not low <= 0.0 <= high else ""
        fixed = ", fixed = true" if entry["fixed"] else ""
        lines.append(
            f'{name} = {{value = {entry["value"]:g}, unit = "{entry["unit"]}", '
            f"bounds = [{low:g}, {high:g}]{neutral}{fixed}}}"
        )
    return "\n".join(lines) + "\n"


def describe_disturbance(body: Explored, unexplained: Unexplained | None) -> dict[str, Json]:
    """What is left of x, y, w, divided by how long it lasts.

    ``rms`` [m/s, m/s, rad/s]; ``lasting``: the part of it that lasts for seconds; ``pose_noise`` [m, m, rad]:
    error of single poses that would make the rest of neighbouring windows as opposite as it is; and
    ``neighbours``: correlation of windows half a second apart, -0.5 for noise of poses.
    """
    held, makeup = body.search.final.held, _split(body)
    rms = np.sqrt((held**2).mean(axis=0))
    text = (
        "what is left is not a function of anything recorded: disturbance and localization noise"
        if unexplained is None
        else "beside the structure, what is left is disturbance and localization noise"
    )
    return {
        "rms": [round(float(value), 6) for value in rms],
        "lasting": [
            round(float(value) * math.sqrt(part.lasting_share), 6)
            for value, part in zip(rms, makeup, strict=True)
        ],
        "pose_noise": [round(part.pose_noise, 6) for part in makeup],
        "neighbours": [round(float(part.correlation[0]), 3) for part in makeup],
        "text": text,
    }


def _depend(body: Explored, signal: Floats) -> tuple[str, list[tuple[float, float]]]:
    """The recorded signal that a push depends on most, and its mean by value."""
    features, names = describe_windows(body.search.selection.part.comparisons)
    best, name, table = -1.0, names[0], [(0.0, 0.0)]
    for column, label in zip(features.T, names, strict=True):
        edges = np.unique(np.quantile(column, np.linspace(0.0, 1.0, _BINS + 1)))
        if edges.size < 3:  # noqa: PLR2004 - it does not vary
            continue
        place = np.clip(np.searchsorted(edges, column, side="right") - 1, 0, edges.size - 2)
        count = np.bincount(place, minlength=edges.size - 1)
        mean = np.bincount(place, signal, minlength=edges.size - 1) / np.maximum(count, 1)
        ratio = float(np.sum(count * (mean - signal.mean()) ** 2)) / max(float(np.sum(signal**2)), 1e-18)
        if ratio > best:
            middle = np.bincount(place, column, minlength=edges.size - 1) / np.maximum(count, 1)
            best, name = ratio, label
            table = [(float(a), float(b)) for a, b, c in zip(middle, mean, count, strict=True) if c]
    return name, table
