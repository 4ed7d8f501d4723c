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
    rate_x, rate_y, rate_z = fields.vector("rad/s", "angular velocity", "imu")
    acceleration_x, acceleration_y, acceleration_z = fields.vector("m/s^2", "specific force", "imu")
    active = fields.flag("inside an interval in which commands are live")
