"""Replay of a log's commands with the twin of a model in MuJoCo, the ideal and the kinematic model."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from pipeline.core import FOLDS, finite_or_none, pick
from pipeline.core.arrays import Flags, Floats
from pipeline.estimation.comparison import Input
from pipeline.estimation.fit import Fitted, fit_model
from pipeline.estimation.folds import number_predictions, refit
from pipeline.estimation.problem import Prediction, Problem, fit_as_it_is, predict_from
from pipeline.estimation.state import State
from pipeline.export.twin_body import TwinBody, build_twin_body
from pipeline.export.twin_files import STEP_S, find_driven_speed, write_world
from pipeline.job import INPUTS
from pipeline.job.run_results import diagnose_stored, find_diagnosis
from pipeline.models.effect import AddedEffect, Effect, Place
from pipeline.models.model import Model
from pipeline.models.model_file import ModelFile
from pipeline.report.motion_view import read_model_text
from pipeline.run import MotionError, MotionRun
from pipeline.run.signals import Resets, Rolling, RunContext, Velocity, Wheels

if TYPE_CHECKING:
    from types import ModuleType

    from pipeline.store import Manifest

_SETTLE_STEPS = 200
"""Steps until the wheels have settled on the ground under the weight: 0.4 s."""
_SEEN_S = 1.0
"""Additional lead time before a prediction to initialize the velocity of a sliding body from poses [s]."""
_FORGETS = 5.0
"""Time constants after which the initial state of a stretch has no influence."""


def load_mujoco() -> ModuleType:
    """Import the package that simulates the twin.

    Raises:
        MotionError: ``mujoco_needed``: it is not installed.
    """
    try:
        return importlib.import_module("mujoco")
    except ImportError:
        what = "a twin is driven in MuJoCo, which is not installed"
        hint = (
            "Install the extra: pip install 'slip-pipeline[sim]'. The files of --to mjcf and sdf need none."
        )
        raise MotionError("mujoco_needed", what, where="slip simulate --twin", hint=hint) from None


class TwinGround(AddedEffect):
    """Twin: motion of the body from its wheels through contact, computed by MuJoCo.

    It replaces everything between the servos and base_link, at the end of the model's path to the centre.

    Args:
        body: the twin's body.
        wanted: cells whose velocity is needed, shape (n,); the others stay at rest.
    """

    id = "twin_ground"
    place = Place.CENTRE
    parameters = ()

    def __init__(self, body: TwinBody, wanted: Flags | None = None) -> None:
        super().__init__()
        self._body = body
        self._wanted = wanted

    def add_to(
        self,
        total: Velocity,  # noqa: ARG002 - an effect is asked so
        rolling: Rolling,
        velocity: Velocity,  # noqa: ARG002
        context: RunContext,
    ) -> Velocity:
        """The velocity from MuJoCo, which replaces the previous one."""
        moved = _Drive(self._body, context).follow(rolling.wheels, self._wanted)
        arm = context.vehicle.kinematics.lever_m(context.vehicle)
        # The model converts from the rear axle to base_link, and these values are already of base_link.
        return Velocity(moved[:, 0], moved[:, 1] - arm * moved[:, 2], moved[:, 2])


def make_twin_effects(body: TwinBody, wanted: Flags | None = None) -> tuple[Effect, ...]:
    """The effects of a twin: its controller, MuJoCo, and the localization of the log."""
    return (*body.controller, TwinGround(body, wanted), *body.reported)


class _Drive:
    """A simulated world in which one body follows a run."""

    def __init__(self, body: TwinBody, context: RunContext) -> None:
        self.engine = load_mujoco()
        # Errors are reported by exceptions, without the file MUJOCO_LOG.TXT.
        self.engine.set_mju_user_warning(lambda _: None)
        self.body, self.context = body, context
        try:
            self.model = self.engine.MjModel.from_xml_string(write_world(body))
        except ValueError as error:
            what = f"MuJoCo {self.engine.__version__} does not read the twin: {' '.join(str(error).split())}"
            hint = "Install a newer one: pip install -U 'slip-pipeline[sim]'."
            raise MotionError("mujoco_old", what, where=body.vehicle.id, hint=hint) from None
        self.settled = self.engine.MjData(self.model)
        self.engine.mj_step(self.model, self.settled, nstep=_SETTLE_STEPS)
        self.data = self.engine.MjData(self.model)
        self.speeds = {name: self.model.joint(name).dofadr[0] for name in self._list_joints()}
        self.actuators = [self.model.actuator(number) for number in range(self.model.nu)]
        self.steps = max(round(context.step_s / STEP_S), 1)

    def _list_joints(self) -> list[str]:
        drive = ["drive"] if self.body.steering is not None else []
        return [*drive, *(wheel.name for wheel in self.body.wheels)]

    def follow(self, wheels: Wheels, wanted: Flags | None) -> Floats:
        """Velocity of base_link on cells (v_x, v_y, v_w), shape (n, 3)."""
        controls = self._list_controls(wheels)
        velocity = np.zeros((wheels.left.size, 3))
        known = _map_resets(self.context.wheels)
        moving = _map_resets(self.context.body) if self.body.slides else {}
        ends = np.append(self.context.spans.first[1:], wheels.left.size)
        for first, end in zip(self.context.spans.first.tolist(), ends.tolist(), strict=True):
            for begin, stop in self._cut(first, end, wanted):
                self._rest()
                self._turn(wheels.left[begin], wheels.right[begin])
                self._move(*self._roll(wheels.left[begin], wheels.right[begin]))
                before = self._read_pose()
                for cell in range(begin, stop):
                    row = known.get(cell)
                    if row is not None:
                        self._turn(row[0], row[1])
                        if not self.body.slides:
                            self._move(*self._roll(row[0], row[1]))
                    if cell in moving:
                        self._move(*moving[cell])
                    self.data.ctrl[:] = controls[cell]
                    self.engine.mj_step(self.model, self.data, nstep=self.steps)
                    after = self._read_pose()
                    velocity[cell] = _differentiate(before, after, self.context.step_s)
                    before = after
                self._check(velocity[begin:stop])
        return velocity

    def _cut(self, first: int, end: int, wanted: Flags | None) -> list[tuple[int, int]]:
        """Stretches of a span to simulate: the wanted cells, and the lead time that their state needs."""
        if wanted is None:
            return [(first, end)]
        lags = [
            servo.lag_s for servo in (*self.body.servos.values(), self.body.steering) if servo is not None
        ]
        before = self.body.delay_s + _FORGETS * (max(lags) + self.body.creep_s)
        before += _SEEN_S if self.body.slides else 0.0
        margin = math.ceil(before / self.context.step_s)
        near = np.flatnonzero(wanted[first:end]) + first
        stretches: list[tuple[int, int]] = []
        for cell in near.tolist():
            if stretches and cell - margin <= stretches[-1][1]:
                stretches[-1] = (stretches[-1][0], cell + 1)
            else:
                stretches.append((max(cell - margin, first), cell + 1))
        return stretches

    def _list_controls(self, wheels: Wheels) -> Floats:
        """Command of each servo on cells, shape (n, m)."""
        if self.body.steering is not None:
            return np.column_stack((0.5 * (wheels.left + wheels.right), wheels.steering))
        return np.column_stack([getattr(wheels, wheel.side) for wheel in self.body.wheels])

    def _rest(self) -> None:
        self.engine.mj_copyData(self.data, self.model, self.settled)

    def _turn(self, left: float, right: float) -> None:
        """Set the speed of the wheels [rad/s]."""
        speeds = {"left": left, "right": right, "drive": 0.5 * (left + right)}
        for wheel in self.body.wheels:
            shown = wheel.side if self.body.steering is None else "drive"
            self.data.qvel[self.speeds[wheel.name]] = speeds[shown]
        if self.body.steering is not None:
            self.data.qvel[self.speeds["drive"]] = speeds["drive"]
        servo = self.body.servos["left"]
        for number, actuator in enumerate(self.actuators):
            if actuator.actnum[0] and actuator.name != "steering":
                side = "drive" if self.body.steering is not None else self.body.wheels[number].side
                servo = self.body.servos.get(self.body.wheels[number].side, servo)
                self.data.act[actuator.actadr[0]] = speeds[side] / servo.gain

    def _move(self, v_x: float, v_y: float, turn: float) -> None:
        """Set the velocity of base_link [m/s, m/s, rad/s]."""
        yaw = self._read_pose()[2]
        self.data.qvel[0] = v_x * math.cos(yaw) - v_y * math.sin(yaw)
        self.data.qvel[1] = v_x * math.sin(yaw) + v_y * math.cos(yaw)
        self.data.qvel[5] = turn

    def _roll(self, left: float, right: float) -> tuple[float, float, float]:
        """Steady velocity of base_link for these wheel speeds; a car keeps its yaw rate."""
        rims = {
            wheel.side: wheel.radius_m * (left if wheel.side == "left" else right)
            for wheel in self.body.wheels
            if wheel.is_driven
        }
        forward = 0.5 * (rims["left"] + rims["right"])
        if self.body.steering is not None:
            turn = self.data.qvel[5]
            return forward, float(self.context.vehicle.base_to_rear_axle_m * turn), turn
        scrub = sum(w.aside_nspm * (w.x_m - self.body.centre_m[0]) ** 2 for w in self.body.wheels)
        drive = sum(w.along_nspm for w in self.body.wheels) * (0.5 * self.body.track_m) ** 2
        turn = (rims["right"] - rims["left"]) / self.body.track_m / (1.0 + scrub / drive)
        x, y = self.body.centre_m
        return forward + y * turn, -x * turn, turn

    def _read_pose(self) -> tuple[float, float, float]:
        x, y, _, a, b, c, d = self.data.qpos[:7].tolist()
        return x, y, math.atan2(2.0 * (a * d + b * c), 1.0 - 2.0 * (c * c + d * d))

    def _check(self, velocity: Floats) -> None:
        bad = self.engine.mjtWarning.mjWARN_BADQACC
        if self.data.warning[bad].number or not np.isfinite(velocity).all():
            what = "MuJoCo could not compute the twin's motion: its wheels left the ground"
            hint = "Look at the model's numbers (slip model show), or drop the effect that is out of range."
            raise MotionError("twin_unstable", what, where=self.body.vehicle.id, hint=hint)


def _map_resets(resets: Resets) -> dict[int, tuple[float, float, float]]:
    """Known states, by the cell before which they are set."""
    start = resets.start[:, :3]
    good = np.isfinite(start).all(axis=1)
    rows = zip(resets.at[good].tolist(), start[good].tolist(), strict=True)
    return {cell: (one, two, three) for cell, (one, two, three) in rows}


def _differentiate(
    before: tuple[float, float, float], after: tuple[float, float, float], step_s: float
) -> tuple[float, float, float]:
    turned = math.remainder(after[2] - before[2], 2.0 * math.pi)
    middle = before[2] + 0.5 * turned
    x, y = after[0] - before[0], after[1] - before[1]
    ahead = x * math.cos(middle) + y * math.sin(middle)
    aside = y * math.cos(middle) - x * math.sin(middle)
    return ahead / step_s, aside / step_s, turned / step_s


SIDES = ("ideal", "model", "twin")
"""Predictions that are compared with the measured motion."""
LEAST_REPRODUCED = 0.9
"""Smallest fraction of the model's error reduction that a complete twin reproduces."""
_WINDOW_S = 30.0
_PATH_EVERY_S = 2.0


