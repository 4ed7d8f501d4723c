"""Export of models to targets, found by being in this folder, and what targets share.

Shared are the conversion of a fitted model to controller parameters, and ROS 2 parameter files.
"""

from __future__ import annotations

import functools
import importlib
import json
import math
import operator
import pkgutil
import re
import textwrap
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from pipeline.core import (
    INPUT_WORDS,
    NORMAL_95,
    PACKAGE,
    guess_names,
    make_plain,
    read_bounded_text,
    read_version,
    suffix_unit,
)
from pipeline.models import (
    CONTRADICTED,
    LEAST_DELAY_S,
    UNDECIDED,
    Effect,
    FormulaEffect,
    Model,
    ModelFile,
    Number,
    Parameter,
    Place,
    Quantity,
    expect_another_run,
    is_of_one_run,
    is_own,
    predict_step,
    time_rise,
)
from pipeline.run import HORIZON_S, MotionError
from pipeline.sources import Vehicle, check_geometry

Current = Mapping[str, float]
Value: TypeAlias = "str | Quantity | Callable[[Facts, Current], Amount]"
"""What a parameter is made of; see `Row`."""


@dataclass(frozen=True)
class Row:
    """One parameter of a target, as data.

    Attributes:
        path: names of the parent nodes and groups and of the parameter, separated by dots.
        value: what it is made of: a quantity of the effects, the name of a dimension of the vehicle
            (`track_width_m`) or of what `Facts` finds (`speed_limit`), with a minus for the opposite, or a
            function of the facts and of the robot's current parameters; several for a parameter of several.
        note: what is said beside it.
        kinds: kinds of vehicles that have it; all of the target without any.
        change: converts the value to the parameter's unit.
    """

    path: str
    value: Value | tuple[Value | float, ...]
    note: str = ""
    kinds: tuple[str, ...] = ()
    change: Callable[..., float] | None = None


@dataclass(frozen=True)
class Target:
    """Format or program to which a model can be exported.

    Attributes:
        name: name on the command line.
        about: what is written.
        source: reference for the names, units and meanings of its parameters, with the version.
        kinds: kinds of vehicles it has parameters for.
        rows: its parameters, in order.
        complete: adds what is no row, given the facts, the table, and the gate where there are `gates`.
        write: makes the text of the table.
        write_file: makes the text from a model file alone, in place of a table.
        corrects: names of the current parameters it reads; empty if all its values are absolute.
        read_current: reads them from the text of the robot's file.
        has_errors: whether it writes held-out errors, for which a log may be given.
        gates: words that say whether a measured offset is applied, the first by default; empty without one.
        takes_doubtful: whether values in doubt are written as others are, as for a whole model.
    """

    name: str
    about: str
    source: str
    kinds: tuple[str, ...] = ()
    rows: tuple[Row, ...] = ()
    complete: Callable[..., None] | None = None
    write: Callable[[Facts, ParameterTable], str] | None = None
    write_file: Callable[[ModelFile], str] | None = None
    corrects: tuple[str, ...] = ()
    read_current: Callable[[str], Current] | None = None
    has_errors: bool = False
    gates: tuple[str, ...] = ()
    takes_doubtful: bool = False


@functools.cache
def list_targets() -> tuple[Target, ...]:
    """All targets of the folder, by name."""
    folder = importlib.import_module("pipeline.export")
    modules = (
        importlib.import_module(f"{folder.__name__}.{m.name}") for m in pkgutil.iter_modules(folder.__path__)
    )
    targets = (value for module in modules for value in vars(module).values() if isinstance(value, Target))
    return tuple(sorted(targets, key=lambda target: target.name))


def find_target(name: str) -> Target:
    """Target of the given name.

    Raises:
        MotionError: ``unknown_target``, with a list of all targets.
    """
    for target in list_targets():
        if target.name == name:
            return target
    names = [target.name for target in list_targets()]
    hint = f"{guess_names(name, names)}There are: {', '.join(names)}."
    raise MotionError("unknown_target", f"no export is called {name!r}", where=name, hint=hint)


def read_current(path: Path, name: str) -> Current:
    """Current parameters of the robot, which a target corrects.

    Args:
        path: the robot's parameter file.
        name: name of the target.

    Raises:
        MotionError: ``unknown_target``; ``no_current_parameters``, the target corrects none;
            ``parameters_unreadable``.
    """
    target = find_target(name)
    if target.read_current is None:
        correcting = [other.name for other in list_targets() if other.read_current]
        what = f"{name} is written without the parameters that the robot has now"
        hint = f"Omit --current; it is for {' and '.join(correcting)}."
        raise MotionError("no_current_parameters", what, where=str(path), hint=hint)
    try:
        return target.read_current(read_bounded_text(path))
    except (OSError, UnicodeDecodeError) as error:
        raise MotionError(
            "parameters_unreadable", f"cannot be read: {error}", where=str(path), hint="Check the file."
        ) from None
    except MotionError as error:
        raise MotionError(error.code, error.what, where=str(path), hint=error.hint) from None


