"""What can keep a stage from its work."""

from collections.abc import Sequence

from pipeline.core.errors import SlipError
from pipeline.logs import Loss


class StageError(SlipError):
    """A log or a table that holds too little for a stage."""


def blame_damage(losses: Sequence[Loss]) -> str:
    """What was lost of the log, for sentences about what is not there; empty where nothing was."""
    more = f" and {len(losses) - 1} more" if len(losses) > 1 else ""
    return f" (the log is damaged: {losses[0].text}{more})" if losses else ""
