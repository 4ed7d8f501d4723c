"""The one base of every error that a user may see.

An error has a stable code for scripts, says what is wrong and where, and ends with what to do about it.
Each room derives one class of its own.
"""

from collections.abc import Iterator
from contextlib import contextmanager

_READABLE = 300
_LONGEST = 1000


class SlipError(Exception):
    """Something the user can mend.

    Args:
        code: stable identifier in snake_case, for example ``log_not_found``.
        what: what is wrong, one sentence without a full stop.
        where: the file, topic, key or line it concerns; empty when there is none.
        hint: what to do about it.
    """

    def __init__(self, code: str, what: str, *, where: str = "", hint: str) -> None:
        super().__init__(what)
        self.code = code
        # What a file says is repeated in errors, and files may say anything at any length.
        self.what = shorten(what, _LONGEST)
        self.where = where
        self.hint = hint

    def __str__(self) -> str:
        """One line: where, what, what to do."""
        place = f"{self.where}: " if self.where else ""
        return f"{place}{self.what}. {self.hint.rstrip('.')}."

    def _render_traceback_(self) -> list[str]:
        """The same line in place of a traceback, where a notebook asks for one."""
        return [f"slip: {' '.join(str(self).split())}"]

    def __reduce__(self) -> tuple[object, ...]:
        """Keep every part when the error crosses a process boundary."""
        return _rebuild, (type(self), self.code, self.what, self.where, self.hint)


def shorten(text: str, most: int = _READABLE) -> str:
    """The beginning of what a text of any length says."""
    return text if len(text) <= most else f"{text[:most]}..."


def _rebuild(kind: type[SlipError], code: str, what: str, where: str, hint: str) -> SlipError:
    return kind(code, what, where=where, hint=hint)


@contextmanager
def naming_os_errors(
    make: type[SlipError], code: str, what: str, *, where: object, hint: str
) -> Iterator[None]:
    """Within it, what the operating system refuses is an error of the house: `what`, and the reason it gives.

    Raises:
        SlipError: of the class `make`.
    """
    try:
        yield
    except OSError as error:
        raise make(code, f"{what}: {error.strerror or error}", where=str(where), hint=hint) from error
