"""The slip stage, g = f(u) - v after each command step, and the aggregates of a run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import polars as pl
import polars.selectors as cs

from pipeline.core import Flags, Floats, bound_median
from pipeline.recording import Finding, StageError
from pipeline.sources import Configuration, Vehicle
from pipeline.stages.inputs import WINDOW_S, Ideal, Steps, cut_steps, keep_known, mark_across, read_inputs
from pipeline.stages.motion_events import MotionEvents, find_events
from pipeline.stages.spans import find_spans
from pipeline.stages.standing import mark_standing
from pipeline.store import JSON
from schemas import tabulate
from schemas.run_tables import COUNTED

PUBLISHED_SAMPLES = 40
"""Samples of a published window, whose norm is not a mean: 40 at 20 Hz."""


@dataclass(frozen=True)
class SlipResult:
    """Slip of a run.

    Attributes:
        slip, windows, events: tables.
        inputs: all known inputs on the grid.
        recorded: the same as recorded, at the stamps of the poses; of measured wheels even if nothing uses
            them.
        suspect: samples in an incident, or with wrong poses, shape (n,).
        cut: command steps.
        findings: findings of the stage.
    """

    slip: pl.DataFrame
    windows: pl.DataFrame
    events: pl.DataFrame
    inputs: Mapping[str, Ideal]
    recorded: Mapping[str, Ideal]
    suspect: Flags
    cut: Steps
    findings: tuple[Finding, ...] = field(default=())


def compute_slip(
    velocities: pl.DataFrame,
    tables: Mapping[str, pl.DataFrame],
    *,
    vehicle: Vehicle,
    configuration: Configuration,
    hold_s: float | None,
    inputs: Sequence[str],
    where: str,
    is_drive_alone: bool = False,
) -> SlipResult:
    """Slip of every requested input, and where a run does not show a vehicle that follows its commands.

    Args:
        velocities: table `velocities`.
        tables: `poses`, `commands`, `wheels`, `imu`, aligned; those that the log lacks may be missing.
        vehicle: for the ideal model.
        configuration: length scale, transitory span.
        hold_s: how long a command is valid; None without commands.
        inputs: `command`, `measured`, or both.
        where: the run, for error messages.
        is_drive_alone: whether the poses are the motion of the measured wheels: a localization has faults,
            and they have none.

    Raises:
        StageError: none of the requested inputs has a single sample.
    """
    times = velocities["t"].to_numpy()
    commands, wheels = (tables.get(name, pl.DataFrame()) for name in ("commands", "wheels"))
    whole = read_inputs(times, commands, wheels, vehicle, hold_s)
    known = keep_known(whole)
    ideals = {name: ideal for name, ideal in known.items() if name in inputs}
    if not ideals:
        if whole and not any(ideal.active.any() for ideal in whole.values()):
            what = "no pose falls into the intervals in which commands are live"
            hint = "Correct [[interval]] (seconds from the run's start), or take all with --interval all."
            raise StageError("empty_interval", what, where=where, hint=hint)
        if known:
            hint = f"Take --input {next(iter(known))}."
            raise StageError(
                "no_command", "the inputs asked for have no usable values", where=where, hint=hint
            )
        what = "no command and no measured wheel speed falls together with a pose"
        hint = "Name the command in run.toml ([command] topic = ...); `slip inspect` lists the topics."
        raise StageError("no_command", what, where=where, hint=hint)
    length = configuration.slip.length_scale_m
    cut = cut_steps(velocities, known, length, configuration.slip.transitory_s)
    base = velocities.select(
        "t", "stamp", "segment", "v_x", "v_y", "v_w", "recorded_x", "recorded_y", "recorded_w"
    ).with_columns(
        step=pl.Series(cut.step),
        transitory=pl.Series(cut.transitory),
        standing=pl.Series(mark_standing(velocities, known)),
    )
    spans = find_spans(velocities, tables["poses"], known, vehicle, hold_s)
    findings = [*_report_stale(times, ideals, hold_s), *spans.findings]
    findings += report_across(wheels if "measured" in ideals else commands)
    suspect, motion = spans.excluded | spans.wrong | velocities["outlier"].to_numpy(), MotionEvents()
    if not is_drive_alone:
        motion = find_events(velocities, known, vehicle, spans)
        findings += motion.findings
    stamps = velocities["recorded_t"].to_numpy()
    # Readings that were repeated are no correction, unless nothing uses them.
    witness = wheels.drop(cs.ends_with("_aligned")) if "measured" not in known else wheels
    if not witness.is_empty():
        witness = witness.with_columns(pl.lit(0.0).alias("latency"))
    recorded = read_inputs(stamps, commands.drop(cs.ends_with("_aligned")), witness, vehicle, hold_s)
    parts = [_tabulate(base, name, ideal, recorded[name], suspect, length) for name, ideal in ideals.items()]
    slip = pl.concat(parts)
    windows = pl.concat([cut_windows(part, configuration.velocity.rate_hz) for part in parts])
    return SlipResult(slip, windows, motion.table, known, recorded, suspect, cut, tuple(findings))


def _tabulate(
    base: pl.DataFrame, name: str, ideal: Ideal, recorded: Ideal, suspect: Flags, length: float
) -> pl.DataFrame:
    """Table `slip` of one input: samples with a known input in live intervals."""
    velocity = ideal.velocity
    mask = np.isfinite(velocity).all(axis=1) & ideal.active
    slip = velocity - base.select("v_x", "v_y", "v_w").to_numpy()
    before = recorded.velocity - base.select("recorded_x", "recorded_y", "recorded_w").to_numpy()
    modulus, raw = (np.linalg.norm(gap * np.array([1.0, 1.0, length]), axis=1) for gap in (slip, before))
    return base.with_columns(
        pl.lit(name, dtype=pl.Enum(["command", "measured"])).alias("input"),
        *(pl.Series(f"f_{axis}", velocity[:, i]) for i, axis in enumerate("xyw")),
        *(pl.Series(f"g_{axis}", slip[:, i]) for i, axis in enumerate("xyw")),
        pl.Series("modulus", modulus),
        pl.Series("recorded_modulus", raw).fill_nan(None),
        pl.Series("suspect", suspect),
        # Filled where a model is available; this stage only knows the ideal one.
        *(
            pl.lit(None, pl.Float64).alias(name)
            for name in ("model_x", "model_y", "model_w", "residual_modulus")
        ),
    ).filter(pl.Series(mask))


def cut_windows(slip: pl.DataFrame, rate: float) -> pl.DataFrame:
    """Table `windows` of one input: full 2 s windows from each step's start, the remainder dropped.

    A window norm is sqrt(40) times the root mean square of the modulus at any rate: at the published 20 Hz it
    is the Frobenius norm of the window's slip matrix.
    """
    size = max(round(WINDOW_S * rate), 1)
    indexed = slip.with_columns(
        # A sample left out inside a step (stale, outside an interval) ends the stretch as a step would.
        (pl.col("t").diff().fill_null(0.0) > 1.5 / rate)
        .cum_sum()
        .alias("stretch"),  # 1.5: tolerance of half a period
    ).with_columns(
        ((pl.col("t") - pl.col("t").min().over("step")) * rate / size + 1e-6)
        .floor()
        .cast(pl.Int32)
        .alias("window")
    )
    grouped = indexed.group_by("step", "stretch", "window", maintain_order=True).agg(
        pl.col("input").first(),
        pl.col("t").min().alias("t_start"),
        (pl.col("t").max() + 1.0 / rate).alias("t_end"),
        pl.col("segment").first(),
        pl.col("suspect", "standing").any(),
        (pl.col("transitory").mean() > 0.5).alias("transitory"),  # noqa: PLR2004 - most of the window
        pl.len().cast(pl.Int32).alias("samples"),
        (pl.col("modulus") ** 2).mean().sqrt().alias("rms_modulus"),
    )
    return (
        grouped.filter(pl.col("samples") == size)
        .with_columns((pl.col("rms_modulus") * PUBLISHED_SAMPLES**0.5).alias("window_norm"))
        .drop("stretch", "window")
    )


def _report_stale(times: Floats, ideals: dict[str, Ideal], hold_s: float | None) -> list[Finding]:
    ideal = ideals.get("command")
    if ideal is None or hold_s is None:
        return []
    # A command of zero does not lapse: a vehicle that is asked to stand needs no second one.
    lapsed = ideal.expired.any(axis=1)
    if not lapsed.any():
        return []
    count = int(lapsed.sum())
    seconds = count * float(np.median(np.diff(times))) if times.size > 1 else 0.0
    first = float(times[np.flatnonzero(lapsed)[0]])
    values = {"kind": "lapsed", "count": count, "seconds": seconds, "hold_s": hold_s}
    return [Finding("stale_command", "warning", "command", values, t_start=first)]


def report_across(drive: pl.DataFrame) -> list[Finding]:
    """A finding on a table of the drive whose steered wheel stands across, so that its turn is unknown."""
    across = np.flatnonzero(mark_across(drive))
    if not across.size:
        return []
    stamps = drive["t"].to_numpy()
    seconds = across.size * float(np.median(np.diff(stamps))) if stamps.size > 1 else 0.0
    first = float(stamps[across[0]])
    values = {"count": across.size, "seconds": seconds}
    return [Finding("steered_across", "warning", "wheels", values, t_start=first)]


_ROUGHNESS_S = 1.0
"""Span over which height changes are taken [s]: Triest et al. 2022 use one second."""
_CALM_SAMPLES = 21
"""Width of the running median of the speed [samples]: a second at 20 Hz, which removes jumps of a pose."""
_FASTEST = 0.99
"""Quantile used as the largest speed: tolerates one bad pose in a hundred."""


def aggregate_run(
    slip: pl.DataFrame,
    windows: pl.DataFrame,
    velocities: pl.DataFrame,
    *,
    vehicle: Vehicle,
    length: float,
    moves: bool = True,
) -> pl.DataFrame:
    """Table `aggregates` of one run.

    Samples in bad stretches and at rest are left out. If command and measured wheels are both known, the mean
    square of the slip splits into drivetrain + ground + cross, with drivetrain = f(command) - f(measured) and
    ground = f(measured) - v: vectors add, moduli do not.

    Args:
        slip: table `slip`.
        windows: table `windows`.
        velocities: table `velocities`.
        vehicle: for the kinetic energy.
        length: length scale L [m].
        moves: whether the vehicle moves; the path of one that stands is noise of the poses.
    """
    clean, whole = slip.filter(COUNTED), windows.filter(COUNTED)
    height_rate = _height_rate(velocities)
    period = float(np.median(np.diff(velocities["t"].to_numpy())))
    rows = []
    for name in slip["input"].unique(maintain_order=True):
        for subset in ("all", "transitory", "steady"):
            chosen = [
                frame.filter((pl.col("input") == name) & _in_subset(subset)) for frame in (clean, whole)
            ]
            raw = slip.filter((pl.col("input") == name) & _in_subset(subset) & ~pl.col("standing"))
            energy = 0.5 * pl.lit(vehicle.mass_kg, dtype=pl.Float64) * find_fastest() ** 2
            split = _split_parts(clean.filter(_in_subset(subset)), length) if name == "command" else {}
            rows.append(
                {
                    "input": name,
                    "subset": subset,
                    **_summarize_slip(chosen[0], chosen[1]),
                    "median_recorded_modulus": _number(raw["recorded_modulus"].median()),
                    **_measure_distance(chosen[0], period, moves=moves),
                    **split,
                    "height_rate": height_rate,
                    "largest_kinetic_energy": clean.filter(pl.col("input") == name).select(energy).item(),
                    "length_scale": length,
                }
            )

    return set_residuals(tabulate("aggregates", rows), slip)


def find_residual_modulus(predicted: Floats, slip: pl.DataFrame, *, length: float) -> Floats:
    """Modulus of a model's velocity residual [m/s], shape (n,).

    Args:
        predicted: body velocities of the model at the rows of ``slip`` [m/s, m/s, rad/s], shape (n, 3).
        slip: rows of table `slip` of one input.
        length: length scale L [m] of the modulus.
    """
    residual = (predicted - slip.select("v_x", "v_y", "v_w").to_numpy()) * np.array([1.0, 1.0, length])
    return np.asarray(np.sqrt(np.sum(residual**2, axis=1)), dtype=np.float64)


def set_residuals(aggregates: pl.DataFrame, slip: pl.DataFrame) -> pl.DataFrame:
    """Table `aggregates` with the medians of the residual moduli in table `slip`."""
    clean = slip.filter(COUNTED)
    medians = [
        clean.filter((pl.col("input") == name) & _in_subset(subset))["residual_modulus"].median()
        for name, subset in aggregates.select("input", "subset").iter_rows()
    ]
    return aggregates.with_columns(pl.Series("median_residual_modulus", medians, pl.Float64))


def _in_subset(subset: str) -> pl.Expr:
    if subset == "all":
        return pl.lit(value=True)
    return pl.col("transitory") if subset == "transitory" else ~pl.col("transitory")


def _summarize_slip(slip: pl.DataFrame, windows: pl.DataFrame) -> dict[str, float | int | None]:
    return {
        "samples": slip.height,
        "windows": windows.height,
        "median_modulus": _number(slip["modulus"].median()),
        "median_window_norm": _number(windows["window_norm"].median()),
        **{f"rms_{axis}": _root_mean_square(slip[f"g_{axis}"]) for axis in "xyw"},
        "mean_square": _number((slip["modulus"] ** 2).mean()),
    }


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, (int, float)) else None


def _root_mean_square(series: pl.Series) -> float | None:
    return float(np.sqrt((series**2).mean())) if series.len() else None  # type: ignore[arg-type]


def _split_parts(slip: pl.DataFrame, length: float) -> dict[str, float]:
    """Mean squares of drivetrain part, ground part and twice their product, for samples with both inputs."""
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


def _measure_distance(slip: pl.DataFrame, period: float, *, moves: bool) -> dict[str, float | None]:
    """Time of samples and distance driven in them; unknown if the vehicle stands, where it is noise alone."""
    speed = np.hypot(slip["v_x"].to_numpy(), slip["v_y"].to_numpy())
    return {"distance": float(speed.sum()) * period if moves else None, "duration": slip.height * period}


def find_fastest() -> pl.Expr:
    """Largest speed of sound samples of a run [m/s]: one that lasts, without jumps of single poses."""
    speed = (pl.col("v_x") ** 2 + pl.col("v_y") ** 2).sqrt()
    return speed.rolling_median(_CALM_SAMPLES, min_samples=3).quantile(_FASTEST)


def _height_rate(velocities: pl.DataFrame) -> float | None:
    """Median of the absolute height change over one second [m/s] (Triest et al. 2022)."""
    pieces = []
    for piece in velocities.partition_by("segment", maintain_order=True):
        times, height = piece["t"].to_numpy(), piece["z"].to_numpy()
        if times[-1] - times[0] >= _ROUGHNESS_S:
            later = np.interp(times + _ROUGHNESS_S, times, height)
            pieces.append(np.abs(later - height)[times <= times[-1] - _ROUGHNESS_S] / _ROUGHNESS_S)
    return float(np.median(np.concatenate(pieces))) if pieces else None


SUMMARY_DIGITS = 6


def summarize_inputs(aggregates: pl.DataFrame, slip: pl.DataFrame) -> dict[str, dict[str, JSON]]:
    """Samples and medians of every input, for the summary of a run; see the tables of these names.

    The 95 % interval of the median is that of other stretches of ten seconds of the same driving.
    """
    names = aggregates["input"].unique(maintain_order=True)
    return {name: _summarize_input(aggregates, slip, name) for name in names}


def _summarize_input(aggregates: pl.DataFrame, slip: pl.DataFrame, name: str) -> dict[str, JSON]:
    rows = {subset: pick_row(aggregates, name, subset) for subset in ("all", "transitory", "steady")}
    whole = rows["all"]
    known = slip.filter(pl.col("input").cast(pl.String) == name, COUNTED)
    low, high = bound_median(known["modulus"].to_numpy(), known["t"].to_numpy()) or (None, None)
    return {
        "samples": int(whole["samples"] or 0),
        "windows": int(whole["windows"] or 0),
        "median_modulus": round_number(whole["median_modulus"]),
        "median_modulus_low": round_number(low),
        "median_modulus_high": round_number(high),
        "median_window_norm": round_number(whole["median_window_norm"]),
        "median_residual_modulus": round_number(whole["median_residual_modulus"]),
        "rms": [round_number(whole[f"rms_{axis}"]) for axis in "xyw"],
        "transitory_median_modulus": round_number(rows["transitory"]["median_modulus"]),
        "steady_median_modulus": round_number(rows["steady"]["median_modulus"]),
    }


def find_standing_share(slip: pl.DataFrame, name: str) -> float:
    """Share of the samples of an input in which the vehicle stands."""
    return float(slip.filter(pl.col("input") == name)["standing"].to_numpy().mean())


def pick_row(aggregates: pl.DataFrame, name: str, subset: str) -> dict[str, float | None]:
    """The row of an input's subset: `all`, `transitory` or `steady`."""
    return aggregates.filter((pl.col("input") == name) & (pl.col("subset") == subset)).row(0, named=True)


def round_number(value: float | None) -> float | None:
    """A number of a summary, with six decimals."""
    return None if value is None else round(float(value), SUMMARY_DIGITS)
