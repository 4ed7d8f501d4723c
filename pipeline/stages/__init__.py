"""velocity -> slip -> aggregate: pure functions from the tables of a recording to tables.

Each stage also returns findings: faults that it corrected or could not correct. No stage reads or writes a
file.
"""

from typing import TYPE_CHECKING

from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.stages.align import *
    from pipeline.stages.checks import *
    from pipeline.stages.inputs import *
    from pipeline.stages.slip_stage import *
else:
    __getattr__ = open_door(
        __name__,
        {
            "align": ("align_tables",),
            "checks": (
                "WRONG_RADIUS",
                "find_gain_of",
                "is_grip",
            ),
            "inputs": ("WINDOW_S",),
            "slip_stage": (
                "PUBLISHED_SAMPLES",
                "SUMMARY_DIGITS",
                "find_fastest",
                "find_residual_modulus",
                "find_standing_share",
                "pick_row",
                "round_number",
                "set_residuals",
                "summarize_inputs",
            ),
        },
    )
