"""What farm-ng's Amiga says; see `platform_table`."""

from __future__ import annotations

from pipeline.simulate.platforms import Platform, pose_fields
from pipeline.simulate.published import Published, Q
from pipeline.simulate.vehicles import Vehicle

_AMIGA = Vehicle("amiga", "differential", 0.2159, 1.0, 1.0, 1.5, max_turn_radps=1.0)
_POSE = "pose.a_from_b"
_IMAGINARY = pose_fields(f"{_POSE}.translation", f"{_POSE}.rotation.unit_quaternion.imag")

FARM_NG_PLATFORMS: dict[str, Platform] = {
    # farm-ng/farm-ng-amiga: protos/farm_ng/canbus, protos/farm_ng/filter; its recordings brought into MCAP
    "amiga": Platform(
        _AMIGA,
        (
            Published(
                "/canbus/twist",
                "farm_ng.canbus.proto.Twist2d",
                "command",
                {"linear_velocity_x": Q("speed"), "angular_velocity": Q("yaw_rate")},
                stamp="none",
            ),
            Published(
                "/canbus/state",
                "farm_ng.canbus.proto.AmigaV6CanbusState",
                "wheels",
                {
                    "amiga_tpdo1.measured_speed": Q("speed"),
                    "amiga_tpdo1.measured_angular_rate": Q("yaw_rate"),
                    "amiga_tpdo1.control_state": 5.0,
                },
                stamp="none",
            ),
            Published(
                "/filter/state",
                "farm_ng.filter.proto.FilterState",
                "localization",
                {
                    **{path: value for path, value in _IMAGINARY.items() if not path.endswith(".w")},
                    f"{_POSE}.rotation.unit_quaternion.real": Q("qw"),
                    "pose.frame_a": "world",
                    "pose.frame_b": "robot",
                    "has_converged": 1.0,
                },
                stamp="none",
            ),
        ),
    ),
}
