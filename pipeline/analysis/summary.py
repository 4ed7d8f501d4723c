"""The JSON object of a run, made of its tables and of what the stages noted."""

from collections.abc import Mapping

import polars as pl

from pipeline.analysis.work import Work
from pipeline.store import JSON

_DIGITS = 6


def summarize_run(work: Work, log: Mapping[str, JSON]) -> dict[str, JSON]:
    """The promised keys of `slip analyze --json` for one run, and some more.

    Args:
        work: the finished stages.
        log: what is known of the recording: path, sha256, duration_s, complete, losses.
    """
    setup, generation = work.setup, work.generation
    aggregates = generation.read_table("aggregates")
    velocities = generation.read_table("velocities")
    by_input = {
        name: _describe_input(aggregates, name) for name in aggregates["input"].unique(maintain_order=True)
    }
    leading = "command" if "command" in by_input else "measured"
    whole = _row(aggregates, leading, "all")
    asked = "both" if len(work.options.inputs) > 1 else work.options.inputs[0]
    return {
        "run": work.run,
        "key": generation.key,
        "log": dict(log),
        "vehicle": setup.vehicle.id,
        "vehicle_name": setup.vehicle.name,
        "terrain": setup.terrain,
        "dataset": setup.dataset,
        "input": asked,
        "rate_hz": setup.configuration.velocity.rate_hz,
        "samples": by_input[leading]["samples"],
        "segments": velocities["segment"].n_unique(),
        "median_modulus": by_input[leading]["median_modulus"],
        "median_window_norm": by_input[leading]["median_window_norm"],
        "leading_input": leading,
        "length_scale_m": setup.configuration.slip.length_scale_m,
        "by_input": by_input,
        "split": _split(whole),
        "distance_m": _rounded(whole["distance"]),
        "duration_s": _rounded(whole["duration"]),
        "height_rate_mps": _rounded(whole["height_rate"]),
        "largest_kinetic_energy_j": _rounded(whole["largest_kinetic_energy"]),
        "held_poses": work.contexts["extract"].get("held_poses"),
        "timing": {
            "clocks": work.contexts["extract"].get("clocks"),
            "gyro": work.contexts["align"].get("gyro"),
        },
        "quarantined": work.contexts["extract"].get("quarantined"),
        "topics": _describe_topics(work),
        **setup.choice.to_json(setup.index.types),
        "findings": list_findings(generation.read_table("findings")),
    }


def _describe_input(aggregates: pl.DataFrame, name: str) -> dict[str, JSON]:
    rows = {subset: _row(aggregates, name, subset) for subset in ("all", "transitory", "steady")}
    whole = rows["all"]
    return {
        "samples": int(whole["samples"] or 0),
        "windows": int(whole["windows"] or 0),
        "median_modulus": _rounded(whole["median_modulus"]),
        "median_window_norm": _rounded(whole["median_window_norm"]),
        "median_residual_modulus": _rounded(whole["median_residual_modulus"]),
        "rms": [_rounded(whole[f"rms_{axis}"]) for axis in "xyw"],
        "transitory_median_modulus": _rounded(rows["transitory"]["median_modulus"]),
        "steady_median_modulus": _rounded(rows["steady"]["median_modulus"]),
    }


def _row(aggregates: pl.DataFrame, name: str, subset: str) -> dict[str, float | None]:
    return aggregates.filter((pl.col("input") == name) & (pl.col("subset") == subset)).row(0, named=True)


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(float(value), _DIGITS)


def _split(row: Mapping[str, float | None]) -> JSON:
    """Shares of the mean square slip on command: drivetrain, ground, and twice their product."""
    parts = {name: row[f"{name}_mean_square"] for name in ("drivetrain", "ground", "cross")}
    present = {name: value for name, value in parts.items() if value is not None}
    total = sum(present.values())
    if len(present) < len(parts) or total <= 0.0:
        return None
    return {name: round(value / total, _DIGITS) for name, value in present.items()}


def _describe_topics(work: Work) -> dict[str, JSON]:
    sources = work.setup.sources
    described: dict[str, JSON] = {}
    for role in ("command", "wheels", "pose", "imu", "interval"):
        source = getattr(sources, role)
        described[role] = None if source is None else {"topic": str(source), "reason": source.reason}
    return {**described, "notes": list(sources.notes)}


def list_findings(findings: pl.DataFrame) -> list[JSON]:
    """Findings as JSON objects, errors first."""
    columns = ["id", "severity", "text", "where", "t_start", "t_end", "value", "count", "stage"]
    # Severities are an Enum from info to error: its order is that of importance.
    return list(findings.select(columns).sort("severity", descending=True, maintain_order=True).to_dicts())
