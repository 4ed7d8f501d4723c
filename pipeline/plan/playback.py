"""Whether a log is that of a plan's drive: its commands hold those of the plan."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.plan.errors import PlanError
from pipeline.plan.manoeuvres import RATE_HZ
from pipeline.runs.recording import MotionRun
from pipeline.runs.signals import DriveSeries, name_inputs
from pipeline.vehicles import Vehicle

_ALIKE = 0.6
"""Likeness of a drive that was stopped at a third; that of other driving stays below it."""


def require_played(path: Path, runs: Sequence[MotionRun], vehicle: Vehicle) -> None:
    """Refuse logs in which the plan was not driven.

    Args:
        path: `plan.csv`; where it is not there, or a log has no commands, nothing is refused.
        runs: of the drive.
        vehicle: their vehicle.

    Raises:
        PlanError: ``not_played``.
    """
    if not path.is_file() or any(run.commands is None for run in runs):
        return
    asked = _read_plan(path, vehicle)
    likeness = max(find_likeness(asked, _sample(run.commands, vehicle)) for run in runs if run.commands)
    if likeness < _ALIKE:
        what = f"no stretch of these commands is the plan's (likeness {likeness:.0%})"
        hint = "Give the log in which the plan was driven."
        raise PlanError("not_played", what, where=", ".join(run.name for run in runs), hint=hint)


def find_likeness(asked: Floats, seen: Floats) -> float:
    """The highest correlation of a sequence of commands with any stretch of a recording.

    Args:
        asked: forward speed and yaw rate, shape (n, 2).
        seen: the same of the recording, at the same rate, shape (m, 2).
    """
    scale = np.sqrt(np.mean(asked**2, axis=0)) + 1e-9
    asked, seen = asked / scale, np.pad(seen / scale, ((len(asked), len(asked)), (0, 0)))
    together = sum(np.correlate(seen[:, axis], asked[:, axis], "valid") for axis in (0, 1))
    energy = np.concatenate(([0.0], np.cumsum(np.sum(seen**2, axis=1))))
    sizes = np.sqrt(np.maximum(energy[len(asked) :] - energy[: -len(asked)], 1e-9) * np.sum(asked**2))
    return float(np.max(together / sizes))


def _read_plan(path: Path, vehicle: Vehicle) -> Floats:
    with path.open(encoding="utf-8", newline="") as file:
        names, *rows = csv.reader(file)
    _, speed, turn = np.array(rows, dtype=np.float64).T
    if names[-1].startswith("steering"):
        _, _, turn = vehicle.kinematics.asked({"speed": speed, "steering": turn}, vehicle)
    return np.column_stack((speed, turn))


def _sample(series: DriveSeries, vehicle: Vehicle) -> Floats:
    """Forward speed and yaw rate that a log's commands ask for, each held, at the plan's rate."""
    speed, _, turn = vehicle.kinematics.asked(name_inputs(series, vehicle), vehicle)
    times = np.arange(series.times[0], series.times[-1], 1.0 / RATE_HZ)
    held = np.maximum(np.searchsorted(series.times, times, side="right") - 1, 0)
    return np.column_stack((speed[held], turn[held]))
