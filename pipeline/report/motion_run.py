"""From a stored run to what models are fitted on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from pipeline.report.errors import ReportError

if TYPE_CHECKING:
    from collections.abc import Mapping

    import polars as pl

    from pipeline.runs import MotionRun
    from pipeline.store import Manifest
    from pipeline.vehicles import Vehicle

_WHEELS = ("t", "left", "right", "sideways", "speed", "steering", "latency")
COLUMNS: Mapping[str, tuple[str, ...]] = {
    "poses": (
        *("t", "segment", "x", "y", "z", "q_x", "q_y", "q_z", "q_w"),
        *("latency", "held", "active", "terrain"),
    ),
    "alignments": (
        *("hold_time", "command_scale", "track_multiplier", "gyro_scale", "gyro_bias", "heading_delay"),
        *("heading_delay_error", "wheel_delay", "gyro_residual", "latency_spread", "outlier_time"),
        *("recorded_modulus_command", "recorded_modulus_measured"),
    ),
    "commands": ("t", *(f"{name}_aligned" for name in ("left", "right", "sideways", "speed")), "steering"),
    "wheels": _WHEELS,
    "imu": ("t", "rate_z"),
    "slip": ("t", "input", "step", "suspect"),
}
"""What models need of a run's tables."""


def load_motion_run(manifest: Manifest, vehicle: Vehicle) -> MotionRun:
    """The tables of a run as arrays for models.

    Raises:
        MotionError: ``no_poses``.
        ReportError: ``no_poses``, the run has no table of poses.
    """
    tables = {name: manifest.read(name) for name in COLUMNS if name in manifest.tables}
    return make_motion_run(manifest, vehicle, tables)


def make_motion_run(manifest: Manifest, vehicle: Vehicle, tables: Mapping[str, pl.DataFrame]) -> MotionRun:
    """As `load_motion_run`, from tables that were read already, or from a stretch of each.

    Args:
        manifest: the run.
        vehicle: geometry.
        tables: by name, with the columns of `COLUMNS` at least.

    Raises:
        MotionError: ``no_poses``.
        ReportError: ``no_poses``, there is no table of poses.
    """
    from pipeline.runs import load_run  # noqa: PLC0415 - heavy

    if "poses" not in tables:
        hint = "Check the pose topic with `slip inspect`."
        raise ReportError(
            "no_poses", "the run has no poses to compare a model with", where=manifest.run, hint=hint
        )
    sha256 = str(manifest.part("log").get("sha256", ""))
    return load_run(tables, vehicle, name=manifest.run, sha256=sha256)


def load_vehicle(manifest: Manifest) -> Vehicle:
    """The vehicle that a run was analyzed with.

    Raises:
        ReportError: ``no_vehicle``, the results do not say it.
    """
    from pipeline.vehicles import Vehicle  # noqa: PLC0415 - heavy

    try:
        return msgspec.convert(manifest.details.get("vehicle"), Vehicle, strict=False)
    except msgspec.ValidationError as error:
        hint = "Analyze the log again with --force."
        raise ReportError(
            "no_vehicle", "the results do not say which vehicle the run is of", where=manifest.run, hint=hint
        ) from error
