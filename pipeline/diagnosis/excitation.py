"""What a log can tell at all: effects of a usual size that would leave no trace in it, and why."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.diagnosis.selection import CandidateModel, Selection
from pipeline.diagnosis.verdict import LEAST_GAIN, LEAST_STRETCHES, SHORT_S, measure_repeated
from pipeline.identification.columns import weigh_columns
from pipeline.identification.proposals import Candidate
from pipeline.models.effect import Effect, Excitation, Search

_STANDARD_ERRORS = 4.0
_DETECTED = 9.0
"""Standard errors of a size that is seen: 14 of 17 hidden effects were named at it and 2 undecided, 6 named
at half of it and 17 at twice (`make detection`, seeds 300 to 317)."""

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
    """Candidates of which a usual size would move the prediction by less than four standard errors.

    Neither can be told what shows but once: an event of its own would look the same.

    Returns:
        What could not be told, and how large the other effects that are linear in one number would have had
        to be.
    """
    found, seen = [], []
    for candidate in selection.candidates:
        if final.state.find(candidate.id) is not None:
            continue
        column = _shift(selection, final, candidate)
        alone, beside, share = _evidence(selection, final, column)
        rare = _count_stretches(selection, column) < LEAST_STRETCHES
        if beside >= _STANDARD_ERRORS and not rare:
            seen += _find_detectable(candidate().make_usual(selection.largest), beside, share)
            continue
        reason: Literal["no excitation", "collinear with what was named"] = (
            "no excitation" if alone < _STANDARD_ERRORS or rare else "collinear with what was named"
        )
        found.append(Unobservable(candidate.id, reason, suggest_manoeuvre(candidate())))
    return found, seen


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
    size = distance * max(_DETECTED / standard_errors, math.sqrt(max(LEAST_GAIN, usual.price) / share))
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


def _evidence(selection: Selection, final: CandidateModel, shift: Floats) -> tuple[float, float, float]:
    """How many standard errors a shift is, alone and beside the model's numbers, and its share of loss."""
    fit, weights = final.fit, selection.weights
    factor = weights.factors(fit.residual)
    column = shift * factor
    beside = column
    if fit.free:
        rows = weigh_columns(fit.jacobian, factor)
        solution = np.linalg.lstsq(rows, column.reshape(-1), rcond=1e-8)[0]
        beside = (column.reshape(-1) - rows @ solution).reshape(column.shape)
    repeated = measure_repeated(selection.part, weights.weigh(fit.residual))
    alone, left = (_weigh_noise((one**2).sum(axis=0), repeated) for one in (column, beside))
    return alone, left, float((beside**2).sum() / weights.cost(fit.residual).sum())


def _weigh_noise(information: Floats, repeated: Floats) -> float:
    """Standard errors of what has this information in each channel, were their residuals independent."""
    total = float(information.sum())
    return total / math.sqrt(float(information @ repeated)) if total > 0.0 else 0.0


def _count_stretches(selection: Selection, shift: Floats) -> float:
    """Number of short stretches over which a shift of the prediction is spread."""
    moved = ((shift / selection.weights.scale) ** 2).sum(axis=1)
    stretch = selection.part.number_stretches(SHORT_S)
    action = np.bincount(stretch, moved)
    power = float(np.sum(action**2))
    return float(action.sum()) ** 2 / power if power > 0.0 else 0.0
