"""A plan: manoeuvres chosen for questions, and what the whole is expected to tell of each."""

import bisect
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Literal

import msgspec
import numpy as np

from pipeline.core import Complex, Floats, enumerate_texts, finite_or_none, format_digits, pick
from pipeline.estimation.terms import SUGGESTION
from pipeline.models import Effect, Excitation, Largest, list_effects
from pipeline.plan.chooser import Chooser, Shape
from pipeline.plan.manoeuvres import (
    LEAD_S,
    LONGEST_S,
    RATE_HZ,
    TAIL_S,
    Area,
    Commands,
    Limits,
    Manoeuvre,
    PlanError,
    is_steered,
    join,
    list_manoeuvres,
    wait,
)
from pipeline.plan.questions import (
    DECIDED_T,
    Answerable,
    Judge,
    Question,
    Separation,
    list_concerned,
)
from pipeline.plan.rehearsal import Knowledge, Rehearsal, drive, start_state

_MODELS = 12
# Sizes of effects that may act unnoticed, as multiples of the usual one: the largest is not always farthest.
_SIZES = (0.7, 1.0, 1.5, 2.0)
_STEP_S = 1.0
# Factors on the goals of single manoeuvres, raised until the whole plan reaches its goals.
_RESERVES = (1.1, 1.4, 1.8)

SAFETY = (
    "This drives a real robot in open loop: no obstacle and no error stops it.",
    "Play it with the wheels lifted first. Then clear the area, and keep an emergency stop at hand.",
    f"It begins with {LEAD_S:g} s of zero commands and obeys the limits that it states.",
)


@dataclass(frozen=True)
class ExpectedGain:
    """What a drive is expected to tell of one open question.

    Attributes:
        question: as text.
        effects: ids of the effects concerned.
        kind: `separation` by a block t, `presence` by one in favour of an effect that acts, or `interval` by
            the half-width of a 95 % interval.
        goal: the t, or the half-width, that answers the question.
        now: t, or half-width in the parameter's unit, before the drive.
        expected: t, or half-width, of the logs and the drive.
        decided_after_s: time in the drive from which the question is answered; infinite if it is not.
        drives: how many times the drive answers it together; 0 if that takes more than an hour of driving.
        unit: of an interval.
        value: of the parameter of an interval.
        needs: what would answer it where this drive does not.
    """

    question: str
    effects: tuple[str, ...]
    kind: Literal["separation", "presence", "interval"]
    goal: float
    now: float
    expected: float
    decided_after_s: float
    drives: int
    unit: str = "1"
    value: float = math.nan
    needs: str = ""

    @property
    def informs(self) -> bool:
        """Whether the drive tells something: repeated it answers the question, or it narrows the interval."""
        narrows = self.kind == "interval" and format_digits(self.expected) != format_digits(self.now)
        return self.drives > 0 or (narrows and self.expected < self.now)


