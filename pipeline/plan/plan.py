"""A plan: manoeuvres chosen for questions, and the expected gain of the whole."""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Literal

import msgspec
import numpy as np

from pipeline.core import Complex, Floats, enumerate_texts, finite_or_none, format_share, pick
from pipeline.models import Effect, Largest, list_effects
from pipeline.plan.chooser import Chooser, Shape, explain_open
from pipeline.plan.manoeuvres import (
    LEAD_S,
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
    list_raised,
    wait,
)
from pipeline.plan.questions import (
    DECIDED_T,
    Answerable,
    Impossible,
    Judge,
    Question,
    Separation,
    leave_open,
    list_reasons,
)
from pipeline.plan.rehearsal import Knowledge, Rehearsal, drive, start_state

_MODELS = 12
# Sizes of effects that may act unnoticed, as multiples of the usual one: the largest is not always farthest.
_SIZES = (0.7, 1.0, 1.5, 2.0)
_STEP_S = 1.0
# Factors on the goals of single manoeuvres, raised until the whole plan reaches its goals.
_RESERVES = (1.1, 1.4, 1.8)
# Multiple of the goals; more driving adds nothing. Spare time is driven if it narrows an interval by a tenth.
_AMPLE = 2.0
_LEAST_GAIN = 0.1
# Factor on what is reached from which a raised limit is named: less is not worth a harder drive.
_HELPS = 1.25
# A shorter rest is not reported.
_LEAST_REST_S = 5.0

SAFETY = (
    "This drives a real robot in open loop: no obstacle and no error stops it.",
    "Play it with the wheels lifted first. Then clear the area, and keep an emergency stop at hand.",
    f"It begins with {LEAD_S:g} s of zero commands and obeys the limits that it states.",
)


@dataclass(frozen=True)
class ExpectedGain:
    """Expected gain of a plan for one question.

    Attributes:
        question: as text.
        effects: ids of the effects concerned.
        kind: `separation` by a block t, or `interval` by the half-width of a 95 % interval.
        decided_after_s: time since the start of the plan.
        expected: block t, or half-width in the parameter's unit, at the end of the plan.
        goal: promised value: at least this t, at most this half-width.
        unit: of `expected`.
    """

    question: str
    effects: tuple[str, ...]
    kind: Literal["separation", "interval"]
    decided_after_s: float
    expected: float
    goal: float
    unit: str = "1"


