"""Estimation: models fitted to runs, judged on data they have not seen, and what they lack.

`EstimationData` makes runs ready once, `fit_model` fits, `hold_out` scores, `climb` builds the ladder.
`diagnose_runs` takes the tables of one run, or of several of one vehicle, and says what the model lacks,
what is not observable, and what no effect of the catalogue explains.
"""

from typing import TYPE_CHECKING

from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.estimation.diagnose import diagnose_runs, parse_budget
    from pipeline.estimation.diagnosis import Diagnosis
    from pipeline.estimation.errors import Errors
    from pipeline.estimation.estimation_data import EstimationData
    from pipeline.estimation.held_out import HeldOut, hold_out, score
    from pipeline.estimation.intervals import Estimates, estimate_intervals
    from pipeline.estimation.ladder import climb
    from pipeline.estimation.model_fit import Fitted, fit_model
    from pipeline.estimation.model_state import Free, ModelState
    from pipeline.estimation.prediction import Prediction, predict_at, predict_at_from, predict_from
    from pipeline.estimation.recordings import Recording, load_recording
    from pipeline.estimation.run_residuals import Input, RunResiduals, choose_input
    from pipeline.estimation.transfer import carry_over
else:
    __getattr__ = open_door(__name__, __file__)
