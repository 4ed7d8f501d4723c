"""Every run predicted from the vehicle's other runs: its errors over 2 s, and its wheels.

Run: python benchmarks/transfer.py RESULTS [--input command|measured] [--vehicle V] [--run TEXT] [--single]
[--wheels]. RESULTS are analyzed and diagnosed recordings (slip batch LOGS --results RESULTS --diagnosis).
Every run is left out in turn, the model is that which `slip fleet predict` expects for its ground from the
others, and nothing but its clocks is the run's own: that of its poses, where no gyro knows it, and that of
its encoders, fitted with all effects held. Printed are errors
of position [m] and heading [rad] over 2 s of the whole run: of the ideal model, of the expected one, of the
expected one with the numbers fitted to the run that are not declared the vehicle's, and of the run's own
written model on stretches held out (its diagnosis), and the ratios of the former two to the last; medians of
the expected one are those of runs on a ground that another run is on. With --single the expected numbers are
those of `forecast_vehicle` alone, without the fit to all runs together.

With --wheels the drivetrain is judged alone: rms of what is not explained of the wheels' difference [rad/s]
and mean [m/s], averaged over windows, the whole run unseen: of the best lag with gain and limit fitted to
this run itself, of the expected drivetrain, and of the same effects fitted to the run.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, cast

import numpy as np
import polars as pl
from scipy.optimize import minimize

from pipeline.core import NORMAL_95, SlipError
from pipeline.core.arrays import Floats
from pipeline.estimation.across_runs import fit_part_jointly
from pipeline.estimation.comparison import Input
from pipeline.estimation.fit import fit_model
from pipeline.estimation.folds import score
from pipeline.estimation.parts import WheelPart, average_windows, locate_windows
from pipeline.estimation.problem import Problem
from pipeline.fleet.forecast import Forecast, forecast_vehicle, list_held
from pipeline.job.compared_runs import read_digest
from pipeline.job.next_drive import forecast_deployment
from pipeline.job.prediction import find_estimates
from pipeline.job.run_results import load_vehicle
from pipeline.models.effect import Effect, Late
from pipeline.models.filters import lag_signal
from pipeline.models.model import Model, Timing
from pipeline.models.parameter import Level
from pipeline.report.motion_view import load_motion_run
from pipeline.store import Manifest, Store

Source = Literal["command", "measured"]
_AS_GOOD = 1.02
"""Two percent are chance."""
_PATH_HEADS = (
    f"{'run':<45}{'ground':<10}{'on':>3}"
    + "".join(f"{name:>16}" for name in ("ideal", "expected", "ground fitted", "own"))
    + f"{'expected/own':>14}{'ground/own':>14}"
)
_WHEEL_HEADS = (
    f"{'run':<45}"
    + "".join(f"{name:>16}" for name in ("own lag", "from others", "own servo"))
    + "  difference, mean"
)


@dataclass(frozen=True)
class Errors:
    """Errors over 2 s: of position [m] and of heading [rad]."""

    position: float
    heading: float


def make_problem(manifest: Manifest, source: str) -> Problem:
    vehicle = load_vehicle(manifest)
    return Problem([load_motion_run(manifest, vehicle)], vehicle, Input(source))


def measure(problem: Problem, effects: Sequence[Effect]) -> Errors:
    return measure_fit(problem, hold(effects))


def measure_fit(problem: Problem, effects: Sequence[Effect]) -> Errors:
    """Errors after the fit of what is not held of these effects, and of the clocks."""
    fitted = fit_model(problem, Model(problem.vehicle, tuple(effects)), exact=True)
    pooled = score(problem, fitted.state).pooled
    return Errors(pooled.t_mrmse_m, pooled.r_mrmse_rad)


def hold(effects: Sequence[Effect]) -> list[Effect]:
    return [effect.fix(*effect.values) for effect in effects]


def hold_vehicle(effect: Effect) -> Effect:
    """The effect with all numbers free that the catalogue does not declare the vehicle's."""
    return effect.fix(*(one.name for one in effect.parameters if one.level is Level.VEHICLE))


