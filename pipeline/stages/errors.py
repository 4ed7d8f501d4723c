"""What can keep a stage from its work."""

from __future__ import annotations

from pipeline.core.errors import SlipError


class StageError(SlipError):
    """A log or a table that holds too little for a stage."""
