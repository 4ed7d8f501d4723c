"""Derived MCAP: the results computed from a log, to be opened beside it.

Message types are standard ROS 2 ones, which Foxglove, Lichtblick, PlotJuggler and RViz support; times are
those of the original.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import polars as pl

from pipeline.core.arrays import Floats, Ints
from pipeline.estimation import Prediction
from pipeline.logs import LogWriter
from pipeline.logs.encode import Given
from pipeline.report import theme
from pipeline.report.export_source import ExportSource, ModelFeed

# Export of a run to common viewers: a derived MCAP, CSV, layouts for Foxglove and PlotJuggler.
#
# Tables are read and written in batches, so that memory does not grow with the duration.


MEASURED = "/slip/velocity/measured"
MODEL = "/slip/velocity/model"
POSE = "/slip/pose"
PATH = "/slip/path"
PREDICTED_PATH = "/slip/predicted_path"
TRAIL = "/slip/trail"
SEGMENT = "/slip/segment"
FINDINGS = "/slip/findings"
FINDING_MARKERS = "/slip/finding_markers"


def name_ideal(input_name: str) -> str:
    """Topic of the ideal velocity on an input."""
    return f"/slip/velocity/ideal_{input_name}"


def name_slip(input_name: str) -> str:
    """Topic of the slip vector on an input."""
    return f"/slip/slip_{input_name}"


def name_modulus(input_name: str) -> str:
    """Topic of the slip speed on an input."""
    return f"/slip/modulus_{input_name}"


_MARKER = "visualization_msgs/msg/Marker"
_LINE_STRIP, _TEXT = 4, 9
_LEVELS = {"info": 20, "warning": 30, "error": 40}
_COLOURS = {"info": theme.ON_COMMAND, "warning": theme.SLIP_RAMP[1], "error": theme.SLIP_RAMP[3]}
_MOST_POINTS = 20_000
_CAP_QUANTILE = 0.98
_LIFT_M = 0.4


def write_trail(writer: LogWriter, source: ExportSource, track: pl.DataFrame) -> None:
    """Write one line per segment, coloured by slip speed on the leading input; grey without slip.

    Args:
        writer: writer of the derived log.
        source: the run.
        track: as from `join_track`.
    """
    if track.is_empty():
        return
    cap = float(track["modulus"].quantile(_CAP_QUANTILE) or 1.0) or 1.0
    for (segment,), rows in track.group_by("segment", maintain_order=True):
        ramp = _ramp(rows["modulus"].fill_null(0.0).to_numpy() / cap)
        fields: dict[str, Given] = {
            "ns": "slip",
            "id": int(str(segment)),
            "type": _LINE_STRIP,
            "pose.orientation.w": 1.0,
            "scale.x": 0.08,
            "color.a": 1.0,
            **{f"points[].{axis}": rows[axis].to_numpy()[None, :] for axis in "xyz"},
            **{f"colors[].{name}": ramp[None, :, i] for i, name in enumerate("rgb")},
            "colors[].a": np.ones((1, rows.height), dtype=np.float32),
        }
        source.write_stamped(writer, TRAIL, _MARKER, rows["stamp"].to_numpy()[:1], fields)


def write_findings(writer: LogWriter, source: ExportSource, track: pl.DataFrame) -> None:
    """Write each finding as a line of a log panel, and as a text at its position.

    Args:
        writer: writer of the derived log.
        source: the run.
        track: as from `join_track`.
    """
    places = track.sort("stamp") if track.width else track
    for frame in source.batches("findings"):
        rows = frame.sort(pl.col("t_start").fill_null(0.0), maintain_order=True)
        seconds = rows["t_start"].fill_null(0.0).to_numpy()
        stamps = source.start_ns + np.round(seconds * 1e9).astype(np.int64)
        severities = rows["severity"].cast(pl.String).to_list()
        writer.write_columns(
            FINDINGS,
            "rcl_interfaces/msg/Log",
            source.log_times(stamps),
            {
                "stamp.sec": stamps // 10**9,
                "stamp.nanosec": stamps % 10**9,
                "level": np.array([_LEVELS.get(name, 20) for name in severities], dtype=np.uint8),
                "name": rows["id"].to_list(),
                "msg": rows["text"].to_list(),
            },
        )
        if not places.is_empty():
            _write_texts(writer, source, rows, stamps, places)


def _write_texts(
    writer: LogWriter,
    source: ExportSource,
    rows: pl.DataFrame,
    stamps: Ints,
    places: pl.DataFrame,
) -> None:
    at = np.clip(np.searchsorted(places["stamp"].to_numpy(), stamps), 0, places.height - 1)
    colours = np.array(
        [_rgb(_COLOURS.get(str(name), theme.INK)) for name in rows["severity"].cast(pl.String)]
    )
    fields: dict[str, Given] = {
        "ns": "findings",
        "id": np.arange(rows.height, dtype=np.int32),
        "type": _TEXT,
        "pose.position.x": places["x"].to_numpy()[at],
        "pose.position.y": places["y"].to_numpy()[at],
        "pose.position.z": places["z"].to_numpy()[at] + _LIFT_M,
        "pose.orientation.w": 1.0,
        "scale.z": 0.3,
        **{f"color.{name}": colours[:, i] for i, name in enumerate("rgb")},
        "color.a": 1.0,
        "text": rows["id"].to_list(),
    }
    source.write_stamped(writer, FINDING_MARKERS, _MARKER, stamps, fields)


def join_track(source: ExportSource) -> pl.DataFrame:
    """Thinned ``stamp segment x y z modulus``, by segment and time; the modulus is null without slip."""
    if "velocities" not in source.manifest.tables:
        return pl.DataFrame()
    every = max(source.manifest.tables["velocities"].rows // _MOST_POINTS, 1)
    wanted = ("stamp", "segment", "x", "y", "z")
    parts = [frame.gather_every(every) for frame in source.batches("velocities", wanted)]
    if not parts:
        return pl.DataFrame()
    track = pl.concat(parts)
    leading = source.inputs[0] if source.inputs else ""
    places = track.select("stamp", "segment")
    known = [
        frame.filter(pl.col("input").cast(pl.String) == leading)
        .select("stamp", "segment", "modulus")
        .join(places, on=["stamp", "segment"], how="semi")
        for frame in source.batches("slip", ("input", "stamp", "segment", "modulus"))
    ]
    if not known:
        return track.with_columns(modulus=pl.lit(None, pl.Float64)).sort("segment", "stamp")
    modulus = pl.concat(known).unique(["stamp", "segment"], maintain_order=True, keep="first")
    return track.join(modulus, on=["stamp", "segment"], how="left").sort("segment", "stamp")


def _ramp(share: Floats) -> Floats:
    """Colours of the slip ramp at fractions of its range, shape (n, 3)."""
    stops = np.linspace(0.0, 1.0, len(theme.SLIP_RAMP))
    table = np.array([_rgb(colour) for colour in theme.SLIP_RAMP])
    return np.stack([np.interp(np.clip(share, 0.0, 1.0), stops, column) for column in table.T], axis=1)


def _rgb(colour: str) -> list[float]:
    return [int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)]


_BODY = "base_link"
_TWIST = "geometry_msgs/msg/TwistStamped"
_PATH_POSES = 5000
_PREDICTIONS_HZ = 5.0
_VELOCITIES = ("t", "stamp", "segment", "x", "y", "z", "yaw", "v_x", "v_y", "v_w")
_SLIP = ("stamp", "f_x", "f_y", "f_w", "g_x", "g_y", "g_w", "modulus")


def write_derived_log(source: ExportSource, path: Path) -> Path:
    """Write velocities, slip, segments, findings and paths of a run as MCAP.

    Args:
        source: the run, with the model whose velocity and predictions are exported.
        path: the file; an existing one is replaced when the new one is complete.

    Raises:
        LogError: the path cannot be written.
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
    _write_twist(writer, source, MEASURED, frame, "v")
    _write_poses(writer, source, frame)
    times = source.log_times(frame["stamp"].to_numpy())
    writer.write_columns(SEGMENT, "std_msgs/msg/Int32", times, {"data": frame["segment"].to_numpy()})