def require_errors(name: str) -> None:
    """Check that a target writes held-out errors, for which a log may be given.

    Raises:
        MotionError: ``unknown_target``; ``no_errors_written``.
    """
    if not find_target(name).has_errors:
        what = f"{name} contains no held-out errors: it is written from the model alone"
        hint = "Omit --on; to fit the model to a log first: slip model fit MODEL --on LOG."
        raise MotionError("no_errors_written", what, where="--on", hint=hint)


def export_model(file: ModelFile, name: str, current: Current | None = None, gate: str | None = None) -> str:
    """Text of a target's file.

    Args:
        file: a fitted model.
        name: name of the target.
        current: current parameters of the robot, by name; see `read_current`.
        gate: whether a measured offset is applied, one of the target's `gates`; None for its default.

    Raises:
        MotionError: ``unknown_target``; ``wrong_vehicle``, the target has no parameters for its kind;
            ``absurd_number``, a value that no robot can have; ``no_gate``; others, see the target.
        ConfigurationError: ``implausible_geometry``.
    """
    target = find_target(name)
    used = dict(current or {})
    check_geometry(file.model.vehicle, file.model.vehicle.id)
    _check_numbers(file, {key: value for key, value in used.items() if key in target.corrects})
    if gate is not None and gate not in target.gates:
        what = f"{name} has no gate {gate!r}"
        gated = " and ".join(one.name for one in list_targets() if one.gates)
        hint = f"Give --gate {' or '.join(target.gates)}." if target.gates else f"Omit it; it is for {gated}."
        raise MotionError("no_gate", what, where="--gate", hint=hint)
    if target.write_file is not None:
        return target.write_file(file)
    facts = Facts(file)
    if facts.vehicle.kind not in target.kinds:
        raise MotionError(
            "wrong_vehicle",
            f"{name} has parameters for {' and '.join(target.kinds)} vehicles; {facts.vehicle.id} is "
            f"{facts.vehicle.kind}",
            where=facts.vehicle.id,
            hint="Export to another target: json and python take every vehicle.",
        )
    head = [
        f"{quote_name(facts.vehicle.name)}: {target.about}.",
        f"Names: {target.source}.",
        *facts.list_origin(),
        facts.vehicle.format_unknown(),
    ]
    table = ParameterTable([line for line in head if line])
    for row in target.rows:
        if not row.kinds or facts.vehicle.kind in row.kinds:
            _fill_row(row, facts, table, used)
    if list_omitted(file, name) or any(setting.is_doubtful for setting in table.settings):
        table.head.append("What depends on a value in doubt is commented out.")
    if target.complete is not None:
        target.complete(facts, table, *([gate or target.gates[0]] if target.gates else []))
    return (target.write or write_yaml)(facts, table)


def list_omitted(file: ModelFile, name: str) -> Mapping[str, Number]:
    """Values in doubt, by label, whose parameters a target leaves out, or has as comments only.

    Raises:
        MotionError: ``unknown_target``.
    """
    return {} if find_target(name).takes_doubtful else file.list_doubtful()


def _fill_row(row: Row, facts: Facts, table: ParameterTable, current: Current) -> None:
    """Add a parameter to a table, unless something that it needs is unknown."""

    def make(value: Value | float) -> Amount | float:
        if isinstance(value, float):
            return value
        amount = facts.find(value) if isinstance(value, str | Quantity) else value(facts, current)
        return amount if row.change is None else amount.change(row.change)

    if isinstance(row.value, tuple):
        table.add_row(row.path, tuple(make(value) for value in row.value), row.note)
    elif isinstance(amount := make(row.value), Amount):
        table.add(row.path, amount, row.note)


LARGEST = 1e9
"""Bound of the absolute values that are exported: in SI units no parameter of a robot or its controller is so
large."""
DRIVEN_SPEED, DRIVEN_TURN = "driven_speed_mps", "driven_yaw_rate_radps"
"""Keys of the largest driven values in the runs of a fit."""
REACHED_ACCELERATION = "reached_acceleration_mps2"
REACHED_TURN_ACCELERATION = "reached_yaw_acceleration_radps2"
"""Keys of the largest accelerations that the model reaches in the runs of its fit."""
_DRIVEN_KEYS = (DRIVEN_SPEED, DRIVEN_TURN, REACHED_ACCELERATION, REACHED_TURN_ACCELERATION)
LOWER_SPEED = "lower_speed_mps"
"""Key of the speed below which a quarter of the driving was slower, in the runs of a fit."""


