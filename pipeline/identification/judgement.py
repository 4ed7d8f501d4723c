"""What one does with a model and runs: judge it, fit it, note in its file what it was fitted on."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from pipeline.core.numbers import pick
from pipeline.identification.describe import errors_as_json
from pipeline.identification.fit import Fitted
from pipeline.identification.intervals import Estimates, estimate_intervals
from pipeline.identification.ladder import Ladder, Rung, climb
from pipeline.identification.problem import Problem
from pipeline.identification.scoring import Errors
from pipeline.models.model import Model
from pipeline.models.model_file import ModelFile


@dataclass(frozen=True)
class Judgement:
    """A model on runs.

    Attributes:
        problem: the runs.
        ladder: held-out errors from the ideal model up.
        whole: all effects of the model, fitted together, with their held-out errors.
        estimates: its numbers with intervals.
    """

    problem: Problem
    ladder: Ladder
    whole: Rung
    estimates: Estimates

    @property
    def fitted(self) -> Fitted:
        """The fit of all effects."""
        return self.whole.fitted

    @property
    def floor(self) -> Errors:
        """The noise floor of the runs."""
        return self.problem.floor


def judge_model(
    problem: Problem, model: Model, *, per_run: Sequence[str] = (), wider: Judgement | None = None
) -> Judgement:
    """Fit a model and climb its ladder.

    Args:
        problem: the runs.
        model: its effects at neutral values are searched, others start from their values.
        per_run: labels whose values belong to each run alone.
        wider: of this model with more effects on the same runs: rungs of the same effects are taken over.
    """
    known = wider.ladder.rungs if wider is not None and wider.problem is problem and not per_run else ()
    ladder = climb(problem, model, per_run=per_run, begun=known)
    whole = ladder.rungs[-1]
    return Judgement(problem, ladder, whole, estimate_intervals(problem, whole.fitted))


def note_fit(file: ModelFile, judgement: Judgement) -> ModelFile:
    """The model file with fitted values, intervals, and what they were fitted on.

    Effects that do not act on the input keep the values they had.
    """
    fitted = judgement.fitted.model
    model = file.model.swap(*(effect for effect in fitted if effect.id in file.model))
    intervals = {
        label: interval
        for label, interval in file.intervals.items()
        if not any(label.startswith(f"{effect.id}.") for effect in fitted)
    }
    problem, estimates = judgement.problem, judgement.estimates
    intervals |= estimates.shared_intervals
    fit: dict[str, object] = {
        "input": problem.source.value,
        "blocks": estimates.blocks,
        "noise_floor": errors_as_json(judgement.floor),
        "runs": [
            {
                "run": comparison.run.name,
                "sha256": comparison.run.sha256,
                "terrain": comparison.run.terrain,
                "pose_delay_s": comparison.run.alignment.heading_delay_s,
                "wheel_delay_s": timing.wheel_delay_s,
            }
            for comparison, timing in zip(problem.comparisons, judgement.fitted.state.timing, strict=True)
        ],
        "ladder": [
            {
                "effects": list(rung.effects),
                "velocity_rms": list(rung.errors.velocity_rms),
                "t_mrmse_m": rung.errors.t_mrmse_m,
                "r_mrmse_rad": rung.errors.r_mrmse_rad,
            }
            for rung in judgement.ladder.rungs
        ],
    }
    own = [
        {
            "run": problem.names[item.free.run],
            "parameter": item.free.label,
            **pick(item, "value", *(("low", "high") if math.isfinite(item.low) else ())),
        }
        for item in estimates.items
        if item.free.effect and item.free.run is not None
    ]
    if own:
        fit["own"] = own
    labels = (item.free.label for item in estimates.items if item.free.effect and item.free.run is not None)
    per_run = tuple(dict.fromkeys((*file.per_run, *labels)))
    # Other runs may tell apart what those of the diagnosis could not.
    names = [run["run"] for run in file.list_fitted("runs")]
    if names in ([], list(problem.names)):
        ids = set(model.ids)
        undecided = [group for group in file.undecided if ids.intersection(group)]
        unless = [
            {"parameter": label, "effect": other, "value": value}
            for label, other, value in file.unless
            if label.split(".")[0] in ids and other not in ids
        ]
        fit |= {key: rows for key, rows in (("undecided", undecided), ("unless", unless)) if rows}
    return replace(file, model=model, per_run=per_run, intervals=intervals, fit=fit)
