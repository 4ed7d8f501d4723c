"""The slip stage, g = f(u) - v after each command step, and the aggregates of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import polars as pl
from numpy.typing import NDArray

from pipeline.core import arrays
from pipeline.core.arrays import Flags, Floats
from pipeline.run import read_wheel_times
from pipeline.run.signals import STILL_MPS
from pipeline.sources import Configuration, Vehicle
from pipeline.stages import Finding, StageError

_SHARE_OF_RANGE = 0.02
"""Fraction of a command's range that counts as a change: joysticks and path followers vary by less."""
_NOISES = 8.0
"""Change of measured wheel speeds that counts [standard deviations of their noise]: eight exceed any
noise."""
_GROWTH = 0.6745 * 6.0**0.5
"""Median magnitude of second differences of white noise over its standard deviation."""
_SHORTEST_STEP = 1.0
"""Shortest command step [s]: a shorter ramp is one change."""
WINDOW_S = 2.0
"""Length of a window [s]: that of the published medians, and the shortest hold of a command step."""
PUBLISHED_SAMPLES = 40
"""Samples of a published window, whose norm is not a mean: 40 at 20 Hz."""


def find_changes(times: Floats, ideal: Floats, length: float) -> Flags:
    """Whether the command changes before each sample.

    It changes if its ideal velocity has moved from its level by more than 2 % of its range (and eight times
    the noise, if measured wheels replace a command), but no sooner than one second after the last change. The
    level is the value of the command one second after a change, so that a short ramp is one change.

    Args:
        times: grid times [s], shape (n,).
        ideal: ideal velocity of the command (f_x, f_y, f_w), NaN where there is none, shape (n, 3).
        length: length scale L [m] that makes yaw rates comparable to speeds.

    Returns:
        Flags of shape (n,); the first is True, since the earlier command is unknown.
    """
    scaled = np.nan_to_num(ideal * np.array([1.0, 1.0, length]))
    size = np.linalg.norm(scaled, axis=1)
    jitter = np.linalg.norm(np.diff(scaled, axis=0), axis=1)
    changes = np.zeros(times.size, dtype=bool)
    changes[:1] = True
    if times.size < 2:  # noqa: PLR2004 - one sample has nothing to change from
        return changes
    tolerance = max(
        _SHARE_OF_RANGE * float(np.quantile(size, 0.99)),
        _NOISES * _estimate_noise(scaled),
        STILL_MPS,
    )
    begin, level = 0, scaled[0]
    # Only samples at which the command changes can start a step, so this loop is short for held commands.
    for index in (np.flatnonzero(jitter > 0.0) + 1).tolist():
        late_enough = times[index] - times[begin] >= _SHORTEST_STEP
        if late_enough and np.linalg.norm(scaled[index] - level) > tolerance:
            changes[index] = True
            begin = index
        if times[index] - times[begin] < _SHORTEST_STEP:
            level = scaled[index]
    return changes


def _estimate_noise(scaled: Floats) -> float:
    """Level of the white noise in a series (n, 3) by its second differences, which cancel smooth motion."""
    if scaled.shape[0] < 3:  # noqa: PLR2004 - a second difference needs three
        return 0.0
    return float(np.median(np.linalg.norm(np.diff(scaled, n=2, axis=0), axis=1))) / _GROWTH


def number_steps(times: Floats, segment: NDArray[np.int32], changes: Flags) -> NDArray[np.int32]:
    """Number the command steps of a run.

    A step starts with a segment, and where the command changes to or from a value held for two seconds. A
    command that varies continuously (a joystick, a path follower) is one long step: cut at each change, it
    would have no window of two seconds at all.

    Args:
        times: grid times [s], shape (n,).
        segment: number of the segment, shape (n,).
        changes: whether the command changes before each sample, shape (n,).

    Returns:
        Step numbers, shape (n,), starting at zero.
    """
    places = np.flatnonzero(changes)
    period = times[1] - times[0] if times.size > 1 else 0.0
    lasts = np.diff(times[places], append=times[-1] + period)
    held = lasts >= WINDOW_S - arrays.ROUNDING_S
    starts = np.zeros(times.size, dtype=bool)
    starts[places[held | np.concatenate(([True], held[:-1]))]] = True
    starts[1:] |= np.diff(segment) != 0
    return (np.cumsum(starts) - 1).astype(np.int32)


def mark_transitory(times: Floats, changes: Flags, span: float) -> Flags:
    """Whether each sample lies within ``span`` [s] of the last change of the command."""
    last = np.maximum.accumulate(np.where(changes, np.arange(times.size), 0))
    return times - times[last] < span - arrays.ROUNDING_S


@dataclass(frozen=True)
class SlipResult:
    """Tables `slip` and `windows`, all inputs and steps on the grid, and findings."""

    slip: pl.DataFrame
    windows: pl.DataFrame
    inputs: Mapping[str, Ideal]
    cut: Steps
    findings: tuple[Finding, ...] = field(default=())


