"""What to drive next: commands that decide what the logs so far could not.

`learn` says what is known, `ask_*` what is asked, `make_plan` chooses manoeuvres for it and promises what
they will answer, `write_plan` writes what a robot plays.
"""

from __future__ import annotations

from pipeline.plan.ask import ask_apart, ask_numbers, ask_presence, ask_undecided, list_names
from pipeline.plan.check import check_plan
from pipeline.plan.errors import PlanError
from pipeline.plan.files import read_promises, write_plan
from pipeline.plan.knowledge import Knowledge, assume, learn
from pipeline.plan.limits import Limits, choose_limits, parse_area
from pipeline.plan.plan import SAFETY, Plan, Request, find_largest, make_plan
from pipeline.plan.protocols import PROTOCOLS, Needed, compare_protocols, parse_protocols

__all__ = [
    "PROTOCOLS",
    "SAFETY",
    "Knowledge",
    "Limits",
    "Needed",
    "Plan",
    "PlanError",
    "Request",
    "ask_apart",
    "ask_numbers",
    "ask_presence",
    "ask_undecided",
    "assume",
    "check_plan",
    "choose_limits",
    "compare_protocols",
    "find_largest",
    "learn",
    "list_names",
    "make_plan",
    "parse_area",
    "parse_protocols",
    "read_promises",
    "write_plan",
]
