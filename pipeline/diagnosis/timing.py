"""How late the reported heading is, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.models.evidence import LEAST_DELAY_S

_SURE = 4.0


@dataclass(frozen=True)
class YawDelay:
    """How late the reported heading is against the gyro.

    Attributes:
        seconds: the delay.
        error: its standard error, from stretches of ten seconds.
    """

    seconds: float
    error: float

    @property
    def is_certain(self) -> bool:
        """Whether it is a delay beyond doubt."""
        return abs(self.seconds) >= LEAST_DELAY_S and abs(self.seconds) > _SURE * self.error
