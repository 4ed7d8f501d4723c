"""Poses of base_link in a fixed frame from pose topics, simulated bodies, or chains of transforms."""

import itertools
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from pipeline.core import Flags, Floats, Ints, name_first, rigid
from pipeline.logs import (
    TRANSFORM_TYPES,
    LogError,
    Ragged,
    RaggedStrings,
    TopicColumns,
    TransformBuffer,
    TransformSeries,
)
from pipeline.recording.findings import Finding, StageError
from pipeline.recording.topic_values import FEWEST_MESSAGES, PoseArrays, axis_fields, first_text
from pipeline.sources import PoseFields, PoseSource, Vehicle, VelocitySection, is_localization, plain_type

_BASE: Final = re.compile(r"(::|/)base(_link|_footprint)?$")
_MOVES_M: Final = 0.5
"""Extent of the positions [m] above which a body moves; the noise of bodies at rest is smaller."""
_SPARSE_S: Final = 1.0
"""Time between two corrections [s] above which they are sparse: two windows of velocities. AMCL comes to
0.3 s, slam_toolbox to 1 to 3 s."""


def read_bodies(
    columns: TopicColumns, pose: PoseFields, asked: str, vehicle: Vehicle
) -> tuple[PoseArrays, str]:
    """Poses of the vehicle, NaN in messages without it, and the name of its body.

    Args:
        columns: a topic of the type.
        pose: its fields.
        asked: configured name; otherwise the only body that moves, or the only one of those that is a base
            link or has the vehicle's name.
        vehicle: vehicle with its names.

    Raises:
        StageError: ``no_body``, no body is the vehicle, or several may be.
    """
    names = columns.fields[pose.names]
    if not isinstance(names, RaggedStrings):
        raise _no_body(columns.topic, "they have no names", ())
    values = np.stack(
        [
            _take_values(columns, field, names)
            for field in (*axis_fields(pose.position, "xyz"), *axis_fields(pose.orientation, "xyzw"))
        ],
        axis=-1,
    )
    code = _choose(names, values[:, :3], asked, vehicle, columns.topic)
    rows_of_body = np.flatnonzero(names.codes == code)
    rows = np.repeat(np.arange(len(names)), np.diff(names.offsets))[rows_of_body]
    series = np.full((len(names), 7), np.nan)
    series[rows] = values[rows_of_body]
    parent = first_text(columns, pose.parent) if pose.parent else pose.fixed
    return PoseArrays(series[:, :3], series[:, 3:], parent, ""), names.values[code]


def _take_values(columns: TopicColumns, field: str, names: RaggedStrings) -> Floats:
    """One number per body, messages concatenated; NaN if a message has fewer numbers than names."""
    column = columns.fields[field]
    values_out = np.full(names.codes.size, np.nan)
    if isinstance(column, Ragged):
        sizes = np.diff(names.offsets)
        whole = sizes == np.diff(column.offsets)
        there = np.repeat(whole, sizes)
        values_out[there] = column.values[np.repeat(whole, np.diff(column.offsets))]
    return values_out


def _choose(names: RaggedStrings, position: Floats, asked: str, vehicle: Vehicle, topic: str) -> int:
    every = {name: code for code, name in enumerate(names.values)}
    if asked:
        if asked not in every:
            raise _no_body(topic, f"none is called {asked!r}", names.values)
        return every[asked]
    words = [word.lower() for word in (vehicle.id, *vehicle.aliases, *vehicle.recognized_by)]
    moving = [name for name, code in every.items() if _reaches(position[names.codes == code])]
    bases = [name for name in moving if _BASE.search(name)] or moving
    called = [name for name in bases if any(word in name.lower() for word in words)]
    bodies = bases if len(bases) == 1 else called
    if len(bodies) != 1:
        why = "several of them move" if moving else "none of them moves"
        raise _no_body(topic, why, moving or list(names.values))
    return every[bodies[0]]


def _reaches(position: Floats) -> bool:
    known = position[np.isfinite(position).all(axis=1)]
    return known.size > 0 and float(np.ptp(known[:, :2], axis=0).max()) > _MOVES_M


