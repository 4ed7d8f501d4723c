"""What comes in: a run's tables, and what the stages noticed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pipeline.runs import MotionRun, load_run
from pipeline.stages.wiring import FAULTS

if TYPE_CHECKING:
    from collections.abc import Mapping

    import polars as pl

    from pipeline.vehicles import Vehicle

# Where one of these stands, a fit means nothing: no effect is named.
FATAL = ("not_moving", "pose_from_wheels", *FAULTS)


@dataclass(frozen=True)
class Recording:
    """One run as the stages left it.

    Attributes:
        name: of the run.
        tables: `poses`, `alignments`, `commands`, `wheels`, `imu`, `slip`, `findings`; those that the
            log lacks may miss.
        sha256: of the recording.
        path: of the log.
        length_scale_m: of the slip modulus [m].
    """

    name: str
    tables: Mapping[str, pl.DataFrame] = field(repr=False)
    sha256: str = ""
    path: str = ""
    length_scale_m: float = 1.0

    def list_findings(self) -> list[dict[str, object]]:
        """What the stages noticed: id, text, where, severity and the number behind it."""
        table = self.tables.get("findings")
        if table is None or table.is_empty():
            return []
        kept = [name for name in ("id", "text", "where", "severity", "value") if name in table.columns]
        return table.select(kept).to_dicts()


def load_recording(recording: Recording, vehicle: Vehicle) -> MotionRun:
    """The run as arrays."""
    return load_run(recording.tables, vehicle, name=recording.name, sha256=recording.sha256)
