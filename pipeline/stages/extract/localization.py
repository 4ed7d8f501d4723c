"""Poses of base_link in a fixed frame, from a pose topic or from transforms."""

import itertools
from dataclasses import dataclass, field

import numpy as np

from pipeline.core import rigid, segments
from pipeline.core.arrays import Flags, Floats, Ints
from pipeline.stages.finding import Finding
from pipeline.vehicles.configuration import VelocitySection

_UNIT_FORGIVEN = 1e-3
_FASTEST = 60.0


@dataclass(frozen=True)
class Track:
    """A series of poses cut into segments.

    Attributes:
        position: [m], shape (n, 3).
        quaternion: unit length where valid, shape (n, 4).
        valid: poses that are numbers with a quaternion, shape (n,).
        held: repeats of the pose before.
        segment: number of the segment of each pose.
    """

    position: Floats
    quaternion: Floats
    valid: Flags
    held: Flags
    segment: Ints
    findings: tuple[Finding, ...] = field(default=())


def normalize_quaternions(quaternion: Floats, topic: str) -> tuple[Floats, Flags, list[Finding]]:
    """Scale quaternions (n, 4) to unit length; say which are none at all and which were far from it."""
    # What is too large to be squared is infinite, and no orientation.
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(quaternion, axis=1)
    usable = np.isfinite(length) & (length > 1e-6)  # noqa: PLR2004 - an all-zero quaternion, up to rounding
    scaled = np.where(usable[:, None], quaternion / np.where(usable, length, 1.0)[:, None], quaternion)
    off = int((usable & (np.abs(length - 1.0) > _UNIT_FORGIVEN)).sum())
    findings = []
    if off:
        text = f"{off} quaternions of {topic} were not of unit length: they were normalised"
        findings.append(Finding("quaternion_not_unit", "warning", text, where=topic, count=off))
    bad = int((~usable).sum())
    if bad:
        text = f"{bad} poses of {topic} have no orientation (a zero quaternion or not a number): quarantined"
        findings.append(Finding("bad_quaternion", "warning", text, where=topic, count=bad))
    return scaled, usable, findings


def cut_track(
    times: Floats,
    position: Floats,
    quaternion: Floats,
    clock_breaks: Flags,
    settings: VelocitySection,
    topic: str,
) -> Track:
    """Cut poses into segments at holes, clock jumps and pose jumps, and flag held poses.

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
        text = f"{lost} poses of {topic} are not numbers: quarantined"
        findings.append(Finding("bad_pose", "warning", text, where=topic, count=lost))
    valid = oriented & finite
    segment = np.zeros(times.size, dtype=np.int64)
    held = np.zeros(times.size, dtype=bool)
    good = np.flatnonzero(valid)
    if good.size == 0:
        return Track(position, unit, valid, held, segment, tuple(findings))
    t, p, q = times[good], position[good], unit[good]
    held[good] = segments.find_held(p, q)
    # A break before a pose that was left out belongs to the next one that stayed.
    counted = np.cumsum(clock_breaks)[good]
    clock = np.concatenate(([False], np.diff(counted) > 0))
    gaps = segments.find_gaps(t, settings.gap_s)
    jumps = _find_pose_jumps(t, p, q, held[good], gaps | clock, settings)
    segment[good] = segments.number_segments(gaps | clock | jumps)
    findings += _describe(t, gaps, jumps, held[good], topic)
    return Track(position, unit, valid, held, segment, tuple(findings))


def _find_pose_jumps(
    t: Floats, p: Floats, q: Floats, held: Flags, breaks: Flags, settings: VelocitySection
) -> Flags:
    """Jumps between fresh poses of one uncut stretch, as flags over all poses."""
    jumps = np.zeros(t.size, dtype=bool)
    distinct = np.concatenate(([True], np.diff(t) > 0.0))
    for first, last in _stretches(breaks):
        keep = first + segments.select_fresh_poses(t[first:last], held[first:last])
        keep = keep[distinct[keep]]
        if keep.size < 2:  # noqa: PLR2004 - one pose cannot jump
            continue
        found = segments.find_jumps(
            t[keep], p[keep], q[keep], metres=settings.jump_m, radians=settings.jump_rad
        )
        too_fast = np.linalg.norm(np.diff(p[keep], axis=0), axis=1) > np.maximum(
            _FASTEST * np.diff(t[keep]), settings.jump_m
        )
        jumps[keep] = found | np.concatenate(([False], too_fast))
    return jumps


def _stretches(breaks: Flags) -> list[tuple[int, int]]:
    edges = [0, *np.flatnonzero(breaks).tolist(), breaks.size]
    return [(a, b) for a, b in itertools.pairwise(edges) if b > a]


def _describe(t: Floats, gaps: Flags, jumps: Flags, held: Flags, topic: str) -> list[Finding]:
    findings = []
    if gaps.any():
        holes = np.diff(t)[gaps[1:]]
        text = (
            f"{holes.size} holes in the poses of {topic}, the longest {holes.max():.3g} s: segments end there"
        )
        findings.append(
            Finding("pose_gap", "info", text, where=topic, value=float(holes.max()), count=int(holes.size))
        )
    if jumps.any():
        count = int(jumps.sum())
        text = (
            f"the pose of {topic} jumped {count} times (the map was corrected, or a late localization "
            "caught up): segments end there"
        )
        where = float(t[np.flatnonzero(jumps)[0]])
        findings.append(Finding("pose_jump", "warning", text, where=topic, t_start=where, count=count))
    share = float(held.mean())
    if share > 0.05:  # noqa: PLR2004 - fewer repeats are chance
        text = f"{share:.0%} of the poses of {topic} repeat the one before: the localization is slower"
        findings.append(Finding("held_poses", "info", text, where=topic, value=share, count=int(held.sum())))
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
