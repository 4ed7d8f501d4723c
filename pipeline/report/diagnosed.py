"""The model that a diagnosis wrote, on its run, for figures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.identification import Problem, State, choose_input
from pipeline.models import ModelFile, Timing
from pipeline.models.model_file import parse_model
from pipeline.report.motion_view import MotionStage, MotionView
from pipeline.report.run import mapping_in, objects_in
from pipeline.runs import MotionError, load_run

if TYPE_CHECKING:
    from collections.abc import Mapping

    import polars as pl

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
    file = read_model_text(diagnosis)
    if file is None or not file.model.effects or "poses" not in tables:
        return None
    asked = diagnosis.get("input")
    try:
        run = load_run(tables, vehicle, name=str(diagnosis.get("run", "")))
        source = choose_input([run], asked if isinstance(asked, str) else None).source
        problem = Problem([run], vehicle, source)
    except MotionError:
        # A log that is too poor for a model has its slip all the same.
        return None
    state = State(file.find_effects(run.name), (Timing(file.find_wheel_delay(run.name)),))
    places = tables["velocities"].select("t", "x", "y").sort("t") if "velocities" in tables else None
    floor = mapping_in(diagnosis, "noise_floor")
    return MotionStage(problem, places).view(state, objects_in(diagnosis, "ladder"), floor or None)


def read_model_text(diagnosis: Mapping[str, object]) -> ModelFile | None:
    """The model file that a diagnosis wrote; None where it wrote none that can be read.

    Args:
        diagnosis: the JSON object of one run of ``slip diagnose --json``.
    """
    text = diagnosis.get("model")
    try:
        return parse_model(text, Path("diagnosis.toml")) if isinstance(text, str) else None
    except MotionError:
        return None
