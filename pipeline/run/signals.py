"""Signals from commands to motion: commands, wheels, rolling and velocity, and their context.

Commands have their own stamps. All later signals are on cells: short intervals of equal length with the mean
of the signal, so that held commands are exact for any stamp. Cells are grouped in spans; between spans the
recording has a gap. From the last cells it is judged whether wheels dig in or spin, or the body slides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pipeline.sources import Vehicle

    Drive: TypeAlias = "DriveSeries | Wheels"
    ChangeWheel: TypeAlias = "Callable[[Floats, Resets, Floats], Floats]"


Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Integers = NDArray[np.int64]
AnyDrive = TypeVar("AnyDrive", "Commands", "Wheels")
Signal = TypeVar("Signal", NDArray[np.float64], NDArray[np.complex128])

_STEPS = 2.0**20
"""Steps of a second, a metre, a radian: a millionth is less than any sensor resolves, and a million times
the rounding of positions in a map."""
GROUND_UNOBSERVABLE = "ground_unobservable"
"""The finding of a run whose log holds no pose: the motion of its wheels stands in for it."""
IN_BURSTS = "commands_in_bursts"
"""The finding of a run whose base stops before its next command, and was taken to be as fast as commanded."""
STILL = 1e-6
"""[rad/s] of wheels at rest: above the rounding of sums."""
_OFF_TIE = 0.37
"""Share of a step added before rounding down: with a half, values of few digits might go either way."""


def round_off(values: Floats) -> Floats:
    """Values in steps of a millionth: what differs by the rounding of sums alone becomes equal."""
    rounded: Floats = np.floor(values * _STEPS + _OFF_TIE) / _STEPS
    return rounded


@dataclass(frozen=True)
class DriveSeries:
    """Commanded or measured wheel speeds at stamps.

    Attributes:
        times: stamps [s], increasing, shape (n,).
        left, right: wheel speeds [rad/s]; on a car both are the rear axle's, shape (n,).
        steering: steering angle [rad], left positive; zero on a differential vehicle, shape (n,).
        sideways: speed of the wheels that moves the vehicle to the left [rad/s], shape (n,); None on one that
            cannot move sideways.
    """

    times: Floats
    left: Floats
    right: Floats
    steering: Floats
    sideways: Floats | None = None

    @property
    def speed(self) -> Floats:
        """Magnitude of the wheels' mean speed [rad/s], above zero so that it can be a weight, shape (n,)."""
        return np.abs(0.5 * (self.left + self.right)) + STILL

    def change(self, times: Floats, change: Callable[[Floats], Floats]) -> DriveSeries:
        """The series at other stamps, with the same change of each signal."""
        sideways = None if self.sideways is None else change(self.sideways)
        return DriveSeries(times, change(self.left), change(self.right), change(self.steering), sideways)


class Commands(DriveSeries):
    """Held commands: each value applies from its stamp to the next."""


@dataclass(frozen=True)
class Wheels:
    """Output of the drivetrain on cells.

    Attributes:
        left, right: wheel speeds [rad/s], shape (n,).
        steering: steering angle [rad], shape (n,).
        sideways: speed of the wheels that moves the vehicle to the left [rad/s], shape (n,); None on one that
            cannot move sideways.
        idle: share of each cell in which no motion is commanded, shape (n,); None if the commands
            are not known by their stamps.
        imbalance: voltage of the right motor minus that of the left one, over their mean.
    """

    left: Floats
    right: Floats
    steering: Floats
    sideways: Floats | None = None
    idle: Floats | None = None
    imbalance: float = 0.0

    def stack(self) -> Floats:
        """Columns left, right and sideways [rad/s], and steering [rad], shape (n, 4)."""
        sideways = np.zeros_like(self.left) if self.sideways is None else self.sideways
        return np.column_stack((self.left, self.right, sideways, self.steering))

    def change_each_wheel(self, change: ChangeWheel, context: RunContext) -> Wheels:
        """The output with the speed of every wheel changed, each from its own state.

        Four wheels may also turn against each other. That moves nothing, and measured sides do not show it:
        predictions take it over from a run without resets.

        Args:
            change: function of the speed of a wheel, shape (n,), resets, and its state at each, shape (k,).
            context: of the run; of its resets, left, right and sideways are the states.
        """
        asked, resets = split_wheels(self), context.wheels
        left, right, sideways = resets.start[:, :3].T
        states = split_wheels(Wheels(left, right, np.zeros(0), None if self.sideways is None else sideways))
        if self.sideways is not None and resets is not context.spans:
            free = [change(wheel, context.spans, context.spans.start[:, 0]) for wheel in asked]
            against = 0.25 * (free[0] + free[1] - free[2] - free[3])[np.maximum(resets.at - 1, 0)]
            states = [state + sign * against for state, sign in zip(states, (1, 1, -1, -1), strict=True)]
        changed = [change(wheel, resets, state) for wheel, state in zip(asked, states, strict=True)]
        return replace(self, **_join_wheels(changed))


