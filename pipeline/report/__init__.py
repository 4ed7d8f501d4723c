"""Figures and the offline page of a run.

A figure is one file in `pipeline.report.figures`: a function from tables to a Vega-Lite chart. A section of
the page is a function from the report to values, and a template that shows them. All numbers come from the
tables and the summary.
"""
