"""One prepared run: its input, grid, windows and horizons, and a model's residuals on them."""

import enum
from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Never

import numpy as np

from pipeline.core import SILENT_S, Complex, Floats, Ints, join_parts, name_first, turn_units
from pipeline.models import (
    Effect,
    ForwardModel,
    Late,
    Place,
    ReportEffect,
    Timing,
    find_late,
    is_own,
    replace_context,
)
from pipeline.run import (
    SPAN_S,
    Grid,
    HeadingSource,
    MotionError,
    MotionRun,
    Resets,
    RunContext,
    Signal,
    Velocity,
    Windows,
    choose_heading,
    find_gaps,
    find_lead,
    find_silences,
    gather_nodes,
    has_excluded,
    join_horizons,
    join_steps,
    join_windows,
    lay_grid,
)
from pipeline.sources import Vehicle

# Cell means of held commands are exact: finer cells change residuals in the sixth digit.
_RATE_HZ = 50.0
_COARSE_HZ = 25.0
"""Cell rate of long runs [Hz]: half of it raises the heading error of gravel 2024-08-06 by 7 %."""
_MOST_CELLS = 20_000
"""Largest number of cells of the fine grid; longer runs use the coarse one."""
_SETTLE_S = 0.6
"""Time at the start of a span [s] from which its initial velocity is estimated."""
_LEAST_S = 0.3
"""Shortest time [s] between two poses for a velocity estimate: over shorter ones noise dominates."""


class Input(enum.Enum):
    """Input of a model."""

    COMMAND = "command"
    MEASURED = "measured"

    @classmethod
    def _missing_(cls, value: object) -> Never:
        what = f"{value!r} is neither command nor measured"
        raise MotionError("bad_value", what, where="input", hint="Models start at one of the two.")


@dataclass(frozen=True)
class HorizonErrors:
    """Errors of predictions at each row of the horizons, shape (n,).

    Attributes:
        position: [m].
        yaw: wrapped [rad].
        turned: unwrapped [rad], since a model that turns far too fast can be wrong by more than a wrapped
            angle can express.
    """

    position: Floats
    yaw: Floats
    turned: Floats


Spot = tuple[Ints, Floats]


@dataclass(frozen=True)
class Measured:
    """Measured motion of every window for one pose delay.

    Attributes:
        spot: of each pose among the cell edges: index and fraction of the cell, each of shape (m,).
        frame: rotates the map into the frame of the heading half-way, shape (n,).
        moved: displacement in that frame [m], shape (n,).
        turned: change of heading [rad], shape (n,).
    """

    spot: Spot
    frame: Complex
    moved: Complex
    turned: Floats


