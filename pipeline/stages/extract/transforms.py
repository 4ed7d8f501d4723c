"""Poses out of chains of transforms, and poses of other frames moved to base_link."""

from collections.abc import Sequence

import numpy as np

from pipeline.core import rigid
from pipeline.core.arrays import Floats
from pipeline.logs import LogError, TopicColumns, TransformBuffer, TransformSeries
from pipeline.stages.errors import StageError
from pipeline.stages.extract.localization import move_to_base, normalize_quaternions
from pipeline.stages.extract.reading import PoseArrays
from pipeline.stages.finding import Finding
from pipeline.vehicles import PoseSource
from pipeline.vehicles.candidates import LOCALIZED
from pipeline.vehicles.message_types import plain_type
from pipeline.vehicles.topics import TRANSFORM_TYPES

_BASES = ("base_link", "base_footprint", "base")
_FIXED = ("map", "world", "odom")


def is_transforms(columns: TopicColumns) -> bool:
    """Whether a topic holds transforms."""
    return plain_type(columns.type_name) in TRANSFORM_TYPES


def chain_poses(topics: Sequence[TopicColumns], source: PoseSource, where: str) -> TransformSeries:
    """Poses of base_link along the chain of transforms.

    Without configured frames the child is base_link (or base_footprint, base), the parent map, world or odom,
    whichever comes first among the child's ancestors, else its topmost ancestor.

    Args:
        topics: all topics that were read; the transforms among them are used.
        source: the choice, with frames where they are configured.
        where: the log, for error messages.

    Raises:
        StageError: the frames do not exist or are not connected.
    """
    buffer = TransformBuffer([columns for columns in topics if is_transforms(columns)])
    parent, child = source.frames or _choose_frames(buffer, where)
    try:
        return buffer.lookup_series(parent, child)
    except LogError as error:
        raise StageError(error.code, error.what, where=where, hint=error.hint) from error


def _choose_frames(buffer: TransformBuffer, where: str) -> tuple[str, str]:
    parents = {link.child: link.parent for link in buffer.links()}
    frames = buffer.frames()
    bases = [frame for base in _BASES for frame in frames if frame.rsplit("/", 1)[-1] == base]
    if not bases:
        raise StageError(
            "no_base_frame",
            "the transforms have no frame called base_link, base_footprint or base",
            where=where,
            hint=f"Name both: [pose] frames = [parent, child]. Known frames: {', '.join(frames) or 'none'}.",
        )
    child = bases[0]
    above = [child]
    while parents.get(above[-1]) is not None and parents[above[-1]] not in above:
        above.append(parents[above[-1]])
    named = [frame for fixed in _FIXED for frame in above[1:] if frame.rsplit("/", 1)[-1] == fixed]
    if not named and len(above) == 1:
        hint = f"Name both: [pose] frames = [parent, child]. Known frames: {', '.join(frames)}."
        raise StageError("no_base_frame", f"the transforms give {child} no parent", where=where, hint=hint)
    return (named[0] if named else above[-1]), child


def describe_chain(series: TransformSeries, topic: str) -> list[Finding]:
    """What is worth knowing about a chain."""
    text = f"poses are the transform from {series.parent} to {series.child}"
    findings = [Finding("transforms", "info", text, where=topic)]
    if series.parent.rsplit("/", 1)[-1] == "odom":
        text = (
            "the transforms end at odom: the poses are an odometry, which drifts and may come from the wheels"
        )
        findings.append(Finding("pose_is_odometry", "warning", text, where=topic))
    return findings + [Finding("transform_note", "info", note, where=topic) for note in series.notes]


def describe_frame(topic: str, parent: str) -> list[Finding]:
    """Whether a topic's poses may be an odometry, by their frame and its name."""
    if parent.rsplit("/", 1)[-1] != "odom" or LOCALIZED.search(topic.lower()):
        return []
    text = (
        f"{topic} gives poses in {parent}: they are an odometry, which drifts and may come from the wheels; "
        "slip against the wheels themselves is zero"
    )
    return [Finding("pose_is_odometry", "warning", text, where=topic)]


def to_base_link(
    arrays: PoseArrays, topics: Sequence[TopicColumns], topic: str
) -> tuple[PoseArrays, list[Finding]]:
    """Move poses of another frame of the vehicle to base_link, through the static transforms.

    Without a static transform the poses are taken as they are, and that is said.
    """
    child = arrays.child.lstrip("/")
    if not child or child.rsplit("/", 1)[-1] in _BASES:
        return arrays, []
    base, offset = _find_base(topics, child)
    if offset is None:
        text = (
            f"{topic} gives poses of {child!r}, and no static transform leads from there to base_link: "
            "they were taken as poses of base_link (a lever arm would look like lateral slip in turns)"
        )
        return arrays, [Finding("child_frame", "warning", text, where=topic)]
    # What is wrong with an orientation is said where the track is cut.
    unit, good, _ = normalize_quaternions(arrays.quaternion, topic)
    position, quaternion = arrays.position.copy(), arrays.quaternion.copy()
    position[good], quaternion[good] = move_to_base(
        arrays.position[good], unit[good], offset.position[0], offset.quaternion[0]
    )
    text = f"{topic} gives poses of {child!r}: moved to base_link through the static transforms"
    moved = PoseArrays(position, quaternion, arrays.parent, base)
    return moved, [Finding("child_frame", "info", text, where=topic)]


def find_antenna(topics: Sequence[TopicColumns], frame: str, topic: str) -> tuple[Floats, list[Finding]]:
    """Place of an antenna in base_link [m], shape (3,); zero where no static transform says it.

    Args:
        topics: all topics that were read.
        frame: of the antenna, in the headers of its topic.
        topic: that topic.
    """
    _, offset = _find_base(topics, frame.lstrip("/"))
    if offset is None:
        text = (
            f"no static transform places the antenna of {topic} ({frame or 'no frame'}) on the vehicle: "
            "it was taken to be at base_link (a lever arm would look like lateral slip in turns)"
        )
        return np.zeros(3), [Finding("child_frame", "warning", text, where=topic)]
    lever = -rigid.rotate(rigid.invert_quaternions(offset.quaternion), offset.position)[0]
    text = (
        f"{topic} is of an antenna {lever[0]:.2g} m ahead and {lever[1]:.2g} m left of base_link: moved there"
    )
    return lever, [Finding("child_frame", "info", text, where=topic)]


def _find_base(topics: Sequence[TopicColumns], child: str) -> tuple[str, TransformSeries | None]:
    """The base's frame and its pose in a frame of the vehicle; None where no static transform leads there."""
    buffer = TransformBuffer([columns for columns in topics if is_transforms(columns)])
    base = next((frame for frame in buffer.frames() if frame.rsplit("/", 1)[-1] == _BASES[0]), "")
    try:
        offset = buffer.lookup_series(child, base, at=np.zeros(1, dtype=np.int64)) if base else None
    except LogError:
        offset = None
    return base, offset if offset is not None and offset.position.shape[0] else None
