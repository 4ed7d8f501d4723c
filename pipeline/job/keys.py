"""Look-up of logs and runs, choice of the vehicle geometry, and keys of stages."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import msgspec

from pipeline.core.program import guess_names
from pipeline.job import STAGES, JobError
from pipeline.logs import RemotePath, locate_recorded, spell_location, to_location
from pipeline.sources import Vehicle
from pipeline.store import Manifest, Store

if TYPE_CHECKING:
    from pipeline.job.log_setup import LogSetup  # numerical imports that key look-ups of batches do not need


def find_run(text: str, store: Store) -> Manifest:
    """The current results of a run, by its name, its stem, or the path of its log.

    Raises:
        JobError: no run matches, or several runs do.
    """
    manifests = store.survey().manifests
    path = spell_location(Path(text).resolve())
    fitting = [
        manifest
        for manifest in manifests
        if text in {manifest.run, manifest.run.rsplit("/", 1)[-1]} or recorded_path(manifest) == path
    ]
    if len(fitting) == 1:
        return fitting[0]
    names = ", ".join(manifest.run for manifest in (fitting or manifests)) or "none yet"
    what = f"several runs are called {text!r}" if fitting else f"there is no run {text!r}"
    known = [name for manifest in manifests for name in (manifest.run, manifest.run.rsplit("/", 1)[-1])]
    near = "" if fitting else guess_names(text, dict.fromkeys(known))
    raise JobError("no_such_run", what, where=str(store.root), hint=f"{near}Say which of: {names}.")


def find_log(text: str, out: Path) -> Path:
    """The log that a user refers to by its path or by the name of a run that has results.

    Raises:
        JobError: neither matches, or the run's log no longer exists.
        LogError: as `find_recorded_log`.
    """
    path = to_location(text)
    if isinstance(path, RemotePath) or path.exists() or path.suffix:
        return path
    return find_recorded_log(find_run(text, Store(out)), hint="Give the path it has now.")


def find_recorded_log(manifest: Manifest, *, hint: str) -> Path:
    """The log of a run.

    Args:
        manifest: manifest of the run.
        hint: hint of the error if the log no longer exists.

    Raises:
        JobError: ``log_gone``.
        LogError: ``remote_not_followed``, ``no_object_store``.
    """
    log = locate_recorded(recorded_path(manifest))
    if not log.exists():
        raise JobError("log_gone", "the log of this run is not there any more", where=str(log), hint=hint)
    return log


def recorded_path(manifest: Manifest) -> str:
    """Path of the log of a run."""
    return str(manifest.part("log").get("path", ""))


Owner = Literal["model", "run"]
_LENGTHS = ("wheel_radius_m", "track_width_m", "wheelbase_m", "base_to_rear_axle_m")
# Model files store six digits.
_ROUNDING = 1e-5


def agree_on_vehicle(model: Vehicle, runs: Mapping[str, Vehicle], owner: Owner | None) -> Vehicle:
    """Vehicle whose geometry is used for a model and runs.

    Args:
        model: vehicle of the model.
        runs: vehicle of each run, by name. The controller's track multiplier is always that of the
            recording.
        owner: whose geometry to use if they differ; None raises an error.

    Raises:
        JobError: ``vehicle_contradiction``: they differ and ``owner`` is None, or the runs differ from each
            other and ``owner`` is ``run``.
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
            what = f"it is of a {_format(vehicle, differing)}, {first} of a {_format(chosen, differing)}"
            hint = "Give runs of one vehicle, or --vehicle-of model."
            raise JobError("vehicle_contradiction", what, where=name, hint=hint)
        raise JobError(
            "vehicle_contradiction",
            f"the run is of a {_format(vehicle, differing)}, the model of a {_format(model, differing)}",
            where=name,
            hint="Choose the geometry: --vehicle-of model, or --vehicle-of run.",
        )
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


# Keys of stages: a stage is up to date if its key equals that of the existing results.
#
# A key is a hash of the previous stage's key, of the stage's own configuration and of the stage's version.
# The version must be incremented with every change of what the stage computes.

VERSIONS: Mapping[str, int] = {"extract": 10, "align": 12, "velocity": 5, "slip": 10, "aggregate": 1}
EXTRACTED = ("commands", "wheels", "poses", "imu", "power")
TABLES: Mapping[str, tuple[str, ...]] = {
    "extract": EXTRACTED,
    "align": (*EXTRACTED, "alignments", "events"),
    "velocity": ("velocities",),
    "slip": ("slip", "windows"),
    "aggregate": ("aggregates",),
}
_DIGITS = 16


def key_stages(
    run: str, sha256: str, setup: LogSetup, inputs: tuple[str, ...], model: str | None = None
) -> dict[str, str]:
    """Key of every stage of a run, in order; ``model`` is the hash of the model for the residual slip."""
    # The contracts import a table library that help and usage errors do not need.
    from pipeline.logs import OVER_BUDGET  # noqa: PLC0415
    from schemas import contract_of  # noqa: PLC0415

    plain = msgspec.to_builtins(setup.configuration)
    pose_limits = {name: plain["velocity"][name] for name in ("jump_m", "jump_rad", "gap_s")}
    own = {
        "extract": {
            "log": sha256,
            "run": [run, setup.dataset, setup.terrain],
            "vehicle": msgspec.to_builtins(setup.vehicle),
            "roles": [plain[role] for role in ("command", "wheels", "pose", "imu", "interval")],
            "use_intervals": plain["use_intervals"],
            "limits": pose_limits,
        },
        "align": {},
        "velocity": plain["velocity"],
        "slip": {"slip": plain["slip"], "inputs": inputs, "model": model},
        "aggregate": {},
    }
    if setup.configuration.run.map is not None:
        own["extract"]["map"] = setup.configuration.run.map
    # A higher limit reads more of the log.
    unread = [loss.text for loss in setup.index.losses if loss.kind == OVER_BUDGET]
    if unread:
        own["extract"]["left_out"] = unread
    # The losses of a bag are known only after reading it.
    catalogs = [part.catalog for part in setup.index.parts]
    allowed = [catalog.most_inflated for catalog in catalogs if catalog.most_inflated is not None]
    if allowed:
        own["extract"]["max_inflated"] = allowed
    keys: dict[str, str] = {}
    above = ""
    for stage in STAGES:
        contracts = {table: contract_of(table).version for table in (*TABLES[stage], "findings")}
        above = hash_json([above, stage, VERSIONS[stage], own[stage], contracts])
        keys[stage] = above
    return keys


def hash_json(content: object) -> str:
    """First sixteen hexadecimal digits of the SHA-256 of a JSON value with sorted keys."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:_DIGITS]
