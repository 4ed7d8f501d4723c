"""Motion models: a vehicle plus physical effects, and their files.

`Model` composes effects along the command path; the ideal models are in `pipeline.sources.kinematics`.
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
