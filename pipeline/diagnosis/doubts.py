"""Named effects whose numbers no vehicle shows: what is not named for it, and what is named as a stand-in."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.diagnosis.plausibility import HALVES, find_beyond, find_exceeded, find_implausible
from pipeline.models import Effect, find_effect

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.diagnosis.diagnosis import Json, Named, Value


def find_doubt(effect: Named, exceeded: Mapping[str, float]) -> str | None:
    """Why an effect with its numbers is none of a vehicle's; None where it may be one, or stands for one.

    Args:
        effect: with its numbers.
        exceeded: what measured wheels exceed, see `Conditions`.
    """
    for values in effect.tellings:
        restored = restore(effect.id, values)
        highs = {name: value.high for name, value in values.items()}
        implausible = None if describe_stand_in(effect) else find_implausible(restored)
        doubt = implausible or find_exceeded(restored, highs, exceeded)
        if doubt is not None:
            return doubt
    return None


def describe_stand_in(effect: Named) -> str:
    """In words with which numbers, beyond those of vehicles, an effect halves the loss; else empty."""
    beyond = (find_beyond(restore(effect.id, values)) for values in effect.tellings)
    return next(filter(None, beyond), "") if HALVES * (1.0 + effect.gain) >= 1.0 else ""


def restore(name: str, values: Mapping[str, Value]) -> Effect:
    """The effect with the numbers that are told of it."""
    return find_effect(name)().change(**{key: value.value for key, value in values.items()})


def note_doubts(doubts: Mapping[str, str]) -> list[Mapping[str, Json]]:
    """Findings of doubts, by effect."""
    return [
        {"id": "implausible_effect", "text": text, "where": name, "severity": "warning"}
        for name, text in doubts.items()
    ]
