"""Tables of one run: what its log holds, and what is computed of it."""

from collections.abc import Mapping
from typing import ClassVar

import dataframely as dy
import polars as pl

import schemas
from schemas import Table


class Commands(Table):
    """One row a command message, held until the next one or until it is stale."""

    VERSION: ClassVar[int] = 4

    t = schemas.seconds()
    stamp = schemas.stamp()
    log_time = schemas.log_time()
    left = schemas.optional("rad/s", "commanded speed of the left wheels")
    right = schemas.optional("rad/s", "commanded speed of the right wheels")
    speed = schemas.body("m/s", "commanded speed (Ackermann)", nullable=True)
    steering = schemas.body("rad", "commanded steering angle (Ackermann), left positive", nullable=True)
    sideways = schemas.optional(
        "rad/s", "commanded speed of the wheels that moves to the left (mecanum, omni)"
    )
    body_x = schemas.body(
        "m/s", "commanded forward speed where a Twist is the command or is beside it", nullable=True
    )
    body_y = schemas.body(
        "m/s", "commanded speed to the left where the command is a Twist (mecanum, omni)", nullable=True
    )
    body_w = schemas.body(
        "rad/s", "commanded yaw rate where a Twist is the command or is beside it", nullable=True
    )
    left_aligned = schemas.optional("rad/s", "speed of the left wheels after corrections")
    right_aligned = schemas.optional("rad/s", "speed of the right wheels after corrections")
    sideways_aligned = schemas.optional(
        "rad/s", "speed of the wheels that moves to the left after corrections"
    )
    speed_aligned = schemas.body("m/s", "speed after corrections (Ackermann)", nullable=True)
    followed = schemas.flag("whether the drive followed it at once: models apply no others")
    active = schemas.flag("inside an interval in which commands are live")

    @dy.rule()
    def drive_is_complete(cls) -> pl.Expr:  # noqa: N805 - dataframely rules receive the class
        return schemas.drive_is_complete()


class Wheels(Table):
    """One row an encoder message."""

    VERSION: ClassVar[int] = 4

    t = schemas.seconds()
    stamp = schemas.stamp()
    log_time = schemas.log_time()
    left = schemas.optional("rad/s", "measured speed of the left wheels, mean of the side")
    right = schemas.optional("rad/s", "measured speed of the right wheels, mean of the side")
    speed = schemas.body("m/s", "measured speed (Ackermann)", nullable=True)
    steering = schemas.body("rad", "measured steering angle (Ackermann), left positive", nullable=True)
    sideways = schemas.optional(
        "rad/s", "measured speed of the wheels that moves to the left (mecanum, omni)"
    )
    left_aligned = schemas.optional("rad/s", "speed of the left wheels, linear between its readings")
    right_aligned = schemas.optional("rad/s", "speed of the right wheels, linear between its readings")
    speed_aligned = schemas.body("m/s", "speed, linear between its readings (Ackermann)", nullable=True)
    steering_aligned = schemas.body("rad", "steering angle, linear between its readings", nullable=True)
    sideways_aligned = schemas.optional(
        "rad/s", "speed of the wheels that moves to the left, linear between its readings"
    )
    latency = schemas.number("s", "delay of the encoders: they describe t - latency", frame="log clock")
    active = schemas.flag("inside an interval in which commands are live")

    @dy.rule()
    def drive_is_complete(cls) -> pl.Expr:  # noqa: N805 - dataframely rules receive the class
        return schemas.drive_is_complete()


UNIT_TOLERANCE = 1e-6


class Poses(Table):
    """One row a pose message of base_link in a fixed frame."""

    VERSION: ClassVar[int] = 3

    t = schemas.seconds()
    stamp = schemas.stamp()
    log_time = schemas.log_time()
    segment = schemas.segment()
    x, y, z = schemas.vector("m", "position of base_link", "map")
    q_x, q_y, q_z, q_w = schemas.vector("1", "quaternion of base_link", "map", 4)
    latency = schemas.number(
        "s", "delay of this pose against the gyro: it belongs to t - latency", frame="log clock"
    )
    outlier = schemas.flag("the localization contradicts the wheels: left out of medians and fits")
    held = schemas.flag("repeats the pose before it: an old estimate sampled again")
    corrected = schemas.flag("the localization corrected the odometry since the pose before it")
    active = schemas.flag("inside an interval in which commands are live")

    @dy.rule()
    def quaternion_has_unit_length(cls) -> pl.Expr:  # noqa: N805 - dataframely rules receive the class
        squared = sum((pl.col(name) ** 2 for name in ("q_x", "q_y", "q_z", "q_w")), pl.lit(0.0))
        return (squared - 1.0).abs() < UNIT_TOLERANCE


