"""Both sides of a check fitted with one model, and baseline files."""

import contextlib
import itertools
import json
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import msgspec
import numpy as np

from pipeline.core import INPUTS, NORMAL_95, Floats, SlipError, finite_or_none, read_bounded
from pipeline.datasets.changes import AFTER, BEFORE, RunNumbers, Side
from pipeline.datasets.check_readings import (
    LOGARITHMS,
    Label,
    RunReading,
    list_labels,
    measure_slip,
    read_run,
)
from pipeline.datasets.compared_runs import find_run_refusal
from pipeline.datasets.pooling import ComparisonError
from pipeline.datasets.stored_fits import read_runs
from pipeline.estimation.run_residuals import Input, choose_input
from pipeline.estimation.stored_diagnosis import diagnose_stored, find_diagnosis, keep_diagnosis
from pipeline.models import (
    Effect,
    FormulaEffect,
    Model,
    ModelFile,
    format_model,
    is_of_one_run,
    list_effects,
    parse_model,
)
from pipeline.recording.log_setup import UNKNOWN
from pipeline.results import read_model
from pipeline.run import MotionRun, load_motion_run
from pipeline.sources import Owner, agree_on_vehicle, load_vehicle
from pipeline.store import Manifest, Store, StoreError, decode_stored

BASELINE_FORMAT = 1
_MOST_OF_SPREAD = 16
"""Runs that determine a spread between runs: more take longer and change a limit by less than a twentieth."""
_MOST = 0.5
"""Smallest fraction of a side's runs whose model has an effect: an effect of one run of many is its own."""
_ROUNDING = 1e-6
"""Tolerance of the symmetry and of negative eigenvalues of a correlation matrix."""
_MOST_LOGARITHM = 30.0
"""Largest absolute logarithm of an error or a slip in a valid baseline: exp(30) is 1e13 m."""
Kind = Literal["runs", "model", "baseline"]


