"""The error of this room."""

from __future__ import annotations

from pipeline.core.errors import SlipError


class MotionError(SlipError):
    """A model, an effect, a formula or a fit that cannot be, in one line."""
