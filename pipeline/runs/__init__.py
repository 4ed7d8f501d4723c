"""One run as every model, diagnosis and page reads it: inputs, poses, gyro, its grid and its windows."""

from pipeline.runs.errors import MotionError
from pipeline.runs.heading import HeadingSource
from pipeline.runs.recording import MotionRun, load_run