@dataclass(frozen=True)
class Plan:
    """Commands and their expected gain.

    Attributes:
        vehicle: id of the vehicle.
        runs: names of the logs that the plan is based on.
        manoeuvres: names and start times [s].
        commands: all of them, zero commands first.
        limits, area: limits that it satisfies.
        gains: what is expected by question; what is answered first stands first.
        topic, type_name: topic on which the commands are played, and its type.
        steered: whether a turn is a steering angle.
        home_m: largest distance of any model's end from the start.
        wheels: commanded speeds of the left and the right wheels [rad/s], shape (n,) each; None if the drive
            has other inputs.
        ways: paths of the models, base first, positions x + iy [m] at 20 Hz, shape (models, n).
        as_driven: limits that are what the runs reached, in words.
    """

    vehicle: str
    runs: tuple[str, ...]
    manoeuvres: tuple[tuple[str, float], ...]
    commands: Commands = field(repr=False)
    limits: Limits
    area: Area
    gains: tuple[ExpectedGain, ...]
    topic: str
    type_name: str
    steered: bool
    home_m: float
    wheels: tuple[Floats, Floats] | None = field(repr=False)
    ways: Complex = field(repr=False)
    as_driven: tuple[str, ...] = ()

    @property
    def informative(self) -> tuple[ExpectedGain, ...]:
        """Questions of which the drive tells something."""
        return tuple(one for one in self.gains if one.informs)

    @property
    def unanswered(self) -> tuple[ExpectedGain, ...]:
        """Questions of which it tells nothing."""
        return tuple(one for one in self.gains if not one.informs)

    def format_limits(self) -> str:
        """All limits, and which of them are what the runs reached."""
        text = self.limits.format(steered=self.steered)
        return f"{text} ({enumerate_texts(self.as_driven)} as the runs reached)" if self.as_driven else text

    def to_json(self) -> dict[str, object]:
        """The documented keys of `slip plan --json`, and others."""
        return {
            "duration_s": self.commands.duration_s if self.manoeuvres else 0.0,
            "vehicle": self.vehicle,
            "runs": list(self.runs),
            "home_m": self.home_m,
            "limits": asdict(self.limits) | {"yaw_rate_radps": finite_or_none(self.limits.yaw_rate_radps)},
            "limits_as_driven": list(self.as_driven),
            "area": asdict(self.area),
            "safety": list(SAFETY),
            "topic": self.topic,
            "type": self.type_name,
            "manoeuvres": [{"name": name, "start_s": start} for name, start in self.manoeuvres],
            "promises": [
                {
                    **pick(one, "question", "kind", "goal", "drives", "unit"),
                    "effects": list(one.effects),
                    "decided_after_s": finite_or_none(one.decided_after_s),
                    "now": finite_or_none(one.now),
                    ("interval_after_s" if one.kind == "interval" else "expected_t"): one.expected,
                }
                for one in self.informative
            ],
            "impossible": [
                {"question": one.question, "effects": list(one.effects), "because": one.needs}
                for one in self.unanswered
            ],
        }


@dataclass(frozen=True)
class Request:
    """Request for a plan.

    Attributes:
        limits, area: to obey.
        time_s: longest duration, including the zero commands at the start.
        runs: names of the logs that the knowledge is based on.
        topic, type_name: topic on which the commands will be played, and its type.
        as_driven: limits that are what the runs reached, in words.
    """

    limits: Limits
    area: Area
    time_s: float
    runs: tuple[str, ...] = ()
    topic: str = "/cmd_vel"
    type_name: str = "geometry_msgs/msg/Twist"
    as_driven: tuple[str, ...] = ()


def make_plan(
    knowledge: Knowledge,
    questions: Sequence[Question],
    request: Request,
    notify: Callable[[str], object] = str,
) -> Plan:
    """Choose the manoeuvres that tell most of the questions, and compute what the whole tells of each.

    Args:
        knowledge: what is known before the drive.
        questions: to answer.
        request: time, area and limits.
        notify: called with what is being done.

    Raises:
        PlanError: ``no_room``, no manoeuvre fits into the area and the time.
    """
    largest = find_largest(knowledge, request.limits, request.time_s)
    models = _list_models(knowledge, questions, largest)
    library = list_manoeuvres(knowledge.vehicle, request.limits)
    best = _rehearse(knowledge, questions, request.area, [], models)
    if questions:
        plural = "s" * (len(questions) != 1)
        notify(f"rehearsing {len(library)} manoeuvres for {len(questions)} open question{plural}")
        chooser = _make_chooser(knowledge, questions, request, models)
        undriven = tuple(_expect_gain(one, np.zeros(len(library))) for one in chooser.questions)
        best = replace(best, gains=undriven)
        for attempt, reserve in enumerate(_RESERVES, start=1):
            notify(f"choosing manoeuvres, attempt {attempt} of at most {len(_RESERVES)}")
            chosen = [library[number] for number in chooser.choose(reserve)]
            trial = _rehearse(knowledge, questions, request.area, chosen, models)
            # What tells nothing is not driven.
            if trial.answered <= best.answered or not any(one.informs for one in trial.gains):
                break
            best = trial
            if all(math.isfinite(one.decided_after_s) for one in best.gains if one.informs):
                break
        notify("what other drives would add")
        best = replace(best, gains=_advise(best, chooser, knowledge, questions, request.limits))
    commands, ways = best.commands, best.ways
    return Plan(
        as_driven=request.as_driven,
        vehicle=knowledge.vehicle.id,
        runs=request.runs,
        manoeuvres=tuple((one.name, at) for one, at in zip(best.manoeuvres, best.starts, strict=True)),
        commands=commands,
        limits=request.limits,
        area=request.area,
        gains=best.gains,
        topic=request.topic,
        type_name=request.type_name,
        steered=is_steered(knowledge.vehicle),
        home_m=float(np.abs(ways[:, -1]).max()),
        wheels=_turn_wheels(commands, knowledge),
        ways=ways,
    )


