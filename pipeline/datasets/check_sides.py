"""Both sides of a check, each run fitted with one model."""

import contextlib
import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from pipeline.core import INPUTS, NORMAL_95, SlipError
from pipeline.datasets.check_readings import Label, RunReading, list_labels, measure_slip, read_run
from pipeline.datasets.compared_runs import find_run_refusal, read_digest
from pipeline.datasets.corrections import note_corrections
from pipeline.datasets.pooling import ComparisonError
from pipeline.datasets.robots import note_robots
from pipeline.datasets.stored_fits import read_runs
from pipeline.estimation.run_residuals import Input, choose_input
from pipeline.estimation.stored_diagnosis import diagnose_stored, find_diagnosis, keep_diagnosis
from pipeline.models import Effect, FormulaEffect, Model, ModelFile, is_of_one_run, list_effects
from pipeline.recording.log_setup import UNKNOWN
from pipeline.results import read_model
from pipeline.run import MotionRun, load_motion_run
from pipeline.sources import Owner, agree_on_vehicle, load_vehicle
from pipeline.store import Manifest, Store

BEFORE, AFTER = "before", "after"
_MOST_OF_SPREAD = 16
"""Runs that determine a spread between runs: more take longer and change a limit by less than a twentieth."""
_MOST = 0.5
"""Smallest fraction of a side's runs whose model has an effect: an effect of one run of many is its own."""


@dataclass(frozen=True)
class Sides:
    """Both sides of a check, fitted with one model.

    Attributes:
        model: model of both sides.
        source: input of the model.
        labels: compared parameters.
        before, after: estimates of the runs; a model file as BEFORE counts as one run with its values.
        notes: excluded runs with the reasons, and warnings.
        others: further runs of the vehicle on the same terrains, by terrain: several of one tell how much
            runs differ.
        is_model: whether BEFORE is a model file.
    """

    model: ModelFile
    source: Input
    labels: tuple[Label, ...]
    before: tuple[RunReading, ...]
    after: tuple[RunReading, ...]
    notes: tuple[str, ...] = ()
    others: Mapping[str, tuple[RunReading, ...]] = field(default_factory=dict)
    is_model: bool = False

    @property
    def terrains(self) -> tuple[list[str], list[str]]:
        """Terrains of both sides."""
        before, after = (sorted({one.terrain for one in side} - {""}) for side in (self.before, self.after))
        return before, after

    @property
    def paces(self) -> tuple[float, float]:
        """Root mean square ideal speed of both sides [m/s], see `RunReading`; NaN of a model."""
        before, after = (float(np.mean([one.pace for one in side])) for side in (self.before, self.after))
        return before, after

    @property
    def grouped(self) -> list[tuple[str, RunReading]]:
        """All runs with their group: the side, or the terrain of further runs."""
        sides = [(BEFORE, self.before), (AFTER, self.after)]
        sides += [(f"others on {name}", runs) for name, runs in self.others.items()]
        return [(name, reading) for name, runs in sides for reading in runs]


def read_sides(
    before: Sequence[Manifest] | ModelFile,
    after: Sequence[Manifest],
    store: Store,
    *,
    source: str | None = None,
    owner: Owner | None = None,
) -> Sides:
    """Fit one model to both sides of a check.

    A model file defines the model. For runs, the model has the effects that the diagnoses of at
    least half of the runs of either side identify; runs without a diagnosis are diagnosed first.

    Args:
        before: runs, or a model file.
        after: runs.
        store: results that contain the runs.
        source: `command` or `measured`; None chooses.
        owner: geometry to use where vehicles differ.

    Raises:
        SlipError: no run of a side can be fitted; vehicles differ; a run is on both sides.
    """
    for side, runs_of in ((BEFORE, before), (AFTER, after)):
        if isinstance(runs_of, Sequence) and not runs_of:
            what = f"the check has no runs {side.upper()}"
            raise ComparisonError("no_runs", what, hint="Give logs, or runs of the results.")
    file = before if isinstance(before, ModelFile) else None
    manifests, notes_before = _leave_out_refused(() if isinstance(before, ModelFile) else before, BEFORE)
    after, notes_after = _leave_out_refused(after, AFTER)
    everything = [*manifests, *after]
    held = {read_digest(one) for one in manifests}
    if shared := sorted({one.run for one in after if read_digest(one) in held}):
        what = f"a run is on both sides: {', '.join(shared)}"
        raise ComparisonError("same_run", what, hint="Give runs before the change, and others after it.")
    vehicle, runs = read_runs(everything, None if file is None else file.model.vehicle, owner)
    models = {one.run: _find_model(one, store, is_needed=file is None) for one in everything}
    starts = {run: model for run, model in models.items() if model is not None}
    if file is None:
        united = unite_effects(*([models[one.run] for one in side] for side in (manifests, after)))
        file = ModelFile(Model(vehicle, united))
    file = replace(file, model=replace(file.model, vehicle=vehicle))
    sides = (runs[: len(manifests)], runs[len(manifests) :])
    both = read_under(file, sides, source, starts=starts)
    slips = {one.run: measure_slip(one.read("slip"), both.source) for one in everything}
    known = [
        tuple(replace(one, slip=slips.get(one.run, one.slip)) for one in side)
        for side in (both.before, both.after)
    ]
    others = _list_others(store, both, {read_digest(one) for one in everything})
    return replace(
        both,
        before=known[0],
        after=known[1],
        notes=(
            *notes_before,
            *notes_after,
            *note_robots(everything),
            *note_corrections(store, everything),
            *both.notes,
        ),
        others=_read_others(others, both, store),
    )


