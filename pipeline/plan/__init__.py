"""What to drive next: commands that decide what the logs so far leave open."""

from typing import TYPE_CHECKING

from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.plan.gain_words import list_gains, summarize_gains
    from pipeline.plan.manoeuvres import (
        LEAD_S,
        RATE_HZ,
        Commands,
        DrivenRange,
        PlanError,
        choose_limits,
        is_steered,
        join,
        limit_yaw_rate,
        list_manoeuvres,
        parse_area,
        parse_time,
        wait,
    )
    from pipeline.plan.next_drive import (
        Wish,
        expect,
        plan_drive,
        read_command,
        study,
    )
    from pipeline.plan.plan import SAFETY, Plan
    from pipeline.plan.plan_files import (
        FILES,
        check_plan,
        read_plan,
        require_played,
        write_plan,
    )
else:
    __getattr__ = open_door(__name__, __file__)