def read_own(manifest: Manifest, source: str) -> Errors:
    """Held-out errors of the written model: the last step of the run's ladder."""
    rows = manifest.read("ladder").filter(pl.col("kind") == "rung", pl.col("input") == source)
    if rows.is_empty():
        return Errors(float("nan"), float("nan"))
    last = rows.sort("rung").row(-1, named=True)
    return Errors(float(last["t_mrmse"]), float(last["r_mrmse"]))


def list_clocks(store: Store, run: str, source: str) -> list[Effect]:
    """The clock of a run's poses that its own model holds: no other run says it."""
    own = find_estimates(store).filter(pl.col("run") == run)
    held = list_held(own, str(own["vehicle"][0]), source)
    return [effect for effect in held if effect.late is Late.POSES]


def expect(store: Store, manifest: Manifest, source: Source, *, single: bool) -> Forecast:
    vehicle, terrain = load_vehicle(manifest).id, str(manifest.details.get("terrain"))
    without = [read_digest(manifest)]
    if single:
        return forecast_vehicle(find_estimates(store, without=without), vehicle, terrain, source)
    return forecast_deployment(store, vehicle, terrain, source, without=without)


def judge_path(
    store: Store, manifest: Manifest, source: Source, *, single: bool
) -> tuple[tuple[float, ...], list[tuple[bool, float]]]:
    forecast = expect(store, manifest, source, single=single)
    problem = make_problem(manifest, source)
    clock = list_clocks(store, manifest.run, source)
    ideal = measure(problem, tuple(clock))
    expected = measure(problem, (*forecast.effects, *clock))
    ground = measure_fit(problem, [*map(hold_vehicle, forecast.effects), *hold(clock)])
    own = read_own(manifest, source)
    ratios = [
        one / mine
        for found in (expected, ground)
        for one, mine in ((found.position, own.position), (found.heading, own.heading))
    ]
    print(
        f"{Path(manifest.run).name[:44]:<45}{forecast.terrain[:9]:<10}{len(forecast.here):>3}"
        + "".join(f"{one.position:>8.3f}{one.heading:>8.3f}" for one in (ideal, expected, ground, own))
        + "".join(f"{one:>7.2f}" for one in ratios)
        + f"  {', '.join(effect.id for effect in forecast.effects)}",
        flush=True,
    )
    return (*ratios, float(len(forecast.here))), list_held_numbers(store, manifest, forecast)


def list_held_numbers(store: Store, manifest: Manifest, forecast: Forecast) -> list[tuple[bool, float]]:
    """Of each expected number that the run's own model holds: whether its interval does, and its width.

    The run's own error widens the interval; the width is half of it over the run's own value.
    """
    own = find_estimates(store).filter(
        "in_model", ~pl.col("at_bound"), pl.col("run") == manifest.run, pl.col("input") == forecast.input
    )
    rows = own.select("effect", "parameter", "value", "standard_error").iter_rows()
    known = {f"{effect}.{name}": (value, error) for effect, name, value, error in rows}
    found = []
    for number in forecast.numbers:
        if number.label in known:
            (value, error), (low, high) = known[number.label], number.ends
            room = high - number.value if value > number.value else number.value - low
            inside = abs(value - number.value) <= np.hypot(room, NORMAL_95 * error)
            found.append((bool(inside), 0.5 * (high - low) / max(abs(value), 1e-9)))
    return found