def require_plausible(label: str, *values: float, least: float = -LARGEST) -> None:
    """Refuse numbers that are not finite, or beyond those of any robot.

    Raises:
        MotionError: ``absurd_number``.
    """
    for value in values:
        if not least <= value <= LARGEST:
            what = f"{label} = {value:g} is not a plausible number, so nothing is written"
            hint = "Correct it in the model file or in the file of --current, or fit the model again."
            raise MotionError("absurd_number", what, where=label, hint=hint)


_FACTORS = {Quantity.RADIUS, Quantity.TRACK, Quantity.WHEELBASE}
SPEED_LIMITS = frozenset({Quantity.SPEED_LIMIT, Quantity.TURN_LIMIT, Quantity.WHEEL_SPEED_LIMIT})
"""Quantities that clip a constant command."""
_TARGET_LIMITS = SPEED_LIMITS | {
    Quantity.ACCELERATION_LIMIT,
    Quantity.TURN_ACCELERATION_LIMIT,
    Quantity.WHEEL_ACCELERATION_LIMIT,
}
"""Quantities that targets have parameters for beside delays."""
_USUAL_TOP = (1.0, 0.5)
"""Speed [m/s] and yaw rate [rad/s] if neither the fit nor the vehicle gives the largest ones."""
STEADY_S = 20.0
"""Time until the motion counts as steady [s]: twenty times the longest lag that vehicles have."""
_TRIED = 0.1
"""Change of a parameter that shows whether a delay depends on it, in parts of it or of a typical one."""
_UNCHANGED_S = 5e-3
"""Change of a delay that is none [s]: a tenth of a step of MPPI."""
_STEPS = (1.0, 0.5, 0.25)
"""Steps whose delays are compared, in parts of the largest driven motion."""
_ONE_DELAY = 1.5
"""Ratio of the delays of these steps up to which one stands for all."""
_MPPI_STEP_S = 0.05
"""Usual step of MPPI [s]: delays that differ by less are one."""
_DRIVEN = 4.0
"""Ratio of the 99th percentile of a motion to the rms of the noise floor from which on it was driven: that of
noise alone is 2.6."""
_DIGEST = 12
"""Digits of a recording's hash that tell it from all others."""
_MOST_GROUNDS = 5
"""Values by ground that a comment lists; of more it has the least and the largest."""
_LINE = 100
"""Columns of a line of names in a comment."""
_LEAST_FACTOR = 0.01
"""Least ratio of an effective to a nominal length: below it a vehicle hardly moves, and has no parameters."""


def _check_numbers(file: ModelFile, current: Current) -> None:
    """Refuse absurd numbers that a target may write or calculate with.

    An open parameter, such as a limit without a value, has a neutral value that is not finite.
    """
    for effect in file.model:
        for parameter in effect.parameters:
            value = effect.values[parameter.name]
            if math.isfinite(value) or math.isfinite(parameter.neutral):
                require_plausible(f"{effect.id}.{parameter.name}", value)
    for row in file.list_fitted("runs"):
        for key in (*_DRIVEN_KEYS, LOWER_SPEED):
            if isinstance(driven := row.get(key), float):
                require_plausible(f"fit.runs.{key}", driven, least=0.0)
    for name, value in current.items():
        require_plausible(name, value)


@dataclass(frozen=True)
class Amount:
    """Value with its sources.

    Attributes:
        value: in SI units.
        sources: a line for each parameter it was computed from; empty if nothing is known.
        effects: ids of the effects among them.
        is_doubtful: whether one of the parameters is in doubt.
    """

    value: float
    sources: tuple[str, ...] = ()
    effects: frozenset[str] = frozenset()
    is_doubtful: bool = False

    def __neg__(self) -> Amount:
        return self.change(operator.neg)

    @property
    def is_known(self) -> bool:
        """Whether the value was measured and is finite."""
        return bool(self.sources) and math.isfinite(self.value)

    def change(self, function: Callable[..., float], *given: Amount) -> Amount:
        """Convert the value to another quantity, such as a body limit to a wheel limit by the wheel's radius.

        The effects of the given values are listed as sources, but not as effects covered by the result. What
        nothing is known of stays unknown, whatever is known of the given values.
        """
        if not self.sources:
            return Amount(math.nan)
        return replace(combine(function, self, *given), effects=self.effects)


def combine(function: Callable[..., float], *amounts: Amount) -> Amount:
    """Apply a function to several values; the sources and effects are united."""
    effects = frozenset[str]().union(*(amount.effects for amount in amounts))
    is_doubtful = any(amount.is_doubtful for amount in amounts)
    return Amount(_compute(function, *amounts), _unite(*amounts), effects, is_doubtful)