class Imu(Table):
    """One row an IMU message, in the sensor's own axes and sign, as recorded."""

    VERSION: ClassVar[int] = 1

    t = schemas.seconds()
    stamp = schemas.stamp()
    log_time = schemas.log_time()
    rate_x, rate_y, rate_z = schemas.vector("rad/s", "angular velocity", "imu")
    acceleration_x, acceleration_y, acceleration_z = schemas.vector("m/s^2", "specific force", "imu")
    active = schemas.flag("inside an interval in which commands are live")


class Alignments(Table):
    """One row a run."""

    VERSION: ClassVar[int] = 6

    hold_time = schemas.optional("s", "the controller stops this long after its last command")
    command_scale = schemas.number(
        "1", "factor by which the recorded command was multiplied; of commanded sides, their mean"
    )
    command_turn_scale = schemas.number("1", "factor by which the sides' difference was multiplied")
    track_multiplier = schemas.number(
        "1", "by which the controller multiplies the track width when it turns a body command into wheels"
    )
    body_multiplier = schemas.optional(
        "1",
        "yaw rate of the commanded wheels at the nominal track over the body command's; null without one",
    )
    gyro_scale = schemas.optional(
        "1", "yaw rate over the gyro's, negative where it turns the other way; null without a good gyro"
    )
    gyro_bias = schemas.optional("rad/s", "yaw rate of the vehicle where the scaled gyro says zero")
    heading_delay = schemas.optional(
        "s", "delay of the reported heading against the gyro: part of every latency of the poses"
    )
    heading_delay_error = schemas.optional("s", "standard error of that delay")
    wheel_delay = schemas.number("s", "delay of the encoders against the gyro: the latency of the wheels")
    gyro_residual = schemas.optional("1", "yaw rate that differs from the gyro's, as a share of it")
    gyro_delay = schemas.optional(
        "s", "delay of the gyro against the poses, where it is within half of its sampling period"
    )
    latency_spread = schemas.number("s", "standard deviation of the latencies that were taken off the poses")
    outlier_time = schemas.number("s", "time in which the localization contradicts the wheels")


EVENT_KINDS = (
    "digging_in", "spinning", "stuck", "sliding", "stopped", "side_stopped", "manual_driving", "pushed",
    "commands_silent", "localization_frozen",
)  # fmt: skip


class Events(Table):
    """One row an event in motion, from commands, wheels and poses."""

    VERSION: ClassVar[int] = 2

    kind = schemas.choice(EVENT_KINDS, "what happened")
    t_start = schemas.seconds("when it began")
    t_end = schemas.seconds("when it ended")
    t_known = schemas.seconds("when the signals up to then first showed it")
    size = schemas.optional(
        "1",
        "largest share of the wheels' usual motion that the body did not make; when sliding, of the body's "
        "motion that the wheels did not make; null of incidents",
    )
    x = schemas.number("m", "position of base_link where it began", frame="map")
    y = schemas.number("m", "position of base_link where it began", frame="map")


SEVERITIES = ("info", "warning", "error")


class Findings(Table):
    """One row a finding."""

    VERSION: ClassVar[int] = 2

    stage = schemas.text("stage that noticed it")
    id = dy.String(min_length=1, regex=r"^[a-z][a-z0-9_]*$", metadata={"description": "stable id"})
    severity = schemas.choice(SEVERITIES, "info, warning, or error: do not trust results")
    text = schemas.name("the finding in one sentence")
    where = schemas.text("topic, column or stretch of time; empty for the whole run")
    values = schemas.text("numbers, texts and lists of the finding by name, as JSON")
    t_start = schemas.optional("s", "start of the stretch it concerns")
    t_end = schemas.optional("s", "end of the stretch it concerns")
    value = schemas.optional("1", "the number behind it, in the unit the text gives")
    count = schemas.count("how often", nullable=True)


class Velocities(Table):
    """One row a step of the uniform grid inside a segment."""

    VERSION: ClassVar[int] = 3

    t = schemas.seconds()
    stamp = schemas.stamp()
    segment = schemas.segment()
    x, y, z = schemas.vector("m", "position of base_link", "map")
    roll = schemas.number("rad", "roll of base_link", frame="map")
    pitch = schemas.number("rad", "pitch of base_link, nose down positive", frame="map")
    yaw = schemas.number("rad", "yaw of base_link, unwrapped inside a segment", frame="map")
    v_x = schemas.body("m/s", "body velocity forward")
    v_y = schemas.body("m/s", "body velocity to the left")
    v_w = schemas.body("rad/s", "yaw rate: of the pose, or of the gyro with `--yaw imu`")
    v_w_imu = schemas.body("rad/s", "yaw rate of the gyro, sign, scale and bias corrected", nullable=True)
    recorded_t = schemas.seconds("the stamp of these poses, before their latency was taken off")
    recorded_x = schemas.body("m/s", "v_x by these stamps")
    recorded_y = schemas.body("m/s", "v_y by these stamps")
    recorded_w = schemas.body("rad/s", "yaw rate of the poses by these stamps")
    outlier = schemas.flag("the localization contradicts the wheels")


