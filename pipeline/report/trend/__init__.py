"""Quantities of vehicles over the dates of their runs, on one offline page.

A panel each, runs as points, levels as lines, steps named.
"""

from pipeline.report.trend.page import render_trend

__all__ = ["render_trend"]
