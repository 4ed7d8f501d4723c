"""System identification: models fitted to runs and judged on data that the fit has not seen.

`Problem` makes runs ready once, `fit_model` fits, `hold_out` scores, `climb` builds the ladder.
"""

from pipeline.identification.comparison import Comparison, Input
from pipeline.identification.fit import Fitted, fit_model
from pipeline.identification.inputs import InputChoice, choose_input
from pipeline.identification.intervals import Estimate, Estimates, estimate_intervals
from pipeline.identification.ladder import Ladder, Rung, climb
from pipeline.identification.predict import Prediction, predict, predict_at, predict_at_from, predict_from
from pipeline.identification.problem import Problem
from pipeline.identification.scoring import Errors, HeldOut, hold_out, score
from pipeline.identification.state import Free, State
from pipeline.identification.transfer import Transfer, carry_over
from pipeline.identification.weights import Weights

__all__ = [
    "Comparison",
    "Errors",
    "Estimate",
    "Estimates",
    "Fitted",
    "Free",
    "HeldOut",
    "Input",
    "InputChoice",
    "Ladder",
    "Prediction",
    "Problem",
    "Rung",
    "State",
    "Transfer",
    "Weights",
    "carry_over",
    "choose_input",
    "climb",
    "estimate_intervals",
    "fit_model",
    "hold_out",
    "predict",
    "predict_at",
    "predict_at_from",
    "predict_from",
    "score",
]