COUNTED = ~pl.col("suspect") & ~pl.col("standing")
"""Rows of tables `slip` and `windows` on which medians and fits rest."""


class Slip(Table):
    """One row a time step and input: g = f(u) - v."""

    VERSION: ClassVar[int] = 5
    FACTS: ClassVar[Mapping[str, str]] = {
        "length_scale_m": "L, which turns yaw rate into speed in the moduli",
        "wheel_radius_m": "r, radius of the wheels",
        "track_width_m": "b, between the left and the right wheels; absent where it is unknown",
        "wheelbase_m": "l, between the axles; absent where it is unknown",
    }

    input = schemas.source()
    t = schemas.seconds()
    stamp = schemas.stamp()
    segment = schemas.segment()
    step = schemas.step()
    transitory = schemas.flag("within the transitory span after a change of command")
    f_x = schemas.body("m/s", "ideal velocity forward")
    f_y = schemas.body("m/s", "ideal velocity to the left")
    f_w = schemas.body("rad/s", "ideal yaw rate")
    v_x = schemas.body("m/s", "measured velocity forward")
    v_y = schemas.body("m/s", "measured velocity to the left")
    v_w = schemas.body("rad/s", "measured yaw rate")
    g_x = schemas.body("m/s", "slip forward")
    g_y = schemas.body("m/s", "slip to the left")
    g_w = schemas.body("rad/s", "slip in yaw rate")
    modulus = dy.Float64(
        min=0.0,
        check=lambda value: value.is_finite(),
        metadata={"unit": "m/s", "frame": "base_link", "description": "norm of (g_x, g_y, L g_w)"},
    )
    recorded_modulus = schemas.body(
        "m/s", "modulus with stamps, scales and commands as recorded, before any correction", nullable=True
    )
    model_x = schemas.body(
        "m/s",
        "velocity forward of the model: that of --model, else that of the diagnosis; null without one",
        nullable=True,
    )
    model_y = schemas.body("m/s", "velocity to the left of that model", nullable=True)
    model_w = schemas.body("rad/s", "yaw rate of that model", nullable=True)
    residual_modulus = schemas.body(
        "m/s", "norm of (model_x - v_x, model_y - v_y, L (model_w - v_w))", nullable=True
    )
    suspect = schemas.flag(
        "in an incident, or where the localization is at fault; left out of medians and fits"
    )
    standing = schemas.flag(
        "nothing is commanded and nothing moves within 2 s: no slip to measure; left out of medians and fits"
    )

    @dy.rule()
    def slip_is_ideal_minus_measured(cls) -> pl.Expr:  # noqa: N805 - dataframely rules receive the class
        wrong = [(pl.col(f"f_{c}") - pl.col(f"v_{c}") - pl.col(f"g_{c}")).abs() for c in "xyw"]
        return pl.sum_horizontal(wrong) < 1e-9  # noqa: PLR2004 - rounding of three differences


class Windows(Table):
    """One row a full window; windows start where a segment or a command step starts."""

    VERSION: ClassVar[int] = 2

    input = schemas.source()
    t_start = schemas.seconds("start of the window")
    t_end = schemas.seconds("end of the window")
    segment = schemas.segment()
    step = schemas.step()
    transitory = schemas.flag("most of the window lies in the transitory span of a change of command")
    suspect = schemas.flag(
        "in an incident, or where the localization is at fault; left out of medians and fits"
    )
    standing = schemas.flag("some of its steps are those of a vehicle at rest; left out of medians and fits")
    samples = dy.Int32(min=1, metadata={"description": "grid steps in the window"})
    rms_modulus = schemas.bounded("m/s", "root mean square of the slip modulus", 0.0)
    window_norm = schemas.bounded("m/s", "sqrt(40) rms_modulus: the published 2 s window norm", 0.0)


SUBSETS = ("all", "transitory", "steady")


