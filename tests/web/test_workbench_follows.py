"""Everything that is shown is of the model that stands there: map, commands, where it fails, what to add."""

import json
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from store_samples import forge_file
from workbench_server import RUN, Workbench

from pipeline.estimation import Input
from pipeline.estimation.prediction import predict_at
from pipeline.models import read_model
from pipeline.run import load_motion_run
from pipeline.sources.one_vehicle import load_vehicle
from pipeline.stages.slip_stage import find_residual_modulus
from pipeline.store import Store

Rows = dict[str, dict[str, list[float | None]]]


def rows_of(answer: dict[str, object]) -> Rows:
    return cast("Rows", answer["rows"])


def finite(values: list[float | None]) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([value for value in values if value is not None])


def write_diagnosis(workbench: Workbench, told: dict[str, object]) -> None:
    manifest = Store(workbench.results).manifest("field/hidden")
    assert manifest is not None
    forge_file(manifest, "diagnosis.json", json.dumps(told).encode())


def test_map_and_commands_show_what_the_model_leaves_of_the_slip(workbench: Workbench) -> None:
    workbench.session(RUN)
    drawn = workbench.post("/api/figures", run=RUN)
    manifest = Store(workbench.results).manifest(RUN)
    assert manifest is not None
    slip = manifest.read("slip").filter(input="command")
    assert finite(rows_of(drawn)["track"]["modulus"]).max() == pytest.approx(slip["modulus"].max(), abs=1e-4)

    workbench.session(RUN, "add", effect="effective_track")
    moved = workbench.post("/api/rows", run=RUN)
    path = workbench.post("/api/save", run=RUN)["path"]
    vehicle = load_vehicle(manifest)
    predicted = predict_at(
        read_model(Path(str(path))).model,
        load_motion_run(manifest, vehicle),
        Input.COMMAND,
        slip["t"].to_numpy(),
    )
    # As `slip analyze --model` has it, on the scale of the ideal model.
    left = find_residual_modulus(predicted, slip, length=1.0)
    shown = finite(rows_of(moved)["track"]["modulus"])
    assert shown.max() == pytest.approx(np.nanmax(left), rel=0.02)
    assert np.median(shown) < 0.3 * slip["modulus"].median()
    before = rows_of(drawn)["command_cells"]["modulus"]
    assert np.median(finite(rows_of(moved)["command_cells"]["modulus"])) < 0.3 * np.median(finite(before))
    workbench.session(RUN, "undo")
    assert rows_of(workbench.post("/api/rows", run=RUN))["track"] == rows_of(drawn)["track"]


def test_a_formula_that_the_diagnosis_found_is_added(workbench: Workbench) -> None:
    formula = (
        '[[effect]]\nid = "found_w"\nv_w = "k * w0"\nk = {value = -0.3, unit = "1", bounds = [-0.9, 0.9]}\n'
    )
    write_diagnosis(workbench, {"input": "command", "effects": [], "unexplained": {"formula": formula}})
    added = cast("dict[str, Any]", workbench.session(RUN, "add_found")["session"])
    assert [effect["id"] for effect in added["effects"]] == ["found_w"]
    # The log turns as if its wheels stood 1.6 times as far apart.
    assert added["effects"][0]["parameters"][0]["value"] == pytest.approx(1 / 1.6 - 1.0, rel=0.02)
    assert added["errors"]["r"] < 0.1 * added["ideal"]["r"]


def test_the_noise_floor_is_that_of_the_diagnosis(workbench: Workbench) -> None:
    floor = {"t_mrmse_m": 0.0123, "r_mrmse_rad": 0.0045}
    write_diagnosis(workbench, {"input": "command", "effects": [], "noise_floor": floor})
    shown = cast("dict[str, Any]", workbench.session(RUN)["session"])
    assert shown["floor"] == {"t": 0.0123, "r": 0.0045}
