"""One run as the stages leave it: its tables, for a diagnosis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pipeline.recording import Finding
from pipeline.results import read_finding_table
from pipeline.run import MotionRun, load_run
from pipeline.sources import Vehicle

if TYPE_CHECKING:
    import polars as pl


@dataclass(frozen=True)
class DiagnosisInput:
    """One run as processed by the stages.

    Attributes:
        name: of the run.
        tables: `poses`, `alignments`, `commands`, `wheels`, `imu`, `slip`, `findings`; those that the log
            lacks may be absent.
        sha256: of the recording.
        path: of the log.
        length_scale_m: of the slip modulus [m].
    """

    name: str
    tables: Mapping[str, pl.DataFrame] = field(repr=False)
    sha256: str = ""
    path: str = ""
    length_scale_m: float = 1.0

    def list_findings(self) -> tuple[Finding, ...]:
        """Findings of the stages."""
        table = self.tables.get("findings")
        return () if table is None else read_finding_table(table)


def load_recording(recording: DiagnosisInput, vehicle: Vehicle) -> MotionRun:
    """The run as arrays."""
    return load_run(recording.tables, vehicle, name=recording.name, sha256=recording.sha256)