def _compute(function: Callable[..., float], *amounts: Amount) -> float:
    """Value of the function; NaN for a division by zero."""
    try:
        return function(*(amount.value for amount in amounts))
    except ZeroDivisionError:
        return math.nan


def _unite(*amounts: Amount) -> tuple[str, ...]:
    return tuple(dict.fromkeys(line for amount in amounts for line in amount.sources))


class _Motion(NamedTuple):
    """A motion of the body: key of its largest driven value, its channel, and words for it."""

    driven: str
    channel: int
    did: str
    other: str


_AHEAD = _Motion(DRIVEN_SPEED, 0, "drove ahead", "turning")
_TURNING = _Motion(DRIVEN_TURN, 2, "turned", "driving")


@dataclass(frozen=True)
class Setting:
    """One parameter of a target.

    Attributes:
        path: names of the parent nodes and groups and of the parameter, separated by dots.
        value: value as written: a number, a switch or a word, or several in a row.
        sources: sources of the value.
        effects: ids of the effects that it covers.
        is_doubtful: whether it depends on a value in doubt, so that it is written as a comment.
    """

    path: str
    value: float | bool | str | tuple[float, ...] | tuple[bool, ...]
    sources: tuple[str, ...] = ()
    effects: frozenset[str] = frozenset()
    is_doubtful: bool = False


def _name_plainly(path: str) -> str:
    """A parameter without its node and ROS's group."""
    return ".".join(part for part in path.split(".")[1:] if part != "ros__parameters") or path


@dataclass
class ParameterTable:
    """Parameters of a target, in order.

    Attributes:
        head: comment lines above them.
        settings: the parameters.
        unknown: names of the parameters that no effect of the model tells.
    """

    head: list[str] = field(default_factory=list)
    settings: list[Setting] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)

    def add(self, path: str, amount: Amount, note: str = "") -> None:
        """Add a value; of an unknown one only that it is."""
        if amount.is_known:
            self._append(path, _round(amount.value), amount, note)
        else:
            self.unknown.append(_name_plainly(path))

    def add_row(self, path: str, amounts: tuple[Amount | float, ...], note: str = "") -> None:
        """Add a parameter of several values; if one that is no constant is unknown, only that it is."""
        measured = [amount for amount in amounts if isinstance(amount, Amount)]
        if all(amount.is_known for amount in measured):
            numbers = tuple(_round(a.value if isinstance(a, Amount) else a) for a in amounts)
            self._append(path, numbers, combine(lambda *_: math.nan, *measured), note)
        else:
            self.unknown.append(_name_plainly(path))

    def _append(self, path: str, value: float | tuple[float, ...], amount: Amount, note: str) -> None:
        require_plausible(path, *(value if isinstance(value, tuple) else (value,)))
        notes = (note,) if note else ()
        sources = (*amount.sources, *notes)
        self.settings.append(Setting(path, value, sources, amount.effects, amount.is_doubtful))


