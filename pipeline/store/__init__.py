"""The only writer of results: whole generations of tables, published in one moment.

A run's results are a folder of Parquet tables and texts that never changes after its commit; the run's
manifest points at the current one and is replaced last. Killed at any moment, readers see the old results or
the new ones, never a mix, and the next writer cleans up. Rows that break a contract are kept and counted.
"""

from pipeline.store.generation import STEPS, Generation
from pipeline.store.identities import LogIdentities, LogSighting, see_log
from pipeline.store.manifest import JSON, Manifest, Partition
from pipeline.store.mirror import Mirror
from pipeline.store.names import StoreError, TableReport
from pipeline.store.results import Store
from pipeline.store.seals import LOG_NOTES
from pipeline.store.verification import Examination, Problem
