"""Other ways to drive, as commands within the same limits: what each would need for the same questions."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.plan.errors import PlanError
from pipeline.plan.knowledge import Knowledge
from pipeline.plan.limits import Limits, is_steered
from pipeline.plan.manoeuvres import LEAD_S, RATE_HZ, Commands, hold_within, join, wait
from pipeline.plan.plan import since_when
from pipeline.plan.questions import Judge, Question
from pipeline.plan.rehearsal import Rehearsal
from pipeline.vehicles import Vehicle

Stages = list[tuple[float, float, float]]

LONGEST_S = 300.0
"""A question that a protocol has not answered by then it does not answer."""
_STEP_S = 6.0
_HALF = 0.5


@dataclass(frozen=True)
class Needed:
    """Seconds of a protocol until each question is answered; infinite where it is not, shape of questions."""

    protocol: str
    seconds: tuple[float, ...]


def parse_protocols(text: str) -> tuple[str, ...]:
    """Names of `PROTOCOLS` between commas.

    Raises:
        PlanError: ``unknown_protocol``.
    """
    names = tuple(text.split(","))
    for name in names:
        if name not in PROTOCOLS:
            what = f"no protocol is called {name!r}"
            hint = f"Give some of {', '.join(PROTOCOLS)}."
            raise PlanError("unknown_protocol", what, where="--compare", hint=hint)
    return names


def compare_protocols(
    knowledge: Knowledge, questions: Sequence[Question], limits: Limits, names: Sequence[str], seed: int = 0
) -> list[Needed]:
    """How long each protocol would have to be driven; none is held to an area.

    Args:
        knowledge: where they start from.
        questions: to answer.
        limits: of the vehicle, the same for all.
        names: as of `parse_protocols`.
        seed: of those that are drawn.
    """
    found = []
    for name in names:
        commands, begins = drive_protocol(name, knowledge.vehicle, limits, seed)
        rehearsal = Rehearsal(commands, knowledge.vehicle, knowledge.senses, begins)
        edges = np.arange(0.0, commands.duration_s + 1.0)
        judged = Judge(rehearsal, knowledge, edges, stretches=True).judge(questions)
        found.append(Needed(name, tuple(since_when(one, edges) for one in judged)))
    return found


def drive_protocol(name: str, vehicle: Vehicle, limits: Limits, seed: int) -> tuple[Commands, Floats]:
    """The commands of a protocol up to `LONGEST_S`, and the times [s] at which its stages begin."""
    stages = PROTOCOLS[name](limits, vehicle, np.random.default_rng(seed))
    whole = join([wait(LEAD_S), hold_within(stages, vehicle, limits)])
    count = round(LONGEST_S * RATE_HZ)
    commands = Commands(whole.speed[:count], whole.turn[:count])
    begins = LEAD_S + np.cumsum([0.0, *(seconds for _, _, seconds in stages[:-1])])
    return commands, begins[begins < commands.duration_s]


def _drive(limits: Limits, _: Vehicle, generator: np.random.Generator) -> Stages:
    """Random steps of six seconds out of the whole command space (DRIVE; Baril et al., 2024)."""
    count = round(LONGEST_S / _STEP_S)
    speeds = generator.uniform(-limits.speed_mps, limits.speed_mps, count).tolist()
    turns = generator.uniform(-limits.turn, limits.turn, count).tolist()
    return [(speed, turn, _STEP_S) for speed, turn in zip(speeds, turns, strict=True)]


def _human(limits: Limits, _: Vehicle, generator: np.random.Generator) -> Stages:
    """A person who drives about: mostly ahead at half speed, turning a little, every two to six seconds."""
    stages: Stages = []
    while sum(stage[2] for stage in stages) < LONGEST_S:
        speed = float(np.clip(generator.normal(0.4, 0.3), -1.0, 1.0)) * limits.speed_mps
        turn = float(np.clip(generator.normal(0.0, 0.4), -1.0, 1.0)) * limits.turn
        stages.append((speed, turn, float(generator.uniform(2.0, 6.0))))
    return stages


def _straight_and_circle(limits: Limits, vehicle: Vehicle, _: np.random.Generator) -> Stages:
    """Ahead, back, once round to the left and once to the right, at half speed, again and again."""
    speed, around = _HALF * limits.speed_mps, _round_s(limits, vehicle)
    lap = [
        (speed, 0.0, 10.0),
        (-speed, 0.0, 10.0),
        (speed, _HALF * limits.turn, around),
        (speed, -_HALF * limits.turn, around),
    ]
    return lap * math.ceil(LONGEST_S / (20.0 + 2.0 * around))


def _eights(limits: Limits, vehicle: Vehicle, _: np.random.Generator) -> Stages:
    """Once round to the left and once to the right at half speed."""
    speed, around = _HALF * limits.speed_mps, _round_s(limits, vehicle)
    lap = [(speed, _HALF * limits.turn, around), (speed, -_HALF * limits.turn, around)]
    return lap * math.ceil(LONGEST_S / (2.0 * around))


def _round_s(limits: Limits, vehicle: Vehicle) -> float:
    """Seconds of once round at half of the largest turn; of a steering angle, which says none, twenty."""
    return 20.0 if is_steered(vehicle) else 2.0 * math.pi / (_HALF * limits.turn)


PROTOCOLS: Mapping[str, Callable[[Limits, Vehicle, np.random.Generator], Stages]] = {
    "drive": _drive,
    "human": _human,
    "straight_and_circle": _straight_and_circle,
    "eights": _eights,
}
