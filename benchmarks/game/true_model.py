"""The held-out errors of the ideal model, of the true one, and of what was named.

The true model has the effects that were simulated, begins at their values and is fitted as any other; all
models are fitted to and judged on the same windows. A clock that the gyro shows was put right before any
model was fitted: what the true model gains by it is measured on the poses as they were stamped.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from game.draw import Answer
from pipeline.estimation import DiagnosisInput, EstimationData, Input, fit_model, hold_out, load_recording
from pipeline.estimation.errors import measure_errors
from pipeline.models import Effect, Model, ModelFile, find_effect, format_model
from pipeline.models.effect import Late, find_late
from pipeline.models.model_file import parse_model
from pipeline.run import MotionError
from pipeline.run.heading import HeadingSource
from pipeline.sources import Vehicle

Json = Mapping[str, object]

_SUBTLE = 0.05
_LEAST_M = 1e-6


@dataclass(frozen=True)
class Held:
    """Held-out errors: over 2 s [m] and [rad], and of the velocity over 0.5 s [m/s, m/s, rad/s]."""

    t_m: float
    r_rad: float
    x: float
    y: float
    w: float

    def falls_below(self, other: Held, share: float = _SUBTLE) -> bool:
        """Whether the 2 s error of position or of yaw is lower than another's by a share."""
        return self.t_m <= (1.0 - share) * other.t_m or self.r_rad <= (1.0 - share) * other.r_rad

    def ratio(self, other: Held) -> float:
        """The larger of the two ratios of the 2 s errors."""
        return max(self.t_m / max(other.t_m, _LEAST_M), self.r_rad / max(other.r_rad, _LEAST_M))


@dataclass(frozen=True)
class Checked:
    """Models of one log side by side; None where there is nothing to fit.

    Attributes:
        ideal: without effects.
        true: with all that was simulated.
        named: with all that was named.
        formula: with what was named and the pasted formula.
        without: the true model less one of its effects, where it has several.
    """

    ideal: Held | None = None
    true: Held | None = None
    named: Held | None = None
    formula: Held | None = None
    without: Mapping[str, Held] = field(default_factory=dict)

    def is_weak(self, effect: str) -> bool:
        """Whether the true model lowers the held-out error by less than 5 % for having this effect."""
        beside = self.without.get(effect, self.ideal)
        return self.true is not None and beside is not None and not self.true.falls_below(beside)


def check_models(vehicle: Vehicle, recording: DiagnosisInput, told: Json, answer: Answer) -> Checked:
    """Fit and judge the true model and the named one on a diagnosed log.

    Args:
        vehicle: as the stages found it.
        recording: the run.
        told: what the diagnosis said of it.
        answer: what was hidden.
    """
    entries = [item for item in _list(told, "effects") if isinstance(item, Mapping)]
    named = [_restore(entry) for entry in entries]
    ids = set(answer.effects) | {effect.id for effect in named}
    run = load_recording(recording, vehicle)
    vehicle = run.correct_vehicle(vehicle)
    try:
        data = EstimationData(
            [run],
            vehicle,
            Input.COMMAND,
            # A skew of the reported heading shows against the reported heading only.
            heading=HeadingSource.POSE if "heading_skew" in ids else HeadingSource.AUTO,
        )
    except MotionError:
        return Checked()
    true = list(build_true(answer, run.duration_s))
    ideal = _judge(data, Model(vehicle))
    best = _judge(data, Model(vehicle, tuple(true))) if true else None
    found = _judge(data, Model(vehicle, tuple(named))) if named else ideal
    without: dict[str, Held] = {}
    if len(true) > 1:
        without = {
            effect.id: _judge(data, Model(vehicle, tuple(e for e in true if e is not effect)))
            for effect in true
        }
    clock = find_late(true, Late.POSES)
    if clock is not None and run.gyro_fit is not None:
        without[clock.id] = _judge_late(data, Model(vehicle, tuple(true)))
    return Checked(ideal, best, found, _judge_formula(data, Model(vehicle, tuple(named)), told), without)


def build_true(answer: Answer, duration_s: float) -> tuple[Effect, ...]:
    """The effects that were simulated, at their values."""
    return tuple(_place_change(_build(name, values), duration_s) for name, values in answer.effects.items())


def _judge(data: EstimationData, model: Model) -> Held:
    errors = hold_out(data, fit_model(data, model)).pooled
    return Held(errors.t_mrmse_m, errors.r_mrmse_rad, *errors.velocity_rms)


def _judge_late(data: EstimationData, fitted: Model) -> Held:
    """A model on poses that stand where they were stamped, in sample."""
    state = fit_model(data, fitted).state
    late = -data.runs[0].alignment.heading_delay_s
    run_residuals = data.residuals_by_run[0]
    reach = run_residuals.find_horizon_errors(state.effects, state.timing[0], late)
    residuals = run_residuals.find_residuals(state.effects, state.timing[0], late)
    errors = measure_errors(residuals, reach.position, reach.yaw)
    return Held(errors.t_mrmse_m, errors.r_mrmse_rad, *errors.velocity_rms)


def _judge_formula(data: EstimationData, model: Model, told: Json) -> Held | None:
    """The model file with the formula pasted at its end, as a user would."""
    flagged = told.get("unexplained")
    formula = flagged.get("formula") if isinstance(flagged, Mapping) else None
    if not isinstance(formula, str):
        return None
    pasted = parse_model(format_model(ModelFile(model)) + "\n" + formula, Path("pasted.toml"))
    return _judge(data, pasted.model)


def _build(name: str, values: Mapping[str, float]) -> Effect:
    """An effect at given values, brought inside its bounds."""
    effect = find_effect(name)()
    inside = {}
    for key, value in values.items():
        low, high = effect.parameter(key).bounds
        inside[key] = value if math.isnan(value) else min(max(value, low), high)
    return effect.change(**inside)


def _place_change(effect: Effect, duration_s: float) -> Effect:
    """A simulated terrain changes half-way; a fit has to find the place again, as a diagnosis had to."""
    return effect.change(at_s=0.5 * duration_s) if effect.id == "terrain_change" else effect


def _restore(entry: Json) -> Effect:
    """A named effect at the values that were told."""
    parameters = entry.get("parameters")
    values = {
        str(name): float(item["value"])
        for name, item in (parameters.items() if isinstance(parameters, Mapping) else ())
        if isinstance(item.get("value"), int | float)
    }
    return _build(str(entry["id"]), values)


def _list(content: Json, key: str) -> Sequence[object]:
    found = content.get(key)
    return found if isinstance(found, list | tuple) else ()
