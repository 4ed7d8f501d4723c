"""Comparison of deployments: datasets, pairs, difficulty, trends, and the map of the literature.

Input and output are tables; `pipeline.fleet.rank_tests` holds the significance tests. Other packages read the
results and draw the pages.
"""
