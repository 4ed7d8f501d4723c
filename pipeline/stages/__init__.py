"""extract -> velocity -> slip -> aggregate: pure functions from tables to tables.

Each stage also returns findings: what it noticed and mended, or could not mend. Nothing here reads or
writes a file.
"""

from pipeline.stages.finding import Finding, StageError
