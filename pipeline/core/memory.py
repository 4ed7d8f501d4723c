"""Memory that is free again."""

import ctypes


def return_freed_memory() -> None:
    """Hand memory that was freed back to the machine, where the C library can.

    Columns of a log are many small pieces from several threads: what is left between them stays with the
    process, up to half of what was read, until it is asked for.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
