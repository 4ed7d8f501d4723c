"""Where on Earth a run was driven: read from its log again, if it is still there."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.arrays import Floats, interpolate_linearly
from pipeline.core.program import SlipError
from pipeline.job.keys import find_recorded_log
from pipeline.job.options import JobError
from pipeline.logs import TopicColumns, Wanted, open_log, read_topics
from pipeline.sources.message_types import find_type
from pipeline.stages.reading import read_fixes
from pipeline.stages.satellite import to_local_plane

if TYPE_CHECKING:
    from pipeline.logs import LogIndex
    from pipeline.store import Manifest

_FEWEST = 20
"""Fixes that a run must have."""
_ROUNDS = 3
_OUTLIERS = 3.0
"""Times the median distance beyond which a fix is a reflection."""
WORST_FIT_M = 3.0
"""Median distance between poses and fixes beyond which they do not say the same: that of a plain receiver."""
_LEAST_EXTENT = 5.0
"""Times that distance by which a run must extend: a run on the spot has no direction on Earth."""
_SITE_M = 20_000.0
"""Runs that are nearer than this are on one plane."""
_ANCHOR_DIGITS = 2
"""Of a degree: maps of one site that are made at different times have the same cells."""


@dataclass(frozen=True)
class Beside:
    """What a log holds beside what a run was made of.

    Attributes:
        times: of the fixes [s] since the run's start, shape (n,).
        fixes: latitude, longitude [deg] and altitude [m], shape (n, 3).
        reason: why there is nothing; empty where it could be read.
    """

    times: Floats = field(default_factory=lambda: np.zeros(0))
    fixes: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    reason: str = ""


def read_beside(manifest: Manifest) -> Beside:
    """Fixes of a run out of its log.

    A log that has gone, or is another one by now, is not read; then the reason says so.
    """
    try:
        path = find_recorded_log(manifest, hint="Analyze it where it is now.")
        index = open_log(path)
        wanted = _list_wanted(index)
        if not wanted:
            return Beside(reason="its log has no fixes of satellites")
        data = read_topics(index, wanted)
        if data.sha256 != manifest.part("log").get("sha256"):
            what = "the log is another one than the run was made of"
            raise JobError("log_changed", what, where=str(path), hint="Analyze it again.")
    except SlipError as error:
        return Beside(reason=error.what)
    start = manifest.part("stages", "extract", "context").get("start_ns")
    begin = start if isinstance(start, int) else index.start_ns
    fixes = _join([_take_fixes(one, begin) for one in data.topics if find_type(one.type_name).fix], 4)
    reason = "" if fixes.size else "its log has no fixes of satellites"
    return Beside(fixes[:, 0], fixes[:, 1:], reason)


def _list_wanted(index: LogIndex) -> list[Wanted]:
    wanted: dict[str, tuple[str, ...]] = {}
    for channel in index.channels:
        kind = find_type(channel.type_name)
        if kind.fix is not None:
            wanted[channel.topic] = (
                kind.fix.latitude,
                kind.fix.longitude,
                kind.fix.altitude,
                kind.fix.status,
            )
    return [Wanted(topic, fields) for topic, fields in wanted.items()]


def _join(parts: list[Floats], width: int) -> Floats:
    """The topic with the most rows: several receivers are not mixed."""
    return max(parts, key=len, default=np.zeros((0, width)))


def _find_times(columns: TopicColumns, start_ns: int) -> Floats:
    """Seconds since the run's start, by the header's stamps where they are in the run's clock."""
    header = columns.header_time
    recorded: Floats = np.asarray((columns.log_time - start_ns) * 1e-9, dtype=np.float64)
    if header is None or not header.size:
        return recorded
    stamped: Floats = np.asarray((header - start_ns) * 1e-9, dtype=np.float64)
    return stamped if abs(float(np.median(stamped - recorded))) < 1.0 else recorded


def _take_fixes(columns: TopicColumns, start_ns: int) -> Floats:
    latitude, longitude, altitude, there = read_fixes(columns)
    rows = np.column_stack((_find_times(columns, start_ns), latitude, longitude, altitude))
    return _sort(rows[there])


def _sort(rows: Floats) -> Floats:
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    new: Floats = rows[np.diff(rows[:, 0], prepend=-math.inf) > 0.0]
    return new


