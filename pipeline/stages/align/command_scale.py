"""Whether commands are on the scale of the wheels: another radius, another unit, a controller's own track."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.stages.finding import Finding

if TYPE_CHECKING:
    from pipeline.stages.samples import Samples
    from pipeline.vehicles import Vehicle

Floats = NDArray[np.float64]

_LIVE = 0.02
_FEWEST_STEPS = 6
_SCALED = 0.18
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

    Args:
        samples: of the run, before any correction.
        vehicle: as configured.
    """
    as_told = CommandScale(1.0, vehicle.controller_track_multiplier)
    if samples.measured is None or samples.command is None:
        return as_told
    both = (
        np.isfinite(samples.measured).all(axis=1) & np.isfinite(samples.command).all(axis=1) & samples.steady
    )
    if not both.any():
        return as_told
    asked, got = _average_steps(samples.step[both], samples.command[both], samples.measured[both])
    forward = _slow_ratio(asked[:, 0], got[:, 0])
    turning = _slow_ratio(asked[:, 2], got[:, 2])
    if forward is None:
        return as_told
    if abs(np.log(forward)) > _SCALED:
        text = (
            f"in slow steady steps the wheels turn {forward:.2f} times as fast as commanded: the recorded "
            "command is scaled wrongly (another vehicle's wheel radius, or a unit); it was put right"
        )
        finding = Finding("command_scale", "warning", text, where="command", value=forward)
        return CommandScale(forward, vehicle.controller_track_multiplier, (finding,))
    if turning is None or not samples.body_commanded or np.log(turning / forward) < _SCALED:
        return as_told
    multiplier = turning / forward * vehicle.controller_track_multiplier
    text = (
        f"in slow steady turns the wheels differ {turning / forward:.2f} times as much as the command asks "
        f"with the nominal track width: vehicle.controller_track_multiplier = {multiplier:.3g} was used"
    )
    finding = Finding("controller_multiplier", "warning", text, where="command", value=multiplier)
    return CommandScale(1.0, multiplier, (finding,))


def _average_steps(step: NDArray[np.int32], command: Floats, measured: Floats) -> tuple[Floats, Floats]:
    """Mean command and mean measured wheels of every command step, each of shape (steps, 3)."""
    _, label, count = np.unique(step, return_inverse=True, return_counts=True)
    means = [
        np.stack([np.bincount(label, values[:, i]) / count for i in range(3)], axis=-1)
        for values in (command, measured)
    ]
    return means[0], means[1]


def _slow_ratio(asked: Floats, got: Floats) -> float | None:
    """Median ratio of measured to asked over the slower half of the steps; None where they disagree."""
    size = np.abs(asked)
    slow = (size > max(0.1 * float(size.max()), _LIVE)) & (size < 0.5 * float(size.max()))
    if slow.sum() < _FEWEST_STEPS:
        return None
    ratio = got[slow] / asked[slow]
    middle = float(np.median(ratio))
    spread = 1.4826 * float(np.median(np.abs(ratio - middle)))
    return middle if middle > _LIVE and spread < _DISAGREES * middle else None
