"""What is remembered, and memory that is free again."""

import ctypes
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

Result = TypeVar("Result")


class Newest(Generic[Result]):
    """The newest results of something that is asked again.

    Args:
        most: how many are kept.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._known: OrderedDict[Hashable, Result] = OrderedDict()

    def recall(self, key: Hashable, make: Callable[[], Result]) -> Result:
        """The result that is known under a key, made where it is not."""
        result = self._known.pop(key, None)
        if result is None:
            result = make()
        self._known[key] = result
        while len(self._known) > self._most:
            self._known.popitem(last=False)
        return result


def return_freed_memory() -> None:
    """Hand memory that was freed back to the machine, where the C library can.

    Columns of a log are many small pieces from several threads: what is left between them stays with the
    process, up to half of what was read, until it is asked for.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
