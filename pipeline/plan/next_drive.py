"""Plan of the next drive after stored runs: it answers open questions of their diagnosis."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pipeline.core import SlipError
from pipeline.datasets import Expected, expect_run
from pipeline.estimation import Recording
from pipeline.logs import LogError, locate_recorded, open_log
from pipeline.models import list_effects
from pipeline.plan.manoeuvres import Area, DrivenRange, Limits, choose_limits, is_steered
from pipeline.plan.plan import Plan, Request, find_largest, make_plan
from pipeline.plan.plan_files import WHEELS, list_types
from pipeline.plan.questions import Question, ask_apart, ask_numbers, ask_presence, ask_undecided, list_names
from pipeline.plan.rehearsal import Knowledge, assume, learn, measure_driven_range
from pipeline.results import RunDiagnosis, find_refusal, read_suggestion
from pipeline.sources import Vehicle
from pipeline.store import Manifest, Store, read_choices


@dataclass(frozen=True)
class Studied:
    """Knowledge of one vehicle from its runs.

    Attributes:
        diagnosis: joint diagnosis of the runs; None without runs.
        knowledge: model and the uncertainty of its parameters.
        expected: what the fleet says of the vehicle on a terrain, which the knowledge includes; None if not
            used.
    """

    diagnosis: RunDiagnosis | None
    knowledge: Knowledge
    expected: Expected | None = None


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
    fleet = expect_run(Store(known), vehicle.id, terrain, without=[run.sha256 for run in here])
    if len(here) < len(runs):
        base = assume(vehicle, fleet.effects, fleet.prior).base
        return Studied(diagnosis, replace(learn(runs, vehicle, named), base=base, fitted=None), fleet)
    rest = [effect for effect in fleet.effects if effect.id not in {one.id for one in named}]
    return Studied(diagnosis, learn(runs, vehicle, [*named, *rest], fleet.prior), fleet)


def expect(vehicle: Vehicle, terrain: str | None, known: Path) -> Studied:
    """Knowledge of a vehicle without a log: the fleet's numbers on a terrain, or the ideal model.

    Raises:
        SlipError: the results contain nothing about the vehicle.
    """
    if terrain is None:
        return Studied(None, assume(vehicle))
    fleet = expect_run(Store(known), vehicle.id, terrain)
    return Studied(None, assume(vehicle, fleet.effects, fleet.prior), fleet)


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
