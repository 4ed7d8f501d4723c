"""The error of this room."""

from functools import partial

from pipeline.core.errors import SlipError, naming_os_errors


class ReportError(SlipError):
    """A report or a figure cannot be made or written."""


writing_export = partial(
    naming_os_errors,
    ReportError,
    "export_not_written",
    "cannot be written",
    hint="Choose another place with --out.",
)
