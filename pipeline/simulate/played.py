"""Commands that were written to be played: read back, so that the hidden physics can be driven with them."""

from pathlib import Path

import numpy as np

from pipeline.simulate.errors import SimulateError
from pipeline.simulate.programs import Commands
from pipeline.simulate.vehicles import Vehicle

# Fields of speed and turn; a turn is a steering angle for a car, a yaw rate else.
_STEERED = {
    "ackermann_msgs/msg/AckermannDrive": ("speed", "steering_angle"),
    "ackermann_msgs/msg/AckermannDriveStamped": ("drive.speed", "drive.steering_angle"),
}
_TURNED = {
    "geometry_msgs/msg/Twist": ("linear.x", "angular.z"),
    "geometry_msgs/msg/TwistStamped": ("twist.linear.x", "twist.angular.z"),
}
# Wheel speeds [rad/s], a topic a side.
_SIDE = "std_msgs/msg/Float64"


def read_played(path: Path, vehicle: Vehicle) -> Commands:
    """Body commands of a recording, at the times at which a player would send them.

    Raises:
        SimulateError: ``nothing_to_play``, no topic has commands for this vehicle.
        LogError: the recording cannot be read.
    """
    from pipeline.logs import Wanted, open_log, read_topics  # noqa: PLC0415 - heavy

    types = _STEERED if vehicle.kind == "ackermann" else _TURNED
    index = open_log(path)
    topic = next((channel.topic for channel in index.channels if channel.type_name in types), None)
    sides = sorted(channel.topic for channel in index.channels if channel.type_name == _SIDE)
    if topic is None and len(sides) == 2 and vehicle.kind == "differential":  # noqa: PLR2004 - left and right
        found = read_topics(index, [Wanted(side) for side in sides])
        left, right = (found.of(side)[0] for side in sides)
        rates = [np.asarray(one.fields["data"], dtype=np.float64) for one in (left, right)]
        half = vehicle.lever_m * vehicle.controller_track_multiplier
        speed = 0.5 * vehicle.wheel_radius_m * (rates[0] + rates[1])
        turn = 0.5 * vehicle.wheel_radius_m * (rates[1] - rates[0]) / half
        return Commands((left.log_time - left.log_time[0]) * 1e-9, speed, turn, None)
    if topic is None:
        what = f"no topic has commands that a vehicle of kind {vehicle.kind} is driven with"
        hint = f"Give a recording with {' or '.join(types)}, or {_SIDE} for the left and the right wheels."
        raise SimulateError("nothing_to_play", what, where=str(path), hint=hint)
    columns = read_topics(index, [Wanted(topic)]).of(topic)[0]
    speed, turn = (np.asarray(columns.fields[name], dtype=np.float64) for name in types[columns.type_name])
    times = (columns.log_time - columns.log_time[0]) * 1e-9
    sideways = np.zeros_like(speed) if vehicle.moves_sideways else None
    return Commands(times, speed, turn, sideways)
