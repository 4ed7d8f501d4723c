"""Deployments side by side: datasets, pairs, difficulty, trends, and the map of the literature.

Tables in, tables out; whether a difference is one is asked of `pipeline.fleet.rank_tests`. Reading results
and drawing pages is the work of other rooms.
"""
