"""Fleet model of the results, and its prediction of a run on a terrain."""

import contextlib
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import msgspec
import numpy as np
import polars as pl

from pipeline.core import (
    FEWEST_OF_SPREAD,
    STRETCH_S,
    Complex,
    Flags,
    Floats,
    SlipError,
    enumerate_texts,
    finite_or_none,
    format_count,
    guess_names,
    pick,
)
from pipeline.datasets.compared_runs import ComparedRuns, find_material, read_digest
from pipeline.datasets.forecast import DRAWS, FleetModel, FleetNumber, Forecast, fit_fleet, make_effects
from pipeline.datasets.levels import draw_run
from pipeline.datasets.pooling import UNKNOWN, ComparisonError
from pipeline.datasets.rank_tests import Interval
from pipeline.estimation.prediction import predict_at_from, predict_from
from pipeline.estimation.run_residuals import Input, RunResiduals
from pipeline.models import Effect, Model, ModelFile, Timing, cut_interval, find_effect
from pipeline.run import TABLE_COLUMNS, MotionError, load_motion_run
from pipeline.sources import Vehicle, load_vehicle
from pipeline.store import (
    Manifest,
    Store,
    convert_stored,
    lack_runs,
    no_results,
    read_day,
    read_length_scale,
    read_stored,
)
from schemas import contract_of

FLEET = "fleet.json"
_TABLES = ("estimates",)
_EVERY = "*"
_NAME_EFFECTS = "Name the effects of its logs: slip batch LOGS --diagnosis"


def fit_results(store: Store) -> tuple[FleetModel, tuple[str, ...]]:
    """Fit the fleet model of the results; return it, and the runs with the keys of their results.

    Args:
        store: the results.

    Raises:
        ComparisonError: ``nothing_to_fit``: no run has estimates, or none is on a known terrain.
    """
    compared = _find_runs(store)
    if not compared.manifests:
        raise _lack_estimates(compared)
    model = fit_fleet(compared.read_estimates())
    notes = (*compared.notes, *model.notes)
    return FleetModel(model.numbers, model.runs, notes), compared.keys


def find_estimates(store: Store, *, without: Sequence[str] = ()) -> pl.DataFrame:
    """Rows of `estimates` of the runs that a fleet model uses.

    Args:
        store: the results.
        without: SHA-256 of recordings to exclude, such as those to be predicted.

    Raises:
        ComparisonError: ``nothing_to_fit``: there are none.
    """
    compared = _find_runs(store)
    known = {
        run: manifest for run, manifest in compared.manifests.items() if read_digest(manifest) not in without
    }
    if not known:
        raise _lack_estimates(compared)
    return compared.read_estimates().filter(pl.col("run").is_in(list(known)))


def _lack_estimates(compared: ComparedRuns) -> SlipError:
    """Build the error that no run has estimates; a diagnosis helps, unless slip is not observable."""
    is_excluded = len(compared.refusals) == len(compared.notes) > 0
    hint = (
        "List what its log holds: slip inspect LOG; mend it, or drive again" if is_excluded else _NAME_EFFECTS
    )
    what = "no other run has estimates" if compared.manifests else "no run has estimates"
    return lack_runs("nothing_to_fit", what, compared.store.root, hint, compared.notes)


def _find_runs(store: Store, optional: Sequence[str] = (), vehicle: str = "") -> ComparedRuns:
    return find_material(
        store, ("vehicle",), trusted_only=True, tables=_TABLES, optional=optional, vehicle=vehicle
    )


class _StoredMean(msgspec.Struct):
    """The value of a parameter on a terrain."""

    value: float


class _StoredNumber(msgspec.Struct):
    """What is shown of a parameter of the fleet."""

    effect: str
    parameter: str
    vehicle: str
    name: str
    because: str
    value: float
    unit: str | None
    level: str | None
    low: float | None
    high: float | None
    spread_terrain: float | None
    spread_run: float | None
    chi_square: float | None
    terrains: dict[str, _StoredMean] | None


class _StoredFleet(msgspec.Struct):
    """What is shown of the stored fleet model."""

    parameters: list[_StoredNumber]
    runs: dict[str, list[str]]
    keys: list[str]
    notes: list[str]
    summary: str


