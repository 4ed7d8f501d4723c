"""Motion models: a vehicle plus physical effects, fitted to runs and judged on data the fit has not seen.

`Model` composes effects along a command's way; `Problem` makes runs ready once, `fit_model` fits, `hold_out`
scores, `climb` builds the ladder. The ideal models stand in `pipeline.vehicles.kinematics`.
"""

from pipeline.motion.catalogue import find_effect, list_effects
from pipeline.motion.comparison import Comparison, Input
from pipeline.motion.effect import (
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
from pipeline.motion.errors import MotionError
from pipeline.motion.fit import Fitted, fit_model
from pipeline.motion.floor import estimate_floor
from pipeline.motion.forward import Timing
from pipeline.motion.heading import HeadingSource
from pipeline.motion.inputs import InputChoice, choose_input
from pipeline.motion.intervals import Estimate, Estimates, estimate_intervals
from pipeline.motion.ladder import Ladder, Rung, climb
from pipeline.motion.model import Model
from pipeline.motion.model_file import ModelFile, read_model
from pipeline.motion.model_text import write_model
from pipeline.motion.predict import Prediction, predict, predict_at, predict_at_from, predict_from
from pipeline.motion.problem import Free, Problem, State
from pipeline.motion.recording import MotionRun, load_run
from pipeline.motion.robust import Weights
from pipeline.motion.score import Errors, HeldOut, hold_out, score
from pipeline.motion.transfer import Transfer, carry_over

__all__ = [
    "AddedEffect",
    "BodyEffect",
    "CommandEffect",
    "Comparison",
    "DriveEffect",
    "Effect",
    "Errors",
    "Estimate",
    "Estimates",
    "Excitation",
    "Fitted",
    "Free",
    "HeadingSource",
    "HeldOut",
    "Input",
    "InputChoice",
    "KinematicEffect",
    "Ladder",
    "LinearEffect",
    "Model",
    "ModelFile",
    "MotionError",
    "MotionRun",
    "Parameter",
    "Place",
    "Prediction",
    "Problem",
    "ReportEffect",
    "Rung",
    "Search",
    "State",
    "Timing",
    "Transfer",
    "Weights",
    "carry_over",
    "choose_input",
    "climb",
    "estimate_floor",
    "estimate_intervals",
    "find_effect",
    "fit_model",
    "hold_out",
    "list_effects",
    "load_run",
    "predict",
    "predict_at",
    "predict_at_from",
    "predict_from",
    "read_model",
    "score",
    "write_model",
]
