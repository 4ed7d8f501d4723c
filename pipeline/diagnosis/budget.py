"""How long a search may take, and what it says meanwhile."""

import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from pipeline.core.parallel import measure_cpu
from pipeline.diagnosis.errors import DiagnosisError

_USUAL_S = 60.0
_FOR_S = 600.0
_UNITS = {"": 1.0, "s": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0}
_DURATION = re.compile(r"(\d+(?:\.\d+)?)\s*(s|min|m|h|)")


@dataclass
class Budget:
    """CPU time that a search may take; after it the best answer so far stands.

    Attributes:
        seconds: of CPU time of this process and of what works beside it.
        tell: told what was found so far.
        was_cut: whether a search was ended by it.
    """

    seconds: float = math.inf
    tell: Callable[[str], None] | None = None
    was_cut: bool = False
    _begun: float = field(default_factory=measure_cpu)

    @property
    def spent_s(self) -> float:
        """CPU time since it began [s]."""
        return measure_cpu() - self._begun

    def is_spent(self) -> bool:
        """Whether it is used up: whoever asks ends then."""
        self.was_cut |= self.spent_s > self.seconds
        return self.was_cut

    def report(self, way: str, effects: Iterable[str]) -> None:
        """Say what was found so far on a part of the way."""
        if self.tell is not None:
            found = ", ".join(effects) or "nothing"
            self.tell(f"{way}: {found} so far ({self.spent_s:.0f} s)")


def usual_budget(driven_s: float) -> float:
    """CPU time [s] for a run of so much driving [s]: a minute for ten minutes, and never less."""
    return max(_USUAL_S, _USUAL_S * driven_s / _FOR_S)


def parse_budget(text: str) -> float:
    """CPU time [s] of ``60s``, ``2min`` or a number of seconds.

    Raises:
        DiagnosisError: ``bad_budget``.
    """
    found = _DURATION.fullmatch(text.strip())
    if found is None:
        raise DiagnosisError(
            "bad_budget", f"{text!r} is no time", where="--budget", hint="Write it like 60s or 5min."
        )
    return float(found[1]) * _UNITS[found[2]]
