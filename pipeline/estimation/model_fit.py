"""A model fitted to runs, path by path from the commands to the motion."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

from pipeline.estimation.candidates import Unset
from pipeline.estimation.fit import PathFit, fit_path, settle
from pipeline.estimation.matrix import Matrix
from pipeline.estimation.model_state import ModelState
from pipeline.models import Model

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.core import Floats
    from pipeline.estimation.estimation_data import EstimationData
    from pipeline.estimation.model_state import Free
    from pipeline.estimation.path_residuals import PathResiduals


@dataclass(frozen=True)
class Fitted:
    """A model fitted to runs.

    Attributes:
        data: the runs.
        state: model, per-run values and delays.
        fits: the fit of each path.
    """

    data: EstimationData = field(repr=False)
    state: ModelState
    fits: tuple[PathFit, ...] = field(repr=False)

    @cached_property
    def residuals(self) -> Floats:
        """Residuals in windows of the whole path, shape (n, 3)."""
        return self.data.find_residuals(self.state)

    @property
    def model(self) -> Model:
        """The fitted model with the effects that act on the input."""
        return Model(self.data.vehicle, self.state.effects)

    @property
    def score(self) -> float:
        """Minus twice the logarithm of its likelihood: smaller is better."""
        return sum(fit.score for fit in self.fits)

    @property
    def free(self) -> tuple[Free, ...]:
        """All fitted parameters."""
        return tuple(number for fit in self.fits for number in fit.free)

    @property
    def per_run(self) -> tuple[str, ...]:
        """Labels ``effect.name`` of the parameters with one fitted value per run, not per ground."""
        by_ground = {label for effect in self.state.effects for label in effect.ground_labels}
        own = (number.label for number in self.free if number.effect and number.runs)
        return tuple(label for label in dict.fromkeys(own) if label not in by_ground)


def fit_model(
    data: EstimationData,
    model: Model,
    *,
    per_run: Sequence[str] = (),
    start: Fitted | None = None,
    exact: bool = False,
) -> Fitted:
    """Fit a model's free parameters and the recording's delays.

    If wheels are measured as well as commanded, effects of the drivetrain are fitted from the command to
    the wheels and those of the ground from the wheels to the body: the unexplained residual of one path
    does not bias the parameters of the other.

    Args:
        data: the runs.
        model: effects at neutral values are searched from several starts; others start at their values.
        per_run: labels ``effect.name`` or ids with one value per run.
        start: a fit of nearly the same model, from whose values those of common effects start.
        exact: settle the parameters, so that the same model has the same estimates from every start;
            otherwise only the likelihood converges, which is enough to compare models.

    Returns:
        The fit; for a parameter at its bound, the data would fit better beyond it.
    """
    known = () if start is None else start.state.hold([e for e in start.state.effects if e.id in model])
    state = data.start_state(known)
    effects = data.active_effects(model)
    common = {effect.id: effect for effect in state.effects}
    fits: list[PathFit] = []
    for path in data.paths:
        mine = state.hold([common.get(effect.id, effect) for effect in effects if path.owns(effect)])
        delay = "wheel_delay_s" if path.is_delayed else "encoder_delay_s"
        delays = tuple(getattr(one, delay) for one in mine.timing)
        begin = (path, mine.effects, delays, repr(mine.own), tuple(per_run), exact)
        fit = data.fits.recall(begin, partial(_fit_from, data, path, mine, per_run, exact=exact))
        fits.append(fit)
        own = {run: {**state.own.get(run, {}), **numbers} for run, numbers in fit.state.own.items()}
        timing = tuple(
            replace(one, **{delay: getattr(fitted, delay)})
            for one, fitted in zip(state.timing, fit.state.timing, strict=True)
        )
        state = ModelState(state.effects, timing, {**state.own, **own}).add(*fit.state.effects)
    acting = {effect.id for effect in effects}
    return Fitted(data, state.hold([one for one in state.effects if one.id in acting]), tuple(fits))


def _fit_from(
    data: EstimationData, path: PathResiduals, state: ModelState, per_run: Sequence[str], *, exact: bool
) -> PathFit:
    """The fit from a state; effects without values start where they promise most, one after the other."""
    fresh = [
        effect
        for effect in state.effects
        if effect.fixed != {parameter.name for parameter in effect.parameters}
        # A value shared by all runs is no start for the clock of each run.
        and (effect.is_neutral or (effect.id in path.clocks and not state.has_own(effect.id)))
    ]
    fit = fit_path(path, state.drop([effect.id for effect in fresh]), per_run=per_run)
    for effect in fresh:
        extended = fit.state.add(effect)
        matrix = Matrix(fit, [Unset(effect)], data.largest)
        for best in matrix.list_singles():
            extended = matrix.list_states(best)[0]
            started = extended.find(effect.id)
            # Values that the start does not change may be fitted here.
            extended = extended if started is None else extended.add(effect.change(**started.values))
        fit = fit_path(path, extended, noise=fit.noise, per_run=per_run)
    return _write_down(settle(fit)) if exact else fit


def _write_down(fit: PathFit) -> PathFit:
    """The fit at values as model files have them."""
    state = fit.state.hold([effect.rounded for effect in fit.state.effects])
    return replace(fit, state=state.centred, residual=fit.path.find_residuals(state))
