"""Diagnosis: where a model fails, and which physical effect it lacks.

`diagnose_runs` takes the tables of one run, or of several of one vehicle, and says what is missing from the
model, what this log cannot tell, and what no catalogued effect takes.
"""

from pipeline.diagnosis.diagnose import diagnose_runs
from pipeline.diagnosis.diagnosis import Diagnosis, Named, RunDiagnosis, Value
from pipeline.diagnosis.recording import Recording
