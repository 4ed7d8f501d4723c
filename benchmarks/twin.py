"""The twin beside the model that it was made of: `make twin`.

Six simulated vehicles with known physics are diagnosed, exported to MuJoCo and replayed: held-out error over
2 s of the ideal model, the kinematic model and the twin. Then the exported file alone is driven with other
commands, as a robot of its own, and its log is diagnosed: what was hidden in the first log must come back out
of the motion of the twin.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from pipeline.core.arrays import Floats
from pipeline.export import export_model
from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.job.stored_fits import read_runs
from pipeline.job.twin_replay import SIDES, TwinReplay, find_run_model, replay_twin
from pipeline.models.model_file import ModelFile
from pipeline.simulate import Drive, Scenario, make_scenario, simulate_case, write_log
from pipeline.simulate.drivetrain import apply_ideal_model
from pipeline.simulate.facts import resolve_effects
from pipeline.simulate.messages import Truth, ask_wheels, record_truth
from pipeline.simulate.path import BodyMotion
from pipeline.simulate.path import Path as Way

Sizes = Mapping[str, float | Mapping[str, float]]
HIDDEN: Mapping[str, Sizes] = {
    "husky": {
        "effective_track": 1.8,
        "drive_lag": 0.3,
        "transport_delay": 0.1,
        "lateral_skid": 0.06,
        "icr_offset": -0.08,
    },
    "warthog": {"effective_track": 1.7, "drive_lag": 0.8, "wheel_asymmetry": 0.03, "lateral_skid": 0.08},
    "jackal": {"effective_track": 1.5, "drive_lag": 0.2, "wheel_radius": 0.93},
    "car": {"steering_gain": 0.88, "steering_lag": 0.3, "steering_offset": 0.03, "drive_lag": 0.4},
    "turtlebot3": {
        "effective_track": 1.1,
        "drive_lag": 0.15,
        "transport_delay": 0.1,
        "wheel_asymmetry": 0.03,
    },
    "warthog on ice": {
        "contact_friction": {"friction": 0.1, "creep": 0.5, "k": 1.65, "gyration": 0.9},
        "drive_lag": 0.2,
    },
}
"""Hidden effects by vehicle and ground; the turtlebot3 stands on castors."""
_SETTLE_STEPS = 200


@dataclass(frozen=True)
class Recovered:
    """What the diagnosis names of the twin's own motion: by effect its first number, hidden and named."""

    hidden: Mapping[str, float]
    named: Mapping[str, float]

    def describe(self) -> str:
        """Each hidden effect with its number, and what was named beside."""
        cells = [
            f"{name} {size:g}: {self.named[name]:.3g}"
            if name in self.named
            else f"{name} {size:g}: not named"
            for name, size in self.hidden.items()
        ]
        return "; ".join(
            [*cells, *(f"{n} {s:.3g} beside" for n, s in self.named.items() if n not in self.hidden)]
        )


def diagnose_log(log: Path, results: Path) -> tuple[ModelFile, TwinReplay]:
    """The model of a log's diagnosis, and the log replayed through its twin."""
    manifest = analyze_log(log, Options(out=results, report=False, diagnosis=True)).manifest
    file = find_run_model(manifest, results)
    _, (run,) = read_runs([manifest], file.model.vehicle, None)
    return file, replay_twin(file, run)


