"""Keys of stages: a stage is done when its key is that of the results there are.

A key is a hash of the keys above it, of the stage's own configuration and of the stage's version, a number
that is raised by whoever changes what the stage computes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import TYPE_CHECKING

import msgspec

from pipeline.analysis.options import STAGES

if TYPE_CHECKING:
    from pipeline.analysis.log_setup import LogSetup  # numerics that batches look up keys without

VERSIONS: Mapping[str, int] = {"extract": 6, "align": 8, "velocity": 4, "slip": 7, "aggregate": 1}
EXTRACTED = ("commands", "wheels", "poses", "imu")
TABLES: Mapping[str, tuple[str, ...]] = {
    "extract": EXTRACTED,
    "align": (*EXTRACTED, "alignments"),
    "velocity": ("velocities",),
    "slip": ("slip", "windows"),
    "aggregate": ("aggregates",),
}
_DIGITS = 16


def key_stages(
    run: str, sha256: str, setup: LogSetup, inputs: tuple[str, ...], model: str | None = None
) -> dict[str, str]:
    """Key of every stage of a run, in order; ``model`` is the hash of the model that slip is set against."""
    # The contracts bring a table library along, which help and usage errors do without.
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
    # Who allows more, reads more.
    left_out = [loss.text for loss in setup.index.losses if loss.kind == OVER_BUDGET]
    if left_out:
        own["extract"]["left_out"] = left_out
    # What is left out of a bag is known once it has been read.
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