def split_wheels(drive: Drive) -> list[Floats]:
    """Speeds of the wheels [rad/s]: left, right; or front left, front right, rear left, rear right."""
    left, right, sideways = drive.left, drive.right, drive.sideways
    if sideways is None:
        return [left, right]
    return [left - sideways, right + sideways, left + sideways, right - sideways]


def _join_wheels(wheels: Sequence[Floats]) -> dict[str, Any]:
    """Inverse of `split_wheels`, by name; the combination of four wheels without motion is dropped."""
    if len(wheels) == 2:  # noqa: PLR2004 - one a side
        return {"left": wheels[0], "right": wheels[1]}
    front_left, front_right, rear_left, rear_right = wheels
    return {
        "left": 0.5 * (front_left + rear_left),
        "right": 0.5 * (front_right + rear_right),
        "sideways": 0.25 * (front_right - front_left + rear_left - rear_right),
    }


def change_wheels(drive: AnyDrive, change: Callable[[Floats], Floats]) -> AnyDrive:
    """A drive with the speed of every wheel changed by a function without a state."""
    return replace(drive, **_join_wheels([change(wheel) for wheel in split_wheels(drive)]))


def find_fastest_wheel(drive: Drive) -> Floats:
    """Absolute speed of the fastest wheel [rad/s], shape (n,)."""
    fastest: Floats = np.maximum(np.abs(drive.left), np.abs(drive.right))
    return fastest if drive.sideways is None else fastest + np.abs(drive.sideways)


@dataclass(frozen=True)
class Rolling:
    """Body velocity before the ground acts, on cells.

    Attributes:
        v0: forward [m/s], shape (n,).
        w0: yaw rate [rad/s], shape (n,).
        wheels: output of the drivetrain from which it is computed.
        s0: to the left [m/s], shape (n,); scalar zero for a vehicle that cannot move sideways.
    """

    v0: Floats
    w0: Floats
    wheels: Wheels
    s0: Floats | float = 0.0

    @property
    def velocity(self) -> Velocity:
        """The rolling velocity as a velocity of the body."""
        aside = np.zeros_like(self.v0)
        if not isinstance(self.s0, float) or self.s0 != 0.0:
            aside += self.s0
        return Velocity(self.v0, aside, self.w0)

    def scale(self, along: Floats | float, turning: Floats | float) -> Rolling:
        """Rolling with the speed in every direction and the yaw rate multiplied."""
        return Rolling(self.v0 * along, self.w0 * turning, self.wheels, self.s0 * along)


@dataclass(frozen=True)
class Velocity:
    """Body velocity on cells: x [m/s], y [m/s], w [rad/s], each of shape (n,)."""

    x: Floats
    y: Floats
    w: Floats

    def add(
        self,
        x: Floats | float | None = None,
        y: Floats | float | None = None,
        w: Floats | float | None = None,
    ) -> Velocity:
        """Velocity with an addition; None leaves a channel unchanged."""
        return Velocity(
            self.x if x is None else self.x + x,
            self.y if y is None else self.y + y,
            self.w if w is None else self.w + w,
        )


@dataclass(frozen=True)
class Resets:
    """Resets of internal states, and their start values.

    Attributes:
        number: number of the last reset before each cell, shape (n,).
        first: first cell after each reset, into which no state is carried over, shape (k,).
        at: cell before which the state is set, shape (k,).
        start: state, one column per signal; NaN for the value of the input, shape (k, m).
    """

    number: Integers
    first: Integers
    at: Integers
    start: Floats


@dataclass(frozen=True)
class RunContext:
    """Data of a run that an effect may use besides the signal it acts on.

    Attributes:
        vehicle: geometry.
        times: middles of the cells [s], shape (n,).
        start_s: start of the driving [s].
        step_s: width of a cell [s].
        duration_s: length of the driving, pauses included [s].
        spans: resets at the starts of spans, with the same columns.
        wheels: resets with known output of the drivetrain: columns of `Wheels.stack`.
        body: resets with known body velocity: (v_x, v_y, v_w).
        attitude: roll, pitch, yaw as reported [rad], shape (n, 3).
        position: x, y as reported [m], shape (n, 2).
    """

    vehicle: Vehicle
    times: Floats
    start_s: float
    step_s: float
    duration_s: float
    spans: Resets
    wheels: Resets
    body: Resets
    attitude: Floats
    position: Floats

    @property
    def downhill(self) -> tuple[Floats, Floats]:
        """Direction of gravity in the body's frame: ahead and to the left [1], each of shape (n,)."""
        roll, pitch = self.attitude[:, 0], self.attitude[:, 1]
        return np.sin(pitch), -np.cos(pitch) * np.sin(roll)

    @property
    def slope_rad(self) -> float:
        """Half of the range of pitch in the central nine tenths of its values [rad]."""
        low, high = np.quantile(self.attitude[:, 1], (0.05, 0.95))
        return 0.5 * float(high - low)

    @property
    def track_m(self) -> float:
        """Nominal track width of a difference between the sides [m]; 1 if there is none."""
        return self.vehicle.kinematics.turning_width_m(self.vehicle)


