"""Model files on runs: changed and fitted, carried over, compared, limited in speed, exported."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

from pipeline import datasets
from pipeline.datasets import ModelContest, ModelFit
from pipeline.estimation.run_residuals import InputChoice, choose_input
from pipeline.estimation.tolerance import SpeedLimit, limit_speeds, limits_as_json
from pipeline.estimation.transfer import Transfer, carry_over
from pipeline.export import export_model, list_omitted, read_current, require_errors  # noqa: F401 - for the door
from pipeline.export.data_formats import dump_model  # noqa: F401 - for the door
from pipeline.models import ModelFile
from pipeline.results import to_json
from pipeline.run import MotionRun
from pipeline.sources import Owner
from pipeline.store import Manifest, Store

Source = Literal["command", "measured"]


@dataclass(frozen=True)
class Change:
    """A model fitted to runs, before and after a change, and carried over to others.

    Attributes:
        fit: the model file, and its quality before and after.
        carried: what it predicts of runs that it was not fitted on.
    """

    fit: ModelFit
    carried: Sequence[Transfer]

    @cached_property
    def refusals(self) -> dict[str, str]:
        """Reasons why added effects do not reduce the held-out error, by id; empty if they do."""
        return self.fit.explain_refusals()

    @property
    def added(self) -> set[str]:
        """Ids of the effects that the change added."""
        return set(self.fit.after.whole.effects) - set(self.fit.before.whole.effects)

    @property
    def warnings(self) -> list[str]:
        """What speaks against the fit, or against the model on other runs."""
        return [*filter(None, (self.fit.chosen.warning, *(item.warning for item in self.carried)))]

    def to_json(self, name: str | None) -> dict[str, object]:
        """The object of `slip model fit --json` of a model file of this name."""
        return {
            "model": name,
            **self.fit.to_json(),
            "carried_over": [_transfer_as_json(str(name), item) for item in self.carried],
        }


def change_model(
    before: ModelFile,
    after: ModelFile,
    runs: Sequence[Manifest],
    others: Sequence[Manifest] = (),
    *,
    source: Source | None = None,
    owner: Owner | None = None,
    first_s: float | None = None,
    fleet: Path | None = None,
) -> Change:
    """Fit a model to runs, judge it before and after a change, and predict other runs with it.

    Args:
        before: the model before the change.
        after: the model to fit.
        runs: to fit it to.
        others: to be predicted.
        source: `command` or `measured`; None chooses.
        owner: whose geometry is used where a run is of another vehicle.
        first_s: fit to the first seconds of driving of each run; None for all of them.
        fleet: folder of results whose other runs are a prior; None for none.

    Raises:
        SlipError: the runs lack the input, are too short, or are of another vehicle; an effect cannot act.
    """
    after, gathered = datasets.put_on_runs(after, [*runs, *others], owner)
    fitted, rest = gathered[: len(runs)], gathered[len(runs) :]
    prior = None if fleet is None else Store(fleet)
    fit = datasets.fit_to_runs(before, after, fitted, source, first_s=first_s, fleet=prior)
    rows, own = fit.file.list_fitted("runs"), fit.file.per_run
    carried = carry_over(fit.file.model, rest, fit.chosen.source, fitted_on=rows, per_run=own) if rest else []
    return Change(fit, carried)


def expect_model(
    runs: Sequence[Manifest], source: Source | None, fleet: Path, owner: Owner | None = None
) -> ModelFile:
    """The model that the other runs of a fleet expect for the vehicle and the ground of runs."""
    return datasets.expect_model(runs, source, Store(fleet), owner)


@dataclass(frozen=True)
class Carried:
    """Models with their present values on runs.

    Attributes:
        chosen: their input, and the reason for it.
        rows: name of the model, and what it predicts of a run.
        warnings: what speaks against the comparison.
    """

    chosen: InputChoice
    rows: Sequence[tuple[str, Transfer]]
    warnings: Sequence[str]

    def to_json(self) -> dict[str, object]:
        """The object of `slip model compare --json`."""
        return {
            "input": self.chosen.source.value,
            "input_reason": self.chosen.reason,
            "compared": [_transfer_as_json(name, item) for name, item in self.rows],
        }


def carry_models(
    files: Mapping[str, ModelFile],
    manifests: Sequence[Manifest],
    *,
    source: Source | None = None,
    owner: Owner | None = None,
) -> Carried:
    """Compare models with their present values on runs, as `slip model compare` does.

    Args:
        files: models by name; all use the same input, so that their errors are comparable.
        manifests: the runs.
        source: `command` or `measured`; None chooses.
        owner: whose geometry is used where a run is of another vehicle.
    """
    put = {name: datasets.put_on_runs(file, manifests, owner) for name, file in files.items()}
    last = {file.last_input for file, _ in put.values()}
    effects = [effect for file, _ in put.values() for effect in file.model]
    runs = next(iter(put.values()))[1]
    chosen = choose_input(runs, source, effects, last=last.pop() if len(last) == 1 else None)
    rows: list[tuple[str, Transfer]] = []
    warnings = [chosen.warning]
    for name, (file, read) in put.items():
        own = {str(row.get("run")) for row in file.list_fitted("runs")} & {run.name for run in read}
        seen = "its error there is not a held-out error"
        warnings += [f"{name} was fitted to {run}: {seen}" for run in sorted(own)]
        fitted_on = file.list_fitted("runs")
        carried = carry_over(file.model, read, chosen.source, fitted_on=fitted_on, per_run=file.per_run)
        rows += [(name, item) for item in carried]
    return Carried(chosen, rows, [*filter(None, (*warnings, *(item.warning for _, item in rows)))])


def contest_models(
    files: Mapping[str, ModelFile],
    manifests: Sequence[Manifest],
    *,
    source: Source | None = None,
    owner: Owner | None = None,
) -> tuple[ModelContest, str]:
    """Fit models and those of the literature to runs, and score them on data not seen.

    Args:
        files: models by name; may be empty.
        manifests: the runs.
        source: `command` or `measured`; None chooses.
        owner: whose geometry is used where a run is of another vehicle.

    Returns:
        The comparison, and the kind of the vehicle.
    """
    known = next((file.model.vehicle for file in files.values()), None)
    vehicle, runs = datasets.read_runs(manifests, known, owner)
    return datasets.contest_models(files, runs, vehicle, source), vehicle.kind


@dataclass(frozen=True)
class Speeds:
    """Highest speeds at which predictions stay within a tolerance.

    Attributes:
        limits: by terrain.
        within_m: largest error of position [m].
        ahead_s: time ahead [s].
        chosen: input of the model, and the reason for it.
        runs: names of the runs.
    """

    limits: Mapping[str, SpeedLimit]
    within_m: float
    ahead_s: float
    chosen: InputChoice
    runs: tuple[str, ...]

    @property
    def rows(self) -> list[dict[str, object]]:
        """One object a terrain."""
        return limits_as_json(self.limits)

    def to_json(self) -> dict[str, object]:
        """The object of `slip model speed --json`."""
        return {
            "within_m": self.within_m,
            "ahead_s": self.ahead_s,
            "input": self.chosen.source.value,
            "terrains": self.rows,
        }


def find_speeds(
    file: ModelFile,
    manifests: Sequence[Manifest],
    within_m: float,
    ahead_s: float,
    *,
    source: Source | None = None,
    owner: Owner | None = None,
) -> Speeds:
    """Find the highest speeds at which predictions stay within a tolerance, as `slip model speed` does.

    Args:
        file: the model.
        manifests: the runs.
        within_m: largest error of position [m].
        ahead_s: time ahead [s], at most 2.
        source: `command` or `measured`; None as at the last fit, else as the effects need it.
        owner: whose geometry is used where a run is of another vehicle.
    """
    file, runs, chosen = read_on_runs(file, manifests, source, owner)
    limits = limit_speeds(file, runs, chosen.source, within_m, ahead_s)
    return Speeds(limits, within_m, ahead_s, chosen, tuple(run.name for run in runs))


def read_on_runs(
    file: ModelFile, manifests: Sequence[Manifest], source: Source | None, owner: Owner | None
) -> tuple[ModelFile, list[MotionRun], InputChoice]:
    """A model with the vehicle whose geometry is used, the runs, and the input of the model."""
    file, runs = datasets.put_on_runs(file, manifests, owner)
    return file, runs, choose_input(runs, source, file.model, last=file.last_input)


def export_file(
    file: ModelFile,
    to: str,
    *,
    current: Path | None = None,
    gate: Literal["off", "on", "auto"] | None = None,
    runs: Sequence[Manifest] = (),
) -> str:
    """A model as parameters of what people run, as `slip model export` writes them.

    Args:
        file: the model.
        to: target of the export.
        current: for vesc and px4 the robot's file of parameters, which is corrected.
        gate: for autoware whether the steering offset is applied: off, on, or on and learned on.
        runs: for robot_localization and nav2_amcl: runs for the held-out errors.
    """
    used = None if current is None else read_current(current, to)
    if runs:
        file = datasets.judge_measured(file, runs)
    return export_model(file, to, used, gate)


def _transfer_as_json(name: str, item: Transfer) -> dict[str, object]:
    return {
        "model": name,
        "run": item.run,
        "terrain": item.terrain,
        "carried": to_json(item.carried.pooled),
        "own_fit": to_json(item.own.pooled),
        "ideal": to_json(item.ideal.pooled),
        "ratio": item.ratio,
        "ratios": dict(item.apart),
        "remaining_of_ideal": {
            name: {"carried": given, "own_fit": own} for name, (given, own) in item.remaining.items()
        },
        "fitted_anew": list(item.renewed),
        "beyond_fit": dict(item.beyond),
        "warning": item.warning,
    }