def _no_body(topic: str, why: str, names: Sequence[str]) -> StageError:
    return StageError(
        "no_body",
        f"{topic} gives poses of {len(names)} bodies, and which is the vehicle is not known: {why}",
        where=topic,
        hint=f"Set it in run.toml: [pose] name = one of {name_first(names) or 'its bodies'}.",
    )


_UNIT_FORGIVEN = 1e-3
"""Deviation of a quaternion's length from one that is not reported: doubles and floats deviate by 1e-7, two
decimals by more."""
_FASTEST = 60.0
"""Speed [m/s] that no field robot reaches: a higher one is a jump of the pose."""


@dataclass(frozen=True)
class PoseTrack:
    """A series of poses cut into segments.

    Attributes:
        position: [m], shape (n, 3).
        quaternion: of unit length if valid, shape (n, 4).
        valid: finite poses with a usable quaternion, shape (n,).
        held: repeats of the previous pose.
        segment: number of the segment of each pose.
    """

    position: Floats
    quaternion: Floats
    valid: Flags
    held: Flags
    segment: Ints
    findings: tuple[Finding, ...] = field(default=())


POSE_FINDINGS: Final = frozenset({"bad_quaternion", "bad_pose", "poses_apart"})
"""Ids of the findings that count the poses that go to quarantine."""


def normalize_quaternions(quaternion: Floats, topic: str) -> tuple[Floats, Flags, list[Finding]]:
    """Scale quaternions (n, 4) to unit length; flag unusable ones and report large deviations from one."""
    # A number whose square overflows is infinite, and is not an orientation.
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(quaternion, axis=1)
    usable = np.isfinite(length) & (length > 1e-6)  # noqa: PLR2004 - an all-zero quaternion, up to rounding
    scaled = np.where(usable[:, None], quaternion / np.where(usable, length, 1.0)[:, None], quaternion)
    off = int((usable & (np.abs(length - 1.0) > _UNIT_FORGIVEN)).sum())
    findings = []
    if off:
        findings.append(Finding("quaternion_not_unit", "warning", topic, {"count": off}))
    bad = int((~usable).sum())
    if bad:
        findings.append(Finding("bad_quaternion", "warning", topic, {"count": bad}))
    return scaled, usable, findings


SLOW_HZ: Final = 4.0
"""Least rate of new poses [Hz]: fewer are insufficient for a velocity over 0.75 s."""


def cut_track(
    times: Floats,
    position: Floats,
    quaternion: Floats,
    clock_breaks: Flags,
    settings: VelocitySection,
    topic: str,
) -> PoseTrack:
    """Cut poses into segments at gaps, clock jumps and pose jumps, and flag held poses.

    Args:
        times: stamps [s], not decreasing, shape (n,).
        position: [m], shape (n, 3).
        quaternion: as recorded, shape (n, 4).
        clock_breaks: whether the clock jumped before a pose, shape (n,).
        settings: smallest gap and jumps.
        topic: for the findings.
    """
    unit, oriented, findings = normalize_quaternions(quaternion, topic)
    finite = np.isfinite(position).all(axis=1)
    lost = int((~finite & oriented).sum())
    if lost:
        findings.append(Finding("bad_pose", "warning", topic, {"count": lost}))
    valid = oriented & finite
    segment = np.zeros(times.size, dtype=np.int64)
    held = np.zeros(times.size, dtype=bool)
    good = np.flatnonzero(valid)
    if good.size == 0:
        return PoseTrack(position, unit, valid, held, segment, tuple(findings))
    t, p, q = times[good], position[good], unit[good]
    # A break before a pose that was left out moves to the next remaining one.
    counted = np.cumsum(clock_breaks)[good]
    clock = np.concatenate(([False], np.diff(counted) > 0))
    gaps = rigid.find_gaps(t, settings.gap_s)
    apart = _find_apart(t, p, q, gaps | clock, settings)
    if apart.any():
        findings.append(Finding("poses_apart", "warning", topic, {"count": int(apart.sum())}))
        position, valid[good[apart]] = position.copy(), False
        position[good[apart]] = np.nan
        good, t, p, q = good[~apart], t[~apart], p[~apart], q[~apart]
        gaps, clock = gaps[~apart], clock[~apart]
    held[good] = rigid.find_held(p, q)
    jumps = _find_pose_jumps(t, p, q, held[good], gaps | clock, settings)
    segment[good] = rigid.number_segments(gaps | clock | jumps)
    findings += _report_stamps(t, gaps, jumps, held[good], topic)
    return PoseTrack(position, unit, valid, held, segment, tuple(findings))


