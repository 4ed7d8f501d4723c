"""Motion models: a vehicle plus physical effects, and the files they are kept in.

`Model` composes effects along a command's way; the ideal models stand in `pipeline.sources.kinematics`.
"""

from pipeline.models.catalogue import find_effect, list_effects
from pipeline.models.effect import (
    AddedEffect,
    BodyEffect,
    CommandEffect,
    DriveEffect,
    Effect,
    Excitation,
    KinematicEffect,
    LinearEffect,
    Parameter,
    Place,
    ReportEffect,
    Search,
)
from pipeline.models.model import Model, Timing
from pipeline.models.model_file import ModelFile, read_model
from pipeline.models.model_text import write_model
