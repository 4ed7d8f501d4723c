"""Reading of recordings (index, topics as columns, transforms) and writing of MCAP files.

Reading is columnar and as fast as inflating the chunks. Damage is reported as losses, and the undamaged data
around it are read. The package does not interpret the values of messages. Here are time series of transforms
between frames, from ``/tf`` and ``/tf_static``.

Every frame has one parent. A chain is evaluated at the stamps of its last moving link, the one next to the
child; slower links above it, such as map to odom, are corrections of it: each counts from when it was
recorded, even if it is dated ahead, and what it corrects arose along the path since the one before.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np

from pipeline.core import (
    Flags,
    Floats,
    Ints,
    find_held,
    interpolate_poses,
    invert_quaternions,
    measure_increments,
    multiply_quaternions,
    name_first,
    rotate,
    shorten,
)
from pipeline.logs.catalog import OVER_BUDGET
from pipeline.logs.columns import Column, Ragged, RaggedStrings, Strings, join_times
from pipeline.logs.index import (
    SUFFIXES,
    ChannelInfo,
    LogIndex,
    find_types,
    hash_log,
    list_files,
    open_log,
    stem_of,
    take_start,
)
from pipeline.logs.part import is_finished, judge_content
from pipeline.logs.reader import LogData, TopicColumns, Wanted, join_channels, list_fields, read_topics
from pipeline.logs.records import LATEST_NS, OTHER_VERSION, ROS1_BAG, SQLITE_BAG, LogError, Loss
from pipeline.logs.remote import RemotePath, locate_recorded, open_store, spell_location, to_location
from pipeline.logs.schema import bundled_types, definition_text, short_name


@dataclass(frozen=True, slots=True)
class _Layout:
    """Fields of a message of transforms.

    Attributes:
        each: path of one transform; empty if a message is one.
        parent: name of the parent frame.
        stamp: a structure of ``sec`` and ``nanosec``.
        transform: path of ``translation`` and ``rotation``.
    """

    each: str
    parent: str
    stamp: str
    transform: str

    @property
    def frames(self) -> tuple[str, str]:
        """Fields of the names of parent and child."""
        return f"{self.each}{self.parent}", f"{self.each}child_frame_id"

    @property
    def structures(self) -> tuple[str, str, str]:
        """Paths of stamp, translation and rotation."""
        moved = f"{self.each}{self.transform}"
        return f"{self.each}{self.stamp}", f"{moved}translation", f"{moved}rotation"

    @property
    def numbers(self) -> list[str]:
        """Fields of the structures."""
        parts = (("sec", "nanosec"), "xyz", "xyzw")
        return [
            f"{path}.{part}" for path, names in zip(self.structures, parts, strict=True) for part in names
        ]


_MESSAGE: Final = _Layout("transforms[].", "header.frame_id", "header.stamp", "transform.")
_FOXGLOVE: Final = _Layout("", "parent_frame_id", "timestamp", "")
_LAYOUTS: Final = {
    "tf2_msgs/TFMessage": _MESSAGE,
    "tf/tfMessage": _MESSAGE,
    **{f"{package}/FrameTransform": _FOXGLOVE for package in ("foxglove", "foxglove_msgs")},
    **{
        f"{package}/FrameTransforms": replace(_FOXGLOVE, each="transforms[].")
        for package in ("foxglove", "foxglove_msgs")
    },
}
TRANSFORM_TYPES: Final = tuple(_LAYOUTS)
"""Types of messages of transforms, as ``package/Name``."""


def _find_layout(type_name: str) -> _Layout | None:
    """Fields of a type of transforms; None of another."""
    return _LAYOUTS.get(short_name(type_name.replace(".", "/")))


_LEAST_NORM: Final = 1e-6
_HELD_INTERVALS: Final = 3.0
_SMALLEST_LEAD_NS: Final = 1_000_000
"""Time between stamp and recording that means nothing: recorders write down messages a millisecond apart."""

_SHARED: Final = 2.0 / 3.0
"""Share of poses with the stamp of the one before, and another place, above which stamps are too coarse: two
publishers that stamp alike share half."""
_FEWEST_STAMPS: Final = 20
"""Least number of poses of which that is known."""
_LONGEST_PATH: Final = 2.0
"""Path between two changes of a correction [m + rad] above which the second one is a jump: AMCL corrects
every 0.2 m or 0.2 rad, slam_toolbox every 0.5 m or 0.5 rad."""


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """Pose of a frame in its parent.

    Attributes:
        parent: frame in which the pose is expressed.
        child: frame whose pose it is.
        fixed: whether it never moves; it then has one row.
        time: stamps [ns], int64, strictly increasing, shape (n,).
        log_time: log times of these stamps [ns], int64.
        position: [m], shape (n, 3).
        quaternion: unit, shape (n, 4).
    """

    parent: str
    child: str
    fixed: bool
    time: Ints
    log_time: Ints
    position: Floats
    quaternion: Floats


@dataclass(frozen=True, slots=True, eq=False)
class TransformSeries:
    """Pose of one frame in another over time.

    Attributes:
        parent: frame in which the poses are expressed.
        child: frame whose poses they are.
        time: stamps [ns], int64, strictly increasing, shape (n,).
        log_time: log times of the link next to the child [ns], int64, shape (n,).
        position: [m], shape (n, 3).
        quaternion: (x, y, z, w), unit, shape (n, 4).
        corrected: whether a link above the moving one changed since the stamp before: a localization
            corrected the odometry, shape (n,).
        notes: held, omitted or ambiguous transforms.
    """

    parent: str
    child: str
    time: Ints
    log_time: Ints
    position: Floats
    quaternion: Floats
    corrected: Flags
    notes: tuple[str, ...]


def wanted_transforms(types: Mapping[str, str]) -> list[Wanted]:
    """Topics and fields to read for a buffer.

    Args:
        types: message type by topic. Messages of ROS are transforms of the robot on topics named ``tf`` or
            ``tf_static``; Foxglove's types are on any.
    """
    wanted = []
    for topic, kind in types.items():
        layout = _find_layout(kind)
        if layout is not None and (layout is not _MESSAGE or _base_name(topic) in ("tf", "tf_static")):
            wanted.append(Wanted(topic, (*layout.frames, *layout.structures)))
    return wanted


class TransformBuffer:
    """All transforms of a recording.

    Args:
        topics: columns of topics of transforms, others are ignored; a transform on ``tf_static`` is fixed
            for the whole recording.
    """

    def __init__(self, topics: Iterable[TopicColumns]) -> None:
        self._links: dict[str, Link] = {}
        self._notes: list[str] = []
        self._collect(list(topics))

    def frames(self) -> tuple[str, ...]:
        """All frames, sorted."""
        return tuple(sorted({name for link in self._links.values() for name in (link.parent, link.child)}))

    def links(self) -> tuple[Link, ...]:
        """All links, by child."""
        return tuple(self._links[child] for child in sorted(self._links))

    def chain(self, parent: str, child: str) -> tuple[str, ...]:
        """Frames from ``parent`` to ``child``, both included.

        Raises:
            LogError: ``frame_not_found``, a frame is unknown or the two are not connected.
        """
        up_child = self._ancestors(_clean(child))
        up_parent = self._ancestors(_clean(parent))
        shared = [frame for frame in up_parent if frame in up_child]
        if not shared:
            raise self._missing(parent, child)
        down = up_child[: up_child.index(shared[0])]
        return (*up_parent[: up_parent.index(shared[0]) + 1], *reversed(down))

    def lookup_series(self, parent: str, child: str, *, at: Ints | None = None) -> TransformSeries:
        """Pose of ``child`` in ``parent`` over time.

        Args:
            parent: frame in which the poses are expressed.
            child: frame whose poses they are.
            at: stamps of the poses [ns]; by default those of the link next to the child that moves.

        Returns:
            Poses at the times where every link of the chain is known. A link is interpolated between its
            stamps, a correction of the moving link next to the child between its changes, in proportion to
            the path of that link. Beyond its first and last stamp it is held for three of its intervals plus
            the time by which its stamps are ahead of their log times; others are omitted.

        Raises:
            LogError: ``frame_not_found``.
        """
        steps = self._steps(self.chain(parent, child))
        dynamic = [(link, forward) for link, forward in steps if not link.fixed]
        moving = [step for step in dynamic if not _is_still(step[0])] or dynamic
        # Of a chain up from the vehicle the first link is its own.
        leading = moving[-1 if moving[-1][1] else 0][0] if moving else None
        if at is None:
            time = leading.time if leading is not None else np.zeros(1, dtype=np.int64)
        else:
            time = np.asarray(at, dtype=np.int64)
        known = np.ones(time.size, dtype=np.bool_)
        notes = list(self._notes)
        if leading is not None:
            steps = [(_date_back(link, leading, notes), forward) for link, forward in steps]
        for link, _ in steps:
            known &= _covers(link, time)
        if not known.all():
            notes.append(f"{int((~known).sum())} of {known.size} stamps lie where the chain is not known")
        time = time[known]
        position, quaternion = np.zeros((time.size, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (time.size, 1))
        corrected = np.zeros(time.size, dtype=np.bool_)
        for link, forward in steps:
            if link is not leading:
                corrected |= _changes(link, time)
            step_position, step_quaternion = _pose_at(link, leading, time)
            if not forward:
                step_quaternion = invert_quaternions(step_quaternion)
                step_position = -rotate(step_quaternion, step_position)
            position = position + rotate(quaternion, step_position)
            quaternion = multiply_quaternions(quaternion, step_quaternion)
        log_time = leading.log_time[known] if leading is not None and at is None else time
        return TransformSeries(
            _clean(parent), _clean(child), time, log_time, position, quaternion, corrected, tuple(notes)
        )

    def _steps(self, chain: tuple[str, ...]) -> list[tuple[Link, bool]]:
        steps: list[tuple[Link, bool]] = []
        for upper, lower in pairwise(chain):
            link = self._links.get(lower)
            if link is not None and link.parent == upper:
                steps.append((link, True))
            else:
                steps.append((self._links[upper], False))
        return steps

    def _ancestors(self, frame: str) -> list[str]:
        chain = [frame]
        while chain[-1] in self._links and self._links[chain[-1]].parent not in chain:
            chain.append(self._links[chain[-1]].parent)
        return chain

    def _missing(self, parent: str, child: str) -> LogError:
        frames = self.frames()
        unknown = [frame for frame in (parent, child) if _clean(frame) not in frames]
        what = (
            f"there is no frame {' and no frame '.join(unknown)}"
            if unknown
            else f"no chain of transforms leads from {parent} to {child}"
        )
        hint = f"Known frames: {name_first(frames)}" if frames else "The log holds no transforms"
        return LogError("frame_not_found", what, hint=hint)

    def _collect(self, topics: list[TopicColumns]) -> None:
        links: dict[str, list[Link]] = {}
        invalid: dict[str, int] = {}
        for columns in topics:
            for link, bad in _split_by_child(columns, fixed=_base_name(columns.topic).endswith("static")):
                links.setdefault(link.child, []).append(link)
                invalid[link.child] = invalid.get(link.child, 0) + bad
        for child, several in links.items():
            moving = [link for link in several if not link.fixed and link.time.size]
            chosen = moving or [link for link in several if link.time.size]
            if not chosen:
                self._notes.append(f"every transform of {child} is invalid")
                continue
            parent = max(chosen, key=lambda link: link.time.size).parent
            others = sorted({link.parent for link in chosen} - {parent})
            if others:
                self._notes.append(
                    f"{shorten(child)} has several parents; {shorten(parent)} was taken, "
                    f"not {name_first(others)}"
                )
            if invalid[child]:
                self._notes.append(f"{invalid[child]} transforms of {child} are invalid and were left out")
            own = [link for link in chosen if link.parent == parent]
            if _share_stamps(own):
                self._notes.append(
                    f"stamps of {shorten(child)} are those of several poses: log times were used"
                )
                own = [replace(link, time=link.log_time) for link in own]
            self._links[child] = _join(own)


def _split_by_child(columns: TopicColumns, *, fixed: bool) -> list[tuple[Link, int]]:
    """Links with their valid rows, and the number of invalid rows of each."""
    layout = _find_layout(columns.type_name) or _MESSAGE
    parents, children = (_spread(columns.fields.get(name)) for name in layout.frames)
    numbers = [_spread(columns.fields.get(name)) for name in layout.numbers]
    if not isinstance(parents, RaggedStrings) or not isinstance(children, RaggedStrings):
        return []
    ragged = [column for column in numbers if isinstance(column, Ragged)]
    if len(ragged) < len(numbers):
        return []
    offsets = [parents.offsets, children.offsets, *(column.offsets for column in ragged)]
    counts = np.diff(np.array(offsets), axis=1)
    # Messages of JSON may lack a field of one of their transforms.
    whole = (counts == counts[0]).all(axis=0)
    rows_of = [np.repeat(whole, count) for count in counts]
    parent_codes, child_codes = parents.codes[rows_of[0]], children.codes[rows_of[1]]
    values = [column.values[rows] for column, rows in zip(ragged, rows_of[2:], strict=True)]
    time, known = join_times(values[0], values[1])
    position = np.stack(values[2:5], axis=1).astype(np.float64)
    quaternion = np.stack(values[5:], axis=1).astype(np.float64)
    log_time = np.repeat(columns.log_time[whole], counts[0][whole])
    with np.errstate(over="ignore", invalid="ignore"):
        norm = np.linalg.norm(quaternion, axis=1)
    valid = known & np.isfinite(position).all(axis=1) & np.isfinite(norm) & (norm > _LEAST_NORM)
    links: list[tuple[Link, int]] = []
    several = len(children.values)
    pairs = parent_codes.astype(np.int64) * several + child_codes
    for pair in np.unique(pairs).tolist():
        parent, child = divmod(pair, several)
        here = pairs == pair
        chosen = here & valid
        link = Link(
            _clean(parents.values[parent]),
            _clean(children.values[child]),
            fixed,
            time[chosen],
            log_time[chosen],
            position[chosen],
            quaternion[chosen] / norm[chosen, None],
        )
        links.append((link, int((here & ~valid).sum())))
    return links


def _spread(column: Column | None) -> Column | None:
    """A column of one value a message as sequences of one, or of none where there is no text."""
    if isinstance(column, Strings):
        there = column.codes >= 0
        return RaggedStrings(column.codes[there], column.values, np.append(0, np.cumsum(there)))
    if isinstance(column, np.ndarray):
        return Ragged(column, np.arange(column.size + 1))
    return column


def _share_stamps(links: list[Link]) -> bool:
    """Whether most stamps are those of several poses that differ, as of a clock that counts seconds."""
    time = np.concatenate([link.time for link in links])
    order = np.argsort(time, kind="stable")
    position, quaternion = (
        np.concatenate([getattr(link, name) for link in links])[order] for name in ("position", "quaternion")
    )
    moves = ~find_held(position, quaternion)[1:] & (np.diff(time[order]) == 0)
    return not links[0].fixed and moves.size >= _FEWEST_STAMPS and bool(moves.mean() > _SHARED)


def _join(links: list[Link]) -> Link:
    """Join links between the same frames; of equal stamps and of fixed links the last row is used."""
    time = np.concatenate([link.time for link in links])
    order = np.argsort(time, kind="stable")
    last = order[np.r_[np.diff(time[order]) > 0, True]]
    rows = last[-1:] if links[0].fixed else last

    names = ("time", "log_time", "position", "quaternion")
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(link, name) for link in links])[rows] for name in names
    }
    return replace(links[0], **arrays)


def _is_still(link: Link) -> bool:
    return bool(find_held(link.position, link.quaternion)[1:].all())


def _covers(link: Link, time: Ints) -> Flags:
    """Stamps at which a link is known: within its own, and as far beyond as it is held."""
    if link.fixed or link.time.size == 1:
        return np.ones(time.size, dtype=np.bool_)
    interval = float(np.median(np.diff(link.time)))
    lead = max(0.0, float(np.median(link.time - link.log_time)))
    held = int(_HELD_INTERVALS * interval + lead)
    covered: Flags = (time >= link.time[0] - held) & (time <= link.time[-1] + held)
    return covered


def _changes(link: Link, time: Ints) -> Flags:
    """Stamps before which, and after the stamp before, a link changed."""
    changed = link.time[~find_held(link.position, link.quaternion)][1:]
    counted = np.searchsorted(changed, time, side="right")
    flags: Flags = np.diff(counted, prepend=counted[:1]) > 0
    return flags


def _date_back(link: Link, leading: Link, notes: list[str]) -> Link:
    """A correction of the leading link, without the time by which it is dated ahead of its recording."""
    if link is leading or link.fixed or not leading.time.size:
        return link
    start = leading.time[0]
    recorded = np.maximum.accumulate(leading.log_time) - start
    there = np.interp(link.log_time - start, recorded, leading.time - start)
    ahead = int(np.median(link.time - start - there))
    if ahead < _SMALLEST_LEAD_NS:
        return link
    notes.append(
        f"{link.parent} to {link.child} is dated {ahead * 1e-9:.2g} s ahead: it counts from its recording on"
    )
    return replace(link, time=link.time - ahead)


def _pose_at(link: Link, leading: Link | None, time: Ints) -> tuple[Floats, Floats]:
    """Positions (n, 3) and quaternions (n, 4) of a link at stamps.

    Between two changes of a correction, its share is that of the path of the leading link [m + rad]: so much
    of the drift had arisen. A change of more than that path, or after a long one, is a jump.
    """
    start = link.time[0]
    at, known = (time - start) * 1e-9, (link.time - start) * 1e-9
    if leading is None or link is leading or link.time.size == 1 or leading.time.size == 1:
        return interpolate_poses(at, known, link.position, link.quaternion)
    fresh = np.flatnonzero(~find_held(link.position, link.quaternion))
    before, after = fresh[:-1], fresh[1:]
    stamps = (leading.time - start) * 1e-9
    moved = np.diff(leading.position, axis=0)
    _, turned = measure_increments(leading.position, leading.quaternion)
    odometer = np.append(0.0, np.cumsum(np.linalg.norm(moved, axis=1) + np.linalg.norm(turned, axis=1)))
    path = np.interp(known, stamps, odometer)
    driven = path[after] - path[before]
    vehicle, _ = interpolate_poses(known[after], stamps, leading.position, leading.quaternion)
    old, new = (link.position[rows] + rotate(link.quaternion[rows], vehicle) for rows in (before, after))
    _, turn = measure_increments(link.position[fresh], link.quaternion[fresh])
    arose = np.linalg.norm(new - old, axis=1) + np.linalg.norm(turn, axis=1) < driven
    # What was confirmed over a longer path did not drift along it.
    arose &= driven < _LONGEST_PATH
    rows, here = (np.searchsorted(known[fresh], times, side="right") - 1 for times in (known, at))
    arose = np.append(arose, False)
    needed = ~arose[rows]
    needed[fresh] = True
    spread = arose[here]
    row = here[spread]
    share = (np.interp(at[spread], stamps, odometer) - path[before[row]]) / driven[row]
    at[spread] = known[before[row]] + share * (known[after[row]] - known[before[row]])
    return interpolate_poses(at, known[needed], link.position[needed], link.quaternion[needed])


def _clean(frame: str) -> str:
    return frame.lstrip("/")


def _base_name(topic: str) -> str:
    return topic.rstrip("/").rsplit("/", 1)[-1]
