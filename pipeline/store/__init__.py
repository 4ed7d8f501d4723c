"""The only writer of results: whole generations of tables, published in one moment.

A run is a folder. Its generations are numbered folders in it, of Parquet tables and texts, which never change
after their commit; its manifest says which number is the current one, and is replaced last. Lower numbers are
older, and go when results are pruned; a higher one is of a writer that is at work or was killed, and goes
when the next begins. So readers see the old results or the new ones, never a mix. One lock a run keeps
writers apart. Rows that break a contract are kept and counted.
"""

from typing import TYPE_CHECKING

from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.store.checksums import *
    from pipeline.store.files import *
    from pipeline.store.generation import *
    from pipeline.store.last_batch import *
    from pipeline.store.manifests import *
    from pipeline.store.names import *
    from pipeline.store.parquet_tables import *
    from pipeline.store.results_folder import *
    from pipeline.store.stored_files import *
    from pipeline.store.stored_runs import *
    from pipeline.store.verification import *
else:
    __getattr__ = open_door(
        __name__,
        {
            "checksums": ("LOG_NOTES", "LOG_STATES"),
            "files": (
                "hold_lock",
                "make_folder",
                "replace_file",
                "temporary_beside",
            ),
            "generation": ("Generation",),
            "last_batch": (
                "LAST_BATCH",
                "LastBatch",
                "read_last_batch",
            ),
            "manifests": (
                "JSON",
                "MANIFEST",
                "Manifest",
            ),
            "names": (
                "Sample",
                "StoreError",
                "TableEntry",
                "Tally",
                "date_runs",
                "encode_run",
                "name_damage",
                "no_results",
                "path_unread",
            ),
            "parquet_tables": (
                "CheckedTable",
                "check_size",
                "check_table",
                "to_arrow",
            ),
            "results_folder": (
                "Store",
                "list_old",
            ),
            "stored_files": (
                "SUMMARY",
                "convert_stored",
                "read_stored",
            ),
            "stored_runs": (
                "ANALYZE_FIRST",
                "DIAGNOSIS",
                "REPORT",
                "UPLOADS",
                "LogIdentities",
                "LogSighting",
                "NoRunsError",
                "add_digits",
                "find_log",
                "find_recorded_log",
                "find_run",
                "hash_json",
                "lack_runs",
                "locate_beside",
                "name_run",
                "read_choices",
                "read_length_scale",
                "recorded_path",
                "see_log",
                "stored_contexts",
                "stored_keys",
                "name_distinctly",
            ),
            "verification": (
                "RUNS",
                "Examination",
                "Problem",
            ),
        },
    )
