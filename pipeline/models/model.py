"""A motion model, a vehicle and its effects, and the velocities that it predicts."""

from __future__ import annotations

from abc import abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Self, TypeVar, cast

import numpy as np

from pipeline.core import Floats, guess_names
from pipeline.models.effect import (
    AddedEffect,
    BodyEffect,
    CommandEffect,
    DriveEffect,
    Effect,
    KinematicEffect,
    Place,
    ReportEffect,
)
from pipeline.run import (
    DriveSeries,
    Grid,
    HeldDrive,
    MeasuredDrive,
    MotionError,
    Resets,
    Rolling,
    RunContext,
    Velocity,
    Wheels,
    roll_ideally,
)
from pipeline.sources import Vehicle


@dataclass(frozen=True)
class Model:
    """A vehicle and its effects, in the order of the command path.

    ``model + effect`` and ``model - "id"`` return new models; without effects it is the ideal model.

    Attributes:
        vehicle: geometry.
        effects: sorted by stage and rank, each id at most once.
    """

    vehicle: Vehicle
    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        seen: set[str] = set()
        for effect in self.effects:
            if effect.id in seen:
                what = f"the model has {effect.id} twice"
                hint = "Drop one of them, or change its parameters."
                raise MotionError("effect_twice", what, where=effect.id, hint=hint)
            seen.add(effect.id)
            if self.vehicle.kind not in effect.kinds:
                raise MotionError(
                    "wrong_vehicle",
                    f"{effect.id} exists on {' or '.join(effect.kinds)} vehicles only; {self.vehicle.id} is "
                    f"{self.vehicle.kind}",
                    where=effect.id,
                    hint="Choose another effect.",
                )
        ordered = sorted(self.effects, key=lambda effect: (effect.place, effect.rank))
        object.__setattr__(self, "effects", tuple(ordered))

    def __add__(self, effect: Effect) -> Model:
        if effect.id in self:
            what, hint = "it is already in the model", "`slip model fit` fits it again."
            raise MotionError("effect_twice", what, where=effect.id, hint=hint)
        return replace(self, effects=(*self.effects, effect))

    def __sub__(self, effect: str | Effect) -> Model:
        name = effect if isinstance(effect, str) else effect.id
        self.effect(name)
        return replace(self, effects=tuple(e for e in self.effects if e.id != name))

    def __contains__(self, name: str) -> bool:
        return name in self.ids

    def __iter__(self) -> Iterator[Effect]:
        return iter(self.effects)

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of the effects in order."""
        return tuple(effect.id for effect in self.effects)

    @property
    def ideal(self) -> Model:
        """The same vehicle without effects."""
        return Model(self.vehicle)

    def effect(self, name: str) -> Effect:
        """The effect of that id.

        Raises:
            MotionError: ``no_such_effect``, the model does not have it.
        """
        for effect in self.effects:
            if effect.id == name:
                return effect
        hint = f"{guess_names(name, self.ids)}The model has: {', '.join(self.ids) or 'none'}."
        what = f"no effect of the model is called {name!r}"
        raise MotionError("no_such_effect", what, where=name, hint=hint)

    def change(self, name: str, **values: float) -> Model:
        """The model with other parameter values of one effect.

        Raises:
            MotionError: no such effect or parameter, or a value out of bounds.
        """
        return self.swap(self.effect(name).change(**values))

    def swap(self, *effects: Effect) -> Model:
        """The model with its effects replaced by these effects of the same ids."""
        new = {effect.id: effect for effect in effects}
        return replace(self, effects=tuple(new.get(e.id, e) for e in self.effects))

    def keep(self, names: Iterable[str]) -> Model:
        """The model with only these effects."""
        wanted = set(names)
        return replace(self, effects=tuple(e for e in self.effects if e.id in wanted))


Result = TypeVar("Result")

_REMEMBERED = 3
"""Number of cached states of a long run: each has several arrays of its grid, 1.6 MB and more."""
_REMEMBERED_OF_SHORT = 8
"""Number of cached states of a short run: memory is not critical, and the derivatives by all parameters
start from the same state."""
_SHORT = 200_000
"""Number of grid cells below which a run is short: 2.2 hours at the 25 Hz of long runs."""


@dataclass(frozen=True)
class Timing:
    """Clock delays of one run, not part of the vehicle's physics.

    Attributes:
        wheel_delay_s: delay of the measured wheel speeds against the poses [s].
        encoder_delay_s: the same against the commands [s].
    """

    wheel_delay_s: float = 0.0
    encoder_delay_s: float = 0.0


class JointDrive(DriveEffect):
    """Acts in the drive, and is computed faster for several values and inputs at once."""

    @classmethod
    @abstractmethod
    def drive_each(cls, pairs: Sequence[tuple[Self, Wheels]], context: RunContext) -> list[Wheels]:
        """`drive_wheels` of each effect and its wheels; none of the effects is neutral."""


class JointBody(BodyEffect):
    """Computes the body velocity faster for several values and rolling velocities at once."""

    @classmethod
    @abstractmethod
    def move_each(cls, pairs: Sequence[tuple[Self, Rolling]], context: RunContext) -> list[Velocity]:
        """`move_body` of each effect and its rolling velocity; none of the effects is neutral."""


@dataclass(frozen=True)
class _Path:
    """From the command to the wheels.

    Attributes:
        commanded, driven: effects that act on commands, and in the drive.
        delay_s: delay of the measured wheels [s].
        continues: whether each of `driven` comes before the last one with a state.
        keys: of the wheels before the first of `driven` and after each.
    """

    commanded: tuple[Effect, ...]
    driven: tuple[DriveEffect, ...]
    delay_s: float
    continues: tuple[bool, ...]
    keys: tuple[tuple[object, ...], ...]


def _follow(effects: Sequence[Effect], timing: Timing) -> _Path:
    commanded = tuple(e for e in effects if e.place is Place.COMMAND)
    driven = tuple(cast("DriveEffect", e) for e in effects if e.place is Place.DRIVE)
    last = max((index for index, effect in enumerate(driven) if effect.has_state), default=-1)
    continues = tuple(index < last for index in range(len(driven)))
    keys: list[tuple[object, ...]] = [(timing.wheel_delay_s, *(e.key for e in commanded), "|")]
    for effect, is_before in zip(driven, continues, strict=True):
        keys.append((*keys[-1], effect.key, is_before))
    return _Path(commanded, driven, timing.wheel_delay_s, continues, tuple(keys))


class ForwardModel:
    """Predicted velocities of one run for many models.

    Args:
        series: commands, or measured wheel speeds.
        grid: the grid.
        context: data of the run that effects may use.
        encoders: measured wheel speeds for the initial states; None without.
        has_gyro: whether the heading of the measured velocities comes from a gyro.
    """

    def __init__(
        self,
        series: DriveSeries,
        grid: Grid,
        context: RunContext,
        *,
        encoders: DriveSeries | None,
        has_gyro: bool,
    ) -> None:
        self.series = series
        self.grid = grid
        self.context = context
        self.encoders = encoders
        self.has_gyro = has_gyro
        self._measured = MeasuredDrive(series)
        self._encoders = None if encoders is None else MeasuredDrive(encoders)
        # Derivatives are taken by one parameter after another; their common start state must stay cached.
        self._most = _REMEMBERED_OF_SHORT if grid.times.size < _SHORT else _REMEMBERED
        self._cache: dict[Place, OrderedDict[object, object]] = {stage: OrderedDict() for stage in Place}
        self._known: OrderedDict[float, tuple[RunContext, RunContext]] = OrderedDict()
        self._ahead: dict[object, Wheels] = {}
        self._moved: dict[object, Velocity] = {}

    @cached_property
    def _held(self) -> HeldDrive:
        return HeldDrive(self.series, self.grid)

    def run_commands(self, effects: Sequence[Effect], timing: Timing) -> Velocity:
        """Reported body velocity, predicted from commands."""
        path = _follow(effects, timing)
        return self._move(self._drive(path, len(path.driven)), path.keys[-1], effects)

    def look_ahead(self, models: Sequence[tuple[Sequence[Effect], Timing]], *, measured: bool) -> None:
        """Compute what is faster at once for models that are predicted next.

        Args:
            models: with the same effects, and their delays.
            measured: whether from wheel encoders in place of commands.
        """
        self._ahead, self._moved = {}, {}
        if self._most == _REMEMBERED:
            return
        if measured:
            self._move_ahead(models)
        else:
            self._drive_ahead([_follow(effects, timing) for effects, timing in models])

    def _drive_ahead(self, paths: Sequence[_Path]) -> None:
        """Wheels after an effect of the drive, for paths with the delay of the first one."""
        at = next((n for n, one in enumerate(paths[0].driven) if isinstance(one, JointDrive)), None)
        if at is None:
            return
        delay_s, continues, known = paths[0].delay_s, paths[0].continues[at], self._cache[Place.DRIVE]
        new = {
            key: one
            for one in paths
            if (key := one.keys[at + 1]) not in known
            and one.delay_s == delay_s
            and not one.driven[at].is_neutral
        }
        if len(new) > 1:
            pairs = [(cast("JointDrive", one.driven[at]), self._drive(one, at)) for one in new.values()]
            context = self._start_wheels(delay_s)[continues]
            self._ahead = dict(zip(new, pairs[0][0].drive_each(pairs, context), strict=True))

    def _move_ahead(self, models: Sequence[tuple[Sequence[Effect], Timing]]) -> None:
        """Motion of the body with the measured wheel speeds, for models in which one effect gives it."""
        new = dict[object, tuple[JointBody, Rolling]]()
        for effects, timing in models:
            body = [effect for effect in effects if effect.place is Place.BODY]
            if len(body) == 1 and isinstance(body[0], JointBody) and not body[0].is_neutral:
                rolling, key = self._find_rolling(*self._measure_wheels(timing), effects)
                key = (*key, "|", body[0].key)
                if key not in self._cache[Place.BODY]:
                    new[key] = (body[0], rolling)
        if len(new) > 1:
            pairs = list(new.values())
            self._moved = dict(zip(new, pairs[0][0].move_each(pairs, self.context), strict=True))

    def run_wheels(self, effects: Sequence[Effect], timing: Timing) -> Velocity:
        """Reported body velocity, predicted from wheel encoders, without effects of the drivetrain."""
        return self._move(*self._measure_wheels(timing), effects)

    def _measure_wheels(self, timing: Timing) -> tuple[Wheels, tuple[object, ...]]:
        """Measured wheel speeds, and their key."""
        key = (timing.wheel_delay_s,)
        measure = partial(self._measured.interpolate, self.context.times, timing.wheel_delay_s)
        return self._keep(Place.DRIVE, key, measure), key

    def _start_wheels(self, delay_s: float) -> tuple[RunContext, RunContext]:
        """The run with wheel speeds from the encoders where states are reset, and where spans begin only."""
        if delay_s not in self._known:
            context = self.context
            if self._encoders is not None:
                wheels, spans = (
                    replace(resets, start=self._encoders.interpolate(self._locate(resets), delay_s).stack())
                    for resets in (context.wheels, context.spans)
                )
                context = replace(context, wheels=wheels, spans=spans)
            self._known[delay_s] = (context, replace(context, wheels=context.spans))
            if len(self._known) > _REMEMBERED:
                self._known.popitem(last=False)
        return self._known[delay_s]

    def _locate(self, resets: Resets) -> Floats:
        """Times at which states are reset [s], shape (k,)."""
        return self.context.times[resets.first] - 0.5 * self.context.step_s

    def _keep(self, stage: Place, key: object, make: Callable[[], Result]) -> Result:
        cache = self._cache[stage]
        if key in cache:
            cache.move_to_end(key)
            return cast("Result", cache[key])
        made = make()
        cache[key] = made
        if len(cache) > self._most:
            cache.popitem(last=False)
        return made

    def _hold(self, effects: Sequence[Effect], delay_s: float) -> Wheels:
        first = np.full((self.grid.first.size, 4), np.nan)
        if self._encoders is not None:
            first = self._encoders.interpolate(self.grid.starts, delay_s).stack()
        commands = self._held.begin_spans(first)
        for effect in effects:
            commands = cast("CommandEffect", effect).change_commands(commands, self.context)
        return self._held.average_on_grid(commands)

    def _drive(self, path: _Path, count: int) -> Wheels:
        """Wheel speeds after some effects of the drive; cached per effect, as the next may vary alone.

        Measured wheels are the state of the last effect with a state. Those before it continue theirs.
        """
        known = self._cache[Place.DRIVE]
        done = next(
            (n for n in range(count, 0, -1) if path.keys[n] in known or path.keys[n] in self._ahead), 0
        )
        if done:
            wheels = self._keep(Place.DRIVE, path.keys[done], partial(self._ahead.pop, path.keys[done]))
        else:
            hold = partial(self._hold, path.commanded, path.delay_s)
            wheels = self._keep(Place.COMMAND, path.keys[0], hold)
        contexts = self._start_wheels(path.delay_s)
        for n in range(done, count):
            drive = partial(path.driven[n].drive_wheels, wheels, contexts[path.continues[n]])
            wheels = self._keep(Place.DRIVE, path.keys[n + 1], drive)
        return wheels

    def _move(self, wheels: Wheels, key: tuple[object, ...], effects: Sequence[Effect]) -> Velocity:
        rolling, key = self._find_rolling(wheels, key, effects)
        body = [e for e in effects if e.place is Place.BODY]
        key = (*key, "|", *(e.key for e in body))
        moved, rolling = self._keep(Place.BODY, key, partial(self._move_body, rolling, body, key))
        velocity = moved
        for effect in effects:
            if effect.place is Place.GROUND:
                velocity = cast("AddedEffect", effect).add_to(velocity, rolling, moved, self.context)
        for effect in effects:
            if effect.place is Place.CENTRE:
                velocity = cast("AddedEffect", effect).add_to(velocity, rolling, velocity, self.context)
        vehicle = self.context.vehicle
        arm = vehicle.kinematics.lever_m(vehicle)
        if arm != 0.0:
            velocity = velocity.add(y=arm * velocity.w)
        for effect in effects:
            if effect.place is Place.LOCALIZATION:
                if isinstance(effect, AddedEffect):
                    velocity = effect.add_to(velocity, rolling, velocity, self.context)
                elif self.has_gyro:
                    velocity = cast("ReportEffect", effect).report_gyro(velocity, self.context)
                else:
                    velocity = cast("ReportEffect", effect).report(velocity, self.context)
        return velocity

    def _find_rolling(
        self, wheels: Wheels, key: tuple[object, ...], effects: Sequence[Effect]
    ) -> tuple[Rolling, tuple[object, ...]]:
        """Rolling velocity of wheels, and its key."""
        rolled = [e for e in effects if e.place is Place.KINEMATICS]
        key = (*key, "|", *(e.key for e in rolled))
        return self._keep(Place.KINEMATICS, key, partial(self._roll, wheels, rolled)), key

    def _roll(self, wheels: Wheels, effects: Sequence[Effect]) -> Rolling:
        rolling = roll_ideally(wheels, self.context)
        for effect in effects:
            rolling = cast("KinematicEffect", effect).roll(rolling, self.context)
        return rolling

    def _move_body(
        self, rolling: Rolling, effects: Sequence[Effect], key: object
    ) -> tuple[Velocity, Rolling]:
        """Body velocity, and v0, w0 that effects of the ground act on."""
        ground = rolling
        for effect in cast("Sequence[BodyEffect]", effects):
            known = self._moved.pop(key, None)
            moved = effect.move_body(rolling, self.context) if known is None else known
            rolling = replace(rolling, v0=moved.x, s0=moved.y, w0=moved.w)
            if effect.is_kinematic:
                ground = replace(ground, v0=moved.x, w0=moved.w)
        return rolling.velocity, ground


def replace_context(forward: ForwardModel, context: RunContext) -> ForwardModel:
    """The same input with another run context."""
    return ForwardModel(
        forward.series, forward.grid, context, encoders=forward.encoders, has_gyro=forward.has_gyro
    )
