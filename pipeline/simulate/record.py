"""Write a simulated run as a log: the messages of its layout's topics, never a word of the truth."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.simulate.layouts import find_layout
from pipeline.simulate.messages import (
    command_sheets,
    cut_gaps,
    decoy_sheets,
    imu_sheets,
    pose_sheets,
    state_sheets,
    static_sheets,
    wheel_sheets,
)
from pipeline.simulate.stamps import stamp_times

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.simulate.run import SimulatedRun


def write_log(run: SimulatedRun, path: Path) -> None:
    """Write a run as an MCAP log; the same run gives the same bytes.

    Args:
        run: what was simulated.
        path: file to write; its folder must exist.

    Raises:
        SimulateError: ``unknown_layout`` or ``wrong_vehicle``, before anything is written.
    """
    # Naming cases and effects on the command line must not wait for the writer.
    from pipeline.logs import LogWriter  # noqa: PLC0415

    scenario = run.scenario
    layout = find_layout(scenario.recording.layout, scenario.vehicle)
    sheets = [
        *command_sheets(run, layout),
        *wheel_sheets(run, layout),
        *pose_sheets(run, layout.pose),
        *static_sheets(run, layout),
        *imu_sheets(run, layout),
        *state_sheets(run),
        *decoy_sheets(run),
    ]
    with LogWriter(path) as writer:
        for sheet in cut_gaps(run, sheets):
            header = None if sheet.header_s is None else stamp_times(scenario.clock, sheet.header_s)
            writer.write_columns(
                sheet.topic,
                sheet.type_name,
                stamp_times(scenario.clock, sheet.log_s),
                sheet.fields,
                header_time=header,
            )
        if scenario.recording.deployment == "written":
            writer.metadata(
                "deployment", {"vehicle": scenario.vehicle.name, "terrain": scenario.recording.terrain}
            )
