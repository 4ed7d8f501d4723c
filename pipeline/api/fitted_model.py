"""Models: a vehicle and effects, fitted to runs, as notebooks show them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Literal, Self

import polars as pl
from threadpoolctl import threadpool_limits

from pipeline.api.model_changes import carry_models, change_model, export_file, find_speeds, read_on_runs
from pipeline.core import INPUT_WORDS, finite_or_none, number_in, objects_in
from pipeline.datasets import ModelFit
from pipeline.estimation import EstimationData, ModelState
from pipeline.estimation.additions import Tries, find_refused
from pipeline.estimation.ladder import find_share_removed, judge_whole
from pipeline.estimation.largest import measure_asked
from pipeline.estimation.prediction import predict_at_from
from pipeline.estimation.stored_diagnosis import find_diagnosis
from pipeline.estimation.transfer import fit_as_it_is
from pipeline.models import (
    CHANNELS,
    Effect,
    FormulaEffect,
    ModelFile,
    Number,
    catalogue,
    find_effect,
    list_effects,
    list_own_effects,
    make_parameter,
    name_term,
    read_model,
    refuse_taken,
    write_model,
)
from pipeline.models import Model as MotionModel
from pipeline.report.motion_view import COMPONENTS, MotionStage, MotionView
from pipeline.report.page import ShownFigure, show_figures
from pipeline.report.scene import RunReport
from pipeline.results import RunDiagnosis, read_diagnosed, to_json
from pipeline.run import HORIZON_S, MotionError
from pipeline.sources import Owner, Vehicle, VehicleSection, resolve_vehicle
from pipeline.store import Manifest, Store
from pipeline.words import format_ladder, format_parameters
from schemas.run_tables import COUNTED

_ERRORS = ("t_mrmse_m", "r_mrmse_rad", "explained_share")
_DIGITS = 4


def tabulate_ladder(content: Mapping[str, object]) -> pl.DataFrame:
    """Steps of the ladder: what each adds, and the held-out errors over 2 s [m], [rad] with it."""
    rows, before = [], set[str]()
    for step in objects_in(content, "ladder"):
        effects = step.get("effects")
        names = [str(name) for name in effects] if isinstance(effects, list | tuple) else []
        added = ", ".join(name for name in names if name not in before)
        rows.append({"added": added or "ideal", **{key: number_in(step, key) for key in _ERRORS}})
        before |= set(names)
    return pl.DataFrame(rows, schema={"added": pl.String, **dict.fromkeys(_ERRORS, pl.Float64)})


def tabulate_parameters(
    numbers: Mapping[str, Number], own: Mapping[str, Mapping[str, Number]]
) -> pl.DataFrame:
    """Numbers by ``effect.parameter``: value, 95 % interval (null without one), unit, id of its doubt, run.

    Args:
        numbers: by label.
        own: those that runs have of their own, by label and run: a row each in place of the common one,
            whose run is null.
    """
    rows = [
        (label, *map(finite_or_none, (one.value, one.low, one.high)), number.unit, one.doubt, run)
        for label, number in numbers.items()
        for run, one in own.get(label, {None: number}).items()
    ]
    values = dict.fromkeys(("value", "low", "high"), pl.Float64)
    texts = dict.fromkeys(("unit", "doubt", "run"), pl.String)
    schema = {"parameter": pl.String, **values, **texts}
    return pl.DataFrame(rows, schema=schema, orient="row")


def write_html(title: str, frame: pl.DataFrame, notes: Sequence[str] = ()) -> str:
    """A small table with a title and lines below it; whatever stands in it is text, never markup."""
    head = "".join(f"<th>{escape(name)}</th>" for name in frame.columns)
    body = "".join(
        f"<tr>{''.join(f'<td>{escape(_format_cell(value))}</td>' for value in row)}</tr>"
        for row in frame.rows()
    )
    lines = "".join(f"<div>{escape(note)}</div>" for note in notes)
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>" if frame.height else ""
    return f"<div><b>{escape(title)}</b>{table}{lines}</div>"


def _format_cell(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.{_DIGITS}g}" if isinstance(value, float) else str(value)


Source = Literal["command", "measured"]

_PARTS = 3
_OVER_2S = ("t_mrmse_m", "r_mrmse_rad")


def effect(name: str, /, **values: float | str | tuple[str, float, float]) -> Effect:
    """An effect of the catalogue, or a formula of one's own.

    Args:
        name: its id, as `slip effects` lists it; or a new one for a formula.
        values: numbers by parameter, where a fit starts. Of a formula: texts for the channels ``v_x``,
            ``v_y``, ``v_w``, and for each parameter unit and bounds, ``k=("m/s", -1, 1)``.
    """
    texts = {key: value for key, value in values.items() if isinstance(value, str) and key in CHANNELS}
    tuples = {
        key: value for key, value in values.items() if isinstance(value, tuple) and len(value) == _PARTS
    }
    numbers = {key: value for key, value in values.items() if isinstance(value, int | float)}
    odd = [key for key in values if key not in {**texts, **(tuples if texts else numbers)}]
    if odd:
        hint = 'Give a number; for a formula a text v_x, v_y or v_w and unit and bounds k=("m/s", -1, 1).'
        raise MotionError(
            "bad_value", f"{values[odd[0]]!r} is not a value of {odd[0]}", where=f"effect {name}", hint=hint
        )
    if not texts:
        return find_effect(name)().change(**numbers)
    if not name.isidentifier():
        hint = "Use letters, digits and _, a letter first."
        raise MotionError("bad_value", f"{name!r} cannot be the id of an effect", where="effect", hint=hint)
    refuse_taken(name)
    for key, (_, low, high) in tuples.items():
        if not low < high:
            what = f"bounds of {key} must be two numbers, not {low} and {high}"
            raise MotionError("bad_value", what, where=f"effect {name}", hint=f'Write {key}=("m/s", -1, 1).')
    parameters = [make_parameter(key, unit, (low, high)) for key, (unit, low, high) in tuples.items()]
    return FormulaEffect(name, texts, tuple(parameters))


def effects() -> pl.DataFrame:
    """The physical effects that a model may have: the catalogue, and those of your own that were loaded.

    Returns:
        A row an effect: ``effect``, its id; ``term``, its name; ``sentence``, what happens; ``parameters``
        and ``units``, lists of the same length; ``kinds``, the vehicles that can have it.
    """
    return pl.DataFrame(
        [
            {
                "effect": one.id,
                "term": name_term(one.id),
                "sentence": one.find_page().partition("\n")[0].rpartition(": ")[2],
                "parameters": [each.name for each in one.parameters],
                "units": [each.unit for each in one.parameters],
                "kinds": list(one.kinds),
            }
            for one in (*list_effects(), *list_own_effects().values())
        ]
    )


def load_effects(*paths: str | Path) -> None:
    """Run Python files with effects of your own, which `effect` finds and model files may name from now on.

    Args:
        paths: the files, as `slip model new-effect` writes one.
    """
    catalogue.load_effects([Path(path) for path in paths])


class StoredRun:
    """The tables of an analyzed run.

    Args:
        manifest: its results.
        store: the folder of results.
    """

    def __init__(self, manifest: Manifest, store: Store) -> None:
        self.manifest = manifest
        self._store = store

    def table(self, name: str) -> pl.LazyFrame:
        """One of its tables."""
        return self.manifest.read(name).lazy()

    @property
    def slip(self) -> pl.LazyFrame:
        """Slip per time step: the table ``slip`` without the rows that medians leave out."""
        return self.table("slip").filter(COUNTED)

    def list_diagnosed(self, vehicle: Vehicle) -> tuple[Effect, ...]:
        """What its stored diagnosis names, and the formula that it suggests; empty without one."""
        diagnosis = find_diagnosis(self._store.root, self.manifest)
        return () if diagnosis is None else read_diagnosed(diagnosis, vehicle)


class Model:
    """A vehicle and the effects by which it differs from the ideal one.

    ``model + effect`` and ``model - "id"`` make other models.

    Args:
        vehicle: name of a preset, or the vehicle of a run.
    """

    def __init__(self, vehicle: str | Vehicle) -> None:
        if isinstance(vehicle, str):
            vehicle = resolve_vehicle(VehicleSection(preset=vehicle), recorded=None, where="Model")
        self.file = ModelFile(MotionModel(vehicle))

    @classmethod
    def of(cls, file: ModelFile) -> Self:
        """The model of a file that was read."""
        made = cls(file.model.vehicle)
        made.file = file
        return made

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read a model file; effects of your own are loaded before, with `load_effects`."""
        return cls.of(read_model(Path(path)))

    def write(self, path: str | Path) -> None:
        """Write it as a model file."""
        write_model(self.file, Path(path))

    @property
    def parameters(self) -> pl.DataFrame:
        """Its numbers: ``parameter value low high unit doubt run``, the 95 % interval of the last fit.

        A number that runs have of their own has a row for each run.
        """
        return tabulate_parameters(self.file.list_numbers(), self.file.list_own())

    def __add__(self, other: str | Effect) -> Self:
        return self.of(replace(self.file, model=self.file.model + _take_effect(other)))

    def __sub__(self, other: str | Effect) -> Self:
        return self.of(replace(self.file, model=self.file.model - other))

    def fit(
        self,
        runs: StoredRun | Sequence[StoredRun],
        *,
        input: Source | None = None,
        vehicle_of: Owner | None = None,
    ) -> Fit:
        """Fit its values to runs, as `slip model fit` does.

        Args:
            runs: one, or several of one vehicle.
            input: what it is fed with; None as at the last fit, else as the effects need it.
            vehicle_of: whose geometry counts where a run is of another vehicle.
        """
        manifests = _list_manifests(runs)
        with threadpool_limits(1):
            return Fit(change_model(self.file, self.file, manifests, source=input, owner=vehicle_of).fit)

    def errors(
        self,
        runs: StoredRun | Sequence[StoredRun],
        *,
        input: Source | None = None,
        vehicle_of: Owner | None = None,
    ) -> pl.DataFrame:
        """Errors over 2 s with its values as they are, as `slip model compare` tells them.

        Returns:
            Three rows a run: the model as it is, its effects fitted to this run, the ideal model; the columns
            ``run model t_mrmse_m r_mrmse_rad``.
        """
        manifests = _list_manifests(runs)
        with threadpool_limits(1):
            carried = carry_models({"": self.file}, manifests, source=input, owner=vehicle_of)
        rows = []
        for _, item in carried.rows:
            judged = {"as it is": item.carried, "fitted to this run": item.own, "ideal": item.ideal}
            for words, held_out in judged.items():
                errors = to_json(held_out.pooled)
                rows.append({"run": item.run, "model": words, **{key: errors[key] for key in _OVER_2S}})
        return pl.DataFrame(rows)

    def limit_speed(
        self,
        runs: StoredRun | Sequence[StoredRun],
        *,
        within_m: float,
        ahead_s: float = HORIZON_S,
        input: Source | None = None,
        vehicle_of: Owner | None = None,
    ) -> pl.DataFrame:
        """Highest speeds at which predictions stay within a tolerance, as `slip model speed` tells them.

        Args:
            runs: one, or several of one vehicle.
            within_m: largest error of position [m].
            ahead_s: time ahead [s], at most 2.
            input: what it is fed with; None as at the last fit, else as the effects need it.
            vehicle_of: whose geometry counts where a run is of another vehicle.

        Returns:
            A row for each terrain: ``answer`` is ``up_to``, ``every``, ``none`` or ``too_few``, ``speed_mps``
            the highest speed with its interval, beside the range that was driven and the errors at its ends.
        """
        manifests = _list_manifests(runs)
        with threadpool_limits(1):
            speeds = find_speeds(self.file, manifests, within_m, ahead_s, source=input, owner=vehicle_of)
        return pl.DataFrame(speeds.rows)

    def predict(
        self, run: StoredRun, *, input: Source | None = None, vehicle_of: Owner | None = None
    ) -> pl.DataFrame:
        """Velocities that it predicts for a run, with its values as they are, beside the measured ones.

        Args:
            run: an analyzed run.
            input: what it is fed with; None as at the last fit, else as the effects need it.
            vehicle_of: whose geometry counts where the run is of another vehicle.

        Returns:
            A row a time step of the table ``slip``, with its names: ``t`` [s]; measured ``v_x v_y v_w``, of
            the ideal model ``f_x f_y f_w``, of this model ``model_x model_y model_w``, each forward and left
            [m/s] and the yaw rate [rad/s] of base_link. The model's are null where its input has a gap.

        Raises:
            SlipError: the run has no such input, is too short, or is of another vehicle.
        """
        data, state = self._prepare(run, input, vehicle_of)
        slip = run.slip.filter(pl.col("input").cast(pl.String) == data.source.value).collect()
        velocity = predict_at_from(
            data.residuals_by_run[0], state.effects_of(0), state.timing[0], slip["t"].to_numpy()
        )
        names = [f"{kind}_{axis}" for kind in ("v", "f") for axis in COMPONENTS]
        made = [pl.Series(f"model_{axis}", velocity[:, i]) for i, axis in enumerate(COMPONENTS)]
        return slip.select("t", *names).with_columns(made).with_columns(pl.col("^model_.$").fill_nan(None))

    def missing(
        self,
        run: StoredRun,
        *,
        refused: bool = False,
        input: Source | None = None,
        vehicle_of: Owner | None = None,
    ) -> pl.DataFrame:
        """What it lacks to describe a run: the effects that help, the most helpful first.

        The model is fitted to the run, then with each effect that the run's diagnosis names, with the formula
        that it suggests, and with each other effect whose signature is in the residual; each is judged as the
        diagnosis does. The workbench offers the same, `slip model add` accepts it, and the rest is left out.

        Args:
            run: an analyzed run.
            refused: list in their place those that would help as much, and that `slip model add` refuses
                because this run holds too little evidence for them.
            input: what it is fed with; None as at the last fit, else as the effects need it.
            vehicle_of: whose geometry counts where the run is of another vehicle.

        Returns:
            A row an effect: ``effect``, its id, that of the formula is ``suggested_term``; ``sentence``, what
            the vehicle does by it; ``t_mrmse_m`` [m] and ``r_mrmse_rad`` [rad], the errors over 2 s with it;
            ``t_removed`` and ``r_removed``, the shares of the errors without it that it removes, below zero
            where one grows; ``same_as``, ids of effects that this run does not tell from it; ``refusal``,
            why it is refused, empty for what helps. No row where nothing helps.

        Raises:
            SlipError: the run has no such input, is too short, or is of another vehicle.
        """
        data, state = self._prepare(run, input, vehicle_of)
        model = replace(self.file.model, vehicle=data.vehicle, effects=state.effects_of(0))
        with threadpool_limits(1):
            if refused:
                before = judge_whole(data, model)
                listed, errors_before = find_refused(before), before.errors
            else:
                tries = Tries(data, model, run.list_diagnosed(data.vehicle))
                listed = tries.fold([one for one in tries.try_each() if one is not None])
                errors_before = tries.before
        without = to_json(errors_before)
        asked = measure_asked(data.runs, data.vehicle)
        rows = [
            {
                "effect": one.effect.id,
                "sentence": one.effect.describe_motion(data.vehicle, model, asked),
                **{name: errors[name] for name in _OVER_2S},
                **{f"{name[0]}_removed": _find_removed(errors, without, name) for name in _OVER_2S},
                "same_as": list(one.twins),
                "refusal": one.refusal,
            }
            for one in listed
            for errors in [to_json(one.errors)]
        ]
        numbers = dict.fromkeys((*_OVER_2S, "t_removed", "r_removed"), pl.Float64)
        texts = {"effect": pl.String, "sentence": pl.String}
        return pl.DataFrame(
            rows, schema={**texts, **numbers, "same_as": pl.List(pl.String), "refusal": pl.String}
        )

    def view(
        self, run: StoredRun, *, input: Source | None = None, vehicle_of: Owner | None = None
    ) -> MotionView:
        """Its motion on a run, with its values as they are, as rows for figures."""
        data, state = self._prepare(run, input, vehicle_of)
        known = run.manifest.tables
        velocities = run.table("velocities").collect() if "velocities" in known else None
        return MotionStage(data, velocities).view(state, (), None)

    def _prepare(
        self, run: StoredRun, input: Source | None, owner: Owner | None
    ) -> tuple[EstimationData, ModelState]:
        """The run as estimation data, and the model on it: its values as they are, the run's own delays."""
        file, read, chosen = read_on_runs(self.file, _list_manifests(run), input, owner)
        data = EstimationData(read, file.model.vehicle, chosen.source)
        with threadpool_limits(1):
            return data, fit_as_it_is(data, file.model, file.per_run).state

    def export(
        self,
        to: str,
        *,
        current: str | Path | None = None,
        gate: Literal["off", "on", "auto"] | None = None,
    ) -> str:
        """Its values as parameters of what people run, as `slip model export` writes them.

        Args:
            to: ros2_control, nav2, nav2_amcl, autoware, vesc, px4, robot_localization, gazebo, json or
                python.
            current: for vesc and px4 the robot's file of parameters, which is corrected.
            gate: for autoware whether the steering offset is applied: off, on, or on and learned on.
        """
        return export_file(self.file, to, current=None if current is None else Path(current), gate=gate)

    def __repr__(self) -> str:
        numbers = format_parameters(self.file.list_numbers(), self.file.list_own())
        return "\n".join([self.file.model.vehicle.name, *(numbers or ["  the ideal model, no effect"])])

    def _repr_html_(self) -> str:
        ids = ", ".join(self.file.model.ids) or "the ideal model, no effect"
        return write_html(f"{self.file.model.vehicle.name}: {ids}", self.parameters)


