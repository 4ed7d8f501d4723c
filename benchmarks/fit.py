"""How long fitting takes: five effects to ten minutes of driving, and one look at a model.

Run: python benchmarks/fit.py [LOG]. Without a log, ten minutes of a simulated Husky. The peer is the same
fit by scipy's trust-region least squares with numerical derivatives, on the same residuals.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from pipeline.estimation import Input, Problem, estimate_intervals, fit_model, hold_out
from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.models import Model, find_effect
from pipeline.run import load_run
from pipeline.simulate import simulate_case
from pipeline.sources import Vehicle
from pipeline.store import Store

if TYPE_CHECKING:
    from collections.abc import Callable

    from pipeline.run import MotionRun

TRUTH = {
    "effective_track": 1.8,
    "turn_lag": {"tau_mean": 0.1, "tau_diff": 0.4},
    "transport_delay": 0.15,
    "icr_offset": 0.12,
    "turning_resistance": 0.2,
}
BUDGET_S = 3.0


def load(log: Path, folder: Path) -> tuple[MotionRun, Vehicle]:
    manifest = analyze_log(log, Options(out=folder, report=False)).manifest
    vehicle = msgspec.convert(manifest.details["vehicle"], Vehicle)
    store = Store(folder)
    names = [
        name
        for name in ("poses", "alignments", "commands", "wheels", "imu", "slip")
        if name in manifest.tables
    ]
    return load_run(
        {name: store.read(manifest.run, name) for name in names}, vehicle, name=manifest.run
    ), vehicle


def timed(what: str, work: Callable[[], object], repeats: int = 3) -> float:
    best = min(_measure(work) for _ in range(repeats))
    sys.stdout.write(f"{what:<46}{best:8.3f} s\n")
    return best


def _measure(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def fit_with_scipy(problem: Problem, model: Model) -> float:
    """The peer: same residuals, same start, scipy's optimizer; returns its loss."""
    from scipy.optimize import least_squares  # noqa: PLC0415 - the peer's

    fitted = fit_model(problem, model)
    # Command and wheels are two problems; the peer is given the one of the drivetrain.
    part, fit = problem.parts[-1], fitted.fits[-1]
    free = list(fit.free)
    start = problem.start_state(model.effects)
    for number in free:
        start = start.set(
            number, model.effect(number.effect).parameter(number.name).typical if number.effect else 0.0
        )
    low, high = np.array([number.bounds for number in free]).T

    def residuals(values: np.ndarray) -> np.ndarray:
        state = start
        for number, value in zip(free, values.tolist(), strict=True):
            state = state.set(number, value)
        return (part.find_residuals(state) / fit.weights.scale).ravel()

    begin = np.clip([start.get(number) for number in free], low + 1e-9, high - 1e-9)
    return float(least_squares(residuals, begin, bounds=(low, high), loss="huber", f_scale=3.0).cost)


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = Path(sys.argv[1]) if len(sys.argv) > 1 else folder / "ten_minutes.mcap"
        if len(sys.argv) == 1:
            simulate_case("ideal_husky", TRUTH, out=log, duration_s=600.0, seed=5)
        run, vehicle = load(log, folder / "results")
    model = Model(vehicle, tuple(find_effect(name)() for name in TRUTH))
    sys.stdout.write(f"{run.name}: {run.duration_s:.0f} s, five effects, input: command\n")
    problem = Problem([run], vehicle, Input.COMMAND)
    timed("make the run ready", lambda: Problem([run], vehicle, Input.COMMAND))
    spent = timed("fit five effects from nothing", lambda: fit_model(problem, model))
    fitted = fit_model(problem, model)
    state = fitted.state
    number = fitted.free[0]
    values = iter(np.linspace(0.1, 0.2, 1000).tolist())
    timed("one look at a model", lambda: problem.find_residuals(state.set(number, next(values))), 20)
    timed("intervals", lambda: estimate_intervals(problem, fitted))
    timed("held-out errors, five folds", lambda: hold_out(problem, fitted))
    peer = (
        timed("peer: scipy.optimize from typical values", lambda: fit_with_scipy(problem, model), 1) - spent
    )
    sys.stdout.write(
        f"the fit takes {spent / BUDGET_S:.0%} of its budget of {BUDGET_S:g} s, "
        f"{peer / spent:.1f} times faster than the peer\n"
    )
    if spent > BUDGET_S:
        sys.exit("too slow")


if __name__ == "__main__":
    main()
