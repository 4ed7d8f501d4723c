"""Plan of the next drive after stored runs: their diagnosis, its open questions, and the command topic."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pipeline.core.program import SlipError
from pipeline.estimation import Recording, RunDiagnosis
from pipeline.fleet.forecast import Forecast
from pipeline.plan.manoeuvres import Area, Limits, is_steered
from pipeline.plan.plan import Plan
from pipeline.plan.plan_files import WHEELS, list_types
from pipeline.plan.questions import Question
from pipeline.plan.rehearsal import Knowledge
from pipeline.sources import Vehicle
from pipeline.store import Manifest

UNDECIDED = "undecided"
ALL = "all"


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
        wanted: `UNDECIDED`, `ALL`, or ids of effects; empty for undecided effects first and, in the remaining
            time, all open questions.
        speed_mps, yaw_rate_radps, acceleration_mps2: limits; None for those of the vehicle.
        topic, type_name: topic and type of the played commands; None for those of the recorded command.
        seed: seed of the draws from the known distribution.
    """

    area: Area
    time_s: float
    wanted: tuple[str, ...] = ()
    speed_mps: float | None = None
    yaw_rate_radps: float | None = None
    acceleration_mps2: float | None = None
    topic: str | None = None
    type_name: str | None = None
    seed: int = 0


@dataclass(frozen=True)
class Planned:
    """A plan with its questions and limits."""

    plan: Plan
    questions: tuple[Question, ...]
    limits: Limits


def plan_drive(
    vehicle: Vehicle,
    studied: Studied,
    wish: Wish,
    recordings: Sequence[Recording] = (),
    command: Mapping[str, object] | None = None,
) -> Planned:
    """Plan the drive that best answers the open questions.

    Args:
        vehicle: vehicle to drive.
        studied: knowledge of the vehicle.
        wish: request of the user.
        recordings: the runs that the knowledge comes from.
        command: choice of the first run's command, from `read_command`.

    Raises:
        SlipError: an effect is unknown, the vehicle's largest speed is unknown, or no drive fits.
    """
    from pipeline.plan.manoeuvres import choose_limits  # noqa: PLC0415 - heavy
    from pipeline.plan.plan import Request, make_plan  # noqa: PLC0415 - heavy

    knowledge, diagnosis = studied.knowledge, studied.diagnosis
    limits = choose_limits(
        vehicle,
        None if knowledge.problem is None else knowledge.problem.largest,
        speed_mps=wish.speed_mps,
        yaw_rate_radps=wish.yaw_rate_radps,
        acceleration_mps2=wish.acceleration_mps2,
    )
    is_ambiguous = diagnosis is not None and bool(diagnosis.undecided)
    wanted = wish.wanted or (UNDECIDED if is_ambiguous else ALL,)
    questions = tuple(ask(knowledge, wanted, limits, wish.time_s, diagnosis))
    later: list[Question] = []
    if is_ambiguous and not wish.wanted:
        texts = {question.text for question in questions}
        everything = ask(knowledge, [ALL], limits, wish.time_s, diagnosis)
        later = [question for question in everything if question.text not in texts]
    topic, type_name = choose_topic(vehicle, command or {}, recordings[0].path if recordings else "")
    request = Request(
        limits,
        wish.area,
        wish.time_s,
        tuple(recording.name for recording in recordings),
        wish.topic or topic,
        wish.type_name or type_name,
        wish.seed,
    )
    return Planned(make_plan(knowledge, questions, request, later), questions, limits)


