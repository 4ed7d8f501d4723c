"""Effects as text: from a formula, a page and parameters their physics, page and export are derived."""

import functools
import inspect
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final, TypeVar

import numpy as np

from pipeline.models.effect import (
    ACKERMANN,
    ANY,
    INF,
    NAN,
    SIDES,
    SIDEWAYS,
    WHEELED,
    Column,
    CommandEffect,
    DriveEffect,
    Effect,
    KinematicEffect,
    Late,
    LinearEffect,
    Place,
    ReportEffect,
)
from pipeline.models.expression import Expression, parse_expression
from pipeline.models.filters import lag_signal, limit_rate
from pipeline.models.parameter import (
    LEAST_DELAY_S,
    WARTHOG_LAGS,
    Conditions,
    Excitation,
    Largest,
    Least,
    Level,
    Meaning,
    Parameter,
    Part,
    Plausible,
    Quantity,
    Search,
    Spread,
    parse_unit,
)
from pipeline.run import (
    LEAST_RIM_SPEED,
    Commands,
    Floats,
    MotionError,
    Resets,
    Rolling,
    RunContext,
    Velocity,
    Wheels,
    change_wheels,
    find_fastest_wheel,
    find_turning,
)

__all__ = [
    "ACKERMANN",
    "ANY",
    "INF",
    "LEAST_DELAY_S",
    "LEAST_RAMP_S",
    "NAN",
    "SIDES",
    "SIDEWAYS",
    "TIME_CONSTANT",
    "WARTHOG_LAGS",
    "WHEELED",
    "Conditions",
    "Effect",
    "Excitation",
    "Floats",
    "Largest",
    "Late",
    "Least",
    "Level",
    "Meaning",
    "Parameter",
    "Part",
    "Place",
    "Plausible",
    "Quantity",
    "Resets",
    "Search",
    "Spread",
    "declare",
    "find_least_ramp",
    "has_encoders",
    "has_no_encoders",
    "is_one_motion",
    "is_short",
    "never_attained",
    "never_reached",
    "take_largest",
]

_LEAST_SPEED = 1e-9
"""Smallest speed of the fastest wheel [rad/s]: a divisor at rest."""
_Drive = TypeVar("_Drive", Commands, Wheels)


@dataclass(frozen=True)
class _Now:
    """What the signals of a formula are read from.

    Attributes:
        context: the run.
        drive: commands, or wheels.
        rolling: velocity of the wheels.
        velocity: velocity of the body.
    """

    context: RunContext
    drive: Commands | Wheels | None = None
    rolling: Rolling | None = None
    velocity: Velocity | None = None


def _measure_turn(now: Any) -> Any:  # noqa: ANN401 - see `_SIGNALS`
    """Yaw rate that a drive asks for [rad/s]: of commands by the controller's own track."""
    return 0.5 * (now.drive.right - now.drive.left) / _scale_turn(now.drive, now.context)


def _scale_turn(drive: Commands | Wheels, context: RunContext) -> float:
    vehicle = context.vehicle
    track = 0.5 * context.track_m / vehicle.wheel_radius_m
    return track * vehicle.controller_track_multiplier if isinstance(drive, Commands) else track


