"""Analysis of one log through all stages, and its report.

A job identifies the vehicle and the topics of a log, runs the stages whose key has changed, and publishes
tables, summary and report atomically.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from pipeline.core import SlipError


class JobError(SlipError):
    """A run does not exist, or a log lacks data that the analysis needs."""


ANALYZE_FIRST = "Analyze logs first: slip analyze LOG... --results RESULTS --terrain NAME."


def lack_runs(code: str, what: str, root: Path, hint: str, notes: Iterable[str] = ()) -> SlipError:
    """Build the error that no run in `root` fits the request; `notes` list what was excluded.

    A folder that does not exist, a file, or a folder of other things is no results folder: then this is the
    error.
    """
    from pipeline.store import RUNS  # noqa: PLC0415 - heavy
    from pipeline.store.names import no_results  # noqa: PLC0415 - heavy

    if not root.exists():
        return no_results(root)
    if root.is_file() or (root.is_dir() and any(root.iterdir()) and not (root / RUNS).is_dir()):
        what, hint = (
            "this is not a results folder",
            "Give the folder that `slip analyze` writes (default: results).",
        )
        return JobError(code, what, where=str(root), hint=hint)
    return JobError(code, what + "".join(f"; {note}" for note in notes), where=str(root), hint=hint)


INPUTS = ("command", "measured")
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
FigureFormat = Literal["svg", "pdf", "png"]
FIGURES: tuple[FigureFormat, ...] = get_args(FigureFormat)


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `slip analyze` and of the stage verbs.

    Attributes:
        out: results folder.
        config: configuration file to use instead of the one beside the log.
        fleet: fleet file to apply to the log wherever it is, in addition to those in the folders above it.
        run: name of the run; None derives it from the log's folder, name and content.
        overrides: configuration values from the command line, nested like the file.
        inputs: inputs to compute slip for.
        model: model file; slip is also computed relative to this model.
        report: whether to write `report.html`.
        diagnosis: whether to identify the effects that are missing from the model.
        figures: format of figures for papers (`svg`, `pdf`, `png`); None for none.
        force: recompute existing results.
        through: last stage to run.
        max_inflated: limit of the decompressed size of a log's chunks [bytes]; None for one by its file size.
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
