"""Choosing the pose by its frame and content: what the candidates of a log are worth beside each other.

Every candidate is extracted as an analysis would; compared are the frame it is given in, how often a new pose
comes and for how much of the log, whether it moves at all, and above all whether it is computed from the
wheels: then the wheels' way gives its way back, and it never moves sideways.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
import polars as pl
from numpy.typing import NDArray

from pipeline.core import rigid, timegrid
from pipeline.core.errors import SlipError
from pipeline.stages.extract.tables import extract_tables
from pipeline.stages.trust import measure_rest
from pipeline.vehicles import PoseSource
from pipeline.vehicles.candidates import DEAD_RECKONED, FILTERED, LOCALIZED

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.logs import LogData
    from pipeline.vehicles import Configuration, Sources, Vehicle

Floats = NDArray[np.float64]

_FIXED_FRAME: Final = re.compile(
    r"(^|/)(map|world|earth|utm|enu|global|camera_init|mocap|vicon)$|lidar|slam|gps|gnss|local_origin"
)
_ODOMETRY_FRAME: Final = re.compile(r"odom")
_SPAN_S: Final = 0.5
"""Over so long the way of a pose is compared with that of the wheels."""
_FROM_WHEELS: Final = 0.02
"""Share of the way that wheels leave unexplained, below which a pose may be theirs: a localization's noise of
4 mm is as much of half a metre."""
_SIDEWAYS_MPS: Final = 2e-3
"""Sideways speed below which a pose may be the wheels': a localization has more noise."""
_ASTRAY: Final = 0.3
"""Share of its turning that a pose may have beside the gyro: its noise, and a tilted gyro's loss."""
_SLOW_HZ: Final = 4.0
"""Fewer new poses a second leave too few for a velocity over 0.75 s."""
_SPARSE: Final = 0.5
_STILL_M: Final = 1e-4
_TURNS_RAD: Final = 0.2
_DRIVES_M: Final = 1.0
_FEWEST: Final = 20


