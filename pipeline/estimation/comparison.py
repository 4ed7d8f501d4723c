"""One run made ready: its input, grid, windows and horizons, and a model's residuals on them."""

import enum
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from pipeline.core.arrays import Complex, Floats, Ints, join_parts, turn_units
from pipeline.models.catalogue import is_own
from pipeline.models.effect import Effect, Late, Place, ReportEffect, find_late
from pipeline.models.model import Forward, Timing, replace_context
from pipeline.run.heading import Grid, HeadingSource, choose_heading, lay_grid
from pipeline.run.recording import MotionError, MotionRun
from pipeline.run.signals import Resets, RunContext, Signal, Velocity
from pipeline.run.windows import WINDOW_S, find_gaps, find_lead, gather_nodes, join_horizons, join_windows
from pipeline.sources import Vehicle

# Cell means of held commands are exact: finer cells change residuals in the sixth digit.
_RATE_HZ = 50.0
_COARSE_HZ = 25.0
"""Cells per second of long runs [Hz]; with half of it the heading of gravel 2024-08-06 errs by 7 % more."""
_MOST_CELLS = 20_000
"""Cells of the fine grid up to which it is used."""
_SETTLE_S = 0.6
"""First moments of a span [s], from which the velocity at its start is read."""
_LEAST_S = 0.3
"""Shortest stretch [s] between two poses from which a velocity is read: shorter ones are noise."""


class Input(enum.Enum):
    """What a model is fed with."""

    COMMAND = "command"
    MEASURED = "measured"


@dataclass(frozen=True)
class HorizonErrors:
    """Errors of predictions at each row of the horizons, shape (n,).

    Attributes:
        position: [m].
        yaw: wrapped [rad].
        turned: the same with whole turns counted [rad]: a model that turns far too fast is wrong by more than
            a wrapped angle can say.
    """

    position: Floats
    yaw: Floats
    turned: Floats


Cached = TypeVar("Cached")
Spot = tuple[Ints, Floats]


@dataclass(frozen=True)
class Measured:
    """What poses of one delay say of every window.

    Attributes:
        spot: of each pose among the cell edges: index and share of the cell, each of shape (m,).
        frame: turns the map into the frame of the heading half-way, shape (n,).
        moved: displacement in that frame [m], shape (n,).
        turned: change of heading [rad], shape (n,).
    """

    spot: Spot
    frame: Complex
    moved: Complex
    turned: Floats


