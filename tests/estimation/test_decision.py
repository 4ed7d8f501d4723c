"""The one decision: what is named is there, holds its number, and is more than chance, an event or a trifle."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from game.closed_loop import close_loop
from motion_runs import as_run, make_scenario, simulate, vehicle_of

from pipeline.core.compute import Budget
from pipeline.estimation import Input
from pipeline.estimation.ambiguity import find_undecided
from pipeline.estimation.context import prepare
from pipeline.estimation.decision import LEAST_T, Found, Search, judge, make_folds, measure_t
from pipeline.estimation.fit import fit_part
from pipeline.estimation.intervals import estimate_part
from pipeline.estimation.parts import BLOCK_S
from pipeline.estimation.unexplained import search_formula
from pipeline.models import find_effect
from pipeline.simulate import VEHICLES, Disturbance, PoseSensor, Program, simulate_run

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.run import MotionRun

HUSKY = vehicle_of("husky_a200")
USUAL = Disturbance(0.03, 0.05)
QUIET = Disturbance(0.003, 0.004)


def drive(effects: Mapping[str, object], seed: int = 1, **more: object) -> MotionRun:
    """A minute of driving by hand, or more."""
    usual = {"duration_s": 60.0, "program": Program("teleop"), "disturbance": USUAL}
    return simulate(effects, seed=seed, **{**usual, **more})  # type: ignore[arg-type]


def open_search(run: MotionRun, source: Input = Input.MEASURED, names: Sequence[str] = ()) -> Search:
    """A search on the path behind the wheels; of some candidates, or of all."""
    context = prepare([run], HUSKY, source)
    candidates = context.list_candidates(source)
    chosen = tuple(one for one in candidates if not names or one.id in names)
    return Search(context.problem.parts[0], chosen, context.conditions)


def find(run: MotionRun, names: Sequence[str] = ()) -> tuple[Search, Found]:
    search = open_search(run, names=names)
    return search, search.run(search.part.comparisons and start_of(search))


def start_of(search: Search) -> object:
    raise NotImplementedError
