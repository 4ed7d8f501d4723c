"""Deployments side by side: datasets, pairs, difficulty, trends, and the map of the literature.

Tables in, tables out; whether a difference is one is asked of `pipeline.fleet.statistics`. Reading results
and drawing pages is the work of other rooms.
"""

from pipeline.fleet.datasets import pool_runs, read_day
from pipeline.fleet.errors import ComparisonError
from pipeline.fleet.pairs import Group, Pair, Samples, bound_run, compare_groups
from pipeline.fleet.published import follow_published, read_limits
from pipeline.fleet.runs import add_measures, gather_runs, label_runs, measure_difficulty

__all__ = [
    "ComparisonError",
    "Group",
    "Pair",
    "Samples",
    "add_measures",
    "bound_run",
    "compare_groups",
    "follow_published",
    "gather_runs",
    "label_runs",
    "measure_difficulty",
    "pool_runs",
    "read_day",
    "read_limits",
]
