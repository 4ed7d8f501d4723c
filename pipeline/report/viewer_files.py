"""Files for viewers and spreadsheets: a log of derived topics, layouts, tables as CSV."""

import json
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from pipeline.core import INPUT_WORDS, Floats, Ints, format_csv
from pipeline.estimation import Prediction
from pipeline.logs.writer import Given, LogWriter
from pipeline.report import theme, writing_export
from pipeline.report.export_source import (
    FINDING_MARKERS,
    FINDINGS,
    IDEAL_POSE,
    MEASURED,
    MODEL,
    MODEL_POSE,
    PATH,
    POSE,
    PREDICTED_PATH,
    RESIDUAL,
    SEGMENT,
    TRAIL,
    ExportSource,
    ModelFeed,
    join_track,
    name_ideal,
    name_modulus,
    name_slip,
    write_findings,
    write_trail,
)
from pipeline.stages import find_residual_modulus
from pipeline.store import read_length_scale, replace_file, temporary_beside
from schemas import contract_of

_BODY = "base_link"
_TWIST = "geometry_msgs/msg/TwistStamped"
_PATH_POSES = 5000
_PREDICTIONS_HZ = 5.0
_FOLLOWED_S = 1.7
"""Time [s] that a prediction is followed: the next may begin 0.3 s before it ends, where poses are rare."""
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
        ideal = None if source.model is None else ModelFeed(source, source.model.ideal)
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
            if ideal is not None and frame is not None:
                _write_ideal(writer, source, ideal, (low, high))
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
    modulus = find_residual_modulus(predicted.velocity, frame, length=read_length_scale(source.manifest))
    known = np.isfinite(modulus)
    times = source.log_times(frame["stamp"].to_numpy()[known])
    writer.write_columns(RESIDUAL, "std_msgs/msg/Float64", times, {"data": modulus[known]})
    _write_predictions(writer, source, predicted.prediction)
    _write_predicted_poses(writer, source, MODEL_POSE, predicted.prediction)


def _write_ideal(writer: LogWriter, source: ExportSource, ideal: ModelFeed, stretch: tuple[int, int]) -> None:
    low, high = (1e-9 * (edge - source.start_ns) for edge in stretch)
    predicted = ideal.predict(low, high, np.zeros(0))
    if predicted is not None:
        _write_predicted_poses(writer, source, IDEAL_POSE, predicted.prediction)


def _write_predicted_poses(
    writer: LogWriter, source: ExportSource, topic: str, prediction: Prediction
) -> None:
    """Write the poses of consecutive predictions, which begin at measured poses."""
    times = prediction.start_times[:, None] + prediction.horizon_times[None, :]
    rows = np.broadcast_to(prediction.horizon_times < _FOLLOWED_S, times.shape)
    stamps = source.stamp(times[rows])
    x, y, yaw = prediction.poses[rows].T
    fields: dict[str, Given] = {
        "pose.position.x": x,
        "pose.position.y": y,
        **_turn(yaw, "pose.orientation."),
    }
    source.write_stamped(writer, topic, "geometry_msgs/msg/PoseStamped", stamps, fields)


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
    rows = source.thin_velocities(("stamp", "x", "y", "z", "yaw"), _PATH_POSES)
    if rows.is_empty():
        return
    whole = {name: column.to_numpy()[None, :] for name, column in rows.to_dict().items()}
    stamps, yaw = whole.pop("stamp"), whole.pop("yaw")
    _write_poses_along(writer, source, PATH, stamps, whole, yaw)


def _write_predictions(writer: LogWriter, source: ExportSource, prediction: Prediction) -> None:
    """Write predicted paths of the model over two seconds from measured poses, a few per second."""
    if prediction.start_times.size == 0:
        return
    slot = np.floor(prediction.start_times * _PREDICTIONS_HZ)
    rows = np.flatnonzero(np.diff(slot, prepend=-1.0) > 0.0)
    stamps = source.stamp(prediction.start_times[rows])
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


_CLOSEST_M = 10.0
_FIELDS = {"x": "linear.x", "y": "linear.y", "w": "angular.z"}