def _find_removed(after: Mapping[str, object], before: Mapping[str, object], name: str) -> float | None:
    """Share of an error that is removed, of the numbers as they are said."""
    error, without = number_in(after, name), number_in(before, name)
    return None if error is None or without is None else find_share_removed(error, without, 0.0)


def _take_effect(given: object) -> Effect:
    if isinstance(given, str):
        return effect(given)
    if not isinstance(given, Effect):
        hint = 'Add slip.effect("drive_lag") or the id of an effect.'
        raise MotionError("bad_value", f"{given!r} is not an effect", where="Model", hint=hint)
    return given


def _list_manifests(runs: object) -> list[Manifest]:
    opened = runs if isinstance(runs, Sequence) and not isinstance(runs, str) else [runs]
    manifests = [run.manifest for run in opened if isinstance(run, StoredRun)]
    if not manifests or len(manifests) < len(opened):
        hint = "Give what slip.analyze or slip.load returns."
        raise MotionError("bad_value", f"{runs!r} is not a run", where="Model", hint=hint)
    return manifests


def take_file(model: object) -> ModelFile:
    """The file of a model; an error for anything else."""
    if not isinstance(model, Model):
        hint = "Read a model file with slip.Model.read."
        raise MotionError("bad_value", f"{model!r} is not a model", where="model", hint=hint)
    return model.file