def fit_lag(part: WheelPart) -> Floats:
    """Rms that the best lag with gain and limit leaves of the run that it is fitted to: difference, mean."""
    commanded, measured = part.comparisons[0], part.measured[0]
    spans, around = locate_windows(commanded), commanded.context
    asked, seen = (one.predict_velocity((), Timing()) for one in (commanded, measured))
    wheels = average_windows(commanded, seen, spans)
    left = []
    for channel, place in (("w", 2), ("x", 0)):
        signal = getattr(asked, channel)
        begins = getattr(seen, channel)[around.wheels.first]

        def leave(
            numbers: Floats,
            signal: Floats = signal,
            begins: Floats = begins,
            channel: str = channel,
            place: int = place,
        ) -> float:
            tau, gain, limit = np.exp(numbers).tolist()
            goal = gain * np.clip(signal, -limit, limit)
            driven = lag_signal(goal, tau, around.step_s, around.wheels, begins)
            rest = wheels - average_windows(commanded, replace(asked, **{channel: driven}), spans)
            return float(np.sqrt(np.mean(rest[:, place] ** 2)))

        most = float(np.abs(signal).max())
        starts = [(np.log(tau), -0.1, np.log(share * most)) for tau in (0.3, 1.5) for share in (0.6, 1.1)]
        fits = (minimize(leave, one, method="Nelder-Mead", options={"maxiter": 150}) for one in starts)
        left.append(min(float(fit.fun) for fit in fits))
    return np.array(left)


def judge_wheels(store: Store, manifest: Manifest, *, single: bool) -> tuple[bool, bool] | None:
    problem = make_problem(manifest, "command")
    part = next((one for one in problem.parts if isinstance(one, WheelPart)), None)
    if part is None:
        return None
    forecast = expect(store, manifest, "command", single=single)
    lag = fit_lag(part)
    drive = [effect for effect in forecast.effects if part.owns(effect)]
    others, own = (
        np.sqrt(np.mean(part.find_residuals(state) ** 2, axis=0))[[2, 0]]
        for state in (problem.start_state(drive), fit_part_jointly(part, problem.start_state(drive)).state)
    )
    good = others <= _AS_GOOD * lag
    print(
        f"{Path(manifest.run).name[:44]:<45}"
        + "".join(f"{one[0]:>8.3f}{one[1]:>8.3f}" for one in (lag, others, own))
        + "".join("  as good" if one else "  worse  " for one in good.tolist()),
        flush=True,
    )
    return bool(good[0]), bool(good[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path)
    parser.add_argument("--input", choices=("command", "measured"), default="command")
    parser.add_argument("--vehicle")
    parser.add_argument("--run", default="", help="only runs with this in their names")
    parser.add_argument("--single", action="store_true")
    parser.add_argument("--wheels", action="store_true")
    chosen = parser.parse_args()
    store, source = Store(chosen.results), cast("Source", chosen.input)
    known = find_estimates(store).select("run", "vehicle", "terrain").unique().sort("run")
    rows: list[tuple[float, ...]] = []
    wheels: list[tuple[bool, bool] | None] = []
    numbers: list[tuple[bool, float]] = []
    print(_WHEEL_HEADS if chosen.wheels else _PATH_HEADS)
    for run, vehicle, terrain in known.iter_rows():
        manifest = store.manifest(run)
        if (
            manifest is None
            or terrain == "unknown"
            or chosen.run not in run
            or chosen.vehicle not in {None, vehicle}
        ):
            continue
        try:
            if chosen.wheels:
                wheels.append(judge_wheels(store, manifest, single=chosen.single))
            else:
                row, held = judge_path(store, manifest, source, single=chosen.single)
                rows.append(row)
                numbers += held
        except SlipError as error:
            print(f"{run}: {error}")
    if numbers:
        holds, widths = np.array(numbers).T
        print(
            f"intervals of another run hold {int(holds.sum())} of {holds.size} numbers ({holds.mean():.0%}), "
            f"median half width over the value {np.median(widths):.2f}"
        )
    if judged := [one for one in wheels if one]:
        difference, mean = (sum(one[place] for one in judged) for place in (0, 1))
        print(f"as good as its own lag, of {len(judged)} runs: difference {difference}, mean {mean}")
    for what, ratios in (
        ("on one ground", np.array([row[:2] for row in rows if row[-1] > 0])),
        ("with the ground's numbers fitted", np.array([row[2:4] for row in rows])),
    ):
        if ratios.size:
            print(
                f"{what}, {len(ratios)} runs: median {np.median(ratios, axis=0).round(2)}, "
                f"worst {ratios.max(axis=0).round(2)}"
            )


if __name__ == "__main__":
    main()
