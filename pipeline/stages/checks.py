"""Checks of a whole run: does the vehicle move at all, do encoders, command and pose fit together.

Each check is a function from the samples of a run to findings. They look at displacements over half a second,
where neither smoothing nor vibration matters.
"""

from collections.abc import Callable

import numpy as np

from pipeline.core.arrays import Floats, Ints
from pipeline.models.catalogue import find_late_effect
from pipeline.models.effect import Late
from pipeline.stages.delays import estimate_delay
from pipeline.stages.finding import Finding
from pipeline.stages.samples import Samples
from pipeline.stages.scale import check_scale
from pipeline.stages.trust import check_live_commands
from pipeline.stages.wiring import check_wiring
from pipeline.vehicles import Vehicle

_GAIN_OF_NO_MOTION = 0.05
_NET_OF_NO_MOTION = 0.5
_PATH_OF_MOTION = 5.0
_LIVE = 0.02
_FEWEST = 100
_FEWEST_LIVE = 20
_SKEW = 0.05
_SURE = 5.0


def run_checks(samples: Samples, vehicle: Vehicle) -> list[Finding]:
    """All checks; where the vehicle does not move, only the ones that say so.

    Wheels on a wrong scale, or one side that counts backward, may look as if nothing moved: scale and wiring
    are judged first.
    """
    scaled, wired = check_scale(samples, vehicle), check_wiring(samples, vehicle)
    is_faulty = any(finding.severity == "error" for finding in wired)
    stuck = check_dead_wheels(samples, vehicle)
    stuck += [] if scaled or is_faulty else check_motion(samples, vehicle)
    if stuck:
        return stuck
    if is_faulty:
        return scaled + wired
    checks: tuple[Callable[[Samples, Vehicle], list[Finding]], ...] = (
        check_live_commands,
        check_limits,
        check_delays,
    )
    return scaled + wired + [finding for check in checks for finding in check(samples, vehicle)]


def check_dead_wheels(samples: Samples, _vehicle: Vehicle) -> list[Finding]:
    """Encoders that say zero throughout under live commands: an emergency stop, or dead encoders."""
    if samples.measured is None or samples.command is None:
        return []
    both = np.isfinite(samples.measured).all(axis=1) & np.isfinite(samples.command).all(axis=1)
    live = both & (np.abs(samples.command) > _LIVE).any(axis=1)
    if live.sum() < _FEWEST or float(np.abs(samples.measured[both]).max()) > 0.0:
        return []
    text = (
        "the measured wheels are zero throughout while commands are live: "
        "an emergency stop was pressed, or the encoders are dead"
    )
    return [Finding("wheels_dead", "error", text, where="wheels", count=int(live.sum()))]


def check_motion(samples: Samples, _vehicle: Vehicle) -> list[Finding]:
    """A vehicle that does not move: wheels in the air, or standing under commands.

    The gain of displacement on the ideal's is below 5 % ahead, sideways and in turning, or the run's net
    displacement is below half a metre over more than five metres of wheel path. The pose's own path is
    no test: its noise alone sums to tens of metres.
    """
    ideal = samples.measured if samples.measured is not None else samples.command
    if samples.measured is not None and not np.nanmax(np.abs(samples.measured), initial=0.0) > 0.0:
        ideal = samples.command
    if ideal is None:
        return []
    known = np.isfinite(ideal).all(axis=1)
    if known.sum() < _FEWEST:
        return []
    period = float(np.median(np.diff(samples.times)))
    path = float(np.hypot(ideal[known, 0], ideal[known, 1]).sum() * period)
    turned = float(np.abs(ideal[known, 2]).sum() * period)
    if path < _NET_OF_NO_MOTION and turned < _NET_OF_NO_MOTION:
        text = f"the vehicle was hardly asked to move: {path:.2g} m of path in the whole run"
        return [Finding("not_moving", "error", text, value=path)]
    gains = [_gain_on(samples.velocity[known, axis], ideal[known, axis]) for axis in range(3)]
    reach = samples.position[known]
    net = float(np.linalg.norm(reach.max(axis=0) - reach.min(axis=0)))
    still = all(abs(gain) < _GAIN_OF_NO_MOTION for gain in gains)
    nowhere = net < _NET_OF_NO_MOTION and path > _PATH_OF_MOTION
    if not still and not (nowhere and abs(gains[2]) < 10.0 * _GAIN_OF_NO_MOTION):
        return []
    # Sideways counts only where nothing was asked ahead.
    covered = gains[0] or gains[1]
    text = (
        f"the vehicle does not move: of {path:.0f} m that the wheels turned it covered {covered:.1%}, "
        f"within {net:.2g} m (wheels in the air, blocked, or stopped)"
    )
    return [Finding("not_moving", "error", text, value=covered)]


def _gain_on(velocity: Floats, ideal: Floats) -> float:
    """Gain of a velocity on its ideal where anything is asked; zero where nothing is: noise is no motion."""
    live = np.abs(ideal) > _LIVE
    if live.sum() < _FEWEST_LIVE:
        return 0.0
    return float(np.sum(velocity[live] * ideal[live]) / np.sum(ideal[live] ** 2))


def check_limits(samples: Samples, vehicle: Vehicle) -> list[Finding]:
    """Commands beyond what the vehicle's controller lets through."""
    if samples.command is None:
        return []
    findings = []
    for axis, limit, unit in ((0, vehicle.max_speed_mps, "m/s"), (2, vehicle.max_yaw_rate_radps, "rad/s")):
        asked = np.abs(samples.command[np.isfinite(samples.command[:, axis]), axis])
        if limit is None or asked.size == 0:
            continue
        share = float(np.mean(asked > limit * 1.02))
        if share > 0.01:  # noqa: PLR2004 - a hundredth of the samples is no accident
            name = "speed" if axis == 0 else "yaw rate"
            text = (
                f"{share:.0%} of the commands ask for more than the vehicle's largest {name} "
                f"({limit:g} {unit}): its controller may clip them"
            )
            findings.append(
                Finding("command_beyond_limit", "info", text, where=f"command {name}", value=share)
            )
    return findings


def check_delays(samples: Samples, _vehicle: Vehicle) -> list[Finding]:
    """A heading that is later than the position."""
    ideal = samples.measured if samples.measured is not None else samples.command
    if ideal is None:
        return []
    findings = []
    known = np.isfinite(ideal).all(axis=1)
    places = np.flatnonzero(known)
    along = _delay_of(samples.velocity[:, 0], ideal[:, 0], places, samples)
    turning = _delay_of(samples.velocity[:, 2], ideal[:, 2], places, samples)
    if along is not None and turning is not None and samples.measured is not None:
        skew = turning[0] - along[0]
        if abs(skew) > max(_SKEW, _SURE * float(np.hypot(along[1], turning[1]))):
            later = "later" if skew > 0.0 else "earlier"
            text = (
                f"against the wheels the heading is {abs(skew) * 1e3:.0f} ms {later} than the position: "
                "a skew of the localization (it looks like lateral skid) or inertia of the body"
            )
            name = find_late_effect(Late.HEADING).id
            findings.append(Finding(name, "warning", text, where="pose", value=skew))
    return findings


def _delay_of(
    signal: Floats, reference: Floats, places: Ints, samples: Samples
) -> tuple[float, float] | None:
    """Delay and standard deviation [s] of a signal against a reference; None where they do not correlate."""
    times = samples.times[places]
    found = estimate_delay(times, signal[places], times, reference[places])
    if found is None or abs(found.correlation) < 0.7:  # noqa: PLR2004 - below it the lag means nothing
        return None
    return found.seconds, found.deviation
