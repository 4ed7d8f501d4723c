"""A recording while it is written: what is known of it so far, and the process that records a live server.

`watch` schedules the looks at a growing log and says what each of them found; `running_log` holds what
is valid before a log ends; `receiver` is the process that writes the messages of a server to a recording.
"""

from pipeline.core import SlipError


class LiveError(SlipError):
    """A recording that cannot be followed, or a server that cannot be received."""