# Readers take `_Now` with what is there at their stage.
_SIGNALS: Final[Mapping[str, tuple[str, Callable[[Any], Any]]]] = {
    "left": ("rad/s", lambda now: now.drive.left),
    "right": ("rad/s", lambda now: now.drive.right),
    "sideways": ("rad/s", lambda now: now.drive.sideways),
    "delta": ("rad", lambda now: now.drive.steering),
    "D": ("rad/s", lambda now: now.drive.right - now.drive.left),
    "f_x": ("m/s", lambda now: 0.5 * now.context.vehicle.wheel_radius_m * (now.drive.left + now.drive.right)),
    "f_w": ("rad/s", _measure_turn),
    "e_m": ("1", lambda now: now.drive.imbalance),
    "fastest": ("rad/s", lambda now: np.maximum(find_fastest_wheel(now.drive), _LEAST_SPEED)),
    "v0": ("m/s", lambda now: now.rolling.v0),
    "s0": ("m/s", lambda now: now.rolling.s0),
    "w0": ("rad/s", lambda now: now.rolling.w0),
    "v_x": ("m/s", lambda now: now.velocity.x),
    "v_y": ("m/s", lambda now: now.velocity.y),
    "v_w": ("rad/s", lambda now: now.velocity.w),
    "turning": ("1", lambda now: find_turning(now.drive, now.context)),
    "roll": ("rad", lambda now: now.context.attitude[:, 0]),
    "pitch": ("rad", lambda now: now.context.attitude[:, 1]),
    "t": ("s", lambda now: now.context.times - now.context.start_s),
    "T": ("s", lambda now: now.context.duration_s),
    "r": ("m", lambda now: now.context.vehicle.wheel_radius_m),
    "b": ("m", lambda now: now.context.track_m),
    "l": ("m", lambda now: now.context.vehicle.wheelbase_m or 1.0),
}
SIGNALS: Final[Mapping[str, str]] = {
    "Omega": "rad/s",
    **{name: unit for name, (unit, _) in _SIGNALS.items()},
}
"""What the formula of an effect may use, and units.

Speeds of one wheel Omega, of the sides left and right and their difference D, sideways, and of the fastest
wheel; steering angle delta; speed f_x and yaw rate f_w that a drive asks for; imbalance e_m of its motors;
rolling v0, s0, w0; body velocity v_x, v_y, v_w; turning, one while the wheels turn; attitude roll, pitch;
time t of the run's T; radius r, track b and wheelbase l.
"""

_EQUATION = re.compile(r"(\w+)\s*(\+?=)\s*(.+)")
_LAG = re.compile(r"(\w+) \* d(\w+)/dt = u - \2")
_DELAY = re.compile(r"Omega\(t\) = u\(t - (\w+)\)")
_RAMP = re.compile(r"abs\(d(\w+)/dt\) <= (\w+)")
_PLACES = {
    **dict.fromkeys(
        ("Omega", "left", "right", "sideways", "delta", "D", "M", "f_x", "f_w", "e_m"), Place.DRIVE
    ),
    **dict.fromkeys(("v0", "s0", "w0"), Place.KINEMATICS),
}


class Written(Effect):
    """An effect whose physics is its formula.

    Attributes:
        formula: its lines, by kind of vehicle where they differ; the empty kind stands for all others.
        about: the page without the formula.
        adds: whether its equations say what is added to a signal, in place of its new value.
    """

    formula: Mapping[str, tuple[str, ...]]
    about: str
    adds: ClassVar[bool] = False

    @classmethod
    def find_page(cls) -> str:
        """Its manual page: the formula below the first line."""
        title, _, rest = cls.about.partition("\n")
        shown = []
        for kind, lines in cls.formula.items():
            where = f", on {kind} vehicles" if kind else ""
            wheels = [", each wheel" * ("Omega" in line and "each wheel" not in line) for line in lines]
            shown += [f"    {line}{each}{where}" for line, each in zip(lines, wheels, strict=True)]
        return "\n".join([title, "", *shown, rest]).strip()

    @classmethod
    def choose_lines(cls, kind: str) -> tuple[str, ...]:
        """Lines of the formula on a kind of vehicle."""
        return cls.formula.get(kind, cls.formula[""])

    @classmethod
    @functools.cache
    def list_equations(cls, kind: str) -> Mapping[str, Expression]:
        """Right sides of the formula on a kind of vehicle, by the signal that each changes."""
        return _parse_equations(
            cls.id, cls.choose_lines(kind), tuple((p.name, p.unit) for p in cls.parameters)
        )

    def _compute(self, expression: Expression, now: _Now, **extra: Any) -> Any:  # noqa: ANN401 - a signal
        known = {**self.known, **extra}
        for name in expression.names - known.keys():
            known[name] = _SIGNALS[name][1](now)
        return expression.evaluate(known)

    @property
    def known(self) -> dict[str, Floats | float]:
        """The parameters; one without a value is zero."""
        return {name: 0.0 if np.isnan(value) else value for name, value in self.values.items()}

    def _change_drive(self, drive: _Drive, context: RunContext) -> _Drive:
        now, changed = _Now(context, drive), drive
        for name, expression in self.list_equations(context.vehicle.kind).items():
            if name == "Omega":
                change = functools.partial(self._change_wheel, expression, now)
                changed = change_wheels(changed, change)
            elif name in {"D", "f_x", "f_w"}:
                added = self._compute(expression, now) - _SIGNALS[name][1](now)
                changed = _spread(changed, context, name, added)
            else:
                field = {"delta": "steering", "e_m": "imbalance"}.get(name, name)
                changed = replace(changed, **{field: self._compute(expression, now)})
        return changed

    def _change_wheel(self, expression: Expression, now: _Now, wheel: Floats) -> Floats:
        radius = now.context.vehicle.wheel_radius_m
        extra = {"turning": radius * np.abs(wheel) > LEAST_RIM_SPEED} if "turning" in expression.names else {}
        changed: Floats = self._compute(expression, now, Omega=wheel, **extra)
        return changed


