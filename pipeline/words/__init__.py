"""Sentences: results as text, the same for screen, report, workbench, JSON and notebook.

`verdict` says how far a run is off in one to three sentences, `diagnosis` lists its lines, `effects` and
`errors` have the parts, `findings` has a template an id, and `objects` adds the sentences to the JSON of
`slip diagnose`.
"""

from typing import TYPE_CHECKING

from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.words.check import check_as_json, format_junit, format_markdown, list_lines
    from pipeline.words.comparison import format_ratio, list_answer, list_shown_notes, summarize_answer
    from pipeline.words.diagnosis import (
        VERDICT,
        describe,
        format_lines,
        format_short,
        format_suggestion,
        list_findings,
        list_largest_falls,
        list_terms,
    )
    from pipeline.words.effects import (
        describe_cause,
        describe_clause,
        describe_motion,
        describe_separation,
        name_group,
        suggest_drive,
    )
    from pipeline.words.errors import (
        describe_end,
        describe_need,
        describe_region,
        describe_regions,
        describe_rest,
        describe_unexplained,
        format_remaining_error,
        name_span,
    )
    from pipeline.words.findings import format_finding
    from pipeline.words.models import (
        describe_step,
        format_contest,
        format_heads,
        format_ladder,
        format_measured_errors,
        format_parameters,
        format_recordings,
        format_refusals,
        format_speed_limits,
        suggest_export,
    )
    from pipeline.words.objects import diagnosis_as_json
    from pipeline.words.verdict import format_refusal, format_verdict
else:
    __getattr__ = open_door(__name__, __file__)
