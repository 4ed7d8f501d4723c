"""The front door of a log: which signals are its command, its wheels and its pose, in which frame and unit.

Columns in, tables at one clock and one `Recording` out: every question of `examination.QUESTIONS` is decided
here, with its evidence, its rivals and the line of run.toml that decides otherwise, and nothing decides it
again. The completed configuration holds the answers, so that the stages after take a recording as a user
could have described it by hand.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.core import INPUTS, SlipError
from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.recording.case import *
    from pipeline.recording.clocks import *
    from pipeline.recording.drive import *
    from pipeline.recording.echo import *
    from pipeline.recording.examination import *
    from pipeline.recording.extract import *
    from pipeline.recording.findings import *
    from pipeline.recording.hypotheses import *
    from pipeline.recording.log_columns import *
    from pipeline.recording.lost_messages import *
    from pipeline.recording.motion import *
    from pipeline.recording.pose_choice import *
    from pipeline.recording.pose_topics import *
    from pipeline.recording.topic_values import *
else:
    __getattr__ = open_door(
        __name__,
        {
            "case": ("are_apart",),
            "clocks": ("find_pauses",),
            "drive": ("SIGNALS", "interpolate_readings"),
            "echo": ("check_echo",),
            "examination": ("Recording", "examine"),
            "extract": ("Extracted", "Extraction", "Given", "extract_tables"),
            "findings": ("SURE", "Finding", "Severity", "StageError", "blame_damage"),
            "hypotheses": ("BLOCK_S", "LASTS_NATS", "follow_likeliest", "price_change"),
            "log_columns": ("LogColumns",),
            "lost_messages": ("number_gaps",),
            "motion": ("ONE_SCALE", "find_one_ratio"),
            "pose_choice": ("PoseRating", "measure_rest"),
            "pose_topics": ("POSE_FINDINGS", "SLOW_HZ"),
            "topic_values": ("list_wanted",),
        },
    )


class RecordingError(SlipError):
    """A log that lacks what an analysis needs: messages, a pose, or commands and measured wheels."""


@dataclass(frozen=True, kw_only=True)
class LogOptions:
    """What a user says of a log before it is read.

    Attributes:
        config: configuration file to use instead of the one beside the log.
        fleet: fleet file to apply to the log wherever it is, in addition to those in the folders above it.
        listed: path of the log by the links that lead to it; None for the path that is given.
        overrides: configuration values from the command line, nested like the file.
        inputs: inputs to compute slip for.
        max_inflated: limit of the decompressed size of a log's chunks [bytes]; None for one by its file size.
    """

    config: Path | None = None
    fleet: Path | None = None
    listed: Path | None = None
    overrides: Mapping[str, object] = field(default_factory=dict)
    inputs: tuple[str, ...] = INPUTS
    max_inflated: int | None = None


MISREAD = ("configured_wrongly", "kept_as_recorded")
"""Findings on lines of run.toml that the other signals contradict."""
FAULTS = (
    *MISREAD,
    "wheels_scaled",
    "vehicle_by_motion",
    "wheelbase_contradicted",
    "signs_contradict",
    "command_reversed",
    "command_of_map",
    "commands_mixed",
    "tracks_mixed",
    "not_driven",
    "pose_contradicts_itself",
    "motor_reversed",
    "wheels_reversed",
    "wheel_dead",
    "pose_flipped",
)
"""Findings each of which makes every fit meaningless."""
