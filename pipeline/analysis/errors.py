"""What can keep a job from its work."""

from collections.abc import Iterable
from pathlib import Path

from pipeline.core.errors import SlipError


class JobError(SlipError):
    """A run that is not there, or a log that lacks what the analysis needs."""


ANALYZE_FIRST = "Analyze logs first: slip analyze LOG... --out RESULTS --terrain NAME."


def lack_runs(code: str, what: str, root: Path, hint: str, notes: Iterable[str] = ()) -> JobError:
    """The error that the results in `root` have no run for what is asked; `notes` say what was left out."""
    return JobError(code, what + "".join(f"; {note}" for note in notes), where=str(root), hint=hint)