@dataclass(frozen=True)
class _Trial:
    """Manoeuvres rehearsed as a whole; see `Plan`."""

    manoeuvres: tuple[Manoeuvre, ...]
    starts: tuple[float, ...]
    commands: Commands
    ways: Complex
    gains: tuple[ExpectedGain, ...]
    answered: float


def _advise(
    best: _Trial, chooser: Chooser, knowledge: Knowledge, questions: Sequence[Question], limits: Limits
) -> tuple[ExpectedGain, ...]:
    """What is expected, with what would tell the questions of which the drive tells nothing.

    An hour of all manoeuvres that fit into the area, of all manoeuvres, and of all at higher limits.
    """
    unanswered = {one.question for one in best.gains if not one.informs}
    room = np.array([chooser.fits([number]) for number in range(chooser.durations.size)], dtype=np.float64)
    needs = dict[str, str]()
    for one in chooser.questions:
        question = one.question
        if question.text not in unanswered:
            continue
        if any(Excitation.SLOPE in effect.needs for effect in list_concerned(question)):
            needs[question.text] = "drive by hand on a slope, in several directions"
        elif _answers(one, room):
            is_alone = len(best.gains) == 1 or SUGGESTION in question.effects
            alone = f"needs a drive of its own: slip plan --for {question.effects[0]}"
            needs[question.text] = "give more --time" if is_alone else alone
        elif _answers(one, np.ones(room.size)):
            needs[question.text] = "give a larger --area"
    rest = [one for one in questions if one.text in unanswered - needs.keys()]
    harder, options = limits.raise_within(knowledge.vehicle)
    for one in _judge_library(knowledge, rest, harder)[1] if rest else ():
        needs[one.question.text] = (
            f"give {options}, where the robot and the ground allow it"
            if _answers(one, np.ones(one.groups.seconds.size))
            else "no drive that was tried answers it: an hour, anywhere, at the highest limits"
        )
    return tuple(replace(one, needs=needs.get(one.question, "")) for one in best.gains)


def _answers(one: Answerable, weight: Floats) -> bool:
    """Whether an hour of these manoeuvres answers a question."""
    seconds = float(weight @ one.groups.seconds)
    return seconds > 0.0 and float(one.answer(weight * (LONGEST_S / seconds))) >= 1.0


def _turn_wheels(commands: Commands, knowledge: Knowledge) -> tuple[Floats, Floats] | None:
    """Wheel commands in the scale of a recorded log."""
    kinematics = knowledge.vehicle.kinematics
    if is_steered(knowledge.vehicle) or kinematics.has_inputs("sideways"):
        return None
    vehicle = msgspec.structs.replace(knowledge.vehicle, controller_track_multiplier=1.0)
    driven, senses = drive(commands, vehicle), knowledge.senses
    ahead = 0.5 * (driven.left + driven.right) / senses.command_scale
    apart = 0.5 * (driven.right - driven.left) / senses.command_turn_scale
    return ahead - apart, ahead + apart


