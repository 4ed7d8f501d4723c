"""Simulated runs as tables, without the detour over a log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import polars as pl

from pipeline.core.rigid import find_held, find_jumps, number_segments
from pipeline.run import MotionRun, load_run
from pipeline.simulate import Disturbance, PoseSensor, Scenario, SimulatedRun, simulate_run
from pipeline.sources import Configuration, Vehicle, find_preset
from pipeline.stages.align import align_tables
from pipeline.stages.slip_stage import compute_slip
from pipeline.stages.velocity import compute_velocities

QUIET = PoseSensor(noise_m=0.002, noise_rad=0.001)
WANDERING = PoseSensor(noise_m=0.004, noise_rad=0.002, drift_m=0.02, drift_rad=0.004, drift_s=8.0)


def vehicle_of(name: str) -> Vehicle:
    found = find_preset(name)
    assert found is not None
    return found


def make_scenario(effects: object, *, seed: int = 1, duration_s: float = 120.0, **more: object) -> Scenario:
    base = Scenario(pose=QUIET, disturbance=Disturbance(0.01, 0.015))
    return replace(base, effects=effects, seed=seed, duration_s=duration_s, **more)  # type: ignore[arg-type]


def simulate(effects: object, *, seed: int = 1, duration_s: float = 120.0, **more: object) -> MotionRun:
    return as_run(simulate_run(make_scenario(effects, seed=seed, duration_s=duration_s, **more)))


def as_run(made: SimulatedRun) -> MotionRun:
    vehicle = vehicle_of(made.scenario.vehicle.name)
    return load_run(tables_of(made, vehicle), vehicle, name=f"seed {made.scenario.seed}")


def tables_of(made: SimulatedRun, vehicle: Vehicle) -> dict[str, pl.DataFrame]:
    return align(extract(made, vehicle), vehicle)


def extract(made: SimulatedRun, vehicle: Vehicle) -> dict[str, pl.DataFrame]:
    tables = {"poses": _poses(made), "commands": _commands(made, vehicle)}
    tables["wheels"] = _wheels(made, vehicle)
    tables["imu"] = _imu(made)
    return tables


def align(tables: Mapping[str, pl.DataFrame], vehicle: Vehicle) -> dict[str, pl.DataFrame]:
    configuration = Configuration()
    made = align_tables(tables, vehicle, hold_s=None, body_commanded=False, where="simulated")
    found = dict(made.tables)
    velocities = compute_velocities(
        found["poses"], found["imu"], made.alignment.gyro, configuration.velocity, where="simulated"
    )
    slip = compute_slip(
        velocities.table,
        found["commands"],
        found["wheels"],
        vehicle=made.vehicle,
        configuration=configuration,
        hold_s=made.alignment.hold_s,
        inputs=("command", "measured"),
        where="simulated",
    )
    return found | {"slip": slip.slip}


def _frame(times: np.ndarray, columns: dict[str, np.ndarray]) -> pl.DataFrame:
    stamp = np.round(times * 1e9).astype(np.int64)
    return pl.DataFrame(
        {"t": times, "stamp": stamp, "log_time": stamp, **columns, "active": np.ones(times.size, dtype=bool)}
    )


def _poses(made: SimulatedRun) -> pl.DataFrame:
    poses = made.poses
    position, quaternion = poses.in_map()
    jumps = find_jumps(poses.stamp_s, position, quaternion, metres=0.1, radians=0.1)
    frame = _frame(
        poses.stamp_s,
        {
            "segment": number_segments(jumps).astype(np.int32),
            **{name: position[:, i] for i, name in enumerate("xyz")},
            **{f"q_{name}": quaternion[:, i] for i, name in enumerate("xyzw")},
            "held": find_held(position, quaternion),
        },
    )
    return frame.with_columns(pl.lit(made.scenario.recording.terrain).alias("terrain"))


def _commands(made: SimulatedRun, vehicle: Vehicle) -> pl.DataFrame:
    asked = made.commands
    if vehicle.kind == "ackermann":
        return _frame(asked.time_s, {"speed": asked.speed_mps, "steering": asked.turn})
    body = (asked.speed_mps, asked.sideways, asked.turn)
    return _frame(asked.time_s, vehicle.kinematics.inverse(body, vehicle))


def _wheels(made: SimulatedRun, vehicle: Vehicle) -> pl.DataFrame:
    read = made.wheels
    if read is None:
        return pl.DataFrame()
    if vehicle.kind == "ackermann":
        return _frame(read.time_s, {"speed": read.left * vehicle.wheel_radius_m, "steering": read.steering})
    sides = {"left": read.left, "right": read.right}
    if vehicle.kind == "mecanum":
        sides["sideways"] = read.sideways_mps(made.scenario.vehicle) / vehicle.wheel_radius_m
    return _frame(read.time_s, sides)


def _imu(made: SimulatedRun) -> pl.DataFrame:
    if made.imu is None:
        return pl.DataFrame()
    return _frame(made.imu.time_s, {"rate_z": made.imu.rates[:, 2]})