class _StoredRun(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One run of a baseline, see `RunReading`; unknown values are null."""

    run: str
    sha256: str
    terrain: str
    pace: float
    values: list[float | None]
    covariance: list[list[float | None]]
    slip: tuple[float | None, float | None]


class _StoredBaseline(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of a baseline file."""

    format: int
    input: Literal["command", "measured"]
    model: str
    numbers: list[str]
    runs: list[_StoredRun]


@dataclass(frozen=True)
class Baseline:
    """Stored estimates of runs, as the reference of later checks.

    Attributes:
        model: model that the runs were fitted with.
        source: input of the model.
        names: names of the quantities.
        readings: estimates of the runs.
    """

    model: ModelFile
    source: Input
    names: tuple[str, ...]
    readings: tuple[RunReading, ...]


@dataclass(frozen=True)
class Sides:
    """Both sides of a check, fitted with one model.

    Attributes:
        kind: kind of the side BEFORE.
        model: model of both sides.
        source: input of the model.
        labels: compared parameters.
        before, after: estimates of the runs; a model file as BEFORE counts as one run with its values.
        notes: excluded runs with the reasons, and warnings.
        others: further runs of the vehicle on the same terrains, by terrain: they tell how much runs differ.
    """

    kind: Kind
    model: ModelFile
    source: Input
    labels: tuple[Label, ...]
    before: tuple[RunReading, ...]
    after: tuple[RunReading, ...]
    notes: tuple[str, ...] = ()
    others: Mapping[str, tuple[RunReading, ...]] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the quantities of each run, the logarithms last."""
        return (*(label.name for label in self.labels), *LOGARITHMS)

    @property
    def terrains(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Terrains of both sides."""
        before, after = (
            tuple(sorted({one.terrain for one in side if one.terrain})) for side in (self.before, self.after)
        )
        return before, after


def read_sides(
    before: Sequence[Manifest] | ModelFile | Baseline,
    after: Sequence[Manifest],
    store: Store,
    *,
    source: str | None = None,
    owner: Owner | None = None,
) -> Sides:
    """Fit one model to both sides of a check.

    A model file or a baseline defines the model. For runs, the model has the effects that the diagnoses of at
    least half of the runs of either side identify; runs without a diagnosis are diagnosed first.

    Args:
        before: runs, a model file, or a baseline.
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
    given = None if isinstance(before, Sequence) else before
    file = before.model if isinstance(before, Baseline) else given if isinstance(given, ModelFile) else None
    manifests, notes_before = _leave_out_refused(before if isinstance(before, Sequence) else (), BEFORE)
    after, notes_after = _leave_out_refused(after, AFTER)
    everything = [*manifests, *after]
    known = before.readings if isinstance(before, Baseline) else ()
    _refuse_shared([*map(_digest, manifests), *(one.sha256 for one in known)], after)
    vehicle, runs = read_runs(everything, None if file is None else file.model.vehicle, owner)
    models = {one.run: _find_model(one, store, is_needed=file is None) for one in everything}
    starts = {run: model for run, model in models.items() if model is not None}
    if file is None:
        united = unite_effects(*([models[one.run] for one in side] for side in (manifests, after)))
        file = ModelFile(Model(vehicle, united))
    file = replace(file, model=replace(file.model, vehicle=vehicle))
    if isinstance(before, Baseline):
        file = replace(file, fit={**file.fit, "input": before.source.value})
    sides: dict[Side, Sequence[MotionRun]] = {BEFORE: runs[: len(manifests)], AFTER: runs[len(manifests) :]}
    both = read_under(file, sides, source, known=known, starts=starts)
    slips = {one.run: measure_slip(one.read("slip"), both.source) for one in everything}
    held = {*(_digest(one) for one in everything), *(one.sha256 for one in known)}
    others = _read_others(_list_others(store, both, held), both, store)
    names: dict[type, Kind] = {Baseline: "baseline", ModelFile: "model"}
    return replace(
        both,
        kind=names.get(type(before), "runs"),
        before=tuple(_note_slip(one, slips) for one in both.before),
        after=tuple(_note_slip(one, slips) for one in both.after),
        notes=(*notes_before, *notes_after, *both.notes),
        others=others,
    )


def _list_others(store: Store, sides: Sides, held: Collection[str]) -> list[Manifest]:
    """Further runs of the vehicle on the terrains of a check; none where enough runs are on its sides."""
    room = _MOST_OF_SPREAD - len(sides.before) - len(sides.after)
    terrains = {*itertools.chain(*sides.terrains)} - {UNKNOWN}
    if room <= 0 or not terrains:
        return []
    others: dict[str, Manifest] = {}
    for manifest in store.survey().manifests:
        is_here = manifest.details.get("terrain") in terrains
        if is_here and manifest.part("vehicle").get("id") == sides.model.model.vehicle.id:
            digest = _digest(manifest)
            if digest and digest not in held and not find_run_refusal(manifest):
                others.setdefault(digest, manifest)
    return [*others.values()][-room:]


def _read_others(
    manifests: Sequence[Manifest], sides: Sides, store: Store
) -> dict[str, tuple[RunReading, ...]]:
    """Estimates of further runs by terrain; what cannot be fitted, and what is alone, tells no spread."""
    vehicle = sides.model.model.vehicle
    readings: dict[str, list[RunReading]] = {}
    for manifest in manifests:
        own = _find_model(manifest, store, is_needed=False) or ()
        start = sides.model.model.swap(*(effect for effect in own if effect.id in sides.model.model))
        with contextlib.suppress(SlipError):
            agree_on_vehicle(vehicle, {manifest.run: load_vehicle(manifest)}, None)
            run = load_motion_run(manifest, vehicle)
            reading = read_run(run, start, sides.source, sides.labels, BEFORE)
            readings.setdefault(reading.terrain, []).append(reading)
    return {terrain: tuple(runs) for terrain, runs in readings.items() if len(runs) > 1}


def _leave_out_refused(manifests: Sequence[Manifest], side: Side) -> tuple[list[Manifest], list[str]]:
    """Runs of a side to which a fit has a meaning, and notes on the others; an error where none has."""
    refused = {one.run: why for one in manifests if (why := find_run_refusal(one))}
    sound = [one for one in manifests if one.run not in refused]
    reasons = [f"{run}: {why}" for run, why in refused.items()]
    if refused and not sound:
        what = f"no run {side.upper()} can be compared: {'; '.join(reasons)}"
        raise ComparisonError("nothing_to_compare", what, hint="Give other runs.")
    return sound, [f"left out: {reason}" for reason in reasons]


def _note_slip(reading: RunReading, slips: Mapping[str, tuple[float, float]]) -> RunReading:
    return replace(reading, slip=slips.get(reading.numbers.run, reading.slip))


def read_under(
    file: ModelFile,
    runs: Mapping[Side, Sequence[MotionRun]],
    source: str | None = None,
    *,
    known: Sequence[RunReading] = (),
    starts: Mapping[str, Model] = MappingProxyType({}),
) -> Sides:
    """Fit a model to the runs of both sides.

    Args:
        file: the model, with the vehicle whose geometry is used.
        runs: runs of both sides; if BEFORE has none, the values of the model take its place.
        source: `command` or `measured`; None chooses.
        known: estimates of BEFORE from a baseline.
        starts: models of single runs, by name, from whose values the fit to that run starts: on ice a fit
            that starts from the friction of asphalt does not find its own.

    Raises:
        ComparisonError: ``nothing_to_compare``: no run of a side can be fitted.
        MotionError: the runs lack the input.
    """
    chosen = choose_input([*runs[BEFORE], *runs[AFTER]], source, file.model, last=file.last_input)
    labels = tuple(list_labels(file.model, file.per_run))
    notes = [chosen.warning] if chosen.warning else []
    readings: dict[Side, list[RunReading]] = {BEFORE: list(known), AFTER: []}
    for side in (BEFORE, AFTER):
        for run in runs[side]:
            own = starts.get(run.name, ())
            start = file.model.swap(*(effect for effect in own if effect.id in file.model))
            try:
                readings[side].append(read_run(run, start, chosen.source, labels, side))
            except SlipError as error:
                notes.append(f"left out: {error}")
    if not runs[BEFORE] and not known:
        readings[BEFORE].append(_read_model(file, labels))
    for side in (BEFORE, AFTER):
        if not readings[side]:
            what = f"no run {side.upper()} can be compared: {'; '.join(notes)}"
            raise ComparisonError("nothing_to_compare", what, hint="Give other runs, or drive longer.")
    before, after = (tuple(readings[side]) for side in (BEFORE, AFTER))
    return Sides("runs", file, chosen.source, labels, before, after, tuple(notes))


def _digest(manifest: Manifest) -> str:
    return str(manifest.part("log").get("sha256", ""))


def _refuse_shared(before: Sequence[str], after: Sequence[Manifest]) -> None:
    """Raise an error if a recording, identified by its SHA-256, is on both sides."""
    held = {one for one in before if one}
    shared = sorted({one.run for one in after if _digest(one) in held})
    if shared:
        what = f"a run is on both sides: {', '.join(shared)}"
        raise ComparisonError("same_run", what, hint="Give runs before the change, and others after it.")


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
    count = len(labels) + len(LOGARITHMS)
    values, deviations = np.full(count, np.nan), np.full(count, np.nan)
    for index, label in enumerate(labels):
        is_stated = not file.intervals or label.name in file.intervals
        if not (is_stated or label.parameter.name in label.effect.fixed):
            continue
        low, high = file.intervals.get(label.name, (0.0, 0.0))
        values[index] = label.effect.values[label.parameter.name]
        deviations[index] = max(0.5 * (high - low) / NORMAL_95, 0.0)
    terrains = {str(run.get("terrain")) for run in file.list_fitted("runs")}
    covariance = np.diag(deviations**2)
    numbers = RunNumbers("model", BEFORE, values, covariance)
    return RunReading(numbers, "", terrains.pop() if len(terrains) == 1 else "", math.nan)


def format_baseline(sides: Sides) -> str:
    """Text of a baseline file: the side AFTER, as the reference of later checks."""
    stored = _StoredBaseline(
        format=BASELINE_FORMAT,
        input=sides.source.value,
        model=format_model(sides.model),
        numbers=list(sides.names),
        runs=[
            _StoredRun(
                one.numbers.run,
                one.sha256,
                one.terrain,
                one.pace,
                _list(one.numbers.values),
                [_list(row) for row in one.numbers.covariance],
                (finite_or_none(one.slip[0]), finite_or_none(one.slip[1])),
            )
            for one in sides.after
        ],
    )
    return json.dumps(msgspec.to_builtins(stored), indent=1, allow_nan=False) + "\n"


def _list(values: Floats) -> list[float | None]:
    return [finite_or_none(value) for value in values.tolist()]


def read_baseline(path: Path) -> Baseline:
    """Read a baseline file that a check has written.

    Raises:
        ComparisonError: ``bad_baseline``: it does not exist, or is not a valid baseline.
        MotionError: its model cannot be read.
    """
    hint = "Keep one anew: slip check BEFORE AFTER --keep FILE."
    try:
        stored = decode_stored(read_bounded(path), _StoredBaseline, path)
    except OSError as error:
        what = f"the baseline cannot be read ({error.strerror})"
        raise ComparisonError("bad_baseline", what, where=str(path), hint=hint) from error
    except StoreError as error:
        what = f"this is not a baseline: {error.what}"
        raise ComparisonError("bad_baseline", what, where=str(path), hint=hint) from error
    file = parse_model(stored.model, path)
    names = (*(label.name for label in list_labels(file.model, file.per_run)), *LOGARITHMS)
    count = len(names)
    fits = all(
        len(run.values) == count and [len(row) for row in run.covariance] == [count] * count
        for run in stored.runs
    )
    is_ours = stored.format == BASELINE_FORMAT and tuple(stored.numbers) == names
    readings = tuple(map(_open_run, stored.runs)) if fits and is_ours else ()
    if not (readings and all(map(_is_sound, readings))):
        what = "the baseline is of another version, or its numbers are not those of fits of its model"
        raise ComparisonError("bad_baseline", what, where=str(path), hint=hint)
    return Baseline(file, Input(stored.input), names, readings)


def _open_run(run: _StoredRun) -> RunReading:
    slip = _array(run.slip)
    numbers = RunNumbers(run.run, BEFORE, _array(run.values), _array(run.covariance))
    return RunReading(numbers, run.sha256, run.terrain, run.pace, (float(slip[0]), float(slip[1])))


def _is_sound(reading: RunReading) -> bool:
    """Whether a fit can give these estimates: the covariance is valid, and the robot moved."""
    rows = np.flatnonzero(reading.numbers.known)
    covariance = reading.numbers.covariance[np.ix_(rows, rows)]
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    logarithms = np.append(reading.numbers.values[-len(LOGARITHMS) :], reading.slip[0])
    if not (size > 0.0).all() or not reading.pace > 0.0 or (np.abs(logarithms) > _MOST_LOGARITHM).any():
        return False
    correlation = covariance / np.outer(size, size)
    if not np.allclose(correlation, correlation.T, atol=_ROUNDING):
        return False
    return bool(np.linalg.eigvalsh(correlation).min(initial=1.0) > -_ROUNDING)


def _array(values: Sequence[object]) -> Floats:
    """Array of values, NaN for None."""
    return np.array(values, dtype=np.float64)
