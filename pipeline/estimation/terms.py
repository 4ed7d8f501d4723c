"""What describes residuals that no effect takes: formulas of a library, and boosted regression trees."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Bytes, Floats, Ints
from pipeline.core.machine_code import compiled
from pipeline.estimation.proposals import TERM
from pipeline.models.effect import ANY, Parameter
from pipeline.models.formula import FormulaEffect, make_parameter

# Gradient boosting: small regression trees, each fitted to what those before it leave.
#
# Squared loss; features are sorted into bins, and a tree splits the leaf that gains most until it has ten.
#
# Source: Friedman, Annals of Statistics 29 (2001); growth by leaf over histograms: LightGBM, Ke et al. 2017.

_TREES, _RATE = 40, 0.15
"""Trees, and the share of each that is taken: together 99.8 % of what trees of that size can take (1 -
0.85^40)."""
# With 48 the same structure was said of 24 answers of recordings, and trees took a quarter longer.
_BINS = 32
_LEAVES = 10
"""Leaves of a tree."""
_LEAST_ROWS = 25
"""Windows that a leaf must hold."""
_RIDGE = 5.0
"""Windows of zero that every leaf holds beside its own: small leaves say little."""


def bin_features(features: Floats) -> Bytes:
    """Bins of equal counts by feature, shape (n, f)."""
    shares = np.linspace(0.0, 1.0, _BINS + 1)[1:-1]
    edges = np.quantile(features, shares, axis=0).T
    columns = [np.searchsorted(*pair) for pair in zip(edges, features.T, strict=True)]
    return np.column_stack(columns).astype(np.uint8)


def boost(bins: Bytes, target: Floats, unseen: Bytes) -> Floats:
    """What trees predict where they have not been fitted.

    Args:
        bins: of `bin_features`, where they are fitted, shape (n, f).
        target: there, shape (n,).
        unseen: bins where they predict, shape (m, f).
    """
    middle = float(target.mean())
    predicted = np.full(unseen.shape[0], middle)
    rows, asked = np.arange(bins.shape[0]), np.arange(unseen.shape[0])
    aside = np.empty(max(rows.size, asked.size), dtype=np.int64)
    shape = (_LEAVES, bins.shape[1], _BINS)
    _grow_trees(
        np.ascontiguousarray(bins), target - middle, np.ascontiguousarray(unseen), predicted,
        rows, asked, aside, np.zeros(shape), np.zeros(shape),
        np.zeros((2, _LEAVES), dtype=np.int64), np.zeros((2, _LEAVES), dtype=np.int64),
        np.zeros(_LEAVES), np.zeros(_LEAVES, dtype=np.int64),
    )  # fmt: skip
    return predicted


@compiled()
def _copy(source: Floats, target: Floats) -> None:
    for feature in range(source.shape[0]):
        for index in range(_BINS):
            target[feature, index] = source[feature, index]


@compiled()
def _take_off(part: Floats, whole: Floats) -> None:
    for feature in range(part.shape[0]):
        for index in range(_BINS):
            whole[feature, index] -= part[feature, index]


@compiled()
def _tally(bins: Bytes, rest: Floats, rows: Ints, count: Floats, total: Floats) -> None:
    """Count some rows, and sum the residuals in them, by feature and bin."""
    count[:] = 0.0
    total[:] = 0.0
    for row in rows:
        for feature in range(bins.shape[1]):
            index = bins[row, feature]
            count[feature, index] += 1.0
            total[feature, index] += rest[row]


@compiled()
def _find_split(count: Floats, total: Floats) -> tuple[float, int]:
    """What the best split of a leaf gains, and the last bin on its left, numbered through all features."""
    rows, whole = count[0].sum(), total[0].sum()
    best, last = -np.inf, 0
    for feature in range(count.shape[0]):
        below, summed = 0.0, 0.0
        for index in range(_BINS):
            below += count[feature, index]
            summed += total[feature, index]
            if min(below, rows - below) < _LEAST_ROWS:
                continue
            gained = summed**2 / (below + _RIDGE) + (whole - summed) ** 2 / (rows - below + _RIDGE)
            if gained > best:
                best, last = gained, feature * _BINS + index
    return best - whole**2 / (rows + _RIDGE), last


@compiled()
def _part_rows(rows: Ints, bins: Bytes, split: int, aside: Ints) -> int:
    """Put the rows on the left of a split before the others, each side in order; how many they are."""
    feature, last = split // _BINS, split % _BINS
    front, count = 0, 0
    for row in rows:
        if bins[row, feature] <= last:
            rows[front] = row
            front += 1
        else:
            aside[count] = row
            count += 1
    for row in range(count):
        rows[front + row] = aside[row]
    return front


@compiled(
    "void(uint8[:, ::1], float64[::1], uint8[:, ::1], float64[::1], int64[::1], int64[::1], int64[::1], "
    "float64[:, :, ::1], float64[:, :, ::1], int64[:, ::1], int64[:, ::1], float64[::1], int64[::1])"
)
def _grow_trees(
    bins: Bytes,
    rest: Floats,
    unseen: Bytes,
    predicted: Floats,
    rows: Ints,
    asked: Ints,
    aside: Ints,
    count: Floats,
    total: Floats,
    begin: Ints,
    end: Ints,
    gain: Floats,
    split: Ints,
) -> None:
    """Grow trees, each on what those before it leave, and add what they predict.

    Args:
        bins: where they are fitted, shape (n, f).
        rest: what is to be predicted there; what the trees leave of it afterwards, shape (n,).
        unseen: bins where they predict, shape (m, f).
        predicted: there; added to, shape (m,).
        rows: numbers of the rows that are fitted, which are put in the order of leaves.
        asked: of those that are predicted.
        aside: room for as many rows.
        count: room for how many rows there are by leaf, feature and bin.
        total: room for the sum of the residuals in them.
        begin: room for where every leaf begins among ``rows`` and ``asked``, shape (2, leaves).
        end: and where it ends.
        gain: room for what the best split of every leaf gains.
        split: and for that split.
    """
    for _ in range(_TREES):
        _tally(bins, rest, rows, count[0], total[0])
        begin[0, 0], begin[1, 0] = 0, 0
        end[0, 0], end[1, 0] = rows.size, asked.size
        gain[0], split[0] = _find_split(count[0], total[0])
        leaves = 1
        while leaves < _LEAVES:
            leaf, new = int(np.argmax(gain[:leaves])), leaves
            if not gain[leaf] > 0.0:
                break
            for side in range(2):
                order, table = (rows, bins) if side == 0 else (asked, unseen)
                inside = order[begin[side, leaf] : end[side, leaf]]
                middle = begin[side, leaf] + _part_rows(inside, table, split[leaf], aside)
                begin[side, new], end[side, new], end[side, leaf] = middle, end[side, leaf], middle
            # What lies in the bins of one side is what the other leaves: the smaller one is counted.
            on_left, on_right = end[0, leaf] - begin[0, leaf], end[0, new] - begin[0, new]
            fewer, other = (new, leaf) if on_right < on_left else (leaf, new)
            if other == new:
                _copy(count[leaf], count[new])
                _copy(total[leaf], total[new])
            _tally(bins, rest, rows[begin[0, fewer] : end[0, fewer]], count[fewer], total[fewer])
            _take_off(count[fewer], count[other])
            _take_off(total[fewer], total[other])
            gain[leaf], split[leaf] = _find_split(count[leaf], total[leaf])
            gain[new], split[new] = _find_split(count[new], total[new])
            leaves += 1
        for leaf in range(leaves):
            value = _RATE * total[leaf, 0].sum() / (end[0, leaf] - begin[0, leaf] + _RIDGE)
            for row in rows[begin[0, leaf] : end[0, leaf]]:
                rest[row] -= value
            for row in asked[begin[1, leaf] : end[1, leaf]]:
                predicted[row] += value


# Terms for what no effect of the catalogue takes: one-sided and world-frame formulas.
#
# Every term is a formula effect with consistent units, in the syntax that a model file takes. None depends on
# place or time: a pattern over the map of one run does not predict the next run over the same ground.

CHANNELS = ("v_x", "v_y", "v_w")
SUGGESTION = "unexplained"
"""Id of the formula that is suggested for what no effect explains."""
_WIDE = 50.0
"""Bound of a coefficient of a formula, in units of the usual one."""

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
    # Sine and cosine together: which way a map lies must not matter.
    "world": ("(a * sin(yaw) + b * cos(yaw)) * tanh(abs(v0) / u)", "1"),
    "world_still": ("a * sin(yaw) + b * cos(yaw)", "1"),
    "world_two": ("(a * sin(2 * yaw) + b * cos(2 * yaw)) * tanh(abs(v0) / u)", "1"),
    "speed_world": ("v0 * (a * sin(yaw) + b * cos(yaw))", "m/s"),
    "turn_world": ("w0 * (a * sin(yaw) + b * cos(yaw))", "rad/s"),
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
"""Shapes that are searched by trial, with their bounds."""
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
    """All terms; ``sideways`` of a vehicle that drives so, too."""
    shapes = {**_SHAPES, **_SIDEWAYS_SHAPES} if sideways else _SHAPES
    return tuple(
        _make_term(channel, name, text, unit)
        for channel in CHANNELS
        for name, (text, unit) in shapes.items()
        if (channel, name) not in _KNOWN
    )


def _make_term(channel: str, name: str, text: str, unit: str) -> Term:
    ratio = _divide(_UNITS[channel], unit)
    sizes = {"a": "sine part", "b": "cosine part"} if "a * sin" in text else {"k": "size"}
    gains = [Parameter(n, ratio, (-_WIDE, _WIDE), 0.0, about, 0.1, step=1e-3) for n, about in sizes.items()]
    shape = tuple(parameter for key, parameter in _FIXED.items() if f" {key})" in text)
    whole = text if len(gains) > 1 else f"k * {text}"
    return Term(f"{TERM}{channel[-1]}_{name}", channel, whole, (*gains, *shape))


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


def is_term(name: str) -> bool:
    """Whether an id is that of a term."""
    return name.startswith(TERM)


def join_formula(terms: Sequence[FormulaEffect]) -> FormulaEffect:
    """Several terms as one formula, as a model file has it."""
    texts: dict[str, list[str]] = {}
    parameters, values, fixed = list[Parameter](), dict[str, float](), set[str]()
    for number, term in enumerate(terms, start=1):
        ((channel, text),) = term.formulas.items()
        for parameter in term.parameters:
            name, value = f"{parameter.name}_{number}", term.values[parameter.name]
            text = _rename(text, parameter.name, name)
            is_fixed = parameter.name in term.fixed
            neutral = value if is_fixed else parameter.neutral
            parameters.append(make_parameter(name, parameter.unit, parameter.bounds, neutral=neutral))
            values[name] = value
            fixed |= {name} if is_fixed else set()
        texts.setdefault(channel, []).append(text)
    formulas = {channel: " + ".join(parts) for channel, parts in texts.items()}
    return FormulaEffect(SUGGESTION, formulas, tuple(parameters), fixed=fixed).change(**values)


def _rename(text: str, old: str, new: str) -> str:
    import re  # noqa: PLC0415 - only for what is unexplained

    return re.sub(rf"\b{old}\b", new, text)
