"""Figures and one offline page for a run.

A figure is one file in `pipeline.report.figures`, a function from tables to an Altair chart; a section of
the page is a function from the report to values and a template that shows them. Numbers come from the tables
and the summary.
"""

from pipeline.report.bundle import warm_bundle
from pipeline.report.diagnosed import view_diagnosis
from pipeline.report.errors import ReportError
from pipeline.report.export import FORMATS, make_charts, write_figures
from pipeline.report.page import render_report
from pipeline.report.run import RunReport

__all__ = [
    "FORMATS",
    "ReportError",
    "RunReport",
    "make_charts",
    "render_report",
    "view_diagnosis",
    "warm_bundle",
    "write_figures",
]