class RunResiduals:
    """Measured less predicted motion of one run, for one input and any model.

    Attributes:
        run: the recording.
        windows: displacements whose residuals are found.
        horizons: predictions over 2 s whose errors are found.
        heading: source of the heading.
        forward: predictions from the input.
    """

    def __init__(
        self,
        run: MotionRun,
        vehicle: Vehicle,
        source: Input,
        *,
        heading: HeadingSource = HeadingSource.AUTO,
        rate_hz: float | None = None,
    ) -> None:
        series = run.commands if source is Input.COMMAND else run.wheels
        if series is None:
            words = "commands" if source is Input.COMMAND else "measured wheels"
            what = f"the run has no {words} to feed a model with"
            raise MotionError(f"no_{source.value}", what, where=run.name, hint="Choose the other input.")
        # The geometry may be another vehicle's; the controller is always that of this recording.
        vehicle = run.correct_vehicle(vehicle)
        self.run = run
        self.source = source
        self.grid = lay_grid(run, choose_rate([run]) if rate_hz is None else rate_hz)
        self.heading = choose_heading(run, self.grid, heading)
        self.nodes = gather_nodes(run.track, self.grid)
        if self.nodes.times.size == 0:
            what = "no pose falls into a stretch with a live command"
            hint = "Correct [[interval]], or take all with --interval all."
            raise MotionError("no_poses", what, where=run.name, hint=hint)
        lead = find_lead(run, run.alignment.heading_delay_s)
        self._silences = np.zeros(0) if run.wheels is None else find_silences(run.wheels, run.track.times)
        compared = run
        if source is Input.MEASURED:
            compared = replace(run, excluded=np.union1d(run.excluded, self._silences))
        self.windows = join_windows(compared, self.grid, self.nodes, lead)
        self.horizons = join_horizons(compared, self.grid, self.nodes, lead)
        self._steps = join_steps(compared, self.grid, self.nodes, lead)
        # First node of each prediction, common to all of its rows.
        self._begins = self.horizons.origin[np.flatnonzero(np.diff(self.horizons.number, prepend=-1))]
        self._pose_times = run.track.times[self.nodes.poses]
        self._path = self.nodes.average(run.track.path[self.nodes.poses])
        self._frames: dict[float, Complex] = {}
        self._headings: dict[float, Floats] = {}
        self._measured: dict[float, Measured] = {}
        base = self._make_context(vehicle)
        self.forward = ForwardModel(series, self.grid, base, encoders=run.wheels, has_gyro=self.has_gyro)
        self._reaching = replace_context(self.forward, self._look_from_horizons(base))

    @cached_property
    def stepped(self) -> "RunResiduals":
        """The same run, compared by increments that do not overlap in place of windows of half a second."""
        compared = copy(self)
        compared.windows, compared._measured = self._steps, {}  # noqa: SLF001 - its own
        return compared

    @property
    def where_read(self) -> "RunResiduals":
        """The same run, without the windows in which its encoders were silent."""
        if not self._silences.size:
            return self
        known = ~has_excluded(self._silences, *self.windows.times.T)
        compared = copy(self)
        compared.windows = Windows(**{name: rows[known] for name, rows in vars(self.windows).items()})
        compared._measured = {}  # noqa: SLF001 - its own
        return compared

    @property
    def has_gyro(self) -> bool:
        """Whether the gyro provides heading and clock."""
        return self.heading.gyro is not None

    @property
    def context(self) -> RunContext:
        """Data of the run available to effects."""
        return self.forward.context

    @property
    def restarts(self) -> RunContext:
        """The context with the body velocity before the start of every prediction, see `Resets`."""
        return self._reaching.context

    def list_active(self, effects: Iterable[Effect]) -> tuple[Effect, ...]:
        """Effects of a model that can act on this input, without a pose clock where the run has a gyro.

        The alignment with the gyro has already corrected the pose times. A clock belongs to one run: that of
        another run, or of this one before alignment, would shift the poses a second time.
        """
        return tuple(
            effect
            for effect in effects
            if (self.source is Input.COMMAND or effect.place > Place.DRIVE)
            and not (self.has_gyro and effect.late is Late.POSES)
        )

    def predict_velocity(
        self, effects: Sequence[Effect], timing: Timing, *, restarted: bool = False
    ) -> Velocity:
        """Body velocity of a model on the cells, as the localization would report it.

        Args:
            effects: of the model, with their values.
            timing: of the run.
            restarted: reset states to measured values where 2 s predictions begin.
        """
        if self.source is Input.COMMAND:
            timing = self.complete_timing(effects, timing)
        return self._run(self._reaching if restarted else self.forward, effects, timing)

    def predict_wheels(
        self, effects: Sequence[Effect], timing: Timing, *, restarted: bool = False
    ) -> Velocity:
        """Ideal velocity from the wheel speeds of a drivetrain model on the cells.

        Args:
            effects: of the drivetrain, with their values.
            timing: of the run: initial states are the wheel speeds at that time, whenever reported.
            restarted: see `predict_velocity`.
        """
        return self._run(self._reaching if restarted else self.forward, effects, timing)

    def _run(self, forward: ForwardModel, effects: Sequence[Effect], timing: Timing) -> Velocity:
        own = [effect.id for effect in effects if is_own(type(effect))]
        # Formulas check themselves; values that a user's Python effect leaves undefined give one error below.
        with np.errstate(all="ignore" if own else None):
            if self.source is Input.COMMAND:
                velocity = forward.run_commands(effects, timing)
            else:
                velocity = forward.run_wheels(effects, timing)
        if own and not all(np.isfinite(part).all() for part in (velocity.x, velocity.y, velocity.w)):
            what = "an effect of your own gives a velocity that is not a finite number"
            hint = "Correct its Python: it must give a number for every cell of the run."
            raise MotionError("not_finite", what, where=", ".join(own), hint=hint)
        return velocity

    def complete_timing(self, effects: Sequence[Effect], timing: Timing) -> Timing:
        """Timing with the part of the encoder delay that a body lag hides added to it.

        Initial states may use only values reported by the time of the pose that they start from.
        """
        if timing.wheel_delay_s <= 0.0:
            return timing
        hidden = sum(effect.delay for effect in effects if effect.late is Late.BODY)
        most = max(self.run.alignment.heading_delay_s, 0.0)
        return replace(timing, wheel_delay_s=min(timing.wheel_delay_s + hidden, most))

    def find_residuals(
        self, effects: Sequence[Effect], timing: Timing, late_s: float = 0.0, *, restarted: bool = False
    ) -> Floats:
        """Measured minus predicted displacement of every window, divided by its duration.

        Args:
            effects: of the model, with their values.
            timing: of the run.
            late_s: additional delay of the poses [s].
            restarted: see `predict_velocity`.

        Returns:
            x, y [m/s] in the frame of the measured heading half-way, and w [rad/s], shape (n, 3).
        """
        velocity = self.predict_velocity(effects, timing, restarted=restarted)
        delay = late_s + self._find_delay(effects)
        seen = self._measure(delay)
        return find_gaps(
            np.ascontiguousarray(velocity.x),
            np.ascontiguousarray(velocity.y),
            np.ascontiguousarray(velocity.w),
            self._frame(delay), self.grid.step_s,
            *seen.spot, self.nodes.first, self.windows.start, self.windows.end,
            seen.frame, seen.moved, seen.turned, self.windows.span_s,
        )  # fmt: skip

    def find_horizon_errors(
        self, effects: Sequence[Effect], timing: Timing, late_s: float = 0.0
    ) -> HorizonErrors:
        """Errors of two-second predictions from a measured state, integrating the model's own yaw.

        A prediction starts from the measured pose, the wheel speeds of the encoders where there are any, and
        the body velocity of the half second before: the information of a planner at that moment.

        Args:
            effects: of the model, with their values.
            timing: of the run.
            late_s: additional delay of the poses [s].
        """
        delay = late_s + self._find_delay(effects)
        moved, turned = self._predict_horizons(effects, timing, delay)
        heading = self._node_headings(delay)
        origin, node = self.horizons.origin, self.horizons.node
        predicted = self._path[origin] + np.exp(1j * heading[self._begins])[self.horizons.number] * moved
        yaw = (heading[node] - heading[origin]) - turned
        wrapped = np.abs(np.remainder(yaw + np.pi, 2.0 * np.pi) - np.pi)
        return HorizonErrors(np.abs(predicted - self._path[node]), wrapped, np.abs(yaw))

    def trace_horizons(
        self, effects: Sequence[Effect], timing: Timing
    ) -> tuple[Complex, Floats, Complex, Floats]:
        """Motion since the start of every prediction, predicted and measured.

        Returns:
            Predicted displacement [m] in the frame of the start, predicted turn [rad], and both as measured,
            shape (n,) each.
        """
        delay = self._find_delay(effects)
        moved, turned = self._predict_horizons(effects, timing, delay)
        heading = self._node_headings(delay)
        origin, node = self.horizons.origin, self.horizons.node
        back: Complex = np.exp(-1j * heading[self._begins])[self.horizons.number]
        return moved, turned, back * (self._path[node] - self._path[origin]), heading[node] - heading[origin]

    def find_horizon_shifts(
        self, effects: Sequence[Effect], others: Sequence[Effect], timing: Timing
    ) -> tuple[Floats, Floats, Floats]:
        """Differences between the two-second predictions of two models.

        Args:
            effects: of one model.
            others: of the other one.
            timing: of the run.

        Returns:
            Distance [m] and turn [rad] between them, and the distance predicted by the first [m], (n,) each.
        """
        one, two = (
            self._predict_horizons(model, timing, self._find_delay(model)) for model in (effects, others)
        )
        return np.abs(one[0] - two[0]), np.abs(one[1] - two[1]), np.abs(one[0])

    def _predict_horizons(
        self, effects: Sequence[Effect], timing: Timing, delay: float
    ) -> tuple[Complex, Floats]:
        """Displacement [m] in the frame of the start and turn [rad] of every prediction, shape (n,) each."""
        velocity = self.predict_velocity(effects, timing, restarted=True)
        spot = self._find_spot(delay)
        edges = self.grid.sum_up(velocity.w)
        own = turn_units(0.5 * (edges[1:] + edges[:-1]))
        travelled = self._at_nodes(self.grid.sum_up(join_parts(velocity.x, velocity.y) * own), spot)
        turned = self._at_nodes(edges, spot)
        origin, node = self.horizons.origin, self.horizons.node
        back: Complex = np.exp(-1j * turned[self._begins])[self.horizons.number]
        return back * (travelled[node] - travelled[origin]), turned[node] - turned[origin]

    def list_starts(self) -> tuple[Floats, Floats]:
        """Starts of predictions: stamps [s], shape (k,), and poses (x, y [m], yaw [rad]), shape (k, 3)."""
        origin = np.unique(self.horizons.origin)
        heading = self._node_headings(0.0)[origin]
        path = self._path[origin]
        return self.nodes.times[origin], np.column_stack((path.real, path.imag, heading))

    def _find_delay(self, effects: Sequence[Effect]) -> float:
        """Delay of the position stamps according to the model's own effects [s]."""
        late = sum(effect.delay_s() for effect in effects if isinstance(effect, ReportEffect))
        if self.has_gyro:
            late -= sum(effect.delay for effect in effects if effect.late is Late.HEADING)
        return late

    def _find_spot(self, delay: float) -> Spot:
        """Location of poses among the cell edges: preceding edge and fraction of its cell."""
        spot = self.grid.locate_edges(self._pose_times - delay)
        index = np.minimum(spot.astype(np.int64), self.grid.times.size - 1)
        return index, spot - index

    def _measure(self, delay: float) -> Measured:
        """Measured motion of every window for poses that are late by ``delay`` [s]."""
        if delay not in self._measured:
            heading = self._node_headings(delay)
            start, end = self.windows.start, self.windows.end
            frame = turn_units(-0.5 * (heading[start] + heading[end]))
            moved = frame * (self._path[end] - self._path[start])
            _forget(self._measured)
            spot = self._find_spot(delay)
            self._measured[delay] = Measured(spot, frame, moved, heading[end] - heading[start])
        return self._measured[delay]

    def measure_steps(self) -> Measured:
        """Measured motion of every window, with the stamps of the poses as they are."""
        return self._measure(0.0)

    def _at_nodes(self, edges: Signal, spot: Spot) -> Signal:
        index, beyond = spot
        before = edges[index]
        values: Signal = before + beyond * (edges[index + 1] - before)
        return self.nodes.average(values)

    def _node_headings(self, delay: float) -> Floats:
        """Measured heading at the nodes [rad]."""
        if delay not in self._headings:
            offset = self.heading.offset[self.nodes.poses]
            if self.heading.gyro is not None:
                index, beyond = self._find_spot(delay)
                before = self.heading.edges[index]
                offset = offset + before + beyond * (self.heading.edges[index + 1] - before)
            _forget(self._headings)
            self._headings[delay] = self.nodes.average(offset)
        return self._headings[delay]

    def _frame(self, delay: float) -> Complex:
        """Unit vectors along the measured heading on the cells."""
        key = 0.0 if self.heading.gyro is not None else delay
        if key not in self._frames:
            times, offset = self.run.track.times, self.heading.offset
            if self.heading.gyro is not None:
                middle = 0.5 * (self.heading.edges[1:] + self.heading.edges[:-1])
                heading = middle + np.interp(self.grid.times, times, offset)
            else:
                heading = np.interp(self.grid.times + delay, times, offset)
            _forget(self._frames)
            self._frames[key] = turn_units(heading)
        return self._frames[key]

    def _make_context(self, vehicle: Vehicle) -> RunContext:
        grid, track = self.grid, self.run.track
        at = grid.times
        first, last = self._first_moments()
        _, velocity = self._measure_velocity(first, last)
        # The velocity over this time is used after its end only, so that no earlier score depends on it.
        known = (self._locate_nodes(last), velocity)
        unknown = np.full((grid.first.size, 4), np.nan)
        spans = Resets(grid.span, grid.first, grid.first, unknown)
        return RunContext(
            vehicle=vehicle,
            times=at,
            start_s=self.run.start_s + self.run.lead_s,
            step_s=grid.step_s,
            duration_s=self.run.duration_s,
            spans=spans,
            wheels=spans,
            body=_reset_body(grid, grid.first, known),
            attitude=np.column_stack([np.interp(at, track.times, column) for column in track.attitude.T]),
            position=np.column_stack([np.interp(at, track.times, column) for column in track.position.T]),
        )

    def _look_from_horizons(self, base: RunContext) -> RunContext:
        """The context with states reset at every horizon to the values known at that time."""
        grid, nodes = self.grid, self.nodes
        origin = np.unique(self.horizons.origin)
        known = nodes.times[origin]
        # Where the encoders were silent, the drive goes on as predicted.
        known = known[~has_excluded(self._silences, known - SILENT_S, known + SILENT_S)]
        begin = grid.locate_edges(known).astype(np.int64)
        begin = np.minimum(begin, grid.times.size - 1)
        before = np.searchsorted(nodes.times, nodes.times[origin] - SPAN_S - 0.01)
        first = np.unique(np.concatenate((grid.first, begin)))
        number = np.searchsorted(first, np.arange(grid.times.size), side="right") - 1
        wheels = base.wheels
        if self.run.wheels is not None:
            wheels = Resets(number, first, first, np.full((first.size, 4), np.nan))
        measured, velocity = self._measure_velocity(before, origin)
        good = np.isfinite(velocity).all(axis=1)
        cell = np.concatenate((base.body.at, measured[good]))
        velocity = np.concatenate((base.body.start, velocity[good]))
        order = np.unique(cell, return_index=True)[1]
        rows = (cell[order], velocity[order])
        body = _reset_body(grid, np.unique(np.concatenate((grid.first, rows[0]))), rows)
        return replace(base, wheels=wheels, body=body)

    def _first_moments(self) -> tuple[Ints, Ints]:
        """First node of every span, and its last node within `_SETTLE_S`."""
        grid, nodes = self.grid, self.nodes
        first = np.searchsorted(nodes.times, grid.starts)
        last = np.searchsorted(nodes.times, grid.starts + _SETTLE_S) - 1
        return first, last

    def _measure_velocity(self, first: Ints, last: Ints) -> tuple[Ints, Floats]:
        """Body velocity between pairs of nodes: the cell midway, and (v_x, v_y, v_w) or NaN."""
        grid, nodes = self.grid, self.nodes
        heading = self._node_headings(0.0)
        top = nodes.times.size - 1
        one, two = np.clip(first, 0, top), np.clip(last, 0, top)
        span = nodes.times[two] - nodes.times[one]
        good = (
            (two > one) & (nodes.piece[one] == nodes.piece[two]) & (span > _LEAST_S) & (span < 2.0 * SPAN_S)
        )
        span = np.where(good, span, 1.0)
        moved = (self._path[two] - self._path[one]) * np.exp(-0.5j * (heading[one] + heading[two])) / span
        velocity = np.column_stack((moved.real, moved.imag, (heading[two] - heading[one]) / span))
        velocity[~good] = np.nan
        middle = 0.5 * (nodes.times[one] + nodes.times[two])
        return np.minimum(grid.locate_edges(middle).astype(np.int64), grid.times.size - 1), velocity

    def _locate_nodes(self, nodes: Ints) -> Ints:
        """Cells that contain the times of nodes."""
        at = self.nodes.times[np.clip(nodes, 0, self.nodes.times.size - 1)]
        return np.minimum(self.grid.locate_edges(at).astype(np.int64), self.grid.times.size - 1)