def _rehearse(
    knowledge: Knowledge,
    questions: Sequence[Question],
    area: Area,
    chosen: Sequence[Manoeuvre],
    models: Sequence[tuple[Effect, ...]],
) -> _Trial:
    """Longest beginning of a sequence that stays inside the area, and its expected gain."""
    chosen = list(chosen)
    while True:
        commands = join([wait(LEAD_S), *(one.commands for one in chosen), wait(TAIL_S)])
        ends = LEAD_S + np.cumsum([0.0, *(one.commands.duration_s for one in chosen)])
        rehearsal = Rehearsal(commands, knowledge.vehicle, knowledge.senses, ends)
        ways = np.array([rehearsal.trace(effects)[0] for effects in models])
        # Motion that outlasts the rest between two manoeuvres shows only in the whole sequence.
        if not chosen or area.holds(ways):
            break
        chosen.pop()
    starts = tuple(np.round(ends[:-1], 3).tolist())
    if not chosen:
        return _Trial((), (), commands, ways, (), 0.0)
    gains, answered = _expect_gains(knowledge, questions, rehearsal, commands.duration_s)
    return _Trial(tuple(chosen), starts, commands, ways, gains, answered)


def find_largest(knowledge: Knowledge, limits: Limits, time_s: float) -> Largest:
    """Largest commands of plans within these limits; usual sizes of effects are fractions of them."""
    library = join([one.commands for one in list_manoeuvres(knowledge.vehicle, limits)])
    largest = Rehearsal(library, knowledge.vehicle, knowledge.senses, np.zeros(1)).largest
    return replace(largest, moments=np.linspace(0.0, time_s, largest.moments.size), turns=None)


def _list_models(
    knowledge: Knowledge, questions: Sequence[Question], largest: Largest
) -> list[tuple[Effect, ...]]:
    """Candidate models: the base, those of the questions, draws, and the base with one more effect.

    A slow or short log may hide any effect: each one of the catalogue is assumed to act at usual sizes.
    """
    asked = dict.fromkeys(
        model
        for question in questions
        for model in (question.models if isinstance(question, Separation) else (question.model,))
    )
    supposed = list(dict.fromkeys([knowledge.base, *asked]))
    generator = np.random.default_rng(0)
    drawn = [supposed[turn % len(supposed)].draw(generator) for turn in range(_MODELS)]
    unnoticed = dict.fromkeys(
        _enlarge(one, times)
        for effect in list_effects()
        if knowledge.vehicle.kind in effect.kinds and effect.id not in knowledge.base.names
        for one in (effect().make_usual(largest), _make_typical(effect()))
        for times in _SIZES
    )
    base = start_state(knowledge.base.effects)
    return [*(model.effects for model in supposed), *drawn, *(base.add(one).effects for one in unnoticed)]


def _make_typical(effect: Effect) -> Effect:
    """An effect of typical size, independent of the plan's commands."""
    return effect.change(
        **{p.name: p.typical for p in effect.parameters if not p.instead_of and not p.relative_to}
    )


def _enlarge(effect: Effect, times: float) -> Effect:
    """Scale an effect's distance from neutral; a limit that is neutral at infinity is divided instead."""
    values = {}
    for parameter in effect.parameters:
        value, neutral = effect.values[parameter.name], parameter.neutral
        if math.isfinite(value) and not math.isnan(neutral):
            far = neutral + times * (value - neutral) if math.isfinite(neutral) else value / times
            values[parameter.name] = min(max(far, parameter.bounds[0]), parameter.bounds[1])
    return effect.change(**values)


