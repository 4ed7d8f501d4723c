"""Many logs, every night: incremental, resumable, one bad log costs nothing but itself.

A batch finds the logs, leaves alone what is done, works on the rest in processes of this machine or of a
cluster, and ends with what became of each log and why. Doing the same again is how it is continued.
"""

from pipeline.batch.request import (
    BatchError,
    Pruning,
    Request,
    Shard,
    count_cores,
    measure_memory,
    parse_shard,
    parse_size,
)