def _write_slip(writer: LogWriter, source: ExportSource, name: str, rows: pl.DataFrame) -> None:
    _write_twist(writer, source, name_ideal(name), rows, "f")
    _write_twist(writer, source, name_slip(name), rows, "g")
    times = source.log_times(rows["stamp"].to_numpy())
    modulus = {"data": rows["modulus"].to_numpy()}
    writer.write_columns(name_modulus(name), "std_msgs/msg/Float64", times, modulus)


def _write_model(
    writer: LogWriter, source: ExportSource, model: ModelFeed, frame: pl.DataFrame, stretch: tuple[int, int]
) -> None:
    low, high = (1e-9 * (edge - source.start_ns) for edge in stretch)
    predicted = model.predict(low, high, frame["t"].to_numpy())
    if predicted is None:
        return
    columns = {f"v_{axis}": predicted.velocity[:, i] for i, axis in enumerate("xyw")}
    velocity = frame.select("stamp").with_columns(**columns).filter(pl.col("v_x").is_finite())
    _write_twist(writer, source, MODEL, velocity, "v")
    _write_predictions(writer, source, predicted.prediction)


def _write_poses(writer: LogWriter, source: ExportSource, frame: pl.DataFrame) -> None:
    # Not odometry: its two covariances, which are unknown, would be four fifths of the file.
    fields: dict[str, Given] = {
        **{f"pose.position.{axis}": frame[axis].to_numpy() for axis in "xyz"},
        **_turn(frame["yaw"].to_numpy(), "pose.orientation."),
    }
    stamps = frame["stamp"].to_numpy()
    source.write_stamped(writer, POSE, "geometry_msgs/msg/PoseStamped", stamps, fields)


