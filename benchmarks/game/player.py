"""`slip` as a player of the game: what its diagnosis says, in the form of an answer.

No setting but the vehicle sheet; `slip.analyze` and `Run.diagnose` as anybody has them.
"""

import sys
import tempfile
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import slip
from game.baselines import drive_ideally
from game.read_task import Read, predict_windows, walk_velocities
from game.score import (
    MOST_CANDIDATES,
    MOST_EFFECTS,
    MOST_GROUPS,
    MOST_UNOBSERVABLE,
    MOST_WORDS,
    Answer,
    Number,
)
from pipeline.api import Diagnosis
from pipeline.simulate import list_effects

Json = Mapping[str, Any]

_LISTED = {spec.id: {item.name for item in spec.parameters} for spec in list_effects()}
_SHEET = ("wheel_radius_m", "track_width_m", "wheelbase_m")
_STEP_S = 0.01


def read_run(run: Json) -> Answer:
    """What a run of `slip diagnose --json` says."""
    entries = _list(run, "effects")
    effects = {str(entry["id"]): _read_numbers(entry.get("parameters", {})) for entry in entries}
    same_as = {str(entry["id"]): frozenset(map(str, entry.get("equivalent_to", ()))) for entry in entries}
    undecided = tuple(frozenset(map(str, group["candidates"])) for group in _list(run, "undecided"))
    rest = run.get("unexplained")
    other = frozenset(map(str, rest["channels"])) if rest else frozenset[str]()
    return Answer(
        effects,
        same_as,
        # What was refused denies nothing.
        not (effects or undecided or other or "error" in run),
        undecided,
        frozenset(map(str, _list(run, "unobservable"))),
        other,
    )


def _read_numbers(parameters: Json) -> dict[str, Number]:
    numbers: dict[str, Number] = {}
    for name, number in parameters.items():
        value, low, high = (number.get(key) for key in ("value", "low", "high"))
        # A clock that was put right beforehand, and a number at its bound, have no interval.
        whole = low is not None and high is not None and not number.get("at_bound")
        if value is not None:
            numbers[name] = (value, low, high) if whole else (value, None, None)
    return numbers


def _list(run: Json, key: str) -> Sequence[Any]:
    found = run.get(key)
    return found if isinstance(found, list | tuple) else ()


def answer_slip(read: Read) -> dict[str, Any]:
    """What `slip diagnose` says of a task, with the poses that its model predicts."""
    vehicle = {"kind": read.sheet["kind"], **{name: read.sheet[name] for name in _SHEET}}
    with tempfile.TemporaryDirectory(prefix="game_") as folder:
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
    return {**write_claims(diagnosis.to_json()), "poses": predict(read, diagnosis)}


def write_claims(run: Json) -> dict[str, Any]:
    """A diagnosis as an answer's file has it: names of the published list alone, as many as it takes."""
    said = read_run(run)
    named = [name for name in said.effects if name in _LISTED][:MOST_EFFECTS]
    effects = [
        {
            "name": name,
            "parameters": {
                key: {"value": value} if low is None else {"value": value, "low": low, "high": high}
                for key, (value, low, high) in said.effects[name].items()
                if key in _LISTED[name]
            },
            "same_as": sorted(said.same_as[name] & set(_LISTED))[:MOST_CANDIDATES],
        }
        for name in named
    ]
    groups = [sorted((group & set(_LISTED)) - set(named))[:MOST_CANDIDATES] for group in said.undecided]
    groups = [group for group in groups if len(group) > 1][:MOST_GROUPS]
    rest = run.get("unexplained")
    other = {}
    if rest:
        formula = str(rest.get("formula") or rest["where"])[:MOST_WORDS]
        other = {"other": {"channels": sorted(said.other), "formula": formula}}
    return {
        "effects": effects,
        "undecided": groups,
        "unobservable": sorted(said.unobservable & set(_LISTED))[:MOST_UNOBSERVABLE],
        "none": not (effects or groups or rest),
        **other,
    }


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
    time, speed, turn = read.commands.T
    left, right = ((speed + side * 0.5 * width * turn) / radius for side in (-1.0, 1.0))
    columns = [time, speed / radius, speed / radius, turn] if read.is_car else [time, left, right]
    # The exported function is plain Python, and takes plain numbers.
    rows: Sequence[tuple[float, ...]] = np.column_stack(columns).tolist()
    return rows
