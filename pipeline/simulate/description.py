"""Robot descriptions (URDF) of simulated vehicles: wheels as cylinders on joints, as vendors write them."""

from collections.abc import Mapping

from pipeline.simulate.vehicles import Vehicle

_WIDTH_M = 0.05


def describe_robot(name: str, vehicle: Vehicle, joints: Mapping[str, str]) -> str:
    """A description in which every wheel is a joint of base_link.

    Args:
        name: of the robot.
        vehicle: its geometry.
        joints: names of the wheel joints by their place, ``front_left`` and the like; ``left`` for the only
            axle. Places that begin with ``steer`` steer.
    """
    parts = ['<link name="base_link"/>']
    for place, joint in joints.items():
        y = 0.5 * vehicle.track_width_m * (1.0 if place.endswith("left") else -1.0)
        if vehicle.kind == "ackermann":
            x = vehicle.wheelbase_m if "front" in place or place.startswith("steer") else 0.0
        else:
            x = vehicle.wheelbase_m * {"front": 0.5, "rear": -0.5}.get(place.split("_")[0], 0.0)
        parts.append(_write_joint(joint, (x, y), vehicle.wheel_radius_m, steers=place.startswith("steer")))
    return f'<?xml version="1.0"?><robot name="{name}">{"".join(parts)}</robot>'


def _write_joint(joint: str, place: tuple[float, float], radius_m: float, *, steers: bool) -> str:
    link = joint.removesuffix("_joint") + "_link"
    shape = f'<cylinder radius="{radius_m}" length="{_WIDTH_M}"/>'
    geometry = "" if steers else f"<collision><geometry>{shape}</geometry></collision>"
    kind, axis = ("revolute", "0 0 1") if steers else ("continuous", "0 1 0")
    return (
        f'<link name="{link}">{geometry}</link><joint name="{joint}" type="{kind}">'
        f'<parent link="base_link"/><child link="{link}"/>'
        f'<origin xyz="{place[0]} {place[1]} 0" rpy="0 0 0"/><axis xyz="{axis}"/></joint>'
    )