def read_fleet(store: Store) -> dict[str, object]:
    """The JSON object of the stored fleet model; its `notes` state whether results have changed since.

    Raises:
        ComparisonError: ``no_fleet``: there is none.
        StoreError: ``no_results``; ``file_damaged``, it cannot be read.
    """
    path = store.root / FLEET
    hint = f"Fit it: slip fleet fit {store.root}"
    if not store.root.is_dir():
        raise no_results(store.root)
    if not path.is_file():
        raise ComparisonError(
            "no_fleet", "no fleet model was fitted to these results", where=str(path), hint=hint
        )
    content = read_stored(path, dict[str, object], hint=hint)
    stored = convert_stored(content, _StoredFleet, path, hint=hint)
    known, notes = set(stored.keys), stored.notes
    now = set(_find_runs(store).keys)
    if now != known:
        notes.append(f"{len(now ^ known)} results have changed since: slip fleet fit brings it up to date")
    return {**content, "notes": notes}


def summarize_fleet(model: FleetModel) -> dict[str, object]:
    """The JSON object of `slip fleet fit`."""
    return {
        "parameters": [_summarize_number(number) for number in model.numbers],
        "resolved": [
            {
                "vehicle": number.vehicle,
                "parameter": number.label,
                "candidates": list(number.candidates),
                "answer": None if number.level is None else number.name,
                "because": number.because,
            }
            for number in model.numbers
            if len(number.candidates) > 1
        ],
        "runs": {vehicle: list(runs) for vehicle, runs in model.runs.items()},
        "notes": list(model.notes),
        "summary": _summarize(model),
    }


def _summarize(model: FleetModel) -> str:
    """Summarize in one or two sentences: levels of the parameters, and the data needed for open ones."""
    counts = Counter("" if number.level is None else number.level.value for number in model.numbers)
    runs = sum(map(len, model.runs.values()))
    fitted = f"{format_count(runs, 'run')} of {format_count(len(model.runs), 'vehicle')}"
    if not counts:
        return f"No significant effect in {fitted}."
    owners = [
        f"{counts[level]} {words}"
        for level, words in (
            ("vehicle", "of the vehicle"),
            ("terrain", "of the terrain"),
            ("run", "of the run"),
        )
        if counts[level]
    ]
    source = f": {enumerate_texts(owners)}" if owners else ""
    first = f"{format_count(len(model.numbers), 'parameter')} in {fitted}{source}."
    if not counts[""]:
        return first
    verb = "remains" if counts[""] == 1 else "remain"
    return (
        f"{first} {counts['']} {verb} open between these levels: to decide, diagnose more runs, "
        "several on each of two or more terrains."
    )


def _summarize_number(number: FleetNumber) -> dict[str, object]:
    fit = number.fit
    return {
        **pick(number, "effect", "parameter", "unit", "vehicle"),
        "level": None if number.level is None else number.level.value,
        "name": number.name,
        "because": number.because,
        "value": fit.value,
        **_bounds(number, fit.interval),
        "spread_terrain": finite_or_none(fit.spread_group),
        "spread_run": finite_or_none(fit.spread_run),
        "chi_square": finite_or_none(fit.chi_square),
        "p_terrain": finite_or_none(fit.p_groups),
        "terrains": {
            name: {"value": mean.value, **_bounds(number, mean.interval), "runs": mean.runs}
            for name, mean in fit.groups.items()
        },
        "runs": len(number.runs),
        "named": number.named,
        "odd": list(number.odd),
    }


def tabulate_fleet(model: FleetModel, keys: tuple[str, ...]) -> pl.DataFrame:
    """The table `fleet`."""
    rows: list[Mapping[str, object]] = []
    for number in model.numbers:
        summary = _summarize_number(number)
        whose = {"run": _EVERY, "dataset": _EVERY, "terrain": _EVERY, "keys": " ".join(keys)}
        rows.append({**summary, **whose, "level": summary["level"] or "open"})
        terrains = cast("Mapping[str, Mapping[str, object]]", summary["terrains"])
        rows += [{**rows[-1], "named": None, "terrain": name, **mean} for name, mean in terrains.items()]
    return pl.DataFrame(rows, schema=contract_of("fleet").schema.create_empty().schema)


