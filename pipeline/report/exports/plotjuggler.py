"""A layout for PlotJuggler: slip and velocities of the derived log, one below the other."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING

from pipeline.report import theme
from pipeline.report.exports import topics
from pipeline.report.exports.files import write_text
from pipeline.report.exports.series import list_series

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.report.exports.source import ExportSource


def write_plotjuggler_layout(source: ExportSource, path: Path) -> Path:
    """Write a layout file for `plotjuggler --datafile run_slip.mcap --layout run_plotjuggler.xml`.

    A layout finds its curves among the data that is loaded already, so the log comes first.

    Raises:
        ReportError: ``export_not_written``.
    """
    tree = _build_layout(source)
    ET.indent(tree)
    return write_text(path, '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(tree, "unicode") + "\n")


def _build_layout(source: ExportSource) -> ET.Element:
    root = ET.Element("root")
    window = ET.SubElement(root, "tabbed_widget", {"parent": "main_window", "name": "Main Window"})
    tab = ET.SubElement(window, "Tab", {"containers": "1", "tab_name": "slip"})
    container = ET.SubElement(tab, "Container")
    slip = [(f"{topics.name_modulus(name)}/data", theme.INPUT_COLOURS[name]) for name in source.inputs]
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