def _find_pose_jumps(
    t: Floats, p: Floats, q: Floats, held: Flags, breaks: Flags, settings: VelocitySection
) -> Flags:
    """Jumps between fresh poses of one uncut stretch, as flags over all poses."""
    jumps = np.zeros(t.size, dtype=bool)
    distinct = np.concatenate(([True], np.diff(t) > 0.0))
    for first, last in _stretches(breaks):
        keep = first + rigid.select_fresh_poses(t[first:last], held[first:last])
        keep = keep[distinct[keep]]
        if keep.size < 2:  # noqa: PLR2004 - one pose cannot jump
            continue
        jumped = rigid.find_jumps(
            t[keep], p[keep], q[keep], metres=settings.jump_m, radians=settings.jump_rad
        )
        too_fast = np.linalg.norm(np.diff(p[keep], axis=0), axis=1) > np.maximum(
            _FASTEST * np.diff(t[keep]), settings.jump_m
        )
        jumps[keep] = jumped | np.concatenate(([False], too_fast))
    return jumps


_BACK = 10
"""Largest number of poses of one publisher between two of the other, both counted."""
_ALTERNATES = 0.1
"""Share of steps between the tracks from which on poses alternate: fewer lie apart, or are noise."""
_RETURNS = (0.2, 0.6)
"""A pose returns if it lies nearer to one before the last than this part of its step; so do this many of the
steps between tracks. Of poses that are noise one in three returns by chance."""
_NEARER = 0.5
"""Distance to a pose's own track over that to the other, up to which it is clear whose it is."""
_MOST_UNCLEAR = 0.02
"""Share of poses that may be unclear, as where bodies pass each other."""
_GOES_ON_S = (0.02, 0.5)
"""Times [s] between two poses of a track that show its velocity."""


def find_tracks(times: Floats, position: Floats, smallest_m: float) -> Ints | None:
    """Two tracks between which poses jump to and fro, as of two publishers; None of a body's own poses.

    Nearly every pose lies far nearer to one of them than to the other.

    Args:
        times: stamps [s], not decreasing, shape (n,).
        position: [m], shape (n, 3).
        smallest_m: smallest jump [m].

    Returns:
        Number of the track of each pose, 1 or 2 by their first poses, shape (n,).
    """
    known = np.flatnonzero(np.isfinite(position[:, :2]).all(axis=1))
    places = position[known, 0] + 1j * position[known, 1]
    steps = np.abs(np.diff(places, prepend=places[:1]))
    nearest = np.full(places.size, np.inf)
    for back in range(2, min(_BACK, places.size - 1) + 1):
        nearest[back:] = np.minimum(nearest[back:], np.abs(places[back:] - places[:-back]))
    is_far = steps > smallest_m
    returns = is_far & (nearest < _RETURNS[0] * steps)
    far = np.flatnonzero(is_far)
    if returns.sum() < max(FEWEST_MESSAGES, _ALTERNATES * steps.size, _RETURNS[1] * far.size):
        return None
    # The second track begins where the poses went that came back first.
    begins = int(far[np.searchsorted(far, np.flatnonzero(returns)[0]) - 1])
    number, is_unclear = _follow_tracks(times[known].tolist(), places.tolist(), begins, smallest_m)
    if np.mean(is_unclear) > _MOST_UNCLEAR or np.mean(np.diff(number) != 0) < _ALTERNATES:
        return None
    numbers = np.ones(position.shape[0], dtype=np.int64)
    numbers[known] = number
    return numbers