def _bounds(number: FleetNumber, interval: Interval | None) -> dict[str, float | None]:
    """Ends of an interval, cut to the bounds of the parameter."""
    if interval is None:
        return {"low": None, "high": None}
    bounds = find_effect(number.effect)().parameter(number.parameter).bounds
    low, high = cut_interval(interval.low, interval.high, bounds)
    return {"low": low, "high": high}


MOST_RUNS = 8
"""Largest number of runs whose commands represent future runs: more hardly change the result."""
_ENDS = (0.025, 0.5, 0.975)
# Prior spread of log residuals and log speeds between terrains and between runs: a factor of two.
_USUAL_LOG_RATIOS = (math.log(2.0), math.log(2.0))
# Relative standard error of the speed of a run: one percent.
_SMALL = 0.01


@dataclass(frozen=True)
class Expected:
    """Predicted quantity: its median, and the interval that contains 95 of 100 runs."""

    value: float
    interval: Interval


@dataclass(frozen=True)
class Prediction:
    """Prediction of a run on a terrain.

    Attributes:
        forecast: the model.
        vehicle: vehicle with the geometry of the newest run.
        t_mrmse_m: error over 2 s of the forecast model [m].
        ideal_t_mrmse_m: error over 2 s of the ideal model [m].
        median_modulus: median slip modulus [m/s].
        runs_used: runs whose commands and residuals represent future runs.
        notes: excluded runs with the reasons, and where a forecast for a terrain without runs comes from.
    """

    forecast: Forecast
    vehicle: Vehicle
    t_mrmse_m: Expected
    ideal_t_mrmse_m: Expected
    median_modulus: Expected
    runs_used: tuple[str, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Driven:
    """A run of the fleet: its commands, and the residuals of its own model.

    Attributes:
        manifest: its results.
        run_residuals: the run with the chosen input.
        error_m: error of its own model over 2 s [m].
        times: times of its slip samples [s], shape (n,).
        ideal: ideal velocity at these times, shape (n, 3); `residual`: measured velocity minus own model.
        scale: weights of the modulus [1, 1, m], shape (3,).
    """

    manifest: Manifest
    run_residuals: RunResiduals
    error_m: float
    times: Floats
    ideal: Floats
    residual: Floats
    scale: Floats

    @property
    def pace(self) -> float:
        """Root mean square ideal speed of the run [m/s]."""
        return float(np.sqrt(np.mean(np.sum((self.ideal * self.scale) ** 2, axis=1))))


def predict_deployment(store: Store, forecast: Forecast, *, seed: int = 0) -> Prediction:
    """Simulate the commands of the vehicle's runs with draws of the model forecast for a terrain.

    A draw represents a future run: its parameters are drawn, its commands are those of a stored run
    (`weigh_runs`), and its residuals are those of that run's own model, scaled to a size drawn from all runs
    (`draw_run` on the logarithm, relative to the speed). The speed is drawn in the same way and scales the
    results. The error of the forecast is that of its expected parameters against the draw, with the residual
    added in squares; the slip is that of the draw.

    Args:
        store: the results.
        forecast: forecast of the vehicle on the terrain.
        seed: seed of the draws.
    """
    compared = _find_runs(store, tuple(TABLE_COLUMNS), forecast.vehicle)
    runs = _load_runs(compared, forecast)
    rng = np.random.default_rng(seed)
    paces = np.log([max(run.pace, 1e-6) for run in runs])
    logs = np.log([max(run.error_m, 1e-6) for run in runs]) - paces
    length = [max(run.run_residuals.run.duration_s / STRETCH_S, 1.0) for run in runs]
    terrains = [str(run.manifest.details.get("terrain")) for run in runs]
    sizes = draw_run(
        logs, np.sqrt(0.5 / np.array(length)), terrains, forecast.terrain,
        usual=_USUAL_LOG_RATIOS, count=DRAWS, rng=rng,
    )  # fmt: skip
    there = np.array([name == forecast.terrain for name in terrains])
    comes = draw_run(
        paces, np.full(len(runs), _SMALL), terrains, forecast.terrain,
        usual=_USUAL_LOG_RATIOS, count=DRAWS, rng=rng,
    )  # fmt: skip
    choices = rng.choice(len(runs), DRAWS, p=weigh_runs(there)).tolist()
    numbers: Floats = np.empty((DRAWS, 3))
    known = [_predict(run, forecast.effects) for run in runs]
    ideal = [_predict(run, ()) for run in runs]
    for which, size in enumerate(sizes.tolist()):
        choice = choices[which]
        run = runs[choice]
        effects = forecast.draw(which)
        truth = _predict(run, effects)
        errors = [
            float(np.sqrt(np.mean(np.abs(truth - side) ** 2))) for side in (known[choice], ideal[choice])
        ]
        grown = math.exp(size - float(logs[choice]))
        slip = (
            run.ideal
            - predict_at_from(run.run_residuals, effects, Timing(), run.times)
            - grown * run.residual
        )
        modulus = np.linalg.norm(slip * run.scale, axis=1)
        residual = math.exp(size + float(paces[choice]))
        errors_out = (*(math.hypot(error, residual) for error in errors), np.nanmedian(modulus))
        numbers[which] = math.exp(float(comes[which] - paces[choice])) * np.array(errors_out)
    error, without, modulus_median = (_bound(column) for column in numbers.T)
    used = tuple(run.manifest.run for run in runs)
    vehicle = runs[0].run_residuals.context.vehicle
    notes = compared.notes if forecast.here else (*compared.notes, _note_terrain(compared.labels, forecast))
    return Prediction(forecast, vehicle, error, without, modulus_median, used, notes)


def _note_terrain(labels: pl.DataFrame, forecast: Forecast) -> str:
    """Note on a terrain without runs of the vehicle: whether it is known, and what the forecast is from."""
    terrains = {str(name) for name in labels["terrain"]} - {UNKNOWN, forecast.terrain}
    own = labels.filter(pl.col("run").is_in(list(forecast.elsewhere)))["terrain"].unique().sort()
    source = f"the prediction is for another terrain, from runs on {', '.join(own)}"
    if not labels.filter(pl.col("terrain") == forecast.terrain).is_empty():
        return f"no run of {forecast.vehicle} is on {forecast.terrain}: {source}"
    known = f"{guess_names(forecast.terrain, terrains)}Known: {', '.join(sorted(terrains))}"
    return f"no run is on {forecast.terrain}: {source}. {known}"


def weigh_runs(there: Flags) -> Floats:
    """Probability that the next run has the commands of each of these runs, shape (n,).

    With probability n / (n + 1) it is one of the n runs on its terrain, else another run (Blackwell and
    MacQueen, Annals of Statistics 1, 1973): few runs on a terrain do not cover all possible commands.

    Args:
        there: which runs are on the terrain, shape (n,), n >= 1.
    """
    count, others = int(there.sum()), int((~there).sum())
    if min(count, others) == 0:
        return np.full(there.size, 1.0 / there.size)
    return np.where(there, 1.0 / (count + 1), 1.0 / (count + 1) / others)


def _bound(draws: Floats) -> Expected:
    low, middle, high = np.quantile(draws, _ENDS).tolist()
    return Expected(middle, Interval(low, high))


def _predict(run: _Driven, effects: Sequence[Effect]) -> Complex:
    """Positions of predictions over 2 s [m], by prediction and time since its start (x + iy)."""
    poses = predict_from(run.run_residuals, effects, Timing()).poses
    return poses[:, 1:, 0] + 1j * poses[:, 1:, 1]


def _load_runs(compared: ComparedRuns, forecast: Forecast) -> list[_Driven]:
    """Load the runs on the terrain, then others, newest first, with their own models.

    Raises:
        ComparisonError: ``nothing_to_drive``: no run has the input.
    """
    on_input = pl.col("input").cast(pl.String) == forecast.input
    named = compared.read_estimates().filter(pl.col("named"), on_input)
    newest = [
        name
        for side in (forecast.here, forecast.elsewhere)
        for name in sorted(side, key=lambda run: read_day(run) or "")[::-1]
    ]
    runs: list[_Driven] = []
    for name in newest:
        manifest = compared.manifests.get(name)
        if manifest is not None and len(runs) < MOST_RUNS:
            with contextlib.suppress(MotionError):
                own = named.filter(pl.col("run") == name)
                runs.append(_load_run(manifest, own, Input(forecast.input)))
    if not runs:
        what = f"no run of {forecast.vehicle} has the {forecast.input} input to drive again"
        raise lack_runs("nothing_to_drive", what, compared.store.root, "Choose the other input.")
    return runs


def _load_run(manifest: Manifest, named: pl.DataFrame, source: Input) -> _Driven:
    vehicle = load_vehicle(manifest)
    run_residuals = RunResiduals(load_motion_run(manifest, vehicle), vehicle, source)
    values: dict[str, dict[str, float]] = {}
    for effect, parameter, value in named.select("effect", "parameter", "value").iter_rows():
        low, high = find_effect(effect)().parameter(parameter).bounds
        values.setdefault(effect, {})[parameter] = min(max(value, low), high)
    own = run_residuals.list_active(make_effects(values))
    error = run_residuals.find_horizon_errors(own, Timing()).position
    slip = manifest.read("slip").filter(~pl.col("suspect"), pl.col("input").cast(pl.String) == source.value)
    times = slip["t"].to_numpy()
    measured = slip.select("v_x", "v_y", "v_w").to_numpy()
    return _Driven(
        manifest=manifest,
        run_residuals=run_residuals,
        error_m=float(np.sqrt(np.mean(error**2))),
        times=times,
        ideal=slip.select("f_x", "f_y", "f_w").to_numpy(),
        residual=measured - predict_at_from(run_residuals, own, Timing(), times),
        scale=np.array([1.0, 1.0, read_length_scale(manifest)]),
    )


def summarize_prediction(prediction: Prediction) -> dict[str, object]:
    """The JSON object of `slip fleet predict`."""
    forecast = prediction.forecast
    effects: dict[str, dict[str, object]] = {}
    for number in forecast.numbers:
        numbers = effects.setdefault(number.effect, {})
        numbers[number.parameter] = {
            **_summarize_ends(number.value, number.ends, number.runs),
            **pick(number, "unit", "runs", "at_bound"),
            "default_spread": number.has_default_spread,
        }
    expected = {
        "t_mrmse_m": prediction.t_mrmse_m,
        "ideal_t_mrmse_m": prediction.ideal_t_mrmse_m,
        "median_modulus": prediction.median_modulus,
    }
    return {
        **pick(forecast, "vehicle", "terrain", "input"),
        "effects": [{"id": effect.id, "parameters": effects[effect.id]} for effect in forecast.effects],
        **{
            key: _summarize_ends(one.value, (one.interval.low, one.interval.high), len(prediction.runs_used))
            for key, one in expected.items()
        },
        "runs_on_terrain": len(forecast.here),
        "runs_elsewhere": len(forecast.elsewhere),
        "runs_used": list(prediction.runs_used),
        "notes": list(prediction.notes),
    }


def _summarize_ends(value: float, ends: tuple[float, float], runs: int) -> dict[str, float | None]:
    """A value with its interval, which is not given from fewer than three runs."""
    low, high = ends if runs >= FEWEST_OF_SPREAD else (None, None)
    return {"value": value, "low": low, "high": high}


def make_model_file(prediction: Prediction) -> ModelFile:
    """Model file of the forecast, with the intervals of three runs or more that end at no bound."""
    forecast = prediction.forecast
    there = f"{len(forecast.here)} runs on {forecast.terrain}, {len(forecast.elsewhere)} elsewhere"
    return ModelFile(
        Model(prediction.vehicle, forecast.effects),
        intervals={number.label: number.ends for number in forecast.numbers if number.has_interval},
        note=f"Expected of {forecast.vehicle} on {forecast.terrain}, from {there}; not fitted to a run.",
    )
