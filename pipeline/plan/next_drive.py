"""Plan of the next drive after stored runs, and the forecast from all runs of a vehicle.

The plan answers open questions of their diagnosis; the forecast is of one model fitted jointly to all runs of
a vehicle.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.core import SlipError, format_count
from pipeline.datasets import (
    Forecast,
    expect_values,
    find_estimates,
    forecast_vehicle,
    list_held,
)
from pipeline.estimation import Recording
from pipeline.estimation.decision import find_cost
from pipeline.estimation.estimation_data import EstimationData
from pipeline.estimation.fit import PathFit, fit_path
from pipeline.estimation.path_residuals import weigh_runs
from pipeline.estimation.run_residuals import Input, RunResiduals
from pipeline.logs import LogError, locate_recorded, open_log
from pipeline.models import Effect, Late, Model, list_effects
from pipeline.plan.manoeuvres import Area, DrivenRange, Limits, choose_limits, is_steered
from pipeline.plan.plan import Plan, Request, find_largest, make_plan
from pipeline.plan.plan_files import WHEELS, list_types
from pipeline.plan.questions import Question, ask_apart, ask_numbers, ask_presence, ask_undecided, list_names
from pipeline.plan.rehearsal import Knowledge, assume, learn, measure_driven_range
from pipeline.results import RunDiagnosis, find_refusal, read_suggestion
from pipeline.run import MotionRun, load_motion_run
from pipeline.sources import Vehicle, load_vehicle
from pipeline.store import Manifest, Store, read_choices

MOST_JOINED = 24
"""Largest number of jointly fitted runs, those on the terrain first: more take longer for the same result."""
OTHER_GROUND = 0.1
"""Weight of a run on another terrain, so that runs on the requested terrain dominate and the others determine
the remaining parameters. The median heading error of seven runs, divided by that of their own models, is 1.29
with 0.3, 1.22 with 0.1 and 1.21 with 0.03; with 0.03 the largest error grows."""


def forecast_deployment(
    store: Store,
    vehicle: str,
    terrain: str,
    source: Literal["command", "measured"] = "command",
    *,
    without: Sequence[str] = (),
    notify: Callable[[str], object] = str,
) -> Forecast:
    """Forecast the parameters of a vehicle on a terrain from the runs of the results.

    The stored models define the effects and the start values of the fit (`forecast_vehicle`). This model is
    fitted to all runs of the vehicle jointly, each weighted by its own misfit, with less weight for other
    terrains. An effect that fewer models have is added if it lowers the misfit over all runs. How parameters
    vary between terrains and runs is that of the single runs (`expect_values`).

    Args:
        store: the results.
        vehicle: id of the vehicle.
        terrain: name of the terrain; it need not have runs.
        source: input of the model.
        without: SHA-256 of recordings to exclude, such as those to be predicted.
        notify: called with a line of progress.

    Raises:
        SlipError: there is no fleet, or no run of the vehicle.
    """
    estimates = find_estimates(store, without=without)
    start = forecast_vehicle(estimates, vehicle, terrain, source)
    runs = list(_load_runs(store, start))
    if not start.numbers or not runs:
        return start
    notify(f"fitting {format_count(len(runs), 'run')} jointly")
    geometry, held = runs[0][1], list_held(estimates, vehicle, source)
    data = EstimationData([run for run, _ in runs], geometry, Input(source))
    clocks = [effect for effect in held if effect.late is Late.POSES]
    shares = np.array([1.0 if run.terrain == terrain else OTHER_GROUND for run in data.runs])
    fits: list[PathFit] = []
    also: list[str] = []
    timing = data.start_state().timing
    for path in (weigh_runs(one, shares) for one in data.paths):
        mine = [effect for effect in (*start.effects, *clocks) if path.owns(effect)]
        active = data.active_effects(Model(geometry, tuple(mine)))
        # The delays of the encoders follow from the body: the drivetrain moves wheels before they report it.
        state = replace(data.start_state(active), timing=timing)
        fit = _add_held(fit_path(path, state), held)
        also += [effect.id for effect in fit.state.effects if effect.id not in state.ids]
        timing = fit.state.timing
        fits.append(fit)
    if also:
        start = forecast_vehicle(estimates, vehicle, terrain, source, also=also)
    return expect_values(start, read_values(data, fits, terrain))


def _load_runs(store: Store, start: Forecast) -> Iterator[tuple[MotionRun, Vehicle]]:
    """Runs of the forecast that have its input, those on its terrain first."""
    for name in start.runs[:MOST_JOINED]:
        manifest = store.manifest(name)
        with contextlib.suppress(SlipError):
            if manifest is not None:
                vehicle = load_vehicle(manifest)
                run = load_motion_run(manifest, vehicle)
                RunResiduals(run, vehicle, Input(start.input))
                yield run, vehicle


def _add_held(fit: PathFit, held: Sequence[Effect]) -> PathFit:
    """Extend the fit with effects of some stored models if they lower the misfit over all runs."""
    for effect in held:
        taken = any(
            effect.id == one.id or effect.id in one.contains or one.id in effect.contains
            for one in fit.state.effects
        )
        if taken or not fit.path.owns(effect):
            continue
        extended = fit_path(fit.path, fit.state.add(effect))
        if find_cost(extended) < find_cost(fit):
            fit = extended
    return fit


def read_values(data: EstimationData, fits: Sequence[PathFit], terrain: str) -> Mapping[str, float]:
    """Values of the joint fits by label; a terrain parameter has its value on this terrain.

    For a terrain without runs it is the median over the other terrains, which is robust against an unusual
    one such as ice.
    """
    first = {run.terrain: number for number, run in reversed([*enumerate(data.runs)])}
    runs = [first[terrain]] if terrain in first else [*first.values()]
    values: dict[str, float] = {}
    for fit in fits:
        for number in fit.free:
            if number.effect:
                acting = (replace(number, runs=(run,)) for run in runs)
                values[number.label] = float(np.median([fit.state.get(one) for one in acting]))
    return values


@dataclass(frozen=True)
class Studied:
    """Knowledge of one vehicle from its runs.

    Attributes:
        diagnosis: joint diagnosis of the runs; None without runs.
        knowledge: model and the uncertainty of its parameters.
        forecast: the fleet's forecast, which the knowledge includes; None if it was not used.
    """

    diagnosis: RunDiagnosis | None
    knowledge: Knowledge
    forecast: Forecast | None = None


@dataclass(frozen=True)
class Wish:
    """Request of a user for a plan.

    Attributes:
        area: free area.
        time_s: longest duration [s].
        wanted: ids of effects whose open questions are to be answered; empty for all.
        speed_mps, yaw_rate_radps, acceleration_mps2, lateral_mps2: limits; None for what the runs reached, or
            without runs for those of the vehicle.
        topic, type_name: topic and type of the played commands; None for those of the recorded command.
    """

    area: Area
    time_s: float
    wanted: tuple[str, ...] = ()
    speed_mps: float | None = None
    yaw_rate_radps: float | None = None
    acceleration_mps2: float | None = None
    topic: str | None = None
    type_name: str | None = None
    lateral_mps2: float | None = None


def plan_drive(
    vehicle: Vehicle,
    studied: Studied,
    wish: Wish,
    recordings: Sequence[Recording] = (),
    command: Mapping[str, object] | None = None,
    notify: Callable[[str], object] = str,
) -> Plan:
    """Plan the drive that tells most of the open questions.

    Args:
        vehicle: vehicle to drive.
        studied: knowledge of the vehicle.
        wish: request of the user.
        recordings: the runs that the knowledge comes from.
        command: choice of the first run's command, from `read_command`.
        notify: called with what is being done.

    Raises:
        SlipError: an effect is unknown, the vehicle's largest speed is unknown, or no drive fits.
    """
    knowledge, diagnosis = studied.knowledge, studied.diagnosis
    reached = DrivenRange() if knowledge.data is None else measure_driven_range(knowledge.data)
    limits = choose_limits(
        vehicle,
        reached,
        speed_mps=wish.speed_mps,
        yaw_rate_radps=wish.yaw_rate_radps,
        acceleration_mps2=wish.acceleration_mps2,
        lateral_mps2=wish.lateral_mps2,
    )
    notify("fitting the alternatives of open questions")
    questions = ask(knowledge, wish.wanted, limits, wish.time_s, diagnosis)
    topic, type_name = choose_topic(vehicle, command or {}, recordings[0].path if recordings else "")
    request = Request(
        limits,
        wish.area,
        wish.time_s,
        tuple(recording.name for recording in recordings),
        wish.topic or topic,
        wish.type_name or type_name,
        tuple(reached.list_used(limits)),
    )
    return make_plan(knowledge, questions, request, notify)


def study(
    recordings: Sequence[Recording],
    vehicle: Vehicle,
    terrain: str | None = None,
    known: Path | None = None,
    notify: Callable[[str], None] | None = None,
) -> Studied:
    """Diagnose runs jointly, and fit the identified and the undecided effects.

    Args:
        recordings: runs of one vehicle.
        vehicle: the vehicle.
        terrain: terrain to drive on; the fleet's prior for it is combined with runs on this terrain, and
            replaces the estimates of runs on other terrains.
        known: results folder of the fleet; needed with a terrain.
        notify: called with what is being done.

    Raises:
        SlipError: nothing can be estimated, or a run has no commands.
    """
    from pipeline.estimation import diagnose_runs, load_recording  # noqa: PLC0415 - heavy

    joint = diagnose_runs(recordings, vehicle, notify=notify)
    diagnosis = joint.runs[0]
    if joint.proposal is None:
        why = find_refusal(diagnosis.findings) or "the log cannot be judged"
        what = f"{why}, so that nothing can be planned from it"
        hint = "See the findings of `slip diagnose`, or plan for the vehicle alone with --vehicle."
        raise SlipError("nothing_judged", what, where=recordings[0].name, hint=hint)
    catalogue = {effect.id for effect in list_effects()}
    named = [effect for effect in joint.proposal.model.effects if effect.id in catalogue]
    if terrain is None:
        # A suggested term was seen on the ground of these runs.
        named += read_suggestion(diagnosis, vehicle)
    runs = [load_recording(recording, vehicle) for recording in recordings]
    if terrain is None or known is None:
        return Studied(diagnosis, learn(runs, vehicle, named))
    here = [run for run in runs if run.terrain == terrain]
    # The prior excludes runs that are fitted themselves, and includes those on other terrains.
    forecast = _forecast(known, vehicle, terrain, without=[run.sha256 for run in here])
    if len(here) < len(runs):
        expected = assume(vehicle, forecast.effects, forecast.prior).base
        return Studied(diagnosis, replace(learn(runs, vehicle, named), base=expected, fitted=None), forecast)
    rest = [effect for effect in forecast.effects if effect.id not in {one.id for one in named}]
    return Studied(diagnosis, learn(runs, vehicle, [*named, *rest], forecast.prior), forecast)


def expect(vehicle: Vehicle, terrain: str | None, known: Path) -> Studied:
    """Knowledge of a vehicle without a log: the fleet's forecast on a terrain, or the ideal model.

    Raises:
        SlipError: the results contain nothing about the vehicle.
    """
    if terrain is None:
        return Studied(None, assume(vehicle))
    forecast = _forecast(known, vehicle, terrain)
    return Studied(None, assume(vehicle, forecast.effects, forecast.prior), forecast)


def _forecast(known: Path, vehicle: Vehicle, terrain: str, without: Sequence[str] = ()) -> Forecast:
    return forecast_deployment(Store(known), vehicle.id, terrain, without=without)


def ask(
    knowledge: Knowledge, wanted: Sequence[str], limits: Limits, time_s: float, diagnosis: RunDiagnosis | None
) -> list[Question]:
    """List what the logs so far leave open, or without logs all that acts on the vehicle.

    Undecided alternatives, identified effects that others could replace, wide intervals, and effects that the
    logs could not show.

    Args:
        knowledge: knowledge before the drive.
        wanted: ids of effects; only what concerns one of them is asked. Empty for all.
        limits: limits of the commands, to which the usual sizes of effects are relative.
        time_s: length of the plan [s].
        diagnosis: diagnosis of the existing logs; None without logs.

    Raises:
        SlipError: an effect is unknown or does not exist on the vehicle.
    """
    groups = [] if diagnosis is None else [group.candidates for group in diagnosis.undecided]
    open_ones = {name for group in groups for name in group}
    stated = {}
    if diagnosis is not None and not diagnosis.has_suggestion:
        # Beside a suggested term effects have other numbers.
        stated = {
            f"{effect.id}.{name}": value.half
            for effect in diagnosis.effects
            for name, value in effect.parameters.items()
        }
    numbers = ask_numbers(knowledge.base, stated)
    questions: list[Question] = [*ask_undecided(knowledge, groups), *ask_apart(knowledge, open_ones)]
    questions += [one for one in numbers if not open_ones & {*one.effects}]
    acting = list_names(knowledge)
    hidden = [one for one in (acting if diagnosis is None else diagnosis.unobservable_why) if one in acting]
    if wanted:
        questions = [one for one in questions if {*wanted} & {*one.effects}]
    largest = find_largest(knowledge, limits, time_s)
    return [*questions, *ask_presence(knowledge, dict.fromkeys(wanted or hidden), largest)]


def read_command(manifest: Manifest) -> dict[str, object]:
    """Choice of a stored run's command: ``choices``, and the configuration as ``command_source``."""
    configuration = manifest.details.get("configuration")
    source = configuration.get("command") if isinstance(configuration, dict) else None
    return {**read_choices(manifest), "command_source": source}


