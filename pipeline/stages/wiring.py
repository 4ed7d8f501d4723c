"""Whether commands, encoders and poses agree on left and right, ahead and back: faults of the wiring.

Three signals tell of the same motion: what was asked for, what the encoders say, and what the localization
says. Where one of them contradicts the two others, that one is wired or mounted wrongly; no physics turns
left into right. Looked at on differential drives, whose sides are known.
"""

from collections.abc import Mapping
from itertools import combinations
from typing import Final

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.core.robust import fit_robustly
from pipeline.stages.finding import Finding
from pipeline.stages.samples import Samples
from pipeline.vehicles import Vehicle

FAULTS: Final = ("sides_exchanged", "wheel_sign", "pose_mirrored", "wheel_dead")
"""Findings of which one makes every fit meaningless."""

_LIVE: Final = 0.05
"""Speed of a side that is more than encoders' rounding and a creeping vehicle's [m/s]."""
_FEWEST: Final = 100
_RELATED: Final = 0.5
"""Least correlation whose sign is believed; on recordings of snow and ice it is 0.6 and more."""
_AXIS_LIVE: Final = 0.1
"""Share of the usual largest speed of a side that moving ahead, or turning, must have to have a sign."""
_USUAL: Final = 0.95
"""Share of the samples that are no outliers of the localization."""
_LEAST_SCALE: Final = 0.04
"""Smallest difference of the sides' scales that is told: unequal tyres and motors reach 0.035."""
_AXES: Final = ("ahead", "turning")


def check_wiring(samples: Samples, vehicle: Vehicle) -> list[Finding]:
    """Sides exchanged, a sign wrong, one encoder dead or on another scale, poses of the other hand."""
    if vehicle.kind != "differential" or vehicle.track_width_m is None:
        return []
    told = {"pose": samples.velocity, "command": samples.command, "wheels": samples.measured}
    signals = {name: signal for name, signal in told.items() if signal is not None}
    if len(signals) == 1:
        return []
    known = samples.steady & np.all([np.isfinite(signal).all(axis=1) for signal in signals.values()], axis=0)
    sides = {name: _find_sides(signal[known], vehicle.track_width_m) for name, signal in signals.items()}
    # Where nothing turns and nothing is asked for, noise has no sign.
    live = np.any([np.abs(side).max(axis=1) > _LIVE for side in sides.values()], axis=0)
    if live.sum() < _FEWEST:
        return []
    sides = {name: side[live] for name, side in sides.items()}
    found = (
        _check_dead_side(sides) or _check_one_sign(sides) or _check_signs(sides, body=samples.body_commanded)
    )
    return found or _check_side_scale(sides)


def _find_sides(velocity: Floats, track_m: float) -> Floats:
    """Speed of the left and the right side of an ideal differential drive [m/s], shape (n, 2)."""
    half = 0.5 * track_m * velocity[:, 2]
    return np.column_stack((velocity[:, 0] - half, velocity[:, 0] + half))


def _check_dead_side(sides: Mapping[str, Floats]) -> list[Finding]:
    """One side's encoder says zero throughout while the other's turns, and the vehicle does not spin."""
    if "wheels" not in sides:
        return []
    largest = np.abs(sides["wheels"]).max(axis=0)
    for dead, (side, other) in enumerate((("left", "right"), ("right", "left"))):
        reference = sides.get("command", sides["pose"])[:, dead]
        moves = float(np.mean(np.abs(reference) > _LIVE))
        if largest[dead] < 1e-6 and largest[1 - dead] > _LIVE and moves > _RELATED:  # noqa: PLR2004 - zero
            text = (
                f"the {side} wheels' encoder says zero throughout while the {other} wheels turn and the "
                f"{side} side moves: its encoder is dead (take --input command, or mend [wheels] {side})"
            )
            return [Finding("wheel_dead", "error", text, where=f"wheels {side}", value=moves)]
    return []


def _check_one_sign(sides: Mapping[str, Floats]) -> list[Finding]:
    """One side's encoder runs backward: what is straight for the others is a spin for it."""
    if "wheels" not in sides:
        return []
    reference = sides.get("command", sides["pose"])
    related = [_correlate(sides["wheels"][:, k], reference[:, k]) for k in (0, 1)]
    crossed = [_correlate(sides["wheels"][:, k], reference[:, 1 - k]) for k in (0, 1)]
    for wrong, side in enumerate(("left", "right")):
        if related[wrong] < -_RELATED < _RELATED < related[1 - wrong] and related[wrong] < crossed[wrong]:
            text = (
                f"the {side} wheels' encoder counts backward (correlation {related[wrong]:.2f} with that "
                f"side, {related[1 - wrong]:.2f} on the other): turn its sign in the recorder or the robot "
                "description, or take --input command"
            )
            return [Finding("wheel_sign", "error", text, where=f"wheels {side}", value=related[wrong])]
    return []