def _follow_tracks(
    times: Sequence[float], places: Sequence[complex], begins: int, smallest_m: float
) -> tuple[Ints, Flags]:
    """Number of the track that each pose goes on, by its velocity, and whether it is unclear."""
    number, is_unclear = np.ones(len(places), dtype=np.int64), np.zeros(len(places), dtype=bool)
    last = [begins - 1, begins]
    pace = [0j, 0j]
    for row in range(begins, len(places)):
        away = [
            abs(places[row] - places[one] - rate * (times[row] - times[one]))
            for one, rate in zip(last, pace, strict=True)
        ]
        own = int(away[1] < away[0])
        is_apart = abs(places[last[0]] - places[last[1]]) > smallest_m
        is_unclear[row] = is_apart and away[own] > _NEARER * away[1 - own]
        elapsed = times[row] - times[last[own]]
        if elapsed > _GOES_ON_S[0]:
            is_near = elapsed < _GOES_ON_S[1]
            pace[own] = (places[row] - places[last[own]]) / elapsed if is_near else 0j
        last[own], number[row] = row, own + 1
    return number, is_unclear


def choose_track(tracks: Ints | None, source: PoseSource) -> Ints:
    """Rows of the poses of one track.

    Raises:
        StageError: ``no_track``, the poses are those of one body.
    """
    if tracks is None:
        what = f"run.toml names a track, and the poses of {source} do not alternate between two of them"
        raise StageError("no_track", what, where=source.topic, hint="Leave out `track` of [pose].")
    return np.flatnonzero(tracks == source.track)


_APART = 3
"""Greatest number of poses in a row that lie apart: more are a map that was corrected for a while."""
_REPEATED = 0.05
"""Share of poses that repeat the one before, from which on a late localization that catches up lies apart."""
_FAST = 3.0
"""Change over the usual largest one, beside the smallest jump, up to which a pose may go on."""


def _find_apart(t: Floats, p: Floats, q: Floats, breaks: Flags, settings: VelocitySection) -> Flags:
    """Poses that lie away from those before them, and from those after them, which go on, as flags."""
    apart, last = np.zeros(t.size, dtype=bool), t.size - 1
    if t.size < FEWEST_MESSAGES or rigid.find_held(p, q).mean() > _REPEATED:
        return apart
    stretch, spans = np.cumsum(breaks), np.diff(t)
    least = np.array([settings.jump_m, settings.jump_rad])

    def measure(places: int) -> Floats:
        """Distance and angle from each pose to one so many places later, shape (n - places, 2) [m, rad]."""
        increments = rigid.measure_increments(p, q, places)
        return np.column_stack([np.linalg.norm(one, axis=1) for one in increments])

    moves = spans > 0.0
    if not moves.any():
        return apart
    usual = np.quantile(measure(1)[moves] / spans[moves, None], 0.9, axis=0)

    def is_far(places: int) -> Flags:
        limits = least + _FAST * usual * (t[places:] - t[:-places])[:, None]
        return np.asarray((measure(places) > limits).any(axis=1) | (stretch[places:] != stretch[:-places]))

    steps = is_far(1)
    for count in range(1, _APART + 1):
        away = steps[: last - count] & steps[count:] & ~is_far(count + 1)
        for number in range(count):
            apart[np.flatnonzero(away) + 1 + number] = True
    return apart


def _stretches(breaks: Flags) -> list[tuple[int, int]]:
    edges = [0, *np.flatnonzero(breaks).tolist(), breaks.size]
    return [(a, b) for a, b in itertools.pairwise(edges) if b > a]


