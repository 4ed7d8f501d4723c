"""The error of this room."""

from __future__ import annotations

from pipeline.core.errors import SlipError


class WorkbenchError(SlipError):
    """Something that was asked of the workbench cannot be done."""
