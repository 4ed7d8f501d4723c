"""What a robot does per command at several speeds: factors for a simulator, and multipliers per speed.

The fitted model is driven by a constant command until its motion is steady. A factor is that motion over the
command; of a simulator's own export, given as the current parameters, it is the robot's over the simulator's.
"""

import math
from collections.abc import Sequence

import msgspec
import numpy as np
import yaml

from pipeline.core import Floats
from pipeline.export import DRIVEN_SPEED, DRIVEN_TURN, Amount, Current, Facts, Target, start_table, write_yaml
from pipeline.models import Effect, ForwardModel, ModelFile, Place, Quantity, Timing
from pipeline.run import DriveSeries, Grid, MotionError, Resets, RunContext
from pipeline.sources import Vehicle

_SPEEDS = 4
"""Number of speeds: quarters of the largest driven one show a factor that falls or rises with speed."""
_STEADY_S = 20.0
"""Time until the motion counts as steady [s]: twenty times the longest lag that vehicles have."""
_STEP_S = 0.02
"""Step of the model [s], that of its fits."""
_USUAL_TOP = (1.0, 0.5)
"""Speed [m/s] and yaw rate [rad/s] if neither the fit nor the vehicle gives the largest ones."""
_SAME = 0.01
"""Spread of a factor over the speeds that one value still fits: the tolerance of data sheets."""


def find_steady_motion(
    vehicle: Vehicle, effects: Sequence[Effect], speed: float, turn: float
) -> tuple[float, float]:
    """Speed [m/s] and yaw rate [rad/s] of a vehicle under a constant body command.

    Args:
        vehicle: geometry.
        effects: effects of the model; those of the localization are left out.
        speed: commanded speed [m/s].
        turn: commanded yaw rate [rad/s].
    """
    count = round(_STEADY_S / _STEP_S)
    times: Floats = (np.arange(count, dtype=np.float64) + 0.5) * _STEP_S
    zero = np.zeros(1, dtype=np.int64)
    grid = Grid(_STEP_S, times, np.zeros(count, dtype=np.int64), zero, np.zeros(1), np.array((_STEADY_S,)))
    context = RunContext(
        vehicle=vehicle, times=times, start_s=0.0, step_s=_STEP_S, duration_s=_STEADY_S,
        spans=_reset(count, 4), wheels=_reset(count, 4), body=_reset(count, 3),
        attitude=np.zeros((count, 3)), position=np.zeros((count, 2)),
    )  # fmt: skip
    body = (np.array((speed,)), np.zeros(1), np.array((turn,)))
    inputs = {name: float(value[0]) for name, value in vehicle.kinematics.inverse(body, vehicle).items()}
    own = inputs.get("speed", 0.0) / vehicle.wheel_radius_m
    stamps = np.arange(0.0, _STEADY_S, 0.05)

    def hold(value: float) -> Floats:
        return np.full(stamps.size, value)

    series = DriveSeries(
        stamps,
        hold(inputs.get("left", own)),
        hold(inputs.get("right", own)),
        hold(inputs.get("steering", 0.0)),
        hold(inputs["sideways"]) if "sideways" in inputs else None,
    )
    forward = ForwardModel(series, grid, context, encoders=None, has_gyro=False)
    acting = [effect for effect in effects if effect.place is not Place.LOCALIZATION]
    moved = forward.run_commands(acting, Timing())
    return float(moved.x[-1]), float(moved.w[-1])


def _reset(count: int, signals: int) -> Resets:
    """A run that begins once, at rest or with its first input."""
    zero = np.zeros(1, dtype=np.int64)
    return Resets(np.zeros(count, dtype=np.int64), zero, zero, np.full((1, signals), math.nan))


