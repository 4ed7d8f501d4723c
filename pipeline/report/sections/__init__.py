"""The page from top to bottom: how bad, where, why, what now; first in short, then with figures.

Health of the log and provenance come last. A section is a function from the page to HTML; one that has
nothing to say returns an empty text and is left out.
"""

from pipeline.report.sections.glance import render_glance
from pipeline.report.sections.health import render_health
from pipeline.report.sections.how_bad import render_how_bad
from pipeline.report.sections.page import Page, PageSection
from pipeline.report.sections.provenance import render_provenance
from pipeline.report.sections.what_now import render_what_now
from pipeline.report.sections.where import render_where
from pipeline.report.sections.why import render_why

SECTIONS = (
    PageSection("glance", "At a glance", render_glance),
    PageSection("how-bad", "How bad", render_how_bad),
    PageSection("where", "Where", render_where),
    PageSection("why", "Why", render_why),
    PageSection("what-now", "What now", render_what_now),
    PageSection("health", "Data health", render_health),
    PageSection("provenance", "Provenance", render_provenance),
)

__all__ = ["SECTIONS", "Page", "PageSection"]
