"""Medians, intervals, permutation tests and effect sizes: functions of arrays, usable alone.

Slip is correlated from sample to sample, so samples are not what is counted: runs are, or blocks of one run
where there is only one. Nothing here knows of logs, tables or vehicles.
"""

from pipeline.fleet.statistics.changes import find_changes
from pipeline.fleet.statistics.correlation import integrated_time, number_blocks
from pipeline.fleet.statistics.effect_sizes import cliffs_delta, name_delta, shift_between
from pipeline.fleet.statistics.errors import StatisticsError
from pipeline.fleet.statistics.families import MOST_GROUPS, adjust_holm, adjust_max_t, runs_needed
from pipeline.fleet.statistics.intervals import (
    Interval,
    bootstrap_median,
    bound_difference,
    bound_mean,
    bound_shift,
    bound_typical,
)
from pipeline.fleet.statistics.levels import LevelFit, find_outlier, split_levels
from pipeline.fleet.statistics.orders import kendall_p, kendall_tau, list_swaps
from pipeline.fleet.statistics.pairs import Blocks, Comparison, compare_blocks, compare_runs, cut_blocks
from pipeline.fleet.statistics.permutation import DRAWS, permute_means, permute_studentized, smallest_p
from pipeline.fleet.statistics.posterior import draw_run
from pipeline.fleet.statistics.ranks import mann_whitney
from pipeline.fleet.statistics.shifts import FEWEST_FREE, find_shifts, guess_shift

__all__ = [
    "DRAWS",
    "FEWEST_FREE",
    "MOST_GROUPS",
    "Blocks",
    "Comparison",
    "Interval",
    "LevelFit",
    "StatisticsError",
    "adjust_holm",
    "adjust_max_t",
    "bootstrap_median",
    "bound_difference",
    "bound_mean",
    "bound_shift",
    "bound_typical",
    "cliffs_delta",
    "compare_blocks",
    "compare_runs",
    "cut_blocks",
    "draw_run",
    "find_changes",
    "find_outlier",
    "find_shifts",
    "guess_shift",
    "integrated_time",
    "kendall_p",
    "kendall_tau",
    "list_swaps",
    "mann_whitney",
    "name_delta",
    "number_blocks",
    "permute_means",
    "permute_studentized",
    "runs_needed",
    "shift_between",
    "smallest_p",
    "split_levels",
]
