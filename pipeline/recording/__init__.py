"""The front door of a log: which signals are its command, its wheels and its pose, in which frame and unit.

Columns in, one `Recording` out: every question is decided here, with its evidence, its rivals and the line of
run.toml that decides otherwise, and nothing decides it again. The completed configuration holds the answers,
so that the stages after read a recording as a user could have described it by hand.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.recording.drive_alone import examine_drive
    from pipeline.recording.examination import Recording, examine

__all__ = ["FAULTS", "Recording", "examine", "examine_drive"]

FAULTS = (
    "signs_contradict",
    "command_reversed",
    "motor_reversed",
    "wheels_reversed",
    "wheel_dead",
    "pose_flipped",
    "steering_as_yaw_rate",
)
"""Findings each of which makes every fit meaningless."""


def __getattr__(name: str) -> object:
    # The verdict on a stored run needs the names of faults only.
    if name not in __all__:
        raise AttributeError(name)
    from pipeline.recording import drive_alone, examination  # noqa: PLC0415

    return getattr(drive_alone if name == "examine_drive" else examination, name)
