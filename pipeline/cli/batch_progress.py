"""How a batch goes on, for people: a bar on a terminal, a line a log otherwise, with an estimate."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Self

from pipeline.cli.output import say, tidy_line
from pipeline.core.durations import say_duration

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from pipeline.batch.season import Line


class SilentWatch:
    """Says nothing."""

    def plan(self, todo: int, settled: int, size: int) -> None:
        """Ignored."""

    def tell(self, line: Line, size: int) -> None:
        """Ignored."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None


class LineWatch(SilentWatch):
    """One line a log on stderr."""

    def __init__(self) -> None:
        self._started = time.monotonic()
        self._todo = self._done = 0
        self._size = self._read = 0

    def plan(self, todo: int, settled: int, size: int) -> None:
        """Say how much there is to do."""
        self._begin(todo, size)
        say(f"{todo} logs to work on ({size / 1e6:.1f} MB), {settled} settled")

    def tell(self, line: Line, size: int) -> None:
        """Say what came of a log and how long the rest may take."""
        self._done += 1
        self._read += size
        what = f"{line.state}: {line.reason}" if line.reason else line.state
        left = f", about {say_duration(self.estimate_rest())} left" if self._done < self._todo else ""
        say(f"[{self._done}/{self._todo}] {line.run or line.path} {what} ({line.seconds:.1f} s){left}")

    def _begin(self, todo: int, size: int) -> None:
        self._todo, self._size = todo, size
        self._started = time.monotonic()

    def estimate_rest(self) -> float:
        """Seconds that the rest takes if a byte of it, or else a log, takes as long as those before."""
        share = self._read / self._size if self._read else self._done / self._todo
        return (time.monotonic() - self._started) * (1.0 - share) / share


class BarWatch(LineWatch):
    """A bar on a terminal; only what went wrong gets a line."""

    def __init__(self) -> None:
        super().__init__()
        from rich.console import Console  # noqa: PLC0415 - only for people at a terminal
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn  # noqa: PLC0415
        from rich.progress import Progress as Bar  # noqa: PLC0415

        columns = ("{task.description}", BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[left]}"))
        self._bar: Progress = Bar(*columns, console=Console(stderr=True))
        self._task: TaskID | None = None

    def plan(self, todo: int, settled: int, size: int) -> None:
        """Show the bar."""
        self._begin(todo, size)
        del settled
        self._task = self._bar.add_task("logs", total=todo, left="")
        self._bar.start()

    def tell(self, line: Line, size: int) -> None:
        """Move the bar on."""
        self._done += 1
        self._read += size
        if line.reason:
            text = tidy_line(f"{line.run or line.path} {line.state}: {line.reason}")
            self._bar.console.print(text, markup=False, highlight=False)
        if self._task is not None:
            left = f"about {say_duration(self.estimate_rest())} left" if self._done < self._todo else ""
            self._bar.update(self._task, advance=1, left=left)

    def __exit__(self, *_: object) -> None:
        self._bar.stop()


def open_watch(*, quiet: bool) -> SilentWatch:
    """Whoever fits the place: nobody, a bar, or lines."""
    if quiet:
        return SilentWatch()
    return BarWatch() if sys.stderr.isatty() else LineWatch()
