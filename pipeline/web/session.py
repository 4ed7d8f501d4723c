"""A session: the model of a run that a user edits, and its steps, which can be undone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from pipeline.estimation.additions import explain_refusals, list_beyond, weigh_addition
from pipeline.estimation.driving_need import list_numbers
from pipeline.models import Effect, Model, ModelFile, Number, find_effect, name_term
from pipeline.results import Errors, RunDiagnosis, Step, read_diagnosed, read_model
from pipeline.web import WorkbenchError
from pipeline.web.cards import show_addition
from pipeline.web.figures import Shown
from pipeline.web.prepared import FittedModel, PreparedRun
from pipeline.words import format_refusals

_MOST_STEPS = 200


@dataclass(frozen=True, kw_only=True)
class Edit:
    """One model of a session with its results.

    Attributes:
        said: short text of the action.
        model: the model.
        order: ids of its effects in the order in which they were added.
        numbers: of the last fit by label ``effect.parameter``, with what the driving makes doubtful.
        wheel_delay_s: delay of the recorded wheels [s].
        ladder: from the ideal model upwards.
        without: error over 2 s without one effect [m], by id.
        by_hand: whether values were set by hand since the last fit.
        refused: reasons why effects of the model are refused, by id.
    """

    said: str
    model: Model
    order: tuple[str, ...] = ()
    numbers: Mapping[str, Number]
    wheel_delay_s: float = 0.0
    ladder: tuple[Step, ...] = ()
    without: Mapping[str, float]
    by_hand: bool = False
    refused: Mapping[str, str]


@dataclass(frozen=True)
class Session:
    """All steps of a model; every operation returns a changed copy.

    Attributes:
        prepared: the run.
        diagnosis: of the run; None if it has not been diagnosed.
        steps: the oldest first.
        at: index of the current step; later ones can be redone.
    """

    prepared: PreparedRun
    diagnosis: RunDiagnosis | None
    steps: tuple[Edit, ...]
    at: int = 0

    @property
    def step(self) -> Edit:
        """The current step."""
        return self.steps[self.at]

    @cached_property
    def named(self) -> list[Effect]:
        """Effects of the run's diagnosis, with their values."""
        file = None if self.diagnosis is None else read_model(self.diagnosis)
        return [] if file is None else list(file.model)

    @cached_property
    def diagnosed(self) -> tuple[Effect, ...]:
        """What the diagnosis of the run found, its formula too: fits of these effects begin at its values."""
        return () if self.diagnosis is None else read_diagnosed(self.diagnosis, self.prepared.vehicle)

    @property
    def floor(self) -> Errors:
        """The noise floor of the run: that of its diagnosis, else what the ideal model shows."""
        known: dict[str, Errors | None] = {}
        if self.diagnosis is not None:
            known = {name: one.noise_floor for name, one in self.diagnosis.by_path.items()}
            known[self.diagnosis.input] = self.diagnosis.noise_floor
        return known.get(self.prepared.data.source.value) or self.prepared.floor

    def show(self) -> Shown:
        """The current model on its run."""
        step = self.step
        return self.prepared.show(step.model, step.wheel_delay_s, step.ladder, self.floor)

    def begin(self, model: Model) -> Model:
        """The model from which a fit begins: effects of the diagnosis have the values that it gives them.

        So a model has the errors that the diagnosis gives it, whatever was fitted or set before, and in
        whichever order its effects were added.
        """
        known = (one for one in self.diagnosed if one.id in model)
        return model.swap(*(one for one in known if not model.effect(one.id).fixed))

    def list_offers(self) -> list[dict[str, object]]:
        """What the diagnosis has beyond the model and would be accepted, as JSON, the largest gain first."""
        prepared, step, model = self.prepared, self.step, self.begin(self.step.model)
        before = prepared.judge(model).step
        missing = list_beyond(prepared.data, model, self.diagnosed)
        weighed = (weigh_addition(before, prepared.judge(model + one).step, one.id) for one in missing)
        accepted = [one for one in weighed if one is not None and not one.refusal]
        errors = prepared.score(step.model, step.wheel_delay_s)
        ordered = sorted(accepted, key=lambda one: one.remaining)
        return [show_addition(one, errors, model, prepared.asked) for one in ordered]

    def add(self, effects: Sequence[Effect | str], *, anyway: bool = False) -> Session:
        """Add effects to the model at once, and fit the whole model.

        Raises:
            WorkbenchError: ``no_help``, one is refused and ``anyway`` is false.
        """
        known = {one.id: one for one in self.diagnosed}
        made = [(known.get(one) or find_effect(one)()) if isinstance(one, str) else one for one in effects]
        model = self.begin(self.step.model)
        for one in made:
            model = model + one
        names = [name_term(one.id) for one in made]
        said = f"+ {names[0]}" if len(names) == 1 else f"+ all {len(names)} of the diagnosis"
        changed = self._fit(model, (*self.step.order, *(one.id for one in made)), said)
        refusals = {one.id: why for one in made if (why := changed.step.refused.get(one.id))}
        # The diagnosis tested its effects together with all others.
        if refusals and not anyway and not {one.id for one in made} <= set(known):
            raise WorkbenchError(
                "no_help",
                f"{format_refusals(refusals)}: the model is unchanged",
                where=self.prepared.manifest.run,
                hint="Choose another effect, or apply it anyway",
            )
        return changed

    def drop(self, name: str) -> Session:
        """Remove an effect and fit the rest."""
        order = tuple(each for each in self.step.order if each != name)
        return self._fit(self.begin(self.step.model) - name, order, f"\u2212 {name}")

    def fit(self) -> Session:
        """Fit all values that are not held fixed, starting from the present ones."""
        return self._fit(self.step.model, self.step.order, "fit", afresh=True)

    def set_value(self, name: str, parameter: str, value: float) -> Session:
        """Set a value of an effect by hand, without a fit."""
        step = self.step
        model = step.model.change(name, **{parameter: value})
        errors, known = self.prepared.score(model, step.wheel_delay_s), self.prepared.find_fit(model)
        changed = replace(
            step,
            said=f"{name}: {parameter} = {value:.4g}",
            model=model,
            ladder=(*step.ladder[:-1], self._measure(step.ladder[-1].effects, errors)),
            numbers={} if known is None else self._list_numbers(known),
            by_hand=known is None,
        )
        return self._push(changed)

    def lock(self, name: str, parameter: str) -> Session:
        """Hold a value fixed in fits, or release it."""
        effect = self.step.model.effect(name)
        is_held = parameter in effect.fixed
        changed = effect.loosen(parameter) if is_held else effect.fix(parameter)
        said = f"{name}.{parameter} {'unlocked' if is_held else 'locked'}"
        return self._push(replace(self.step, said=said, model=self.step.model.swap(changed)))

    def move(self, by: int) -> Session:
        """The session some steps back (negative) or forward, limited to the existing steps."""
        return replace(self, at=min(max(self.at + by, 0), len(self.steps) - 1))

    def format_file(self) -> ModelFile:
        """The model as it is saved: with the data of its fit, unless values were set by hand since."""
        file = ModelFile(self.step.model, numbers=self.step.numbers)
        is_fitted = file.model.effects and not self.step.by_hand
        return self.prepared.note_fit(file) if is_fitted else file

    def _list_numbers(self, judged: FittedModel) -> dict[str, Number]:
        return list_numbers(self.prepared.data, judged.step.fitted, judged.estimates)

    def _push(self, step: Edit) -> Session:
        steps = (*self.steps[: self.at + 1], step)[-_MOST_STEPS:]
        return replace(self, steps=steps, at=len(steps) - 1)

    def _fit(self, model: Model, order: Sequence[str], said: str, *, afresh: bool = False) -> Session:
        """Fit a model; the steps of its ladder are in the order in which effects were added.

        Args:
            model: the model, with values to start from.
            order: order of its effects.
            said: short text of the action.
            afresh: whether to refit steps that were fitted before.
        """
        step, prepared = self.step, self.prepared
        judged = prepared.judge(model)
        fitted = judged.step.fitted.model
        shown = tuple(name for name in order if name in fitted)
        # After a change by hand the last step is not fitted.
        rungs = () if afresh else step.ladder[: len(step.ladder) - step.by_hand]
        known = {one.effects: one for one in rungs}
        below = [
            known.get(shown[:count])
            or self._measure(shown[:count], prepared.measure_errors(self.begin(fitted.keep(shown[:count]))))
            for count in range(len(shown))
        ]
        delay = judged.step.fitted.state.timing[0].wheel_delay_s
        changed = Edit(
            said=said,
            model=model.swap(*(one.rounded for one in fitted)),
            order=tuple(order),
            numbers=self._list_numbers(judged),
            wheel_delay_s=delay,
            ladder=(*below, self._measure(shown, judged.step.errors)),
            without={name: prepared.score(fitted - name, delay).t_mrmse_m for name in shown},
            refused=explain_refusals(judged.step, shown),
        )
        prepared.remember(changed.model, judged)
        return self._push(changed)

    def _measure(self, effects: tuple[str, ...], errors: Errors) -> Step:
        if not math.isfinite(errors.t_mrmse_m + errors.r_mrmse_rad):
            raise WorkbenchError(
                "not_finite",
                "with that the model predicts no finite motion on this run",
                where=self.prepared.manifest.run,
                hint="The model is unchanged; take other values or another formula.",
            )
        return Step.of(errors, effects)


def open_session(prepared: PreparedRun, diagnosis: RunDiagnosis | None) -> Session:
    """A new session with the ideal model, fitted."""
    step = Edit(said="ideal model", model=Model(prepared.vehicle), numbers={}, without={}, refused={})
    fitted = Session(prepared, diagnosis, (step,)).fit()
    return Session(prepared, diagnosis, (replace(fitted.step, said=step.said),))
