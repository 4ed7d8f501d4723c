"""What a plan promised against what came out of driving it."""

from dataclasses import dataclass

from pipeline.diagnosis import RunDiagnosis
from pipeline.plan.files import Promised
from pipeline.plan.plan import Promise


@dataclass(frozen=True)
class Kept:
    """A promise and its outcome.

    Attributes:
        question: in words.
        promised: in words.
        measured: in words.
        kept: whether it is what was promised.
    """

    question: str
    promised: str
    measured: str
    kept: bool


@dataclass(frozen=True)
class Check:
    """All promises with their outcomes, and what is open still: in words."""

    kept: tuple[Kept, ...]
    open: tuple[str, ...]

    def to_json(self) -> dict[str, object]:
        """The promised keys of `slip plan --check --json`."""
        return {"kept": [vars(one) for one in self.kept], "open": list(self.open)}


def check_plan(promised: Promised, diagnosis: RunDiagnosis) -> Check:
    """Compare promises with the joint diagnosis of the logs before and of that of the plan.

    A separation is kept where its effects stand together in no undecided group any more and one of them is
    named, or the logs can tell of all and show none; an interval where it is as narrow as was promised.
    """
    kept = tuple(
        _check_interval(one, diagnosis) if one.kind == "interval" else _check_separation(one, diagnosis)
        for one in promised.promises
    )
    still = [f"{' or '.join(group.candidates)}: {group.separate_by}" for group in diagnosis.undecided]
    still += [f"{one.id}: {one.manoeuvre}" for one in diagnosis.unobservable]
    return Check(kept, tuple(still))


def _check_separation(promise: Promise, diagnosis: RunDiagnosis) -> Kept:
    text = f"decided after {promise.decided_after_s:g} s (t = {promise.expected:.1f})"
    named = [effect.id for effect in diagnosis.effects if effect.id in promise.effects]
    asked = set(promise.effects)
    undecided = any(asked <= set(group.candidates) for group in diagnosis.undecided)
    if named and not undecided:
        # What explains the drive leaves a rival nothing to be seen by: it is decided against.
        return Kept(promise.question, text, " and ".join(named), kept=True)
    if undecided or asked & {one.id for one in diagnosis.unobservable}:
        return Kept(promise.question, text, "still open", kept=False)
    # With more data what two effects shared may prove to be nothing: that decides, too.
    return Kept(promise.question, text, "decided: none of it acts", kept=True)


def _check_interval(promise: Promise, diagnosis: RunDiagnosis) -> Kept:
    text = f"+- {promise.goal:.2g} after {promise.decided_after_s:g} s"
    label = promise.question.partition(" ")[0]
    for effect in diagnosis.effects:
        for name, value in effect.parameters.items():
            if f"{effect.id}.{name}" == label:
                half = value.half
                return Kept(
                    promise.question, text, f"{value.value:.3g} +- {half:.2g}", kept=half <= promise.goal
                )
    return Kept(promise.question, text, "not named", kept=False)
