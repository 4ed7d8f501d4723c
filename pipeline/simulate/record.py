"""Write a simulated run as a log: the messages of its layout's topics, never a word of the truth."""

from pathlib import Path

import numpy as np

from pipeline.core.arrays import Ints
from pipeline.simulate import messages
from pipeline.simulate.layouts import find_layout
from pipeline.simulate.messages import Field
from pipeline.simulate.protobuf import is_protobuf, write_protobuf
from pipeline.simulate.published import publish
from pipeline.simulate.run import SimulatedRun
from pipeline.simulate.stamps import stamp_headers, stamp_times

_BOOTED_NS = 100_000_000_000


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
    sheets = (
        publish(run, layout.topics)
        if layout.topics
        else [
            *messages.command_sheets(run, layout),
            *messages.wheel_sheets(run, layout),
            *messages.pose_sheets(run, layout.pose),
            *messages.static_sheets(run, layout),
            *messages.imu_sheets(run, layout),
            *messages.state_sheets(run),
            *messages.decoy_sheets(run),
        ]
    )
    if layout.topics and all(is_protobuf(topic.type_name) for topic in layout.topics):
        write_protobuf(messages.cut_gaps(run, sheets), scenario.clock, path)
        return
    with LogWriter(path) as writer:
        for sheet in messages.cut_gaps(run, sheets):
            header = None if sheet.header_s is None else stamp_headers(scenario.clock, sheet.header_s)
            if header is not None and sheet.topic in scenario.recording.zero_stamps:
                header = np.zeros_like(header)
            fields = sheet.fields
            if header is not None and sheet.stamp != "header":
                fields, header = fields | _write_stamp(sheet.stamp, header, scenario.clock.start_ns), None
            writer.write_columns(
                sheet.topic,
                sheet.type_name,
                stamp_times(scenario.clock, sheet.log_s),
                fields,
                header_time=header,
            )
        if scenario.recording.deployment == "written":
            writer.metadata(
                "deployment", {"vehicle": scenario.vehicle.name, "terrain": scenario.recording.terrain}
            )


def _write_stamp(field: str, stamps: Ints, start_ns: int) -> dict[str, Field]:
    """Fields of a stamp [ns] outside a header; a counter of microseconds began some time before the run."""
    if field.startswith("timestamp"):
        return {field: ((stamps - start_ns + _BOOTED_NS) // 1000).astype(np.float64)}
    seconds, rest = np.divmod(stamps, 1_000_000_000)
    return {f"{field}.sec": seconds.astype(np.float64), f"{field}.nanosec": rest.astype(np.float64)}
