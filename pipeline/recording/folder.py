"""Vehicle of a recording whose end is lost, as the other recordings of its folder name it."""

from pathlib import Path

from pipeline.core import SlipError
from pipeline.logs import (
    LogIndex,
    RaggedStrings,
    RemotePath,
    Wanted,
    is_finished,
    list_files,
    open_log,
    read_topics,
    take_start,
)
from pipeline.recording.findings import Finding
from pipeline.sources import Recognized, Vehicle, find_preset, plain_type, recognize_vehicle

_LOST_ENDS = ("truncated", "damaged_summary")
"""Losses of the end of a file, where recorders write what they say of the recording."""
_MOST = 12
"""Most recordings that are asked, the nearest by name: each costs some hundredths of a second."""
_CHUNKS = 2
"""Chunks of a file in which the names of its joints are looked up: every message repeats them."""
_JOINTS = "sensor_msgs/JointState"


def find_in_folder(index: LogIndex) -> tuple[Recognized | None, tuple[Finding, ...]]:
    """The vehicle of the recordings beside one whose end is lost, and which have the same topics and joints.

    Args:
        index: of the recording, which does not say itself what its vehicle is.

    Returns:
        The vehicle, None without one or where they name several; and a finding on either.
    """
    if isinstance(index.path, RemotePath) or not any(loss.kind in _LOST_ENDS for loss in index.losses):
        return None, ()
    topics, joints = _list_topics(index), _read_joints(index)
    named: dict[str, tuple[Vehicle, list[str]]] = {}
    for path in _list_beside(index.path):
        try:
            other = open_log(path)
            vehicle = _read_vehicle(other)
            is_alike = (
                vehicle is not None
                and topics <= _list_topics(other)
                and _are_alike(joints, _read_joints(other))
            )
        except (SlipError, OSError):
            continue
        if vehicle is not None and is_alike:
            named.setdefault(vehicle.id, (vehicle, []))[1].append(path.name)
    if not named:
        return None, ()
    if len(named) > 1:
        several = {"kind": "several", "vehicles": [vehicle.name for vehicle, _ in named.values()]}
        return None, (Finding("vehicle_of_folder", "warning", "vehicle", several),)
    ((vehicle, logs),) = named.values()
    values = {"kind": "one", "vehicle": vehicle.name, "preset": vehicle.id, "logs": logs}
    return Recognized(vehicle, "folder"), (Finding("vehicle_of_folder", "warning", "vehicle", values),)


def _list_beside(path: Path) -> list[Path]:
    """Finished recordings of the same folder, the nearest by name first."""
    path = path.absolute()
    if path.is_dir():
        every = sorted(one for one in path.parent.iterdir() if one.is_dir())
    else:
        every = [one for one in list_files(path.parent) if one.name.endswith(path.suffix)]
    own = every.index(path) if path in every else 0
    near = sorted(range(len(every)), key=lambda number: abs(number - own))
    return [every[number] for number in near if every[number] != path and _is_whole(every[number])][:_MOST]


def _is_whole(path: Path) -> bool:
    try:
        files = list_files(path) if path.is_dir() else [path]
        return bool(files) and all(is_finished(file) for file in files)
    except OSError:
        return False


def _read_vehicle(index: LogIndex) -> Vehicle | None:
    """The vehicle that a recording names, by its metadata or by words of it."""
    preset = find_preset(index.deployment.get("vehicle") or "")
    recognized = None if preset is not None else recognize_vehicle(index.channels, index.metadata, None)
    return preset if recognized is None else recognized.vehicle


def _list_topics(index: LogIndex) -> set[tuple[str, str]]:
    return {(one.topic, plain_type(one.type_name)) for one in index.channels if one.message_count != 0}


def _are_alike(some: set[tuple[str, str]], others: set[tuple[str, str]]) -> bool:
    """Whether one recording has all joints of the other: either may begin before all of them are sent."""
    return some <= others or others < some


def _read_joints(index: LogIndex) -> set[tuple[str, str]]:
    """Names of joints by topic, from the start of the recording."""
    wanted = [Wanted(topic, ("name",)) for topic, kind in sorted(_list_topics(index)) if kind == _JOINTS]
    if not wanted:
        return set()
    read = read_topics(take_start(index, _CHUNKS), wanted, sha256="unused", skip_unfit=True)
    columns = ((one.topic, one.fields.get("name")) for one in read.topics)
    return {
        (topic, name) for topic, names in columns if isinstance(names, RaggedStrings) for name in names.values
    }
