"""Figures, discovered automatically.

A `Figure` in a module of this folder becomes part of the report and of `slip analyze --figures` without
further registration. Its chart refers to rows by name (`Chart.of_rows`), and ``Drawing.rows`` contains these
rows, so that several figures share one block of data on the page.
"""

from pipeline.report.figures.figure import Drawing, list_figures
