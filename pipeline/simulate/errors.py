"""The errors of this room."""

from pipeline.core.errors import SlipError


class SimulateError(SlipError):
    """A scenario that cannot be simulated: unknown name, wrong parameter, impossible value."""


def unknown_name(kind: str, name: str, known: list[str]) -> SimulateError:
    """The error for a name that is not in a list.

    Args:
        kind: what the name should be, for example ``effect``.
        name: what was given.
        known: the names that exist.

    Returns:
        An error with code ``unknown_<kind>`` whose hint lists the names, nearest first.
    """
    import difflib  # noqa: PLC0415 - only needed once something is already wrong

    near = difflib.get_close_matches(name, known, n=3)
    guess = f"Did you mean {' or '.join(near)}? " if near else ""
    return SimulateError(
        f"unknown_{kind}", f"there is no {kind} '{name}'", hint=f"{guess}Known: {', '.join(known)}"
    )
