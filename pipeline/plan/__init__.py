"""What to drive next: standard manoeuvres that decide what the logs so far leave open."""

from pipeline.plan.manoeuvres import (
    RATE_HZ,
    Commands,
    PlanError,
    choose_limits,
    is_steered,
    join,
    list_manoeuvres,
    parse_area,
    parse_time,
    wait,
)
from pipeline.plan.plan import (
    LEAD_S,
    SAFETY,
    Plan,
    make_plan,
    tabulate_questions,
)
from pipeline.plan.plan_files import (
    FILES,
    CheckedPlan,
    check_plan,
    choose_topic,
    list_commands,
    read_plan,
    require_played,
    write_plan,
)
from pipeline.plan.rehearsal import (
    Studied,
    study,
)
