"""What can keep a job from its work."""

from pipeline.core.errors import SlipError


class JobError(SlipError):
    """A run that is not there, or a log that lacks what the analysis needs."""
