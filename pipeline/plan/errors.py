"""The error of this room."""

from pipeline.core.errors import SlipError


class PlanError(SlipError):
    """A plan that cannot be made, written or read, in one line."""
