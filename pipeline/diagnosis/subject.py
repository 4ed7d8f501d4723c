"""What comes in: a run's tables, what the stages noticed, and corrections that are certain."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import msgspec

from pipeline.motion import load_run

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import polars as pl

    from pipeline.motion import MotionRun
    from pipeline.vehicles import Vehicle

# Where one of these stands, a fit means nothing: no effect is named.
FATAL = ("not_moving", "pose_from_wheels")


@dataclass(frozen=True)
class Recording:
    """One run as the stages left it.

    Attributes:
        name: of the run.
        tables: `poses`, `commands`, `wheels`, `imu`, `slip`, `findings`; those that the log lacks may miss.
        sha256: of the recording.
        path: of the log.
        hold_s: the controller stops this long after its last command; the usual rule when None.
    """

    name: str
    tables: Mapping[str, pl.DataFrame] = field(repr=False)
    sha256: str = ""
    path: str = ""
    hold_s: float | None = None

    def list_findings(self) -> list[dict[str, object]]:
        """What the stages noticed: id, text, where, severity and the number behind it."""
        table = self.tables.get("findings")
        if table is None or table.is_empty():
            return []
        kept = [name for name in ("id", "text", "where", "severity", "value") if name in table.columns]
        return table.select(kept).to_dicts()

    def find_value(self, name: str) -> float | None:
        """The number behind a finding, None without it."""
        for finding in self.list_findings():
            if finding["id"] == name and isinstance(finding.get("value"), float):
                return float(finding["value"])  # type: ignore[arg-type]
        return None


def correct_vehicle(recordings: Sequence[Recording], vehicle: Vehicle) -> Vehicle:
    """The vehicle with the controller's track multiplier that the log itself shows."""
    for recording in recordings:
        multiplier = recording.find_value("controller_multiplier")
        if multiplier is not None:
            return msgspec.structs.replace(vehicle, controller_track_multiplier=multiplier)
    return vehicle


def load_recording(recording: Recording, vehicle: Vehicle) -> MotionRun:
    """The run as arrays, its command brought to the scale that the measured wheels show."""
    run = load_run(
        recording.tables, vehicle, name=recording.name, sha256=recording.sha256, hold_s=recording.hold_s
    )
    scale = recording.find_value("command_scale")
    if scale is None or run.commands is None:
        return run
    told = run.commands
    return replace(run, commands=replace(told, left=scale * told.left, right=scale * told.right))
