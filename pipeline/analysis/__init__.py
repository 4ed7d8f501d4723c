"""Analysis of one log through all stages, and its report.

An analysis identifies the vehicle and the topics of a log, runs the stages whose key has changed, and
publishes tables, summary and report atomically.
"""

from dataclasses import dataclass
from pathlib import Path

from pipeline.core import FigureFormat
from pipeline.recording import LogOptions

STAGE_WORDS = {
    "read": "reading the log",
    "extract": "extracting commands and poses",
    "velocity": "differentiating poses",
    "slip": "computing slip",
    "aggregate": "aggregating",
    "report": "drawing the report",
}
"""Descriptions of the stages for users."""

STAGES = ("extract", "velocity", "slip", "aggregate")


@dataclass(frozen=True, kw_only=True)
class Options(LogOptions):
    """Options of `slip analyze` and of the stage verbs, and those of its log.

    Attributes:
        out: results folder.
        run: name of the run; None derives it from the log's folder, name and content.
        model: model file; slip is also computed relative to this model.
        report: whether to write `report.html`.
        diagnosis: whether to identify the effects that are missing from the model.
        figures: format of figures for papers (`svg`, `pdf`, `png`); None for none.
        force: recompute existing results.
        through: last stage to run.
    """

    out: Path = Path("results")
    run: str | None = None
    model: Path | None = None
    report: bool = True
    diagnosis: bool = False
    figures: FigureFormat | None = None
    force: bool = False
    through: str = "aggregate"
