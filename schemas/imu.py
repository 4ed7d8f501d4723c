"""What the inertial unit measured."""

from typing import ClassVar

from schemas import fields
from schemas.contract import Table


class Imu(Table):
    """One row an IMU message, in the sensor's own axes and sign, as recorded."""

    VERSION: ClassVar[int] = 1

    t = fields.seconds()
    stamp = fields.stamp()
    log_time = fields.log_time()
    rate_x = fields.number("rad/s", "angular velocity", frame="imu")
    rate_y = fields.number("rad/s", "angular velocity", frame="imu")
    rate_z = fields.number("rad/s", "angular velocity", frame="imu")
    acceleration_x = fields.number("m/s^2", "specific force", frame="imu")
    acceleration_y = fields.number("m/s^2", "specific force", frame="imu")
    acceleration_z = fields.number("m/s^2", "specific force", frame="imu")
    active = fields.flag("inside an interval in which commands are live")
