"""The align stage: what is wrong with a recording is put right once, and stored.

Clocks, the latency of poses, outliers of the localization, the gyro's sign, scale and bias, the scale of
commands and how long they are held: corrections are columns of the stored tables and findings, and whoever
reads the run reads it corrected.
"""

from pipeline.stages.align.align import Aligned, align_tables
