"""Tables of one run: what its log holds, and what is computed of it."""

from __future__ import annotations

from typing import ClassVar

import dataframely as dy
import polars as pl

from schemas import contract
from schemas.contract import Table


class Commands(Table):
    """One row a command message, held until the next one or until it is stale."""

    VERSION: ClassVar[int] = 3

    t = contract.seconds()
    stamp = contract.stamp()
    log_time = contract.log_time()
    left = contract.optional("rad/s", "commanded speed of the left wheels")
    right = contract.optional("rad/s", "commanded speed of the right wheels")
    speed = contract.body("m/s", "commanded speed (Ackermann)", nullable=True)
    steering = contract.body("rad", "commanded steering angle (Ackermann), left positive", nullable=True)
    sideways = contract.optional(
        "rad/s", "commanded speed of the wheels that moves to the left (mecanum, omni)"
    )
    body_x = contract.body("m/s", "commanded forward speed where the command is a Twist", nullable=True)
    body_y = contract.body(
        "m/s", "commanded speed to the left where the command is a Twist (mecanum, omni)", nullable=True
    )
    body_w = contract.body("rad/s", "commanded yaw rate where the command is a Twist", nullable=True)
    left_aligned = contract.optional("rad/s", "speed of the left wheels after corrections")
    right_aligned = contract.optional("rad/s", "speed of the right wheels after corrections")
    sideways_aligned = contract.optional(
        "rad/s", "speed of the wheels that moves to the left after corrections"
    )
    speed_aligned = contract.body("m/s", "speed after corrections (Ackermann)", nullable=True)
    active = contract.flag("inside an interval in which commands are live")

    @dy.rule()
    def drive_is_complete(cls) -> pl.Expr:  # noqa: N805 - dataframely rules receive the class
        return contract.drive_is_complete()


class Wheels(Table):
    """One row an encoder message."""

    VERSION: ClassVar[int] = 3

    t = contract.seconds()
    stamp = contract.stamp()
    log_time = contract.log_time()
    left = contract.optional("rad/s", "measured speed of the left wheels, mean of the side")
    right = contract.optional("rad/s", "measured speed of the right wheels, mean of the side")
    speed = contract.body("m/s", "measured speed (Ackermann)", nullable=True)
    steering = contract.body("rad", "measured steering angle (Ackermann), left positive", nullable=True)
    sideways = contract.optional(
        "rad/s", "measured speed of the wheels that moves to the left (mecanum, omni)"
    )
    latency = contract.number("s", "delay of the encoders: they describe t - latency", frame="log clock")
    active = contract.flag("inside an interval in which commands are live")

    @dy.rule()
    def drive_is_complete(cls) -> pl.Expr:  # noqa: N805 - dataframely rules receive the class
        return contract.drive_is_complete()


UNIT_TOLERANCE = 1e-6


class Poses(Table):
    """One row a pose message of base_link in a fixed frame."""

    VERSION: ClassVar[int] = 2

    t = contract.seconds()
    stamp = contract.stamp()
    log_time = contract.log_time()
    segment = contract.segment()
    x, y, z = contract.vector("m", "position of base_link", "map")
    q_x, q_y, q_z, q_w = contract.vector("1", "quaternion of base_link", "map", 4)
    latency = contract.number(
        "s", "delay of this pose against the gyro: it belongs to t - latency", frame="log clock"
    )
    outlier = contract.flag("in an incident, or the localization is at fault: left out of medians and fits")
    held = contract.flag("repeats the pose before it: an old estimate sampled again")
    active = contract.flag("inside an interval in which commands are live")

    @dy.rule()
    def quaternion_has_unit_length(cls) -> pl.Expr:  # noqa: N805 - dataframely rules receive the class
        squared = sum((pl.col(name) ** 2 for name in ("q_x", "q_y", "q_z", "q_w")), pl.lit(0.0))
        return (squared - 1.0).abs() < UNIT_TOLERANCE


class Imu(Table):
    """One row an IMU message, in the sensor's own axes and sign, as recorded."""

    VERSION: ClassVar[int] = 1

    t = contract.seconds()
    stamp = contract.stamp()
    log_time = contract.log_time()
    rate_x, rate_y, rate_z = contract.vector("rad/s", "angular velocity", "imu")
    acceleration_x, acceleration_y, acceleration_z = contract.vector("m/s^2", "specific force", "imu")
    active = contract.flag("inside an interval in which commands are live")


