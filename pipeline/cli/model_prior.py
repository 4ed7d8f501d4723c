"""Few-shot fits: the first seconds of a run, and what the fleet knows of its numbers before."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Literal

from pipeline.core.numbers import NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from pipeline.fleet.forecast import Forecast
    from pipeline.identification.problem import Problem
    from pipeline.models.model import Model
    from pipeline.models.model_file import ModelFile
    from pipeline.runs.recording import MotionRun
    from pipeline.vehicles import Vehicle

_SECONDS = re.compile(r"(\d+(?:\.\d+)?)\s*s?")


def read_seconds(text: str) -> float:
    """Seconds of `20s` or `20`.

    Raises:
        MotionError: ``bad_duration``.
    """
    from pipeline.runs.errors import MotionError  # noqa: PLC0415 - heavy

    found = _SECONDS.fullmatch(text.strip())
    if found is None or not float(found[1]) > 0.0:
        raise MotionError("bad_duration", f"{text!r} is no duration", where="--first", hint="Write 20s.")
    return float(found[1])


def require_model(path: Path | None) -> Path:
    """The model file.

    Raises:
        MotionError: ``no_model``: none was given.
    """
    from pipeline.runs.errors import MotionError  # noqa: PLC0415 - heavy

    if path is None:
        hint = "Give one, or take what the fleet lets expect: --prior fleet."
        raise MotionError("no_model", "no model file was given", where="slip model fit", hint=hint)
    return path


def cut_first(runs: Sequence[MotionRun], first_s: float) -> list[MotionRun]:
    """The first seconds of driving of each run.

    Raises:
        MotionError: ``too_short``: a run was not driven for so long.
    """
    from pipeline.runs.cut import cut_run, find_driven  # noqa: PLC0415 - heavy

    return [cut_run(run, end_s=find_driven(run, first_s)) for run in runs]


def forecast_runs(
    runs: Sequence[MotionRun], vehicle: Vehicle, source: Literal["command", "measured"], out: Path
) -> Forecast:
    """What the fleet lets expect on the ground of these runs, which themselves do not count.

    Raises:
        SlipError: there is no fleet; or ``several_terrains``.
    """
    from pipeline.analysis.fleet import find_estimates  # noqa: PLC0415 - heavy
    from pipeline.fleet.forecast import forecast_vehicle  # noqa: PLC0415
    from pipeline.runs.errors import MotionError  # noqa: PLC0415
    from pipeline.store import Store  # noqa: PLC0415

    terrains = sorted({run.terrain for run in runs})
    if len(terrains) > 1:
        raise MotionError(
            "several_terrains",
            f"the runs are on {', '.join(terrains)}, and a prior is of one ground",
            where=", ".join(run.name for run in runs),
            hint="Fit the runs of each ground alone.",
        )
    estimates = find_estimates(Store(out), without=[run.sha256 for run in runs])
    return forecast_vehicle(estimates, vehicle.id, terrains[0], source)


def expect_model(names: Sequence[str], source: str | None, out: Path, *, quiet: bool) -> ModelFile:
    """The model that the fleet lets expect of the vehicle and the ground of runs.

    Raises:
        SlipError: a log cannot be read, runs are of several vehicles, or there is no fleet.
    """
    from pipeline.cli.model_runs import gather_runs  # noqa: PLC0415 - heavy
    from pipeline.identification.inputs import choose_input  # noqa: PLC0415
    from pipeline.models.model import Model  # noqa: PLC0415
    from pipeline.models.model_file import ModelFile  # noqa: PLC0415

    vehicle, runs = gather_runs(names, None, None, out, quiet=quiet)
    chosen = choose_input(runs, source)
    return ModelFile(Model(vehicle, forecast_runs(runs, vehicle, chosen.source.value, out).effects))


def tie_to_fleet(problem: Problem, model: Model, out: Path) -> Problem:
    """The problem with the fleet's forecast as prior.

    Raises:
        SlipError: see `forecast_runs`.
    """
    from pipeline.identification.few_shot import tie_to_prior  # noqa: PLC0415 - heavy

    forecast = forecast_runs(problem.runs, model.vehicle, problem.source.value, out)
    return tie_to_prior(problem, model, forecast.prior)


def prior_as_json(problem: Problem) -> dict[str, dict[str, object]]:
    """What was known of the numbers before the fit, by label: value and 95 % interval; empty if nothing."""
    from pipeline.models.bounds import cut_interval  # noqa: PLC0415 - heavy
    from pipeline.models.catalogue import find_effect  # noqa: PLC0415 - heavy

    found: dict[str, dict[str, object]] = {}
    for label, (mean, deviation) in problem.parts[0].prior.numbers.items():
        effect, _, name = label.partition(".")
        half = NORMAL_95 * deviation
        parameter = find_effect(effect)().parameter(name)
        low, high = cut_interval(mean - half, mean + half, parameter.bounds)
        found[label] = {"value": mean, "low": low, "high": high, "unit": parameter.unit}
    return found
