# ruff: noqa: ANN401, FBT003 - rules are functions of any kind
"""The rules of the diagnosis, each with what happens without it: what `ablate` turns off in turn.

A rule is a function of the diagnosis and its replacement. While a log is diagnosed with all rules, both are
asked: a rule whose replacement would have answered the same everywhere has not acted on that log, and turning
it off cannot change the answer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import numpy as np

from pipeline.diagnosis import (
    conclude,
    diagnose,
    excitation,
    naming_rules,
    plausibility,
    residual_structure,
    search,
    selection,
    undecided,
    unexplained,
    verdict,
)
from pipeline.identification import proposals

# Where a decision about a verdict may lie.
_THRESHOLDS = (1.0, 1.5, 1.6, 2.5, 3.0, 6.0)


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


def _second(_original: Any, _self: Any, one: Any, *_rest: Any) -> Any:
    return one


def _set(module: Any, **constants: float) -> Callable[..., Any]:
    """The function itself with other constants of a module."""

    def call(original: Callable[..., Any], *args: Any, **named: Any) -> Any:
        with patch.multiple(module, **constants):
            return original(*args, **named)

    return call


def _grade(one: verdict.Verdict, other: verdict.Verdict) -> bool:
    """Whether two verdicts lie between the same thresholds."""

    def place(found: verdict.Verdict) -> list[int]:
        return np.searchsorted(_THRESHOLDS, [found.t, found.z], side="right").tolist()

    return place(one) == place(other)


def _same_ids(one: Any, other: Any) -> bool:
    return bool(one.ids == other.ids)


def _same_names(one: Any, other: Any) -> bool:
    return [(effect.id, effect.tentative) for effect in one] == [
        (effect.id, effect.tentative) for effect in other
    ]


def _same_values(one: Any, other: Any) -> bool:
    return bool(np.array_equal(one, other))


def _untraced(_original: Any, _trial: proposals.Trial, size: Any) -> Any:
    return np.ones(size.size, dtype=bool)


def _explain_nothing(
    _original: Any, _of: selection.Selection, final: selection.CandidateModel, _features: Any
) -> unexplained.Explainable:
    return unexplained.Explainable(np.zeros(3), np.zeros(3), np.zeros(final.held.shape))


def _same_structure(one: unexplained.Explainable, other: unexplained.Explainable) -> bool:
    return unexplained.is_explainable(one) == unexplained.is_explainable(other)


def _nameable_in_disguise(original: Any, effect: Any, evidence: Any) -> bool:
    with patch.object(type(effect), "is_degenerate", return_value=False):
        return bool(original(effect, evidence))


def _same_presence(one: Any, other: Any) -> bool:
    return (one is None) == (other is None)


def _same_clocks(one: Any, other: Any) -> bool:
    return [effect.id for effect in one.effects] == [effect.id for effect in other.effects]


_NEVER, _ALWAYS = 1e9, -1e9
RULES: tuple[Rule, ...] = (
    Rule("rare", "what acts in a few stretches needs less t there", verdict.Verdict, "accepts",
         _set(verdict, _RARE_T=_NEVER)),
    Rule("faint", "a gain must stand out of the noise", verdict.Verdict, "accepts",
         _set(verdict, _FAINT_Z=_ALWAYS)),
    Rule("short_stretches", "three-second stretches may decide too", selection, "compare",
         _set(verdict, _SHORT_T=_NEVER), _grade),
    Rule("few_windows", "stretches of few windows do not vote", selection, "compare",
         _set(verdict, _FEWEST_WINDOWS=0), _grade),
    Rule("few_active", "one stretch alone decides nothing", selection, "compare",
         _set(verdict, _FEWEST_ACTIVE=0.0), _grade),
    Rule("few_moved", "what moves one short stretch stands out of nothing", selection, "compare",
         _set(verdict, LEAST_STRETCHES=0.0), _grade),
    Rule("price", "some effects must gain more than others", search, "price_of", _give(verdict.LEAST_GAIN)),
    Rule("simplify", "what a new effect leaves at nothing goes", selection.Selection, "_simplify",
         _second, _same_ids),
    Rule("disguise", "no effect at values where it is another one", selection, "is_nameable",
         _nameable_in_disguise),
    Rule("sign", "no effect of the sign that physics does not have", plausibility, "_has_its_sign",
         _give(True)),
    Rule("large_enough", "no effect below its least size", plausibility, "is_large_enough", _give(True)),
    Rule("plausible", "no effect beyond what vehicles show", plausibility, "find_implausible", _give(None),
         _same_presence),
    Rule("traced", "a number that leaves no trace stays", proposals, "_find_traced", _untraced,
         _same_values),
    Rule("pushed_alike", "rivals push the prediction alike", undecided, "_does_the_same", _give(True)),
    Rule("larger_rival", "what needs more numbers is no rival", undecided, "_is_larger", _give(False)),
    Rule("softer_rival", "bends for breaks, and what one motion shows, are rivals", undecided, "_list_alike",
         _give([])),
    Rule("formula_for_effect", "a formula may take the place of an effect", unexplained, "_replace",
         _give(None), _same_presence),
    Rule("formula", "a formula for what no effect takes", unexplained, "_add", _give(None), _same_presence),
    Rule("boosting", "what trees can predict is unexplained", diagnose, "boost_residuals", _explain_nothing,
         _same_structure),
    Rule("lasting", "motion that lasts is unexplained", residual_structure, "_find_lasting", _give(None),
         _same_presence),
    Rule("idle", "what helps the wheels and not the body is not named", conclude, "_find_idle", _give([])),
    Rule("idle_together", "unless it helps with others", conclude, "_find_idle",
         _set(conclude, _TOGETHER=0.0)),
    Rule("idle_tentative", "what lowers no error is tentative", conclude, "_mark_idle", _first, _same_names),
    Rule("doubt", "what no vehicle does is a finding", conclude, "_doubt", _give(None), _same_presence),
    Rule("skewed_clock", "a clock beside a skew must be larger", diagnose, "read_clocks",
         _set(naming_rules, _SKEWED_CLOCK=0.0), _same_clocks),
    Rule("shown_once", "what shows once cannot be told", diagnose, "find_unobservable",
         _set(excitation, LEAST_STRETCHES=0.0)),
)  # fmt: skip