def choose_rate(runs: Iterable[MotionRun]) -> float:
    """Cell rate for modelling runs [Hz]."""
    recorded_s = sum(float(run.streams[-1] - run.streams[0]) for run in runs)
    return _COARSE_HZ if recorded_s * _RATE_HZ > _MOST_CELLS else _RATE_HZ


def _reset_body(grid: Grid, first: Ints, known: tuple[Ints, Floats]) -> Resets:
    """Resets of the body's state: at the given cells where a velocity is known, else at the first cell."""
    at, velocity = known
    good = np.isfinite(velocity).all(axis=1)
    start = np.full((first.size, 3), np.nan)
    position = first.copy()
    number = np.searchsorted(first, np.arange(grid.times.size), side="right") - 1
    rows = number[at[good]]
    start[rows], position[rows] = velocity[good], at[good]
    return Resets(number, first, position, start)


def _forget(cache: dict[float, Any]) -> None:
    while len(cache) > 2:  # noqa: PLR2004 - the value in use and one beside it for derivatives
        cache.pop(next(iter(cache)))


@dataclass(frozen=True)
class InputChoice:
    """An input and the reason for choosing it.

    Attributes:
        source: the input.
        reason: as text.
        idle: ids of the effects that cannot act on it, or on these runs.
        warning: sentence stating why they cannot; empty where all can act.
    """

    source: Input
    reason: str
    idle: tuple[str, ...] = ()
    warning: str = ""