def _spread(drive: _Drive, context: RunContext, name: str, added: Floats) -> _Drive:
    """A drive with something added to the difference of its sides, its speed or its yaw rate."""
    if name == "f_x":
        both = added / context.vehicle.wheel_radius_m
        return replace(drive, left=drive.left + both, right=drive.right + both)
    half = 0.5 * added if name == "D" else added * _scale_turn(drive, context)
    return replace(drive, left=drive.left - half, right=drive.right + half)


def _parse_equations(
    effect: str,
    lines: tuple[str, ...],
    own: tuple[tuple[str, str], ...],
    given: tuple[tuple[str, float], ...] = (),
) -> Mapping[str, Expression]:
    """Right sides of equations by the signal that each changes, some parameters being given."""
    units = {name: parse_unit(unit, effect) for name, unit in (*SIGNALS.items(), *own)}
    equations = {}
    for line in lines:
        if (match := _EQUATION.fullmatch(line)) is None or match[1] not in units:
            hint = f"Write for example v_y += c * v0; there are: {', '.join(SIGNALS)}."
            raise MotionError("bad_formula", f"{line!r} changes no signal", where=effect, hint=hint)
        name = match[1]
        asked = re.sub(r"\bu\b", name, match[3])
        equations[name] = parse_expression(asked, units, effect, dict(given))
        if equations[name].unit != units[name]:
            what = f"{line!r} is in {equations[name].unit}, not in {units[name]}"
            hint = "Correct the formula or the unit of a parameter."
            raise MotionError("wrong_units", what, where=effect, hint=hint)
    return equations


class _WrittenCommand(Written, CommandEffect):
    def change_commands(self, commands: Commands, context: RunContext) -> Commands:
        """See the formula."""
        return commands if self.is_neutral else self._change_drive(commands, context)


class Delay(Written, CommandEffect):
    """Commands that take effect after a dead time, ``Omega(t) = u(t - d)``."""

    def change_commands(self, commands: Commands, context: RunContext) -> Commands:
        """See the formula."""
        return replace(commands, times=commands.times + self.delay)


