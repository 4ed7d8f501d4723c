"""Comparison of a model with the ideal one on a run, as rows for figures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import polars as pl

from pipeline.core import Floats
from pipeline.estimation import EstimationData, Fitted, ModelState, choose_input, fit_model, predict_from
from pipeline.estimation.effect_signature import Signature, find_signatures, measure_variables
from pipeline.estimation.run_residuals import HorizonErrors
from pipeline.models import Model, Timing
from pipeline.results import Errors, RunDiagnosis, Step, read_model
from pipeline.run import MotionError, load_run
from pipeline.sources import Vehicle

# Comparison of a model with the ideal one on a run, as rows for figures.
#
# The report and the workbench draw from the same rows. Preparing a run takes a second; evaluating another
# model takes hundredths.

COMPONENTS = ("x", "y", "w")
SIGNALS = ("f_x", "f_y", "f_w", "f_x_f_w", "a_x", "a_w", "roll", "pitch")

_ARC_EVERY_S = 2.0
_ARC_RATE_HZ = 10.0
_RATE_HZ = 20.0
_BROKEN_S = 5.0


@dataclass(frozen=True)
class MotionView:
    """Results of a model on a run.

    Attributes:
        input: `command` or `measured`.
        effects: ids of its effects.
        ladder: its steps, starting with the ideal model.
        floor: noise floor; None if unknown.
        residuals: one row per window of half a second: ``t`` [s], residuals ``ideal_x`` .. ``model_w``
            [m/s, rad/s], and the signals of `SIGNALS`.
        velocity: the model's velocity: ``t piece v_x v_y v_w``.
        horizon_errors: one row per prediction of 2 s: ``t piece ideal model`` [m], ``ideal_yaw model_yaw``
            [rad].
        arcs: consecutive predicted paths of two seconds: ``t piece x y`` in the map.
        ideal_arcs: the same for the ideal model.
        signatures: signatures of the effects, predicted and measured in the run.
    """

    input: str
    effects: tuple[str, ...]
    ladder: Sequence[Step]
    floor: Errors | None
    residuals: pl.DataFrame
    velocity: pl.DataFrame
    horizon_errors: pl.DataFrame
    arcs: pl.DataFrame
    ideal_arcs: pl.DataFrame
    signatures: Sequence[Signature] = ()


class MotionStage:
    """Run prepared for evaluating many models.

    Args:
        data: the runs; the first one is shown.
        velocities: that table of the run, whose places are the starts of predicted paths; None keeps the
            coordinates of the plane of motion.
    """

    def __init__(self, data: EstimationData, velocities: pl.DataFrame | None = None) -> None:
        self.data = data
        self._places = None if velocities is None else velocities.select("t", "x", "y").sort("t")
        self._run_residuals = data.residuals_by_run[0]

    @cached_property
    def ideal(self) -> Fitted:
        """The ideal model with the recording's delays."""
        return fit_model(self.data, Model(self.data.vehicle))

    @cached_property
    def _ideal_errors(self) -> HorizonErrors:
        return self._run_residuals.find_horizon_errors((), self.ideal.state.timing[0])

    @cached_property
    def _ideal_arcs(self) -> pl.DataFrame:
        return self._draw_arcs(self.ideal.state)

    @cached_property
    def _signals(self) -> dict[str, Floats]:
        measured = measure_variables(self._run_residuals)
        return {name: measured[name] for name in SIGNALS}

    def view(self, state: ModelState, ladder: Sequence[Step], floor: Errors | None) -> MotionView:
        """Return the rows of one model.

        Args:
            state: model with its parameter values and the recording's delays.
            ladder: its steps.
            floor: noise floor; None if unknown.
        """
        run_residuals = self._run_residuals
        rows = self.data.whole.run == 0
        ideal, model = self.ideal.residuals[rows], self.data.find_run_residuals(state, 0)
        effects, timing = state.effects_of(0), state.timing[0]
        residuals = pl.DataFrame(
            {
                "t": run_residuals.windows.times.mean(axis=1) + run_residuals.run.origin.time_s,
                **{f"ideal_{name}": ideal[:, i] for i, name in enumerate(COMPONENTS)},
                **{f"model_{name}": model[:, i] for i, name in enumerate(COMPONENTS)},
                **self._signals,
            }
        )
        return MotionView(
            input=self.data.source.value,
            effects=state.ids,
            ladder=ladder,
            floor=floor,
            residuals=residuals,
            velocity=self._draw_velocity(state),
            horizon_errors=self._gather_errors(run_residuals.find_horizon_errors(effects, timing)),
            arcs=self._draw_arcs(state),
            signatures=find_signatures(self.data, state),
            ideal_arcs=self._ideal_arcs,
        )

    def _draw_velocity(self, state: ModelState) -> pl.DataFrame:
        grid = self._run_residuals.grid
        velocity = self._run_residuals.predict_velocity(state.effects_of(0), state.timing[0])
        every = max(round(1.0 / (_RATE_HZ * grid.step_s)), 1)
        picked = slice(every // 2, None, every)
        columns = {f"v_{name}": getattr(velocity, name)[picked] for name in COMPONENTS}
        return pl.DataFrame(
            {
                "t": grid.times[picked] + self._run_residuals.run.origin.time_s,
                "piece": grid.span[picked].astype(np.int32),
                **columns,
            }
        )

    def _gather_errors(self, predicted: HorizonErrors) -> pl.DataFrame:
        horizons, ideal = self._run_residuals.horizons, self._ideal_errors
        count = np.maximum(np.bincount(horizons.number), 1)

        def size(errors: Floats) -> Floats:
            return np.asarray(np.sqrt(np.bincount(horizons.number, errors**2) / count), dtype=np.float64)

        first = np.unique(horizons.number, return_index=True)[1]
        times = horizons.times[first, 0] + self._run_residuals.run.origin.time_s
        present = np.unique(horizons.number)
        broken = np.diff(times, prepend=times[:1]) > _BROKEN_S
        return pl.DataFrame(
            {
                "t": times,
                "piece": np.cumsum(broken).astype(np.int32),
                "ideal": size(ideal.position)[present],
                "model": size(predicted.position)[present],
                "ideal_yaw": size(ideal.yaw)[present],
                "model_yaw": size(predicted.yaw)[present],
            }
        )

    def _draw_arcs(self, state: ModelState) -> pl.DataFrame:
        made = predict_from(self._run_residuals, state.effects_of(0), state.timing[0], rate_hz=_ARC_RATE_HZ)
        slot = np.floor(made.start_times / _ARC_EVERY_S)
        rows = np.flatnonzero(np.diff(slot, prepend=-1.0) > 0.0)
        x, y = made.poses[rows, :, 0], made.poses[rows, :, 1]
        if self._places is not None and rows.size:
            known = self._places["t"].to_numpy()
            at = [np.interp(made.start_times[rows], known, self._places[name].to_numpy()) for name in "xy"]
            x, y = x + (at[0] - x[:, 0])[:, None], y + (at[1] - y[:, 0])[:, None]
        steps = made.horizon_times.size
        return pl.DataFrame(
            {
                "t": (made.start_times[rows][:, None] + made.horizon_times).ravel(),
                "piece": np.repeat(np.arange(rows.size, dtype=np.int32), steps),
                "x": x.ravel(),
                "y": y.ravel(),
            }
        )


def view_diagnosis(
    tables: Mapping[str, pl.DataFrame],
    vehicle: Vehicle,
    diagnosis: RunDiagnosis,
) -> MotionView | None:
    """Return the results of the diagnosed model on the run.

    Args:
        tables: tables of the run: `poses`, `alignments` and `commands` or `wheels`, preferably with `imu`,
            `slip` and `velocities`.
        vehicle: geometry.
        diagnosis: of the run.

    Returns:
        Rows to draw, of the ideal model where no effect was found; None without errors of a model, or if the
        run has too little data for one.
    """
    file = read_model(diagnosis)
    if file is None or not diagnosis.ladder or "poses" not in tables:
        return None
    try:
        run = load_run(tables, vehicle, name=diagnosis.run)
        source = choose_input([run], diagnosis.input or None).source
        data = EstimationData([run], vehicle, source)
    except MotionError:
        # A log with too little data for a model still has its slip.
        return None
    state = ModelState(file.find_effects(run.name), (Timing(file.find_wheel_delay(run.name)),))
    return MotionStage(data, tables.get("velocities")).view(state, diagnosis.ladder, diagnosis.noise_floor)
