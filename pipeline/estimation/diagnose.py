"""Diagnosis of one run, or of several of one vehicle: explored by input, and concluded."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import msgspec
from threadpoolctl import threadpool_limits

from pipeline.core import Budget
from pipeline.estimation import conclude
from pipeline.estimation.ambiguity import Clocks, find_undecided, find_unobservable, read_clocks
from pipeline.estimation.conclude import PathResult
from pipeline.estimation.decision import Search
from pipeline.estimation.diagnosis import Diagnosis
from pipeline.estimation.encoder_scale import find_encoder_scale
from pipeline.estimation.estimation_data import DiagnosisError, EstimationData, prepare_data
from pipeline.estimation.model_state import ModelState
from pipeline.estimation.recordings import DiagnosisInput
from pipeline.estimation.run_residuals import Input, InputChoice, choose_input
from pipeline.estimation.together import Member, judge_together
from pipeline.estimation.unexplained import search_formula
from pipeline.models import Effect, Model, Place
from pipeline.run import MotionRun
from pipeline.sources import Vehicle

_UNITS = {"": 1.0, "s": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0}
"""Seconds in a unit of `--budget`."""
_DURATION = re.compile(r"(\d+(?:\.\d+)?)\s*(s|min|m|h|)")


def parse_budget(text: str) -> float:
    """CPU time [s] of ``60s``, ``2min`` or a number of seconds.

    Raises:
        DiagnosisError: ``bad_budget``.
    """
    match = _DURATION.fullmatch(text.strip())
    if match is None or float(match[1]) == 0.0:
        what, hint = f"{text!r} is not a duration above zero", "Write it like 60s or 5min."
        raise DiagnosisError("bad_budget", what, where="--budget", hint=hint)
    return float(match[1]) * _UNITS[match[2]]


def diagnose_runs(
    recordings: Sequence[DiagnosisInput],
    vehicle: Vehicle,
    *,
    inputs: Sequence[str] = ("command", "measured"),
    model: Model | None = None,
    budget_s: float | None = None,
    notify: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Identify the physical effects missing from the model of one run, or of several runs of one vehicle.

    Args:
        recordings: the runs' tables.
        vehicle: their vehicle.
        inputs: `command`, `measured` or both; with both, the command leads and the wheels separate the
            drivetrain from the ground.
        model: the known model, to which effects are added; the ideal model when None.
        budget_s: CPU time limit of the search [s]; by default none: answers do not hang on it.
        notify: called with a progress message.

    Returns:
        One diagnosis per run, those that were judged together first: they share their effects. A run that
        cannot be judged has none, and its reason as a finding.

    Raises:
        DiagnosisError: ``too_short`` or ``no_input``, where no run can be judged.
    """
    known = () if model is None else model.effects
    leading = "command" if "command" in inputs else "measured"

    def judge(members: Sequence[Member]) -> Diagnosis:
        judged = search(members, [one.run for one in members])
        misread = find_encoder_scale(judged.runs[0])
        if misread is None:
            return judged
        again = search(members, misread.correct([one.run for one in members]))
        finding = misread.report()
        runs = (msgspec.structs.replace(run, findings=(finding, *run.findings)) for run in again.runs)
        return replace(again, runs=tuple(runs))

    def search(members: Sequence[Member], runs: Sequence[MotionRun]) -> Diagnosis:
        chosen = choose_input(runs, inputs[0] if len(inputs) == 1 else None, known)
        data = prepare_data(runs, vehicle, chosen.source)
        budget = Budget(math.inf if budget_s is None else budget_s, notify)
        # With more threads, the order of summation would depend on the number of cores.
        with threadpool_limits(limits=1, user_api="blas"):
            results, clocks = _search_paths(data, chosen.source, known, budget)
            return _conclude([one.recording for one in members], data, chosen, results, clocks)

    return judge_together(recordings, vehicle, leading, judge)


def _search_paths(
    data: EstimationData, source: Input, known: Sequence[Effect], budget: Budget
) -> tuple[list[PathResult], Clocks]:
    """Explore all available paths: ground and drivetrain separately, or both together without encoders."""
    body_data, body_input = data, source
    if not data.is_drive_alone and source is Input.COMMAND and data.has_encoders:
        body_data, body_input = data.behind_wheels, Input.MEASURED
    usable = [e for e in known if body_input is Input.COMMAND or e.place > Place.DRIVE]
    candidates = data.list_candidates(body_input)
    given = frozenset(e.id for e in usable)
    search = Search(body_data.paths[0], candidates, data.conditions, given, budget)
    body = _search_path(data, search, body_input.value, body_data.start_state(usable))
    results, state = [body], body.outcome.final.state
    if body_input is not source:
        driven = [e for e in known if e.place <= Place.DRIVE]
        candidates, given = data.list_drivetrain(), frozenset(e.id for e in driven)
        search = Search(data.paths[1], candidates, data.conditions, given, budget)
        results.append(_search_path(data, search, "wheels", ModelState((), state.timing).add(*driven)))
    return results, read_clocks(data, body.outcome, body_input)


def _search_path(data: EstimationData, search: Search, name: str, start: ModelState) -> PathResult:
    outcome = search.run(start)
    formula = None
    if name != "wheels" and not data.is_drive_alone:
        sideways = data.vehicle.kinematics.has_inputs("sideways")
        outcome, formula = search_formula(search, outcome, sideways=sideways)
    unobservable, detectable = find_unobservable(search, outcome)
    undecided = tuple(find_undecided(search, outcome))
    return PathResult(name, search, outcome, formula, undecided, unobservable, tuple(detectable))


def _conclude(
    recordings: Sequence[DiagnosisInput],
    data: EstimationData,
    chosen: InputChoice,
    results: Sequence[PathResult],
    clocks: Clocks,
) -> Diagnosis:
    whole, delays = conclude.summarize(data, chosen.source, results, clocks, recordings[0].length_scale_m)
    (common,) = whole.runs
    common = msgspec.structs.replace(common, input_reason=chosen.reason)
    runs = tuple(
        conclude.of_run(common, recording, number, delays[number], data)
        for number, recording in enumerate(recordings)
    )
    return replace(whole, runs=runs)
