"""A Python function without dependencies that predicts poses from commands.

It says where the vehicle is, not what the localization reports.
"""

from pipeline.export.python_text import write_function
from pipeline.export.target import Target

TARGET = Target(
    "python",
    "a function that predicts poses from commands",
    "the function's docstring",
    lambda file, _current: write_function(file.model),
)
