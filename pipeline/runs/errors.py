"""The error of this room."""

from pipeline.core.errors import SlipError


class MotionError(SlipError):
    """A model, an effect, a formula or a fit that cannot be, in one line."""