@dataclass(frozen=True)
class VelocityLine:
    """Velocity in the derived log.

    Attributes:
        topic: topic of type TwistStamped.
        label: label in the legend.
        colour: colour as in the report.
    """

    topic: str
    label: str
    colour: str

    def path(self, axis: str, separator: str = ".") -> str:
        """Message path of the component `x`, `y` or `w`."""
        return f"{self.topic}{separator}twist{separator}{_FIELDS[axis].replace('.', separator)}"


def list_series(source: ExportSource) -> list[VelocityLine]:
    """Velocities: measured, ideal on every input, and that of the model if there is one."""
    lines = [VelocityLine(MEASURED, "measured", theme.MEASURED)]
    lines += [
        VelocityLine(name_ideal(name), f"ideal {INPUT_WORDS[name]}", theme.INPUT_COLOURS[name])
        for name in source.inputs
    ]
    if source.model is not None:
        lines.append(VelocityLine(MODEL, "model", theme.MODEL))
    return lines


def write_foxglove_layout(source: ExportSource, path: Path) -> Path:
    """Write a layout file that shows the derived log beside the original.

    Raises:
        ReportError: ``export_not_written``.
    """
    return write_text(path, json.dumps(_build_panels(source), indent=1) + "\n")


def _build_panels(source: ExportSource) -> dict[str, object]:
    inputs = source.inputs
    panels: dict[str, object] = {
        "3D!map": _build_map(source),
        "RosOut!findings": {"searchTerms": [], "minLogLevel": 1, "topicToRender": FINDINGS},
        "Plot!slip": _build_plot(
            "slip modulus [m/s]",
            [
                *(
                    (f"{name_modulus(name)}.data", INPUT_WORDS[name], theme.INPUT_COLOURS[name])
                    for name in inputs
                ),
                *([] if source.model is None else [(f"{RESIDUAL}.data", "with the model", theme.MODEL)]),
            ],
        ),
    }
    for axis, title in (("x", "v_x [m/s]"), ("y", "v_y [m/s]"), ("w", "v_w [rad/s]")):
        lines = [(line.path(axis), line.label, line.colour) for line in list_series(source)]
        panels[f"Plot!{axis}"] = _build_plot(title, lines)
    return {"configById": panels, **_read_constants()["layout"]}


def _read_constants() -> dict[str, dict[str, Any]]:
    """Common parts of every layout: line, plot, map and whole; nulls are filled in."""
    text = resources.files("pipeline.report").joinpath("foxglove.json").read_text("utf-8")
    constants: dict[str, dict[str, Any]] = json.loads(text)
    return constants


def _build_map(source: ExportSource) -> dict[str, object]:
    lines = {
        PATH: {"visible": False, "lineWidth": 0.05, "gradient": [theme.QUIET, theme.QUIET]},
        TRAIL: {"visible": True},
        PREDICTED_PATH: {
            "visible": True,
            "lineWidth": 0.1,
            "gradient": [theme.MODEL, theme.MODEL],
        },
        FINDING_MARKERS: {"visible": True},
        POSE: {"visible": True},
        **({} if source.model is None else {MODEL_POSE: {"visible": True}, IDEAL_POSE: {"visible": True}}),
    }
    middle, extent = _find_extent(source)
    panel = _read_constants()["map"]
    # From above, north up, with the complete path in view.
    panel["cameraState"] |= {"distance": max(_CLOSEST_M, 1.2 * extent), "targetOffset": [*middle, 0]}
    panel["layers"]["grid"]["color"] = theme.GRID
    return panel | {"followTf": source.frame_id, "topics": lines}


def _find_extent(source: ExportSource) -> tuple[list[float], float]:
    """Centre of the path, x and y [m], and the longer side of its bounding box [m]."""
    parts = [frame.to_numpy() for frame in source.batches("velocities", ("x", "y"))]
    if not parts:
        return [0.0, 0.0], 0.0
    low = np.min([part.min(axis=0) for part in parts], axis=0)
    high = np.max([part.max(axis=0) for part in parts], axis=0)
    return [round(float(value), 2) for value in (low + high) / 2.0], float((high - low).max())


