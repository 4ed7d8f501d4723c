"""The only writer of results: whole generations of tables, published in one moment.

A run's results are a folder of Parquet tables and texts that never changes after its commit; the run's
manifest points at the current one and is replaced last. Killed at any moment, readers see the old results or
the new ones, never a mix, and the next writer cleans up. Rows that break a contract are kept and counted.
"""

from typing import TYPE_CHECKING

from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.store.checksums import LOG_NOTES, load_manifest, parse_manifest
    from pipeline.store.files import (
        JSON,
        MANIFEST,
        TEMPORARY,
        Manifest,
        Partition,
        hold_lock,
        make_folder,
        replace_file,
        temporary_beside,
    )
    from pipeline.store.generation import STEPS, Generation
    from pipeline.store.names import (
        Sample,
        StoreError,
        TableReport,
        Tally,
        check_home,
        date_runs,
        encode_run,
        name_damage,
        no_results,
        path_unread,
    )
    from pipeline.store.parquet_tables import (
        CheckedTable,
        check_size,
        check_table,
    )
    from pipeline.store.results_folder import RUNS, Store, scan_table
    from pipeline.store.stored_files import SUMMARY, convert_stored, decode_stored, read_stored
    from pipeline.store.stored_runs import (
        ANALYZE_FIRST,
        DIAGNOSIS,
        REPORT,
        UPLOADS,
        LogIdentities,
        LogSighting,
        NoRunsError,
        find_log,
        find_recorded_log,
        find_run,
        hash_json,
        lack_runs,
        locate_beside,
        name_plainly,
        name_run,
        read_choices,
        read_length_scale,
        see_log,
        stored_contexts,
        stored_keys,
    )
    from pipeline.store.verification import DiskFiles, Examination, Problem
else:
    __getattr__ = open_door(__name__, __file__)