STILL_MPS = 0.02
"""Speed [m/s] below which a wheel or vehicle is at rest: encoder rounding, wheels wound up by a motor,
drifting poses; half and double change no finding of two recordings."""
MOVING_MPS = 0.1
"""Speed [m/s] above which a vehicle moves, and its velocity has a direction and can be a divisor: 4 mm of
noise over 0.75 s are 5 % of it."""
LIVE_SHARE = 0.1
"""Share of the usual largest speed above which a side turns and its sign and ratios are significant: a lower
speed may be noise, friction or drift of the poses."""
ANSWERS_S = 2.0
"""Time [s] in which a drive follows a command: longer than dead times and pauses; with a lag of 1.2 s, 19 %
of a step remain after it."""
HORIZON_S = 2.0
"""Length of a prediction [s] by which models are judged, as those of Samson et al. 2024 and of planners."""
SPAN_S = 0.5
"""Span of the displacements that models are compared by [s]: the noise of poses is a larger share of shorter
ones, and longer ones are less sensitive to lags. None fits into a shorter stretch or bridges a longer gap."""
LEAST_RIM_SPEED = 0.01
"""Speed of the fastest rim [m/s] above which effects of driving act."""


def find_turning(wheels: Wheels, context: RunContext) -> Floats:
    """One where the wheels turn, zero where they are at rest, shape (n,)."""
    rim = context.vehicle.wheel_radius_m * find_fastest_wheel(wheels)
    return (rim > LEAST_RIM_SPEED).astype(np.float64)


def name_inputs(drive: Drive, vehicle: Vehicle) -> dict[str, Floats]:
    """Signals of a drive by their names in the kinematics."""
    named = {"left": drive.left, "right": drive.right, "steering": drive.steering}
    if vehicle.kinematics.has_inputs("speed"):
        named["speed"] = 0.5 * vehicle.wheel_radius_m * (drive.left + drive.right)
    return named if drive.sideways is None else named | {"sideways": drive.sideways}


def roll_ideally(wheels: Wheels, context: RunContext) -> Rolling:
    """Ideal velocity of the drivetrain's output, without the sideways motion of a lever arm."""
    vehicle = context.vehicle
    forward, sideways, turning = vehicle.kinematics.forward(name_inputs(wheels, vehicle), vehicle)
    return Rolling(forward, turning, wheels, 0.0 if wheels.sideways is None else sideways)


def earlier_in_span(context: RunContext, late: float) -> Flags:
    """Whether the time ``late`` seconds before each cell (after it, if negative) lies in the same span."""
    spans = context.spans
    last = np.append(spans.first[1:], context.times.size) - 1
    at = context.times - late
    inside: Flags = (at >= context.times[spans.first][spans.number]) & (
        at <= context.times[last][spans.number]
    )
    return inside


# The rule is causal: it uses past and present samples only. The same source is exported for robots
# (`export/data_formats.py`). Ratios refer to the usual speed of the body at given wheel speeds on
# this terrain: deep snow that always takes half of it is no event. Turns are excluded, because skid-steered
# vehicles always slip in turns.


@dataclass(frozen=True)
class Limits:
    """Thresholds of `trace_traction`; `make bench NAME=events` measures misses, false alarms, lead times.

    Attributes:
        live: usual body speed above which traction is judged [m/s].
        margin: speed of a sliding body above `excess` times its wheels [m/s]; half of it is detected later.
        window_s: duration of steady wheel speed before body and wheels are compared [s]: lags have decayed.
        steady: maximum relative change of wheel speed in this window [1].
        falls_s: minimum age of the ratios of body to wheel speed with which the present one is compared [s];
            the maximum age is three times as long.
        drop: decrease of this ratio in that time when wheels dig in [1].
        half: ratio below which wheels dig in [1].
        lost: ratio below which wheels spin, with or without a decrease [1].
        excess: minimum ratio of a sliding body [1]; with steady wheels, a larger one is a jump of the poses.
        dig_hold_s: duration of the loss after which digging in is reported [s].
        sudden_s: longest time with a ratio below `lost` when wheels dig in [s]; above it, they broke loose.
        hold_s: duration of spinning or sliding after which it is reported [s].
    """

    live: float
    margin: float
    window_s: float = 1.0
    steady: float = 0.3
    falls_s: float = 3.0
    drop: float = 0.3
    half: float = 0.5
    lost: float = 0.3
    excess: float = 1.5
    dig_hold_s: float = 1.0
    sudden_s: float = 0.6
    hold_s: float = 1.5


