"""The front door of a log: which signals are its command, its wheels and its pose, in which frame, sign and unit.

Columns in, one `Recording` out: every question is decided here, with its evidence, its rivals and the line of run.toml
that decides otherwise, and nothing decides it again. The completed configuration holds the answers, so that the stages
after read a recording as a user could have described it by hand.
"""

from pipeline.recording.evidence import Length
from pipeline.recording.examination import FAULTS, Geometry, Recording, examine

__all__ = ["FAULTS", "Geometry", "Length", "Recording", "examine"]
