"""Everything that defines a simulated run, commands and incidents too: from one value the same bytes."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from pipeline.core import Floats, Ints, quaternions_from_euler
from pipeline.simulate.facts import VEHICLES, EffectSpec, Field, Layout, SimulateError, Vehicle


def integrate_cells(signal: Floats, *, step_s: float) -> Floats:
    """Integral at the cell edges, shape (n + 1,), starting from zero."""
    return np.concatenate(([0.0], np.cumsum(signal) * step_s))


@dataclass(frozen=True, eq=False)
class Commands:
    """Body commands at their own stamps.

    Attributes:
        time_s: increasing, shape (n,).
        speed_mps: shape (n,).
        turn: yaw rate [rad/s] or steering angle [rad], shape (n,).
        sideways_mps: speed to the left, shape (n,); None on a vehicle that cannot.
    """

    time_s: Floats
    speed_mps: Floats
    turn: Floats
    sideways_mps: Floats | None = None

    @property
    def sideways(self) -> Floats:
        """Speed to the left [m/s], zero on a vehicle that cannot, shape (n,)."""
        return np.zeros_like(self.speed_mps) if self.sideways_mps is None else self.sideways_mps

    def yaw_rate(self, vehicle: Vehicle) -> Floats:
        """The yaw rate that is asked for [rad/s], which a car's steering stands for."""
        if vehicle.kind != "ackermann":
            return self.turn
        return self.speed_mps * np.tan(self.turn) / vehicle.wheelbase_m


@dataclass(frozen=True)
class Drive:
    """What the drivetrain does, on cells of ``step_s``.

    Attributes:
        step_s: cell width [s].
        left, right: true wheel speeds [rad/s], shape (n,); equal on a car, whose rear axle they are; means of
            a side on mecanum wheels.
        steering: true steering angle [rad], shape (n,); zero on a differential vehicle.
        corners: true speeds of mecanum wheels by place; on omni wheels those of wheels at the corners of the
            same body motion; None on a vehicle that cannot move sideways.
    """

    step_s: float
    left: Floats
    right: Floats
    steering: Floats
    corners: Mapping[str, Floats] | None = None

    def wheel_angles(self) -> tuple[Floats, Floats]:
        """Turned angles [rad] of left and right wheels at the cell edges, each of shape (n + 1,)."""
        return integrate_cells(self.left, step_s=self.step_s), integrate_cells(self.right, step_s=self.step_s)


@dataclass(frozen=True)
class BodyMotion:
    """Velocities on the drive's cells.

    Attributes:
        v0, w0: body velocity before ground effects [m/s], [rad/s], shape (n,).
        velocity: (v_x, v_y, v_w) so far [m/s, m/s, rad/s], shape (n, 3).
        turning: one where the wheels turn, else zero, shape (n,).
    """

    v0: Floats
    w0: Floats
    velocity: Floats
    turning: Floats


ProgramName = Literal[
    "drive_steps", "ramps", "smooth", "straight", "circle", "spins", "slalom", "stop_and_go", "teleop"
]


@dataclass
class State:
    """What odd physics may depend on; the same object is reused at every step.

    Attributes:
        t: time since the start [s]; ``dt`` the step [s].
        v0, w0: body velocity before ground effects [m/s], [rad/s].
        x, y, yaw: true pose in the world [m], [rad].
        roll, pitch: attitude of the body on the ground [rad].
        left_angle, right_angle: turned angle of the wheels [rad] (both the rear axle's on a car).
        left_speed, right_speed: wheel speeds [rad/s].
        steering: steering angle [rad], zero on a differential vehicle.
        turning: one while the wheels turn, else zero.
    """

    t: float = 0.0
    dt: float = 0.0
    v0: float = 0.0
    w0: float = 0.0
    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    left_angle: float = 0.0
    right_angle: float = 0.0
    left_speed: float = 0.0
    right_speed: float = 0.0
    steering: float = 0.0
    turning: float = 0.0


ExtraPhysics = Callable[[State], tuple[float, float, float]]


@dataclass(frozen=True)
class Program:
    """What the driver asks for.

    Attributes:
        name: which manoeuvre.
        rate_hz: how often a command is published.
        speed_scale, turn_scale: share of the vehicle's command space that is used.
        step_s: length of a step of ``drive_steps``.
        jitter_s: standard deviation of the time between commands about its mean.
        lead_s: standing still at the start and at the end.
        hold_s: the controller stops when no command came for this long.
    """

    name: ProgramName = "drive_steps"
    rate_hz: float = 20.0
    speed_scale: float = 1.0
    turn_scale: float = 1.0
    step_s: float = 6.0
    jitter_s: float = 0.0
    lead_s: float = 2.0
    hold_s: float = 0.5