def study(
    recordings: Sequence[Recording], vehicle: Vehicle, terrain: str | None = None, known: Path | None = None
) -> Studied:
    """Diagnose runs jointly, and fit the identified and the undecided effects.

    Args:
        recordings: runs of one vehicle.
        vehicle: the vehicle.
        terrain: terrain to drive on; the fleet's prior for it is combined with runs on this terrain, and
            replaces the estimates of runs on other terrains.
        known: results folder of the fleet; needed with a terrain.

    Raises:
        SlipError: nothing can be estimated, or a run has no commands.
    """
    from pipeline.estimation import diagnose_runs  # noqa: PLC0415 - heavy
    from pipeline.estimation.diagnose import load_recording  # noqa: PLC0415 - heavy
    from pipeline.estimation.verdict import find_refusal  # noqa: PLC0415 - heavy
    from pipeline.models import list_effects  # noqa: PLC0415 - heavy
    from pipeline.plan.rehearsal import assume, learn  # noqa: PLC0415 - heavy

    diagnosis = diagnose_runs(recordings, vehicle).runs[0]
    if diagnosis.proposal is None:
        why = find_refusal(diagnosis.to_json()) or "the log cannot be judged"
        what = f"{why}, so that nothing can be planned from it"
        hint = "See the findings of `slip diagnose`, or plan for the vehicle alone with --vehicle."
        raise SlipError("nothing_judged", what, where=recordings[0].name, hint=hint)
    # Terms outside the catalogue are specific to this run's terrain.
    catalogue = {effect.id for effect in list_effects()}
    named = [effect for effect in diagnosis.proposal.model.effects if effect.id in catalogue]
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
    from pipeline.plan.rehearsal import assume  # noqa: PLC0415 - heavy

    if terrain is None:
        return Studied(None, assume(vehicle))
    forecast = _forecast(known, vehicle, terrain)
    return Studied(None, assume(vehicle, forecast.effects, forecast.prior), forecast)


def _forecast(known: Path, vehicle: Vehicle, terrain: str, without: Sequence[str] = ()) -> Forecast:
    from pipeline.job.fleet_evidence import forecast_deployment  # noqa: PLC0415 - heavy
    from pipeline.store import Store  # noqa: PLC0415 - heavy

    return forecast_deployment(Store(known), vehicle.id, terrain, without=without)


def ask(
    knowledge: Knowledge, wanted: Sequence[str], limits: Limits, time_s: float, diagnosis: RunDiagnosis | None
) -> list[Question]:
    """List the questions of a plan.

    Args:
        knowledge: knowledge before the drive.
        wanted: ``undecided``, ``all``, or ids of effects.
        limits: limits of the commands, to which the usual sizes of effects are relative.
        time_s: length of the plan [s].
        diagnosis: diagnosis of the existing logs; None without logs.

    Raises:
        SlipError: an effect is unknown or does not exist on the vehicle.
    """
    from pipeline.plan.plan import find_largest  # noqa: PLC0415
    from pipeline.plan.questions import ask_apart, ask_numbers, ask_presence, ask_undecided, list_names  # noqa: PLC0415

    questions: list[Question] = []
    names = [name for name in wanted if name not in {UNDECIDED, ALL}]
    numbers = knowledge.base.names & set(names)
    if len(names) < len(wanted):
        groups = [] if diagnosis is None else [group.candidates for group in diagnosis.undecided]
        questions += ask_undecided(knowledge, groups)
        questions += ask_apart(knowledge, {name for group in groups for name in group})
        numbers |= knowledge.base.names.difference(*groups)
        effects = () if diagnosis is None else diagnosis.effects
        names += [one.id for effect in effects for one in effect.unless]
    questions += [one for one in ask_numbers(knowledge.base) if numbers & set(one.effects)]
    if ALL in wanted:
        names += [u.id for u in diagnosis.unobservable] if diagnosis is not None else list_names(knowledge)
    elif diagnosis is None and not names:
        names = list(list_names(knowledge))
    if names:
        questions += ask_presence(knowledge, dict.fromkeys(names), find_largest(knowledge, limits, time_s))
    return questions


def read_command(manifest: Manifest) -> dict[str, object]:
    """Choice of a stored run's command: ``choices``, and the configuration as ``command_source``."""
    from pipeline.job.run_results import read_choices  # noqa: PLC0415 - heavy

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
    from pipeline.logs import LogError, locate_recorded, open_log  # noqa: PLC0415 - heavy

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
