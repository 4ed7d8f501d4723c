"""slip in Python: runs, diagnoses and models as objects, with the numbers of the command line.

Users import the names from `pipeline` itself; each is thin over the functions that the verbs call. What
cannot be done raises `SlipError`: one line that says what is wrong, where, and what to do.
"""

from pipeline.api.fitted_model import Fit, Model, effect
from pipeline.api.run import Check, Diagnosis, Run, analyze, check, load, table
from pipeline.core.program import SlipError
