"""Model files, their exports as those projects read them that take them, and what they predict."""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

import numpy as np
import yaml
from motion_runs import vehicle_of

from pipeline.export import export_model
from pipeline.models import Model, ModelFile, list_effects

if TYPE_CHECKING:
    from pipeline.models import Effect

HUSKY, CAR, F1TENTH = (vehicle_of(name) for name in ("husky_a200", "ackermann_car", "f1tenth"))
FIT = {
    "input": "measured",
    "runs": [{"run": "yard/monday"}],
    "ladder": [
        {"effects": [], "velocity_rms": [0.3, 0.2, 0.4], "t_mrmse_m": 0.5},
        {"effects": ["drive_lag"], "velocity_rms": [0.02, 0.03, 0.05], "t_mrmse_m": 0.1},
        {"effects": ["drive_lag", "icr_offset"], "velocity_rms": [0.02, 0.01, 0.05], "t_mrmse_m": 0.05},
    ],
}


def make(*effects: Effect, vehicle: object = HUSKY, **more: object) -> ModelFile:
    return ModelFile(Model(vehicle, effects), **more)  # type: ignore[arg-type]


def make_full(vehicle: object) -> ModelFile:
    """A model with every effect that its vehicle can have, at a usual size."""
    effects = [
        kind().change(**{p.name: p.typical for p in kind.parameters if not p.instead_of})
        for kind in list_effects()
        if vehicle.kind in kind.kinds  # type: ignore[attr-defined]
    ]
    known = {
        f"{effect.id}.{name}": (0.9 * value, 1.1 * value)
        for effect in effects
        for name, value in effect.values.items()
    }
    return make(*effects, vehicle=vehicle, fit=FIT, intervals=known)


def flatten(tree: object, path: str = "") -> dict[str, object]:
    if not isinstance(tree, dict):
        return {path: tree}
    return {
        k: v for name, item in tree.items() for k, v in flatten(item, f"{path}.{name}".strip(".")).items()
    }


def read(name: str, text: str) -> dict[str, object]:
    """The parameters of an exported file, read as those who take it read it."""
    if name == "gazebo":
        root = ET.fromstring(text)  # noqa: S314 - it is our own
        assert root.tag == "plugin"
        assert set(root.attrib) == {"filename", "name"}
        return {element.tag: float(element.text or "nan") for element in root}
    if name == "px4":
        # QGroundControl's documented columns: vehicle, component, name, value, MAV_PARAM_TYPE.
        rows = list(csv.reader((line for line in text.splitlines() if line[:1] != "#"), delimiter="\t"))
        assert {tuple(row[:2]) for row in rows} == {("1", "1")}
        assert {row[4] for row in rows} == {"9"}
        return {row[2]: float(row[3]) for row in rows}
    # The parser of ROS 2 is libyaml; launch files use PyYAML's own.
    tree = yaml.load(text, Loader=yaml.CSafeLoader)
    assert tree == yaml.safe_load(text)
    return flatten(tree)


def take(name: str, file: ModelFile) -> dict[str, float]:
    """The parameters by the last part of their names."""
    found = read(name, export_model(file, name))
    return {path.split("ros__parameters.")[-1]: value for path, value in found.items()}  # type: ignore[misc]


def predict(file: ModelFile, commands: list[tuple[float, ...]], until_s: float) -> np.ndarray:
    """Motion of the vehicle that the model describes: time, x, y, yaw, v_x, v_y, v_w."""
    space: dict[str, object] = {}
    exec(compile(export_model(file, "python"), "exported", "exec"), space)  # noqa: S102 - that is what it is for
    return np.array(space["predict"](commands, until_s))  # type: ignore[operator]
