"""Whose geometry counts where a model and a run come from different vehicles."""

import math
from collections.abc import Mapping, Sequence
from typing import Literal

from pipeline.analysis.errors import JobError
from pipeline.vehicles import Vehicle

Owner = Literal["model", "run"]
_LENGTHS = ("wheel_radius_m", "track_width_m", "wheelbase_m", "base_to_rear_axle_m")
# Model files hold six digits.
_ROUNDING = 1e-5


def agree_on_vehicle(model: Vehicle, runs: Mapping[str, Vehicle], owner: Owner | None) -> Vehicle:
    """The vehicle that a model and runs are read with.

    Args:
        model: vehicle of the model.
        runs: vehicle of each run, by name. Its controller's track multiplier is the recording's, whoever's
            geometry counts.
        owner: whose geometry counts where they differ; None asks.

    Raises:
        JobError: ``vehicle_contradiction``: they differ and nobody said whose counts, or the runs differ
            among each other and should count.
    """
    if owner == "model":
        return model
    chosen = model
    if owner == "run":
        chosen = next(iter(runs.values()))
    for name, vehicle in runs.items():
        differing = _list_differences(chosen, vehicle)
        if not differing:
            continue
        if owner == "run":
            first = next(iter(runs))
            what = f"it is of a {_describe(vehicle, differing)}, {first} of a {_describe(chosen, differing)}"
            hint = "Give runs of one vehicle, or --vehicle-of model."
            raise JobError("vehicle_contradiction", what, where=name, hint=hint)
        raise JobError(
            "vehicle_contradiction",
            f"the run is of a {_describe(vehicle, differing)}, the model of a {_describe(model, differing)}",
            where=name,
            hint="Say whose geometry counts: --vehicle-of model, or --vehicle-of run.",
        )
    return chosen


def _list_differences(one: Vehicle, other: Vehicle) -> list[str]:
    """Names of the geometry that two vehicles do not share; what one of them leaves open is shared."""
    found = ["kind"] if one.kind != other.kind else []
    for name in _LENGTHS:
        values = getattr(one, name), getattr(other, name)
        if None not in values and not math.isclose(*values, rel_tol=_ROUNDING):
            found.append(name)
    return found


def _describe(vehicle: Vehicle, names: Sequence[str]) -> str:
    values = ((name, getattr(vehicle, name)) for name in names)
    facts = (f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}" for name, value in values)
    return f"{vehicle.name} ({', '.join(facts)})"
