"""What a log can tell at all: effects of a usual size that would leave no trace in it, and why."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.diagnosis.selection import CandidateModel, Selection
from pipeline.estimation.acceptance import LEAST_GAIN, LEAST_T, STABLE_T
from pipeline.estimation.noise import Noise
from pipeline.identification.proposals import Candidate
from pipeline.models.effect import Effect, Excitation, Search

DETECTED = LEAST_T + 1.3
"""Standard errors of a size that is named in nine of ten logs."""

MANOEUVRES: Mapping[Excitation, str] = {
    Excitation.DRIVING: "drive for a few minutes",
    Excitation.TURNING: "turn both ways, on the spot and while driving",
    Excitation.SPEED_SPREAD: "drive at several speeds, forward and backward",
    Excitation.BOTH_SIGNS: "drive forward and backward, straight and in curves of both signs",
    Excitation.CHANGES: "change speed and turning in steps, every few seconds",
    Excitation.SLOPE: "drive on a slope in several directions",
    Excitation.LARGE: "ask for the largest speeds and turns",
    Excitation.SMALL: "ask for very small speeds, and for very small turns while driving",
    Excitation.LONG: "drive for ten minutes, the same manoeuvres at the start and at the end",
    Excitation.STEERING: "steer to both sides at several speeds",
    Excitation.SIDEWAYS: "drive sideways both ways, at several speeds",
}


@dataclass(frozen=True)
class Unobservable:
    """An effect of which this log could not tell.

    Attributes:
        id: of the effect.
        reason: the run does not excite it, or it looks like what was named.
        manoeuvre: what would show it.
    """

    id: str
    reason: Literal["no excitation", "collinear with what was named"]
    manoeuvre: str


@dataclass(frozen=True)
class Detectable:
    """What an effect that was not named would have had to be to be seen in this log.

    Attributes:
        id: of the effect.
        parameter, unit: its number.
        size: distance of the number from where the effect does nothing.
    """

    id: str
    parameter: str
    unit: str
    size: float


def find_unobservable(
    selection: Selection, final: CandidateModel
) -> tuple[list[Unobservable], list[Detectable]]:
    """Candidates of which a usual size would not be named in this log.

    Neither can be told what shows but once: an event of its own would look the same.

    Returns:
        What could not be told, and how large the other effects that are linear in one number would have had
        to be.
    """
    noise = selection.noise or selection.take_evidence(final).noise
    rows, factor = noise.tiles.rows, selection.weights.factors(final.fit.residual)
    own = noise.whiten(final.fit.jacobian[rows])
    loss = selection.weights.cost(final.fit.residual).sum()
    found, seen = [], []
    for candidate in selection.candidates:
        if final.state.find(candidate.id) is not None:
            continue
        shift = _shift(selection, final, candidate)
        column = noise.whiten(shift[rows, :, None])[:, :, 0]
        left = _project_out(own, column)
        alone, beside = (math.sqrt(float((one**2).sum())) for one in (column, left))
        if beside >= LEAST_T and _is_spread(noise, left):
            share = float(((shift * factor) ** 2).sum() / loss) * (beside / max(alone, 1e-300)) ** 2
            seen += _find_detectable(candidate().make_usual(selection.largest), beside, share)
            continue
        is_shown = alone >= LEAST_T and _is_spread(noise, column)
        reason: Literal["no excitation", "collinear with what was named"] = (
            "collinear with what was named" if is_shown else "no excitation"
        )
        found.append(Unobservable(candidate.id, reason, suggest_manoeuvre(candidate())))
    return found, seen


def _project_out(own: Floats, column: Floats) -> Floats:
    """What of a column, shape (k, c), the model's own columns, shape (k, c, p), cannot imitate."""
    if not own.shape[2]:
        return column
    flat = own.reshape(-1, own.shape[2])
    solution = np.linalg.lstsq(flat, column.reshape(-1), rcond=1e-8)[0]
    left: Floats = (column.reshape(-1) - flat @ solution).reshape(column.shape)
    return left


def _is_spread(noise: Noise, column: Floats) -> bool:
    """Whether a column of innovations shows without the ten seconds in which it shows most."""
    power = np.bincount(noise.tiles.unit, (column**2).sum(axis=1))
    return math.sqrt(float(power.sum() - power.max())) >= STABLE_T


def _find_detectable(usual: Effect, standard_errors: float, share: float) -> list[Detectable]:
    """The size of an effect of one number that would be seen; its motion grows with it.

    Args:
        usual: the effect at a usual size.
        standard_errors: that it is then.
        share: of the model's loss that it then takes away: what takes less than a name must is not named.
    """
    (parameter, *more) = usual.parameters
    distance = abs(usual.values[parameter.name] - parameter.neutral)
    if more or parameter.search is not Search.DIRECT or not math.isfinite(distance):
        return []
    size = distance * max(DETECTED / standard_errors, math.sqrt(LEAST_GAIN / share))
    if parameter.least is not None:
        size = max(size, parameter.least.size)
    return [Detectable(usual.id, parameter.name, parameter.unit, size)]


def suggest_manoeuvre(*effects: Effect) -> str:
    """What to drive so that effects show themselves."""
    needs: list[Excitation] = []
    for effect in effects:
        needs += [need for need in effect.needs if need not in needs]
    return "; ".join(MANOEUVRES[need] for need in needs[:3])


def _shift(selection: Selection, final: CandidateModel, candidate: Candidate) -> Floats:
    changed = selection.part.find_residuals(final.state.add(candidate().make_usual(selection.largest)))
    return final.fit.residual - changed