def _list_others(store: Store, sides: Sides, held: Collection[str]) -> list[Manifest]:
    """Further runs of the vehicle on the terrains of a check; none where enough runs are on its sides."""
    room = _MOST_OF_SPREAD - len(sides.before) - len(sides.after)
    terrains = {*itertools.chain(*sides.terrains)} - {UNKNOWN}
    others: dict[str, Manifest] = {}
    for manifest in store.survey().manifests if room > 0 else ():
        is_here = manifest.details.get("terrain") in terrains
        if is_here and manifest.part("vehicle").get("id") == sides.model.model.vehicle.id:
            digest = read_digest(manifest)
            if digest not in held and not find_run_refusal(manifest):
                others.setdefault(digest, manifest)
    return [*others.values()][-max(room, 1) :]


def _read_others(
    manifests: Sequence[Manifest], sides: Sides, store: Store
) -> dict[str, tuple[RunReading, ...]]:
    """Estimates of further runs by terrain, of those that can be fitted."""
    vehicle = sides.model.model.vehicle
    readings: dict[str, list[RunReading]] = {}
    for manifest in manifests:
        own = _find_model(manifest, store, is_needed=False) or ()
        start = sides.model.model.swap(*(effect for effect in own if effect.id in sides.model.model))
        with contextlib.suppress(SlipError):
            agree_on_vehicle(vehicle, {manifest.run: load_vehicle(manifest)}, None)
            reading = read_run(load_motion_run(manifest, vehicle), start, sides.source, sides.labels)
            readings.setdefault(reading.terrain, []).append(reading)
    return {terrain: tuple(runs) for terrain, runs in readings.items()}


def _leave_out_refused(manifests: Sequence[Manifest], side: str) -> tuple[list[Manifest], list[str]]:
    """Runs of a side to which a fit has a meaning, and notes on the others; an error where none has."""
    refused = {one.run: why for one in manifests if (why := find_run_refusal(one))}
    sound = [one for one in manifests if one.run not in refused]
    reasons = [f"{run}: {why}" for run, why in refused.items()]
    if refused and not sound:
        what = f"no run {side.upper()} can be compared: {'; '.join(reasons)}"
        raise ComparisonError("nothing_to_compare", what, hint="Give other runs.")
    return sound, [f"left out: {reason}" for reason in reasons]