class _WrittenDrive(Written, DriveEffect):
    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula."""
        return wheels if self.is_neutral else self._change_drive(wheels, context)


class _WrittenRolling(Written, KinematicEffect):
    def roll(self, rolling: Rolling, context: RunContext) -> Rolling:
        """See the formula."""
        if self.is_neutral:
            return rolling
        now, equations = _Now(context, rolling.wheels, rolling), self.list_equations(context.vehicle.kind)
        return replace(rolling, **{name: self._compute(one, now) for name, one in equations.items()})


class _WrittenTerm(Written, LinearEffect):
    adds = True

    @classmethod
    @functools.cache
    def list_slopes(cls) -> Mapping[str, Mapping[str, Expression]]:
        """Derivatives of the formula by each parameter, by the signal that changes."""
        own = tuple((p.name, p.unit) for p in cls.parameters)
        whole, slopes = _parse_equations(cls.id, cls.formula[""], own), {}
        for name, _ in own:
            given = tuple((other, float(other == name)) for other, _ in own)
            parts = _parse_equations(cls.id, cls.formula[""], own, given)
            slopes[name] = {channel: one for channel, one in parts.items() if name in whole[channel].names}
        return slopes

    def columns(self, rolling: Rolling, velocity: Velocity, context: RunContext) -> Mapping[str, Column]:
        """See `LinearEffect`: the derivatives of the formula."""
        now = _Now(context, rolling.wheels, rolling, velocity)
        slopes = {
            name: {channel: self._compute(one, now) for channel, one in parts.items()}
            for name, parts in self.list_slopes().items()
        }
        return {name: (s.get("v_x", 0.0), s.get("v_y", 0.0), s.get("v_w", 0.0)) for name, s in slopes.items()}


class _WrittenReport(Written, ReportEffect):
    def report(self, velocity: Velocity, context: RunContext) -> Velocity:
        """See the formula."""
        if self.is_neutral:
            return velocity
        now, equations = _Now(context, velocity=velocity), self.list_equations("")
        return replace(velocity, **{name[-1]: self._compute(one, now) for name, one in equations.items()})


# Start of a state from that of the wheels: columns left, right, sideways, steering.
_STARTS: Final[Mapping[str, Callable[[Floats], Floats]]] = {
    "left": lambda known: known[:, 0],
    "right": lambda known: known[:, 1],
    "sideways": lambda known: known[:, 2],
    "delta": lambda known: known[:, 3],
    "M": lambda known: 0.5 * (known[:, 0] + known[:, 1]),
    "D": lambda known: known[:, 1] - known[:, 0],
}


class Lag(Written, DriveEffect):
    """Signals of the drive that follow what is asked, ``tau * dOmega/dt = u - Omega``."""

    has_state = True

    @classmethod
    @functools.cache
    def list_lags(cls) -> list[tuple[str, str]]:
        """Time constants, and the signal that each delays: all sides of Omega, what moves sideways with M."""
        pairs = [(match[1], match[2]) for line in cls.formula[""] if (match := _LAG.fullmatch(line))]
        parts = {"Omega": ("left", "right", "sideways"), "M": ("M", "sideways")}
        return [(tau, signal) for tau, whole in pairs for signal in parts.get(whole, (whole,))]

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula."""
        if self.is_neutral:
            return wheels
        lagged: dict[str, Any] = {}
        for tau, name in self.list_lags():
            signal = (
                0.5 * (wheels.left + wheels.right)
                if name == "M"
                else _SIGNALS[name][1](_Now(context, wheels))
            )
            if signal is not None:
                resets = context.spans if name == "delta" else context.wheels
                start = _STARTS[name](resets.start)
                lagged[name] = lag_signal(signal, self.values[tau], context.step_s, resets, start)
        if "M" in lagged:
            mean, half = lagged.pop("M"), 0.5 * lagged.pop("D")
            lagged |= {"left": mean - half, "right": mean + half}
        if "delta" in lagged:
            lagged["steering"] = lagged.pop("delta")
        return replace(wheels, **lagged)


Walk = Callable[[Mapping[str, float], Floats, float, Resets, Floats], Floats]


class Filtered(Written, DriveEffect):
    """A signal of the drive after a filter of its own.

    Attributes:
        signal: ``Omega`` for each wheel, ``delta``, or ``M`` and ``D`` with their limits as f_x and f_w.
        walk: the filter: parameters by name, signal on cells, width of a cell [s], resets and state there.
    """

    has_state = True
    signal: str = "Omega"
    walk: Walk

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula."""
        if self.is_neutral:
            return wheels
        walk, step = type(self).walk, context.step_s
        if self.signal == "delta":
            spans = context.spans
            return replace(
                wheels, steering=walk(self.values, wheels.steering, step, spans, spans.start[:, 3])
            )
        return wheels.change_each_wheel(
            lambda speed, resets, start: walk(self.values, speed, step, resets, start), context
        )


class Ramp(Filtered):
    """A signal of the drive whose rate is limited, ``abs(dOmega/dt) <= limit``."""

    @staticmethod
    def walk(
        values: Mapping[str, float], signal: Floats, step_s: float, resets: Resets, start: Floats
    ) -> Floats:
        """See `limit_rate`."""
        return limit_rate(signal, values["limit"], step_s, resets, start)

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula."""
        if self.is_neutral or self.signal in {"Omega", "delta"}:
            ramped = super().drive_wheels(wheels, context)
            return ramped if self.is_neutral or self.signal == "delta" else replace(ramped, idle=None)
        now, name = _Now(context, wheels), "M" if self.signal == "f_x" else "D"
        asked = 0.5 * (wheels.left + wheels.right) if name == "M" else _SIGNALS["D"][1](now)
        limit = (
            self.values["limit"] * (1.0 if name == "M" else context.track_m) / context.vehicle.wheel_radius_m
        )
        start = _STARTS[name](context.wheels.start)
        added = limit_rate(asked, limit, context.step_s, context.wheels, start) - asked
        if name == "M":
            return replace(wheels, left=wheels.left + added, right=wheels.right + added, idle=None)
        return replace(_spread(wheels, context, "D", added), idle=None)


