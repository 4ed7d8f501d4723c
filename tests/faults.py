"""Faults on purpose: memory that is refused, and a disk that does not take what it is given."""

from __future__ import annotations

import _testcapi
import errno
import os
import random
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import Self

CALLS = ("fsync", "mkdir", "rename", "replace", "link", "open", "unlink", "symlink", "rmdir")
CODES = (errno.ENOSPC, errno.EIO, errno.EDQUOT)
MEMORY, DISK = "memory", "disk"


@dataclass(frozen=True)
class Fault:
    """What goes wrong.

    Attributes:
        kind: `MEMORY` or `DISK`.
        after: allocations, or calls of the system, that succeed before.
        lasting: how many then fail; 0 for all of them.
        code: of the system's errors.
    """

    kind: str
    after: int
    lasting: int = 1
    code: int = errno.ENOSPC


def draw_faults(rounds: int, *, most: dict[str, int], seed: int) -> Iterator[Fault]:
    """Faults of both kinds in turn; half of them once, the others until the end or for a while."""
    chance = random.Random(seed)  # noqa: S311 - moments, not secrets
    for number in range(rounds):
        kind = (MEMORY, DISK)[number % 2]
        lasting = chance.choice((1, 1, 20, 0) if kind == DISK else (1, 1, 20, 1000))
        yield Fault(kind, chance.randrange(most[kind]), lasting, chance.choice(CODES))


@contextmanager
def arm(fault: Fault) -> Iterator[Callable[[], int]]:
    """Let the fault happen in the block.

    Yields:
        How many calls of the system were counted so far.
    """
    disk = _Disk(fault)
    with disk.in_the_way():
        if fault.kind == MEMORY:
            _testcapi.set_nomemory(fault.after, fault.after + fault.lasting)
        try:
            yield lambda: disk.count
        finally:
            _testcapi.remove_mem_hooks()


class _Disk:
    def __init__(self, fault: Fault) -> None:
        self.count = 0
        self._fault = fault

    def strike(self) -> None:
        fault, number = self._fault, self.count
        self.count += 1
        if fault.kind == DISK and number >= fault.after and not 0 < fault.lasting <= number - fault.after:
            raise OSError(fault.code, os.strerror(fault.code))

    @contextmanager
    def in_the_way(self) -> Iterator[None]:
        kept = {name: getattr(os, name) for name in CALLS}
        opened = Path.open

        def open_path(path: Path, mode: str = "r", *rest: Any, **named: Any) -> Any:  # noqa: ANN401
            file = opened(path, mode, *rest, **named)
            return file if mode[0] == "r" else _File(file, self)

        for name, call in kept.items():
            setattr(os, name, self._wrap(call))
        Path.open = open_path  # type: ignore[method-assign]
        try:
            yield
        finally:
            Path.open = opened  # type: ignore[method-assign]
            for name, call in kept.items():
                setattr(os, name, call)

    def _wrap(self, call: Callable[..., object]) -> Callable[..., object]:
        def strike(*arguments: object, **named: object) -> object:
            # Only what is asked to change the disk: reading is another matter.
            if call.__name__ != "open" or arguments[1] != os.O_RDONLY:  # type: ignore[misc]
                self.strike()
            return call(*arguments, **named)

        return strike


class _File:
    """A file of which the disk takes only the first half of what is written when the fault strikes."""

    def __init__(self, file: Any, disk: _Disk) -> None:  # noqa: ANN401
        self._file = file
        self._disk = disk

    def __getattr__(self, name: str) -> object:
        return getattr(self._file, name)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write(self, data: bytes) -> int:
        try:
            self._disk.strike()
        except OSError:
            self._file.write(data[: len(data) // 2])
            self._file.flush()
            raise
        return int(self._file.write(data))
