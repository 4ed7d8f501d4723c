"""Walks of the wheel servo through the cells of a run, several of them at once.

The formula is that of the effect; walks at once are those of `machine_code.deal_lanes`.
"""

import math
from collections.abc import Sequence

import numpy as np

from pipeline.core import LANES, Floats, Ints, compiled, deal_lanes

ROTATING = 0.7
"""Inertia of the rotating parts over that of the vehicle: the loss of nine Warthog runs on five grounds
together changes by 3 % from 0.3 to 3."""
_LENGTHWISE = 0.75
"""Squared distance of the contacts lengthwise over that across: that of a track 1.75 times as wide."""
_SLOW = 0.05
"""Speed [m/s] below which the rolling resistance fades: wheels that stop would chatter otherwise."""
_OBSERVED = 0.5
"""Share of a deviation of the wheels' difference at the start of a prediction that the integral part takes:
with 0.4 to 0.8 the errors of nine Warthog runs over 2 s are smallest."""

# Rows of what belongs to each walk: state, numbers in the order of `walk_each`, and what it has in a cell.
(
    _ON_LEFT, _ON_RIGHT, _AHEAD, _TURN, _PUSH_LEFT, _PUSH_RIGHT, _STEP_LEFT, _STEP_RIGHT, _STEP_V, _STEP_W,
    _GAIN, _RESET, _DRAG, _BOUND_LEFT, _BOUND_RIGHT, _ROLLING, _REST, _SCRUB, _ASIDE, _SLOPE,
    _LEFT, _RIGHT, _IDLE, _NEAR_LEFT, _NEAR_RIGHT, _GRIP_LEFT, _GRIP_RIGHT, _HELD_LEFT, _HELD_RIGHT,
    _GIVEN_LEFT, _GIVEN_RIGHT, _ASKED_LEFT, _ASKED_RIGHT, _FREE_LEFT, _FREE_RIGHT,
    _MEAN_LEFT, _MEAN_RIGHT, _MEAN_V, _MEAN_W, _PULL_LEFT, _PULL_RIGHT, _MOST_LEFT, _MOST_RIGHT,
) = (LANES * row for row in range(43))  # fmt: skip