def _make_chooser(
    knowledge: Knowledge,
    questions: Sequence[Question],
    request: Request,
    models: Sequence[tuple[Effect, ...]],
) -> Chooser:
    """Chooser for the library, with the information of each manoeuvre on each question, and its paths."""
    rehearsal, answerable = _judge_library(knowledge, questions, request.limits)
    durations = answerable[0].groups.seconds
    edges = np.concatenate(([0.0], np.cumsum(durations)))
    ways = [rehearsal.trace(effects) for effects in models]
    shapes = []
    for begin, end in zip((edges[:-1] * RATE_HZ).round(), (edges[1:] * RATE_HZ).round(), strict=True):
        rows = slice(int(begin), int(end) + 1)
        paths = np.array([path[rows] for path, _ in ways])
        turned = np.array([heading[rows] for _, heading in ways])
        own = np.exp(-1j * turned[:, :1]) * (paths - paths[:, :1])
        shapes.append(Shape(own, turned[:, -1] - turned[:, 0]))
    time_s = request.time_s - LEAD_S - TAIL_S
    chooser = Chooser(answerable, durations, shapes, request.area, time_s)
    if not any(chooser.fits([one]) for one in np.flatnonzero(durations <= time_s).tolist()):
        raise PlanError(
            "no_room",
            "no manoeuvre fits into the area and the time",
            where=f"{request.area.length_m:g} x {request.area.width_m:g} m, {request.time_s:g} s",
            hint="Give a larger --area or --time, or a lower --max-speed.",
        )
    return chooser


def _judge_library(
    knowledge: Knowledge, questions: Sequence[Question], limits: Limits
) -> tuple[Rehearsal, list[Answerable]]:
    """All manoeuvres within limits one after the other, and what each tells of every question."""
    pieces = [one.commands for one in list_manoeuvres(knowledge.vehicle, limits)]
    edges = np.concatenate(([0.0], np.cumsum([one.duration_s for one in pieces])))
    rehearsal = Rehearsal(join(pieces), knowledge.vehicle, knowledge.senses, edges[:-1])
    return rehearsal, Judge(rehearsal, knowledge, edges).judge(questions)


def _expect_gains(
    knowledge: Knowledge, questions: Sequence[Question], rehearsal: Rehearsal, duration_s: float
) -> tuple[tuple[ExpectedGain, ...], float]:
    """What the whole plan tells by question, and the sum of the fractions of the goals that it reaches."""
    edges = np.arange(0.0, duration_s + _STEP_S, _STEP_S)
    judged = Judge(rehearsal, knowledge, edges, stretches=True).judge(questions)
    whole = np.ones(edges.size - 1)
    answered = sum(float(one.answer(whole)) for one in judged)
    gains = []
    for one in judged:
        within = _find_first(one, [whole * (edges[1:] <= end) for end in edges])
        drives = _find_first(one, [whole * count for count in range(int(LONGEST_S / edges[-1]) + 1)])
        after = math.inf if within is None else float(edges[within])
        gains.append(replace(_expect_gain(one, whole), decided_after_s=after, drives=drives or 0))
    return tuple(sorted(gains, key=lambda one: (one.decided_after_s, one.drives))), answered


def _expect_gain(one: Answerable, weight: Floats) -> ExpectedGain:
    """What a drive tells of a question, without when; weights of its groups as of `Answerable.answer`."""
    question = one.question
    gain = ExpectedGain(
        question=question.text,
        effects=question.effects,
        kind="separation",
        goal=DECIDED_T,
        now=question.now,
        expected=float(one.measure(weight)),
        decided_after_s=math.inf,
        drives=0,
    )
    if isinstance(question, Separation):
        return replace(gain, kind="presence" if question.is_presence else "separation")
    return replace(
        gain,
        kind="interval",
        goal=question.goal,
        unit=question.model.free[question.number].unit,
        value=float(question.model.values[question.number]),
    )


def _find_first(one: Answerable, weights: Sequence[Floats]) -> int | None:
    """Number of the first of weights that rise which answers a question; None if none does."""
    number = bisect.bisect_left(weights, 1.0, key=lambda weight: float(one.answer(weight)))
    return number if number < len(weights) else None
