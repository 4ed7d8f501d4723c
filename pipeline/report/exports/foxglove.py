"""A layout for Foxglove and Lichtblick: map, velocities, slip, findings of the derived log."""

from __future__ import annotations

import json
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.report import theme
from pipeline.report.exports import topics
from pipeline.report.exports.files import write_text
from pipeline.report.exports.series import list_series

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.report.exports.source import ExportSource

_CLOSEST_M = 10.0


def write_foxglove_layout(source: ExportSource, path: Path) -> Path:
    """Write a layout file that shows the derived log beside the original.

    Raises:
        ReportError: ``export_not_written``.
    """
    return write_text(path, json.dumps(_build_layout(source), indent=1) + "\n")


def _build_layout(source: ExportSource) -> dict[str, object]:
    inputs = source.inputs
    panels: dict[str, object] = {
        "3D!map": _build_map(source),
        "RosOut!findings": {"searchTerms": [], "minLogLevel": 1, "topicToRender": topics.FINDINGS},
        "Plot!slip": _build_plot(
            "slip modulus [m/s]",
            [
                (f"{topics.name_modulus(name)}.data", f"on {name}", theme.INPUT_COLOURS[name])
                for name in inputs
            ],
        ),
    }
    for axis, title in (("x", "v_x [m/s]"), ("y", "v_y [m/s]"), ("w", "v_w [rad/s]")):
        lines = [(line.path(axis), line.label, line.colour) for line in list_series(source)]
        panels[f"Plot!{axis}"] = _build_plot(title, lines)
    return {"configById": panels, **_read_constants()["layout"]}


def _read_constants() -> dict[str, dict[str, Any]]:
    """What is the same in every layout: of a line, a plot, the map and the whole; null is filled in."""
    text = resources.files("pipeline.report.exports").joinpath("foxglove.json").read_text("utf-8")
    constants: dict[str, dict[str, Any]] = json.loads(text)
    return constants


def _build_map(source: ExportSource) -> dict[str, object]:
    lines = {
        topics.PATH: {"visible": False, "lineWidth": 0.05, "gradient": [theme.QUIET, theme.QUIET]},
        topics.TRAIL: {"visible": True},
        topics.PREDICTED_PATH: {"visible": True, "lineWidth": 0.1, "gradient": [theme.MODEL, theme.MODEL]},
        topics.FINDING_MARKERS: {"visible": True},
        topics.POSE: {"visible": True},
    }
    middle, extent = _find_extent(source)
    panel = _read_constants()["map"]
    # From above, north up, the whole way in view.
    panel["cameraState"] |= {"distance": max(_CLOSEST_M, 1.2 * extent), "targetOffset": [*middle, 0]}
    panel["layers"]["grid"]["color"] = theme.GRID
    return panel | {"followTf": source.frame_id, "topics": lines}


def _find_extent(source: ExportSource) -> tuple[list[float], float]:
    """Middle of the way driven, x and y [m], and the longer side of the box round it [m]."""
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
