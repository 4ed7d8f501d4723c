"""Choice of the pose by its frame and content, and the geometry of an unidentified vehicle.

Every candidate is extracted as in an analysis. Compared are its frame, the rate and coverage of new poses,
whether it moves at all, and mainly whether it is computed from the wheels: then it never moves sideways, and
the path of the wheels explains its path.

What is not known of a candidate never speaks for it, so that a log of which a part is lost accepts nothing
that the whole one refuses: a pose that never moves sideways is computed from the wheels unless enough is
recorded to show another path, and in the frame of an odometry it is so by where it comes from.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import polars as pl

from pipeline.core import Floats, SlipError, arrays, fit_robustly, format_share, rigid
from pipeline.recording.drive import read_speed
from pipeline.recording.extract import Extracted, Extraction, Given
from pipeline.recording.findings import Finding
from pipeline.recording.pose_topics import SLOW_HZ
from pipeline.recording.satellite import estimate_noise
from pipeline.recording.topic_values import FEWEST_MESSAGES
from pipeline.run import SPAN_S, STILL_MPS
from pipeline.sources import (
    DEAD_RECKONED,
    FILTERED,
    PoseContent,
    PoseSource,
    Sources,
    Vehicle,
    is_localization,
)

_FIXED_FRAME: Final = re.compile(
    r"(^|/)(map|world|earth|utm|enu|global|camera_init|mocap|vicon)$|lidar|slam|gps|gnss|local_origin"
)
_ODOMETRY_FRAME: Final = re.compile(r"odom")
_FROM_WHEELS: Final = 0.02
"""Fraction of the path that wheels do not explain, below which a pose may be computed from them: 4 mm of a
localization's noise are as much of 0.2 m, the path of half a second at 0.4 m/s."""
_NEXT: Final = 1.5
"""Time between two poses over the usual one up to which none is missing between them."""
_CHANCE: Final = 2.3
"""Twice the relative standard deviation of the median of a single absolute residual: that of n of them is
smaller by the square root of n."""
_SIDEWAYS_MPS: Final = 2e-3
"""Sideways speed [m/s] below which a pose may be computed from the wheels: a localization has more noise."""
_ASTRAY: Final = 0.3
"""Fraction of a pose's turning that may differ from the gyro's: its noise, and the loss of a tilted gyro."""
_SPARSE: Final = 0.5
"""Coverage of the log below which a topic often lacks poses."""
_STILL_M: Final = 1e-4
"""Displacement [m] that counts as none: rounding of a constant position."""
_TURNS_RAD: Final = 0.2
"""Change of heading [rad] above which a vehicle moves even if its position is constant."""
_DRIVES_M: Final = 1.0
"""Wheel path [m] above which a vehicle moves even if its position is constant."""
_NOISY_MPS: Final = 0.1
"""Noise of the speed over half a second [m/s] above which a receiver's velocities are preferable."""


@dataclass(frozen=True)
class PoseRating:
    """Rating of a candidate for the pose.

    Attributes:
        source: the candidate.
        parent, child: frames, if recorded.
        rate_hz: new poses per second, without repeats.
        coverage: fraction of the log's time with new poses.
        beside_wheels: fraction of its path that the wheels do not explain; None if not determinable.
        from_wheels: whether it is computed from the wheels.
        score: higher is better.
        reason: as text.
        refusal: why it is unusable; empty if it is usable.
        stands: whether it is unusable since it never changes.
        time: of its positions [s], shape (n,), until copies are found.
        position: its positions [m], shape (n, 2), as long.
        same_as: a topic with the same positions, wheel odometry or the best candidate; empty without one.
    """

    source: PoseSource
    parent: str = ""
    child: str = ""
    rate_hz: float = 0.0
    coverage: float = 0.0
    beside_wheels: float | None = None
    from_wheels: bool = False
    score: float = 0.0
    reason: str = ""
    refusal: str = ""
    stands: bool = False
    time: Floats | None = None
    position: Floats | None = None
    same_as: str = ""

    def format_line(self) -> str:
        """One line."""
        if self.refusal:
            return f"{self.source}: refused, {self.refusal}"
        frames = f"{self.parent or '?'} -> {self.child or '?'}"
        share = f"new poses at {self.rate_hz:.3g} Hz, {format_share(self.coverage)} of the time"
        return f"{self.source}: {frames}, {share}; {self.reason}"


