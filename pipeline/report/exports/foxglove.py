"""A layout for Foxglove and Lichtblick: map, velocities, slip, findings of the derived log."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

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
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {
            "direction": "row",
            "splitPercentage": 45,
            "first": {
                "direction": "column",
                "splitPercentage": 75,
                "first": "3D!map",
                "second": "RosOut!findings",
            },
            "second": {
                "direction": "column",
                "splitPercentage": 50,
                "first": {"direction": "column", "first": "Plot!slip", "second": "Plot!x"},
                "second": {"direction": "column", "first": "Plot!y", "second": "Plot!w"},
            },
        },
    }


def _build_map(source: ExportSource) -> dict[str, object]:
    lines = {
        topics.PATH: {"visible": False, "lineWidth": 0.05, "gradient": [theme.QUIET, theme.QUIET]},
        topics.TRAIL: {"visible": True},
        topics.PREDICTED_PATH: {"visible": True, "lineWidth": 0.1, "gradient": [theme.MODEL, theme.MODEL]},
        topics.FINDING_MARKERS: {"visible": True},
        topics.POSE: {"visible": True},
    }
    middle, extent = _find_extent(source)
    return {
        "followTf": source.frame_id,
        "followMode": "follow-none",
        "scene": {},
        # From above, north up, the whole way in view.
        "cameraState": {
            "perspective": False,
            "distance": max(_CLOSEST_M, 1.2 * extent),
            "phi": 0,
            "thetaOffset": 90,
            "target": [0, 0, 0],
            "targetOffset": [*middle, 0],
            "targetOrientation": [0, 0, 0, 1],
            "fovy": 45,
            "near": 0.01,
            "far": 5000,
        },
        "transforms": {},
        "topics": lines,
        "layers": {
            "grid": {
                "layerId": "foxglove.Grid",
                "instanceId": "grid",
                "label": "Grid",
                "visible": True,
                "frameLocked": True,
                "size": 100,
                "divisions": 20,
                "lineWidth": 1,
                "color": theme.GRID,
                "position": [0, 0, 0],
                "rotation": [0, 0, 0],
                "order": 1,
            }
        },
        "imageMode": {},
    }


def _find_extent(source: ExportSource) -> tuple[list[float], float]:
    """Middle of the way driven, x and y [m], and the longer side of the box round it [m]."""
    parts = [frame.to_numpy() for frame in source.batches("velocities", ("x", "y"))]
    if not parts:
        return [0.0, 0.0], 0.0
    low = np.min([part.min(axis=0) for part in parts], axis=0)
    high = np.max([part.max(axis=0) for part in parts], axis=0)
    return [round(float(value), 2) for value in (low + high) / 2.0], float((high - low).max())


def _build_plot(title: str, lines: list[tuple[str, str, str]]) -> dict[str, object]:
    return {
        "title": title,
        "paths": [
            {
                "value": value,
                "label": label,
                "color": colour,
                "enabled": True,
                "timestampMethod": "receiveTime",
                "showLine": True,
            }
            for value, label, colour in lines
        ],
        "showLegend": True,
        "showPlotValuesInLegend": False,
        "legendDisplay": "floating",
        "isSynced": True,
        "xAxisVal": "timestamp",
        "sidebarDimension": 240,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
    }