@dataclass(frozen=True)
class Ideal:
    """Ideal velocities of one input on the grid.

    Attributes:
        velocity: (f_x, f_y, f_w), NaN if the input is unknown, shape (n, 3).
        stale: samples whose last command is too old to be valid, shape (n,).
        active: samples in an interval with live commands.
    """

    velocity: Floats
    stale: Flags
    active: Flags

    def leave_out(self, samples: Flags) -> Ideal:
        """The same with some samples unknown."""
        return replace(self, velocity=np.where(samples[:, None], np.nan, self.velocity))

    @property
    def expired(self) -> Floats:
        """Velocities of the last valid input where it is stale; zero elsewhere, shape (n, 3)."""
        known = np.isfinite(self.velocity).all(axis=1)
        last = np.maximum.accumulate(np.where(known, np.arange(known.size), -1))
        taken = self.stale & (last >= 0)
        return np.where(taken[:, None], self.velocity[np.maximum(last, 0)], 0.0)


def compute_slip(
    velocities: pl.DataFrame,
    commands: pl.DataFrame,
    wheels: pl.DataFrame,
    *,
    vehicle: Vehicle,
    configuration: Configuration,
    hold_s: float | None,
    inputs: Sequence[str],
    where: str,
) -> SlipResult:
    """Slip of every requested input.

    Args:
        velocities: table `velocities`.
        commands: table `commands`, aligned; may be empty.
        wheels: table `wheels`; may be empty.
        vehicle: for the ideal model.
        configuration: length scale, transitory span.
        hold_s: how long a command is valid; None without commands.
        inputs: `command`, `measured`, or both.
        where: the run, for error messages.

    Raises:
        StageError: none of the requested inputs has a single sample.
    """
    times = velocities["t"].to_numpy()
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
    base = velocities.select("t", "stamp", "segment", "v_x", "v_y", "v_w").with_columns(
        step=pl.Series(cut.step), transitory=pl.Series(cut.transitory)
    )
    suspect = velocities["outlier"].to_numpy()
    findings = _report_stale(times, ideals)
    parts = [_tabulate(base, name, ideal, suspect, length) for name, ideal in ideals.items()]
    slip = pl.concat(parts)
    windows = pl.concat([cut_windows(part, configuration.velocity.rate_hz) for part in parts])
    return SlipResult(slip, windows, known, cut, tuple(findings))


@dataclass(frozen=True)
class Steps:
    """Command steps of a run on its grid.

    Attributes:
        step: number of the step of each sample, shape (n,).
        transitory: within the transitory span after a change of the command, shape (n,).
    """

    step: NDArray[np.int32]
    transitory: Flags


def read_inputs(
    times: Floats, commands: pl.DataFrame, wheels: pl.DataFrame, vehicle: Vehicle, hold_s: float | None
) -> dict[str, Ideal]:
    """Ideal velocities of every available input, by name."""
    known: dict[str, Ideal] = {}
    if not commands.is_empty() and hold_s is not None:
        known["command"] = hold_commands(times, commands, vehicle, hold_s)
    if not wheels.is_empty():
        known["measured"] = interpolate_wheels(times, wheels, vehicle)
    return known


def keep_known(inputs: Mapping[str, Ideal]) -> dict[str, Ideal]:
    """The inputs that are known in some live interval."""
    return {n: one for n, one in inputs.items() if np.isfinite(one.velocity[one.active]).all(axis=1).any()}


def cut_steps(
    velocities: pl.DataFrame, known: Mapping[str, Ideal], length: float, transitory_s: float
) -> Steps:
    """Command steps; those of the measured wheels only without a command, regardless of the requested inputs.

    Args:
        velocities: table `velocities`.
        known: at least one input.
        length: length scale L [m].
        transitory_s: span after a change [s].
    """
    times = velocities["t"].to_numpy()
    leading = known.get("command") or known["measured"]
    changes = find_changes(times, leading.velocity, length)
    return Steps(
        number_steps(times, velocities["segment"].to_numpy(), changes),
        mark_transitory(times, changes, transitory_s),
    )


def hold_commands(times: Floats, commands: pl.DataFrame, vehicle: Vehicle, hold: float) -> Ideal:
    """Ideal velocities of the last command at each time, while it is valid.

    Args:
        times: grid [s].
        commands: table `commands`, sorted by time.
        vehicle: for the ideal model.
        hold: how long a command is valid [s].
    """
    stamps = commands["t"].to_numpy()
    index = arrays.hold_indices(times, stamps)
    known = index >= 0
    last = np.maximum(index, 0)
    stale = known & (times - stamps[last] > hold)
    velocity = _predict(commands, vehicle)[last]
    velocity[~known | stale] = np.nan
    active = commands["active"].to_numpy()[last] & known
    return Ideal(velocity, stale & active, active)


