"""Slip against turning, over all runs of a results folder, with polars on the tables.

slip analyze run.mcap && python examples/where_it_turns.py results
"""

import sys

import polars as pl

import slip

steps = slip.table("slip", results=sys.argv[1] if len(sys.argv) > 1 else "results")
turning = (pl.col("f_w").abs() / 0.25).floor() * 0.25  # rad/s, lower edge
table = (
    steps.filter(~pl.col("suspect"), ~pl.col("standing"))
    .group_by("run", "input", turning_faster_than=turning)
    .agg(seconds=pl.len() / 20.0, median_modulus=pl.col("modulus").median(), bias_w=pl.col("g_w").mean())
    .sort("run", "input", "turning_faster_than")
)
with pl.Config(tbl_rows=-1, tbl_hide_dataframe_shape=True, float_precision=3):
    print(table.collect())