class Fit:
    """A model fitted to runs.

    Attributes:
        model: with the fitted values.
        errors: held-out errors of all effects together: ``t_mrmse_m`` and ``r_mrmse_rad`` over 2 s, ...
        ladder: those after each effect that helps: ``added t_mrmse_m r_mrmse_rad explained_share``.
    """

    def __init__(self, fit: ModelFit) -> None:
        self._fit = fit
        self.model = Model.of(fit.file)
        self.errors = to_json(fit.after.whole.errors)
        self.ladder = tabulate_ladder(self.to_json())

    def to_json(self) -> dict[str, object]:
        """The keys of `slip model fit --json` that are the fit's own: not those of files and priors."""
        return self._fit.to_json()

    def _as_diagnosis(self) -> RunDiagnosis:
        ladder = self._fit.after.ladder.as_result(self._fit.floor)
        return RunDiagnosis(input=self._fit.chosen.source.value, ladder=ladder, noise_floor=self._fit.floor)

    def figures(self) -> dict[str, ShownFigure]:
        """The ladder as a chart."""
        return show_figures(RunReport({}, diagnosis=self._as_diagnosis()))

    def __repr__(self) -> str:
        return "\n".join([repr(self.model), *format_ladder(self._fit.after.ladder, self._fit.floor)])

    def _repr_html_(self) -> str:
        chosen, names = self._fit.chosen, ", ".join(self._fit.after.data.names)
        notes = [chosen.warning] if chosen.warning else []
        title = f"fitted {INPUT_WORDS[chosen.source.value]} of {names} ({chosen.reason})"
        return write_html(title, self.model.parameters) + write_html("held-out errors", self.ladder, notes)
