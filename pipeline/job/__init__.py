"""One log through all stages and its report; keys of what is done.

A job settles what a log is and which topics serve, runs the stages whose key has changed, and publishes
tables, summary and report in one moment.
"""

from pipeline.job.options import Options
