"""What a run knows, for the viewers people use: a derived MCAP, CSV, layouts for Foxglove and PlotJuggler.

Tables are read and written in batches, so that a day of driving needs no more memory than a minute.
"""

from pipeline.report.exports.csv import write_csv
from pipeline.report.exports.derived import write_derived_log
from pipeline.report.exports.foxglove import write_foxglove_layout
from pipeline.report.exports.plotjuggler import write_plotjuggler_layout
from pipeline.report.exports.source import ExportSource

__all__ = [
    "ExportSource",
    "write_csv",
    "write_derived_log",
    "write_foxglove_layout",
    "write_plotjuggler_layout",
]