class Response:
    """Factors of a model: its steady motion over the command, at quarters of the largest driven speed.

    Attributes:
        speeds: commanded speeds [m/s], shape (n,).
        turn: commanded yaw rate at which turning is judged [rad/s].
        linear: speed over its command when driving straight, shape (n,).
        angular: yaw rate over its command at these speeds, shape (n,).
    """

    def __init__(self, facts: Facts, effects: Sequence[Effect] | None = None) -> None:
        vehicle, known = facts.vehicle, facts.file.model.effects if effects is None else effects
        driven = facts.file.list_fitted("runs")
        top, turn = (
            max(
                (value for row in driven if isinstance(value := row.get(key), float) and value > 0.0),
                default=0.0,
            )
            for key in (DRIVEN_SPEED, DRIVEN_TURN)
        )
        top = top or vehicle.max_speed_mps or _USUAL_TOP[0]
        self.turn = 0.5 * (turn or _USUAL_TOP[1])
        self.speeds = np.array([float(f"{top * (n + 1) / _SPEEDS:.3g}") for n in range(_SPEEDS)])
        straight = [find_steady_motion(vehicle, known, speed, 0.0)[0] for speed in self.speeds.tolist()]
        curved = [
            find_steady_motion(vehicle, known, speed, self._limit(vehicle, speed))[1]
            for speed in self.speeds.tolist()
        ]
        self.linear = np.array(straight) / self.speeds
        self.angular = np.array(curved) / [self._limit(vehicle, speed) for speed in self.speeds.tolist()]

    def _limit(self, vehicle: Vehicle, speed: float) -> float:
        """Yaw rate at a speed: what the steering reaches at most."""
        if vehicle.kind != "ackermann":
            return self.turn
        steering = 0.5 * (vehicle.max_steering_rad or 0.5)
        return min(self.turn, speed * math.tan(steering) / (vehicle.wheelbase_m or 1.0))

    @property
    def separation(self) -> Floats:
        """`wheel_separation_multiplier` at each speed, once the radii are corrected by `linear`."""
        return _divide(self.linear, self.angular)


def _divide(values: Floats, by: Floats) -> Floats:
    """Ratios; infinite where the vehicle stands still or does not turn."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio: Floats = values / by
    return ratio


def describe_spread(facts: Facts) -> list[str]:
    """Multipliers per speed as lines of a comment, where one for all speeds does not fit; else empty."""
    response = Response(facts)
    own = facts.vehicle.controller_track_multiplier
    rows = {
        "wheel_separation_multiplier": own * response.separation,
        "wheel_radius_multiplier": response.linear,
    }
    lines = []
    for name, values in rows.items():
        if np.isfinite(values).all() and float(np.ptp(values)) > _SAME * float(np.abs(values).mean()):
            at = ", ".join(
                f"{value:.3f} at {speed:g} m/s"
                for value, speed in zip(values.tolist(), response.speeds.tolist(), strict=True)
            )
            lines.append(f"One {name} does not fit all speeds: {at}. As a table: --to simulator.")
    return lines


_NODE = "simulated_base.ros__parameters"
_FACTORS = ("linear_factor", "angular_factor")
_LATE = ("command_delay_s", "linear_lag_s", "angular_lag_s")


def write_simulator(file: ModelFile, current: Current) -> str:
    """Write the factors as YAML.

    Args:
        file: model fitted to the robot's logs, from commands.
        current: the same export of a model fitted to a log of the simulator; empty for an ideal simulator, in
            which the base follows its commands.

    Raises:
        MotionError: ``wrong_vehicle``.
    """
    facts, table = start_table(file, SIMULATOR, "differential", "ackermann", "mecanum", "omni")
    response = Response(facts)
    sources = _find_sources(facts, response)
    table.add_row(f"{_NODE}.speeds_mps", tuple(_cite(response.speeds, (("commanded speeds",), frozenset()))))
    of_simulator = "speeds_mps.0" in current
    whose = "robot over simulator" if of_simulator else "robot over command"
    for name, values in zip(_FACTORS, (response.linear, response.angular), strict=True):
        other = _interpolate(current, name, response.speeds)
        table.add_row(
            f"{_NODE}.{name}", tuple(_cite(_divide(values, other), sources)), f"steady motion, {whose}"
        )
    if facts.vehicle.kind == "differential":
        own = facts.vehicle.controller_track_multiplier * response.separation
        note = "for the robot's own controller: on top of radii that are multiplied by linear_factor"
        if not of_simulator:
            table.add_row(f"{_NODE}.wheel_separation_multiplier", tuple(_cite(own, sources)), note)
    lag = Quantity.STEERING_LAG if facts.vehicle.kind == "ackermann" else Quantity.TURN_LAG
    for name, quantity in zip(_LATE, (Quantity.COMMAND_DELAY, Quantity.SPEED_LAG, lag), strict=True):
        less = Amount(current.get(name, 0.0))
        late = facts.take(quantity).change(lambda robot, other: max(robot - other, 0.0), less)
        table.add(f"{_NODE}.{name}", late)
    return write_yaml(facts, table)


def _cite(values: Floats, sources: tuple[tuple[str, ...], frozenset[str]]) -> list[Amount]:
    return [Amount(value, *sources) for value in values.tolist()]


def _find_sources(facts: Facts, whole: Response) -> tuple[tuple[str, ...], frozenset[str]]:
    """Lines of the effects that change a factor by more than rounding, and their ids."""
    lines, ids = list[str](), set[str]()
    effects = facts.file.model.effects
    for effect in effects:
        less = Response(facts, [one for one in effects if one is not effect])
        pairs = ((less.linear, whole.linear), (less.angular, whole.angular))
        if not all(np.allclose(one, other, rtol=1e-4, equal_nan=True) for one, other in pairs):
            lines += facts.list_sources(effect)
            ids.add(effect.id)
    return (tuple(lines) or ("the ideal model: no effect of the model changes it",), frozenset(ids))


def _interpolate(current: Current, name: str, speeds: Floats) -> Floats:
    """Factors of the simulator at the robot's speeds; one without them."""
    if "speeds_mps.0" not in current:
        return np.ones(speeds.size)
    known = [(current[f"speeds_mps.{n}"], current[f"{name}.{n}"]) for n in range(_SPEEDS)]
    at, values = np.array(known).T
    factors: Floats = np.interp(speeds, at, values)
    return factors