class Comparison:
    """One run, one input: what a model predicts against what was measured.

    Attributes:
        run: the recording.
        windows: displacements that are compared.
        horizons: predictions that are compared.
        heading: whose heading is used.
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
        # Whoever's geometry counts, the controller is that of this recording.
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
        self.windows = join_windows(run, self.grid, self.nodes, lead)
        self.horizons = join_horizons(run, self.grid, self.nodes, lead)
        # Where each prediction begins; all of its rows begin there.
        self._begins = self.horizons.origin[np.flatnonzero(np.diff(self.horizons.number, prepend=-1))]
        self._pose_times = run.track.times[self.nodes.poses]
        self._path = self.nodes.average(run.track.path[self.nodes.poses])
        self._frames: dict[float, Complex] = {}
        self._headings: dict[float, Floats] = {}
        self._measured: dict[float, Measured] = {}
        base = self._make_context(vehicle)
        self._forward = Forward(series, self.grid, base, encoders=run.wheels, has_gyro=self.has_gyro)
        self._reaching = replace_context(self._forward, self._look_from_horizons(base))

    @property
    def has_gyro(self) -> bool:
        """Whether the gyro is heading and clock."""
        return self.heading.gyro is not None

    @property
    def context(self) -> RunContext:
        """What effects may know of the run."""
        return self._forward.context

    @property
    def restarts(self) -> RunContext:
        """What is known where every prediction begins: the body's velocity before it, see `Resets`."""
        return self._reaching.context

    def list_active(self, effects: Iterable[Effect]) -> tuple[Effect, ...]:
        """Effects of a model that can act on this input, without the clock of poses that a gyro has dated.

        Those poses were put back to their moments when the recording was aligned. A clock belongs to one run:
        that of another run, or of this one before it was aligned, would move them a second time.
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
            restarted: states begin anew, from what was measured, where predictions over 2 s begin.
        """
        if self.source is Input.COMMAND:
            timing = self._complete_timing(effects, timing)
        return self._run(self._reaching if restarted else self._forward, effects, timing)

    def predict_wheels(
        self, effects: Sequence[Effect], timing: Timing, *, restarted: bool = False
    ) -> Velocity:
        """Ideal velocity of the wheels of a drivetrain on the cells.

        Args:
            effects: of the drivetrain, with their values.
            timing: of the run: states begin with what the wheels did then, whenever it was reported.
            restarted: see `predict_velocity`.
        """
        return self._run(self._reaching if restarted else self._forward, effects, timing)

    def _run(self, forward: Forward, effects: Sequence[Effect], timing: Timing) -> Velocity:
        own = [effect.id for effect in effects if is_own(type(effect))]
        # Formulas judge themselves; what Python of the user's own leaves without a value is said in one line.
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

    def _complete_timing(self, effects: Sequence[Effect], timing: Timing) -> Timing:
        """The delay of the encoders with what a body that follows late has hidden of it.

        States may only begin with what had been reported when the pose they start from was.
        """
        if timing.wheel_delay_s <= 0.0:
            return timing
        hidden = sum(effect.delay for effect in effects if effect.late is Late.BODY)
        most = max(self.run.alignment.heading_delay_s, 0.0)
        return replace(timing, wheel_delay_s=min(timing.wheel_delay_s + hidden, most))

    def find_residuals(
        self, effects: Sequence[Effect], timing: Timing, late_s: float = 0.0, *, restarted: bool = False
    ) -> Floats:
        """Measured less predicted displacement of every window, over its length.

        Args:
            effects: of the model, with their values.
            timing: of the run.
            late_s: how much later the poses are than they are taken for [s].
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

        A prediction begins with the measured pose, the wheel speeds of the encoders where there are any, and
        the body velocity of the half second before: what a planner knows at that moment.

        Args:
            effects: of the model, with their values.
            timing: of the run.
            late_s: how much later the poses are than they are taken for [s].
        """
        delay = late_s + self._find_delay(effects)
        moved, turned = self._predict_horizons(effects, timing, delay)
        heading = self._node_headings(delay)
        origin, node = self.horizons.origin, self.horizons.node
        predicted = self._path[origin] + np.exp(1j * heading[self._begins])[self.horizons.number] * moved
        yaw = (heading[node] - heading[origin]) - turned
        wrapped = np.abs(np.remainder(yaw + np.pi, 2.0 * np.pi) - np.pi)
        return HorizonErrors(np.abs(predicted - self._path[node]), wrapped, np.abs(yaw))

    def find_horizon_shifts(
        self, effects: Sequence[Effect], others: Sequence[Effect], timing: Timing
    ) -> tuple[Floats, Floats, Floats]:
        """How far two models' two-second predictions lie apart.

        Args:
            effects: of one model.
            others: of the other one.
            timing: of the run.

        Returns:
            Distance [m] and turn [rad] between them, and the way that the first predicts [m], (n,) each.
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
        """Where predictions begin: stamps [s], shape (k,), and poses (x, y [m], yaw [rad]), shape (k, 3)."""
        origin = np.unique(self.horizons.origin)
        heading = self._node_headings(0.0)[origin]
        path = self._path[origin]
        return self.nodes.times[origin], np.column_stack((path.real, path.imag, heading))

    def _find_delay(self, effects: Sequence[Effect]) -> float:
        """How much later the model itself says positions are stamped [s]."""
        late = sum(effect.delay_s() for effect in effects if isinstance(effect, ReportEffect))
        if self.has_gyro:
            late -= sum(effect.delay for effect in effects if effect.late is Late.HEADING)
        return late

    def _find_spot(self, delay: float) -> Spot:
        """Where poses lie among the cell edges: the edge before, and how far on in its cell."""
        spot = self.grid.locate_edges(self._pose_times - delay)
        index = np.minimum(spot.astype(np.int64), self.grid.times.size - 1)
        return index, spot - index

    def _measure(self, delay: float) -> Measured:
        """What the poses say of every window when they are late by ``delay`` [s]."""
        if delay not in self._measured:
            heading = self._node_headings(delay)
            start, end = self.windows.start, self.windows.end
            frame = turn_units(-0.5 * (heading[start] + heading[end]))
            moved = frame * (self._path[end] - self._path[start])
            _forget(self._measured)
            spot = self._find_spot(delay)
            self._measured[delay] = Measured(spot, frame, moved, heading[end] - heading[start])
        return self._measured[delay]

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
        # What was seen over the first moments counts from their end on: nothing scored before has used it.
        known = (self._locate_nodes(last), velocity)
        unknown = np.full((grid.first.size, 3), np.nan)
        spans = Resets(grid.span, grid.first, grid.first, unknown)
        return RunContext(
            vehicle=vehicle,
            times=at,
            start_s=self.run.start_s,
            step_s=grid.step_s,
            duration_s=self.run.duration_s,
            spans=spans,
            wheels=spans,
            body=_reset_body(grid, grid.first, known),
            attitude=np.column_stack([np.interp(at, track.times, column) for column in track.attitude.T]),
            position=np.column_stack([np.interp(at, track.times, column) for column in track.position.T]),
        )

    def _look_from_horizons(self, base: RunContext) -> RunContext:
        """The run with states that begin anew at every horizon, with what is known by then."""
        grid, nodes = self.grid, self.nodes
        origin = np.unique(self.horizons.origin)
        begin = grid.locate_edges(nodes.times[origin]).astype(np.int64)
        begin = np.minimum(begin, grid.times.size - 1)
        before = np.searchsorted(nodes.times, nodes.times[origin] - WINDOW_S - 0.01)
        first = np.unique(np.concatenate((grid.first, begin)))
        number = np.searchsorted(first, np.arange(grid.times.size), side="right") - 1
        wheels = base.wheels
        if self.run.wheels is not None:
            wheels = Resets(number, first, first, np.full((first.size, 3), np.nan))
        at, velocity = self._measure_velocity(before, origin)
        good = np.isfinite(velocity).all(axis=1)
        at = np.concatenate((base.body.at, at[good]))
        velocity = np.concatenate((base.body.start, velocity[good]))
        order = np.unique(at, return_index=True)[1]
        rows = (at[order], velocity[order])
        body = _reset_body(grid, np.unique(np.concatenate((grid.first, rows[0]))), rows)
        return replace(base, wheels=wheels, body=body)

    def _first_moments(self) -> tuple[Ints, Ints]:
        """First node of every span and the last within its first moments."""
        grid, nodes = self.grid, self.nodes
        first = np.searchsorted(nodes.times, grid.starts)
        last = np.searchsorted(nodes.times, grid.starts + _SETTLE_S) - 1
        return first, last

    def _measure_velocity(self, first: Ints, last: Ints) -> tuple[Ints, Floats]:
        """Body velocity between pairs of nodes: cells in their middle, and (v_x, v_y, v_w) or NaN."""
        grid, nodes = self.grid, self.nodes
        heading = self._node_headings(0.0)
        top = nodes.times.size - 1
        one, two = np.clip(first, 0, top), np.clip(last, 0, top)
        span = nodes.times[two] - nodes.times[one]
        good = (
            (two > one) & (nodes.piece[one] == nodes.piece[two]) & (span > _LEAST_S) & (span < 2.0 * WINDOW_S)
        )
        span = np.where(good, span, 1.0)
        moved = (self._path[two] - self._path[one]) * np.exp(-0.5j * (heading[one] + heading[two])) / span
        velocity = np.column_stack((moved.real, moved.imag, (heading[two] - heading[one]) / span))
        velocity[~good] = np.nan
        middle = 0.5 * (nodes.times[one] + nodes.times[two])
        return np.minimum(grid.locate_edges(middle).astype(np.int64), grid.times.size - 1), velocity

    def _locate_nodes(self, nodes: Ints) -> Ints:
        """Cells in which nodes were reached."""
        at = self.nodes.times[np.clip(nodes, 0, self.nodes.times.size - 1)]
        return np.minimum(self.grid.locate_edges(at).astype(np.int64), self.grid.times.size - 1)


def choose_rate(runs: Iterable[MotionRun]) -> float:
    """Cells per second that runs are modelled on [Hz]."""
    return _COARSE_HZ if sum(run.duration_s for run in runs) * _RATE_HZ > _MOST_CELLS else _RATE_HZ


def _reset_body(grid: Grid, first: Ints, known: tuple[Ints, Floats]) -> Resets:
    """Resets of the body's state: at the cells given where a velocity is known, else at the first cell."""
    at, velocity = known
    good = np.isfinite(velocity).all(axis=1)
    start = np.full((first.size, 3), np.nan)
    position = first.copy()
    number = np.searchsorted(first, np.arange(grid.times.size), side="right") - 1
    rows = number[at[good]]
    start[rows], position[rows] = velocity[good], at[good]
    return Resets(number, first, position, start)


