"""Results of a diagnosis as data: ids, and numbers with units.

The search writes them, the results folder stores them, and every face shows them; `pipeline.words` makes the
sentences.
"""

from typing import TYPE_CHECKING

from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.results.reading import *
    from pipeline.results.structs import *
else:
    __getattr__ = open_door(
        __name__,
        {
            "reading": (
                "ABOVE_FLOOR",
                "BREVITY",
                "BUDGET_SLIP",
                "CAUSE_NAMES",
                "CHANCE",
                "CHANGE",
                "DETECTED_SHARE",
                "ERRORS_OVER_2S",
                "FATAL",
                "INTERVAL_SHARE",
                "SEARCH_CUT",
                "as_written",
                "find_refusal",
                "has_no_pose",
                "is_small",
                "key_finding",
                "list_added",
                "list_excess",
                "list_rises",
                "measure_excess",
                "parse_values",
                "rank_main",
                "read_diagnosed",
                "read_error",
                "read_finding_table",
                "read_findings",
                "read_model",
                "read_suggestion",
                "split_main",
            ),
            "structs": (
                "CommandedTurn",
                "DataNeed",
                "Delays",
                "Detectable",
                "Disturbance",
                "Errors",
                "EstimatedNumber",
                "GrownEvidence",
                "Growth",
                "Json",
                "Moments",
                "Moves",
                "Named",
                "Narrowing",
                "PathLadder",
                "Refused",
                "Region",
                "RunDiagnosis",
                "Share",
                "SlipBudget",
                "Stretch",
                "Step",
                "Undecided",
                "Unexplained",
                "Unobservable",
                "read_result",
                "to_json",
            ),
        },
    )