_Row = tuple[float, float, float, float]


class _Factors(msgspec.Struct):
    """An export of a simulator, of as many speeds as this program writes."""

    speeds_mps: _Row
    linear_factor: _Row
    angular_factor: _Row
    command_delay_s: float = 0.0
    linear_lag_s: float = 0.0
    angular_lag_s: float = 0.0


def read_simulator(text: str) -> Current:
    """Read the factors of the simulator, as `--to simulator` wrote them from a model of its log.

    Raises:
        MotionError: ``parameters_unreadable``.
    """
    hint = "Give what `slip model export --to simulator` wrote from a model of the simulator's log."
    try:
        # Scalars as texts: the constructors of other types fail in ways of their own.
        tree = yaml.load(text, Loader=yaml.BaseLoader)  # noqa: S506 - the loader that makes texts only
        rows = msgspec.convert(tree["simulated_base"]["ros__parameters"], _Factors, strict=False)
    except (yaml.YAMLError, RecursionError, KeyError, TypeError, msgspec.ValidationError) as error:
        what = f"is not an export of a simulator: {' '.join(str(error).split())}"
        raise MotionError("parameters_unreadable", what, where="--current", hint=hint) from None
    speeds, factors = list(rows.speeds_mps), [*rows.linear_factor, *rows.angular_factor]
    if sorted(speeds) != speeds or min(factors) <= 0.0 or not np.isfinite([*speeds, *factors]).all():
        what = "its speeds must rise and its factors be above zero"
        raise MotionError("parameters_unreadable", what, where="--current", hint=hint)
    columns = {name: getattr(rows, name) for name in ("speeds_mps", *_FACTORS)}
    numbers = {f"{name}.{n}": column[n] for name, column in columns.items() for n in range(_SPEEDS)}
    return {**numbers, **{name: getattr(rows, name) for name in _LATE}}


SIMULATOR = Target(
    "simulator",
    "factors by speed, dead time and lags that make a simulated base follow commands as the robot does",
    "the handbook, Nav2 and simulators: no simulator declares such a node, apply them to its commands",
    write_simulator,
    corrects=(*(f"{name}.{n}" for name in ("speeds_mps", *_FACTORS) for n in range(_SPEEDS)), *_LATE),
    read_current=read_simulator,
)
