"""Sentences: results as text, the same for screen, report, workbench, JSON and notebook.

`verdict` says how far a run is off in one to three sentences, `diagnosis` lists its lines, `effects` and
`errors` have the parts, `findings` has a template an id, and `objects` adds the sentences to the JSON of
`slip diagnose`.
"""

from typing import TYPE_CHECKING

from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.words.batches import *
    from pipeline.words.check import *
    from pipeline.words.comparison import *
    from pipeline.words.diagnosis import *
    from pipeline.words.effects import *
    from pipeline.words.errors import *
    from pipeline.words.findings import *
    from pipeline.words.fleet import *
    from pipeline.words.models import *
    from pipeline.words.objects import *
    from pipeline.words.tables import *
    from pipeline.words.verdict import *
else:
    __getattr__ = open_door(
        __name__,
        {
            "batches": ("describe_batch", "describe_unfinished"),
            "check": (
                "check_as_json",
                "format_junit",
                "format_markdown",
                "list_check_lines",
                "list_check_sentences",
                "list_sides",
                "tabulate_check",
                "tabulate_limits",
            ),
            "comparison": (
                "format_answer",
                "format_causes",
                "list_answer",
                "list_shown_notes",
                "summarize_answer",
                "tabulate_answer",
                "tabulate_causes",
                "tabulate_datasets",
                "tabulate_pairs",
            ),
            "diagnosis": (
                "has_dead_encoder",
                "VERDICT",
                "describe",
                "describe_standing",
                "format_lines",
                "format_short",
                "format_suggestion",
                "list_findings",
                "BELOW_MAIN",
                "list_largest_falls",
                "list_terms",
            ),
            "effects": (
                "describe_cause",
                "describe_clause",
                "describe_motion",
                "describe_separation",
                "is_open",
                "name_group",
                "suggest_drive",
            ),
            "errors": (
                "describe_end",
                "describe_need",
                "describe_region",
                "describe_regions",
                "describe_rest",
                "describe_unexplained",
                "format_rises",
                "list_remaining_errors",
                "name_span",
            ),
            "findings": ("format_finding", "format_other_vehicles"),
            "fleet": (
                "format_fleet",
                "format_map",
                "format_trend",
                "name_series",
                "summarize_map",
                "tabulate_fleet",
                "tabulate_map",
                "tabulate_trend",
            ),
            "models": (
                "describe_offered",
                "describe_partial",
                "format_change",
                "format_contest",
                "format_ladder",
                "format_parameters",
                "format_refusals",
                "format_speed_limits",
                "format_transfers",
                "list_omitted",
                "suggest_export",
            ),
            "objects": ("diagnosis_as_json",),
            "tables": ("NOTHING", "Cell", "Column", "Table"),
            "verdict": (
                "format_refusal",
                "format_verdict",
            ),
        },
    )
