"""This project's own answers to HiddenEffect, by its Python face as it is: no setting but the vehicle sheet.

python benchmarks/hidden_effect/answer_slip.py RINGS/open --out answers/slip
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from answer_simple import drive_ideally, write_answers
from read_task import Read, predict_windows, walk_velocities

import pipeline as slip
from pipeline.api import Diagnosis

Json = dict[str, Any]

_LIST = tomllib.loads(Path(__file__).with_name("names.toml").read_text("utf-8"))
_NAMES = {str(entry.get("slip", name)): name for name, entry in _LIST.items()}
"""Names of the published list by this project's ids."""
_KINDS = {"skid_steer": "differential"}
_SHEET = ("wheel_radius_m", "track_width_m", "wheelbase_m")
_STEP_S = 0.01
_MOST_CANDIDATES, _MOST_GROUPS = 6, 5
_CHANNELS = {"x": "x", "y": "y", "w": "yaw"}


def answer(read: Read) -> Json:
    """What `slip diagnose` says of a log, in the words of the published list."""
    kind = read.sheet["kind"]
    vehicle = {"kind": _KINDS.get(kind, kind), **{name: read.sheet[name] for name in _SHEET}}
    with tempfile.TemporaryDirectory(prefix="hidden_effect_") as folder:
        try:
            run = slip.analyze(
                read.folder / "log.mcap",
                results=folder,
                settings={"vehicle": vehicle},
                report=False,
                diagnosis=False,
            )
            diagnosis = run.diagnose()
        except slip.SlipError as problem:
            print(f"{read.id}: no answer: {problem}", file=sys.stderr)
            return {}
    return {**translate(diagnosis.to_json()), "poses": predict(read, diagnosis)}


def translate(told: Mapping[str, Any]) -> Json:
    """A diagnosis as an answer: what has no name in the published list is physics that no name fits."""
    effects = [
        {
            "name": _NAMES[entry["id"]],
            "parameters": {key: _tell(number) for key, number in entry["parameters"].items()},
        }
        for entry in told["effects"]
        if entry["id"] in _NAMES
    ]
    named = {entry["name"] for entry in effects}
    groups = [
        sorted({_NAMES[one] for one in group["candidates"] if one in _NAMES} - named)[:_MOST_CANDIDATES]
        for group in told["undecided"]
    ]
    groups = [group for group in groups if len(group) > 1][:_MOST_GROUPS]
    rest = told["unexplained"]
    said: Json = {"effects": effects, "undecided": groups}
    if rest:
        channels = [_CHANNELS[one] for one in rest["channels"]]
        said["other"] = {"channels": channels, "formula": str(rest.get("formula") or rest["where"])[:2000]}
    return {**said, "none": not (effects or groups or rest)}


def _tell(number: Mapping[str, Any]) -> Json:
    value, low, high = number["value"], number["low"], number["high"]
    return {"value": value} if low is None or high is None else {"value": value, "low": low, "high": high}


def predict(read: Read, diagnosis: Diagnosis) -> list[list[float]]:
    """Ends of the windows by the model that was named, as it is exported to Python."""
    edges, ideal = drive_ideally(read)
    if diagnosis.model is None:
        return predict_windows(read, edges, walk_velocities(edges, ideal))
    module: dict[str, Any] = {}
    exec(write_function(diagnosis.model), module)  # noqa: S102 - what the project itself wrote
    commands = _list_wheels(read, module["R"], module["B"])
    rows = np.array(module["predict"](commands, float(edges[-1]), _STEP_S))
    return predict_windows(read, rows[:, 0], rows[:, 1:4])


def write_function(model: slip.Model) -> str:
    """The model as a Python function, without the terms that it cannot have."""
    while True:
        try:
            return model.export("python")
        except slip.SlipError as problem:
            if problem.code != "not_exportable" or problem.where is None:
                raise
            model = model - problem.where


def _list_wheels(read: Read, radius: float, width: float) -> Sequence[tuple[float, ...]]:
    time, speed, aside, turn = read.commands.T
    left, right = ((speed + side * 0.5 * width * turn) / radius for side in (-1.0, 1.0))
    columns = [time, left, right]
    if read.is_car:
        columns = [time, speed / radius, speed / radius, turn]
    elif read.sheet["kind"] == "mecanum":
        columns.append(aside / radius)
    # The exported function is plain Python, and takes plain numbers.
    rows: Sequence[tuple[float, ...]] = np.column_stack(columns).tolist()
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("rings", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--resume", action="store_true", help="leave answers that are there")
    given = parser.parse_args()
    print(f"{write_answers(given.rings, given.out, answer, resume=given.resume)} answers in {given.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