class Facts:
    """Vehicle properties from a model file: quantities, and delays and limits of the body derived from them.

    Attributes:
        file: the model file.
        vehicle: its vehicle.
    """

    def __init__(self, file: ModelFile) -> None:
        self.file = file
        self.vehicle = file.model.vehicle
        for effect, parameter in self._list_numbers():
            # Controllers divide by effective lengths.
            if _FACTORS.intersection(parameter.quantities):
                value = effect.values[parameter.name]
                require_plausible(f"{effect.id}.{parameter.name}", value, least=_LEAST_FACTOR)

    def take(self, quantity: Quantity) -> Amount:
        """Return a quantity; neutral and without sources if no effect of the model has it.

        Formulas and Python effects of the user do not count, whatever their ids are.
        """
        values, sources, effects, is_doubtful = [], [], [], False
        for effect, parameter in self._list_numbers():
            if quantity in parameter.quantities:
                is_doubtful |= bool(self.file.find_number(effect, parameter).doubt)
                values.append(effect.values[parameter.name])
                sources.append(self._format_source(effect, parameter))
                effects.append(effect.id)
        return Amount(_join(quantity, values), tuple(sources), frozenset(effects), is_doubtful)

    def find_variance(self, quantity: Quantity) -> Amount:
        """Variance of a quantity whose values add up, from their intervals; unknown if one has none."""
        taken, variances = self.take(quantity), list[float]()
        for effect, parameter in self._list_numbers():
            number = self.file.find_number(effect, parameter)
            if effect.id in taken.effects and quantity in parameter.quantities and math.isfinite(number.low):
                variances.append((0.5 * (number.high - number.low) / NORMAL_95) ** 2)
        value = math.fsum(variances) if len(variances) == len(taken.effects) else math.nan
        return replace(taken, value=value)

    def measure(self, name: str) -> Amount:
        """Return a vehicle dimension by its field name; unknown if it is not given (NaN) or a stand-in."""
        value = getattr(self.vehicle, name)
        known = name not in self.vehicle.stand_ins
        is_doubtful = name in self.file.contradicted
        about = f", {CONTRADICTED}" if is_doubtful else ""
        sources = (f"vehicle {name_entity(self.vehicle)}: {name}{about}",) if known else ()
        return Amount(math.nan if value is None else value, sources, is_doubtful=is_doubtful)

    def find(self, name: str | Quantity) -> Amount:
        """Return a quantity, a dimension of the vehicle, or what a method `find_` of that name finds.

        A minus before the name makes it negative.
        """
        if isinstance(name, Quantity):
            return self.take(name)
        plain = name.removeprefix("-")
        known = hasattr(self, f"find_{plain}")
        amount = getattr(self, f"find_{plain}")() if known else self.measure(plain)
        return -amount if name.startswith("-") else amount

    def find_radius(self) -> Amount:
        """Effective wheel radius [m]."""
        return self._scale("wheel_radius_m", Quantity.RADIUS)

    def find_track(self) -> Amount:
        """Effective track width [m]."""
        return self._scale("track_width_m", Quantity.TRACK)

    def find_wheelbase(self) -> Amount:
        """Effective wheelbase [m]."""
        return self._scale("wheelbase_m", Quantity.WHEELBASE)

    def _scale(self, name: str, factor: Quantity) -> Amount:
        """Dimension times its factor; unknown for a stand-in, whose value cancels out in limits."""
        dimension = self.measure(name)
        scaled = combine(operator.mul, dimension, self.take(factor))
        return scaled if dimension.sources else Amount(scaled.value, is_doubtful=scaled.is_doubtful)

    def find_largest_steering(self) -> Amount:
        """Steering angle at the largest command [rad]."""
        return combine(operator.mul, self.measure("max_steering_rad"), self.take(Quantity.STEERING_GAIN))

    def find_turning_radius(self) -> Amount:
        """Smallest turning radius that a car reaches to both sides [m]."""
        gain, offset = self.take(Quantity.STEERING_GAIN), self.take(Quantity.STEERING_OFFSET)
        angle = combine(lambda a, g, o: g * a - abs(o), self.measure("max_steering_rad"), gain, offset)
        return combine(_find_circle, self.find_wheelbase(), angle)

    def find_speed_delay(self) -> Amount:
        """Delay of the speed behind its command [s]; see `_time_steps`."""
        return self._doubt_undriven(self._time_steps(self.find_driven()[0], 0.0), _AHEAD)

    def find_turn_delay(self) -> Amount:
        """Delay of the yaw rate behind its command [s], on the spot; on a car it is that of the steering."""
        if self.vehicle.kind == "ackermann":
            late = combine(operator.add, self.take(Quantity.COMMAND_DELAY), self.take(Quantity.STEERING_LAG))
        else:
            late = self._time_steps(0.0, self.find_driven()[1])
        return self._doubt_undriven(late, _TURNING)

    def find_driven(self) -> tuple[float, float]:
        """Largest speed [m/s] and yaw rate [rad/s] of the runs of the fit, or else of the vehicle."""
        speed, turn = (max(self.list_driven(key), default=0.0) for key in (DRIVEN_SPEED, DRIVEN_TURN))
        return speed or self.vehicle.max_speed_mps or _USUAL_TOP[0], turn or _USUAL_TOP[1]

    def _doubt_undriven(self, late: Amount, motion: _Motion) -> Amount:
        """A delay; in doubt where the runs of the fit hardly had the motion that is late.

        It is then that of the other motion, which the model need not tell from it.
        """
        driven, floor = self.list_driven(motion.driven), self.file.fit.get("noise_floor")
        noise = floor.get("velocity_rms") if isinstance(floor, Mapping) else None
        rms = noise[motion.channel] if isinstance(noise, Sequence) and len(noise) > motion.channel else 0.0
        if not late.is_known or not driven or not (isinstance(rms, float) and max(driven) < _DRIVEN * rms):
            return late
        who = "runs" if len(driven) > 1 else "run"
        source = f"the {who} hardly {motion.did}: the delay is assumed equal to that of {motion.other}"
        return replace(late, sources=(*late.sources, source), is_doubtful=True)

    def _time_steps(self, speed: float, turn: float) -> Amount:
        """Time from a step of the command to 63 % of the motion that follows [s], from rest.

        It is that of the whole model: a dead time and a time constant add up, and so do motors and a ground
        that have none. Limits are left out: they are parameters of their own. Sources are the parameters on
        which it depends, and the times after smaller steps where they differ. It is in doubt where they
        differ much, and where it exceeds the time over which models are judged: a motion that grows for so
        long does not follow its command by a delay.
        """
        dead = self.take(Quantity.COMMAND_DELAY)
        free = {
            effect.id: effect.change(
                **{p.name: p.neutral for p in effect.parameters if _TARGET_LIMITS.intersection(p.quantities)}
            )
            for effect in self.file.model
            if effect.place is not Place.LOCALIZATION
            and effect.id not in dead.effects
            and not is_of_one_run(effect.parameters)
        }

        def time(effects: Mapping[str, Effect], part: float = 1.0) -> float:
            moved = predict_step(self.vehicle, (*effects.values(),), part * speed, part * turn, STEADY_S)
            motion = moved.w if turn else moved.x
            return time_rise(motion / motion[-1]) if motion[-1] else math.nan

        rise, sources, effects, is_doubtful = time(free), [*dead.sources], {*dead.effects}, dead.is_doubtful
        for effect, parameter in self._list_numbers():
            if effect.id not in free or _TARGET_LIMITS.intersection(parameter.quantities):
                continue
            value = effect.values[parameter.name]
            change = _TRIED * max(abs(value), abs(parameter.typical))
            tried = free[effect.id].change_within(**{parameter.name: value + change})
            if not abs(time({**free, effect.id: tried}) - rise) <= _UNCHANGED_S:
                sources.append(self._format_source(effect, parameter))
                effects.add(effect.id)
                is_doubtful |= bool(self.file.find_number(effect, parameter).doubt)
        if not sources:
            return Amount(math.nan)
        size, unit = (turn, "rad/s") if turn else (speed, "m/s")
        # A smaller step may move nothing: then nothing is late.
        times = {part * size: dead.value + time(free, part) for part in _STEPS}
        known = {step: late for step, late in times.items() if math.isfinite(late)}
        apart = max(known.values()) - min(known.values()) if known else 0.0
        text = "time to 63 % of the motion"
        if apart <= _UNCHANGED_S:
            sources.append(f"{text} after a step of {size:.3g} {unit}")
        else:
            each = ", ".join(
                f"{late:.2g} s after a step of {step:.3g} {unit}" for step, late in known.items()
            )
            sources.append(f"{text} from rest: {each}")
        if apart > max((_ONE_DELAY - 1.0) * min(known.values(), default=0.0), _MPPI_STEP_S):
            sources.append("one delay does not fit these steps")
            is_doubtful = True
        if rise > HORIZON_S:
            sources.append(f"no delay describes a motion that grows for more than {HORIZON_S:g} s")
            is_doubtful = True
        return Amount(dead.value + rise, tuple(sources), frozenset(effects), is_doubtful)

    def find_speed_limit(self) -> Amount:
        """Largest speed of the body [m/s], from its command or from the wheels when driving straight.

        Gains of the drive are left out.
        """
        wheels = self.take(Quantity.WHEEL_SPEED_LIMIT).change(operator.mul, self.find_radius())
        commanded = self.take(Quantity.SPEED_LIMIT).change(operator.mul, self.take(Quantity.RADIUS))
        return self._hold(_take_least(commanded, wheels), DRIVEN_SPEED, "m/s")

    def find_turn_limit(self) -> Amount:
        """Largest yaw rate of the body [rad/s], from its command or from the wheels turning on the spot.

        Gains of the drive are left out; without a known track or wheelbase it is that of the command.
        """
        wheels, commanded = self._spin(Quantity.WHEEL_SPEED_LIMIT), self.take(Quantity.TURN_LIMIT)
        is_car = self.vehicle.kind == "ackermann"
        width = self.take(Quantity.WHEELBASE if is_car else Quantity.TRACK)
        if width.is_known:
            own = 1.0 if is_car else self.vehicle.controller_track_multiplier
            commanded = commanded.change(lambda w, r, k: w * own * r / k, self.take(Quantity.RADIUS), width)
        return self._hold(_take_least(commanded, wheels), DRIVEN_TURN, "rad/s")

    def _hold(self, limit: Amount, key: str, unit: str) -> Amount:
        """Limit of the body, at most the largest driven value: wheels that turn faster may slip.

        A limit of commands that motors follow late is higher than what the body reaches.
        """
        most = max(self.list_driven(key), default=math.inf)
        if not limit.is_known or limit.value <= most:
            return limit
        source = f"no more than was driven: {most:.3g} {unit}"
        return replace(limit, value=most, sources=(*limit.sources, source))

    def find_speed_acceleration(self) -> Amount:
        """Largest acceleration [m/s^2], from the command or from the wheels driving straight."""
        wheels = self.take(Quantity.WHEEL_ACCELERATION_LIMIT).change(operator.mul, self.find_radius())
        commanded = self.take(Quantity.ACCELERATION_LIMIT).change(operator.mul, self.take(Quantity.RADIUS))
        return self._hold(_take_least(commanded, wheels), REACHED_ACCELERATION, "m/s^2")

    def find_turn_acceleration(self) -> Amount:
        """Largest yaw acceleration [rad/s^2], from the command or turning on the spot; unknown for a car."""
        gains = self.take(Quantity.RADIUS), self.take(Quantity.TRACK)
        commanded = self.take(Quantity.TURN_ACCELERATION_LIMIT).change(lambda a, r, k: a * r / k, *gains)
        limit = _take_least(commanded, self._spin(Quantity.WHEEL_ACCELERATION_LIMIT))
        return self._hold(limit, REACHED_TURN_ACCELERATION, "rad/s^2")

    def find_deadband_speed(self) -> Amount:
        """Deadband as speed when driving straight [m/s]."""
        return self.take(Quantity.DEADBAND).change(operator.mul, self.take(Quantity.RADIUS))

    def find_deadband_turn(self) -> Amount:
        """Deadband as yaw rate when turning on the spot [rad/s]."""
        return self._turn(self.find_deadband_speed())

    def list_unmapped(self, table: ParameterTable) -> list[str]:
        """Parameters of effects that a table does not cover, a line an effect, and clocks of poses."""
        used = {(name, source) for one in table.settings for source in one.sources for name in one.effects}
        lines = []
        for effect in self.file.model:
            texts = [self._format_source(effect, p) for p in effect.parameters if effect.is_used(p)]
            missing = [text for text in texts if (effect.id, text) not in used]
            if missing or not texts:
                lines.append("; ".join(missing) or effect.id)
        clocks = {str(row.get("run")): row.get("pose_delay_s") for row in self.file.list_fitted("runs")}
        lines += [
            f"clock_offset.d = {late:.3g} s: the heading of the poses of {quote_name(run)} is late"
            for run, late in clocks.items()
            if isinstance(late, float) and abs(late) >= LEAST_DELAY_S
        ]
        return lines

    def list_driven(self, key: str) -> list[float]:
        """A number of every run of the fit that has it, for example `DRIVEN_SPEED`."""
        rows = self.file.list_fitted("runs")
        return [value for row in rows if isinstance(value := row.get(key), float)]

    def list_origin(self) -> list[str]:
        """What the values come from: the version that writes them, and the runs of a fit."""
        names = []
        for run in self.file.list_fitted("runs"):
            digest = str(run.get("sha256") or "")[:_DIGEST]
            names.append(f"{quote_name(str(run.get('run')))}{digest and f' (SHA-256 {digest})'}")
        source = str(self.file.fit.get("input"))
        words = INPUT_WORDS.get(source) or quote_name(source)
        fitted = [f"Fitted {words} of {', '.join(names)}."] if names else []
        return [f"Written by {PACKAGE} {read_version()}.", *fitted]

    def list_sources(self) -> list[str]:
        """All parameters that act, with their intervals and doubts."""
        return [
            self._format_source(effect, parameter)
            for effect in self.file.model
            for parameter in effect.parameters
            if effect.is_used(parameter)
        ]

    def _spin(self, quantity: Quantity) -> Amount:
        return self._turn(self.take(quantity).change(operator.mul, self.find_radius()))

    def _turn(self, rim: Amount) -> Amount:
        """Yaw rate of a vehicle whose sides run at opposite speeds; unknown for a car."""
        if self.vehicle.kind != "differential":
            return Amount(math.nan)
        return rim.change(lambda speed, track: 2.0 * speed / track, self.find_track())

    def _list_numbers(self) -> Iterator[tuple[Effect, Parameter]]:
        for effect in self.file.model:
            if not isinstance(effect, FormulaEffect) and not is_own(type(effect)):
                yield from ((effect, parameter) for parameter in effect.parameters)

    def _format_source(self, effect: Effect, parameter: Parameter) -> str:
        label, number = f"{effect.id}.{parameter.name}", self.file.find_number(effect, parameter)
        text = f"{label} = {number.value:.5g}{suffix_unit(number.unit)}"
        if math.isfinite(number.low):
            single = len(self.file.list_fitted("runs")) == 1
            text += f" ({'this run' if single else 'these runs'}, 95 %: {number.low:.5g} to {number.high:.5g}"
            text += f"; {number.elsewhere})" if number.elsewhere else ")"
        if by_ground := self._list_by_ground(label):
            text += f", the mean of {', '.join(by_ground)}"
        if number.doubt == UNDECIDED:
            names = " or ".join(map(quote_name, self.file.list_rivals(effect.id)))
            return f"{text}, undecided: {names} would explain the data as well"
        return f"{text}, {number.reason}" if number.doubt else text

    def _list_by_ground(self, label: str) -> list[str]:
        """Values of a parameter that grounds or runs have of their own; of many the least and the largest."""
        by_run = {run: number.value for run, number in self.file.list_own().get(label, {}).items()}
        grounds = {str(row.get("run")): str(row.get("terrain")) for row in self.file.list_fitted("runs")}
        values = {(grounds.get(run, run), value) for run, value in by_run.items()}
        if len(values) != len({ground for ground, _ in values}) or {"None", "unknown"} & {*dict(values)}:
            values = {*by_run.items()}
        ranked = sorted(values, key=lambda one: one[1])
        texts = [f"{value:.4g} on {quote_name(name)}" for name, value in ranked]
        return texts if len(texts) <= _MOST_GROUNDS else [f"{len(texts)} values, {texts[0]} to {texts[-1]}"]


