"""The real recordings: what the right effects, given by hand, leave of the ideal model's held-out error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import msgspec
import numpy as np
import pytest

from pipeline.job.analyze import analyze_log
from pipeline.job.options import Options
from pipeline.motion import (
    Input,
    Model,
    MotionRun,
    Problem,
    Timing,
    carry_over,
    climb,
    find_effect,
    fit_model,
    hold_out,
    load_run,
    score,
)
from pipeline.store import Store
from pipeline.vehicles import Vehicle

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.long
NAN = float("nan")
TRACK, INERTIA = "effective_track", "body_inertia"
M, C = Input.MEASURED, Input.COMMAND


@dataclass(frozen=True)
class Case:
    """A recording, the effects, and the largest ratios after / before of x, y, w, T, R."""

    log: str
    source: Input
    effects: tuple[str, ...]
    largest: tuple[float, float, float, float, float]


TILE = (TRACK, "icr_offset", "yaw_misalignment", "wheel_asymmetry")
SNOW = (TRACK, "icr_offset", "turning_resistance")
WET = (TRACK, "icr_offset", "body_turn_limit", "turn_lag", "transport_delay")
FAST = (TRACK, INERTIA, "turn_lag", "wheel_speed_limit")
GRAVEL = (TRACK, INERTIA, "lateral_skid")
ICE = (INERTIA, "acceleration_limit", TRACK)
_TILE = "husky_wheels-deflated_tile_2023_12_12_16h16"
# What was reached, and 8 % of margin: five numbers, relative to the ideal model on the clocks as recorded.
CASES = (
    Case(_TILE, M, TILE, (0.91, 0.24, 0.07, 0.30, 0.05)),
    Case(_TILE, C, (*TILE, "turn_lag", "transport_delay"), (0.72, 0.27, 0.15, 0.37, 0.14)),
    Case("husky_snow_boreal", M, SNOW, (0.83, 0.80, 0.19, 0.43, 0.19)),
    Case("husky_snow_boreal", C, (*SNOW, "body_turn_limit", "turn_lag"), (0.94, 0.80, 0.06, 0.45, 0.14)),
    Case("husky_wheels_wetgrass", M, (TRACK, "icr_offset"), (1.09, 1.06, 0.15, 0.93, 0.10)),
    Case("husky_wheels_wetgrass", C, WET, (1.06, 1.06, 0.10, 0.82, 0.07)),
    Case("warthog_wheels_asphalt_2024_8_7_11h30s30", M, (TRACK, INERTIA), (0.95, 0.58, 0.21, 0.52, 0.13)),
    Case("warthog_wheels_asphalt_2024_8_7_11h30s30", C, FAST, (0.71, 0.59, 0.19, 0.39, 0.16)),
    Case("warthog_wheels_asphalt", M, (TRACK, INERTIA), (0.87, 0.46, 0.15, 0.54, 0.12)),
    Case("warthog_wheels_asphalt", C, FAST, (0.77, 0.46, 0.20, 0.43, 0.18)),
    Case("warthog_gravel_1", M, GRAVEL, (0.53, 0.26, 0.14, 0.23, 0.16)),
    Case("warthog_gravel_1", C, (*GRAVEL, "turn_lag", "body_turn_limit"), (0.41, 0.33, 0.12, 0.27, 0.25)),
    Case("warthog_wheels_gravel_2024_8_6_11h37s32", M, GRAVEL, (0.84, 0.53, 0.15, 0.45, 0.13)),
    Case(
        "warthog_wheels_gravel_2024_8_6_11h37s32", C, (*FAST, "lateral_skid"), (0.63, 0.54, 0.16, 0.40, 0.17)
    ),
    Case("warthog_wheels_sand_2024_9_25_14h32s32", M, (TRACK, INERTIA), (0.81, 0.50, 0.14, 0.43, 0.13)),
    Case(
        "warthog_wheels_sand_2024_9_25_14h32s32",
        C,
        (*FAST, "body_turn_limit"),
        (0.61, 0.51, 0.13, 0.37, 0.18),
    ),
    Case(
        "warthog_wheels_ice_2024_7_30_16h30s21", M, (INERTIA, "wheel_radius"), (0.54, 0.62, 0.35, 0.39, 0.31)
    ),
    Case("warthog_wheels_ice_2024_7_30_16h30s21", C, ICE, (0.50, 0.74, 0.28, 0.35, 0.27)),
    Case("warthog_wheels_grass_2024_7_29_14h46s15", M, (TRACK, INERTIA), (0.94, 0.83, 0.10, 0.57, 0.08)),
    Case(
        "warthog_wheels_grass_2024_8_8_16h19s23",
        C,
        (TRACK, INERTIA, "turn_lag"),
        (0.40, 0.43, 0.20, 0.26, 0.17),
    ),
)


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
        tables = [t for t in ("poses", "commands", "wheels", "imu", "slip") if t in manifest.tables]
        return load_run({t: store.read(manifest.run, t) for t in tables}, vehicle, name=name), vehicle


@pytest.fixture(scope="module")
def recordings(shared_logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Recordings:
    return Recordings(shared_logs, tmp_path_factory.mktemp("recordings"))


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.log}-{case.source.value}")
def test_the_right_effects_leave_this_share_of_the_error(case: Case, recordings: Recordings) -> None:
    run, vehicle = recordings.load(case.log)
    problem = Problem([run], vehicle, case.source)
    ideal = fit_model(problem, Model(vehicle))
    as_recorded = Problem([run], vehicle, case.source, timing=[Timing()])
    before = score(as_recorded, as_recorded.start_state(Model(vehicle)), ideal.weights).pooled
    fitted = fit_model(problem, Model(vehicle, tuple(find_effect(name)() for name in case.effects)))
    ratios = np.array(hold_out(problem, fitted).pooled.ratios(before))
    assert np.all(ratios <= np.array(case.largest)), ratios.round(3)


def test_the_ladder_falls_or_stops(recordings: Recordings) -> None:
    run, vehicle = recordings.load("husky_wheels-deflated_tile_2023_12_12_16h16")
    problem = Problem([run], vehicle, M)
    ladder = climb(problem, Model(vehicle, tuple(find_effect(name)() for name in (*TILE, "lateral_drift"))))
    errors = [rung.errors.t_mrmse_m for rung in ladder.rungs]
    assert errors == sorted(errors, reverse=True)
    assert set(ladder.rungs[-1].effects) | set(ladder.idle) == {*TILE, "lateral_drift"}


def test_a_model_of_one_asphalt_predicts_another_but_not_ice(recordings: Recordings) -> None:
    run, vehicle = recordings.load("warthog_wheels_asphalt_2024_8_7_11h30s30")
    others = [
        recordings.load(name)[0]
        for name in ("warthog_wheels_asphalt", "warthog_wheels_ice_2024_7_30_16h30s21")
    ]
    problem = Problem([run], vehicle, M)
    fitted = fit_model(problem, Model(vehicle, (find_effect(TRACK)(), find_effect(INERTIA)())))
    asphalt, ice = carry_over(fitted.model, others, M, fitted_on=["asphalt"])
    assert asphalt.ratio <= 1.1
    assert asphalt.warning == ""
    assert ice.ratio > 1.1
    assert "does not carry over" in ice.warning