class Aggregates(Table):
    """One row an input and subset of the samples."""

    VERSION: ClassVar[int] = 3

    input = schemas.source()
    subset = schemas.choice(SUBSETS, "all samples, or only transitory or steady ones")
    samples = schemas.count("time steps counted")
    windows = schemas.count("2 s windows counted")
    median_modulus = schemas.optional("m/s", "median slip modulus")
    median_recorded_modulus = schemas.optional(
        "m/s", "as recorded: nothing corrected, only standing left out"
    )
    median_residual_modulus = schemas.optional("m/s", "median residual modulus of the model, see table slip")
    median_window_norm = schemas.optional("m/s", "median 2 s window norm")
    rms_x = schemas.optional("m/s", "root mean square of g_x")
    rms_y = schemas.optional("m/s", "root mean square of g_y")
    rms_w = schemas.optional("rad/s", "root mean square of g_w")
    mean_square = schemas.optional("m^2/s^2", "mean square of the modulus")
    drivetrain_mean_square = schemas.optional("m^2/s^2", "of f(command) - f(measured wheels)")
    ground_mean_square = schemas.optional("m^2/s^2", "of f(measured wheels) - v")
    cross_mean_square = schemas.optional("m^2/s^2", "twice the mean product of the two parts")
    distance = schemas.optional("m", "distance driven in the samples; null if the vehicle does not move")
    duration = schemas.optional("s", "time of the samples")
    height_rate = schemas.optional("m/s", "height variation per second")
    largest_kinetic_energy = schemas.optional("J", "largest 1/2 m v^2; null without a mass")
    length_scale = schemas.number("m", "L that turns yaw rate into speed in the slip modulus")


KINDS = ("rung", "floor")


class Ladder(Table):
    """One row for each step; the last row of an input is its noise floor."""

    VERSION: ClassVar[int] = 1

    input = schemas.source("input of the model")
    kind = schemas.choice(KINDS, "a model, or how well motion repeats itself")
    rung = dy.Int32(min=0, metadata={"description": "step of the ladder; 0 is the ideal model"})
    added = schemas.text("effects that this step adds")
    effects = schemas.text("all effects of this step, in the order from command to pose")
    rms_x = schemas.body("m/s", "rms of displacement over 0.5 s, over 0.5 s: forward", nullable=True)
    rms_y = schemas.body("m/s", "the same to the left", nullable=True)
    rms_w = schemas.body("rad/s", "the same of the heading", nullable=True)
    t_mrmse = schemas.optional("m", "rms position error over windows and steps of 2 s")
    r_mrmse = schemas.optional("rad", "rms wrapped yaw error over windows and steps of 2 s")
    explained_share = schemas.optional("1", "share of the removable error that is gone")


QUANTITIES = ("slip", "position", "heading")
BUDGET_KINDS = ("effect", "disturbance", "localization_noise")


class Budget(Table):
    """One row a cause: the shares of an input and a quantity add up to one."""

    VERSION: ClassVar[int] = 1

    input = schemas.source()
    quantity = schemas.choice(QUANTITIES, "mean square that is divided: slip over 0.5 s, or error over 2 s")
    kind = schemas.choice(BUDGET_KINDS, "an effect, the disturbance, or the noise floor")
    name = schemas.name("id of the effect, or the kind")
    mean_square = schemas.number("1", "its part of the mean square, in the unit of the column `unit`")
    unit = schemas.text("unit of mean_square")
    share = schemas.number("1", "its part over the whole: its Shapley value over the order of effects")
    low = schemas.optional("1", "lower end of its 95 % interval, a jackknife over 10 s stretches")
    high = schemas.optional("1", "upper end of it")
    alone = schemas.optional("1", "share that the effect takes from the ideal model by itself")
    last = schemas.optional("1", "share that it takes when all others are there")
    stretches = dy.Int32(min=0, metadata={"description": "stretches of 10 s behind the interval"})


class Parameters(Table):
    """One row a parameter of an effect that is missing from the ideal model, as in `diagnosis.json`."""

    VERSION: ClassVar[int] = 3

    input = schemas.source()
    effect = schemas.name("id of the effect")
    parameter = schemas.name("name of the parameter")
    value = schemas.number("1", "its value, in the unit of the column `unit`")
    low = schemas.optional("1", "lower end of its 95 % interval")
    high = schemas.optional("1", "upper end of it")
    unit = schemas.text("unit of value, low and high")
    at_bound = schemas.flag("the fit stopped at a bound of the search: the interval is not meaningful")
    doubt = schemas.text("id of why it is not to be used as it stands, as in JSON; empty without a doubt")


class Estimates(Table):
    """One row a parameter: what runs are set side by side with."""

    VERSION: ClassVar[int] = 3

    input = schemas.source()
    effect = schemas.name("id of the effect")
    parameter = schemas.name("name of the parameter")
    unit = schemas.text("unit of value and standard_error")
    value = schemas.number("1", "its estimate, in the unit of the column `unit`")
    standard_error = schemas.bounded("1", "half of its 95 % interval over 1.96", 0.0)
    named = schemas.flag(
        "the diagnosis names the effect; else the estimate is what one step of a joint fit gives"
    )
    at_bound = schemas.flag("the fit stopped at a bound of the search: the error is not meaningful")
    in_model = schemas.flag("the run's written model holds the effect: one of each undecided group, too")