@dataclass(frozen=True)
class PoseRating:
    """What a candidate for the pose is worth.

    Attributes:
        source: the candidate.
        parent, child: frames, as far as they are said.
        rate_hz: new poses a second, repeats left out.
        coverage: share of the log's time in which they come.
        beside_wheels: share of its way that the wheels do not account for; None where that cannot be told.
        from_wheels: whether it is computed from the wheels.
        score: the higher, the better.
        reason: in words.
        refused: why it cannot serve at all; empty where it can.
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
    refused: str = ""

    def describe(self) -> str:
        """One line."""
        if self.refused:
            return f"{self.source}: refused, {self.refused}"
        frames = f"{self.parent or '?'} -> {self.child or '?'}"
        share = f"{self.rate_hz:.3g} Hz new, {self.coverage:.0%} of the time"
        return f"{self.source}: {frames}, {share}; {self.reason}"


def rate_poses(
    data: LogData, sources: Sources, configuration: Configuration, vehicle: Vehicle, *, where: str
) -> tuple[PoseRating, ...]:
    """Candidates for the pose, the best first.

    Args:
        data: columns of all candidates and of the wheels.
        sources: the choice by type and name, with the other candidates.
        configuration: units, signs, clocks.
        vehicle: its geometry, or that of any vehicle of its kind: gains do not matter.
        where: the log.
    """
    if sources.pose is None:
        return ()
    others = [source for source in sources.others.get("pose", ()) if isinstance(source, PoseSource)]
    ratings = [
        _rate(data, candidate, sources, configuration, vehicle, where)
        for candidate in (sources.pose, *others)
    ]
    return tuple(sorted(ratings, key=lambda rating: (bool(rating.refused), -rating.score, -rating.rate_hz)))


def _rate(
    data: LogData,
    pose: PoseSource,
    sources: Sources,
    configuration: Configuration,
    vehicle: Vehicle,
    where: str,
) -> PoseRating:
    alone = replace(sources, pose=pose, interval=None)
    try:
        made = extract_tables(data, alone, configuration, vehicle, where=where)
    except SlipError as error:
        return PoseRating(pose, refused=error.what)
    poses = made.tables["poses"].filter(~pl.col("held") & pl.col("x").is_finite() & pl.col("q_w").is_finite())
    parent, child = made.frames
    bare = PoseRating(pose, parent, child)
    if poses.height < _FEWEST:
        return replace(bare, refused=f"only {poses.height} new poses")
    time = poses["t"].to_numpy()
    position = np.stack([poses[axis].to_numpy() for axis in "xy"], axis=1)
    yaw = np.unwrap(_yaw_of(np.stack([poses[f"q_{axis}"].to_numpy() for axis in "xyzw"], axis=1)))
    length = max(_span_of(table) for table in made.tables.values())
    period = float(np.median(np.diff(time)))
    rate = 1.0 / period if period > 0.0 else 0.0
    coverage = min(float(np.minimum(np.diff(time), 2.0 * period).sum()) / length, 1.0)
    wheels = made.tables["wheels"]
    reach, turned = np.ptp(position, axis=0).max(), np.ptp(yaw)
    path = _path_of(wheels, vehicle)
    drove = path is not None and float(np.hypot(*np.diff(path[1:])).sum()) > _DRIVES_M
    if reach < _STILL_M and (turned > _TURNS_RAD or drove):
        living = "its heading turns" if turned > _TURNS_RAD else "the wheels drive"
        return replace(bare, rate_hz=rate, refused=f"its position never changes while {living}")
    share, sideways = _compare_with_wheels(time, position, yaw, path)
    from_wheels = share is not None and share < _FROM_WHEELS and sideways < _SIDEWAYS_MPS
    score, reasons = _score_frame(str(pose), parent)
    if from_wheels:
        score -= 10.0
        reasons = ["it is computed from the wheels"]
    elif share is not None:
        reasons.append(f"{share:.1%} of its way is not the wheels'")
    astray = _compare_with_gyro(time, yaw, made.tables["imu"])
    if astray is not None and astray > _ASTRAY:
        score -= 1.5
        reasons.append(f"{astray:.0%} of its turning is not the gyro's")
    if rate < _SLOW_HZ:
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
    )


def _span_of(table: pl.DataFrame) -> float:
    return float(np.ptp(table["t"].to_numpy())) if table.height else 0.0


def _score_frame(name: str, parent: str) -> tuple[float, list[str]]:
    """What names and frames say."""
    name, frame = name.lower(), parent.lower()
    if _FIXED_FRAME.search(frame):
        score, reasons = 3.0, ["given in a fixed frame"]
    elif _ODOMETRY_FRAME.search(frame):
        score, reasons = 1.0, ["given in an odometry's frame"]
    else:
        score, reasons = 2.0, ["its frame does not say what it is"]
    if LOCALIZED.search(name):
        score += 1.0
        reasons.append("a localization by its name")
    elif DEAD_RECKONED.search(name) and score < 3.0:  # noqa: PLR2004 - a fixed frame outweighs the name
        score -= 1.0
        reasons.append("wheel odometry by its name")
    if FILTERED.search(name):
        score -= 0.5
        reasons.append("a filter, which may follow the wheels")
    return score, reasons


def _path_of(wheels: pl.DataFrame, vehicle: Vehicle) -> tuple[Floats, Floats, Floats] | None:
    """Times [s] of the wheels' messages, ways [m] ahead and aside since the first; None without wheels."""
    if wheels.height < _FEWEST:
        return None
    if wheels["speed"].null_count() < wheels.height:
        speed = wheels["speed"].to_numpy()
    else:
        speed = 0.5 * vehicle.wheel_radius_m * (wheels["left"] + wheels["right"]).to_numpy()
    aside = np.zeros_like(speed)
    if vehicle.kinematics.has_inputs("sideways"):
        aside = vehicle.wheel_radius_m * wheels["sideways"].cast(pl.Float64).to_numpy()
    known = np.isfinite(speed) & np.isfinite(aside)
    time = wheels["t"].to_numpy()[known]
    if time.size < _FEWEST:
        return None
    return time, timegrid.integrate_rate(time, speed[known]), timegrid.integrate_rate(time, aside[known])


def _compare_with_wheels(
    time: Floats, position: Floats, yaw: Floats, path: tuple[Floats, Floats, Floats] | None
) -> tuple[float | None, float]:
    """Share of a pose's way that is not the wheels', and its median sideways speed beside theirs [m/s].

    Any gain is allowed, and a small delay. What a coarse integration makes of a turn is no sideways motion:
    it is proportional to way times turn.
    """
    if path is None:
        return None, np.inf
    inside = (time >= path[0][0]) & (time <= path[0][-1])
    time, position, yaw = time[inside], position[inside], yaw[inside]
    if time.size < _FEWEST:
        return None, np.inf
    span = max(round(_SPAN_S / max(float(np.median(np.diff(time))), 1e-3)), 1)
    ends = np.arange(0, time.size, span)
    way, _ = _split_chords(position[ends], yaw[ends])
    rolled = np.interp(time[ends], *path[:2])
    rate = np.gradient(path[1], path[0] + np.arange(path[0].size) * 1e-12)
    share = measure_rest(way, np.diff(rolled), np.diff(np.interp(time[ends], path[0], rate)))
    ahead, aside = _split_chords(position, yaw)
    aside = aside - np.diff(np.interp(time, path[0], path[2]))
    turned = ahead * np.diff(yaw)
    gain = float(turned @ aside) / max(float(turned @ turned), 1e-12)
    elapsed = np.maximum(np.diff(time), 1e-3)
    moving = np.abs(ahead) > _STILL_M
    sideways = np.abs(aside - gain * turned)[moving] / elapsed[moving]
    return share, float(np.median(sideways)) if sideways.size else np.inf


