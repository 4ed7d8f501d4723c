"""A fitting problem: one or several runs, one input, and which numbers are free."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.identification.comparison import Comparison, Input
from pipeline.identification.encoders import measure_wheel_delay
from pipeline.models.effect import Late, Place, Search, find_late
from pipeline.models.forward import Timing
from pipeline.runs.errors import MotionError
from pipeline.runs.heading import HeadingSource

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.models.effect import Effect, Parameter
    from pipeline.models.model import Model
    from pipeline.runs.recording import MotionRun
    from pipeline.vehicles import Vehicle

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

_DELAY_BOUNDS = (-0.7, 0.9)
_DELAY_STEP = 5e-3
_FEWEST_WINDOWS = 20


@dataclass(frozen=True)
class Free:
    """A number that is fitted.

    Attributes:
        effect: id of the effect; empty for a delay of the recording.
        name: of the parameter or of the delay.
        run: number of the run it belongs to; None where all runs share it.
        bounds: smallest and largest value.
        step: for numerical derivatives.
        parameter: its declaration; None for a delay.
    """

    effect: str
    name: str
    run: int | None
    bounds: tuple[float, float]
    step: float
    parameter: Parameter | None = None

    @property
    def label(self) -> str:
        """``effect.name``, or ``timing.name``."""
        return f"{self.effect or 'timing'}.{self.name}"


@dataclass(frozen=True)
class State:
    """A model with its values, run by run.

    Attributes:
        model: with the shared values.
        own: values that belong to one run: by run number, then ``(effect, name)``.
        timing: delays of each run.
    """

    model: Model
    own: Mapping[int, Mapping[tuple[str, str], float]]
    timing: tuple[Timing, ...]

    def effects_of(self, run: int) -> tuple[Effect, ...]:
        """The effects as they act in one run."""
        if run not in self.own:
            return self.model.effects
        model = self.model
        for (effect, name), value in self.own[run].items():
            model = model.change(effect, **{name: value})
        return model.effects

    def get(self, free: Free) -> float:
        """Value of a free number."""
        if not free.effect:
            return float(getattr(self.timing[free.run or 0], free.name))
        if free.run is not None and (free.effect, free.name) in self.own.get(free.run, {}):
            return self.own[free.run][free.effect, free.name]
        return self.model.effect(free.effect).values[free.name]

    def set(self, free: Free, value: float) -> State:
        """The state with another value of a free number, brought inside its bounds."""
        # A step that ends on a bound may miss it by a rounding error.
        value = min(max(value, free.bounds[0]), free.bounds[1])
        if not free.effect:
            timing = list(self.timing)
            timing[free.run or 0] = replace(timing[free.run or 0], **{free.name: value})
            return replace(self, timing=tuple(timing))
        if free.run is not None:
            own = {**self.own.get(free.run, {}), (free.effect, free.name): value}
            return replace(self, own={**self.own, free.run: own})
        return replace(self, model=self.model.change(free.effect, **{free.name: value}))


class Problem:
    """Runs made ready for one input; models are fitted to it and judged on it.

    Building one is the expensive part; asking it about many models is cheap.

    Args:
        runs: one or several recordings of one vehicle.
        vehicle: geometry.
        source: what models are fed with.
        heading: whose heading is used.
        estimate_timing: delays of the recording are fitted along with every model (as far as they can be told
            from physics); else they are ``timing``.
        timing: delays of each run to start from, or to keep.

    Raises:
        MotionError: a run lacks the input, or has too little that can be compared.
    """

    def __init__(
        self,
        runs: Sequence[MotionRun],
        vehicle: Vehicle,
        source: Input,
        *,
        heading: HeadingSource = HeadingSource.AUTO,
        timing: Sequence[Timing] | None = None,
        rate_hz: float | None = None,
    ) -> None:
        more = {} if rate_hz is None else {"rate_hz": rate_hz}
        self.vehicle = runs[0].correct_vehicle(vehicle)
        self.source = source
        self.comparisons = tuple(Comparison(run, vehicle, source, heading=heading, **more) for run in runs)
        self.given_timing = None if timing is None else tuple(timing)
        # From commands, states begin with what the encoders say: their delay must be known beforehand.
        late = source is Input.COMMAND and timing is None
        self._late_wheels = tuple(
            measure_wheel_delay(run, vehicle) if late and comparison.has_gyro else 0.0
            for run, comparison in zip(runs, self.comparisons, strict=True)
        )
        counts = []
        for comparison in self.comparisons:
            counts.append(comparison.windows.start.size)
            if counts[-1] < _FEWEST_WINDOWS:
                raise MotionError(
                    "too_short",
                    f"the run has {counts[-1]} stretches of half a second with live commands and good poses; "
                    f"{_FEWEST_WINDOWS} are needed",
                    where=comparison.run.name,
                    hint="Drive longer, or check the intervals and the pose topic with `slip inspect`.",
                )
        self.run_of = np.repeat(np.arange(len(counts)), counts)
        shift = np.concatenate(([0], np.cumsum([int(c.windows.block.max()) + 1 for c in self.comparisons])))
        self._block_shift = shift
        blocks = [c.windows.block + shift[i] for i, c in enumerate(self.comparisons)]
        self.block_of: Integers = np.concatenate(blocks)
        self.times: Floats = np.concatenate([c.windows.times for c in self.comparisons])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the runs."""
        return tuple(comparison.run.name for comparison in self.comparisons)

    def horizon_blocks(self, run: int) -> Integers:
        """Block of every row of a run's horizons, numbered as `block_of`."""
        shifted: Integers = self.comparisons[run].horizons.block + self._block_shift[run]
        return shifted

    def start_state(self, model: Model) -> State:
        """A model before fitting: delays as given, or as the gyro shows them."""
        if self.given_timing is not None:
            return State(model, {}, self.given_timing)
        known = find_late(model, Late.POSES) is None
        timing = tuple(
            Timing(
                pose_delay_s=c.heading.gyro.yaw_delay_s if c.heading.gyro is not None and known else 0.0,
                wheel_delay_s=late,
            )
            for c, late in zip(self.comparisons, self._late_wheels, strict=True)
        )
        return State(model, {}, timing)

    def active_effects(self, model: Model) -> tuple[Effect, ...]:
        """Effects that can act on this input."""
        if self.source is Input.COMMAND:
            return model.effects
        return tuple(e for e in model.effects if e.place > Place.DRIVE)

    def list_free(self, model: Model, per_run: Sequence[str] = ()) -> tuple[Free, ...]:
        """The numbers a fit may change.

        Args:
            model: with its fixed parameters.
            per_run: labels ``effect.name``, or ids of effects, whose values belong to each run alone.
        """
        found: list[Free] = []
        for effect in self.active_effects(model):
            for parameter in effect.parameters:
                if parameter.name in effect.fixed or not effect.is_used(parameter):
                    continue
                alone = f"{effect.id}.{parameter.name}" in per_run or effect.id in per_run
                places: Sequence[int | None] = range(len(self.comparisons)) if alone else [None]
                found += [
                    Free(effect.id, parameter.name, run, parameter.bounds, parameter.step, parameter)
                    for run in places
                ]
        return (*found, *self._free_delays(model))

    def _free_delays(self, model: Model) -> list[Free]:
        """Delays that this input and heading can tell from physics.

        With a gyro the delay of the poses is known from their heading and is no free number: a position that
        is later than its own heading, or a body that is later than its wheels, are effects (see `Late`).
        """
        if self.given_timing is not None:
            return []
        found = []
        for run, comparison in enumerate(self.comparisons):
            measured = self.source is Input.MEASURED
            if measured and not comparison.has_gyro and find_late(model, Late.POSES) is None:
                found.append(Free("", "pose_delay_s", run, _DELAY_BOUNDS, _DELAY_STEP))
            if comparison.has_gyro and measured:
                found.append(Free("", "wheel_delay_s", run, _DELAY_BOUNDS, _DELAY_STEP))
        return found

    def find_residuals(self, state: State) -> Floats:
        """Residuals of all windows of all runs, shape (n, 3): x, y [m/s], w [rad/s]."""
        return np.concatenate([self.find_run_residuals(state, run) for run in range(len(self.comparisons))])

    def find_run_residuals(self, state: State, run: int) -> Floats:
        """Residuals of one run's windows."""
        return self.comparisons[run].find_residuals(state.effects_of(run), state.timing[run])

    def differentiate(self, state: State, free: Sequence[Free], base: Floats) -> Floats:
        """Change of the residuals with every free number, by differences; shape (n, 3, p)."""
        columns = np.zeros((*base.shape, len(free)))
        for index, number in enumerate(free):
            value, (low, high) = state.get(number), number.bounds
            step = number.step if value + number.step <= high else -number.step
            del low
            moved = state.set(number, value + step)
            if number.run is None:
                columns[:, :, index] = (self.find_residuals(moved) - base) / step
            else:
                rows = self.run_of == number.run
                columns[rows, :, index] = (self.find_run_residuals(moved, number.run) - base[rows]) / step
        return columns


def needs_search(free: Free) -> bool:
    """Whether a number is found on a grid only."""
    return free.parameter is not None and free.parameter.search is Search.GRID