def _report_stamps(t: Floats, gaps: Flags, jumps: Flags, held: Flags, topic: str) -> list[Finding]:
    findings = []
    if gaps.any():
        lengths = np.diff(t)[gaps[1:]]
        count, longest = int(lengths.size), float(lengths.max())
        findings.append(Finding("pose_gap", "info", topic, {"value": longest, "count": count}))
    if jumps.any():
        where = float(t[np.flatnonzero(jumps)[0]])
        findings.append(Finding("pose_jump", "warning", topic, {"count": int(jumps.sum())}, t_start=where))
    fresh = rigid.select_fresh_poses(t, held)
    period = float(np.median(np.diff(t[fresh]))) if fresh.size > 1 else 0.0
    if period * SLOW_HZ > 1.0:
        findings.append(Finding("slow_poses", "warning", topic, {"value": period}))
    # A vehicle at rest repeats its pose, too.
    share = 1.0 - fresh.size / held.size
    if share > 0.05:  # noqa: PLR2004 - fewer repeats are chance
        values = {"value": share, "count": held.size - fresh.size}
        findings.append(Finding("held_poses", "info", topic, values))
    return findings


def move_to_base(position: Floats, quaternion: Floats, offset: Floats, turn: Floats) -> tuple[Floats, Floats]:
    """Poses of base_link from poses of a frame fixed to it.

    Args:
        position: of the child frame [m], shape (n, 3).
        quaternion: of the child frame, unit length, shape (n, 4).
        offset: position of base_link in the child frame [m], shape (3,).
        turn: quaternion of base_link in the child frame, shape (4,).
    """
    lever = np.broadcast_to(offset, position.shape)
    moved = position + rigid.rotate(quaternion, lever)
    return moved, rigid.multiply_quaternions(quaternion, np.broadcast_to(turn, quaternion.shape))


_TURNED: Final = 1e-9
"""Change of a quaternion that shows a measured heading: a smaller one is rounding."""
_ACROSS_M: Final = 0.5
"""Sideways displacement [m] above which a constant orientation is not that of the vehicle."""


def lacks_heading(arrays: PoseArrays) -> bool:
    """Whether poses move across their one constant direction, so that only the positions are measured."""
    there = np.isfinite(arrays.position).all(axis=1)
    quaternion, position = arrays.quaternion[there], arrays.position[there, :2]
    if position.shape[0] < FEWEST_MESSAGES or not np.ptp(quaternion, axis=0).max() < _TURNED:
        return False
    yaw = float(rigid.euler_from_quaternions(quaternion[:1])[2][0]) if quaternion[0].any() else 0.0
    return bool(np.ptp(position @ np.array([-np.sin(yaw), np.cos(yaw)])) > _ACROSS_M)


_BASES = ("base_link", "base_footprint", "base")
_FIXED = ("map", "world", "odom")
_REFERENCE: Final = re.compile(r"(map|world|odom)")
"""Start of the names of reference frames: ``odom_combined`` moves as it is corrected."""


def is_transforms(columns: TopicColumns) -> bool:
    """Whether a topic contains transforms."""
    return plain_type(columns.type_name) in TRANSFORM_TYPES


def chain_poses(
    topics: Sequence[TopicColumns], source: PoseSource, where: str, *, drive: str = ""
) -> TransformSeries:
    """Poses of base_link along the chain of transforms.

    Without configured frames the child is base_link (or base_footprint, base), else the only frame that
    moves, or the only one in the namespace of the drive; of several robots it is that of the drive's
    namespace, or else the first. The parent is the first of map, world and odom among
    the child's ancestors, else its topmost ancestor.

    Args:
        topics: all topics that were read; the transforms among them are used.
        source: the choice, with frames if configured.
        where: the log, for error messages.
        drive: topic of the drive.

    Raises:
        StageError: the frames do not exist or are not connected.
    """
    buffer = TransformBuffer([columns for columns in topics if is_transforms(columns)])
    parent, child = source.frames or _choose_frames(buffer, where, drive)
    try:
        return buffer.lookup_series(parent, child)
    except LogError as error:
        raise StageError(error.code, error.what, where=where, hint=error.hint) from error


def _choose_frames(buffer: TransformBuffer, where: str, drive: str) -> tuple[str, str]:
    parents = {link.child: link.parent for link in buffer.links()}
    frames = buffer.frames()
    bases = _list_bases(frames, drive)
    child = bases[0] if bases else _find_moving_frame(buffer, where, drive)
    above = _climb(parents, child)
    named = [frame for fixed in _FIXED for frame in above[1:] if frame.rsplit("/", 1)[-1] == fixed]
    if not named and len(above) == 1:
        hint = f"Name both: [pose] frames = [parent, child]. Known frames: {', '.join(frames)}."
        raise StageError("no_base_frame", f"the transforms give {child} no parent", where=where, hint=hint)
    return (named[0] if named else above[-1]), child