def declare(
    name: str,
    page: str | None,
    formula: str | Mapping[str, str],
    *own: Parameter,
    walk: Walk | None = None,
    **facts: Any,  # noqa: ANN401 - whatever an effect has
) -> Any:  # noqa: ANN401 - a class that has what it declares
    """An effect: the class of that id, whose physics, page and export come from its formula.

    Args:
        name: id of the effect.
        page: what happens in one line; then parameters, and the source.
        formula: lines of equations of `SIGNALS` and parameters. ``v_y += c * turning`` adds a term to the
            body velocity, linear in its parameters; ``w0 = w0 / k`` changes a signal; ``tau * dOmega/dt = u -
            Omega`` is a lag, ``abs(dOmega/dt) <= limit`` a ramp and ``Omega(t) = u(t - d)`` a dead time. A
            mapping has the lines by kind of vehicle, the empty kind for all others.
        own: parameters.
        walk: the filter of an effect of the drive, see `Filtered`; its formula is any text that says what it
            does.
        facts: further attributes of `Effect`, and methods that take the place of its own.

    Raises:
        MotionError: ``unknown_fact``. The formula is read when it is needed, see `check_formula`.
    """
    lines = {
        kind: tuple(line.strip() for line in text.strip().splitlines())
        for kind, text in ({"": formula} if isinstance(formula, str) else formula).items()
    }
    first = lines[""][0]
    base, said = _choose_family(first, facts) if walk is None else (Filtered, {"walk": staticmethod(walk)})
    if missing := [fact for fact in facts if not hasattr(base, fact)]:
        what = f"an effect has no fact {missing[0]!r}"
        raise MotionError("unknown_fact", what, where=name, hint="See the attributes of Effect.")
    title = "".join(part.capitalize() for part in name.split("_"))
    made: Any = type(
        title,
        (base,),
        {
            "__module__": sys._getframe(1).f_globals["__name__"],  # noqa: SLF001 - as namedtuple does
            "__doc__": page,
            "id": name,
            "about": inspect.cleandoc(page or name),
            "formula": lines,
            "parameters": own,
            **said,
            **facts,
        },
    )
    return made


def _choose_family(first: str, facts: Mapping[str, Any]) -> tuple[type[Written], dict[str, Any]]:
    """Class of an effect by the first line of its formula, and what that line says of it."""
    if _DELAY.fullmatch(first):
        return Delay, {}
    if _LAG.fullmatch(first):
        return Lag, {}
    if ramp := _RAMP.fullmatch(first):
        return Ramp, {"signal": ramp[1]}
    channel, sign = (match[1], match[2]) if (match := _EQUATION.fullmatch(first)) else ("", "")
    if sign == "+=":
        return _WrittenTerm, {}
    stage = facts.get("place", _PLACES.get(channel, Place.LOCALIZATION))
    families: dict[Place, type[Written]] = {
        Place.COMMAND: _WrittenCommand,
        Place.DRIVE: _WrittenDrive,
        Place.KINEMATICS: _WrittenRolling,
        Place.LOCALIZATION: _WrittenReport,
    }
    return families[stage], {}


