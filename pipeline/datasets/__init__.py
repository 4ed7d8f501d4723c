"""Runs together, in one model: a value is a level of the vehicle, of the ground, and of the run.

`levels` is that model; comparisons, causes, levels of a fleet and checks are tables that it fills. Pages are
drawn by `pipeline.report`.
"""

from typing import TYPE_CHECKING

from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.datasets.causes import *
    from pipeline.datasets.check import *
    from pipeline.datasets.check_readings import *
    from pipeline.datasets.compare import *
    from pipeline.datasets.compared_runs import *
    from pipeline.datasets.deployments import *
    from pipeline.datasets.fleet import *
    from pipeline.datasets.pairs import *
    from pipeline.datasets.pooling import *
    from pipeline.datasets.robots import *
    from pipeline.datasets.stored_fits import *
    from pipeline.datasets.trend import *
else:
    __getattr__ = open_door(
        __name__,
        {
            "causes": (
                "Budget",
                "Causes",
                "find_causes",
            ),
            "check": (
                "RunsCheck",
                "CheckedNumber",
                "check_runs",
                "read_limits",
            ),
            "check_readings": (
                "COMMANDED_TURN",
                "HEADING_ERROR",
                "MULTIPLIER",
                "POSITION_ERROR",
            ),
            "compare": (
                "ABOUT_UNIT",
                "AS_PUBLISHED",
                "EQUAL_DRIVING",
                "QUANTITIES",
                "Answer",
                "compare_results",
            ),
            "compared_runs": (
                "NOT_VALID",
                "Question",
                "find_material",
            ),
            "deployments": (
                "DeploymentMap",
                "draw_up_map",
            ),
            "fleet": (
                "Band",
                "Fleet",
                "fit_results",
            ),
            "pairs": (
                "ALIKE",
                "DIFFERENT",
                "OF_TWO_RUNS",
                "OTHERS_SPREAD",
                "OVER_RUNS",
                "THIS_RUN",
                "UNTESTED",
                "judge_pair",
            ),
            "pooling": (
                "MEASURES",
                "ComparisonError",
                "gather_runs",
                "pool_runs",
            ),
            "robots": ("note_robots",),
            "stored_fits": (
                "ModelContest",
                "ModelFit",
                "contest_models",
                "expect_model",
                "fit_to_runs",
                "judge_measured",
                "put_on_runs",
                "read_runs",
            ),
            "trend": (
                "Series",
                "Trend",
                "follow_trend",
            ),
        },
    )