def _forget(cache: dict[float, Cached]) -> None:
    while len(cache) > 2:  # noqa: PLR2004 - the value in use and one beside it for derivatives
        cache.pop(next(iter(cache)))


@dataclass(frozen=True)
class InputChoice:
    """An input and why it was taken.

    Attributes:
        source: the input.
        reason: in words.
        idle: ids of the effects that cannot act on it, or on these runs.
        warning: why they cannot, in a sentence; empty where all can act.
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
    """The input asked for; else what the effects need, what was last used, or what leads in the runs.

    The command leads where every run has one: it holds everything between what was asked and what came of it.

    Args:
        runs: all must have the input.
        asked: `command` or `measured`; None leaves the choice open.
        effects: of the model; those between command and wheels need the command.
        last: the input of the model's last fit.
    """
    known = tuple(effects)
    drivetrain = tuple(dict.fromkeys(effect.id for effect in known if effect.place <= Place.DRIVE))
    acts = f"{', '.join(drivetrain)} {'act' if len(drivetrain) > 1 else 'acts'} between command and wheels"
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
    clock = find_late(known, Late.POSES)
    if clock is not None and all(run.gyro_fit is not None for run in runs):
        idle.append(clock.id)
        warnings.append(f"{clock.id} not fitted: the gyro gives the delay of the poses")
    return InputChoice(source, reason, tuple(idle), "; ".join(warnings))
