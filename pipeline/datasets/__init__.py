"""Runs together, in one model: a value is a level of the vehicle, of the ground, and of the run.

`levels` is that model; comparisons, causes, levels of a fleet and checks are tables that it fills. Pages are
drawn by `pipeline.report`.
"""

from typing import TYPE_CHECKING

from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.datasets.causes import Budget, Causes, find_causes
    from pipeline.datasets.check import Check, Number, check_runs, read_limits
    from pipeline.datasets.compare import (
        ABOUT_UNIT,
        AS_PUBLISHED,
        EQUAL_DRIVING,
        QUANTITIES,
        Answer,
        compare_results,
    )
    from pipeline.datasets.compared_runs import NOT_VALID, Question, find_material
    from pipeline.datasets.deployments import DeploymentMap, draw_up_map
    from pipeline.datasets.fleet import Band, Fleet, fit_results
    from pipeline.datasets.pairs import ALIKE, DIFFERENT, OF_TWO_RUNS, THIS_RUN, UNTESTED, judge_pair
    from pipeline.datasets.pooling import MEASURES, ComparisonError, gather_runs, pool_runs
    from pipeline.datasets.stored_fits import (
        ModelFit,
        contest_models,
        expect_model,
        fit_to_runs,
        judge_measured,
        put_on_runs,
        read_runs,
    )
    from pipeline.datasets.trend import Series, Trend, follow_trend
else:
    __getattr__ = open_door(__name__, __file__)
