"""A Python function without dependencies that predicts poses from commands."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.models.python_text import write_function
from pipeline.models.target import Target

if TYPE_CHECKING:
    from pipeline.models.model_file import ModelFile
    from pipeline.models.target import Current


def write(file: ModelFile, current: Current) -> str:
    """The function: it says where the vehicle is, not what the localization reports.

    Raises:
        MotionError: ``not_exportable``, an effect is a class of the user's own or needs what a planner lacks.
    """
    del current
    return write_function(file.model)


TARGET = Target("python", "a function that predicts poses from commands", "the function's docstring", write)