@dataclass(frozen=True)
class ReplayError:
    """RMS error of predictions over 2 s from measured poses: position [m] and heading [rad]."""

    t_mrmse_m: float
    r_mrmse_rad: float


@dataclass(frozen=True)
class MissingEffect:
    """An effect that contact does not reproduce: its description, and the model's error [m] without it."""

    effect: str
    motion: str
    t_mrmse_m: float


@dataclass(frozen=True)
class TwinReplay:
    """Predictions of a log with three models.

    Attributes:
        run: name of the run.
        model: model of the twin; if it was fitted to this log, with the estimates from the whole log.
        body: the twin.
        is_seen: whether the model was fitted to this log; each prediction is then evaluated with parameters
            that were fitted without its stretch.
        errors: errors by `SIDES`.
        missing: effects that contact does not reproduce, in order of decreasing error.
        paths: rows ``t piece x y series`` of predictions over 2 s, including the measured path.
        horizon_errors: rows ``t value series``: the error of each prediction [m].
        predictions: number of predictions.
    """

    run: str
    model: Model
    body: TwinBody
    is_seen: bool
    errors: dict[str, ReplayError]
    missing: tuple[MissingEffect, ...]
    paths: pl.DataFrame
    horizon_errors: pl.DataFrame
    predictions: int

    @property
    def reproduced(self) -> float:
        """Fraction of the model's error reduction, relative to the ideal model, that the twin reproduces."""
        ideal, model, twin = (self.errors[side].t_mrmse_m for side in SIDES)
        return (ideal - twin) / (ideal - model) if ideal > model else float("nan")

    @property
    def is_worse(self) -> bool:
        """Whether the twin reproduces clearly less than its model."""
        return self.reproduced < LEAST_REPRODUCED

    def to_json(self) -> dict[str, object]:
        """The JSON object of `slip simulate --twin`."""
        return {
            "run": self.run,
            "vehicle": self.body.vehicle.id,
            "effects": list(self.model.ids),
            "fitted_to_this_log": self.is_seen,
            "predictions": self.predictions,
            "errors": {side: pick(error, "t_mrmse_m", "r_mrmse_rad") for side, error in self.errors.items()},
            "missing": [pick(one, "effect", "motion", "t_mrmse_m") for one in self.missing],
            "controller": [effect.id for effect in self.body.controller],
            "notes": list(self.body.notes),
            "reproduced": finite_or_none(self.reproduced),
        }


