"""A run as models, diagnosis and pages read it: inputs, poses, gyro, grid and windows."""

from pipeline.run.heading import HeadingSource
from pipeline.run.recording import MotionError, MotionRun, load_run
