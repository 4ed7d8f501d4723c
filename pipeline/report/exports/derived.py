"""The derived MCAP: what was computed of a log, to be opened beside it.

Message types are standard ROS 2 ones, which Foxglove, Lichtblick, PlotJuggler and RViz know; times are those
of the original.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import polars as pl

from pipeline.core.arrays import Floats, Ints
from pipeline.identification import Prediction
from pipeline.logs import LogWriter
from pipeline.logs.normalize import Given
from pipeline.report.exports import topics
from pipeline.report.exports.markers import join_track, write_findings, write_trail
from pipeline.report.exports.source import ExportSource
from pipeline.report.exports.stretches import ModelFeed

_BODY = "base_link"
_TWIST = "geometry_msgs/msg/TwistStamped"
_PATH_POSES = 5000
_PREDICTIONS_HZ = 5.0
_VELOCITIES = ("t", "stamp", "segment", "x", "y", "z", "yaw", "v_x", "v_y", "v_w")
_SLIP = ("stamp", "f_x", "f_y", "f_w", "g_x", "g_y", "g_w", "modulus")


def write_derived_log(source: ExportSource, path: Path) -> Path:
    """Write velocities, slip, segments, findings and paths of a run as MCAP.

    Args:
        source: the run, and the model whose velocity and predictions are wanted.
        path: the file; an existing one is replaced when the new one is whole.

    Raises:
        LogError: nothing can be written there.
        MotionError: the model cannot be run on this log.
    """
    with LogWriter(path) as writer:
        writer.metadata("slip", {"run": source.manifest.run, "key": source.manifest.key, **_name_log(source)})
        track = join_track(source)
        _write_path(writer, source)
        write_trail(writer, source, track)
        write_findings(writer, source, track)
        velocities = source.feed("velocities", "stamp", _VELOCITIES)
        slip = {name: source.feed("slip", "stamp", _SLIP, name) for name in source.inputs}
        model = None if source.model is None else ModelFeed(source, source.model)
        for low, high in source.stretches:
            frame = velocities.take(low, high)
            if frame is not None:
                _write_velocities(writer, source, frame)
            for name, feed in slip.items():
                rows = feed.take(low, high)
                if rows is not None:
                    _write_slip(writer, source, name, rows)
            if model is not None and frame is not None:
                _write_model(writer, source, model, frame, (low, high))
            writer.write_before(high + source.shift_ns)
        if model is not None:
            model.check()
    return path


def _name_log(source: ExportSource) -> dict[str, str]:
    log = source.manifest.part("log")
    return {key: str(log.get(name, "")) for key, name in (("log", "path"), ("sha256", "sha256")) if log}


def _write_twist(
    writer: LogWriter, source: ExportSource, topic: str, frame: pl.DataFrame, prefix: str
) -> None:
    fields: dict[str, Given] = {
        "header.frame_id": _BODY,
        "twist.linear.x": frame[f"{prefix}_x"].to_numpy(),
        "twist.linear.y": frame[f"{prefix}_y"].to_numpy(),
        "twist.angular.z": frame[f"{prefix}_w"].to_numpy(),
    }
    source.write_stamped(writer, topic, _TWIST, frame["stamp"].to_numpy(), fields)


def _write_velocities(writer: LogWriter, source: ExportSource, frame: pl.DataFrame) -> None:
    _write_twist(writer, source, topics.MEASURED, frame, "v")
    _write_poses(writer, source, frame)
    times = source.log_times(frame["stamp"].to_numpy())
    writer.write_columns(topics.SEGMENT, "std_msgs/msg/Int32", times, {"data": frame["segment"].to_numpy()})


def _write_slip(writer: LogWriter, source: ExportSource, name: str, rows: pl.DataFrame) -> None:
    _write_twist(writer, source, topics.name_ideal(name), rows, "f")
    _write_twist(writer, source, topics.name_slip(name), rows, "g")
    times = source.log_times(rows["stamp"].to_numpy())
    modulus = {"data": rows["modulus"].to_numpy()}
    writer.write_columns(topics.name_modulus(name), "std_msgs/msg/Float64", times, modulus)


def _write_model(
    writer: LogWriter, source: ExportSource, model: ModelFeed, frame: pl.DataFrame, stretch: tuple[int, int]
) -> None:
    low, high = (1e-9 * (edge - source.start_ns) for edge in stretch)
    found = model.predict(low, high, frame["t"].to_numpy())
    if found is None:
        return
    columns = {f"v_{axis}": found.velocity[:, i] for i, axis in enumerate("xyw")}
    velocity = frame.select("stamp").with_columns(**columns).filter(pl.col("v_x").is_finite())
    _write_twist(writer, source, topics.MODEL, velocity, "v")
    _write_predictions(writer, source, found.prediction)


def _write_poses(writer: LogWriter, source: ExportSource, frame: pl.DataFrame) -> None:
    # Not odometry: its two covariances, which nobody has, would be four fifths of the file.
    fields: dict[str, Given] = {
        **{f"pose.position.{axis}": frame[axis].to_numpy() for axis in "xyz"},
        **_turn(frame["yaw"].to_numpy(), "pose.orientation."),
    }
    stamps = frame["stamp"].to_numpy()
    source.write_stamped(writer, topics.POSE, "geometry_msgs/msg/PoseStamped", stamps, fields)


def _write_path(writer: LogWriter, source: ExportSource) -> None:
    """The whole way driven as one message at its beginning, thinned to what a screen can show."""
    if "velocities" not in source.manifest.tables:
        return
    every = max(source.manifest.tables["velocities"].rows // _PATH_POSES, 1)
    kept = [
        frame.gather_every(every) for frame in source.batches("velocities", ("stamp", "x", "y", "z", "yaw"))
    ]
    if not kept:
        return
    whole = {name: column.to_numpy()[None, :] for name, column in pl.concat(kept).to_dict().items()}
    stamps, yaw = whole.pop("stamp"), whole.pop("yaw")
    _write_poses_along(writer, source, topics.PATH, stamps, whole, yaw)


def _write_predictions(writer: LogWriter, source: ExportSource, prediction: Prediction) -> None:
    """Where the model would have gone, over two seconds from measured poses, a few a second."""
    if prediction.start_times.size == 0:
        return
    slot = np.floor(prediction.start_times * _PREDICTIONS_HZ)
    kept = np.flatnonzero(np.diff(slot, prepend=-1.0) > 0.0)
    stamps = source.start_ns + np.round(prediction.start_times[kept] * 1e9).astype(np.int64)
    along = stamps[:, None] + np.round(prediction.horizon_times * 1e9).astype(np.int64)[None, :]
    x, y, yaw = np.moveaxis(prediction.poses[kept], 2, 0)
    _write_poses_along(writer, source, topics.PREDICTED_PATH, along, {"x": x, "y": y}, yaw)


def _write_poses_along(
    writer: LogWriter, source: ExportSource, name: str, stamps: Ints, place: Mapping[str, Floats], yaw: Floats
) -> None:
    """Paths, one a row, each at the stamp of its first pose.

    Args:
        writer: of the derived log.
        source: the run.
        name: topic of the paths.
        stamps: of the poses [ns], shape (n, k).
        place: by axis [m], shape (n, k) each.
        yaw: [rad], shape (n, k).
    """
    fields: dict[str, Given] = {
        "poses[].header.frame_id": [[source.frame_id] * stamps.shape[1]] * stamps.shape[0],
        "poses[].header.stamp.sec": stamps // 10**9,
        "poses[].header.stamp.nanosec": stamps % 10**9,
        **{f"poses[].pose.position.{axis}": values for axis, values in place.items()},
        **_turn(yaw, "poses[].pose.orientation."),
    }
    source.write_stamped(writer, name, "nav_msgs/msg/Path", stamps[:, 0], fields)


def _turn(yaw: Floats, prefix: str) -> dict[str, Floats]:
    return {f"{prefix}z": np.sin(0.5 * yaw), f"{prefix}w": np.cos(0.5 * yaw)}
