"""Viewer layouts for the derived log (Foxglove, Lichtblick, PlotJuggler), and tables as CSV."""

import json
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from pipeline.core.program import INPUT_WORDS
from pipeline.core.tables import format_csv
from pipeline.report import derived_log, theme
from pipeline.report.export_source import ExportSource
from pipeline.report.templating import writing_export
from pipeline.store.files import replace_file
from schemas import contract_of

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
    lines = [VelocityLine(derived_log.MEASURED, "measured", theme.MEASURED)]
    lines += [
        VelocityLine(derived_log.name_ideal(name), f"ideal {INPUT_WORDS[name]}", theme.INPUT_COLOURS[name])
        for name in source.inputs
    ]
    if source.model is not None:
        lines.append(VelocityLine(derived_log.MODEL, "model", theme.MODEL))
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
        "RosOut!findings": {"searchTerms": [], "minLogLevel": 1, "topicToRender": derived_log.FINDINGS},
        "Plot!slip": _build_plot(
            "slip speed [m/s]",
            [
                (f"{derived_log.name_modulus(name)}.data", f"on {name}", theme.INPUT_COLOURS[name])
                for name in inputs
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
        derived_log.PATH: {"visible": False, "lineWidth": 0.05, "gradient": [theme.QUIET, theme.QUIET]},
        derived_log.TRAIL: {"visible": True},
        derived_log.PREDICTED_PATH: {
            "visible": True,
            "lineWidth": 0.1,
            "gradient": [theme.MODEL, theme.MODEL],
        },
        derived_log.FINDING_MARKERS: {"visible": True},
        derived_log.POSE: {"visible": True},
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
    slip = [(f"{derived_log.name_modulus(name)}/data", theme.INPUT_COLOURS[name]) for name in source.inputs]
    plots = [slip]
    plots += [[(line.path(axis, "/"), line.colour) for line in list_series(source)] for axis in "xyw"]
    sizes = ";".join(["0.25"] * len(plots))
    splitter = ET.SubElement(
        container, "DockSplitter", {"orientation": "-", "count": str(len(plots)), "sizes": sizes}
    )
    names = ("slip speed [m/s]", "v_x [m/s]", "v_y [m/s]", "v_w [rad/s]")
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
        folder: output folder; created if missing.

    Returns:
        The files, sorted.

    Raises:
        ReportError: ``export_not_written``.
    """
    written = []
    with writing_export(where=folder):
        folder.mkdir(parents=True, exist_ok=True)
        for table in sorted(source.manifest.tables):
            path = folder / f"{table}.csv"
            part = path.with_name(f".{path.name}.part")
            heads = {name: _name_column(table, name) for name in source.columns(table)}
            try:
                with part.open("wb") as file:
                    file.write(format_csv(pl.DataFrame(schema=list(heads.values()))).encode())
                    for frame in source.batches(table):
                        file.write(format_csv(frame, header=False).encode())
                part.replace(path)
            finally:
                part.unlink(missing_ok=True)
            written.append(path)
    return written


def _name_column(table: str, name: str) -> str:
    contract = contract_of(table)
    if name not in contract.schema.columns():
        return name
    unit = contract.metadata_of(name).get("unit", "")
    return f"{name} [{unit}]" if unit and unit != "1" else name
