"""slip in Python: one function a question, with the numbers and the files of the command line.

Users import names from `slip`; the command line parses, calls one of these functions and shows what it
returns. What cannot be done raises `SlipError`: one line that says what is wrong, where, and what to do.
"""

from typing import TYPE_CHECKING

from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.api.comparisons import *
    from pipeline.api.diagnoses import *
    from pipeline.api.drives import *
    from pipeline.api.fitted_model import *
    from pipeline.api.model_changes import *
    from pipeline.api.opening import *
    from pipeline.api.runs import *
    from pipeline.core import SlipError
    from pipeline.datasets import Question
    from pipeline.export import list_omitted, require_errors
    from pipeline.export.data_formats import dump_model
else:
    __getattr__ = open_door(
        __name__,
        {
            "comparisons": (
                "Question",
                "compare_causes",
                "compare_datasets",
                "draw_map",
                "follow_trend",
                "read_fleet",
                "split_names",
                "write_fleet",
            ),
            "diagnoses": (
                "diagnose_together",
                "parse_budget",
                "read_slip",
            ),
            "drives": (
                "check_drive",
                "list_plan_files",
                "plan_drive",
                "suggest_plan",
            ),
            "fitted_model": (
                "Fit",
                "Model",
                "effect",
                "effects",
                "load_effects",
            ),
            "model_changes": (
                "carry_models",
                "change_model",
                "contest_models",
                "dump_model",
                "expect_model",
                "export_file",
                "find_speeds",
                "list_omitted",
                "require_errors",
            ),
            "opening": (
                "ReadRun",
                "read_run",
            ),
            "runs": (
                "Check",
                "Diagnosis",
                "Run",
                "SlipError",
                "analyze",
                "check",
                "load",
                "table",
            ),
        },
    )
