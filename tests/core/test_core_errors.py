"""Errors: one line, a code for scripts, whole across processes."""

import pickle

from pipeline.core import SlipError


class RoomError(SlipError):
    pass


def test_an_error_says_where_what_and_what_to_do_in_one_line() -> None:
    error = RoomError("too_cold", "it is too cold", where="room 3", hint="Close the window.")
    assert str(error) == "room 3: it is too cold. Close the window."


def test_an_error_survives_the_way_between_processes() -> None:
    error = pickle.loads(pickle.dumps(RoomError("too_cold", "cold", where="here", hint="Wait.")))  # noqa: S301
    assert isinstance(error, RoomError)
    assert (error.code, error.what, error.where, error.hint) == ("too_cold", "cold", "here", "Wait.")


def test_an_error_stays_readable_whatever_a_file_says() -> None:
    error = RoomError("unknown", f"no vehicle is called {'husky_' * 2000}", hint="Wait.")
    assert len(str(error)) < 1100
    assert "husky_..." in str(error) or "..." in error.what
