"""Wheel speed scaling: all wheels are slowed by one factor where one would exceed its limit.

fastest = max(abs(u)) of all wheels. limit [rad/s], 6 on a Husky. It keeps the radius of a curve; where each
wheel is clipped alone, which is a wheel speed limit, a fast curve becomes a wider one. Command curves that
are too fast for the outer wheels.

Source: desaturation of wheel speeds in WPILib, `DifferentialDriveKinematics`; measured on a Husky on snow.
"""

from pipeline.models.effects.wheel_speed_limit import WheelSpeedLimit
from pipeline.models.families import Excitation, declare, has_encoders, never_attained

WheelSpeedScaling = declare(
    "wheel_speed_scaling",
    __doc__,
    "Omega = min(1, limit / fastest) * u",
    *WheelSpeedLimit.parameters,
    rank=4,
    kinds=("differential", "mecanum"),
    needs=(Excitation.LARGE, Excitation.TURNING),
    can_show=has_encoders,
    is_degenerate=never_attained,
)
