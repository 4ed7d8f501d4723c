"""The error of this room."""

from __future__ import annotations

from pipeline.core.errors import SlipError


class ReportError(SlipError):
    """A report or a figure cannot be made or written."""