def _list_bases(frames: Sequence[str], drive: str) -> list[str]:
    """Frames of bases, those of the robot in whose namespace the drive is first."""
    spaces = drive.strip("/").split("/")[:-1]
    prefixed = {f"{space}_{base}" for space in spaces for base in _BASES}
    bases = [frame for base in _BASES for frame in frames if frame.rsplit("/", 1)[-1] == base]
    bases += [frame for frame in frames if frame.rsplit("/", 1)[-1] in prefixed]
    # The base of an arm on a robot has a longer name than its own.
    return sorted(bases, key=lambda frame: (not _is_within(frame, spaces), frame.count("/")))


def _is_within(frame: str, spaces: Sequence[str]) -> bool:
    """Whether a frame is of a robot in one of the namespaces, by its prefix."""
    return any(space in frame.split("/")[:-1] or frame.startswith(f"{space}_") for space in spaces)


def _find_moving_frame(buffer: TransformBuffer, where: str, drive: str) -> str:
    """The only frame that moves, or of several the only one in the namespace of the drive's topic."""
    moving = [
        link.child
        for link in buffer.links()
        if not link.fixed and _reaches(link.position) and not _REFERENCE.match(link.child.rsplit("/", 1)[-1])
    ]
    space = drive.strip("/").partition("/")[0] + "/"
    chosen = moving if len(moving) == 1 else [frame for frame in moving if frame.startswith(space)]
    if len(chosen) != 1:
        moved = f"several frames move ({name_first(moving)})" if moving else "no frame moves"
        raise StageError(
            "no_base_frame",
            f"the transforms have no frame called base_link, base_footprint or base, and {moved}",
            where=where,
            hint="Name both: [pose] frames = [parent, child]. "
            f"Known frames: {', '.join(buffer.frames()) or 'none'}.",
        )
    return chosen[0]


def report_chain(
    series: TransformSeries, source: PoseSource, topics: Sequence[TopicColumns], drive: str
) -> list[Finding]:
    """Findings on a chain.

    Args:
        series: the chain.
        source: the choice, with frames if configured.
        topics: all topics that were read.
        drive: topic of the drive.
    """
    topic = source.topic
    findings = [Finding("transforms", "info", topic, {"parent": series.parent, "child": series.child})]
    findings += [] if source.frames else _report_robots(series.child, topics, topic, drive)
    if source.frames is None and series.child.rsplit("/", 1)[-1] not in _BASES:
        findings.append(Finding("vehicle_frame", "info", topic, {"frame": series.child}))
    if series.parent.rsplit("/", 1)[-1] == "odom":
        findings.append(Finding("pose_is_odometry", "warning", topic, {"kind": "transforms"}))
    if (often := rigid.measure_period(1e-9 * series.time[series.corrected].astype(np.float64))) > _SPARSE_S:
        findings.append(Finding("sparse_corrections", "info", topic, {"period_s": often}))
    return findings + [Finding("transform_note", "info", topic, {"note": note}) for note in series.notes]


def _report_robots(child: str, topics: Sequence[TopicColumns], topic: str, drive: str) -> list[Finding]:
    """A finding where the transforms are of several robots: which one is taken, and why."""
    buffer = TransformBuffer([one for one in topics if is_transforms(one)])
    parents = {link.child: link.parent for link in buffer.links()}
    bases = [frame for frame in _list_bases(buffer.frames(), drive) if _end_of(frame) == _end_of(child)]
    # The base of an arm on the robot is below its own.
    others = [frame for frame in bases if child not in _climb(parents, frame)]
    if not others:
        return []
    is_own = _is_within(child, drive.strip("/").split("/")[:-1])
    values = {
        "kind": "of the command" if is_own else "undecided",
        "frames": sorted((child, *others)),
        "child": child,
        "drive": drive,
        "count": 1 + len(others),
    }
    return [Finding("several_robots", "info" if is_own else "warning", topic, values)]


