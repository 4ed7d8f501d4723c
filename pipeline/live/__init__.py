"""A recording while it is written: what is known of it so far.

`watch` schedules the looks at a growing log and says what each of them found; `running_log` holds what
is valid before a log ends.
"""

from pipeline.core import SlipError


class LiveError(SlipError):
    """A recording that cannot be followed."""