def rate_poses(given: Given) -> tuple[PoseRating, ...]:
    """Candidates for the pose of a log, the best first.

    Any vehicle of its kind will do: gains do not matter.
    """
    sources = given.sources
    if sources.pose is None:
        return ()
    others = [source for source in sources.others.get("pose", ()) if isinstance(source, PoseSource)]
    ratings = sorted(
        (_rate(given, one) for one in (sources.pose, *others)),
        key=lambda rating: (bool(rating.refusal), -rating.score, -rating.rate_hz),
    )
    rated = [_find_copy(one, ratings) for one in ratings]
    best = rated[0]
    driven = {signal.topic for drive in sources.rank_drives("wheels") for signal in drive.signals}
    for number, one in enumerate(rated[1:], start=1):
        if not best.from_wheels and one.source.topic in driven and _are_copies(best, one):
            rated[number] = replace(one, same_as=str(best.source))
    return tuple(replace(one, time=None, position=None) for one in rated)


_COPIED: Final = 0.9
"""Share of positions that two topics have in common if one is a copy of the other."""


def _find_copy(rating: PoseRating, ratings: Sequence[PoseRating]) -> PoseRating:
    """The rating of a pose that an odometry of the wheels, by its name, publishes as well."""
    reckoned = [one for one in ratings if one is not rating and DEAD_RECKONED.search(str(one.source).lower())]
    if not reckoned or not _ODOMETRY_FRAME.search(rating.parent.lower()):
        return rating
    for other in reckoned:
        if _are_copies(rating, other):
            reason = f"the same positions as {other.source}, by its name an odometry of the wheels"
            return replace(rating, from_wheels=True, same_as=str(other.source), reason=reason)
    return rating


def _are_copies(one: PoseRating, other: PoseRating) -> bool:
    """Whether another candidate has the positions of one, to a micrometre; none is one that is refused.

    Where both have poses of the same times, these are compared: of two topics of a damaged log different
    messages are left.
    """
    if one.time is None or one.position is None or other.time is None or other.position is None:
        return False
    position, there = one.position, other.position
    shared = np.isin(np.round(one.time, 6), np.round(other.time, 6))
    if shared.sum() >= FEWEST_MESSAGES:
        position = position[shared]
    own, others = ({*map(tuple, np.round(some, 6).tolist())} for some in (position, there))
    return len(own & others) > _COPIED * len(own)


def _rate(given: Given, pose: PoseSource) -> PoseRating:
    alone = replace(given.sources, pose=pose, interval=None)
    try:
        extraction = Extraction(replace(given, sources=alone))
        if not pose.track and extraction.find_tracks() is not None:
            # Poses of two publishers are as good as those of the better one.
            each = [_rate(given, replace(pose, track=number)) for number in (1, 2)]
            return replace(max(each, key=lambda one: (not one.refusal, one.score)), source=pose)
        made = extraction.run()
    except SlipError as error:
        return PoseRating(pose, refusal=error.what)
    return _rate_extracted(given, pose, made)


