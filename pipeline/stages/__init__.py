"""extract -> velocity -> slip -> aggregate: pure functions from tables to tables.

Each stage also returns findings: faults that it corrected or could not correct. No stage reads or writes a
file.
"""

from typing import TYPE_CHECKING

from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.stages.align import align_tables
    from pipeline.stages.checks import WRONG_RADIUS, find_gain_of, is_grip
    from pipeline.stages.clocks import describe_pauses, find_pauses
    from pipeline.stages.drive import choose_sides, list_steered
    from pipeline.stages.extract import Extracted, Extraction, Given, extract_tables
    from pipeline.stages.findings import Finding, Severity, StageError, blame_damage, tabulate_findings
    from pipeline.stages.inputs import WINDOW_S
    from pipeline.stages.log_columns import LogColumns
    from pipeline.stages.lost_messages import number_gaps
    from pipeline.stages.pose_choice import PoseRating, rate_poses, replace_pose
    from pipeline.stages.pose_topics import POSE_FINDINGS, SLOW_HZ
    from pipeline.stages.reading import find_sideways_share, list_wanted, with_texts
    from pipeline.stages.slip_stage import (
        PUBLISHED_SAMPLES,
        SUMMARY_DIGITS,
        find_fastest,
        find_residual_modulus,
        pick_row,
        round_number,
        set_residuals,
        summarize_inputs,
    )
    from pipeline.stages.spans import BLOCK_S, follow_likeliest, price_change
    from pipeline.stages.trust import ONE_SCALE
else:
    __getattr__ = open_door(__name__, __file__)
