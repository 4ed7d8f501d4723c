"""Figures and one offline page for a run.

A figure is one file in `pipeline.report.figures`, a function from tables to a Vega-Lite chart; a section of
the page is a function from the report to values and a template that shows them. Numbers come from the tables
and the summary.
"""