def quote_name(name: str) -> str:
    """A name from a log or a model file as a literal in a comment: printable, and with its own end."""
    return repr(name)


def name_entity(vehicle: Vehicle) -> str:
    """Name of the vehicle as an identifier: letters, digits and underscores."""
    return re.sub(r"\W+", "_", vehicle.id) or "robot"


def _join(quantity: Quantity, values: list[float]) -> float:
    if values or quantity.join not in {min, max}:
        return float(quantity.join(values))
    return math.inf if quantity.join is min else 0.0


def _round(value: float) -> float:
    return float(f"{value:.5g}")


def _find_circle(wheelbase_m: float, angle_rad: float) -> float:
    """Turning radius of the rear axle; infinite if the car steers to one side only."""
    return wheelbase_m / math.tan(angle_rad) if angle_rad > 0.0 else math.inf


def _take_least(*amounts: Amount) -> Amount:
    known = [amount for amount in amounts if amount.is_known]
    return combine(min, *known) if len(known) > 1 else (known or [Amount(math.inf)])[0]


def list_comments(facts: Facts, table: ParameterTable) -> list[str]:
    """Comment lines above the parameters: the head, effects that none of them covers, and what is missing."""
    unmapped, unknown = facts.list_unmapped(table), ", ".join(table.unknown)
    lines = [*table.head, *(["Not covered by these parameters:"] if unmapped else [])]
    lines += [f"  {line}" for line in unmapped]
    lines += ["Not written, as no effect of the model determines it:"] if unknown else []
    lines += [f"  {line}" for line in textwrap.wrap(unknown, _LINE)]
    return [make_plain(line) for line in lines]


