"""The aggregate stage: what a run comes to."""

import numpy as np
import polars as pl

from pipeline.core.tables import tabulate
from pipeline.vehicles import Vehicle

_ROUGHNESS_S = 1.0


def aggregate_run(
    slip: pl.DataFrame, windows: pl.DataFrame, velocities: pl.DataFrame, *, vehicle: Vehicle, length: float
) -> pl.DataFrame:
    """Table `aggregates` of one run.

    Samples in bad stretches are left out. Where command and measured wheels are both known, the mean square
    of the slip splits as drivetrain + ground + cross, with drivetrain = f(command) - f(measured) and
    ground = f(measured) - v: vectors add, moduli do not.

    Args:
        slip: table `slip`.
        windows: table `windows`.
        velocities: table `velocities`.
        vehicle: for the kinetic energy.
        length: length scale L [m].
    """
    clean, whole = slip.filter(~pl.col("suspect")), windows.filter(~pl.col("suspect"))
    motion = _describe_motion(velocities, vehicle)
    rows = []
    for name in slip["input"].unique(maintain_order=True):
        for subset in ("all", "transitory", "steady"):
            chosen = [
                frame.filter((pl.col("input") == name) & _in_subset(subset)) for frame in (clean, whole)
            ]
            split = _split_parts(clean.filter(_in_subset(subset)), length) if name == "command" else {}
            rows.append(
                {
                    "input": name,
                    "subset": subset,
                    **_describe_slip(chosen[0], chosen[1]),
                    **split,
                    **motion,
                    "length_scale": length,
                }
            )
    return tabulate("aggregates", rows)


def _in_subset(subset: str) -> pl.Expr:
    if subset == "all":
        return pl.lit(value=True)
    return pl.col("transitory") if subset == "transitory" else ~pl.col("transitory")


def _describe_slip(slip: pl.DataFrame, windows: pl.DataFrame) -> dict[str, float | int | None]:
    return {
        "samples": slip.height,
        "windows": windows.height,
        "median_modulus": _number(slip["modulus"].median()),
        "median_residual_modulus": _number(slip["residual_modulus"].median()),
        "median_window_norm": _number(windows["window_norm"].median()),
        **{f"rms_{axis}": _root_mean_square(slip[f"g_{axis}"]) for axis in "xyw"},
        "mean_square": _number((slip["modulus"] ** 2).mean()),
    }


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, (int, float)) else None


def _root_mean_square(series: pl.Series) -> float | None:
    return float(np.sqrt((series**2).mean())) if series.len() else None  # type: ignore[arg-type]


def _split_parts(slip: pl.DataFrame, length: float) -> dict[str, float]:
    """Mean squares of drivetrain part, ground part and twice their product, where both inputs are known."""
    sides = [slip.filter(pl.col("input") == name) for name in ("command", "measured")]
    columns = ["stamp", "f_x", "f_y", "f_w", "g_x", "g_y", "g_w"]
    both = sides[0].select(columns).join(sides[1].select(columns), on="stamp", suffix="_measured")
    if both.is_empty():
        return {}
    scale = np.array([1.0, 1.0, length])
    command = both.select("f_x", "f_y", "f_w").to_numpy()
    measured = both.select("f_x_measured", "f_y_measured", "f_w_measured").to_numpy()
    drivetrain = (command - measured) * scale
    ground = both.select("g_x_measured", "g_y_measured", "g_w_measured").to_numpy() * scale
    return {
        "drivetrain_mean_square": float(np.mean(np.sum(drivetrain**2, axis=1))),
        "ground_mean_square": float(np.mean(np.sum(ground**2, axis=1))),
        "cross_mean_square": float(2.0 * np.mean(np.sum(drivetrain * ground, axis=1))),
    }


def _describe_motion(velocities: pl.DataFrame, vehicle: Vehicle) -> dict[str, float | None]:
    """Distance, time, height variation and largest kinetic energy of a run."""
    times = velocities["t"].to_numpy()
    inside = np.diff(velocities["segment"].to_numpy()) == 0
    period = np.diff(times)
    speed = np.hypot(velocities["v_x"].to_numpy(), velocities["v_y"].to_numpy())
    distance = float(np.sum((speed[:-1] * period)[inside]))
    duration = float(np.sum(period[inside]))
    # The 99.5th percentile stands for the largest speed: a single noisy sample is no kinetic energy.
    fastest = float(np.quantile(speed, 0.995))
    energy = None if vehicle.mass_kg is None else 0.5 * vehicle.mass_kg * fastest**2
    return {
        "distance": distance,
        "duration": duration,
        "height_rate": _height_rate(velocities),
        "largest_kinetic_energy": energy,
    }


def _height_rate(velocities: pl.DataFrame) -> float | None:
    """Median of the absolute height change over one second [m/s] (Triest et al. 2022)."""
    pieces = []
    for piece in velocities.partition_by("segment", maintain_order=True):
        times, height = piece["t"].to_numpy(), piece["z"].to_numpy()
        if times[-1] - times[0] >= _ROUGHNESS_S:
            later = np.interp(times + _ROUGHNESS_S, times, height)
            pieces.append(np.abs(later - height)[times <= times[-1] - _ROUGHNESS_S] / _ROUGHNESS_S)
    return float(np.median(np.concatenate(pieces))) if pieces else None
