"""Results of made-up runs, written as the job writes them, without logs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from pipeline.models import list_effects

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.store import Manifest, Store

RATE = 20.0
STEP_S = 6.0
_INPUTS = pl.Enum(["command", "measured"])
_WITHOUT_MODEL = [
    pl.lit(None, pl.Float64).alias(column) for column in ("model_x", "model_y", "model_w", "residual_modulus")
]
_SUBSETS = pl.Enum(["all", "transitory", "steady"])


@dataclass(frozen=True, kw_only=True)
class Run:
    """A run to make up; slip on the measured wheels is half of that on the command."""

    name: str
    dataset: str = "warthog_gravel"
    vehicle: str = "warthog"
    terrain: str = "gravel"
    median: float = 1.0
    seconds: float = 60.0
    mass_kg: float | None = 470.0
    length: float = 1.0
    sha256: str = ""
    start_ns: int = 1_700_000_000_000_000_000
    findings: Sequence[tuple[str, str, float | None]] = field(default=())
    estimates: Sequence[tuple[str, str, float, float]] = field(default=())
    budget: pl.DataFrame | None = None
    at_bound: bool = False
    still: bool = False
    sized: bool = True
    moves: bool = True
    wheels: bool = True
    simulated: bool = False
    gain: float = 0.0
    """Forward speed over the ideal one on either input, in place of the slip."""


def write_run(store: Store, run: Run, *, seed: int = 0) -> Manifest:
    """Write a run's tables and publish them."""
    rng = np.random.default_rng([seed, *run.name.encode()])
    count = round(run.seconds * RATE)
    t = np.arange(count) / RATE
    step = (t / STEP_S).astype(np.int32)
    rho = math.exp(-1.0 / RATE)
    level = np.empty(count)
    level[0] = rng.standard_normal()
    noise = rng.standard_normal(count) * math.sqrt(1.0 - rho**2)
    for i in range(1, count):
        level[i] = rho * level[i - 1] + noise[i]
    modulus = np.full(count, run.median) if run.still else run.median * np.exp(0.5 * level)
    speed = rng.uniform(0.5, 2.0, step[-1] + 1)[step]
    turn = rng.uniform(-1.0, 1.0, step[-1] + 1)[step]
    parts = []
    for name, share in (("command", 1.0), ("measured", 0.5)):
        g = np.stack((0.8 * share * modulus, 0.6 * share * modulus), axis=1)
        parts.append(
            pl.DataFrame(
                {
                    "t": t,
                    "stamp": run.start_ns + (t * 1e9).astype(np.int64),
                    "segment": np.zeros(count, dtype=np.int32),
                    "step": step,
                    "transitory": (t % STEP_S) < 2.0,
                    "f_x": speed,
                    "f_y": np.zeros(count),
                    "f_w": turn,
                    "v_x": speed - g[:, 0],
                    "v_y": -g[:, 1],
                    "v_w": turn,
                    "g_x": speed - (speed - g[:, 0]),
                    "g_y": g[:, 1],
                    "g_w": np.zeros(count),
                    "modulus": share * modulus,
                    "suspect": np.zeros(count, dtype=bool),
                }
            ).with_columns(pl.lit(name).cast(_INPUTS).alias("input"), *_WITHOUT_MODEL)
        )
    slip = pl.concat(parts)
    if run.gain:
        slip = slip.with_columns(v_x=run.gain * pl.col("f_x"), v_y=pl.lit(0.0), g_y=pl.lit(0.0))
        slip = slip.with_columns(g_x=pl.col("f_x") - pl.col("v_x"))
        slip = slip.with_columns(modulus=pl.col("g_x").abs())
    if not run.moves:
        slip = slip.with_columns(pl.col("^[fv]_[xyw]$") * 0.0)
    tables = {
        "slip": slip if run.wheels else slip.filter(pl.col("input") == "command"),
        "windows": _cut_windows(slip),
        "aggregates": _aggregate(slip, run),
        "findings": _list_findings(run),
        "poses": _integrate(t, speed, turn, run.start_ns),
    }
    if run.budget is not None:
        tables["budget"] = _complete_budget(run.budget)
    if run.estimates:
        tables["estimates"] = _list_estimates(run)
    names = {"run": run.name, "dataset": run.dataset, "vehicle": run.vehicle, "terrain": run.terrain}
    labels = [pl.lit(value).alias(name) for name, value in names.items()]
    with store.open_generation(run.name, f"k{seed}") as generation:
        for name, table in tables.items():
            generation.write_table(name, table.with_columns(labels))
        return generation.commit(
            {
                "log": {"sha256": run.sha256 or run.name},
                "stages": {"extract": {"context": {"start_ns": run.start_ns}}},
                "vehicle": {
                    "id": run.vehicle,
                    "mass_kg": run.mass_kg,
                    "wheel_radius_m": 0.3,
                    "track_width_m": 1.08 if run.sized else None,
                    "wheelbase_m": 0.914 if run.sized else None,
                    "max_speed_mps": 5.0,
                    "max_yaw_rate_radps": 4.0,
                },
                "terrain": run.terrain,
                "dataset": run.dataset,
                **({"simulated": True} if run.simulated else {}),
            }
        )