def find_run_model(manifest: Manifest, results: Path) -> ModelFile:
    """The model that the diagnosis of a run proposes.

    Raises:
        MotionError: ``nothing_named``: the twin would be the ideal model.
    """
    content = find_diagnosis(results, manifest) or diagnose_stored([manifest], INPUTS, None, None, None)
    file = read_model_text(content)
    if file is None or not file.model.effects:
        what = "the diagnosis of the run names no effect, so there is nothing that a twin would reproduce"
        hint = "Give a model: slip simulate RUN --twin model.toml."
        raise MotionError("nothing_named", what, where=manifest.run, hint=hint)
    return file


def replay_twin(file: ModelFile, run: MotionRun) -> TwinReplay:
    """Replay the commands of a run.

    Parameters that were fitted to this run are refitted without each stretch of ten seconds; others are
    used unchanged.

    Args:
        file: the model.
        run: the run, read with the model's vehicle.

    Raises:
        MotionError: ``mujoco_needed``; ``wrong_vehicle``; ``no_command``; ``twin_unstable``.
    """
    load_mujoco()
    problem = Problem([run], file.model.vehicle, Input.COMMAND)
    model = file.model.keep(effect.id for effect in problem.active_effects(file.model))
    is_seen = not file.list_fitted("runs") or any(
        row.get("sha256") == run.sha256 or row.get("run") == run.name for row in file.list_fitted("runs")
    )
    if is_seen:
        fitted = fit_model(problem, Model(problem.vehicle, model.effects), per_run=file.per_run, exact=True)
    else:
        fitted = fit_as_it_is(problem, Model(problem.vehicle, model.effects), file.per_run)
    speed = find_driven_speed(file)
    return _Replay(problem, fitted, speed, is_seen=is_seen).replay()


