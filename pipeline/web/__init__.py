"""The workbench: a local page to see where a model fails, to add effects, and to see the error decrease.

State is stored in files with the results, so the page can be reloaded at any time; the figures are those of
the report. The server listens only on the loopback by default, requires a token, and rejects requests from
other pages. Logs are processed in a separate process with limits of time and memory.
"""

from pipeline.web.answers import Limits, WorkbenchError
from pipeline.web.server import build_app, is_loopback, serve
