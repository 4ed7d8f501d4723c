"""Models of one's own beside those of the literature and learned ones, on the same runs and held-out data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from pipeline.estimation.comparison import InputChoice, choose_input
from pipeline.estimation.learned import judge_learned, list_learners
from pipeline.estimation.learned_step import judge_with_term
from pipeline.estimation.problem import Problem
from pipeline.estimation.rivals import (
    Contest,
    contest_as_json,
    format_contest,
    hold_contest,
    judge_fit,
    judge_rival,
    time_fit,
)
from pipeline.job.options import JobError
from pipeline.models.literature import list_models
from pipeline.models.model_file import ModelFile
from pipeline.run import MotionRun
from pipeline.sources import Vehicle

Against = Literal["literature", "learned"]


@dataclass(frozen=True)
class ModelContest:
    """Models on runs.

    Attributes:
        contest: the models with their held-out errors.
        chosen: what they were fed with, and why.
        runs: names of the runs.
    """

    contest: Contest
    chosen: InputChoice
    runs: tuple[str, ...]

    def to_json(self) -> dict[str, object]:
        """The keys of `slip model compare --against --json` that are the contest's own."""
        return {
            "input": self.chosen.source.value,
            "input_reason": self.chosen.reason,
            "runs": list(self.runs),
            **contest_as_json(self.contest),
        }

    def format_lines(self) -> list[str]:
        """The table for people."""
        return format_contest(self.contest)


def contest_models(
    files: Mapping[str, ModelFile],
    runs: Sequence[MotionRun],
    vehicle: Vehicle,
    against: Sequence[Against],
    source: str | None = None,
) -> ModelContest:
    """Fit all models to runs, and score each on ten-second stretches that its fit has not seen.

    Args:
        files: models of one's own by name, which are fitted from their values.
        runs: of one vehicle.
        vehicle: whose geometry counts.
        against: `literature`, `learned`, or both; the ideal model is there in any case.
        source: `command` or `measured`; None chooses.

    Raises:
        SlipError: a run lacks the input or is too short, or scikit-learn is not installed.
        JobError: ``name_taken``: a model of one's own has the name of another one here.
    """
    learners = list_learners() if "learned" in against else ()
    known = {model.name: model.make(vehicle) for model in list_models(vehicle)}
    if taken := files.keys() & {*known, *(learner.name for learner in learners)}:
        what = f"{', '.join(sorted(taken))} is the name of a model that yours is compared with"
        raise JobError("name_taken", what, hint="Give yours another name.")
    last = {file.last_input for file in files.values()}
    effects = [effect for file in files.values() for effect in file.model]
    chosen = choose_input(runs, source, effects, last=last.pop() if len(last) == 1 else None)
    problem = Problem(runs, vehicle, chosen.source)
    rivals = [
        judge_with_term(problem, name, replace(file.model, vehicle=vehicle), file.per_run)
        for name, file in files.items()
    ]
    ideal, fit_s = time_fit(problem, known.pop("ideal"))
    rivals.append(judge_fit(problem, "ideal", ideal, fit_s))
    if "literature" in against:
        rivals += [judge_rival(problem, name, model) for name, model in known.items()]
    rivals += [judge_learned(problem, ideal, learner) for learner in learners]
    return ModelContest(hold_contest(problem, rivals), chosen, problem.names)