def interpolate_wheels(times: Floats, wheels: pl.DataFrame, vehicle: Vehicle) -> Ideal:
    """Ideal velocities of the measured wheels, interpolated; unknown in gaps of the encoders."""
    stamps = read_wheel_times(wheels)
    values = arrays.interpolate_linearly(times, stamps, _predict(wheels, vehicle))
    before = arrays.hold_indices(times, stamps)
    after = np.minimum(before + 1, stamps.size - 1)
    longest = max(arrays.SILENT_S, arrays.PERIODS * _usual_period(stamps))
    on_sample = np.abs(times - stamps[np.maximum(before, 0)]) < arrays.ROUNDING_S
    known = (before >= 0) & (on_sample | ((after > before) & (stamps[after] - stamps[before] <= longest)))
    values[~known] = np.nan
    active = wheels["active"].to_numpy()[np.maximum(before, 0)] & (before >= 0)
    return Ideal(values, np.zeros(times.size, dtype=bool), active)


def _predict(drive: pl.DataFrame, vehicle: Vehicle) -> Floats:
    kinematics = vehicle.kinematics
    inputs = {quantity.name: _read_aligned(drive, quantity.name) for quantity in kinematics.inputs}
    return np.stack(kinematics.forward(inputs, vehicle), axis=-1)


def _read_aligned(drive: pl.DataFrame, name: str) -> Floats:
    """A signal of the drive, corrected if a correction exists."""
    aligned = f"{name}_aligned"
    return drive[aligned if aligned in drive.columns else name].to_numpy()


def _usual_period(stamps: Floats) -> float:
    # Two topics, one per side, come in pairs of nearly equal stamps: their median period is almost zero.
    return float(np.quantile(np.diff(stamps), 0.75)) if stamps.size > 1 else 0.0


def _tabulate(base: pl.DataFrame, name: str, ideal: Ideal, suspect: Flags, length: float) -> pl.DataFrame:
    """Table `slip` of one input: samples with a known input in live intervals."""
    velocity = ideal.velocity
    mask = np.isfinite(velocity).all(axis=1) & ideal.active
    slip = velocity - base.select("v_x", "v_y", "v_w").to_numpy()
    modulus = np.sqrt(slip[:, 0] ** 2 + slip[:, 1] ** 2 + (length * slip[:, 2]) ** 2)
    return base.with_columns(
        pl.lit(name, dtype=pl.Enum(["command", "measured"])).alias("input"),
        *(pl.Series(f"f_{axis}", velocity[:, i]) for i, axis in enumerate("xyw")),
        *(pl.Series(f"g_{axis}", slip[:, i]) for i, axis in enumerate("xyw")),
        pl.Series("modulus", modulus),
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
        pl.col("suspect").any(),
        (pl.col("transitory").mean() > 0.5).alias("transitory"),  # noqa: PLR2004 - most of the window
        pl.len().cast(pl.Int32).alias("samples"),
        (pl.col("modulus") ** 2).mean().sqrt().alias("rms_modulus"),
    )
    return (
        grouped.filter(pl.col("samples") == size)
        .with_columns((pl.col("rms_modulus") * PUBLISHED_SAMPLES**0.5).alias("window_norm"))
        .drop("stretch", "window")
    )


def _report_stale(times: Floats, ideals: dict[str, Ideal]) -> list[Finding]:
    ideal = ideals.get("command")
    if ideal is None:
        return []
    # A command of zero does not lapse: a vehicle that is asked to stand needs no second one.
    lapsed = ideal.expired.any(axis=1)
    if not lapsed.any():
        return []
    count = int(lapsed.sum())
    text = f"in {count} time steps the last command is older than command.hold_s: left out"
    first = float(times[np.flatnonzero(lapsed)[0]])
    return [Finding("stale_command", "warning", text, where="command", t_start=first, count=count)]


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

    Samples in bad stretches are left out. If command and measured wheels are both known, the mean square of
    the slip splits into drivetrain + ground + cross, with drivetrain = f(command) - f(measured) and
    ground = f(measured) - v: vectors add, moduli do not.

    Args:
        slip: table `slip`.
        windows: table `windows`.
        velocities: table `velocities`.
        vehicle: for the kinetic energy.
        length: length scale L [m].
        moves: whether the vehicle moves; the path of one that stands is noise of the poses.
    """
    clean, whole = slip.filter(~pl.col("suspect")), windows.filter(~pl.col("suspect"))
    height_rate = _height_rate(velocities)
    period = float(np.median(np.diff(velocities["t"].to_numpy())))
    rows = []
    for name in slip["input"].unique(maintain_order=True):
        for subset in ("all", "transitory", "steady"):
            chosen = [
                frame.filter((pl.col("input") == name) & _in_subset(subset)) for frame in (clean, whole)
            ]
            energy = 0.5 * pl.lit(vehicle.mass_kg, dtype=pl.Float64) * find_fastest() ** 2
            split = _split_parts(clean.filter(_in_subset(subset)), length) if name == "command" else {}
            rows.append(
                {
                    "input": name,
                    "subset": subset,
                    **_summarize_slip(chosen[0], chosen[1]),
                    **_measure_distance(chosen[0], period, moves=moves),
                    **split,
                    "height_rate": height_rate,
                    "largest_kinetic_energy": clean.filter(pl.col("input") == name).select(energy).item(),
                    "length_scale": length,
                }
            )
    from schemas import tabulate  # noqa: PLC0415 - `slip inspect` needs no contract

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
    clean = slip.filter(~pl.col("suspect"))
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