@dataclass(frozen=True)
class Plan:
    """Commands and their expected gain.

    Attributes:
        vehicle: id of the vehicle.
        runs: names of the logs that the plan is based on.
        manoeuvres: names and start times [s].
        commands: all of them, zero commands first.
        limits, area: limits that it satisfies.
        promises, impossible: by question.
        topic, type_name: topic on which the commands are played, and its type.
        steered: whether a turn is a steering angle.
        home_m: largest distance of any model's end from the start.
        spare_s: available time that is not driven [s].
        spare_gain: fraction by which driving it would narrow the interval that gains most.
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
    promises: tuple[ExpectedGain, ...]
    impossible: tuple[Impossible, ...]
    topic: str
    type_name: str
    steered: bool
    home_m: float
    spare_s: float
    spare_gain: float
    wheels: tuple[Floats, Floats] | None = field(repr=False)
    ways: Complex = field(repr=False)
    as_driven: tuple[str, ...] = ()

    def format_limits(self) -> str:
        """All limits, and which of them are what the runs reached."""
        text = self.limits.format(steered=self.steered)
        return f"{text} ({enumerate_texts(self.as_driven)} as the runs reached)" if self.as_driven else text

    def format_rest(self) -> str:
        """Use of the time after the last decision, or why it is not driven; empty without a drive."""
        duration = self.commands.duration_s
        last = max((one.decided_after_s for one in self.promises), default=duration)
        intervals = any(one.kind == "interval" for one in self.promises)
        sentences = []
        if self.promises and duration - last >= _LEAST_REST_S:
            after = f"no further decision after {last:.0f} s"
            rest = f"; the rest of the {duration:.0f} s narrows intervals"
            sentences.append(after + (rest if intervals else f" of {duration:.0f} s"))
        if self.promises and self.spare_s >= _LEAST_REST_S:
            gain = f"narrow no interval by more than {format_share(max(self.spare_gain, 0.01))}"
            sentences.append(
                f"{self.spare_s:.0f} more seconds would {gain if intervals else 'decide nothing else'}"
            )
        return "; ".join(sentences)

    def list_impossible(self) -> list[str]:
        """Open questions, one text per reason."""
        return list_reasons(self.impossible)

    def to_json(self) -> dict[str, object]:
        """The documented keys of `slip plan --json`, and others."""
        return {
            "duration_s": self.commands.duration_s if self.manoeuvres else 0.0,
            "vehicle": self.vehicle,
            "runs": list(self.runs),
            **pick(self, "home_m", "spare_s", "spare_gain"),
            "limits": asdict(self.limits) | {"yaw_rate_radps": finite_or_none(self.limits.yaw_rate_radps)},
            "limits_as_driven": list(self.as_driven),
            "area": asdict(self.area),
            "safety": list(SAFETY),
            "topic": self.topic,
            "type": self.type_name,
            "manoeuvres": [{"name": name, "start_s": start} for name, start in self.manoeuvres],
            "promises": [
                {
                    "question": one.question,
                    "effects": list(one.effects),
                    "decided_after_s": one.decided_after_s,
                    ("expected_t" if one.kind == "separation" else "interval_after_s"): one.expected,
                }
                for one in self.promises
            ],
            "impossible": [
                {**pick(one, "question", "because", "reached"), "effects": list(one.effects)}
                for one in self.impossible
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
        seed: seed of the draws of parameters.
        as_driven: limits that are what the runs reached, in words.
    """

    limits: Limits
    area: Area
    time_s: float
    runs: tuple[str, ...] = ()
    topic: str = "/cmd_vel"
    type_name: str = "geometry_msgs/msg/Twist"
    seed: int = 0
    as_driven: tuple[str, ...] = ()


def make_plan(
    knowledge: Knowledge,
    questions: Sequence[Question],
    request: Request,
    later: Sequence[Question] = (),
    notify: Callable[[str], object] = str,
) -> Plan:
    """Choose manoeuvres that answer questions, and compute the expected gain of the whole.

    Args:
        knowledge: what is known before the drive.
        questions: to answer.
        request: time, area and limits.
        later: questions for the time that remains after the others are answered.
        notify: called with what is being done.

    Raises:
        PlanError: ``no_room``, no manoeuvre fits into the area and the time.
    """
    largest = find_largest(knowledge, request.limits, request.time_s)
    models = _list_models(knowledge, [*questions, *later], largest, request.seed)
    library = list_manoeuvres(knowledge.vehicle, request.limits)
    plural = "s" * (len(questions) != 1)
    notify(f"rehearsing {len(library)} manoeuvres for {len(questions)} open question{plural}")
    chooser = _make_chooser(knowledge, questions, request, library, models) if questions else None
    best, order, gain = _rehearse(knowledge, questions, request.area, [], models), [], 0.0
    for attempt, reserve in enumerate(_RESERVES if chooser is not None else (), start=1):
        notify(f"choosing manoeuvres, attempt {attempt} of at most {len(_RESERVES)}")
        chosen = chooser.choose(reserve) if chooser is not None else []
        trial = _rehearse(knowledge, questions, request.area, [library[number] for number in chosen], models)
        if (len(trial.promises), trial.answered) > (len(best.promises), best.answered):
            best, order = trial, chosen[: len(trial.manoeuvres)]
        if not best.impossible:
            break
    if chooser is not None and best.promises:
        asked = [*questions, *(later if not best.impossible else ())]
        if len(asked) > len(questions):
            chooser = _make_chooser(knowledge, asked, request, library, models)
        notify("filling the time that is left")
        longer = chooser.extend(order, _AMPLE)
        fuller = _rehearse(knowledge, asked, request.area, [library[number] for number in longer], models)
        # Questions of second priority may stay open without a report.
        texts = {one.text for one in questions}
        missed = tuple(one for one in fuller.impossible if one.question in texts)
        fuller, gain = replace(fuller, impossible=missed), _find_gain(best, fuller)
        # Questions of second priority must not reduce the gain for the first.
        is_covered = {one.question for one in best.promises} <= {one.question for one in fuller.promises}
        if is_covered and (gain >= _LEAST_GAIN or len(fuller.promises) > len(best.promises)):
            best, gain, order = fuller, 0.0, longer[: len(fuller.manoeuvres)]
    if not best.promises:
        # Without an expected answer nothing is driven.
        undriven = tuple(replace(one, reached="") for one in best.impossible)
        best, order = replace(best, manoeuvres=(), starts=(), impossible=undriven), []
    if chooser is not None:
        reasons = []
        for number, one in enumerate(best.impossible, start=1):
            notify(f"what keeps open questions open: {number} of {len(best.impossible)}")
            reasons.append(explain_open(one, chooser, order))
        best = replace(best, impossible=_name_limits(reasons, knowledge, questions, request, notify))
    commands, ways = best.commands, best.ways
    return Plan(
        as_driven=request.as_driven,
        vehicle=knowledge.vehicle.id,
        runs=request.runs,
        manoeuvres=tuple((one.name, at) for one, at in zip(best.manoeuvres, best.starts, strict=True)),
        commands=commands,
        limits=request.limits,
        area=request.area,
        promises=best.promises,
        impossible=best.impossible,
        topic=request.topic,
        type_name=request.type_name,
        steered=is_steered(knowledge.vehicle),
        home_m=float(np.abs(ways[:, -1]).max()),
        spare_s=round(request.time_s - commands.duration_s, 3),
        spare_gain=round(gain, 4),
        wheels=_turn_wheels(commands, knowledge),
        ways=ways,
    )


