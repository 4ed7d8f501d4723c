"""Whether commands are on the scale of the wheels: another radius, another unit, a controller's own track."""

from dataclasses import dataclass

import numpy as np

from pipeline.core import timegrid
from pipeline.core.arrays import Flags, Floats, Ints
from pipeline.stages.finding import Finding
from pipeline.stages.samples import Samples
from pipeline.vehicles import Vehicle

_LIVE = 0.02
_FEWEST_STEPS = 6
_SCALED = 0.18
_BLOCK_S = 0.5
_FEWEST_BLOCKS = 60
_DISAGREES = 0.2


@dataclass(frozen=True)
class CommandScale:
    """What commands must be multiplied with.

    Attributes:
        scale: of the whole command.
        track_multiplier: of the track width, by which the controller turns a yaw rate into wheel speeds.
        findings: what is said of it.
    """

    scale: float
    track_multiplier: float
    findings: tuple[Finding, ...] = ()


def measure_command_scale(samples: Samples, vehicle: Vehicle) -> CommandScale:
    """Steady commanded wheel speeds against measured ones.

    Only the slower half of the steps counts: there nothing saturates, and a wrong scale is the same in all.
    Where a body command never holds still for so many steps, the gain of a lag from command to wheels tells
    the controller's multiplier.

    Args:
        samples: of the run, before any correction.
        vehicle: as configured.
    """
    as_told = CommandScale(1.0, vehicle.controller_track_multiplier)
    if samples.measured is None or samples.command is None:
        return as_told
    both: Flags = np.all(np.isfinite(np.hstack((samples.measured, samples.command))), axis=1)
    forward, turning = _measure_ratios(samples, both)
    if forward is None:
        return as_told
    if abs(np.log(forward)) > _SCALED:
        text = (
            f"in slow steady steps the wheels turn {forward:.2f} times as fast as commanded: the recorded "
            "command is scaled wrongly (another vehicle's wheel radius, or a unit); it was put right"
        )
        finding = Finding("command_scale", "warning", text, where="command", value=forward)
        return CommandScale(forward, vehicle.controller_track_multiplier, (finding,))
    if turning is None or not samples.body_commanded or not _is_multiplied(turning / forward, vehicle):
        return as_told
    used = vehicle.controller_track_multiplier
    multiplier = turning / forward * used
    track = "the nominal track width" if used == 1.0 else f"{used:g} times the nominal track width"
    text = (
        f"in turns the wheels differ {turning / forward:.2f} times as much as the command asks "
        f"with {track}: vehicle.controller_track_multiplier = {multiplier:.3g} was used"
    )
    finding = Finding("controller_multiplier", "warning", text, where="command", value=multiplier)
    return CommandScale(1.0, multiplier, (finding,))


def _measure_ratios(samples: Samples, both: Flags) -> tuple[float | None, float | None]:
    """Ratio of measured to asked speed and yaw rate; None where it cannot be told."""
    steady = both & samples.steady
    if steady.any():
        forward, turning = (
            _find_ratio(asked, got) for asked, got in _average(samples, steady, samples.step.astype(np.int64))
        )
        if forward is not None and turning is not None:
            return forward, turning
    else:
        forward = turning = None
    if samples.body_commanded and both.any():
        blocks = _average(
            samples, both, timegrid.number_stretches(samples.times - samples.times[0], _BLOCK_S)
        )
        along, around = (_find_gain(asked, got) for asked, got in blocks)
        # Limits and droops lower the gain of fast turns; nothing but a multiplier raises it.
        if along is not None and around is not None and abs(np.log(along)) < _SCALED and around > along:
            return along, around
    return forward, turning


def _is_multiplied(ratio: float, vehicle: Vehicle) -> bool:
    """Whether turns show another multiplier than the configured one.

    A controller widens the track or leaves it: wheels that differ by less are a matter of the drive.
    """
    multiplier = ratio * vehicle.controller_track_multiplier
    return bool(abs(np.log(ratio)) >= _SCALED and np.log(multiplier) > -_SCALED)


def _average(samples: Samples, counts: Flags, label: Ints) -> Floats:
    """Means over stretches of one label, in their order.

    Args:
        samples: of the run.
        counts: samples that count, shape (n,).
        label: of the stretch of each sample, shape (n,).

    Returns:
        Speed and yaw rate, each asked and measured, shape (2, 2, stretches).
    """
    _, number, size = np.unique(label[counts], return_inverse=True, return_counts=True)
    means = [
        [
            np.zeros(0) if values is None else np.bincount(number, values[counts, channel]) / size
            for values in (samples.command, samples.measured)
        ]
        for channel in (0, 2)
    ]
    return np.array(means, dtype=np.float64)


def _find_ratio(asked: Floats, got: Floats) -> float | None:
    """Median ratio of measured to asked over the slower half of the steps; None where they disagree."""
    size = np.abs(asked)
    slow = (size > max(0.1 * float(size.max()), _LIVE)) & (size < 0.5 * float(size.max()))
    if slow.sum() < _FEWEST_STEPS:
        return None
    ratio = got[slow] / asked[slow]
    middle = float(np.median(ratio))
    spread = 1.4826 * float(np.median(np.abs(ratio - middle)))
    return middle if middle > _LIVE and spread < _DISAGREES * middle else None


def _find_gain(asked: Floats, got: Floats) -> float | None:
    """Gain of a first-order lag, got + tau dgot/dt = gain * asked; None where it is none."""
    if asked.size < _FEWEST_BLOCKS or float(np.abs(asked).max()) < _LIVE:
        return None
    change = 0.5 * (got[2:] - got[:-2])
    inner = got[1:-1]
    design = np.column_stack((asked[1:-1], change))
    fitted = np.linalg.lstsq(design, inner, rcond=None)[0]
    gain, rest = float(fitted[0]), inner - design @ fitted
    agrees = float(np.sum(rest**2)) < _DISAGREES**2 * float(np.sum(inner**2))
    return gain if gain > _LIVE and agrees else None
