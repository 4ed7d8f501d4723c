"""One run as every model, diagnosis and page reads it: inputs, poses, gyro, its grid and its windows."""

from pipeline.run.heading import HeadingSource
from pipeline.run.recording import MotionError, MotionRun, load_run
