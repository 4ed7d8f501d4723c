"""System identification: models fitted to runs and judged on data that the fit has not seen.

`Problem` makes runs ready once, `fit_model` fits, `hold_out` scores, `climb` builds the ladder.
"""

from pipeline.identification.comparison import Comparison, Input
from pipeline.identification.fit import Fitted, fit_model
from pipeline.identification.inputs import InputChoice, choose_input
from pipeline.identification.intervals import Estimates, estimate_intervals
from pipeline.identification.ladder import climb
from pipeline.identification.predict import Prediction, predict_at, predict_at_from, predict_from
from pipeline.identification.problem import Problem
from pipeline.identification.scoring import Errors, HeldOut, hold_out, score
from pipeline.identification.state import Free, State
from pipeline.identification.transfer import carry_over
