"""What to drive next after stored runs: their diagnosis, its questions, and the topic that the run used."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.core.errors import SlipError
from pipeline.plan.files import WHEELS, list_types
from pipeline.plan.limits import is_steered

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.diagnosis import Recording, RunDiagnosis
    from pipeline.plan import Knowledge, Limits
    from pipeline.plan.questions import Question
    from pipeline.store import Manifest
    from pipeline.vehicles import Vehicle

UNDECIDED = "undecided"
ALL = "all"


@dataclass(frozen=True)
class Studied:
    """Runs of one vehicle with what is known of them.

    Attributes:
        diagnosis: of all of them together.
        knowledge: of the same model.
    """

    diagnosis: RunDiagnosis
    knowledge: Knowledge


def study(recordings: Sequence[Recording], vehicle: Vehicle) -> Studied:
    """Diagnose runs together, and fit what was named and what is undecided.

    Raises:
        SlipError: nothing can be judged, or a run has no commands.
    """
    from pipeline.diagnosis import diagnose_runs  # noqa: PLC0415 - heavy
    from pipeline.diagnosis.subject import load_recording  # noqa: PLC0415 - heavy
    from pipeline.models import list_effects  # noqa: PLC0415 - heavy
    from pipeline.plan import learn  # noqa: PLC0415 - heavy

    diagnosis = diagnose_runs(recordings, vehicle).runs[0]
    if diagnosis.proposal is None:
        raise SlipError(
            "nothing_judged",
            "the log cannot be judged, so that nothing can be planned from it",
            where=recordings[0].name,
            hint="See the findings of `slip diagnose`, or plan for the vehicle alone with --vehicle.",
        )
    # Terms without a name stand for this run's ground: nothing is known of them elsewhere.
    catalogue = {effect.id for effect in list_effects()}
    named = [effect for effect in diagnosis.proposal.model.effects if effect.id in catalogue]
    runs = [load_recording(recording, vehicle) for recording in recordings]
    return Studied(diagnosis, learn(runs, vehicle, named))


def ask(
    knowledge: Knowledge, wanted: Sequence[str], limits: Limits, time_s: float, diagnosis: RunDiagnosis | None
) -> list[Question]:
    """The questions of a plan.

    Args:
        knowledge: where it starts from.
        wanted: ``undecided``, ``all``, or ids of effects.
        limits: usual sizes of effects are shares of what may be asked for.
        time_s: length of the plan.
        diagnosis: of the logs so far; None without.

    Raises:
        SlipError: an effect is unknown or does not exist on the vehicle.
    """
    from pipeline.plan import ask_numbers, ask_presence, ask_undecided, find_largest, list_names  # noqa: PLC0415

    questions: list[Question] = []
    names = [name for name in wanted if name not in {UNDECIDED, ALL}]
    if diagnosis is not None and len(names) < len(wanted):
        questions += ask_undecided(knowledge, [group.candidates for group in diagnosis.undecided])
        open_ids = {name for group in diagnosis.undecided for name in group.candidates}
        questions += [one for one in ask_numbers(knowledge.base) if not open_ids & set(one.effects)]
    if ALL in wanted:
        names += [u.id for u in diagnosis.unobservable] if diagnosis is not None else list_names(knowledge)
    elif diagnosis is None and not names:
        names = list(list_names(knowledge))
    if names:
        questions += ask_presence(knowledge, dict.fromkeys(names), find_largest(knowledge, limits, time_s))
    return questions


def read_command(manifest: Manifest) -> dict[str, object]:
    """How a stored run's command was chosen: its ``choices``, and ``command_source`` as it was configured."""
    from pipeline.analysis.diagnosis import read_choices  # noqa: PLC0415 - heavy

    configuration = manifest.details.get("configuration")
    source = configuration.get("command") if isinstance(configuration, dict) else None
    return {**read_choices(manifest), "command_source": source}


def choose_topic(vehicle: Vehicle, choices: Mapping[str, object], log: str) -> tuple[str, str]:
    """Topics and type of the command that a log recorded; the vehicle's usual one where it has none.

    A body command where there is one, else a pair of wheel speeds [rad/s], else what is usual.
    """
    from pipeline.logs import open_log  # noqa: PLC0415 - heavy

    types = list_types(steered=is_steered(vehicle))
    chosen = choices.get("choices")
    command = chosen.get("command") if isinstance(chosen, dict) else None
    asked: list[str] = []
    if isinstance(command, dict):
        asked = [str(command.get("topic")), *(str(other["topic"]) for other in command.get("others", []))]
    found: dict[str, str] = {}
    if asked and Path(log).exists():
        found = {channel.topic: channel.type_name for channel in open_log(log).channels}
    for topic in asked:
        if found.get(topic) in types:
            return topic, found[topic]
    if isinstance(command, dict) and command.get("type") == WHEELS and _is_plain(choices, vehicle):
        sides = [str(one).removesuffix(".data") for one in str(command["topic"]).split(", ")]
        if len(sides) == 2:  # noqa: PLR2004 - left and right
            return ", ".join(sides), WHEELS
    # A topic of one motor takes no body command.
    usual = [topic for topic in vehicle.topics.command if "cmd" in topic and "motor" not in topic]
    return (usual or ["/cmd_vel"])[0], types[-1] if is_steered(vehicle) else types[0]


def _is_plain(choices: Mapping[str, object], vehicle: Vehicle) -> bool:
    """Whether recorded wheel commands are rad/s, forward above zero."""
    asked = choices.get("command_source")
    source = asked if isinstance(asked, dict) else {}
    unit, sign = source.get("unit"), source.get("sign")
    return not vehicle.units and unit in {None, "rad/s"} and sign in {None, 1} and not source.get("per_turn")