def _write_path(writer: LogWriter, source: ExportSource) -> None:
    """Write the complete path as one message at its beginning, thinned to screen resolution."""
    if "velocities" not in source.manifest.tables:
        return
    every = max(source.manifest.tables["velocities"].rows // _PATH_POSES, 1)
    parts = [
        frame.gather_every(every) for frame in source.batches("velocities", ("stamp", "x", "y", "z", "yaw"))
    ]
    if not parts:
        return
    whole = {name: column.to_numpy()[None, :] for name, column in pl.concat(parts).to_dict().items()}
    stamps, yaw = whole.pop("stamp"), whole.pop("yaw")
    _write_poses_along(writer, source, PATH, stamps, whole, yaw)


def _write_predictions(writer: LogWriter, source: ExportSource, prediction: Prediction) -> None:
    """Write predicted paths of the model over two seconds from measured poses, a few per second."""
    if prediction.start_times.size == 0:
        return
    slot = np.floor(prediction.start_times * _PREDICTIONS_HZ)
    rows = np.flatnonzero(np.diff(slot, prepend=-1.0) > 0.0)
    stamps = source.start_ns + np.round(prediction.start_times[rows] * 1e9).astype(np.int64)
    along = stamps[:, None] + np.round(prediction.horizon_times * 1e9).astype(np.int64)[None, :]
    x, y, yaw = np.moveaxis(prediction.poses[rows], 2, 0)
    _write_poses_along(writer, source, PREDICTED_PATH, along, {"x": x, "y": y}, yaw)


def _write_poses_along(
    writer: LogWriter,
    source: ExportSource,
    name: str,
    stamps: Ints,
    positions: Mapping[str, Floats],
    yaw: Floats,
) -> None:
    """Write paths, one per row, each at the stamp of its first pose.

    Args:
        writer: writer of the derived log.
        source: the run.
        name: topic of the paths.
        stamps: stamps of the poses [ns], shape (n, k).
        positions: by axis [m], shape (n, k) each.
        yaw: [rad], shape (n, k).
    """
    fields: dict[str, Given] = {
        "poses[].header.frame_id": [[source.frame_id] * stamps.shape[1]] * stamps.shape[0],
        "poses[].header.stamp.sec": stamps // 10**9,
        "poses[].header.stamp.nanosec": stamps % 10**9,
        **{f"poses[].pose.position.{axis}": values for axis, values in positions.items()},
        **_turn(yaw, "poses[].pose.orientation."),
    }
    source.write_stamped(writer, name, "nav_msgs/msg/Path", stamps[:, 0], fields)


def _turn(yaw: Floats, prefix: str) -> dict[str, Floats]:
    return {f"{prefix}z": np.sin(0.5 * yaw), f"{prefix}w": np.cos(0.5 * yaw)}
