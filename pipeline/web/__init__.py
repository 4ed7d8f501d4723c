"""The workbench: a local page where one sees where a model fails, adds an effect, and watches the error fall.

State lives in files beside the results, so the page can be reloaded at any time; what is drawn are the
figures of the report. The server listens on the loopback only unless asked, lets in only who has its token,
and refuses what another page sends. Logs are worked on in a process of its own, with limits.
"""

from pipeline.web.answers import Limits, WorkbenchError
from pipeline.web.server import build_app, is_loopback, serve
