"""Figures, found by being here.

A `Figure` in a module of this folder is a figure of the report and of `slip analyze --figures`; nothing
else has to know of it. Its chart refers to rows by name (`Chart.of_rows`) and says in ``Drawing.rows`` what
they are, so that several figures share one block of data on the page.
"""

from pipeline.report.figures.figure import Drawing, list_figures