def _yaw_of(quaternion: Floats) -> Floats:
    return rigid.euler_from_quaternions(quaternion)[2]


def _compare_with_gyro(time: Floats, yaw: Floats, imu: pl.DataFrame) -> float | None:
    """Share of a pose's turning that the gyro does not account for, whatever its sign, scale and mounting."""
    if imu.height < _FEWEST:
        return None
    clock = imu["t"].to_numpy()
    inside = (time >= clock[0]) & (time <= clock[-1])
    time, yaw = time[inside], yaw[inside]
    if time.size < _FEWEST:
        return None
    span = max(round(_SPAN_S / max(float(np.median(np.diff(time))), 1e-3)), 1)
    ends = np.arange(0, time.size, span)
    rate = np.nan_to_num(imu["rate_z"].to_numpy())
    turned = np.diff(np.interp(time[ends], clock, timegrid.integrate_rate(clock, rate)))
    return measure_rest(np.diff(yaw[ends]), turned, np.diff(time[ends]))


def _split_chords(position: Floats, yaw: Floats) -> tuple[Floats, Floats]:
    """Way ahead along the arc, and aside, between neighbouring poses [m]."""
    turned = np.diff(yaw)
    middle = yaw[:-1] + 0.5 * turned
    step = np.diff(position, axis=0)
    ahead = step[:, 0] * np.cos(middle) + step[:, 1] * np.sin(middle)
    aside = step[:, 1] * np.cos(middle) - step[:, 0] * np.sin(middle)
    return ahead / np.sinc(turned / (2.0 * np.pi)), aside


def fit_geometry(wheels: pl.DataFrame, poses: pl.DataFrame, kind: str) -> dict[str, float] | None:
    """Geometry of an unknown vehicle, as its poses show it.

    Args:
        wheels: measured with a stand-in of unit radius, track width and wheelbase.
        poses: of the localization.
        kind: of vehicle.

    Returns:
        Wheel radius and effective track width [m], or the wheelbase of a car; None where it does not drive
        enough to tell.
    """
    fresh = poses.filter(~pl.col("held") & pl.col("x").is_finite() & pl.col("q_w").is_finite())
    if fresh.height < _FEWEST or wheels.height < _FEWEST:
        return None
    time = fresh["t"].to_numpy()
    span = max(round(_SPAN_S / max(float(np.median(np.diff(time))), 1e-3)), 1)
    ends = np.arange(0, time.size, span)
    position = np.stack([fresh[axis].to_numpy() for axis in "xy"], axis=1)[ends]
    yaw = np.unwrap(_yaw_of(np.stack([fresh[f"q_{axis}"].to_numpy() for axis in "xyzw"], axis=1)))[ends]
    way, _ = _split_chords(position, yaw)
    clock = wheels["t"].to_numpy()

    def integral(rate: Floats) -> Floats:
        return np.diff(np.interp(time[ends], clock, timegrid.integrate_rate(clock, np.nan_to_num(rate))))

    if kind == "ackermann":
        speed, steering = wheels["speed"].to_numpy(), wheels["steering"].to_numpy()
        scale = _median_gain(way, integral(speed))
        bent = _median_gain(np.diff(yaw), integral(speed * np.tan(steering)))
        return None if not scale or not bent else {"wheelbase_m": 1.0 / bent}
    left, right = wheels["left"].to_numpy(), wheels["right"].to_numpy()
    radius = _median_gain(way, integral(0.5 * (left + right)))
    over = _median_gain(np.diff(yaw), integral(right - left))
    if not radius or not over or radius <= 0.0 or over <= 0.0:
        return None
    return {"wheel_radius_m": radius, "track_width_m": radius / over}


def _median_gain(moved: Floats, driven: Floats) -> float | None:
    """Weighted median of moved over driven; None where hardly anything was driven."""
    live = np.abs(driven) > 0.1 * float(np.max(np.abs(driven), initial=0.0))
    if live.sum() < _FEWEST:
        return None
    ratio, weight = moved[live] / driven[live], np.abs(driven[live])
    order = np.argsort(ratio)
    total = np.cumsum(weight[order])
    return float(ratio[order][np.searchsorted(total, 0.5 * total[-1])])


def replace_pose(sources: Sources, ratings: Sequence[PoseRating]) -> Sources:
    """The choice with the best rated pose, and why."""
    if not ratings or ratings[0].refused:
        return sources
    best = ratings[0]
    chosen = replace(best.source, reason=best.reason)
    notes = [note for note in sources.notes if not note.startswith("pose:")]
    notes += [f"pose: {best.describe()}", *(f"pose, not taken: {other.describe()}" for other in ratings[1:])]
    others = {
        **sources.others,
        "pose": tuple(replace(one.source, reason=one.refused or one.reason) for one in ratings[1:]),
    }
    return replace(sources, pose=chosen, notes=tuple(notes), others=others).separated()