def _name_limits(
    reasons: Sequence[Impossible],
    knowledge: Knowledge,
    questions: Sequence[Question],
    request: Request,
    notify: Callable[[str], object],
) -> tuple[Impossible, ...]:
    """Open questions; where no room and no time answers one, with the limit that holds it back most.

    All manoeuvres are rehearsed with one limit after the other raised.
    """
    still = {one.question for one in reasons if one.needs_limits}
    asked = [one for one in questions if one.text in still]
    if not asked:
        return tuple(reasons)

    def look(limits: Limits) -> list[tuple[float, bool]]:
        """By question: how much all manoeuvres reach, larger for more, and whether that answers it."""
        library = list_manoeuvres(knowledge.vehicle, limits)
        edges = np.concatenate(([0.0], np.cumsum([one.commands.duration_s for one in library])))
        commands = join([one.commands for one in library])
        rehearsal = Rehearsal(commands, knowledge.vehicle, knowledge.senses, edges[:-1])
        every = np.ones(edges.size - 1)
        judged = Judge(rehearsal, knowledge, edges).judge(asked)
        return [(one.rate(every), float(one.answer(every)) >= 1.0) for one in judged]

    notify("what the limits of the commands keep open")
    before = [reached for reached, _ in look(request.limits)]
    best: dict[str, tuple[float, str]] = {}
    for option, limits, text in list_raised(knowledge.vehicle, request.limits):
        notify(f"whether the limit of {text} keeps questions open")
        for one, own, (reached, is_answered) in zip(asked, before, look(limits), strict=True):
            if reached > max(own * _HELPS, best.get(one.text, (0.0, ""))[0]):
                allowed = "where the robot and the ground allow it"
                advice = f"the limit of {text} keeps it open: give {option}, {allowed}"
                if not is_answered:
                    times = f"{reached / own:.1f} times as much" if own > 0.0 else "something"
                    advice = f"the limit of {text} holds it back most: {option}, {allowed}, tells {times}"
                best[one.text] = reached, advice
    return tuple(
        replace(one, because=best[one.question][1]) if one.question in best else one for one in reasons
    )


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


@dataclass(frozen=True)
class _Trial:
    """Manoeuvres rehearsed as a whole; see `Plan`."""

    manoeuvres: tuple[Manoeuvre, ...]
    starts: tuple[float, ...]
    commands: Commands
    ways: Complex
    promises: tuple[ExpectedGain, ...]
    impossible: tuple[Impossible, ...]
    answered: float


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
        nothing = tuple(Impossible(one.text, one.effects, "") for one in questions)
        return _Trial((), starts, commands, ways, (), nothing, 0.0)
    promised = _expect_answers(knowledge, questions, rehearsal, commands.duration_s)
    return _Trial(tuple(chosen), starts, commands, ways, *promised)