def check_formula(made: type[Effect]) -> None:
    """Refuse a formula that cannot be; one that is not declared, a lag and a filter pass.

    Raises:
        MotionError: ``bad_formula``, ``unknown_signal``, ``wrong_units``; ``not_neutral``, it changes
            something at the neutral values; ``not_linear``, a term is not linear in its parameters.
    """
    if not issubclass(made, Written) or issubclass(made, Delay | Lag | Filtered):
        return
    generator = np.random.default_rng(1)
    signals = {name: generator.uniform(0.1, 1.0) for name in SIGNALS} | {"e_m": 0.0}
    neutral = {p.name: 0.0 if np.isnan(p.neutral) else p.neutral for p in made.parameters}
    other = {p.name: generator.uniform(0.1, 1.0) for p in made.parameters}
    equations = [item for kind in made.formula for item in made.list_equations(kind).items()]
    for name, expression in equations:
        result, once, twice = (
            float(expression.evaluate({**signals, **values}))
            for values in (neutral, other, {key: 2.0 * value for key, value in other.items()})
        )
        if not np.isclose(result, 0.0 if made.adds else signals[name]):
            what = f"{name} = {expression.text!r} changes it at the parameters' neutral values"
            hint = "Correct the formula or a neutral value."
            raise MotionError("not_neutral", what, where=made.id, hint=hint)
        if made.adds and not np.isclose(twice, 2.0 * once):
            what = f"{name} += {expression.text!r} is not linear in its parameters"
            hint = "Write a sum of parameters times signals, or a formula of a model file."
            raise MotionError("not_linear", what, where=made.id, hint=hint)


def list_terms(effect: type[Effect]) -> Mapping[str, str]:
    """What an effect adds to v_x, v_y and v_w as formulas; empty for one that is no sum of terms."""
    equations = effect.list_equations("") if issubclass(effect, Written) and effect.adds else {}
    return {channel: one.text.replace("^", "**") for channel, one in equations.items()}


# Methods of effects that several have in common.

TIME_CONSTANT = Parameter(
    "tau",
    "s",
    (0.0, 10.0),
    0.0,
    "time constant",
    0.5,
    starts=(0.1, 0.3, 0.7, 1.4),
    step=5e-3,
    plausible=Plausible(0.0, 3.0, "as of a drive lag"),
)
"""Time constant of a generic first-order system; `replace` adds what is specific to an effect."""
LEAST_RAMP_S = 0.08
"""Shortest ramp of the largest step [s] that a limit must cause to be visible in the poses."""


def has_encoders(effect: Effect, conditions: Conditions) -> bool:
    """`Effect.can_show` of what only measured wheels tell from another effect."""
    return conditions.encoders


def has_timed_encoders(effect: Effect, conditions: Conditions) -> bool:
    """`Effect.can_show` of gains: in bursts only their product with the duration of one is known."""
    return conditions.encoders and not conditions.bursts


def has_speed(effect: Effect, conditions: Conditions) -> bool:
    """`Effect.can_show` of a factor on what the body does: in bursts their duration does the same."""
    return conditions.encoders or not conditions.bursts


def has_no_encoders(effect: Effect, conditions: Conditions) -> bool:
    """`Effect.is_equivalent` of what measured wheels tell from another effect."""
    return not conditions.encoders


def is_one_motion(effect: Effect, conditions: Conditions) -> bool:
    """`Effect.is_equivalent` of lags: encoders tell wheel from body, without them driving and turning do."""
    return not (conditions.encoders or conditions.largest.moves_both_ways)


def never_reached(effect: Effect, conditions: Conditions) -> bool:
    """`Effect.is_degenerate` of a limit that no command reaches."""
    (limit,) = effect.parameters
    return not conditions.largest.reaches(effect.values[limit.name], limit.relative_to)


def never_attained(effect: Effect, conditions: Conditions) -> bool:
    """`Effect.is_degenerate` of a limit that no wheel reaches."""
    (limit,) = effect.parameters
    return not conditions.attain(effect.values[limit.name], limit.relative_to)


def find_least_ramp(conditions: Conditions) -> float:
    """Shortest ramp [s] that poses and wheels show: a ramp delays the wheels by half of its duration."""
    return max(LEAST_RAMP_S, 2.0 * conditions.least_delay_s)


def is_short(of: str) -> Callable[[Effect, Conditions], bool]:
    """`Effect.is_degenerate` of a ramp that reaches the largest ``speed``, ``turn`` or ``wheel`` at once."""
    return lambda effect, conditions: (
        not effect.values["limit"] * find_least_ramp(conditions) < getattr(conditions.largest, of)
    )


def take_largest(of: str) -> Callable[[Effect, Largest], dict[str, float]]:
    """`Effect.list_usual` of a ramp: it takes a second to the largest value."""
    return lambda _effect, largest: {"limit": getattr(largest, of)}