def _rate_extracted(given: Given, pose: PoseSource, made: Extracted) -> PoseRating:
    poses = made.tables["poses"].filter(~pl.col("held") & pl.col("x").is_finite() & pl.col("q_w").is_finite())
    parent, child = made.frames
    bare = PoseRating(pose, parent, child)
    if poses.height < FEWEST_MESSAGES:
        said = made.tables["poses"].height
        refusal = f"only {poses.height} new of {said} poses"
        return replace(bare, refusal=refusal, stands=said >= FEWEST_MESSAGES)
    time = poses["t"].to_numpy()
    position = np.stack([poses[axis].to_numpy() for axis in "xy"], axis=1)
    yaw = np.unwrap(yaw_of(np.stack([poses[f"q_{axis}"].to_numpy() for axis in "xyzw"], axis=1)))
    length = max(_span_of(table) for table in made.tables.values())
    period = float(np.median(np.diff(time)))
    rate = 1.0 / period if period > 0.0 else 0.0
    coverage = min(float(np.minimum(np.diff(time), 2.0 * period).sum()) / length, 1.0)
    wheels = made.tables["wheels"]
    extent, turned = np.ptp(position, axis=0).max(), np.ptp(yaw)
    path = _path_of(wheels, given.vehicle)
    drove = path is not None and float(np.hypot(*np.diff(path[1:])).sum()) > _DRIVES_M
    if extent < _STILL_M and (turned > _TURNS_RAD or drove):
        living = "its heading turns" if turned > _TURNS_RAD else "the wheels drive"
        refusal = f"its position never changes while {living}"
        return replace(bare, rate_hz=rate, refusal=refusal, stands=True)
    share, least, sideways = _compare_with_wheels(time, position, yaw, path)
    # Satellite poses do not depend on the wheels, and a heading from the course shows no sideways motion.
    on_course = any(finding.id == "no_heading" for finding in made.findings)
    is_plain = pose.content is PoseContent.POSE and not on_course
    is_apart = path is None or (least >= _FROM_WHEELS and not _is_odometry(pose, parent))
    from_wheels = is_plain and sideways < _SIDEWAYS_MPS and not is_apart
    if is_plain:
        score, reasons = _score_frame(str(pose), parent)
    else:
        score, reasons = _score_satellites(pose, time, position, made.findings)
    if from_wheels:
        score -= 10.0
        reasons = ["computed from the wheels"]
    elif share is not None:
        reasons.append(f"{format_share(share)} of its path differs from the wheels'")
    astray = _compare_with_gyro(time, yaw, made.tables["imu"])
    if astray is not None and astray > _ASTRAY:
        score -= 1.5
        reasons.append(f"{format_share(astray)} of its turning differs from the gyro's")
    if rate < SLOW_HZ:
        score -= 5.0
        reasons.append("too slow for velocities")
    if coverage < _SPARSE:
        score -= 3.0
        reasons.append("often missing")
    return replace(
        bare,
        rate_hz=rate,
        coverage=coverage,
        beside_wheels=share,
        from_wheels=from_wheels,
        score=score,
        reason=", ".join(reasons),
        time=time,
        position=position,
    )


def _span_of(table: pl.DataFrame) -> float:
    return float(np.ptp(table["t"].to_numpy())) if table.height else 0.0


def _is_odometry(pose: PoseSource, parent: str) -> bool:
    """Whether a pose is given in the frame of an odometry, by a topic whose name says no localization."""
    frame = parent.lower()
    is_fixed = _FIXED_FRAME.search(frame) is not None or is_localization(str(pose).lower())
    return not is_fixed and _ODOMETRY_FRAME.search(frame) is not None


def _score_frame(name: str, parent: str) -> tuple[float, list[str]]:
    """Score by names and frames."""
    name, frame = name.lower(), parent.lower()
    if _FIXED_FRAME.search(frame):
        score, reasons = 3.0, ["given in a fixed frame"]
    elif _ODOMETRY_FRAME.search(frame):
        score, reasons = 1.0, ["given in an odometry's frame"]
    else:
        score, reasons = 2.0, ["its frame does not say what it is"]
    if is_localization(name):
        score += 1.0
        reasons.append("a localization by its name")
    elif DEAD_RECKONED.search(name) and score < 3.0:  # noqa: PLR2004 - a fixed frame outweighs the name
        score -= 1.0
        reasons.append("wheel odometry by its name")
    if FILTERED.search(name):
        score -= 0.5
        reasons.append("a filter, which may follow the wheels")
    return score, reasons