def _find_gain(best: _Trial, fuller: _Trial) -> float:
    """Fraction by which a longer drive narrows the promised interval that gains most."""
    after = {one.question: one.expected for one in fuller.promises}
    gains = [
        1.0 - after[one.question] / one.expected
        for one in best.promises
        if one.kind == "interval" and one.question in after
    ]
    return max([0.0, *gains])


def find_largest(knowledge: Knowledge, limits: Limits, time_s: float) -> Largest:
    """Largest commands of plans within these limits; usual sizes of effects are fractions of them."""
    library = join([one.commands for one in list_manoeuvres(knowledge.vehicle, limits)])
    largest = Rehearsal(library, knowledge.vehicle, knowledge.senses, np.zeros(1)).largest
    return replace(largest, moments=np.linspace(0.0, time_s, largest.moments.size), turns=None)


def _list_models(
    knowledge: Knowledge, questions: Sequence[Question], largest: Largest, seed: int
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
    generator = np.random.default_rng(seed)
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
    library: Sequence[Manoeuvre],
    models: Sequence[tuple[Effect, ...]],
) -> Chooser:
    """Chooser for the library, with the information of each manoeuvre on each question, and its paths."""
    durations = np.array([one.commands.duration_s for one in library])
    edges = np.concatenate(([0.0], np.cumsum(durations)))
    rehearsal = Rehearsal(
        join([one.commands for one in library]), knowledge.vehicle, knowledge.senses, edges[:-1]
    )
    ways = [rehearsal.trace(effects) for effects in models]
    shapes = []
    for begin, end in zip((edges[:-1] * RATE_HZ).round(), (edges[1:] * RATE_HZ).round(), strict=True):
        rows = slice(int(begin), int(end) + 1)
        paths = np.array([path[rows] for path, _ in ways])
        turned = np.array([heading[rows] for _, heading in ways])
        own = np.exp(-1j * turned[:, :1]) * (paths - paths[:, :1])
        shapes.append(Shape(own, turned[:, -1] - turned[:, 0]))
    answerable = Judge(rehearsal, knowledge, edges).judge(questions)
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


def _expect_answers(
    knowledge: Knowledge, questions: Sequence[Question], rehearsal: Rehearsal, duration_s: float
) -> tuple[tuple[ExpectedGain, ...], tuple[Impossible, ...], float]:
    """Expected gain of the whole plan by question, open questions, and the sum of the reached fractions."""
    edges = np.arange(0.0, duration_s + _STEP_S, _STEP_S)
    promises, impossible, answered = [], [], 0.0
    for one in Judge(rehearsal, knowledge, edges, stretches=True).judge(questions):
        full = np.ones(edges.size - 1)
        reached, measured = float(one.answer(full)), float(one.measure(full))
        answered += reached
        if reached >= 1.0:
            promises.append(_expect_answer(one, edges, measured))
        else:
            impossible.append(leave_open(one, full))
    promises.sort(key=lambda answer: answer.decided_after_s)
    return tuple(promises), tuple(impossible), answered


def since_when(one: Answerable, edges: Floats) -> float:
    """Time after which a question is answered [s], at an edge of the groups; infinite if it is not."""
    low, high = 0, edges.size
    while low < high:
        middle = (low + high) // 2
        if one.answer((np.arange(edges.size - 1) < middle).astype(np.float64)) >= 1.0:
            high = middle
        else:
            low = middle + 1
    return float(edges[high]) if high < edges.size else math.inf


def _expect_answer(one: Answerable, edges: Floats, measured: float) -> ExpectedGain:
    question, after = one.question, since_when(one, edges)
    if isinstance(question, Separation):
        return ExpectedGain(question.text, question.effects, "separation", after, measured, DECIDED_T)
    number = question.model.free[question.number]
    return ExpectedGain(
        question.text, question.effects, "interval", after, measured, question.goal, number.unit
    )
