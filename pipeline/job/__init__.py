"""One log through all stages and its report; keys of what is done.

A job settles what a log is and which topics serve, runs the stages whose key has changed, and publishes
tables, summary and report in one moment.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from pipeline.core.program import SlipError


class JobError(SlipError):
    """A run that is not there, or a log that lacks what the analysis needs."""


ANALYZE_FIRST = "Analyze logs first: slip analyze LOG... --results RESULTS --terrain NAME."


def lack_runs(code: str, what: str, root: Path, hint: str, notes: Iterable[str] = ()) -> JobError:
    """The error that the results in `root` have no run for what is asked; `notes` say what was left out."""
    return JobError(code, what + "".join(f"; {note}" for note in notes), where=str(root), hint=hint)


INPUTS = ("command", "measured")
STAGE_WORDS = {
    "read": "reading the log",
    "extract": "extracting commands and poses",
    "align": "aligning clocks and scales",
    "velocity": "differentiating poses",
    "slip": "computing slip",
    "aggregate": "aggregating",
    "report": "drawing the report",
}
"""What is done in each stage, as people are told."""

STAGES = ("extract", "align", "velocity", "slip", "aggregate")
FigureFormat = Literal["svg", "pdf", "png"]
FIGURES: tuple[FigureFormat, ...] = get_args(FigureFormat)


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `slip analyze` and of the stage verbs.

    Attributes:
        out: results folder.
        config: configuration file in place of the one beside the log.
        fleet: fleet file that holds for the log wherever it stands, beside those above the log.
        run: name of the run; None finds one by the log's folder, name and content.
        overrides: configuration values from the command line, nested like the file.
        inputs: which inputs to compute slip for.
        model: model file to compute slip relative to as well.
        report: whether to write `report.html`.
        diagnosis: whether to name what is missing from the model.
        figures: format of figures for papers (`svg`, `pdf`, `png`); None for none.
        force: compute again what is already there.
        through: last stage to run.
        max_inflated: bytes that the chunks of a log may inflate to; None for what is plausible for its size.
    """

    out: Path = Path("results")
    config: Path | None = None
    fleet: Path | None = None
    run: str | None = None
    overrides: Mapping[str, object] = field(default_factory=dict)
    inputs: tuple[str, ...] = INPUTS
    model: Path | None = None
    report: bool = True
    diagnosis: bool = False
    figures: FigureFormat | None = None
    force: bool = False
    through: str = "aggregate"
    max_inflated: int | None = None
