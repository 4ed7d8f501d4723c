"""The error of this room."""

from pipeline.core.errors import SlipError


class DiagnosisError(SlipError):
    """A diagnosis that cannot be made, in one line."""
