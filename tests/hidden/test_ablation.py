"""Every rule of the ablation is a function of the present diagnosis, and can be turned off."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

HIDDEN = Path(__file__).parents[2] / "benchmarks" / "hidden"
sys.path.insert(0, str(HIDDEN))

from ablate import ablate  # noqa: E402
from rules import RULES, Rule  # noqa: E402


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_every_rule_is_a_function_that_there_is(rule: Rule) -> None:
    assert callable(rule.original)


@pytest.mark.long
def test_every_rule_that_acts_on_a_log_can_be_turned_off() -> None:
    line = ablate("sets", 3, "")
    without = line["without"]
    assert {rule.name for rule in RULES if rule.costly} <= without.keys()
    assert len(without) > 5
    assert all(one["rank"] for one in without.values())
