"""The page from top to bottom: how bad, where, why, what now; first in short, then with figures.

Health of the log and provenance come last. A section is a function from the page to values and a template
that shows them; one that has nothing to say is left out.
"""

from pipeline.report.sections.glance import view_glance
from pipeline.report.sections.health import view_health
from pipeline.report.sections.how_bad import view_how_bad
from pipeline.report.sections.page import Page, PageSection
from pipeline.report.sections.provenance import view_provenance
from pipeline.report.sections.what_now import view_what_now
from pipeline.report.sections.where import view_where
from pipeline.report.sections.why import view_why

SECTIONS = (
    PageSection("glance", "At a glance", view_glance),
    PageSection("how-bad", "How bad", view_how_bad),
    PageSection("where", "Where", view_where),
    PageSection("why", "Why", view_why),
    PageSection("what-now", "What now", view_what_now),
    PageSection("health", "Data health", view_health),
    PageSection("provenance", "Provenance", view_provenance),
)

__all__ = ["SECTIONS", "Page", "PageSection"]
