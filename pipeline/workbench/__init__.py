"""The workbench: a local page where one sees where a model fails, adds an effect, and watches the error fall.

State lives in files beside the results, so the page can be reloaded at any time; what is drawn are the
figures of the report. The server listens on the loopback only unless asked, and refuses what another page
sends.
"""

from pipeline.workbench.app import build_app
from pipeline.workbench.errors import WorkbenchError
from pipeline.workbench.server import serve

__all__ = ["WorkbenchError", "build_app", "serve"]
