"""extract -> velocity -> slip -> aggregate: pure functions from tables to tables.

Each stage also returns findings: faults that it corrected or could not correct. No stage reads or writes a
file.
"""

from typing import TYPE_CHECKING

from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.stages.align import *
    from pipeline.stages.checks import *
    from pipeline.stages.clocks import *
    from pipeline.stages.drive import *
    from pipeline.stages.extract import *
    from pipeline.stages.findings import *
    from pipeline.stages.inputs import *
    from pipeline.stages.lost_messages import *
    from pipeline.stages.pose_choice import *
    from pipeline.stages.pose_topics import *
    from pipeline.stages.reading import *
    from pipeline.stages.slip_stage import *
    from pipeline.stages.spans import *
    from pipeline.stages.trust import *
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
            "clocks": ("find_pauses",),
            "drive": (
                "choose_sides",
                "list_steered",
            ),
            "extract": (
                "Extracted",
                "Extraction",
                "Given",
                "extract_tables",
            ),
            "findings": (
                "Finding",
                "Severity",
                "StageError",
                "blame_damage",
            ),
            "inputs": ("WINDOW_S",),
            "lost_messages": ("number_gaps",),
            "pose_choice": (
                "PoseRating",
                "rate_poses",
                "replace_pose",
            ),
            "pose_topics": (
                "POSE_FINDINGS",
                "SLOW_HZ",
                "Cut",
            ),
            "reading": (
                "find_sideways_share",
                "list_wanted",
                "with_texts",
            ),
            "slip_stage": (
                "PUBLISHED_SAMPLES",
                "SUMMARY_DIGITS",
                "find_fastest",
                "find_residual_modulus",
                "pick_row",
                "round_number",
                "set_residuals",
                "summarize_inputs",
            ),
            "spans": (
                "BLOCK_S",
                "follow_likeliest",
                "price_change",
            ),
            "trust": ("ONE_SCALE",),
        },
    )