def make_budget(squares: Mapping[str, float]) -> pl.DataFrame:
    """What a run's slip is made of, from the mean square of each cause."""
    names = pl.col("name")
    kind = pl.when(names.is_in(["disturbance", "localization_noise"])).then(names).otherwise(pl.lit("effect"))
    share = pl.col("mean_square") / sum(squares.values())
    causes = pl.DataFrame({"name": list(squares), "mean_square": list(squares.values())})
    return causes.with_columns(kind.alias("kind"), *(share.alias(one) for one in ("share", "low", "high")))


def write_budgets(store: Store, runs: int) -> None:
    """Runs of three vehicles on four terrains, a day each, with estimates of all numbers and budgets."""
    rng = np.random.default_rng(0)
    numbers = [
        (effect.id, parameter.name)
        for effect in list_effects()
        for parameter in effect.parameters
        if math.isfinite(parameter.neutral)
    ]
    causes = [*dict.fromkeys(effect for effect, _ in numbers[:7]), "disturbance", "localization_noise"]
    for i in range(runs):
        vehicle, terrain = f"v{i % 3}", f"t{i % 4}"
        budget = make_budget(dict(zip(causes, rng.gamma(2.0, 0.1, len(causes)), strict=True)))
        estimates = [(effect, name, float(rng.normal(1.0, 0.1)), 0.05) for effect, name in numbers]
        run = Run(
            name=f"r{i:03d}", dataset=f"{vehicle}_{terrain}", vehicle=vehicle, terrain=terrain,
            seconds=6.0, start_ns=(1_700_000_000 + 86_400 * i) * 10**9, budget=budget, estimates=estimates,
        )  # fmt: skip
        write_run(store, run, seed=i)


def _cut_windows(slip: pl.DataFrame) -> pl.DataFrame:
    return (
        slip.with_columns((pl.col("t") / 2.0 + 1e-9).floor().alias("window"))
        .group_by("input", "window", maintain_order=True)
        .agg(
            pl.col("t").min().alias("t_start"),
            pl.col("t").max().alias("t_end"),
            pl.col("segment", "step").first(),
            pl.col("transitory").first(),
            pl.col("suspect").any(),
            pl.len().cast(pl.Int32).alias("samples"),
            (pl.col("modulus") ** 2).mean().sqrt().alias("rms_modulus"),
        )
        .with_columns((math.sqrt(40.0) * pl.col("rms_modulus")).alias("window_norm"))
        .drop("window")
    )


