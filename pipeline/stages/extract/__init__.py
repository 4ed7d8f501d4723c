"""The extract stage: commands, wheels, poses and gyro out of a log, at their own stamps."""

from pipeline.stages.extract.reading import list_wanted
from pipeline.stages.extract.tables import Extracted, extract_tables
