"""The named scenarios: the three sample logs, and logs that show one trap or one lesson each."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from pipeline.simulate.mujoco_vehicle import MACHINES, SkidSteer
from pipeline.simulate.scenario import (
    Clock,
    Disturbance,
    Encoders,
    Ground,
    Imu,
    PoseSensor,
    Program,
    Recording,
    Scenario,
    State,
)
from pipeline.simulate.vehicles import VEHICLES


@dataclass(frozen=True)
class Case:
    """A named scenario and what it shows, in one line; a machine when it is built of rigid bodies."""

    name: str
    shows: str
    scenario: Scenario
    machine: SkidSteer | None = None


_ICP = PoseSensor(
    noise_m=0.004,
    noise_rad=0.002,
    noise_z_m=0.004,
    noise_tilt_rad=0.001,
    drift_m=0.01,
    drift_rad=0.002,
    latency_s=0.06,
    latency_jitter_s=0.008,
)
_HUSKY = Scenario(pose=_ICP, disturbance=Disturbance(0.01, 0.015), duration_s=180.0)
_WARTHOG = replace(
    _HUSKY,
    vehicle=VEHICLES["warthog"],
    program=Program(speed_scale=0.6, turn_scale=0.7),
    disturbance=Disturbance(0.03, 0.04),
)
_CAR = replace(
    _HUSKY,
    vehicle=VEHICLES["car"],
    program=Program(speed_scale=0.5),
    disturbance=Disturbance(0.02, 0.02),
)
_SKID = {"effective_track": 1.8, "drive_lag": 0.3}


def _on(scenario: Scenario, terrain: str) -> Scenario:
    return replace(scenario, recording=replace(scenario.recording, terrain=terrain))


def _ride_oval_wheel(state: State) -> tuple[float, float, float]:
    # An out-of-round left wheel: 4 % of radius, once a turn.
    uneven = 0.04 * math.sin(state.left_angle)
    rim = _HUSKY.vehicle.wheel_radius_m * state.left_speed
    return 0.5 * uneven * rim, 0.0, -uneven * rim / _HUSKY.vehicle.track_width_m


CASES: tuple[Case, ...] = (
    Case(
        "husky_tile",
        "sample: a skid-steer with a wide effective track and a mild lag, encoders and gyro",
        _on(replace(_HUSKY, effects=_SKID, seed=11), "tile"),
    ),
    Case(
        "warthog_ice",
        "sample: little grip, so that the body follows its wheels late and slides outward",
        _on(
            replace(
                _WARTHOG,
                effects={"body_inertia": 0.9, "acceleration_limit": 4.0, "effective_track": 1.5},
                pose=replace(_ICP, rate_hz=10.0, noise_m=0.006),
                imu=Imu(bias_radps=0.004),
                duration_s=240.0,
                seed=12,
            ),
            "ice",
        ),
    ),
    Case(
        "ackermann_gravel",
        "sample: a car whose steering is off centre and that understeers",
        _on(
            replace(
                _CAR,
                effects={"steering_offset": 0.03, "understeer": 0.04, "drive_lag": 0.7},
                duration_s=240.0,
                seed=13,
            ),
            "gravel",
        ),
    ),
    Case(
        "ideal_husky",
        "nothing is missing: no effect may be named",
        _on(replace(_HUSKY, seed=21), "lab_floor"),
    ),
    Case(
        "jackal_slope",
        "a slope of 10 degrees pulls the vehicle down while it drives",
        _on(
            replace(
                _HUSKY,
                vehicle=VEHICLES["jackal"],
                program=Program(speed_scale=0.5),
                ground=Ground(pitch_rad=math.radians(10.0)),
                effects={"slope_drift": 0.5, "effective_track": 1.4},
                recording=Recording("tf"),
                seed=22,
            ),
            "slope",
        ),
    ),
    Case(
        "husky_straight",
        "driven straight only: what concerns turning leaves no trace",
        _on(replace(_HUSKY, effects=_SKID, program=Program("straight"), seed=23), "tile"),
    ),
    Case(
        "husky_in_the_air",
        "wheels off the ground: not moving, and no effect may be named",
        replace(_HUSKY, effects={"wheel_radius": 0.0}, disturbance=Disturbance(), duration_s=120.0, seed=24),
    ),
    Case(
        "husky_wheel_odometry",
        "the pose is wheel odometry under another name: slip is zero by construction",
        replace(
            _HUSKY,
            effects=_SKID,
            pose=replace(
                _ICP,
                source="wheels",
                noise_m=0.0,
                noise_rad=0.0,
                noise_z_m=0.0,
                noise_tilt_rad=0.0,
                drift_m=0.0,
                drift_rad=0.0,
            ),
            seed=25,
        ),
    ),
    Case(
        "husky_dead_encoders",
        "the encoders say zero under live commands",
        replace(_HUSKY, effects=_SKID, encoders=Encoders(gain=0.0, noise_radps=0.0), seed=26),
    ),
    Case(
        "husky_hand_driven",
        "a person drives by radio first, past a stale command topic; calib_state says when",
        replace(_HUSKY, effects=_SKID, recording=Recording(hand_driven_s=40.0, terrain="snow"), seed=27),
    ),
    Case(
        "husky_command_scale",
        "wheel commands were recorded with another vehicle's radius, 1.82 times too large",
        replace(_HUSKY, effects=_SKID, recording=Recording(command_scale=1.82, terrain="snow"), seed=28),
    ),
    Case(
        "husky_decoys",
        "a second odometry and a second command topic stand beside the right ones",
        replace(_HUSKY, effects=_SKID, recording=Recording("husky_body_command", decoys="both"), seed=29),
    ),
    Case(
        "warthog_held_poses",
        "scans at 5 Hz repeated at 20 Hz, an inverted gyro, a few jumps and rotated stretches",
        replace(
            _WARTHOG,
            effects={"effective_track": 1.7, "turn_lag": {"tau_mean": 0.4, "tau_diff": 1.2}},
            pose=replace(_ICP, update_hz=5.0, jumps=2, rotated_stretches=2),
            imu=Imu(sign=-1),
            seed=30,
        ),
    ),
    Case(
        "husky_bad_clock",
        "the clock counts from zero at first, is set, and later goes back by 3 s; poses drop out",
        replace(
            _HUSKY,
            effects=_SKID,
            clock=Clock(unset_s=5.0, backward_at_s=120.0, backward_s=3.0),
            pose=replace(_ICP, dropouts=3, invalid=4),
            seed=31,
        ),
    ),
    Case(
        "husky_controller_multiplier",
        "the controller widens the track 1.875 times, so that a body command hides the effective track",
        _on(
            replace(
                _HUSKY,
                vehicle=replace(VEHICLES["husky"], controller_track_multiplier=1.875),
                effects=_SKID,
                recording=Recording("husky_body_command"),
                seed=32,
            ),
            "asphalt",
        ),
    ),
    Case(
        "husky_oval_wheel",
        "a wheel out of round: physics that no catalogue has, and that must stay unexplained",
        _on(replace(_HUSKY, extra=_ride_oval_wheel, effects=_SKID, seed=33), "tile"),
    ),
    Case(
        "husky_lidar_pose",
        "the pose is of the lidar; its place on the robot stands in tf_static",
        replace(
            _HUSKY,
            effects=_SKID,
            pose=replace(_ICP, child_frame="lidar", mount_x_m=0.3, mount_y_m=0.05, mount_yaw_rad=0.1),
            seed=34,
        ),
    ),
    Case(
        "rigid_husky",
        "rigid bodies and friction in place of formulas (needs the extra `sim`)",
        _on(replace(_HUSKY, disturbance=Disturbance(), seed=41), "concrete"),
        MACHINES["husky"],
    ),
    Case(
        "rigid_husky_payload",
        "rigid bodies with 35 kg at the back: the centre of rotation moves (needs the extra `sim`)",
        _on(replace(_HUSKY, disturbance=Disturbance(), seed=42), "concrete"),
        replace(MACHINES["husky"], payload_kg=35.0, payload_x_m=-0.15),
    ),
    Case(
        "rigid_warthog_low_grip",
        "rigid bodies on ice: wheels spin before the body follows (needs the extra `sim`)",
        _on(replace(_WARTHOG, disturbance=Disturbance(), seed=43), "ice"),
        replace(MACHINES["warthog"], friction=0.1),
    ),
)
