"""Several robots in one log: told by their namespaces, so that one's command never meets another's pose.

Namespaces belong to several robots when they hold drives and poses between them and are called alike but
for a number or letter (``robot1``, ``robot2``), are called after vehicles (``husky``, ``warthog``), or hold
the same topics (``alice/cmd_vel``, ``alice/odom``, ``bob/cmd_vel``, ``bob/odom``). Anything else, such as
``controller`` beside ``mapping``, is one robot.
"""

import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping

from pipeline.vehicles.errors import ConfigurationError
from pipeline.vehicles.presets import find_preset

_NUMBERED = re.compile(r"\d+|_[a-d]$")
_FUNCTION = re.compile(
    r"control|platform|drive|base|nav|mux|joy|teleop|web|key|plan|map|slam|icp|lidar|laser|locali|odom|wheel|motor"
    r"|vehicle|robot$|cmd|command|sensor|imu|gnss|gps|rtk|camera|zed|status|state|ekf|filter|fusion|sim|gazebo|truth"
)
"""Words of namespaces that are called after what they do."""


def find_robots(drives: Collection[str], poses: Collection[str]) -> tuple[str, ...]:
    """Namespaces of the robots, ``/robot1/`` and so on, sorted; none where there is but one robot.

    Args:
        drives: topics that may be commands or measured wheels.
        poses: topics that may be poses.
    """
    depths = sorted({topic.count("/") for topic in (*drives, *poses)})
    for depth in range(1, max(depths, default=0)):
        siblings: dict[str, set[str]] = defaultdict(set)
        for topic in (*drives, *poses):
            if topic.count("/") > depth:
                space = _space_of(topic, depth)
                siblings[space.rsplit("/", 2)[0]].add(space)
        for spaces in siblings.values():
            for family in _list_families(spaces, drives, poses):
                if len(family) > 1 and _holds(family, drives) and _holds(family, poses):
                    return tuple(sorted(family))
    return ()


def choose_robot(
    robots: Collection[str],
    *,
    configured: Iterable[str],
    drives: Collection[str],
    poses: Collection[str],
    where: str,
) -> str | None:
    """Namespace of the robot that the log is analyzed for.

    Args:
        robots: as `find_robots` gives them.
        configured: topics that the configuration names, the most telling first.
        drives: topics that may be commands or measured wheels.
        poses: topics that may be poses.
        where: the log, for the error message.

    Returns:
        The robot whose topic is configured, else the only one that has both drive and pose; None where there
        are not several.

    Raises:
        ConfigurationError: ``several_robots``, nothing says which is meant.
    """
    if not robots:
        return None
    for topic in configured:
        for robot in robots:
            if topic.startswith(robot):
                return robot
    whole = [robot for robot in robots if _holds([robot], drives) and _holds([robot], poses)]
    if len(whole) == 1:
        return whole[0]
    names = ", ".join(robot.strip("/") for robot in robots)
    why = "each has a drive and a pose" if whole else "none has both a drive and a pose"
    told = next(topic for topic in sorted(poses) if topic.startswith(tuple(robots)))
    raise ConfigurationError(
        "several_robots",
        f"the log holds several robots ({names}), and {why}",
        where=where,
        hint=f'Name one of its topics in run.toml, for example [pose] topic = "{told}" '
        "(and [command], [wheels], [imu] where they stand elsewhere)",
    )


def _space_of(topic: str, depth: int) -> str:
    return "/".join(topic.split("/")[: depth + 1]) + "/"


def _list_families(
    spaces: Collection[str], drives: Collection[str], poses: Collection[str]
) -> Iterable[set[str]]:
    """Namespaces beside each other that may be robots of one log."""
    families: dict[str, set[str]] = defaultdict(set)
    for space in sorted(spaces):
        name = space.strip("/").rsplit("/", 1)[-1].lower()
        stem = _NUMBERED.sub("", name).strip("_-")
        if find_preset(stem) is not None:
            families["a vehicle"].add(space)
        elif stem != name:
            families[_NUMBERED.sub("#", name)].add(space)
        if not _FUNCTION.search(name):
            families["by its topics"].add(space)
    alike = families.pop("by its topics", set())
    yield from families.values()
    held: Mapping[str, tuple[set[str], set[str]]] = {
        space: (_inside(space, drives), _inside(space, poses)) for space in sorted(alike)
    }
    for own in held.values():
        yield {space for space, other in held.items() if own[0] & other[0] and own[1] & other[1]}


def _inside(space: str, topics: Collection[str]) -> set[str]:
    return {topic.removeprefix(space) for topic in topics if topic.startswith(space)}


def _holds(spaces: Collection[str], topics: Collection[str]) -> bool:
    return any(_inside(space, topics) for space in spaces)