class Power(Table):
    """One row a message of the first current, what else is recorded at its times."""

    VERSION: ClassVar[int] = 1

    t = contract.seconds()
    stamp = contract.stamp()
    log_time = contract.log_time()
    current = contract.number("A", "current that the drive draws, all its motors; below zero it feeds back")
    voltage = contract.optional("V", "voltage of the battery")
    power = contract.optional("W", "current times voltage")
    energy_per_m = contract.optional(
        "J/m", "power over the speed over ground within 0.5 s before and after; null below 0.1 m/s"
    )


class Alignments(Table):
    """One row a run."""

    VERSION: ClassVar[int] = 3

    hold_time = contract.optional("s", "the controller stops this long after its last command")
    command_scale = contract.number("1", "factor by which the recorded command was multiplied")
    track_multiplier = contract.number(
        "1", "by which the controller multiplies the track width when it turns a body command into wheels"
    )
    gyro_scale = contract.optional(
        "1", "yaw rate over the gyro's, negative where it turns the other way; null without a good gyro"
    )
    gyro_bias = contract.optional("rad/s", "yaw rate of the vehicle where the scaled gyro says zero")
    heading_delay = contract.optional(
        "s", "delay of the reported heading against the gyro: part of every latency of the poses"
    )
    heading_delay_error = contract.optional("s", "standard error of that delay")
    wheel_delay = contract.number("s", "delay of the encoders against the gyro: the latency of the wheels")
    gyro_residual = contract.optional("1", "yaw rate that differs from the gyro's, as a share of it")
    gyro_delay = contract.optional(
        "s", "delay of the gyro against the poses, where it is within half of its sampling period"
    )
    latency_spread = contract.number("s", "standard deviation of the latencies that were taken off the poses")
    outlier_time = contract.number("s", "time in which the localization contradicts the wheels")
    recorded_modulus_command = contract.optional(
        "m/s", "median slip speed (L = 1 m) from commands as recorded, before any correction"
    )
    recorded_modulus_measured = contract.optional("m/s", "the same from wheel encoders")


EVENT_KINDS = (
    "digging_in", "spinning", "stuck", "sliding", "emergency_stop", "manual_driving", "pushed",
    "commands_silent", "localization_frozen",
)  # fmt: skip


class Events(Table):
    """One row an event in motion, from commands, wheels and poses."""

    VERSION: ClassVar[int] = 1

    kind = contract.choice(EVENT_KINDS, "what happened")
    t_start = contract.seconds("when it began")
    t_end = contract.seconds("when it ended")
    t_known = contract.seconds("when the signals up to then first showed it")
    size = contract.optional(
        "1",
        "largest share of the wheels' usual motion that the body did not make; when sliding, of the body's "
        "motion that the wheels did not make; null of incidents",
    )
    x = contract.number("m", "position of base_link where it began", frame="map")
    y = contract.number("m", "position of base_link where it began", frame="map")


SEVERITIES = ("info", "warning", "error")


class Findings(Table):
    """One row a finding."""

    VERSION: ClassVar[int] = 1

    stage = contract.text("stage that noticed it")
    id = dy.String(min_length=1, regex=r"^[a-z][a-z0-9_]*$", metadata={"description": "stable id"})
    severity = contract.choice(SEVERITIES, "info, warning, or error: do not trust results")
    text = contract.name("the finding in one sentence")
    where = contract.text("topic, column or stretch of time; empty for the whole run")
    t_start = contract.optional("s", "start of the stretch it concerns")
    t_end = contract.optional("s", "end of the stretch it concerns")
    value = contract.optional("1", "the number behind it, in the unit the text gives")
    count = contract.count("how often", nullable=True)


