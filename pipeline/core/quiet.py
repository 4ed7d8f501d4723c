"""Warnings of libraries are for whoever works on the program, not for whoever uses it."""

import sys
import warnings


def silence_warnings() -> None:
    """Show no warnings in this process, unless they were asked for (``python -W``, ``PYTHONWARNINGS``).

    What a user must know is a finding, a loss or an error. Filters stay as they are: where warnings are
    errors, as in the tests, they are errors still.
    """
    if not sys.warnoptions:
        warnings.showwarning = _ignore


def _ignore(*_: object, **__: object) -> None:
    return None
