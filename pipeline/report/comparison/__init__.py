"""Datasets side by side on one offline page.

The published figure (all windows of a dataset in one box) and the honest one beside it (runs as points, with
an interval over runs), the pairs with their tests, and the measures of difficulty that do not agree.
"""

from pipeline.report.comparison.page import list_pictures, render_comparison
