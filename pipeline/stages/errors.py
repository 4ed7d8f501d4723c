"""What can keep a stage from its work."""

from pipeline.core.errors import SlipError


class StageError(SlipError):
    """A log or a table that holds too little for a stage."""
