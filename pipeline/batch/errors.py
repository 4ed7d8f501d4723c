"""What can keep a batch from its work."""

from pipeline.core.errors import SlipError


class BatchError(SlipError):
    """Logs that cannot be found, or workers that cannot be had."""