@dataclass(frozen=True)
class Ground:
    """The shape of the ground: a tilted plane with hills on it.

    Attributes:
        pitch_rad: tilt of the plane about the world's y axis; above zero the ground falls towards +x.
        roll_rad: tilt about the world's x axis; above zero the ground rises towards +y.
        hill_m: standard deviation of the height of rolling hills; zero for a plane.
        hill_length_m: their typical wavelength.
    """

    pitch_rad: float = 0.0
    roll_rad: float = 0.0
    hill_m: float = 0.0
    hill_length_m: float = 25.0

    @property
    def tilt(self) -> Floats:
        """Attitude of the plane as a quaternion, shape (4,)."""
        angles = (np.array([angle]) for angle in (self.roll_rad, self.pitch_rad, 0.0))
        tilt: Floats = quaternions_from_euler(*angles)[0]
        return tilt


@dataclass(frozen=True)
class Disturbance:
    """Random true motion of the body while its wheels turn: first-order Gauss-Markov on v_x, v_y and v_w.

    Attributes:
        speed_mps, turn_radps: standard deviations.
        correlation_s: correlation time.
    """

    speed_mps: float = 0.0
    turn_radps: float = 0.0
    correlation_s: float = 0.5


@dataclass(frozen=True)
class PoseSensor:
    """What the localization reports, and how well.

    Attributes:
        source: ``localization``, or ``wheels`` for a pose that is wheel odometry under another name.
        rate_hz: how often a pose is published.
        update_hz: how often a new pose is computed; below ``rate_hz`` the last one is repeated.
        noise_m, noise_rad: white noise of x, y and of yaw.
        noise_z_m, noise_tilt_rad: white noise of z and of roll and pitch.
        drift_m, drift_rad: slow error of x, y and yaw, correlated over ``drift_s``.
        jitter_s: standard deviation of the sampling time; the stamp knows it.
        stamp_jitter_s: standard deviation of the stamp about the sampling time; nobody knows it.
        latency_s, latency_jitter_s: from sampling to the recorder.
        dropouts: how many holes of ``dropout_s`` the poses have.
        jumps: how many corrections of ``jump_m`` and ``jump_rad`` happen at once.
        invalid: how many single poses are NaN or have a zero quaternion.
        rotated_stretches: how many stretches of 2 s report a heading that is off by 90 degrees.
        map_stretch, map_stretch_rad: share by which its map is longer than the world along a direction; the
            headings in it stay as they are.
        reports_heading: whether it knows its orientation; else all quaternions are the identity.
        child_frame: what the pose is of; another frame than ``base_link`` is mounted at ``mount_x_m``,
            ``mount_y_m``, ``mount_yaw_rad`` on it, which ``/tf_static`` tells. Odometry messages only.
    """

    source: Literal["localization", "wheels"] = "localization"
    rate_hz: float = 20.0
    update_hz: float | None = None
    noise_m: float = 0.002
    noise_rad: float = 0.001
    noise_z_m: float = 0.002
    noise_tilt_rad: float = 0.0005
    drift_m: float = 0.0
    drift_rad: float = 0.0
    drift_s: float = 8.0
    jitter_s: float = 0.0
    stamp_jitter_s: float = 0.0
    latency_s: float = 0.03
    latency_jitter_s: float = 0.003
    dropouts: int = 0
    dropout_s: float = 1.5
    jumps: int = 0
    jump_m: float = 0.5
    jump_rad: float = 0.1
    invalid: int = 0
    rotated_stretches: int = 0
    map_stretch: float = 0.0
    map_stretch_rad: float = 0.0
    reports_heading: bool = True
    child_frame: str = "base_link"
    mount_x_m: float = 0.0
    mount_y_m: float = 0.0
    mount_yaw_rad: float = 0.0


@dataclass(frozen=True)
class Encoders:
    """Wheel speed measurement.

    Attributes:
        rate_hz: publishing rate.
        noise_radps: white noise of a speed (and, on a car, of the steering angle [rad], a hundredth of it).
        delay_s: age of the reported speed.
        gain: factor on the speed; zero for a dead encoder.
        report: which JointState fields are filled.
    """

    rate_hz: float = 20.0
    noise_radps: float = 0.01
    delay_s: float = 0.0
    gain: float = 1.0
    report: Literal["velocity", "position", "both"] = "both"


@dataclass(frozen=True)
class Imu:
    """Gyro and accelerometer.

    Attributes:
        rate_hz: publishing rate.
        noise_radps: white noise of the rates.
        bias_radps, scale: error of the yaw rate, scale * w + bias.
        sign: -1 for a sensor mounted upside down or a driver with the wrong convention (yaw rate only).
        tilt_roll_rad, tilt_pitch_rad: mounting of the sensor on the body.
        noise_mps2: white noise of the acceleration.
    """

    rate_hz: float = 50.0
    noise_radps: float = 0.005
    bias_radps: float = 0.0
    scale: float = 1.0
    sign: Literal[-1, 1] = 1
    tilt_roll_rad: float = 0.0
    tilt_pitch_rad: float = 0.0
    noise_mps2: float = 0.05


