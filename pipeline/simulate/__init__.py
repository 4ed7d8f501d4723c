"""Logs with known physics: for teaching, and for judging the estimators.

A `Scenario` says everything about a run; `simulate_run` drives it and `write_log` records it. The
physics is written here a second time, independently: nothing is shared with the models that are fitted.
"""