def choose_input(
    runs: Sequence[MotionRun],
    asked: str | None = None,
    effects: Iterable[Effect] = (),
    *,
    last: str | None = None,
) -> InputChoice:
    """Choose the requested input, else that which the effects need, that of the last fit, or the default.

    The default is the command where every run has one: it covers everything from command to motion.

    Args:
        runs: all must have the input.
        asked: `command` or `measured`; None for the automatic choice.
        effects: of the model; those between command and wheels need the command.
        last: the input of the model's last fit.
    """
    known = tuple(effects)
    drivetrain = tuple(dict.fromkeys(effect.id for effect in known if effect.place <= Place.DRIVE))
    names = name_first(drivetrain)
    acts = f"{names} {'act' if len(drivetrain) > 1 else 'acts'} between command and wheels"
    silent = next((run.name for run in runs if run.commands is None), None)
    if asked is not None:
        source, reason = Input(asked), "as requested"
    elif silent is not None:
        source, reason = Input.MEASURED, f"{silent} has no command"
    elif drivetrain:
        source, reason = Input.COMMAND, acts
    elif last is not None and (last == Input.COMMAND.value or all(run.wheels is not None for run in runs)):
        source, reason = Input(last), "as at the last fit"
    else:
        source, reason = Input.COMMAND, "commands are preferred where recorded"
    idle, warnings = list[str](), list[str]()
    if source is Input.MEASURED and drivetrain:
        remedy = "--input command" if silent is None else f"{silent} has no command"
        idle += drivetrain
        warnings.append(f"not fitted from wheel encoders: {acts} ({remedy})")
    alone = next((run.name for run in runs if run.is_drive_alone), None)
    ground = [effect.id for effect in known if effect.place > Place.DRIVE] if alone is not None else []
    if ground:
        idle += ground
        act = "act" if len(ground) > 1 else "acts"
        warnings.append(f"not fitted: {', '.join(ground)} {act} behind the wheels, and {alone} has no pose")
        known = tuple(effect for effect in known if effect.id not in ground)
    clock = find_late(known, Late.POSES)
    if clock is not None and all(run.gyro_fit is not None for run in runs):
        idle.append(clock.id)
        warnings.append(f"{clock.id} not fitted: the gyro gives the delay of the poses")
    return InputChoice(source, reason, tuple(idle), "; ".join(warnings))