def write_yaml(facts: Facts, table: ParameterTable) -> str:
    """Format a table as a ROS 2 parameter file."""
    tree: dict[str, Any] = {}
    for setting in table.settings:
        group = tree
        *above, name = setting.path.split(".")
        for node in above:
            group = group.setdefault(node, {})
        group[name] = setting
    said = Counter(line for one in table.settings for line in one.sources)
    shared = {line: name for line, count in said.items() if count > 1 and (name := _shorten(line)) != line}
    head = list_comments(facts, table)
    head += (
        ["Named beside several parameters:", *(f"  {make_plain(line)}" for line in shared)] if shared else []
    )
    return "".join(f"{line}\n" for line in [*(f"# {line}" for line in head), *_list_lines(tree, shared)])


def _shorten(line: str) -> str:
    """The name of a source: what stands before its value or its explanation."""
    return re.split(" = |: ", line, maxsplit=1)[0]


def _list_lines(group: Mapping[str, Any], shared: Mapping[str, str], indent: str = "") -> Iterator[str]:
    for name, item in group.items():
        if isinstance(item, Setting):
            names = ", ".join(dict.fromkeys(shared[line] for line in item.sources if line in shared))
            lines = [*([names] if names else []), *(line for line in item.sources if line not in shared)]
            yield from (f"{indent}# {make_plain(line)}" for line in lines)
            yield f"{indent}{'# ' * item.is_doubtful}{name}: {_write_value(item.value)}"
        else:
            lines = list(_list_lines(item, shared, f"{indent}  "))
            # A group without values is no group for those who read it.
            is_empty = all(line.lstrip().startswith("#") for line in lines)
            yield f"{indent}{'# ' * is_empty}{name}:"
            yield from lines


def _write_value(value: object) -> str:
    """A value that every YAML reader takes for its type: a number with a point, a word in quotes."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(_write_value, value))}]"
    text = json.dumps(value)
    return text.replace("e", ".0e") if isinstance(value, float) and "." not in text else text