def _aggregate(slip: pl.DataFrame, run: Run) -> pl.DataFrame:
    rows = []
    for name in ("command", "measured"):
        for subset in ("all", "transitory", "steady"):
            own = slip.filter(pl.col("input") == name)
            if subset != "all":
                own = own.filter(pl.col("transitory") == (subset == "transitory"))
            rows.append(
                {
                    "input": name,
                    "subset": subset,
                    "samples": own.height,
                    "windows": own.height // 40,
                    "median_modulus": own["modulus"].median(),
                    "median_window_norm": math.sqrt(40.0) * float(own["modulus"].median()),  # type: ignore[arg-type]
                    **dict.fromkeys(
                        (
                            "rms_x", "rms_y", "rms_w", "mean_square", "drivetrain_mean_square",
                            "ground_mean_square", "cross_mean_square",
                        ),
                        0.1,
                    ),
                    "distance": 100.0,
                    "duration": run.seconds,
                    "height_rate": 0.0,
                    "largest_kinetic_energy": None if run.mass_kg is None else 1000.0,
                    "length_scale": run.length,
                }
            )  # fmt: skip
    return pl.DataFrame(rows).with_columns(
        pl.col("input").cast(_INPUTS),
        pl.col("subset").cast(_SUBSETS),
        pl.col("largest_kinetic_energy").cast(pl.Float64),
        pl.lit(None, pl.Float64).alias("median_residual_modulus"),
    )


def _list_findings(run: Run) -> pl.DataFrame:
    rows = [
        {
            "stage": "slip", "id": name, "severity": severity, "text": name, "where": "", "t_start": None,
            "t_end": None, "value": value, "count": None,
        }
        for name, severity, value in run.findings
    ]  # fmt: skip
    schema = {
        "stage": pl.String, "id": pl.String, "severity": pl.Enum(["info", "warning", "error"]),
        "text": pl.String, "where": pl.String, "t_start": pl.Float64, "t_end": pl.Float64,
        "value": pl.Float64, "count": pl.Int64,
    }  # fmt: skip
    return pl.DataFrame(rows, schema=schema, orient="row")


def _integrate(t: np.ndarray, speed: np.ndarray, turn: np.ndarray, start_ns: int) -> pl.DataFrame:
    """Poses of a vehicle that follows its ideal motion."""
    yaw = np.concatenate(([0.0], np.cumsum(turn[:-1]) / RATE))
    middle = yaw + turn / RATE / 2.0
    stamp = start_ns + (t * 1e9).astype(np.int64)
    zero = np.zeros_like(t)
    return pl.DataFrame(
        {
            "t": t,
            "stamp": stamp,
            "log_time": stamp,
            "segment": np.zeros(t.size, dtype=np.int32),
            "x": np.concatenate(([0.0], np.cumsum((speed * np.cos(middle))[:-1]) / RATE)),
            "y": np.concatenate(([0.0], np.cumsum((speed * np.sin(middle))[:-1]) / RATE)),
            "z": zero,
            "q_x": zero,
            "q_y": zero,
            "q_z": np.sin(yaw / 2.0),
            "q_w": np.cos(yaw / 2.0),
            "latency": zero,
            "outlier": zero > 1.0,
            "held": zero > 1.0,
            "corrected": zero > 1.0,
            "active": zero < 1.0,
        }
    )


def _list_estimates(run: Run) -> pl.DataFrame:
    rows = [
        {"effect": effect, "parameter": parameter, "value": value, "standard_error": error}
        for effect, parameter, value, error in run.estimates
    ]
    return pl.DataFrame(rows).with_columns(
        pl.lit("measured").cast(_INPUTS).alias("input"),
        pl.lit("1").alias("unit"),
        pl.lit(value=True).alias("named"),
        pl.lit(value=run.at_bound).alias("at_bound"),
        pl.lit(value=True).alias("in_model"),
    )


def _complete_budget(budget: pl.DataFrame) -> pl.DataFrame:
    kinds = pl.Enum(["effect", "disturbance", "localization_noise"])
    return budget.with_columns(
        pl.col("kind").cast(kinds),
        pl.lit("measured").cast(_INPUTS).alias("input"),
        pl.lit("slip").cast(pl.Enum(["slip", "position", "heading"])).alias("quantity"),
        pl.lit("m^2/s^2").alias("unit"),
        pl.lit(None, pl.Float64).alias("alone"),
        pl.lit(None, pl.Float64).alias("last"),
        pl.lit(20, pl.Int32).alias("stretches"),
    )