def read_under(
    file: ModelFile,
    runs: tuple[Sequence[MotionRun], Sequence[MotionRun]],
    source: str | None = None,
    *,
    starts: Mapping[str, Model] = MappingProxyType({}),
) -> Sides:
    """Fit a model to the runs of both sides.

    Args:
        file: the model, with the vehicle whose geometry is used.
        runs: runs before and after; if there are none before, the values of the model take their place.
        source: `command` or `measured`; None chooses.
        starts: models of single runs, by name, from whose values the fit to that run starts: on ice a fit
            that starts from the friction of asphalt does not find its own.

    Raises:
        ComparisonError: ``nothing_to_compare``: no run of a side can be fitted.
        MotionError: the runs lack the input.
    """
    chosen = choose_input([*runs[0], *runs[1]], source, file.model, last=file.last_input)
    labels = tuple(list_labels(file.model, file.per_run))
    notes = [chosen.warning] if chosen.warning else []
    sides: list[list[RunReading]] = [[], []]
    for readings, side in zip(sides, runs, strict=True):
        for run in side:
            own = starts.get(run.name, ())
            start = file.model.swap(*(effect for effect in own if effect.id in file.model))
            try:
                readings.append(read_run(run, start, chosen.source, labels))
            except SlipError as error:
                notes.append(f"left out: {error}")
    is_model = not runs[0]
    if is_model:
        sides[0].append(_read_model(file, labels))
    for name, readings in zip((BEFORE, AFTER), sides, strict=True):
        if not readings:
            what = f"no run {name.upper()} can be compared: {'; '.join(notes)}"
            raise ComparisonError("nothing_to_compare", what, hint="Give other runs, or drive longer.")
    before, after = map(tuple, sides)
    return Sides(file, chosen.source, labels, before, after, tuple(notes), is_model=is_model)


def _find_model(manifest: Manifest, store: Store, *, is_needed: bool) -> Model | None:
    """The model from the diagnosis of a run; None if it identified no effect or refused the run.

    Args:
        manifest: the run.
        store: the results.
        is_needed: whether a run without a diagnosis is diagnosed; otherwise it has no model.
    """
    diagnosis = find_diagnosis(store.root, manifest)
    if diagnosis is None and not is_needed:
        return None
    if diagnosis is None:
        diagnosis = diagnose_stored([manifest], INPUTS, None, None, None)
        keep_diagnosis(store.root, manifest, diagnosis)
    file = read_model(diagnosis)
    return None if file is None else file.model


def unite_effects(*sides: Sequence[Model | None]) -> tuple[Effect, ...]:
    """Effects in the models of at least half of the runs of a side, with the medians of their parameters.

    Excluded are formulas, which describe one run, effects that start within one recording, and effects that
    another one contains, unless a model has both. If only the ratio of an effect to another is observable,
    the other one is added; otherwise a change of one would be attributed to the other.
    """
    held: dict[str, list[Effect]] = {}
    wanted: set[str] = set()
    for side in sides:
        count: dict[str, int] = {}
        for model in side:
            for effect in model or ():
                if not isinstance(effect, FormulaEffect) and not is_of_one_run(effect.parameters):
                    held.setdefault(effect.id, []).append(effect)
                    count[effect.id] = count.get(effect.id, 0) + 1
        wanted |= {name for name, times in count.items() if times >= _MOST * len(side)}
    effects = [_average(held[name]) for name in wanted]
    models = [set(model.ids) for side in sides for model in side if model is not None]

    def is_common(one: Effect) -> bool:
        extended = {other.id for other in effects if one.id in other.contains}
        return not extended or any(one.id in ids and extended & ids for ids in models)

    united = list(filter(is_common, effects))
    names = {effect.id for effect in united}
    others = (effect() for effect in list_effects() if effect.id not in names)
    united += [one for one in others if any(effect.depends_on(one) for effect in united)]
    return tuple(sorted(united, key=lambda effect: (effect.place, effect.rank, effect.id)))


def _average(effects: Sequence[Effect]) -> Effect:
    names = effects[0].values
    return effects[0].change(
        **{name: float(np.median([effect.values[name] for effect in effects])) for name in names}
    )


def _read_model(file: ModelFile, labels: Sequence[Label]) -> RunReading:
    """The values of a model file as the estimates of one run.

    Without any interval they count as exact. Else those that are not fixed and have none are undetermined.
    """
    estimates = {}
    is_fitted = any(math.isfinite(number.low) for number in file.numbers.values())
    for label in labels:
        name = label.parameter.name
        number = file.find_number(label.effect, label.parameter)
        width = number.high - number.low
        if math.isfinite(width) or not is_fitted or name in label.effect.fixed:
            deviation = 0.5 * width / NORMAL_95 if math.isfinite(width) else 0.0
            estimates[label.name] = (number.value, deviation)
    terrains = {str(run.get("terrain")) for run in file.list_fitted("runs")}
    return RunReading("model", terrains.pop() if len(terrains) == 1 else "", math.nan, estimates)
