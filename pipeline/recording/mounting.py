"""Where the poses are on the body: the angle to its course, and the point about which it turns.

A body on wheels moves along its own axis, but for a slide outward in turns. What is left aside goes with the
motion ahead where the frame of the poses is turned, and with the turning where they are of another point.
"""

from collections.abc import Sequence

import numpy as np

from pipeline.core import format_length
from pipeline.recording.case import Candidate, Case
from pipeline.recording.score import CLEAR, fit
from pipeline.sources import PoseContent
from pipeline.stages import Finding

_LEAST_RAD = 0.01
"""Least angle [rad] that is told: half a degree, as a sensor is mounted by hand."""
_LEAST_M = 0.02
"""Least distance [m] that is told, as a sensor's place is measured by hand."""


def report_mounting(case: Case, drives: Sequence[Candidate | None]) -> None:
    """Tell the angle and the place of poses that are not those of the body; either may be the ground's.

    Args:
        case: the log, its roles and signs settled.
        drives: what may drive the body, the surest first.
    """
    known = [one.reading for one in drives if one is not None and one.is_sure]
    pose = case.sources.pose
    is_plain = pose is not None and pose.content is PoseContent.POSE and "pose" not in case.changes
    if not known or known[0].explained is None or not is_plain or case.moves_sideways:
        return
    motion = known[0].explained.motion
    if motion.flip or motion.offset_deg:
        return
    ahead, elapsed = motion.body.real, motion.steps.end - motion.steps.start
    columns = np.column_stack([ahead, motion.yaw, ahead / elapsed * motion.yaw])
    made = fit(motion.body.imag, columns, motion.steps)
    (angle, lever, _), (of_angle, of_lever, _) = made.gains.tolist(), made.t.tolist()
    if abs(of_angle) > CLEAR and abs(angle) > _LEAST_RAD:
        degrees, given = np.degrees(angle), case.configuration.pose.heading_deg or 0.0
        text = (
            f"the body moves {abs(degrees):.1f} degrees (±{1.96 * abs(degrees / of_angle):.2g}) to the "
            f"{'left' if angle > 0.0 else 'right'} of the headings of {pose}: their frame is turned, or the "
            "body crabs, as on a bent axle or along a slope; no other signal tells which (heading_deg = "
            f"{given + degrees:.1f} under [pose] in run.toml turns it)"
        )
        case.findings.append(Finding("pose_angle", "info", text, where="pose", value=angle))
    if abs(of_lever) > CLEAR and abs(lever) > _LEAST_M and known[0].form != "steering":
        text = (
            f"the body turns about a point {format_length(abs(lever))} "
            f"(±{format_length(1.96 * abs(lever / of_lever))}) "
            f"{'behind' if lever > 0.0 else 'ahead of'} that of the poses of {pose}: they are of a sensor "
            "that is mounted there, or the wheels do not grip alike front and rear"
        )
        case.findings.append(Finding("pose_lever", "info", text, where="pose", value=lever))