@dataclass(frozen=True)
class Clock:
    """How true time becomes stamps.

    Attributes:
        start_ns: stamp of the run's start, nanoseconds since 1970; 0 is a clock that was never set.
        unset_s: for this long the clock counts from zero, then it is set.
        backward_at_s, backward_s: at this time the clock goes back by that much; none when NaN.
    """

    start_ns: int = 1_717_000_000_000_000_000
    unset_s: float = 0.0
    backward_at_s: float = float("nan")
    backward_s: float = 0.0

    def stamp_headers(self, time_s: Floats) -> Ints:
        """Nanoseconds that header stamps show at true times [s], shape (n,).

        A clock that was set before the run began counts from its own time before the run, too: a pose that is
        stamped early is a few moments older than the run. A clock that shows less than zero shows zero:
        stamps are unsigned.
        """
        elapsed = np.rint(time_s * 1e9).astype(np.int64)
        unset = (time_s < self.unset_s) & (self.unset_s > 0.0)
        shown = np.where(unset, elapsed, self.start_ns + elapsed)
        gone_back = time_s >= self.backward_at_s
        shown = np.where(gone_back, shown - round(self.backward_s * 1e9), shown)
        return np.maximum(shown, 0)

    def stamp_log(self, time_s: Floats) -> Ints:
        """Nanoseconds that the recorder's clock shows when it gets what came at true times [s], (n,)."""
        return self.stamp_headers(time_s)


@dataclass(frozen=True)
class Messages:
    """Messages of one topic, in true seconds.

    Attributes:
        topic, type_name: where and what.
        log_s: when the recorder got them, shape (n,).
        header_s: what their headers say, shape (n,), or None for a type without header.
        fields: values by field path; an array has one row a message.
    """

    topic: str
    type_name: str
    log_s: Floats
    header_s: Floats | None
    fields: Mapping[str, Field]


@dataclass(frozen=True)
class Recording:
    """What the log holds.

    Attributes:
        layout: the topics: a name of ``layouts.LAYOUTS``, ``usual`` for the vehicle's, or a layout.
        deployment: whether and how the deployment record is written: vehicle and terrain, or nothing.
        terrain: name of the ground in that record.
        decoys: topics that a hasty reader takes for the right ones.
        hand_driven_s: for this long at the start a person drives by radio while the command topic is stale;
            a ``calib_state`` topic says which part counts. None leaves that topic out.
        command_scale: factor on recorded wheel commands (a topic made with another vehicle's radius).
        command_turn_scale: factor on the difference of the recorded sides (made with another vehicle's
            track); None for that of the whole command.
        command_latency_s: from a command's stamp to the recorder.
        lose: what else the recorder makes of the messages; None for nothing.
    """

    layout: str | Layout = "usual"
    deployment: Literal["written", "absent"] = "written"
    terrain: str = "simulated"
    decoys: Literal["none", "odometry", "commands", "both"] = "none"
    hand_driven_s: float | None = None
    command_scale: float = 1.0
    command_turn_scale: float | None = None
    command_latency_s: float = 0.001
    lose: Callable[[Messages], Messages] | None = None


@dataclass(frozen=True)
class Scenario:
    """One simulated run, entirely.

    Attributes:
        vehicle: geometry.
        effects: effect id to parameters (or to one number, for an effect with one).
        written: effects among them that this room does not have, by their formulas.
        program: what is driven.
        duration_s: length of the run.
        seed: from which all random numbers come; each source has a stream of its own, so that adding a
            sensor or an effect leaves the others' numbers alone.
        ground, disturbance, pose, encoders, imu, clock, recording: see there. No encoders or IMU when None.
        extra: physics that no catalogue has, added to the body velocity; called 200 times a second.
        machinery: the same of the drivetrain: what wheels and steering do in place of what they would.
        upset: the same of the body, before slope and place act, in steps of so many seconds.
        step_s: integration step.
        played: commands that are driven in place of the program's; they count from their first one. None for
            the program.
        start_pose: x [m], y [m], yaw [rad] at the start.
    """

    vehicle: Vehicle = VEHICLES["husky"]
    effects: Mapping[str, Mapping[str, float] | float] = field(default_factory=dict)
    written: tuple[EffectSpec, ...] = ()
    program: Program = Program()
    duration_s: float = 300.0
    seed: int = 0
    ground: Ground = Ground()
    disturbance: Disturbance = Disturbance()
    pose: PoseSensor = PoseSensor()
    encoders: Encoders | None = Encoders()
    imu: Imu | None = Imu()
    clock: Clock = Clock()
    recording: Recording = Recording()
    extra: ExtraPhysics | None = None
    machinery: Callable[[Drive], Drive] | None = None
    upset: Callable[[BodyMotion, float], BodyMotion] | None = None
    step_s: float = 0.001
    start_pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    played: Commands | None = None

    def __post_init__(self) -> None:
        for name, value, low, high in (
            ("duration_s", self.duration_s, 1.0, 36_000.0),
            ("step_s", self.step_s, 1e-4, 5e-3),
            ("program.rate_hz", self.program.rate_hz, 0.1, 1000.0),
            ("program.step_s", self.program.step_s, 0.1, 3600.0),
            ("program.hold_s", self.program.hold_s, 0.0, 3600.0),
            ("pose.rate_hz", self.pose.rate_hz, 0.1, 1000.0),
        ):
            if not low <= value <= high:
                hint = f"Give {low:g} to {high:g}"
                raise SimulateError("bad_value", f"{name} = {value} is not possible", where=name, hint=hint)
