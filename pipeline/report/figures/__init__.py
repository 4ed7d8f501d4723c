"""One figure, one file.

A module of this folder with a ``FIGURE`` is a figure of the report and of `slip analyze --figures`; nothing
else has to know of it. Its chart refers to rows by name (`Chart.of_rows`) and says in ``Drawing.rows`` what
they are, so that several figures share one block of data on the page.
"""

from pipeline.report.figures.figure import Drawing, list_figures
