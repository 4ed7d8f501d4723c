"""The error of this room."""

from __future__ import annotations

from pipeline.core.errors import SlipError


class PlanError(SlipError):
    """A plan that cannot be made, written or read, in one line."""
