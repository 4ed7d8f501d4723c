"""What a report is made of: the summary of a run and its tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pipeline.report.words import say_number

if TYPE_CHECKING:
    import polars as pl

    from pipeline.report.motion_view import MotionView

INPUTS = ("command", "measured")
INPUT_WORDS = {"command": "on command", "measured": "on measured wheels"}


@dataclass(frozen=True)
class RunReport:
    """A run as the report sees it.

    Attributes:
        summary: the JSON object of one run of ``slip analyze --json``.
        tables: tables by contract name (`commands`, `slip`, `windows`, ...); any may be missing or empty.
        diagnosis: the JSON object of one run of ``slip diagnose --json``; empty where there is none.
        motion: a model of the run; None where there is none.
        peers: median slip moduli [m/s] of comparable runs by input; empty where there are none.
        catalogue: address of the page over all runs, seen from the report; empty where there is none.
        planned: preview of the drive that was planned after it; empty where none was.
    """

    summary: Mapping[str, object]
    tables: Mapping[str, pl.DataFrame] = field(default_factory=dict)
    diagnosis: Mapping[str, object] = field(default_factory=dict)
    motion: MotionView | None = None
    peers: Mapping[str, Sequence[float]] = field(default_factory=dict)
    catalogue: str = ""
    planned: Mapping[str, object] = field(default_factory=dict)

    def table(self, name: str) -> pl.DataFrame | None:
        """A table that has rows, or None."""
        frame = self.tables.get(name)
        return None if frame is None or frame.is_empty() else frame

    @property
    def main_input(self) -> str:
        """The input whose numbers lead: the one the summary names, the command where both are there."""
        wanted = self.text("input")
        there = self.inputs
        if wanted in there:
            return wanted
        return there[0] if there else "command"

    @property
    def inputs(self) -> list[str]:
        """The inputs that there are numbers or slip for, command first."""
        found = set(self.part("by_input"))
        slip = self.table("slip")
        if slip is not None:
            found |= set(slip["input"].cast(str).unique())
        return [name for name in INPUTS if name in found]

    @property
    def ladder(self) -> list[dict[str, float | None]]:
        """Errors over 2 s, ``t`` [m] and ``r`` [rad], of the ideal model and with each named effect more."""
        rungs = objects_in(self.diagnosis, "ladder")
        return [{"t": number_in(rung, "t_mrmse_m"), "r": number_in(rung, "r_mrmse_rad")} for rung in rungs]

    @property
    def is_refused(self) -> bool:
        """Whether a finding makes every fit to the run meaningless, so that the diagnosis names nothing."""
        from pipeline.diagnosis.recording import FATAL  # noqa: PLC0415 - heavy

        return any(finding.get("id") in FATAL for finding in self.items("findings"))

    @property
    def undecided(self) -> list[tuple[str, str]]:
        """Effects that are as good as each other, and the manoeuvre that would tell them apart."""
        found = []
        for entry in objects_in(self.diagnosis, "undecided"):
            names = entry.get("candidates")
            between = " or ".join(map(str, names)) if isinstance(names, list) else ""
            found.append((between, str(entry.get("separate_by", ""))))
        return found

    @property
    def split(self) -> tuple[float | None, float | None, float | None]:
        """Shares of drivetrain, ground and cross term in the mean square of the slip on command."""
        split = self.part("split")
        return number_in(split, "drivetrain"), number_in(split, "ground"), number_in(split, "cross")

    def text(self, key: str) -> str:
        """A text of the summary; empty when it is not there."""
        value = self.summary.get(key)
        return value if isinstance(value, str) else ""

    def number(self, key: str) -> float | None:
        """A number of the summary, or None."""
        return number_in(self.summary, key)

    def part(self, key: str) -> Mapping[str, object]:
        """An object inside the summary; empty when it is not there."""
        return mapping_in(self.summary, key)

    def items(self, key: str) -> list[Mapping[str, object]]:
        """A list of objects inside the summary; empty when it is not there."""
        return objects_in(self.summary, key)


def number_in(source: Mapping[str, object], key: str) -> float | None:
    """A finite number under a key, or None."""
    value = source.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if abs(value) < float("inf") else None


def say_ends(source: Mapping[str, object], *, digits: int = 3) -> str:
    """An interval in words, from its ``low`` to its ``high``; empty without one."""
    low, high = number_in(source, "low"), number_in(source, "high")
    return "" if low is None else f"{say_number(low, digits=digits)} to {say_number(high, digits=digits)}"


def mapping_in(source: Mapping[str, object], key: str) -> Mapping[str, object]:
    """An object under a key; empty when it is not there."""
    value = source.get(key)
    return value if isinstance(value, Mapping) else {}


def objects_in(source: Mapping[str, object], key: str) -> list[Mapping[str, object]]:
    """A list of objects under a key; empty when it is not there, entries of other kinds left out."""
    value = source.get(key)
    if not isinstance(value, Sequence) or isinstance(value, str):
        return []
    return [entry for entry in value if isinstance(entry, Mapping)]


def numbers_in(source: Mapping[str, object], key: str) -> list[float | None]:
    """A list of numbers under a key; entries that are none become None."""
    value = source.get(key)
    if not isinstance(value, Sequence) or isinstance(value, str):
        return []
    return [number_in({"entry": entry}, "entry") for entry in value]
