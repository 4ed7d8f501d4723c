"""Look-up of logs and runs, set-up of one log (configuration, vehicle, topics), and keys of stages."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from pipeline.job import STAGES
from pipeline.recording.log_setup import LogSetup
from pipeline.sources.message_types import describe_types
from pipeline.store.stored_runs import hash_json

# Keys of stages: a stage is up to date if its key equals that of the existing results.
#
# A key is a hash of the previous stage's key, of the stage's own configuration and of the stage's version.
# The version must be incremented with every change of what the stage computes.

VERSIONS: Mapping[str, int] = {"extract": 14, "velocity": 7, "slip": 16, "aggregate": 4}
EXTRACTED = ("commands", "wheels", "poses", "imu", "power")
TABLES: Mapping[str, tuple[str, ...]] = {
    "extract": (*EXTRACTED, "alignments"),
    "velocity": ("velocities",),
    "slip": ("slip", "windows", "events"),
    "aggregate": ("aggregates",),
}


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
            "message_types": describe_types(one.type_name for one in setup.index.channels),
        },
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
