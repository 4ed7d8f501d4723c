"""Medians, intervals, permutation tests and effect sizes: functions of arrays, usable alone.

Slip is correlated from sample to sample, so samples are not what is counted: runs are, or blocks of one run
where there is only one. Nothing here knows of logs, tables or vehicles.
"""
