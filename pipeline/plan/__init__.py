"""What to drive next: standard manoeuvres that decide what the logs so far leave open."""

from typing import TYPE_CHECKING

from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.plan.manoeuvres import *
    from pipeline.plan.plan import *
    from pipeline.plan.plan_files import *
    from pipeline.plan.rehearsal import *
else:
    __getattr__ = open_door(
        __name__,
        {
            "manoeuvres": (
                "RATE_HZ",
                "Commands",
                "PlanError",
                "choose_limits",
                "is_steered",
                "join",
                "list_manoeuvres",
                "parse_area",
                "parse_time",
                "wait",
            ),
            "plan": (
                "LEAD_S",
                "SAFETY",
                "Plan",
                "make_plan",
            ),
            "plan_files": (
                "FILES",
                "CheckedPlan",
                "check_plan",
                "choose_topic",
                "read_plan",
                "require_played",
                "write_plan",
            ),
            "rehearsal": (
                "Studied",
                "study",
            ),
        },
    )
