"""Runs together: datasets and their differences, levels of parameters, forecasts, trends, a map, checks.

Input and output are tables. `rank_tests` holds the significance tests; pages are drawn by `pipeline.report`.
"""

from typing import TYPE_CHECKING

from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.datasets.causes import (
        Budget,
        Causes,
        Difference,
        find_causes,
        list_differences,
        name_causes,
        summarize_causes,
        tabulate_budgets,
        tabulate_differences,
    )
    from pipeline.datasets.changes import Change
    from pipeline.datasets.check import (
        BROKEN,
        Check,
        Limits,
        check_as_json,
        check_runs,
        find_pace,
        keep_baseline,
        read_limits,
    )
    from pipeline.datasets.check_readings import (
        ERRORS,
        HEADING_ERROR,
        LOGARITHMS,
        MULTIPLIER,
        POSITION_ERROR,
        Label,
    )
    from pipeline.datasets.check_sides import Baseline, read_baseline
    from pipeline.datasets.compare import compare_results
    from pipeline.datasets.compared_runs import NOT_VALID, Question, find_material, read_digest
    from pipeline.datasets.deployments import (
        DeploymentMap,
        draw_up_map,
    )
    from pipeline.datasets.equal_driving import LEAST_SAMPLES, SPEED_EDGES, TURN_EDGES
    from pipeline.datasets.forecast import FleetModel, Forecast, expect_values, forecast_vehicle, list_held
    from pipeline.datasets.pairs import (
        ABOUT_BLOCKS,
        ABOUT_UNIT,
        ALIKE,
        AS_DRIVEN,
        AS_PUBLISHED,
        DIFFERENT,
        EQUAL_DRIVING,
        NO_SPREAD,
        OF_TWO_RUNS,
        UNTESTED,
        Answer,
        View,
        compare_orders,
        foresee_pairs,
        judge_pair,
    )
    from pipeline.datasets.pooling import (
        MEASURES,
        THIS_RUN,
        WHISKER_REACH,
        ComparisonError,
        Measure,
        gather_runs,
        pool_runs,
    )
    from pipeline.datasets.prediction import (
        FLEET,
        find_estimates,
        fit_results,
        make_model_file,
        predict_deployment,
        read_fleet,
        summarize_fleet,
        summarize_prediction,
        tabulate_fleet,
    )
    from pipeline.datasets.rank_tests import kendall_tau, list_swaps
    from pipeline.datasets.stored_fits import Against, ModelFit, contest_models, fit_to_runs, read_runs
    from pipeline.datasets.trend import (
        TREND,
        ParameterTrend,
        Series,
        Trend,
        check_limits,
        follow_trend,
        format_change,
        format_power,
        format_quiet,
        name_quantity,
        summarize_trend,
    )
else:
    __getattr__ = open_door(__name__, __file__)
