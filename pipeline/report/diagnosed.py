"""The model that a diagnosis named, on its run, for figures."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.identification import Problem, choose_input, fit_model
from pipeline.models import Model, find_effect
from pipeline.report.motion_view import MotionStage, MotionView
from pipeline.report.run import mapping_in, number_in, objects_in
from pipeline.runs import MotionError, load_run

if TYPE_CHECKING:
    from collections.abc import Mapping

    import polars as pl

    from pipeline.models import Effect
    from pipeline.vehicles import Vehicle


def view_diagnosis(
    tables: Mapping[str, pl.DataFrame],
    vehicle: Vehicle,
    diagnosis: Mapping[str, object],
) -> MotionView | None:
    """What the named model says of the run.

    Args:
        tables: of the run: `poses`, `alignments` and `commands` or `wheels`, better with `imu`, `slip` and
            `velocities`.
        vehicle: geometry.
        diagnosis: the JSON object of one run of ``slip diagnose --json``.

    Returns:
        Rows to draw; None where nothing was named, or the run is too poor for a model.
    """
    model = name_model(diagnosis, vehicle)
    if model is None or "poses" not in tables:
        return None
    asked = diagnosis.get("input")
    try:
        run = load_run(tables, vehicle, name=str(diagnosis.get("run", "")))
        source = choose_input([run], asked if isinstance(asked, str) else None).source
        problem = Problem([run], vehicle, source)
        state = fit_model(problem, model).state
    except MotionError:
        # A log that is too poor for a model has its slip all the same.
        return None
    places = tables["velocities"].select("t", "x", "y").sort("t") if "velocities" in tables else None
    floor = mapping_in(diagnosis, "noise_floor")
    return MotionStage(problem, places).view(state, objects_in(diagnosis, "ladder"), floor or None)


def name_model(diagnosis: Mapping[str, object], vehicle: Vehicle) -> Model | None:
    """The model that a diagnosis names, with its values; None where it names nothing.

    Args:
        diagnosis: the JSON object of one run of ``slip diagnose --json``.
        vehicle: geometry.
    """
    made = [_make_effect(entry) for entry in objects_in(diagnosis, "effects")]
    effects = tuple(effect for effect in made if effect is not None and vehicle.kind in effect.kinds)
    return Model(vehicle, effects) if effects else None


def _make_effect(entry: Mapping[str, object]) -> Effect | None:
    """An effect with the values of the diagnosis; None for one that no longer exists or cannot be so."""
    found = mapping_in(entry, "parameters")
    values = {name: number_in(mapping_in(found, name), "value") for name in found}
    try:
        made = find_effect(str(entry.get("id", "")))()
        return made.change(**{name: value for name, value in values.items() if value is not None})
    except MotionError:
        return None
