"""Estimation: models fitted to runs, judged on data they have not seen, and what they lack.

`EstimationData` makes runs ready once, `fit_model` fits, `hold_out` scores, `climb` builds the ladder.
`diagnose_runs` takes the tables of one run, or of several of one vehicle, and says what the model lacks,
what is not observable, and what no effect of the catalogue explains.
"""

from typing import TYPE_CHECKING

from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.estimation.diagnose import *
    from pipeline.estimation.diagnosis import *
    from pipeline.estimation.estimation_data import *
    from pipeline.estimation.held_out import *
    from pipeline.estimation.intervals import *
    from pipeline.estimation.ladder import *
    from pipeline.estimation.model_fit import *
    from pipeline.estimation.model_state import *
    from pipeline.estimation.prediction import *
    from pipeline.estimation.recordings import *
    from pipeline.estimation.run_residuals import *
    from pipeline.estimation.transfer import *
else:
    __getattr__ = open_door(
        __name__,
        {
            "diagnose": (
                "diagnose_runs",
                "parse_budget",
            ),
            "diagnosis": ("Diagnosis",),
            "estimation_data": ("EstimationData",),
            "held_out": (
                "HeldOut",
                "hold_out",
                "score",
            ),
            "intervals": (
                "Estimates",
                "estimate_intervals",
            ),
            "ladder": ("climb",),
            "model_fit": (
                "Fitted",
                "fit_model",
            ),
            "model_state": (
                "Free",
                "ModelState",
            ),
            "prediction": (
                "Prediction",
                "predict_at",
                "predict_at_from",
                "predict_from",
            ),
            "recordings": (
                "DiagnosisInput",
                "load_recording",
            ),
            "run_residuals": (
                "Input",
                "RunResiduals",
                "choose_input",
            ),
            "transfer": ("carry_over",),
        },
    )
