# ruff: noqa: ANN401, FBT003 - rules are functions of any kind
"""The rules of the diagnosis, each with what happens without it: what `ablate` turns off in turn.

A rule is a function of the diagnosis and its replacement. While a log is diagnosed with all rules, both are
asked: a rule whose replacement would have answered the same everywhere has not acted on that log, and turning
it off cannot change the answer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import Any
from unittest.mock import patch

import numpy as np

from pipeline import estimation
from pipeline.estimation import (
    acceptance,
    ambiguity,
    conclude,
    evidence,
    proposals,
    search,
    selection,
    unexplained,
)
from pipeline.estimation import acceptance as plausibility
from pipeline.estimation import evidence as noise
from pipeline.estimation import unexplained as residual_structure
from pipeline.stages import align


def _same(one: Any, other: Any) -> bool:
    return bool(one == other)


@dataclass(frozen=True)
class Rule:
    """A rule of the diagnosis.

    Attributes:
        name: of the rule.
        says: what it does, in words.
        owner, attribute: the function that is the rule.
        without: what is called in its place: takes the function itself, then its arguments.
        alike: whether two results of it are the same decision.
        costly: the replacement is not asked beside the rule; the rule counts as having acted.
    """

    name: str
    says: str
    owner: Any
    attribute: str
    without: Callable[..., Any]
    alike: Callable[[Any, Any], bool] = _same
    costly: bool = False

    @property
    def original(self) -> Callable[..., Any]:
        """The rule itself."""
        found: Callable[..., Any] = getattr(self.owner, self.attribute)
        return found

    @contextmanager
    def off(self) -> Iterator[None]:
        """Without the rule."""
        original = self.original

        def instead(*args: Any, **named: Any) -> Any:
            return self.without(original, *args, **named)

        with patch.object(self.owner, self.attribute, instead):
            yield


@contextmanager
def watch(rules: Sequence[Rule]) -> Iterator[set[str]]:
    """Names of the rules that act, filled while the block runs."""
    acted: set[str] = {rule.name for rule in rules if rule.costly}
    with ExitStack() as stack:
        for rule in rules:
            if not rule.costly:
                stack.enter_context(_watch(rule, acted))
        yield acted


@contextmanager
def _watch(rule: Rule, acted: set[str]) -> Iterator[None]:
    original = rule.original

    def both(*args: Any, **named: Any) -> Any:
        found = original(*args, **named)
        if rule.name not in acted and not rule.alike(found, rule.without(original, *args, **named)):
            acted.add(rule.name)
        return found

    with patch.object(rule.owner, rule.attribute, both):
        yield


def _give(value: Any) -> Callable[..., Any]:
    return lambda _original, *_args, **_named: value


def _first(_original: Any, one: Any, *_rest: Any) -> Any:
    return one


def _second(_original: Any, _first_one: Any, one: Any, *_rest: Any) -> Any:
    return one


def _set(module: Any, **constants: float) -> Callable[..., Any]:
    """The function itself with other constants of a module."""

    def call(original: Callable[..., Any], *args: Any, **named: Any) -> Any:
        with patch.multiple(module, **constants):
            return original(*args, **named)

    return call


def _grant(**values: float) -> Callable[..., Any]:
    """The improvement with some of its measures as good as can be."""

    def call(original: Callable[..., Any], *args: Any, **named: Any) -> Any:
        return replace(original(*args, **named), **values)

    return call


def _same_verdict(one: acceptance.Improvement, other: acceptance.Improvement) -> bool:
    return one.is_significant == other.is_significant


def _same_sum(one: Any, other: Any) -> bool:
    return bool(np.isclose(one.sum(), other.sum(), rtol=0.1))


def _forget_past(_original: Any, covariance: Any) -> Any:
    """Predictors of no past at all."""
    orders = range(covariance.size)
    return tuple(np.zeros(order) for order in orders), np.full(covariance.size, covariance[0])


def _same_ids(one: Any, other: Any) -> bool:
    return bool(one.ids == other.ids)


def _begin_simply(_original: Any, _selection: Any, first: Any) -> Any:
    """The search begins with the model that it has."""
    return first, True


def _same_beginning(one: Any, other: Any) -> bool:
    return _same_ids(one[0], other[0])


def _same_names(one: Any, other: Any) -> bool:
    return [(effect.id, effect.tentative) for effect in one] == [
        (effect.id, effect.tentative) for effect in other
    ]


def _forget_companions(prune: Callable[..., Any], of: selection.Selection, current: Any) -> Any:
    with ExitStack() as stack:
        for effect in current.state.effects:
            stack.enter_context(patch.object(type(effect), "companions", ()))
        return prune(of, current)


def _take_all_evidence(original: Callable[..., Any], of: selection.Selection, base: Any, *args: Any) -> Any:
    with ExitStack() as stack:
        for kind in {type(effect) for effect in base.state.effects}:
            stack.enter_context(patch.object(kind, "contains", ()))
        return original(of, base, *args)


def _follow_at_once(_original: Any, commands: Any, _wheels: Any, _vehicle: Any) -> Any:
    return commands.with_columns(followed=True) if commands.height else commands, []


def _same_followed(one: Any, other: Any) -> bool:
    return bool(one[0].equals(other[0]))


def _same_values(one: Any, other: Any) -> bool:
    return bool(np.array_equal(one, other))


def _untraced(_original: Any, _trial: proposals.Trial, size: Any) -> Any:
    return np.ones(size.size, dtype=bool)


def _explain_nothing(
    _original: Any, _of: selection.Selection, final: selection.CandidateModel, _features: Any
) -> unexplained.Explainable:
    return unexplained.Explainable(np.zeros(3), np.zeros(final.held.shape))


def _same_structure(one: unexplained.Explainable, other: unexplained.Explainable) -> bool:
    return unexplained.is_explainable(one) == unexplained.is_explainable(other)


def _nameable_in_disguise(original: Any, effect: Any, conditions: Any, **named: Any) -> bool:
    with patch.object(type(effect), "is_degenerate", return_value=False):
        return bool(original(effect, conditions, **named))


def _choose_first(_original: Any, _problem: Any, found: Any, undecided: Any) -> Any:
    return list(found), list(undecided)


def _same_choice(one: Any, other: Any) -> bool:
    return [effect.id for effect in one[0]] == [effect.id for effect in other[0]]


def _same_presence(one: Any, other: Any) -> bool:
    return (one is None) == (other is None)


def _admit_none(_original: Any, _of: Any, _base: Any, found: Any, _beyond: Any) -> Any:
    return found


def _same_count(one: Any, other: Any) -> bool:
    return len(one) == len(other)


def _follow_only(_original: Any, of: selection.Selection, model: Any, best: Any) -> bool:
    """Whether a model follows the whole recording better, whatever it predicts from measured states."""
    return of.loss(model) < (1.0 - selection._BETTER) * of.loss(best)


def _forget_restarts(original: Callable[..., Any], *args: Any, **named: Any) -> Any:
    """The gain on the whole recording alone."""
    return original(*args, **{**named, "restarted": None})


def _same_matter(one: Any, other: Any) -> bool:
    """Whether what an effect moves makes no difference to its name: nothing known, nothing is refused."""
    return one is None or (other is None and one.is_material)


def _same_clocks(one: Any, other: Any) -> bool:
    return [effect.id for effect in one.effects] == [effect.id for effect in other.effects]


RULES: tuple[Rule, ...] = (
    Rule("stable", "the evidence must remain without its best ten seconds", selection, "compare",
         _grant(t_stable=math.inf), _same_verdict),
    Rule("gain", "a name must take away a share of the loss", selection, "compare", _grant(gain=1.0),
         _same_verdict),
    Rule("white", "evidence is taken on innovations, not on residuals", noise, "_predict", _forget_past,
         costly=True),
    Rule("uneven_noise", "noise may differ from stretch to stretch", acceptance, "measure_evidence",
         _set(acceptance, _CLUSTER=1), _same_sum),
    Rule("predicted_gain", "a gain counts in predictions from measured states, too", selection, "compare",
         _forget_restarts, _same_verdict),
    Rule("begin_whole", "a search begins with a controller, or contact, and its companions", search,
         "_begin_whole", _begin_simply, _same_beginning),
    Rule("expected", "companions stay while they take away a share of the loss", search, "prune",
         _forget_companions, costly=True),
    Rule("covered", "special cases of an effect are not added beside it", selection.Selection,
         "take_evidence", _take_all_evidence, costly=True),
    Rule("late_starts", "commands that the drive followed late act from then on", align, "mark_late_starts",
         _follow_at_once, _same_followed),
    Rule("pairs", "two effects may be added at once", evidence.Evidence, "rank_pairs", _give([]),
         costly=True),
    Rule("exchange", "one effect may take the place of another", search, "exchange", _second, _same_ids),
    Rule("exchange_two", "one effect or two may take the place of two", search, "combinations", _give(()),
         costly=True),
    Rule("special_case", "special cases take the place of what is not distinguished from them", search,
         "simplify", _second, _same_ids),
    Rule("predicts", "what takes another's place predicts from measured states as well", selection.Selection,
         "is_better", _follow_only),
    Rule("restart", "the final model is fitted from other starts, too", search, "restart", _second, _same_ids,
         costly=True),
    Rule("simplify", "what a new effect leaves at nothing goes", selection.Selection, "_simplify",
         _second, _same_ids),
    Rule("disguise", "no effect at values where it is another one", selection, "is_nameable",
         _nameable_in_disguise),
    Rule("sign", "no effect of the sign that physics does not have", plausibility, "_has_its_sign",
         _give(True)),
    Rule("large_enough", "no effect below its least size", plausibility, "is_large_enough", _give(True)),
    Rule("plausible", "no effect beyond the observed range", plausibility, "find_implausible", _give(None),
         _same_presence),
    Rule("exceeded", "no limit that measured wheels exceed", plausibility, "find_exceeded", _give(None),
         _same_presence),
    Rule("traced", "a number that leaves no trace stays", proposals, "_find_traced", _untraced,
         _same_values),
    Rule("pushed_alike", "rivals push the prediction alike", ambiguity, "_does_the_same", _give(True)),
    Rule("larger_rival", "no rival with more numbers", ambiguity, "_is_extended", _give(False)),
    Rule("softer_rival", "bends for breaks, and what one motion shows, are rivals", ambiguity, "_list_alike",
         _give([])),
    Rule("formula_for_effect", "a formula may take the place of an effect", unexplained, "_replace",
         _give(None), _same_presence),
    Rule("formula", "a formula for what no effect takes", unexplained, "_add", _give(None), _same_presence),
    Rule("boosting", "what trees can predict is unexplained", estimation, "boost_residuals", _explain_nothing,
         _same_structure),
    Rule("lasting", "motion that lasts is unexplained", residual_structure, "_find_lasting", _give(None),
         _same_presence),
    Rule("idle", "what helps the wheels and not the body is not named", conclude, "find_idle", _give([])),
    Rule("material", "what moves no prediction by what is felt is not named", conclude, "measure_moves",
         _give(None), _same_matter),
    Rule("needed", "what halves an error is named though its numbers are open", conclude, "_is_needed",
         _give(False)),
    Rule("idle_tentative", "what stands in, is open, or lowers no error is tentative", conclude,
         "_mark_tentative", _first, _same_names),
    Rule("doubt", "what no vehicle does is a finding", conclude, "find_doubt", _give(None), _same_presence),
    Rule("stand_in", "what halves an error is named though no vehicle shows its numbers", selection.Selection,
         "admit", _admit_none, _same_count),
    Rule("reaching", "of effects with equal evidence, the one that predicts 2 s best",
         conclude, "choose_reaching", _choose_first, _same_choice),
    Rule("useful", "rivals that stay far behind are not fitted to the end", search, "list_rivals",
         _set(search, USEFUL=math.inf, LEAST_GAIN=-math.inf), costly=True),
    Rule("skewed_clock", "a clock beside a skew must be larger", estimation, "read_clocks",
         _set(ambiguity, _SKEWED_CLOCK=0.0), _same_clocks),
)  # fmt: skip
