"""Batch processing of many logs: incremental, resumable, and robust against bad logs.

A batch finds the logs, skips those that are done, processes the rest on this machine or a cluster, and
reports the outcome of each log with its reason. The same command continues an interrupted batch.
"""

from pipeline.batch.request import (
    BatchError,
    Pruning,
    Request,
    Shard,
    count_cores,
    measure_memory,
    parse_memory_limit,
    parse_shard,
    parse_size,
)
