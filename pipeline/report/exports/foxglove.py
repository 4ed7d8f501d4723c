"""A layout for Foxglove and Lichtblick: map, velocities, slip, findings of the derived log."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from pipeline.report import theme
from pipeline.report.exports import topics
from pipeline.report.exports.files import write_text
from pipeline.report.exports.series import list_series

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.report.exports.source import ExportSource


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
    return {
        "followTf": source.frame_id,
        "followMode": "follow-none",
        "scene": {},
        "cameraState": {"perspective": False, "distance": 40, "phi": 0, "thetaOffset": 90},
        "transforms": {},
        "topics": lines,
        "layers": {"grid": {"layerId": "foxglove.Grid", "visible": True, "size": 100, "divisions": 20}},
    }


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
        "legendDisplay": "floating",
        "isSynced": True,
        "xAxisVal": "timestamp",
        "showXAxisLabels": True,
        "showYAxisLabels": True,
    }