@dataclass(frozen=True)
class RunFrame:
    """Where a run's map lies in a frame that it shares with others.

    Attributes:
        frame: its name.
        anchor: latitude and longitude [deg] of the frame's origin; None of a frame that is not on Earth.
        turn: by which the run's map is turned [rad].
        east, north: place of the run's origin in the frame [m].
        distance_m: median distance between poses and fixes; NaN where none were needed.
    """

    frame: str
    anchor: tuple[float, float] | None = None
    turn: float = 0.0
    east: float = 0.0
    north: float = 0.0
    distance_m: float = math.nan

    def move(self, position: Floats) -> Floats:
        """Places of the run's map [m], shape (n, 2), in the frame."""
        moved = (position[:, 0] + 1j * position[:, 1]) * np.exp(1j * self.turn)
        return np.stack((moved.real + self.east, moved.imag + self.north), axis=1)


def find_anchor(beside: Beside, anchors: list[tuple[float, float]]) -> tuple[float, float]:
    """The origin of the plane that a run is put on: one that is near, else a new one, which is added."""
    latitude, longitude = np.median(beside.fixes[:, :2], axis=0).tolist()
    for anchor in anchors:
        both = np.array([anchor, (latitude, longitude)])
        away = to_local_plane(both[:, 0], both[:, 1], np.zeros(2))[1]
        if math.hypot(*away[:2]) < _SITE_M:
            return anchor
    anchors.append((round(latitude, _ANCHOR_DIGITS), round(longitude, _ANCHOR_DIGITS)))
    return anchors[-1]


def locate_on_earth(
    times: Floats, position: Floats, beside: Beside, anchor: tuple[float, float]
) -> RunFrame | str:
    """Where a run's map lies on the plane about an anchor, or why that is not known.

    A turn and a shift by least squares between poses and fixes (Horn, 1987, in the plane), reflections left
    out by their distance.

    Args:
        times: of the poses [s], increasing, shape (n,).
        position: of base_link in the run's map [m], shape (n, 2); NaN where it is not known.
        beside: fixes, at least one.
        anchor: latitude and longitude [deg] of the plane's origin.
    """
    known = np.isfinite(position).all(axis=1)
    times, position = times[known], position[known]
    inside = (beside.times >= times.min(initial=np.inf)) & (beside.times <= times.max(initial=-np.inf))
    if np.count_nonzero(inside) < _FEWEST:
        return "its poses and its fixes do not share a time"
    fixes = np.concatenate(([[*anchor, beside.fixes[0, 2]]], beside.fixes[inside]))
    there = to_local_plane(*fixes.T)[1:, :2]
    here = interpolate_linearly(beside.times[inside], times, position)
    one, other = here[:, 0] + 1j * here[:, 1], there[:, 0] + 1j * there[:, 1]
    inliers = np.ones(one.size, dtype=bool)
    turn, shift, away = 1.0 + 0.0j, 0.0j, np.zeros(one.size)
    for _ in range(_ROUNDS):
        middles = one[inliers].mean(), other[inliers].mean()
        product = np.sum(np.conj(one[inliers] - middles[0]) * (other[inliers] - middles[1]))
        turn = product / max(abs(product), 1e-12)
        shift = middles[1] - turn * middles[0]
        away = np.abs(other - turn * one - shift)
        inliers = away <= max(_OUTLIERS * float(np.median(away)), 1e-6)
    distance = float(np.median(away))
    extent = float(np.sqrt(np.mean(np.abs(one[inliers] - one[inliers].mean()) ** 2)))
    if distance > WORST_FIT_M:
        return f"its poses and its fixes are {distance:.1f} m apart"
    if extent < _LEAST_EXTENT * distance:
        return f"it extends over {extent:.1f} m only, and its fixes are {distance:.1f} m off"
    name = f"earth {anchor[0]:.2f} {anchor[1]:.2f}"
    return RunFrame(name, anchor, float(np.angle(turn)), float(shift.real), float(shift.imag), distance)


def name_map(manifest: Manifest) -> str | None:
    """The map that the configuration says a run's poses are in; None where it says none."""
    run = manifest.part("configuration").get("run")
    name = run.get("map") if isinstance(run, Mapping) else None
    return str(name) if name else None