def walk_each(
    numbers: Sequence[Floats], source: Sequence[int], asked: Floats, at: Ints, states: Floats, step_s: float
) -> Floats:
    """Cell means of the speeds of both sides [m/s] of several servos, shape (m, 2, n).

    Args:
        numbers: of each servo: proportional gain [1/s], integral gain [1/s^2], drag [m/s^2], largest push at
            rest of the left and the right side [m/s^2], squared slip over acceleration of rolling wheels
            [s^4/m^2] and of those at rest [s^2], inverse square of the largest acceleration [s^4/m^2], half
            the track width [m], and by how much the largest push falls with speed [1/s].
        source: index of the input of each servo.
        asked: inputs: commanded speeds of the left and right side [m/s], and the share of each cell without a
            command, shape (k, 3, n).
        at: cells before which the speeds of both sides are set, shape (e,); the first one is among them.
        states: for each input, these speeds and whether they are those at the start of a prediction,
            shape (k, 3, e).
        step_s: width of a cell [s].
    """
    rolled = np.empty((len(numbers), 2, asked.shape[2]))
    for first, lanes, count in deal_lanes(len(numbers)):
        inputs = np.array(source, dtype=np.int64)[lanes]
        rows = np.zeros((_MOST_RIGHT // LANES + 1, LANES))
        rows[_GAIN // LANES : _LEFT // LANES, : lanes.size] = np.transpose(numbers)[:, lanes]
        given = np.ascontiguousarray(states[inputs].transpose(2, 1, 0))
        _walk(asked, inputs, at, given, step_s, rows.ravel(), count, rolled[first:])
    return rolled


@compiled()
def _set_states(rows: Floats, lanes: int, states: Floats, event: int) -> None:
    """Set the speeds of both sides; the body moves along, as its slip is not measured."""
    aside = rows[_ASIDE]
    for k in range(lanes):
        new_left = states[event, 0, k] - rows[_ON_LEFT + k]
        new_right = states[event, 1, k] - rows[_ON_RIGHT + k]
        rows[_ON_LEFT + k], rows[_ON_RIGHT + k] = states[event, 0, k], states[event, 1, k]
        rows[_AHEAD + k] += 0.5 * (new_left + new_right)
        rows[_TURN + k] += 0.5 * (new_right - new_left) / (aside * (1.0 + _LENGTHWISE))
        # The integral part balances the friction at the measured difference of the wheels.
        held = 0.5 * _OBSERVED * rows[_GAIN + k] * (new_right - new_left) * states[event, 2, k]
        rows[_PUSH_LEFT + k] -= held
        rows[_PUSH_RIGHT + k] += held


@compiled()
def _grip(speed: float, slipped: float, rolling: float, rest: float, scrub: float) -> float:
    """Force of a side over its slip [1/s], from its speed and its squared slip in all directions."""
    return 0.5 / math.sqrt(slipped * scrub + (rolling * speed * speed + rest))


@compiled()
def _approach(rows: Floats, lanes: int, step_s: float) -> None:
    """Grip and resistance at the middle of a cell, if the state changes as in the last one."""
    inertia, aside = ROTATING / step_s, rows[_ASIDE]
    for k in range(lanes):
        driven, gain, drag = 1.0 - rows[_IDLE + k], rows[_GAIN + k], rows[_DRAG + k]
        near_left = rows[_ON_LEFT + k] + rows[_STEP_LEFT + k]
        near_right = rows[_ON_RIGHT + k] + rows[_STEP_RIGHT + k]
        near_v, near_w = rows[_AHEAD + k] + rows[_STEP_V + k], rows[_TURN + k] + rows[_STEP_W + k]
        across = _LENGTHWISE * (aside * near_w) ** 2
        slip_left, slip_right = near_left - near_v + aside * near_w, near_right - near_v - aside * near_w
        rolling, rest, scrub = rows[_ROLLING + k], rows[_REST + k], rows[_SCRUB + k]
        grip_left = _grip(near_left, slip_left * slip_left + across, rolling, rest, scrub)
        grip_right = _grip(near_right, slip_right * slip_right + across, rolling, rest, scrub)
        rows[_HELD_LEFT + k] = inertia + drag / math.sqrt(near_left * near_left + _SLOW * _SLOW) + grip_left
        rows[_HELD_RIGHT + k] = (
            inertia + drag / math.sqrt(near_right * near_right + _SLOW * _SLOW) + grip_right
        )
        push_left, push_right = driven * rows[_PUSH_LEFT + k], driven * rows[_PUSH_RIGHT + k]
        rows[_NEAR_LEFT + k], rows[_NEAR_RIGHT + k] = near_left, near_right
        rows[_GRIP_LEFT + k], rows[_GRIP_RIGHT + k] = grip_left, grip_right
        rows[_GIVEN_LEFT + k], rows[_GIVEN_RIGHT + k] = push_left, push_right
        rows[_ASKED_LEFT + k] = gain * rows[_LEFT + k] + push_left
        rows[_ASKED_RIGHT + k] = gain * rows[_RIGHT + k] + push_right
        rows[_FREE_LEFT + k], rows[_FREE_RIGHT + k] = 1.0, 1.0


@compiled()
def _find_most(pull: float, speed: float, bound: float, slope: float) -> float:
    """Largest push of a side [m/s^2] in the direction of a pull, at its speed [m/s]."""
    most = bound - math.copysign(slope * speed, pull * speed)
    return max(most, 0.0)


@compiled()
def _solve(rows: Floats, lanes: int, step_s: float) -> int:
    """Speeds at the middle of a cell; returns in how many lanes a push has met its bound just now."""
    rate, inertia, aside = 2.0 / step_s, ROTATING / step_s, rows[_ASIDE]
    changed = 0
    for k in range(lanes):
        gain, slope = rows[_GAIN + k], rows[_SLOPE + k]
        grip_left, grip_right = rows[_GRIP_LEFT + k], rows[_GRIP_RIGHT + k]
        stiff_left = rows[_HELD_LEFT + k] + rows[_FREE_LEFT + k] * gain
        stiff_right = rows[_HELD_RIGHT + k] + rows[_FREE_RIGHT + k] * gain
        free_left = (inertia * rows[_ON_LEFT + k] + rows[_ASKED_LEFT + k]) / stiff_left
        free_right = (inertia * rows[_ON_RIGHT + k] + rows[_ASKED_RIGHT + k]) / stiff_right
        part_left, part_right = grip_left / stiff_left, grip_right / stiff_right
        # Speed and yaw rate of the body at the middle of the cell, from those at its start.
        firm_left, firm_right = grip_left * (1.0 - part_left), grip_right * (1.0 - part_right)
        straight, mixed = rate + firm_left + firm_right, aside * (firm_right - firm_left)
        turning = aside * aside * (straight + _LENGTHWISE * (grip_left + grip_right))
        push = rate * rows[_AHEAD + k] + grip_left * free_left + grip_right * free_right
        twist = aside * (aside * rate * rows[_TURN + k] + grip_right * free_right - grip_left * free_left)
        w = (twist * straight - mixed * push) / (straight * turning - mixed * mixed)
        v = (push - mixed * w) / straight
        mean_left = free_left + part_left * (v - aside * w)
        mean_right = free_right + part_right * (v + aside * w)
        pull_left = gain * (rows[_LEFT + k] - mean_left) + rows[_GIVEN_LEFT + k]
        pull_right = gain * (rows[_RIGHT + k] - mean_right) + rows[_GIVEN_RIGHT + k]
        most_left = _find_most(pull_left, rows[_NEAR_LEFT + k], rows[_BOUND_LEFT + k], slope)
        most_right = _find_most(pull_right, rows[_NEAR_RIGHT + k], rows[_BOUND_RIGHT + k], slope)
        is_free_left = rows[_FREE_LEFT + k] if abs(pull_left) <= most_left else 0.0
        is_free_right = rows[_FREE_RIGHT + k] if abs(pull_right) <= most_right else 0.0
        # A pull beyond the largest push becomes that; a lane without such a change stays as it is.
        same = (is_free_left == rows[_FREE_LEFT + k]) & (is_free_right == rows[_FREE_RIGHT + k])
        held_left, held_right = (
            math.copysign(most_left, pull_left),
            math.copysign(most_right, pull_right),
        )
        rows[_ASKED_LEFT + k] = rows[_ASKED_LEFT + k] if same | (is_free_left > 0.0) else held_left
        rows[_ASKED_RIGHT + k] = rows[_ASKED_RIGHT + k] if same | (is_free_right > 0.0) else held_right
        rows[_FREE_LEFT + k], rows[_FREE_RIGHT + k] = is_free_left, is_free_right
        rows[_MEAN_LEFT + k], rows[_MEAN_RIGHT + k] = mean_left, mean_right
        rows[_MEAN_V + k], rows[_MEAN_W + k] = v, w
        rows[_PULL_LEFT + k], rows[_PULL_RIGHT + k] = pull_left, pull_right
        rows[_MOST_LEFT + k], rows[_MOST_RIGHT + k] = most_left, most_right
        changed += 0 if same else 1
    return changed


@compiled()
def _hold(grown: float, pull: float, most: float) -> float:
    """What an integral part grows by: not beyond the largest push."""
    room = most - abs(pull)
    room = max(room, 0.0)
    return math.copysign(room, grown) if (grown * pull > 0.0) & (abs(grown) > room) else grown


@compiled()
def _step(rows: Floats, lanes: int, step_s: float) -> None:
    """The state at the end of a cell."""
    for k in range(lanes):
        driven = 1.0 - rows[_IDLE + k]
        grown = rows[_RESET + k] * step_s * driven
        mean_left, mean_right = rows[_MEAN_LEFT + k], rows[_MEAN_RIGHT + k]
        start_left = rows[_PUSH_LEFT + k] if driven == 1.0 else 0.0
        start_right = rows[_PUSH_RIGHT + k] if driven == 1.0 else 0.0
        rows[_PUSH_LEFT + k] = start_left + _hold(
            grown * (rows[_LEFT + k] - mean_left), rows[_PULL_LEFT + k], rows[_MOST_LEFT + k]
        )
        rows[_PUSH_RIGHT + k] = start_right + _hold(
            grown * (rows[_RIGHT + k] - mean_right), rows[_PULL_RIGHT + k], rows[_MOST_RIGHT + k]
        )
        step_left, step_right = mean_left - rows[_ON_LEFT + k], mean_right - rows[_ON_RIGHT + k]
        step_v, step_w = rows[_MEAN_V + k] - rows[_AHEAD + k], rows[_MEAN_W + k] - rows[_TURN + k]
        rows[_STEP_LEFT + k], rows[_STEP_RIGHT + k] = step_left, step_right
        rows[_STEP_V + k], rows[_STEP_W + k] = step_v, step_w
        rows[_ON_LEFT + k], rows[_ON_RIGHT + k] = mean_left + step_left, mean_right + step_right
        rows[_AHEAD + k], rows[_TURN + k] = rows[_MEAN_V + k] + step_v, rows[_MEAN_W + k] + step_w


@compiled(
    "void(float64[:, :, ::1], int64[::1], int64[::1], float64[:, :, ::1], float64, float64[::1], int64, "
    "float64[:, :, ::1])"
)
def _walk(
    asked: Floats,
    source: Ints,
    at: Ints,
    states: Floats,
    step_s: float,
    rows: Floats,
    count: int,
    rolled: Floats,
) -> None:
    """Implicit midpoint rule in two halves of each cell, with a grip that is extrapolated.

    In whole cells the residual of a fast servo is a rough function of its numbers.

    Args:
        asked: inputs, shape (k, 3, n).
        source: input of each lane, shape (lanes,).
        at: cells before which states are set, shape (e,).
        states: speeds of both sides set there, and whether they are those at the start of a prediction,
            shape (e, 3, lanes).
        step_s: width of a cell [s].
        rows: all that belongs to each lane: its numbers, and zeros.
        count: number of lanes that are wanted.
        rolled: the result [m/s], shape (`count` or more, 2, n).
    """
    event, lanes, half_s = 0, source.size, 0.5 * step_s
    for cell in range(asked.shape[2]):
        for k in range(lanes):
            rows[_LEFT + k], rows[_RIGHT + k] = asked[source[k], 0, cell], asked[source[k], 1, cell]
            rows[_IDLE + k] = asked[source[k], 2, cell]
        if event < at.size and at[event] == cell:
            _set_states(rows, lanes, states, event)
            event += 1
        for half in range(2):
            _approach(rows, lanes, half_s)
            for _ in range(3):
                if _solve(rows, lanes, half_s) == 0:
                    break
            _step(rows, lanes, half_s)
            for k in range(count):
                before_left = rolled[k, 0, cell] if half else 0.0
                before_right = rolled[k, 1, cell] if half else 0.0
                rolled[k, 0, cell] = before_left + 0.5 * rows[_MEAN_LEFT + k]
                rolled[k, 1, cell] = before_right + 0.5 * rows[_MEAN_RIGHT + k]