def choose_topic(vehicle: Vehicle, choices: Mapping[str, object], log: str) -> tuple[str, str]:
    """Topics and type of the command in a log; the vehicle's usual one if the log has none.

    A body command has priority over a pair of wheel speeds [rad/s].
    """
    types = list_types(steered=is_steered(vehicle))
    chosen = choices.get("choices")
    command = chosen.get("command") if isinstance(chosen, dict) else None
    asked: list[str] = []
    if isinstance(command, dict):
        asked = [str(command.get("topic")), *(str(other["topic"]) for other in command.get("others", []))]
    message_types = _read_types(log) if asked else {}
    for topic in asked:
        if message_types.get(topic) in types:
            return topic, message_types[topic]
    if isinstance(command, dict) and command.get("type") == WHEELS and _is_plain(choices, vehicle):
        sides = [str(one).removesuffix(".data") for one in str(command["topic"]).split(", ")]
        if len(sides) == 2:  # noqa: PLR2004 - left and right
            return ", ".join(sides), WHEELS
    # The topic of a single motor does not accept body commands.
    usual = [topic for topic in vehicle.topics.command if "cmd" in topic and "motor" not in topic]
    return (usual or ["/cmd_vel"])[0], types[-1] if is_steered(vehicle) else types[0]


def _read_types(log: str) -> Mapping[str, str]:
    """Message types by topic of a stored run's log; empty if the log is missing or not accessible."""
    try:
        location = locate_recorded(log)
    except LogError:
        return {}
    return open_log(location).types if location.exists() else {}


def _is_plain(choices: Mapping[str, object], vehicle: Vehicle) -> bool:
    """Whether recorded wheel commands are in rad/s, positive forward."""
    asked = choices.get("command_source")
    source = asked if isinstance(asked, dict) else {}
    unit, sign = source.get("unit"), source.get("sign")
    return not vehicle.units and unit in {None, "rad/s"} and sign in {None, 1} and not source.get("per_turn")