def drive_twin(text: str, scenario: Scenario) -> Truth:
    """Drive an exported MJCF with the commands of a scenario, and nothing else."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    step = float(model.opt.timestep)
    effects = resolve_effects({}, scenario.vehicle.kind)
    commands, asked = ask_wheels(scenario, effects, step)
    is_car = scenario.vehicle.kind == "ackermann"
    sides = [asked.left if "left" in model.actuator(n).name else asked.right for n in range(model.nu)]
    told = np.stack([asked.left, asked.steering] if is_car else sides, axis=1)
    names = [model.actuator(n).name for n in range(model.nu)]
    speeds = {name: model.joint("drive" if is_car else name).dofadr[0] for name in names}
    left = [speeds["drive"]] if is_car else [at for name, at in speeds.items() if "left" in name]
    right = [speeds["drive"]] if is_car else [at for name, at in speeds.items() if "right" in name]
    mujoco.mj_step(model, data, nstep=_SETTLE_STEPS)
    count = told.shape[0]
    pose, wheels, steering = np.empty((count + 1, 7)), np.empty((count, 2)), np.zeros(count)
    pose[0] = data.qpos[:7]
    for index in range(count):
        data.ctrl[:] = told[index]
        mujoco.mj_step(model, data)
        pose[index + 1] = data.qpos[:7]
        wheels[index] = data.qvel[left].mean(), data.qvel[right].mean()
        if is_car:
            steering[index] = data.joint("steering").qpos[0]
    drive = Drive(step, wheels[:, 0], wheels[:, 1], steering)
    velocity = find_velocity(pose, step)
    time = np.arange(count + 1, dtype=np.float64) * step
    way = Way(time, pose[:, :3], pose[:, [4, 5, 6, 3]], velocity)
    speed, turn = apply_ideal_model(scenario.vehicle, drive.left, drive.right, drive.steering)
    turning = (np.abs(wheels).max(axis=1) > 0.0).astype(np.float64)
    return Truth(commands, drive, BodyMotion(speed, turn, velocity, turning), way, effects)


def find_velocity(pose: Floats, step_s: float) -> Floats:
    """Body velocity (v_x, v_y, v_w) between poses of MuJoCo on a plane, shape (n, 3)."""
    w, x, y, z = pose[:, 3:].T
    yaw = np.unwrap(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
    middle = 0.5 * (yaw[1:] + yaw[:-1])
    moved = np.diff(pose[:, 0] + 1j * pose[:, 1]) * np.exp(-1j * middle) / step_s
    return np.column_stack((moved.real, moved.imag, np.diff(yaw) / step_s))


def recover(file: ModelFile, name: str, folder: Path, duration_s: float, seed: int) -> Recovered:
    """Diagnose the motion of the exported file under commands that the model has not seen."""
    hidden = {
        effect: next(iter(size.values())) if isinstance(size, Mapping) else size
        for effect, size in HIDDEN[name].items()
    }
    scenario = make_scenario(None, {}, seed=seed, duration_s=duration_s, vehicle=name.split(maxsplit=1)[0])
    log = folder / f"{name}_twin.mcap"
    write_log(record_truth(scenario, drive_twin(export_model(file, "mjcf"), scenario)), log)
    manifest = analyze_log(log, Options(out=folder / "results", report=False, diagnosis=True)).manifest
    found = find_run_model(manifest, folder / "results")
    return Recovered(hidden, {e.id: next(iter(e.values.values())) for e in found.model})


def print_replay(name: str, replay: TwinReplay) -> None:
    """A row of the table of errors."""
    errors = [replay.errors[side] for side in SIDES]
    cells = [f"{100.0 * e.t_mrmse_m:.2f} cm, {math.degrees(e.r_mrmse_rad):.2f} deg" for e in errors]
    lacks = ", ".join(one.effect for one in replay.missing) or "-"
    share = f"{100.0 * replay.reproduced:.0f} %"
    print(f"| {name} | {' | '.join(cells)} | {share} | {lacks} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("vehicles", nargs="*", help=f"of {', '.join(HIDDEN)}; all without")
    parser.add_argument("--logs", nargs="*", type=Path, default=[], help="recordings to replay as well")
    parser.add_argument("--duration", type=float, default=180.0, help="length of a simulated log [s]")
    parser.add_argument("--seed", type=int, default=5)
    chosen = parser.parse_args()
    print("Error over 2 s from measured poses, held out\n")
    print(
        "| log | ideal | kinematic model | twin | reproduced | not in the twin |\n|---|---|---|---|---|---|"
    )
    recovered: dict[str, Recovered] = {}
    with tempfile.TemporaryDirectory(prefix="slip-twin-") as place:
        folder = Path(place)
        for name in chosen.vehicles or ([] if chosen.logs else list(HIDDEN)):
            log = simulate_case(
                None, HIDDEN[name], out=folder / f"{name}.mcap", seed=chosen.seed,
                duration_s=chosen.duration, vehicle=name.split()[0],
            )  # fmt: skip
            file, replay = diagnose_log(log, folder / "results")
            print_replay(name, replay)
            recovered[name] = recover(file, name, folder, chosen.duration, chosen.seed + 1)
        for log in chosen.logs:
            print_replay(log.stem, diagnose_log(log, folder / "results")[1])
    if recovered:
        print("\nDiagnosis of the motion of the exported file under other commands\n")
        print("| vehicle | hidden in the first log: named of the twin |\n|---|---|")
    for name, one in recovered.items():
        print(f"| {name} | {one.describe()} |")


if __name__ == "__main__":
    main()
