"""Motion models: a vehicle plus physical effects, and their files.

`Model` composes effects along the command path; the ideal models are in `pipeline.sources.kinematics`.
"""

from typing import TYPE_CHECKING

from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.models.catalogue import *
    from pipeline.models.effect import *
    from pipeline.models.expression import *
    from pipeline.models.families import Delay, Filtered, Lag, Ramp, Written, list_terms
    from pipeline.models.formula import *
    from pipeline.models.literature import *
    from pipeline.models.model import *
    from pipeline.models.model_file import *
    from pipeline.models.model_text import *
    from pipeline.models.number import *
    from pipeline.models.parameter import *
    from pipeline.models.step import *
else:
    __getattr__ = open_door(
        __name__,
        {
            "catalogue": (
                "draft_effect",
                "explain_idle",
                "find_effect",
                "find_late_effect",
                "is_own",
                "list_effects",
                "list_own_effects",
                "list_pages",
                "load_effects",
                "name_effect",
                "name_number",
                "name_term",
                "refuse_taken",
                "suggest_manoeuvre",
            ),
            "effect": (
                "ANY",
                "AddedEffect",
                "Effect",
                "Late",
                "LinearEffect",
                "Place",
                "ReportEffect",
                "find_late",
            ),
            "expression": ("Expression",),
            "families": (
                "Delay",
                "Filtered",
                "Lag",
                "Ramp",
                "Written",
                "list_terms",
            ),
            "formula": (
                "CHANNELS",
                "FormulaEffect",
                "make_parameter",
            ),
            "literature": (
                "LiteratureModel",
                "find_model",
                "list_literature",
                "list_models",
            ),
            "model": (
                "ForwardModel",
                "Model",
                "Timing",
                "replace_context",
            ),
            "model_file": (
                "CONTRADICTED",
                "ModelFile",
                "parse_model",
                "read_model",
            ),
            "model_text": (
                "check_target",
                "format_effect",
                "format_model",
                "format_value",
                "write_model",
                "write_text",
            ),
            "number": (
                "AT_BOUND",
                "FEWEST_STRETCHES",
                "FEW_STRETCHES",
                "ONE_LIMIT",
                "TOO_SHORT",
                "UNDECIDED",
                "DOUBTS",
                "Interval",
                "Number",
                "expect_another_run",
                "split_determined",
            ),
            "parameter": (
                "EXCEEDED_SHARE",
                "LEAST_DELAY_S",
                "OVERSHOOT",
                "STANDING",
                "Asked",
                "Conditions",
                "Excitation",
                "Largest",
                "Least",
                "Level",
                "Parameter",
                "Quantity",
                "Meaning",
                "Search",
                "cut_interval",
                "is_of_one_run",
                "stands_at_bound",
            ),
            "step": ("predict_step", "time_rise"),
        },
    )
