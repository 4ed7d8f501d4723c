"""Scale of the encoders: a drive gain and a wheel radius whose product is one are what the encoders misread.

An encoder that counts low makes wheels reach less than their command, and the body go further than them.
Together both leave the motion as it was commanded: they change nothing but the readings between.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

from pipeline.models import Number, find_effect
from pipeline.recording import Finding
from pipeline.results import Named, RunDiagnosis
from pipeline.run import MotionRun

GIVEN: Final = "encoder_scale_given"
"""Finding of a run whose configuration says the scale: it is not estimated."""
_LEAST: Final = 0.02
"""Smallest misreading that is reported: unequal tyres and motors reach 0.035 between the sides."""
_ONE: Final = 0.004
"""Deviation of the product from one within which it is one: the least size of a wheel radius worth a name."""


@dataclass(frozen=True)
class EncoderScale:
    """Readings of the encoders over the true wheel speeds.

    Attributes:
        value: the scale, which is also the gain that the drive seems to have.
        radius: factor that the wheel radius seems to have.
    """

    value: float
    radius: float

    def correct(self, runs: Sequence[MotionRun]) -> list[MotionRun]:
        """The runs with the true wheel speeds."""
        return [
            replace(run, wheels=run.wheels.change(run.wheels.times, lambda read: read / self.value))
            if run.wheels is not None
            else run
            for run in runs
        ]

    def report(self) -> Finding:
        """The finding, with the line of run.toml that mends it."""
        return Finding("encoder_scale", "warning", "wheels", {"value": self.value, "radius": self.radius})


def find_encoder_scale(diagnosis: RunDiagnosis) -> EncoderScale | None:
    """Scale of the encoders that explains two identified effects; None if their product is not one."""
    if any(finding.id == GIVEN for finding in diagnosis.findings):
        return None
    gain, radius = (next(_list_values(diagnosis.effects, role), None) for role in ("gain", "radius"))
    if gain is None or radius is None or gain.is_undetermined or radius.is_undetermined:
        return None
    off = abs(math.log(gain.value * radius.value))
    sure = math.hypot(gain.half / gain.value, radius.half / radius.value)
    if off > max(sure, _ONE) or abs(math.log(gain.value)) < max(_LEAST, 2.0 * off):
        return None
    return EncoderScale(gain.value, radius.value)


def _list_values(effects: Sequence[Named], role: str) -> Iterator[Number]:
    for effect in effects:
        if find_effect(effect.id).scale_role == role:
            yield from effect.parameters.values()
