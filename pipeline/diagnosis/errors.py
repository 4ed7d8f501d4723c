"""The error of this room."""

from __future__ import annotations

from pipeline.core.errors import SlipError


class DiagnosisError(SlipError):
    """A diagnosis that cannot be made, in one line."""
