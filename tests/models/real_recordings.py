"""The real recordings with the effects that METHODS names for them, and how far those bring the error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from pipeline.core.arrays import nearest_indices
from pipeline.estimation import Fitted, Input, Problem, fit_model, hold_out
from pipeline.estimation.folds import measure_errors, refit
from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.models import Model, Timing, find_effect
from pipeline.run import MotionRun, load_run
from pipeline.sources import Vehicle
from pipeline.store import Store

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.estimation import Errors
    from pipeline.estimation.comparison import HorizonErrors

M, C = Input.MEASURED, Input.COMMAND
TRACK, INERTIA = "effective_track", "body_inertia"
NAN = float("nan")
Ratios = tuple[float, float, float, float, float]


@dataclass(frozen=True)
class Case:
    """A recording, an input, the effects, and what is left of the ideal model's held-out error.

    Attributes:
        log: name of the recording.
        source: input of the model.
        effects: given by hand.
        table: METHODS section 5, "On the real recordings": x, y, w over half a second, T, R over 2 s.
    """

    log: str
    source: Input
    effects: tuple[str, ...]
    table: Ratios


# The tyres of the tile recording are deflated: their radius is one of the right effects. The commands of the
# snow recording are 1.82 times too large: so is its wheel_radius from commands.
TILE = (TRACK, "icr_offset", "yaw_misalignment", "wheel_asymmetry", "wheel_radius")
SNOW = (TRACK, "icr_offset", "turning_resistance")
SNOW_DRIVE = ("body_turn_limit", "turn_acceleration_limit", "wheel_speed_scaling", "drive_lag")
WET = (TRACK, "icr_offset", "body_turn_limit", "turn_lag", "transport_delay")
FAST = (TRACK, INERTIA, "turn_lag", "wheel_speed_limit")
GRAVEL = (TRACK, INERTIA, "lateral_skid")
ICE = (INERTIA, "acceleration_limit", TRACK)
_LIMITS = ("body_turn_limit", "wheel_speed_limit")
_ASPHALT: tuple[Ratios, Ratios] = ((0.86, 0.52, 0.38, 0.40, 0.14), (0.46, 0.54, 0.20, 0.19, 0.10))
_GRAVEL: tuple[Ratios, Ratios] = ((0.71, 0.42, 0.27, 0.25, 0.14), (0.36, 0.42, 0.15, 0.19, 0.10))
_GRASS: tuple[Ratios, Ratios] = ((NAN, NAN, 0.18, 0.56, 0.07), (0.58, 1.00, 0.17, 0.43, 0.16))
_ROWS: tuple[tuple[str, tuple[str, ...], tuple[str, ...], tuple[Ratios, Ratios]], ...] = (
    (
        "husky_wheels-deflated_tile_2023_12_12_16h16",
        TILE,
        (*TILE, "turn_lag", "transport_delay"),
        ((0.64, 0.22, 0.09, 0.22, 0.06), (0.45, 0.25, 0.14, 0.23, 0.11)),
    ),
    (
        "husky_snow_boreal",
        SNOW,
        (*SNOW, "wheel_radius", *SNOW_DRIVE),
        ((0.68, 0.73, 0.21, 0.41, 0.17), (0.67, 0.75, 0.06, 0.37, 0.05)),
    ),
    (
        "husky_wheels_wetgrass",
        (TRACK, "icr_offset"),
        WET,
        ((1.00, 0.96, 0.13, 0.76, 0.08), (0.96, 0.96, 0.09, 0.62, 0.06)),
    ),
    ("warthog_wheels_asphalt_2024_8_7_11h30s30", (TRACK, INERTIA), FAST, _ASPHALT),
    ("warthog_wheels_asphalt", (TRACK, INERTIA), FAST, _ASPHALT),
    ("warthog_wheels_asphalt_2024_9_20_8h13s12", (TRACK, INERTIA), FAST, _ASPHALT),
    ("warthog_gravel_1", GRAVEL, (*GRAVEL, "turn_lag", *_LIMITS), _GRAVEL),
    ("warthog_wheels_gravel_2024_8_6_11h37s32", GRAVEL, (*GRAVEL, "turn_lag", *_LIMITS), _GRAVEL),
    (
        "warthog_wheels_sand_2024_9_25_14h32s32",
        (TRACK, INERTIA),
        (*FAST, "body_turn_limit"),
        ((0.82, 0.77, 0.38, 0.49, 0.22), (0.55, 0.78, 0.20, 0.27, 0.09)),
    ),
    (
        "warthog_wheels_ice_2024_7_30_16h30s21",
        (INERTIA, "wheel_radius"),
        ICE,
        ((0.58, 0.68, 0.33, 0.48, 0.27), (0.47, 0.69, 0.25, 0.33, 0.12)),
    ),
    ("warthog_wheels_grass_2024_7_29_14h46s15", (TRACK, INERTIA), (TRACK, INERTIA, "turn_lag"), _GRASS),
    ("warthog_wheels_grass_2024_8_8_16h19s23", (TRACK, INERTIA), (TRACK, INERTIA, "turn_lag"), _GRASS),
)
CASES = tuple(
    Case(log, source, effects, table)
    for log, measured, command, tables in _ROWS
    for source, effects, table in ((M, measured, tables[0]), (C, command, tables[1]))
)


@dataclass(frozen=True)
class Reached:
    """What the effects of a case leave.

    Attributes:
        ratios: x, y, w, T, R after / before, held out; before is the ideal model on the clocks as recorded.
        turned: R with whole turns counted: a model that turns twice too fast is wrong by more than a wrapped
            angle can say.
        fitted: to all windows.
        problem: what was fitted.
        t_before_m, r_before_rad: 2 s errors of the ideal model.
        windows: how many were scored.
    """

    ratios: Ratios
    turned: float
    fitted: Fitted
    problem: Problem
    t_before_m: float
    r_before_rad: float
    windows: int


class Recordings:
    """Recordings analyzed once."""

    def __init__(self, logs: Path, out: Path) -> None:
        self.logs = logs
        self.out = out

    def load(self, name: str) -> tuple[MotionRun, Vehicle]:
        options = Options(out=self.out, report=False)
        manifest = analyze_log(self.logs / f"{name}.mcap", options).manifest
        vehicle = msgspec.convert(manifest.details["vehicle"], Vehicle)
        store = Store(self.out)
        tables = [
            t for t in ("poses", "alignments", "commands", "wheels", "imu", "slip") if t in manifest.tables
        ]
        return load_run({t: store.read(manifest.run, t) for t in tables}, vehicle, name=name), vehicle


def make_model(vehicle: Vehicle, effects: tuple[str, ...]) -> Model:
    return Model(vehicle, tuple(find_effect(name)() for name in effects))


def measure_as_recorded(problem: Problem) -> tuple[Errors, HorizonErrors]:
    """Errors of the ideal model of one run on the clocks as they were recorded."""
    alignment, comparison = problem.runs[0].alignment, problem.comparisons[0]
    timing, late = Timing(-alignment.wheel_delay_s), -alignment.heading_delay_s
    recorded = comparison.find_horizon_errors((), timing, late)
    residuals = comparison.find_residuals((), timing, late)
    return measure_errors(residuals, recorded.position, recorded.yaw), recorded


def measure(run: MotionRun, vehicle: Vehicle, source: Input, effects: tuple[str, ...]) -> Reached:
    problem = Problem([run], vehicle, source)
    before, recorded = measure_as_recorded(problem)
    fitted = fit_model(problem, make_model(vehicle, effects))
    after = hold_out(problem, fitted).pooled
    return Reached(
        ratios=after.ratios(before),
        turned=float(np.sqrt(np.mean(_hold_out_turning(problem, fitted) ** 2) / np.mean(recorded.turned**2))),
        fitted=fitted,
        problem=problem,
        t_before_m=before.t_mrmse_m,
        r_before_rad=before.r_mrmse_rad,
        windows=after.windows,
    )


def _hold_out_turning(problem: Problem, fitted: Fitted) -> np.ndarray:
    comparison, middle = problem.comparisons[0], problem.whole.times.mean(axis=1)
    turned = np.full(comparison.horizons.number.size, np.nan)
    for fold, training in zip(problem.folds, problem.training, strict=True):
        state = fitted.state
        for part, fit, rows in zip(problem.parts, fitted.fits, training, strict=True):
            state = state.take_over(refit(part, fit, rows), fit.free)
        told = fold.test[nearest_indices(comparison.horizons.times.mean(axis=1), middle)]
        turned[told] = comparison.find_horizon_errors(state.effects_of(0), state.timing[0]).turned[told]
    return turned[np.isfinite(turned)]
