"""What models are fed with: one choice for every verb, and its reason."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from pipeline.identification.comparison import Input
from pipeline.models.effect import Effect, Place
from pipeline.runs.recording import MotionRun


@dataclass(frozen=True)
class InputChoice:
    """An input and why it was taken.

    Attributes:
        source: the input.
        reason: in words.
        idle: ids of the effects that cannot act on it.
        warning: what those effects need, in a sentence; empty where all can act.
    """

    source: Input
    reason: str
    idle: tuple[str, ...] = ()
    warning: str = ""


def choose_input(
    runs: Sequence[MotionRun],
    asked: str | None = None,
    effects: Iterable[Effect] = (),
    *,
    last: str | None = None,
) -> InputChoice:
    """The input asked for; else what the effects need, what was last used, or what leads in the runs.

    The command leads where every run has one: it holds everything between what was asked and what came of it.

    Args:
        runs: all must have the input.
        asked: `command` or `measured`; None leaves the choice open.
        effects: of the model; those between command and wheels need the command.
        last: the input of the model's last fit.
    """
    drivetrain = tuple(dict.fromkeys(effect.id for effect in effects if effect.place <= Place.DRIVE))
    acts = f"{', '.join(drivetrain)} {'act' if len(drivetrain) > 1 else 'acts'} between command and wheels"
    silent = next((run.name for run in runs if run.commands is None), None)
    if asked is not None:
        source, reason = Input(asked), "as asked for"
    elif silent is not None:
        source, reason = Input.MEASURED, f"{silent} has no command"
    elif drivetrain:
        source, reason = Input.COMMAND, acts
    elif last is not None and (last == Input.COMMAND.value or all(run.wheels is not None for run in runs)):
        source, reason = Input(last), "as at the last fit"
    else:
        source, reason = Input.COMMAND, "the command leads where there is one"
    if source is Input.COMMAND or not drivetrain:
        return InputChoice(source, reason)
    way_out = "--input command" if silent is None else f"{silent} has no command"
    return InputChoice(source, reason, drivetrain, f"not fitted from measured wheels: {acts} ({way_out})")