def _end_of(frame: str) -> str:
    """The base's own name at the end of a frame's."""
    name = frame.rsplit("/", 1)[-1]
    return next((base for base in _BASES if name == base or name.endswith(f"_{base}")), name)


def _climb(parents: Mapping[str, str], frame: str) -> list[str]:
    """A frame and all above it."""
    above = [frame]
    while parents.get(above[-1]) is not None and parents[above[-1]] not in above:
        above.append(parents[above[-1]])
    return above


def report_frame(topic: str, parent: str) -> list[Finding]:
    """Report poses that may be odometry, by their frame and the topic's name."""
    if parent.rsplit("/", 1)[-1] != "odom" or is_localization(topic):
        return []
    return [Finding("pose_is_odometry", "warning", topic, {"kind": "topic", "parent": parent})]


def to_base_link(
    arrays: PoseArrays, topics: Sequence[TopicColumns], topic: str
) -> tuple[PoseArrays, list[Finding]]:
    """Move poses of another frame of the vehicle to base_link, through the static transforms.

    Without a static transform the poses are used unchanged, and this is reported.
    """
    child = arrays.child.lstrip("/")
    if not child or child.rsplit("/", 1)[-1] in _BASES:
        return arrays, []
    base, offset = _find_base(topics, child)
    if offset is None:
        return arrays, [Finding("child_frame", "warning", topic, {"kind": "pose unplaced", "frame": child})]
    # Faults of an orientation are reported where the track is cut.
    unit, good, _ = normalize_quaternions(arrays.quaternion, topic)
    position, quaternion = arrays.position.copy(), arrays.quaternion.copy()
    position[good], quaternion[good] = move_to_base(
        arrays.position[good], unit[good], offset.position[0], offset.quaternion[0]
    )
    moved = PoseArrays(position, quaternion, arrays.parent, base)
    return moved, [Finding("child_frame", "info", topic, {"kind": "pose moved", "frame": child})]


def find_antenna(topics: Sequence[TopicColumns], frame: str, topic: str) -> tuple[Floats, list[Finding]]:
    """Position of an antenna in base_link [m], shape (3,); zero without a static transform.

    Args:
        topics: all topics that were read.
        frame: of the antenna, in the headers of its topic.
        topic: that topic.
    """
    _, offset = _find_base(topics, frame.lstrip("/"))
    if offset is None:
        values = {"kind": "antenna unplaced", "frame": frame}
        return np.zeros(3), [Finding("child_frame", "warning", topic, values)]
    lever = -rigid.rotate(rigid.invert_quaternions(offset.quaternion), offset.position)[0]
    placed = {"kind": "antenna moved", "ahead_m": float(lever[0]), "left_m": float(lever[1])}
    return lever, [Finding("child_frame", "info", topic, placed)]


def find_turn(topics: Sequence[TopicColumns], frame: str) -> Floats | None:
    """Orientation of base_link in the frame of a sensor, shape (4,); None without a static transform.

    Args:
        topics: all topics that were read.
        frame: of the sensor, in the headers of its topic.
    """
    _, offset = _find_base(topics, frame.lstrip("/"))
    return None if offset is None else offset.quaternion[0]


def _find_base(topics: Sequence[TopicColumns], child: str) -> tuple[str, TransformSeries | None]:
    """The base's frame and its pose in a frame of the vehicle; None without a chain of static transforms."""
    buffer = TransformBuffer([columns for columns in topics if is_transforms(columns)])
    # Of several robots, static transforms lead to the base of the child's own.
    bases = [frame for frame in buffer.frames() if frame.rsplit("/", 1)[-1] == _BASES[0]]
    for base in bases:
        with suppress(LogError):
            offset = buffer.lookup_series(child, base, at=np.zeros(1, dtype=np.int64))
            if offset.position.shape[0]:
                return base, offset
    return next(iter(bases), ""), None
