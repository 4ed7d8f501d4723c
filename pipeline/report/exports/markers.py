"""Markers in the derived log: the way driven coloured by slip, and findings where they happened."""

import numpy as np
import polars as pl

from pipeline.core.arrays import Floats, Ints
from pipeline.logs import LogWriter
from pipeline.logs.normalize import Given
from pipeline.report import theme
from pipeline.report.exports import topics
from pipeline.report.exports.source import ExportSource

_MARKER = "visualization_msgs/msg/Marker"
_LINE_STRIP, _TEXT = 4, 9
_LEVELS = {"info": 20, "warning": 30, "error": 40}
_COLOURS = {"info": theme.ON_COMMAND, "warning": theme.SLIP_RAMP[1], "error": theme.SLIP_RAMP[3]}
_MOST_POINTS = 20_000
_CAP_QUANTILE = 0.98
_LIFT_M = 0.4


def write_trail(writer: LogWriter, source: ExportSource, track: pl.DataFrame) -> None:
    """One line a segment, coloured by slip modulus on the leading input; grey where there is none.

    Args:
        writer: of the derived log.
        source: the run.
        track: what `join_track` gives.
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
        source.write_stamped(writer, topics.TRAIL, _MARKER, rows["stamp"].to_numpy()[:1], fields)


def write_findings(writer: LogWriter, source: ExportSource, track: pl.DataFrame) -> None:
    """Each finding as a line of a log panel, and as a text at the place where it happened.

    Args:
        writer: of the derived log.
        source: the run.
        track: what `join_track` gives.
    """
    places = track.sort("stamp") if track.width else track
    for frame in source.batches("findings"):
        rows = frame.sort(pl.col("t_start").fill_null(0.0), maintain_order=True)
        seconds = rows["t_start"].fill_null(0.0).to_numpy()
        stamps = source.start_ns + np.round(seconds * 1e9).astype(np.int64)
        severities = rows["severity"].cast(pl.String).to_list()
        writer.write_columns(
            topics.FINDINGS,
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
    source.write_stamped(writer, topics.FINDING_MARKERS, _MARKER, stamps, fields)


def join_track(source: ExportSource) -> pl.DataFrame:
    """Thinned ``stamp segment x y z modulus``, by segment and time; the modulus null where there is none."""
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
    """Colours of the slip ramp at shares of its end, shape (n, 3)."""
    stops = np.linspace(0.0, 1.0, len(theme.SLIP_RAMP))
    table = np.array([_rgb(colour) for colour in theme.SLIP_RAMP])
    return np.stack([np.interp(np.clip(share, 0.0, 1.0), stops, column) for column in table.T], axis=1)


def _rgb(colour: str) -> list[float]:
    return [int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)]
