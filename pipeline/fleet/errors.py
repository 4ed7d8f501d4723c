"""The error of this room."""

from pipeline.core.errors import SlipError


class ComparisonError(SlipError):
    """Results, or a table of deployments, that cannot be compared."""