def _build_plot(title: str, lines: list[tuple[str, str, str]]) -> dict[str, object]:
    constants = _read_constants()
    paths = [
        {"value": value, "label": label, "color": colour, **constants["line"]}
        for value, label, colour in lines
    ]
    return {"title": title, "paths": paths, **constants["plot"]}


def write_plotjuggler_layout(source: ExportSource, path: Path) -> Path:
    """Write a layout file for `plotjuggler --datafile run_slip.mcap --layout run_plotjuggler.xml`.

    A layout refers to data that is already loaded, so the log comes first.

    Raises:
        ReportError: ``export_not_written``.
    """
    tree = _build_tabs(source)
    ET.indent(tree)
    return write_text(path, '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(tree, "unicode") + "\n")


def _build_tabs(source: ExportSource) -> ET.Element:
    root = ET.Element("root")
    window = ET.SubElement(root, "tabbed_widget", {"parent": "main_window", "name": "Main Window"})
    tab = ET.SubElement(window, "Tab", {"containers": "1", "tab_name": "slip"})
    container = ET.SubElement(tab, "Container")
    slip = [(f"{name_modulus(name)}/data", theme.INPUT_COLOURS[name]) for name in source.inputs]
    slip += [] if source.model is None else [(f"{RESIDUAL}/data", theme.MODEL)]
    plots = [slip]
    plots += [[(line.path(axis, "/"), line.colour) for line in list_series(source)] for axis in "xyw"]
    sizes = ";".join(["0.25"] * len(plots))
    splitter = ET.SubElement(
        container, "DockSplitter", {"orientation": "-", "count": str(len(plots)), "sizes": sizes}
    )
    names = ("slip modulus [m/s]", "v_x [m/s]", "v_y [m/s]", "v_w [rad/s]")
    for name, curves in zip(names, plots, strict=True):
        area = ET.SubElement(splitter, "DockArea", {"name": name})
        plot = ET.SubElement(area, "plot", {"style": "Lines", "mode": "TimeSeries"})
        for curve, colour in curves:
            ET.SubElement(plot, "curve", {"name": curve, "color": colour})
    ET.SubElement(window, "currentTabIndex", {"index": "0"})
    ET.SubElement(root, "use_relative_time_offset", {"enabled": "1"})
    return root


def write_text(path: Path, text: str) -> Path:
    """Write a text file atomically.

    Raises:
        ReportError: ``export_not_written``.
    """
    with writing_export(where=path):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, text.encode())
    return path


def write_csv(source: ExportSource, folder: Path) -> list[Path]:
    """Write every table of a run as `<table>.csv`.

    A column with a unit in its contract has it in its heading, for example `v_x [m/s]`. Rows are read and
    written in batches: memory does not grow with the run.

    Args:
        source: the run.
        folder: output folder; created if missing, and filled when all tables are written.

    Returns:
        The files, sorted.

    Raises:
        ReportError: ``export_not_written``.
    """
    with writing_export(where=folder), _fill_folder(folder) as draft:
        for table in sorted(source.manifest.tables):
            heads = {name: _name_column(table, name) for name in source.columns(table)}
            with (draft / f"{table}.csv").open("wb") as file:
                file.write(format_csv(pl.DataFrame(schema=list(heads.values()))).encode())
                for frame in source.batches(table):
                    file.write(format_csv(frame, header=False).encode())
    return [folder / f"{table}.csv" for table in sorted(source.manifest.tables)]


@contextmanager
def _fill_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder whose files stand in ``folder`` when the block ends without an error."""
    is_new = not folder.is_dir()
    folder.parent.mkdir(parents=True, exist_ok=True)
    draft = temporary_beside(folder if is_new else folder / "draft")
    draft.mkdir()
    try:
        yield draft
        if is_new:
            draft.rename(folder)
        else:
            for path in draft.iterdir():
                path.replace(folder / path.name)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _name_column(table: str, name: str) -> str:
    contract = contract_of(table)
    if name not in contract.schema.columns():
        return name
    unit = contract.metadata_of(name).get("unit", "")
    return f"{name} [{unit}]" if unit and unit != "1" else name