def _check_signs(sides: Mapping[str, Floats], *, body: bool) -> list[Finding]:
    """The one of command, wheels and poses that contradicts the others, ahead or in turning."""
    motion = {name: (side.sum(axis=1), side[:, 1] - side[:, 0]) for name, side in sides.items()}
    least = _AXIS_LIVE * max(float(np.quantile(np.abs(side), _USUAL)) for side in sides.values())
    wrong: dict[str, list[str]] = {}
    value = 0.0
    for place, axis in enumerate(_AXES):
        # Rest of one axis while the other moves is noise and what follows late: it has no sign.
        axis_live = np.any([np.abs(along[place]) > least for along in motion.values()], axis=0)
        if axis_live.sum() < _FEWEST:
            continue
        signs = {
            frozenset(pair): _correlate(motion[pair[0]][place][axis_live], motion[pair[1]][place][axis_live])
            for pair in combinations(motion, 2)
        }
        name = _find_odd(signs, list(motion))
        if name is not None:
            wrong.setdefault(name, []).append(axis)
            value = min(signs.values())
    # With all three, one of them is wrong; where two are, nobody can say which.
    return (
        [_describe(name, axes, value, body=body) for name, axes in wrong.items()] if len(wrong) == 1 else []
    )


def _find_odd(signs: Mapping[frozenset[str], float], names: list[str]) -> str | None:
    """Who is against the others, `wheels` or `command` beside poses alone; None where all agree."""
    if len(names) == 2:  # noqa: PLR2004 - poses, and one more
        other = next(name for name in names if name != "pose")
        return other if signs[frozenset(names)] < -_RELATED else None
    for name in names:
        against = [value for pair, value in signs.items() if name in pair]
        among = next(value for pair, value in signs.items() if name not in pair)
        if max(against) < -_RELATED and among > _RELATED:
            return name
    return None


def _describe(name: str, axes: list[str], value: float, *, body: bool) -> Finding:
    turned = f"correlation {value:.2f}"
    if name == "pose":
        what = "move backward and turn the other way: base_link is mirrored"
        if axes == ["turning"]:
            what = "turn the other way: their frame is of the other hand (y right, or yaw clockwise)"
        elif axes == ["ahead"]:
            what = "move backward: base_link points to the rear"
        text = f"commands and wheels agree, and the poses {what} ({turned}): mend the localization's frame"
        return Finding("pose_mirrored", "error", text, where="pose", value=value)
    told = {"wheels": "the measured wheels", "command": "the commands"}[name]
    mend = "turn the sign of {} in what sends it" if name == "command" and body else None
    if axes == ["turning"]:
        mend = mend.format("angular.z") if mend else f"exchange left and right under [{name}] in run.toml"
        text = (
            f"left and right are exchanged: {told} turn left where the vehicle turns right ({turned}; {mend})"
        )
        return Finding("sides_exchanged", "error", text, where=name, value=value)
    also = " and left and right are exchanged" if axes == ["ahead"] else ""
    mend = mend.format("linear.x") if mend else f"sign = -1 under [{name}] in run.toml"
    text = (
        f"{told} run backward where the vehicle drives ahead ({turned}): their sign is wrong{also} ({mend})"
    )
    return Finding("wheel_sign", "error", text, where=name, value=value)


def _check_side_scale(sides: Mapping[str, Floats]) -> list[Finding]:
    """One encoder on another scale than the other, though the vehicle follows the commands evenly.

    Unequal tyres show between wheels and body only, a weak motor between command and wheels only; an encoder
    that reads low shows in both, in opposite directions.
    """
    if set(sides) != {"pose", "command", "wheels"}:
        return []
    turned = sides["pose"][:, 1] - sides["pose"][:, 0]
    (left, right), _ = fit_robustly(sides["wheels"], turned)
    (own_left, _), _ = fit_robustly(sides["command"], sides["wheels"][:, 0])
    (_, own_right), _ = fit_robustly(sides["command"], sides["wheels"][:, 1])
    if not (left < 0.0 < right and own_left > 0.0 and own_right > 0.0):
        return []
    of_command, of_body = float(np.log(own_left / own_right)), float(np.log(-left / right))
    scale = 0.5 * (of_command - of_body)
    if abs(scale) < _LEAST_SCALE or abs(of_command + of_body) > abs(scale):
        return []
    low = "left" if scale < 0.0 else "right"
    text = (
        f"the {low} wheels' encoder reads {1.0 - np.exp(-abs(scale)):.1%} low against the other side: the "
        "command asks for more there and the vehicle does not turn for it (another gear or resolution?)"
    )
    return [Finding("wheel_scale", "warning", text, where=f"wheels {low}", value=float(np.exp(-abs(scale))))]


def _correlate(one: Floats, other: Floats) -> float:
    """Correlation about zero, since a steady speed is a relation too; outliers count as the usual largest."""
    one, other = (np.clip(v, *(np.quantile(np.abs(v), _USUAL) * np.array([-1.0, 1.0]))) for v in (one, other))
    size = float(np.sqrt(np.sum(one**2) * np.sum(other**2)))
    return float(np.sum(one * other)) / size if size > 0.0 else 0.0
