"""Learned term: linear in plain inputs, fitted to residuals of the named effects, zero beyond its data."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from pipeline.core import Floats, format_share
from pipeline.models.effect import AddedEffect, Effect, Place
from pipeline.models.filters import lag_signal
from pipeline.models.model import Model
from pipeline.run import MotionError, Resets, Rolling, RunContext, Velocity
from pipeline.sources import Vehicle

LEARNED = "learned_term"
"""Id of the learned term; no effect of the catalogue has it."""
_CHANGES_S = (0.2, 0.6, 2.0)
"""Time constants of the velocity changes that are inputs [s]: those of wheels, bodies and a prediction."""
_FADES_S = (0.3, 1.0, 4.0)
"""Time constants [s] with which the error of the physics at the start of a prediction decays."""
_CHANNELS = ("v_x", "v_y", "v_w")
_TURNED = tuple(name for name in _CHANNELS if name != "v_y")

Source = Callable[[Velocity, RunContext], Floats]


def _change(total: Velocity, context: RunContext, channel: str, tau_s: float) -> Floats:
    """Difference between a velocity and its first-order lag."""
    signal = getattr(total, channel[2:])
    spans = context.spans
    unknown = Resets(spans.number, spans.first, spans.at, np.full(spans.first.shape, np.nan))
    changed: Floats = signal - lag_signal(signal, tau_s, context.step_s, unknown, unknown.start)
    return changed


def _miss(total: Velocity, context: RunContext, channel: str, tau_s: float) -> Floats:
    """Measured less modelled velocity at the start of a prediction, decaying exponentially."""
    vehicle, body = context.vehicle, context.body
    signal = getattr(total, channel[2:])
    if channel == "v_y":
        signal = signal + vehicle.kinematics.lever_m(vehicle) * total.w
    missed = np.nan_to_num(body.start[:, _CHANNELS.index(channel)] - signal[body.at])[body.number]
    age = context.times - context.times[body.at[body.number]]
    faded: Floats = missed * np.exp(-age / tau_s)
    return faded


@dataclass(frozen=True)
class Kind:
    """An input that a learned term may have.

    Attributes:
        unit: its unit.
        read: its values on the grid.
        formula: its expression in the exported function; `0.0` if it vanishes for a vehicle starting at rest.
        state: name, channel and time constant [s] of a lag that the expression needs.
    """

    unit: str
    read: Source
    formula: str
    state: tuple[str, str, float] | None = None


def _list_kinds() -> dict[str, Kind]:
    kinds = {
        "v_x": Kind("m/s", lambda total, _: total.x, "v_x"),
        "v_y": Kind("m/s", lambda total, _: total.y, "v_y"),
        "v_w": Kind("rad/s", lambda total, _: total.w, "v_w"),
        "|v_x|": Kind("m/s", lambda total, _: np.abs(total.x), "abs(v_x)"),
        "|v_w|": Kind("rad/s", lambda total, _: np.abs(total.w), "abs(v_w)"),
        "v_x |v_x|": Kind("m^2/s^2", lambda total, _: total.x * np.abs(total.x), "v_x * abs(v_x)"),
        "v_w |v_w|": Kind("rad^2/s^2", lambda total, _: total.w * np.abs(total.w), "v_w * abs(v_w)"),
        "v_x v_w": Kind("m rad/s^2", lambda total, _: total.x * total.w, "v_x * v_w"),
        "|v_x| v_w": Kind("m rad/s^2", lambda total, _: np.abs(total.x) * total.w, "abs(v_x) * v_w"),
        "v_x |v_w|": Kind("m rad/s^2", lambda total, _: total.x * np.abs(total.w), "v_x * abs(v_w)"),
        "roll": Kind("rad", lambda _, context: context.attitude[:, 0], "roll"),
        "pitch": Kind("rad", lambda _, context: context.attitude[:, 1], "pitch"),
    }
    units = {"v_x": "m/s", "v_y": "m/s", "v_w": "rad/s"}
    for channel in _TURNED:
        for number, tau_s in enumerate(_CHANGES_S):
            state = (f"learned_{channel}_{number}", channel, tau_s)
            kinds[f"change of {channel} in {tau_s:g} s"] = Kind(
                units[channel],
                partial(_change, channel=channel, tau_s=tau_s),
                f"({channel} - {state[0]})",
                state,
            )
    for channel in _CHANNELS:
        for tau_s in _FADES_S:
            kinds[f"missed {channel}, forgotten in {tau_s:g} s"] = Kind(
                units[channel], partial(_miss, channel=channel, tau_s=tau_s), "0.0"
            )
    return kinds


_KINDS = _list_kinds()
INPUTS: Mapping[str, str] = {name: kind.unit for name, kind in _KINDS.items()}
"""Possible inputs of a learned term, and their units."""


def find_kind(name: str) -> Kind:
    """The input of that name."""
    return _KINDS[name]


def read_inputs(total: Velocity, context: RunContext, names: Sequence[str]) -> Floats:
    """Inputs of a learned term on the grid of a run, shape (n, p)."""
    return np.column_stack([_KINDS[name].read(total, context) for name in names])


@dataclass(frozen=True)
class LearnedInput:
    """One input of a learned term.

    Attributes:
        name: one of `INPUTS`.
        scale: its root mean square in the training data, in its unit.
        low, high: its range in the training data; outside, the term fades within one scale.
        adds: contribution of one scale of it to v_x, v_y [m/s] and v_w [rad/s].
    """

    name: str
    scale: float
    low: float
    high: float
    adds: tuple[float, float, float]


@dataclass(frozen=True)
class Bands:
    """95 % error bands of predictions over 2 s for similar runs.

    Errors are relative to the distance predicted until then plus `LEAST_WAY_M`.

    Attributes:
        position: largest error of position over the distance [m/m].
        heading: largest error of heading over the distance [rad/m].
        of: description of the data from which they were computed.
    """

    position: float
    heading: float
    of: str


LEAST_WAY_M = 0.1
"""Distance [m] added before an error is divided by the distance: errors remain at rest. With 2 cm
bands are a third wider, with 30 cm they cover fewer errors on held-out ground (five grounds of a Warthog)."""


class ResidualTerm(AddedEffect):
    """Learned term: models the residual velocity of the identified effects from inputs.

        v += share * sum over inputs of adds * input / scale
        share = exp(-1/2 * sum over inputs of (distance to [low, high] / scale)^2)

    It identifies no cause. Where an input leaves its training range, the term fades and the physics remains.

    Args:
        inputs: of the term; empty before it is trained.
        bands: error bands of the model with it; None where they were not measured.
    """

    id = LEARNED
    place = Place.CENTRE
    rank = 1000
    parameters = ()

    def __init__(
        self, inputs: Iterable[LearnedInput] = (), bands: Bands | None = None, *, fixed: Iterable[str] = ()
    ) -> None:
        super().__init__(fixed=fixed)
        self.inputs = tuple(inputs)
        self.bands = bands

    @property
    def key(self) -> tuple[object, ...]:
        """Id and inputs as a hashable key."""
        return (self.id, self.inputs)

    @property
    def is_neutral(self) -> bool:
        """Whether it adds nothing."""
        return not any(any(one.adds) for one in self.inputs)

    def _copy(self, values: Mapping[str, float], fixed: Iterable[str]) -> ResidualTerm:
        del values, fixed  # it has no parameter that a fit changes
        return self

    def add_to(self, total: Velocity, rolling: Rolling, velocity: Velocity, context: RunContext) -> Velocity:
        """Add the learned residual velocity."""
        del rolling, velocity
        if not self.inputs:
            return total
        known = read_inputs(total, context, [one.name for one in self.inputs])
        return total.add(*self.predict(known).T)

    def predict(self, known: Floats) -> Floats:
        """Contribution of the inputs to x, y [m/s] and w [rad/s], shape (n, 3).

        Args:
            known: the inputs, shape (n, p).
        """
        scale, low, high = (
            np.array([getattr(one, name) for one in self.inputs]) for name in ("scale", "low", "high")
        )
        beyond = np.maximum(np.maximum(low - known, known - high), 0.0) / scale
        share = np.exp(-0.5 * (beyond**2).sum(axis=1))
        added: Floats = share[:, None] * ((known / scale) @ np.array([one.adds for one in self.inputs]))
        return added

    def describe_motion(self, vehicle: Vehicle, beside: Iterable[Effect] = ()) -> str:
        """The number of inputs; it identifies no cause."""
        del vehicle, beside
        return f"Learned term: {len(self.inputs)} inputs; it names no cause"

    def describe_clause(self, vehicle: Vehicle, beside: Iterable[Effect] = ()) -> str:
        """Its clause in a sentence."""
        del vehicle, beside
        return "deviates as a learned term says, which names no cause"


class InputProbe(AddedEffect):
    """Adds nothing, and records the inputs that a learned term would have.

    Attributes:
        known: the inputs of `INPUTS` on the grid of the last run, shape (n, p).
    """

    id = LEARNED
    place = Place.CENTRE
    rank = ResidualTerm.rank
    parameters = ()

    def __init__(self) -> None:
        super().__init__()
        self.known: Floats = np.zeros((0, len(INPUTS)))

    @property
    def key(self) -> tuple[object, ...]:
        """A hashable key that is unique to this object: no result of another one is reused."""
        return (self.id, id(self))

    def add_to(self, total: Velocity, rolling: Rolling, velocity: Velocity, context: RunContext) -> Velocity:
        """Add nothing."""
        del rolling, velocity
        self.known = read_inputs(total, context, tuple(INPUTS))
        return total


def find_learned(effects: Iterable[Effect]) -> ResidualTerm | None:
    """The learned term among the effects of a model; None without one."""
    return next((effect for effect in effects if isinstance(effect, ResidualTerm)), None)


def drop_learned(model: Model) -> Model:
    """The model without its learned term."""
    return model.keep(name for name in model.ids if name != LEARNED)


_TABLE_KEYS = {"input", "bands"}
_INPUT_KEYS = {"name", "unit", "scale", "low", "high", "adds"}
_BAND_KEYS = {"position", "heading", "of"}
_MOST_INPUTS = len(INPUTS)
_WHERE = "[learned]"


def parse_learned(table: object, where: str) -> ResidualTerm:
    """A learned term from its table in a model file.

    Args:
        table: the value of `learned`.
        where: file and line, for error messages.

    Raises:
        MotionError: ``learned_invalid``: the table is not valid.
    """
    rows = table.get("input", []) if isinstance(table, Mapping) else None
    if not isinstance(table, Mapping) or not isinstance(rows, list) or set(table) - _TABLE_KEYS:
        raise _refuse(f"{_WHERE} holds [[learned.input]] tables and bands, and nothing else", where)
    names = [row.get("name") if isinstance(row, Mapping) else None for row in rows]
    if len(rows) > _MOST_INPUTS or len(set(map(str, names))) < len(rows):
        raise _refuse(f"{_WHERE} has at most {_MOST_INPUTS} inputs, each once", where)
    return ResidualTerm([_parse_input(row, where) for row in rows], _parse_bands(table.get("bands"), where))


def _parse_input(row: object, where: str) -> LearnedInput:
    if not isinstance(row, Mapping) or set(row) - _INPUT_KEYS or row.get("name") not in list(INPUTS):
        name = str(row.get("name"))[:80] if isinstance(row, Mapping) else str(row)[:80]
        raise _refuse(
            f"{name!r} cannot be an input of a learned term: one has {', '.join(sorted(_INPUT_KEYS))}", where
        )
    name = str(row["name"])
    if row.get("unit", INPUTS[name]) != INPUTS[name]:
        raise _refuse(f"the unit of {name!r} is {INPUTS[name]}, not {str(row['unit'])[:80]!r}", where)
    adds = row.get("adds")
    if not isinstance(adds, list) or len(adds) != len(_CHANNELS):
        raise _refuse(f"adds of {name!r} is not three numbers: v_x, v_y, v_w", where)
    numbers = [_read_number(value, name, where) for value in (*map(row.get, ("scale", "low", "high")), *adds)]
    scale, low, high, x, y, w = numbers
    if not (scale > 0.0 and low <= high):
        raise _refuse(f"{name!r} needs a scale above 0 and a low that is not above its high", where)
    return LearnedInput(name, scale, low, high, (x, y, w))


def _parse_bands(table: object, where: str) -> Bands | None:
    if table is None:
        return None
    if not isinstance(table, Mapping) or set(table) != _BAND_KEYS or not isinstance(table["of"], str):
        raise _refuse(f"bands of {_WHERE} are {', '.join(sorted(_BAND_KEYS))}", where)
    position, heading = (_read_number(table[name], "bands", where) for name in ("position", "heading"))
    if min(position, heading) < 0.0:
        raise _refuse(f"bands of {_WHERE} hold a number below 0", where)
    return Bands(position, heading, table["of"])


def _read_number(value: object, name: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _refuse(f"{name!r} of {_WHERE} holds what is not a finite number", where)
    return float(value)


def _refuse(what: str, where: str) -> MotionError:
    return MotionError("learned_invalid", what, where=where, hint="Learn it anew: slip model add.")


def learned_as_table(term: ResidualTerm) -> dict[str, object]:
    """The table of a learned term in a model file, and in JSON."""
    table: dict[str, object] = {}
    if term.bands is not None:
        table["bands"] = {name: getattr(term.bands, name) for name in ("position", "heading", "of")}
    table["input"] = [
        {
            "name": one.name,
            "unit": INPUTS[one.name],
            "scale": one.scale,
            "low": one.low,
            "high": one.high,
            "adds": list(one.adds),
        }
        for one in term.inputs
    ]
    return table


def describe_learned(term: ResidualTerm) -> list[str]:
    """A learned term as lines for people: its inputs, where they are valid, and what they add."""
    lines = [f"{term.id}: names no cause; where an input leaves low to high, the effects alone predict"]
    lines.append(f"  {'input':<36}{'unit':<11}{'low':>8}{'high':>8}   its RMS adds to v_x, v_y, v_w")
    for one in term.inputs:
        adds = " ".join(f"{value:>8.2g}" for value in one.adds)
        lines.append(f"  {one.name:<36}{INPUTS[one.name]:<11}{one.low:>8.2g}{one.high:>8.2g}   {adds}")
    return [*lines, _describe_bands(term.bands)]


def _describe_bands(bands: Bands | None) -> str:
    """Error bands of predictions over 2 s, as a line for people."""
    if bands is None:
        return "  no 95 % bands: they need errors from 19 stretches of 10 s"
    sizes = (
        f"{format_share(bands.position, 0)} of the distance in position, "
        f"{math.degrees(bands.heading):.2g} degrees per metre"
    )
    return f"  95 % of the errors within 2 s are below {sizes} in heading, {bands.of}"