class Velocities(Table):
    """One row a step of the uniform grid inside a segment."""

    VERSION: ClassVar[int] = 2

    t = contract.seconds()
    stamp = contract.stamp()
    segment = contract.segment()
    x, y, z = contract.vector("m", "position of base_link", "map")
    roll = contract.number("rad", "roll of base_link", frame="map")
    pitch = contract.number("rad", "pitch of base_link, nose down positive", frame="map")
    yaw = contract.number("rad", "yaw of base_link, unwrapped inside a segment", frame="map")
    v_x = contract.body("m/s", "body velocity forward")
    v_y = contract.body("m/s", "body velocity to the left")
    v_w = contract.body("rad/s", "yaw rate: of the pose, or of the gyro with `--yaw imu`")
    v_w_imu = contract.body("rad/s", "yaw rate of the gyro, sign, scale and bias corrected", nullable=True)
    outlier = contract.flag("in an incident, or the localization is at fault")


class Slip(Table):
    """One row a time step and input: g = f(u) - v."""

    VERSION: ClassVar[int] = 2

    input = contract.source()
    t = contract.seconds()
    stamp = contract.stamp()
    segment = contract.segment()
    step = contract.step()
    transitory = contract.flag("within the transitory span after a change of command")
    f_x = contract.body("m/s", "ideal velocity forward")
    f_y = contract.body("m/s", "ideal velocity to the left")
    f_w = contract.body("rad/s", "ideal yaw rate")
    v_x = contract.body("m/s", "measured velocity forward")
    v_y = contract.body("m/s", "measured velocity to the left")
    v_w = contract.body("rad/s", "measured yaw rate")
    g_x = contract.body("m/s", "slip forward")
    g_y = contract.body("m/s", "slip to the left")
    g_w = contract.body("rad/s", "slip in yaw rate")
    modulus = dy.Float64(
        min=0.0,
        check=lambda value: value.is_finite(),
        metadata={"unit": "m/s", "frame": "base_link", "description": "norm of (g_x, g_y, L g_w)"},
    )

    model_x = contract.body("m/s", "velocity forward of the model given with --model", nullable=True)
    model_y = contract.body("m/s", "velocity to the left of that model", nullable=True)
    model_w = contract.body("rad/s", "yaw rate of that model", nullable=True)
    residual_modulus = contract.body(
        "m/s", "norm of (model_x - v_x, model_y - v_y, L (model_w - v_w))", nullable=True
    )
    suspect = contract.flag(
        "in an incident, or where the localization is at fault; left out of medians and fits"
    )

    @dy.rule()
    def slip_is_ideal_minus_measured(cls) -> pl.Expr:  # noqa: N805 - dataframely rules receive the class
        wrong = [(pl.col(f"f_{c}") - pl.col(f"v_{c}") - pl.col(f"g_{c}")).abs() for c in "xyw"]
        return pl.sum_horizontal(wrong) < 1e-9  # noqa: PLR2004 - rounding of three differences


class Windows(Table):
    """One row a full window; windows start where a segment or a command step starts."""

    VERSION: ClassVar[int] = 1

    input = contract.source()
    t_start = contract.seconds("start of the window")
    t_end = contract.seconds("end of the window")
    segment = contract.segment()
    step = contract.step()
    transitory = contract.flag("most of the window lies in the transitory span of a change of command")
    suspect = contract.flag(
        "in an incident, or where the localization is at fault; left out of medians and fits"
    )
    samples = dy.Int32(min=1, metadata={"description": "grid steps in the window"})
    rms_modulus = contract.bounded("m/s", "root mean square of the slip speed", 0.0)
    window_norm = contract.bounded("m/s", "sqrt(40) rms_modulus: the published 2 s window norm", 0.0)


SUBSETS = ("all", "transitory", "steady")


class Aggregates(Table):
    """One row an input and subset of the samples."""

    VERSION: ClassVar[int] = 2

    input = contract.source()
    subset = contract.choice(SUBSETS, "all samples, or only transitory or steady ones")
    samples = contract.count("time steps counted")
    windows = contract.count("2 s windows counted")
    median_modulus = contract.optional("m/s", "median slip speed")
    median_residual_modulus = contract.optional(
        "m/s", "median slip speed of the residual of the model given with --model"
    )
    median_window_norm = contract.optional("m/s", "median 2 s window norm")
    rms_x = contract.optional("m/s", "root mean square of g_x")
    rms_y = contract.optional("m/s", "root mean square of g_y")
    rms_w = contract.optional("rad/s", "root mean square of g_w")
    mean_square = contract.optional("m^2/s^2", "mean square of the modulus")
    drivetrain_mean_square = contract.optional("m^2/s^2", "of f(command) - f(measured wheels)")
    ground_mean_square = contract.optional("m^2/s^2", "of f(measured wheels) - v")
    cross_mean_square = contract.optional("m^2/s^2", "twice the mean product of the two parts")
    distance = contract.optional("m", "distance driven")
    duration = contract.optional("s", "time covered by the samples")
    height_rate = contract.optional("m/s", "height variation per second")
    largest_kinetic_energy = contract.optional("J", "largest 1/2 m v^2; null without a mass")
    length_scale = contract.number("m", "L that turns yaw rate into speed in the slip speed")


