"""What a log may do to the process that works on it."""

from __future__ import annotations

import os
import signal
import time


class Panic(BaseException):
    """What a library in Rust raises when it gives up: no exception that `except Exception` catches."""


def do_harm(kind: str, about: str) -> None:
    """Do what the kind says; nothing when it says nothing.

    Args:
        kind: such as ``hangs`` or ``dies``.
        about: of what an error speaks.
    """
    if kind == "raises":
        raise RuntimeError(f"poison in {about}")
    if kind == "panics":
        raise Panic(f"poison in {about}")
    if kind == "hangs":
        time.sleep(3600.0)
    if kind == "eats":
        hoard = []
        while True:
            hoard.append(b"x" * (1 << 26))
    if kind == "dies":
        os.kill(os.getpid(), signal.SIGSEGV)
    if kind == "leaves":
        os._exit(7)
