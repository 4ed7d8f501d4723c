"""The vehicle of stored runs, and the one whose geometry stands for several."""

import math
from collections.abc import Mapping, Sequence
from typing import Literal

import msgspec

from pipeline.sources.configuration import ConfigurationError, Vehicle
from pipeline.store import Manifest

Owner = Literal["model", "run"]


_LENGTHS = ("wheel_radius_m", "track_width_m", "wheelbase_m", "base_to_rear_axle_m")


# Model files store six digits.
_ROUNDING = 1e-5


def agree_on_vehicle(model: Vehicle | None, runs: Mapping[str, Vehicle], owner: Owner | None) -> Vehicle:
    """Vehicle whose geometry is used for a model and runs.

    Args:
        model: vehicle of the model; None stands for that of the first run.
        runs: vehicle of each run, by name. The controller's track multiplier is always that of the
            recording.
        owner: whose geometry to use if they differ; None raises an error.

    Raises:
        ConfigurationError: ``vehicle_contradiction``: ``owner`` is not ``model``, and the runs differ from
            each other; or it is None, and they differ from the model.
    """
    first, own = next(iter(runs.items()))
    chosen = own if model is None or owner == "run" else model
    if owner == "model":
        return chosen
    for name, vehicle in runs.items():
        if differing := _list_differences(own, vehicle):
            what = f"it is of a {_format(vehicle, differing)}, {first} of a {_format(own, differing)}"
            hint = "Give runs of one vehicle, or --vehicle-of model" + (
                f" for that of {first}." * (not model)
            )
            raise ConfigurationError("vehicle_contradiction", what, where=name, hint=hint)
    if differing := _list_differences(chosen, own):
        what = f"the run is of a {_format(own, differing)}, the model is for a {_format(chosen, differing)}"
        hint = "Choose the geometry: --vehicle-of model, or --vehicle-of run."
        raise ConfigurationError("vehicle_contradiction", what, where=first, hint=hint)
    return chosen


def _list_differences(one: Vehicle, other: Vehicle) -> list[str]:
    """Names of the geometry in which two vehicles differ; values that one of them lacks do not count."""
    names = ["kind"] if one.kind != other.kind else []
    for name in _LENGTHS:
        values = getattr(one, name), getattr(other, name)
        if None not in values and not math.isclose(*values, rel_tol=_ROUNDING):
            names.append(name)
    return names


def _format(vehicle: Vehicle, names: Sequence[str]) -> str:
    values = ((name, getattr(vehicle, name)) for name in names)
    facts = (f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}" for name, value in values)
    return f"{vehicle.name} ({', '.join(facts)})"


def load_vehicle(manifest: Manifest) -> Vehicle:
    """Vehicle that a run was analyzed with.

    Raises:
        ConfigurationError: ``no_vehicle``, the results do not contain it.
    """
    try:
        return msgspec.convert(manifest.details.get("vehicle"), Vehicle, strict=False)
    except msgspec.ValidationError as error:
        hint = "Analyze the log again with --force."
        raise ConfigurationError(
            "no_vehicle", "the results do not say which vehicle the run is of", where=manifest.run, hint=hint
        ) from error
