"""How the body moved, from the poses."""

from typing import ClassVar

from schemas import fields
from schemas.contract import Table


class Velocities(Table):
    """One row a step of the uniform grid inside a segment."""

    VERSION: ClassVar[int] = 2

    t = fields.seconds()
    stamp = fields.stamp()
    segment = fields.segment()
    x, y, z = fields.vector("m", "position of base_link", "map")
    roll = fields.number("rad", "roll of base_link", frame="map")
    pitch = fields.number("rad", "pitch of base_link, nose down positive", frame="map")
    yaw = fields.number("rad", "yaw of base_link, unwrapped inside a segment", frame="map")
    v_x = fields.body("m/s", "body velocity forward")
    v_y = fields.body("m/s", "body velocity to the left")
    v_w = fields.body("rad/s", "yaw rate: of the pose, or of the gyro with `--yaw imu`")
    v_w_imu = fields.body("rad/s", "yaw rate of the gyro, sign, scale and bias corrected", nullable=True)
    outlier = fields.flag("the localization is at fault here")