def _score_satellites(
    pose: PoseSource, time: Floats, position: Floats, findings: Sequence[Finding]
) -> tuple[float, list[str]]:
    """Score of satellite poses: below a localization with a heading of its own."""
    score, reasons = 2.0, [pose.content.value]
    if pose.content is PoseContent.VELOCITY:
        score -= 0.2
    if any(finding.id == "heading_from_course" for finding in findings):
        score -= 0.5
        reasons.append("its heading is its course")
    else:
        reasons.append("its heading is the IMU's, put on its course")
    noise = estimate_noise(position[:, :2]) / np.sqrt(arrays.count_steps(time, SPAN_S)) / SPAN_S
    if noise > _NOISY_MPS:
        score -= 0.5
        reasons.append(f"noisy: {noise:.2g} m/s over half a second")
    return score, reasons


def _path_of(wheels: pl.DataFrame, vehicle: Vehicle) -> tuple[Floats, Floats, Floats] | None:
    """Times [s] of wheel messages, paths [m] ahead and sideways since the first; None without wheels."""
    rolled = read_speed(wheels, vehicle)
    if rolled is None:
        return None
    time, speed = rolled
    aside = np.zeros_like(speed)
    if vehicle.kinematics.has_inputs("sideways"):
        known = wheels.drop_nulls("sideways")
        if not known.is_empty():
            aside = vehicle.wheel_radius_m * np.interp(time, known["t"], known["sideways"])
    return time, arrays.integrate_rate(time, speed), arrays.integrate_rate(time, aside)


def _compare_with_wheels(
    time: Floats, position: Floats, yaw: Floats, path: tuple[Floats, Floats, Floats] | None
) -> tuple[float | None, float, float]:
    """How far a pose goes another way than the wheels.

    Any gain is allowed, and a small delay. Coarse integration of a turn causes an apparent sideways motion
    proportional to path times turn, which is removed.

    Returns:
        Fraction of its path not explained by the wheels, None where too little is recorded; the least that it
        may be but for chance, infinite without wheels; and median relative sideways speed [m/s], infinite
        where it stands.
    """
    if path is None:
        return None, np.inf, np.inf
    inside = (time >= path[0][0]) & (time <= path[0][-1])
    share, least = None, 0.0
    if inside.sum() >= FEWEST_MESSAGES:
        time, position, yaw = time[inside], position[inside], yaw[inside]
        ends = np.arange(0, time.size, arrays.count_steps(time, SPAN_S))
        distance, _ = split_chords(position[ends], yaw[ends])
        rolled = np.interp(time[ends], *path[:2])
        rate = np.gradient(path[1], arrays.spread_equal(path[0]))
        share = measure_rest(distance, np.diff(rolled), np.diff(np.interp(time[ends], path[0], rate)))
        least = 0.0 if share is None else share * max(0.0, 1.0 - _CHANCE / math.sqrt(distance.size))
    ahead, aside = split_chords(position, yaw)
    aside = aside - np.diff(np.interp(time, path[0], path[2]))
    elapsed = np.maximum(np.diff(time), 1e-3)
    # Where poses are missing a body goes along a curve, of which nothing is known.
    moving = (np.abs(ahead) > _STILL_M) & (elapsed < _NEXT * float(np.quantile(elapsed, 0.1)))
    turned, aside, elapsed = (ahead * np.diff(yaw))[moving], aside[moving], elapsed[moving]
    gain = float(turned @ aside) / max(float(turned @ turned), 1e-12)
    sideways = np.abs(aside - gain * turned) / elapsed
    return share, least, float(np.median(sideways)) if sideways.size else np.inf


def yaw_of(quaternion: Floats) -> Floats:
    """Headings [rad], shape (n,), of unit quaternions (n, 4)."""
    return rigid.euler_from_quaternions(quaternion)[2]