class _Replay:
    def __init__(self, problem: Problem, fitted: Fitted, speed_mps: float, *, is_seen: bool) -> None:
        self.problem, self.fitted, self.speed_mps, self.is_seen = problem, fitted, speed_mps, is_seen
        (self.comparison,) = problem.comparisons
        self.effects = fitted.state.effects_of(0)
        self.body = self._build(self.effects)

    def _build(self, effects: Sequence[Effect]) -> TwinBody:
        return build_twin_body(Model(self.problem.vehicle, tuple(effects)), self.speed_mps)

    def replay(self) -> TwinReplay:
        missing = [effect.id for effect in self.body.missing]
        position, yaw = self._find_errors(missing)
        errors = {side: ReplayError(_rms(position[side]), _rms(yaw[side])) for side in SIDES}
        context = self.comparison.context
        costs = [
            MissingEffect(
                effect.id, effect.describe_motion(context.vehicle, self.effects), _rms(position[effect.id])
            )
            for effect in self.body.missing
        ]
        paths, horizon_errors = self._draw_paths(), self._list_horizon_errors(position)
        return TwinReplay(
            run=self.comparison.run.name,
            model=Model(self.problem.vehicle, self.effects),
            body=self.body,
            is_seen=self.is_seen,
            errors=errors,
            missing=tuple(sorted(costs, key=lambda one: -one.t_mrmse_m)),
            paths=paths,
            horizon_errors=horizon_errors,
            predictions=int(np.unique(self.comparison.horizons.number).size),
        )

    def _list_states(self) -> Iterator[tuple[State, Flags]]:
        """Parameters and the predictions to evaluate them on: one set for all if the run is unseen."""
        (numbers,) = number_predictions(self.problem)
        if not self.is_seen:
            yield self.fitted.state, np.ones(numbers.size, dtype=bool)
            return
        for fold, training in enumerate(self.problem.training):
            state = self.fitted.state
            for part, fit, train in zip(self.problem.parts, self.fitted.fits, training, strict=True):
                state = state.take_over(refit(part, fit, train), fit.free)
            yield state, numbers % FOLDS == fold

    def _find_errors(self, missing: Sequence[str]) -> tuple[dict[str, Floats], dict[str, Floats]]:
        """Errors of position [m] and heading [rad] of every prediction, by side and by removed effect."""
        count = self.comparison.horizons.number.size
        position = {side: np.full(count, np.nan) for side in (*SIDES, *missing)}
        yaw = {side: np.full(count, np.nan) for side in position}
        for state, in_test in self._list_states():
            if not in_test.any():
                continue
            effects, timing = state.effects_of(0), state.timing[0]
            asked: dict[str, Callable[[], Sequence[Effect]]] = {
                "ideal": tuple,
                "model": lambda effects=effects: effects,  # type: ignore[misc]
                "twin": lambda effects=effects, in_test=in_test: make_twin_effects(  # type: ignore[misc]
                    self._build(effects), self._find_cells(in_test)
                ),
            }
            for name in missing:
                asked[name] = lambda effects=effects, name=name: [e for e in effects if e.id != name]  # type: ignore[misc]
            for side, make in asked.items():
                errors = self.comparison.find_horizon_errors(make(), timing)
                position[side][in_test], yaw[side][in_test] = errors.position[in_test], errors.yaw[in_test]
        return position, yaw

    def _find_cells(self, in_test: Flags) -> Flags:
        """Cells that these predictions use, shape (n,)."""
        grid = self.comparison.grid
        times = self.comparison.horizons.times[in_test]
        late = self.comparison.run.alignment.heading_delay_s
        steps = np.zeros(grid.times.size + 1, dtype=np.int64)
        margin = 2.0 * grid.step_s + abs(late)
        np.add.at(steps, np.searchsorted(grid.times, times[:, 0] - margin), 1)
        np.add.at(steps, np.searchsorted(grid.times, times[:, 1] + margin), -1)
        used: Flags = np.cumsum(steps)[:-1] > 0
        return used

    def _draw_paths(self) -> pl.DataFrame:
        timing = self.fitted.state.timing[0]
        track, origin = self.comparison.run.track, self.comparison.run.origin
        frames = [_tabulate_track(track.times + origin.time_s, origin.put_back(track.path))]
        sides = {"ideal": (), "model": self.effects, "twin": make_twin_effects(self.body)}
        for side, effects in sides.items():
            made = predict_from(self.comparison, effects, timing, rate_hz=10.0)
            frames.append(_tabulate_arcs(made, side))
        return pl.concat(frames)

    def _list_horizon_errors(self, position: dict[str, Floats]) -> pl.DataFrame:
        horizons = self.comparison.horizons
        first = np.unique(horizons.number, return_index=True)[1]
        count = np.maximum(np.bincount(horizons.number), 1)
        times = horizons.times[first, 0] + self.comparison.run.origin.time_s
        frames = []
        for side in SIDES:
            squares = np.bincount(horizons.number, np.nan_to_num(position[side]) ** 2) / count
            values = np.sqrt(squares)[np.unique(horizons.number)]
            frames.append(pl.DataFrame({"t": times, "value": values, "series": side}))
        return pl.concat(frames)


def _rms(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


def _tabulate_track(times: Floats, path: np.ndarray[tuple[int], np.dtype[np.complex128]]) -> pl.DataFrame:
    piece = np.cumsum(np.diff(times, prepend=times[:1]) > _WINDOW_S).astype(np.int32)
    return pl.DataFrame({"t": times, "piece": piece, "x": path.real, "y": path.imag, "series": "measured"})


def _tabulate_arcs(made: Prediction, side: str) -> pl.DataFrame:
    slot = np.floor(made.start_times / _PATH_EVERY_S)
    starts = np.flatnonzero(np.diff(slot, prepend=-1.0) > 0.0)
    steps = made.horizon_times.size
    return pl.DataFrame(
        {
            "t": (made.start_times[starts][:, None] + made.horizon_times).ravel(),
            "piece": np.repeat(np.arange(starts.size, dtype=np.int32), steps),
            "x": made.poses[starts, :, 0].ravel(),
            "y": made.poses[starts, :, 1].ravel(),
            "series": side,
        }
    )