KINDS = ("rung", "floor")


class Ladder(Table):
    """One row for each step; the last row of an input is its noise floor."""

    VERSION: ClassVar[int] = 1

    input = contract.source("input of the model")
    kind = contract.choice(KINDS, "a model, or how well motion repeats itself")
    rung = dy.Int32(min=0, metadata={"description": "step of the ladder; 0 is the ideal model"})
    added = contract.text("effects that this step adds")
    effects = contract.text("all effects of this step, in the order from command to pose")
    rms_x = contract.body("m/s", "rms of displacement over 0.5 s, over 0.5 s: forward", nullable=True)
    rms_y = contract.body("m/s", "the same to the left", nullable=True)
    rms_w = contract.body("rad/s", "the same of the heading", nullable=True)
    t_mrmse = contract.optional("m", "rms position error over windows and steps of 2 s")
    r_mrmse = contract.optional("rad", "rms wrapped yaw error over windows and steps of 2 s")
    explained_share = contract.optional("1", "share of the removable error that is gone")


QUANTITIES = ("slip", "position", "heading")
BUDGET_KINDS = ("effect", "disturbance", "localization_noise")


class Budget(Table):
    """One row a cause: the shares of an input and a quantity add up to one."""

    VERSION: ClassVar[int] = 1

    input = contract.source()
    quantity = contract.choice(QUANTITIES, "mean square that is divided: slip over 0.5 s, or error over 2 s")
    kind = contract.choice(BUDGET_KINDS, "an effect, the disturbance, or the noise floor")
    name = contract.name("id of the effect, or the kind")
    mean_square = contract.number("1", "its part of the mean square, in the unit of the column `unit`")
    unit = contract.text("unit of mean_square")
    share = contract.number("1", "its part over the whole: its Shapley value over the order of effects")
    low = contract.optional("1", "lower end of its 95 % interval, a jackknife over 10 s stretches")
    high = contract.optional("1", "upper end of it")
    alone = contract.optional("1", "share that the effect takes from the ideal model by itself")
    last = contract.optional("1", "share that it takes when all others are there")
    stretches = dy.Int32(min=0, metadata={"description": "stretches of 10 s behind the interval"})


class Parameters(Table):
    """One row a parameter of an effect that is missing from the ideal model, as in `diagnosis.json`."""

    VERSION: ClassVar[int] = 2

    input = contract.source()
    effect = contract.name("id of the effect")
    parameter = contract.name("name of the parameter")
    value = contract.number("1", "its value, in the unit of the column `unit`")
    low = contract.optional("1", "lower end of its 95 % interval")
    high = contract.optional("1", "upper end of it")
    unit = contract.text("unit of value, low and high")
    at_bound = contract.flag("the fit stopped at a bound of the search: the interval is not meaningful")


class Estimates(Table):
    """One row a parameter: what runs are set side by side with."""

    VERSION: ClassVar[int] = 3

    input = contract.source()
    effect = contract.name("id of the effect")
    parameter = contract.name("name of the parameter")
    unit = contract.text("unit of value and standard_error")
    value = contract.number("1", "its estimate, in the unit of the column `unit`")
    standard_error = contract.bounded("1", "half of its 95 % interval over 1.96", 0.0)
    named = contract.flag(
        "the diagnosis names the effect; else the estimate is what one step of a joint fit gives"
    )
    at_bound = contract.flag("the fit stopped at a bound of the search: the error is not meaningful")
    in_model = contract.flag("the run's written model holds the effect: one of each undecided group, too")