def integrate_between(start: Floats, end: Floats, times: Floats, rate: Floats) -> Floats:
    """Integrals of a sampled rate over spans of time, shape (m,); NaN where readings are missing.

    A missing reading is no rate of zero: rows that are not finite are left out, and a span that touches a
    hole of more than `arrays.PERIODS` usual periods is unknown.

    Args:
        start: of each span [s], shape (m,).
        end: of each span [s], shape (m,).
        times: of the readings [s], shape (n,), increasing.
        rate: the readings, NaN where missing, shape (n,).
    """
    known = np.isfinite(rate)
    times, rate = times[known], rate[known]
    if times.size < 2:  # noqa: PLR2004 - one reading has no duration
        return np.full(start.shape, np.nan)
    steps = np.diff(times)
    holes = np.append(
        0.0, np.cumsum(steps > arrays.PERIODS * max(float(np.median(steps)), arrays.SHORTEST_PERIOD))
    )
    path = arrays.integrate_rate(times, rate)
    moved, missing = (np.interp(end, times, sums) - np.interp(start, times, sums) for sums in (path, holes))
    inside = (start >= times[0]) & (end <= times[-1]) & (missing == 0.0)
    return np.where(inside, moved, np.nan)


def _compare_with_gyro(time: Floats, yaw: Floats, imu: pl.DataFrame) -> float | None:
    """Fraction of a pose's turning not explained by the gyro, for any sign, scale and mounting of it."""
    if imu.height < FEWEST_MESSAGES:
        return None
    clock = imu["t"].to_numpy()
    inside = (time >= clock[0]) & (time <= clock[-1])
    time, yaw = time[inside], yaw[inside]
    if time.size < FEWEST_MESSAGES:
        return None
    ends = np.arange(0, time.size, arrays.count_steps(time, SPAN_S))
    at = time[ends]
    turned = integrate_between(at[:-1], at[1:], clock, imu["rate_z"].to_numpy())
    known = np.isfinite(turned)
    if known.sum() < FEWEST_MESSAGES:
        return None
    return measure_rest(np.diff(yaw[ends])[known], turned[known], np.diff(at)[known])


def measure_rest(moved: Floats, driven: Floats, changed: Floats) -> float | None:
    """Median residual of a robust fit of ``moved`` on ``driven`` and ``changed``, relative to ``moved``."""
    size = float(np.sqrt(np.mean(moved**2)))
    if size < STILL_MPS * SPAN_S:
        return None
    rest = fit_robustly(np.column_stack((driven, changed)), moved).rest
    return float(np.median(np.abs(rest))) / size


def split_chords(position: Floats, yaw: Floats) -> tuple[Floats, Floats]:
    """Path ahead along the arc, and sideways, between neighbouring poses [m]."""
    turned = np.diff(yaw)
    middle = yaw[:-1] + 0.5 * turned
    step = np.diff(position, axis=0)
    ahead = step[:, 0] * np.cos(middle) + step[:, 1] * np.sin(middle)
    aside = step[:, 1] * np.cos(middle) - step[:, 0] * np.sin(middle)
    return ahead / np.sinc(turned / (2.0 * np.pi)), aside


def replace_pose(sources: Sources, ratings: Sequence[PoseRating]) -> Sources:
    """The choice with the best rated pose, and the reason."""
    if not ratings or ratings[0].refusal:
        return sources
    best = ratings[0]
    chosen = replace(best.source, reason=best.reason)
    notes = [note for note in sources.notes if not note.startswith("pose:")]
    notes += [
        f"pose: {best.format_line()}",
        *(f"pose, not chosen: {other.format_line()}" for other in ratings[1:]),
    ]
    others = {
        **sources.others,
        "pose": tuple(replace(one.source, reason=one.refusal or one.reason) for one in ratings[1:]),
    }
    return replace(sources, pose=chosen, notes=tuple(notes), others=others).separated(
        best.same_as, *(one.source.topic for one in ratings[1:] if one.same_as)
    )