LEAST_SHARE = 0.125
"""Share of the usual largest speed above which traction is judged. Also the minimum gain by which a limit is
divided."""
MARGIN_SHARE = 0.25
"""`Limits.margin` as a share of the usual largest speed: lags and drifting poses stay below it."""


def find_limits(top: float, gain: float) -> Limits:
    """Thresholds for a vehicle.

    Args:
        top: usual largest speed [m/s].
        gain: usual ratio of body to wheel speed, forward.
    """
    # A body that is faster than usual, but not faster than its wheels, has better traction.
    excess = Limits.excess / min(max(gain, LEAST_SHARE), 1.0)
    return Limits(LEAST_SHARE * top, MARGIN_SHARE * top, excess=excess)


def trace_traction(
    wheels: Sequence[float],
    turning: Sequence[float],
    body: Sequence[float],
    step_s: float,
    *,
    live: float,
    margin: float,
    window_s: float,
    steady: float,
    falls_s: float,
    drop: float,
    half: float,
    lost: float,
    excess: float,
    dig_hold_s: float,
    sudden_s: float,
    hold_s: float,
) -> list[int]:
    """State of the wheels at every step: 0 drive, 1 dig in, 2 spin, 3 slide.

    Args:
        wheels: forward speed of the body that is usual at the wheel speeds [m/s].
        turning: rim speed due to turning, half the track times the yaw rate from the wheels [m/s].
        body: forward speed of the body, with sideways motion up to the speed of the wheels [m/s].
        step_s: time step [s].
        live: usual body speed above which traction is judged [m/s].
        margin: speed of a sliding body above `excess` times its wheels [m/s]; half of it is detected later.
        window_s: duration of steady wheel speed before body and wheels are compared [s].
        steady: maximum relative change of wheel speed in this window.
        falls_s: minimum age of the ratios of body to wheel speed with which the present one is compared [s];
            the maximum age is three times as long.
        drop: decrease of this ratio when wheels dig in.
        half: ratio below which wheels dig in.
        lost: ratio below which they spin.
        excess: minimum ratio of a sliding body.
        dig_hold_s: duration of the loss after which digging in is reported [s].
        sudden_s: longest time with a ratio below `lost` when wheels dig in [s]; above it, they broke loose.
        hold_s: duration of spinning or sliding after which it is reported [s].
    """
    window, falls = round(window_s / step_s), round(falls_s / step_s)
    codes, shares = [], []
    compared = digs = spins = 0
    slid = 0.0
    share = 1.0
    surge = -falls - 1
    for now in range(len(wheels)):
        recent = wheels[max(now - window, 0) : now + 1]
        slowest, fastest = min(recent), max(recent)
        forward = 1.0 if slowest > 0.0 else -1.0
        if forward < 0.0:
            slowest, fastest = -fastest, -slowest
        is_straight = abs(turning[now]) < abs(wheels[now])
        compared = compared + 1 if slowest > live and is_straight else 0
        # While the wheel speed changes, the last ratio remains valid.
        is_steady = not compared or fastest - slowest < steady * fastest
        if is_steady:
            share = forward * body[now] / slowest if compared else 1.0
        if share > excess:
            surge = now
        # Poses that jumped ahead of the wheels then stand still until the wheels have caught up.
        share = share if now - surge > falls else 1.0
        shares.append(share)
        earlier = shares[max(now - compared + 1, now - 3 * falls) : now - falls]
        before = max(earlier) if earlier else share
        digs = digs + 1 if share < half and before - share > drop else 0
        spins = spins + is_steady if share < lost else 0
        most = max(abs(slowest), abs(fastest))
        # Page's CUSUM with bounded steps: a sliding body that slows down is still detected, and a jump of the
        # poses has no more weight than its duration.
        faster = 2.0 * (abs(body[now]) - excess * most) - margin
        slid = max(slid + min(faster, margin) * step_s, 0.0)
        if spins * step_s > hold_s:
            codes.append(2)
        elif is_steady and digs * step_s > dig_hold_s and spins * step_s <= sudden_s:
            codes.append(1)
        elif faster > 0.0 and slid > margin * hold_s:
            codes.append(3)
        else:
            codes.append(0)
    return codes
