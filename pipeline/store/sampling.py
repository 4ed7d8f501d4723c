"""A share of many files, drawn by their names: what is drawn does not depend on what else there is."""

import hashlib
from dataclasses import dataclass

_DRAWN_BYTES = 8


@dataclass(frozen=True)
class Sample:
    """Draws files.

    Attributes:
        share: of all, 0 to 1.
        seed: another one draws others.
    """

    share: float
    seed: str

    def takes(self, name: str) -> bool:
        """Whether a file is drawn."""
        digest = hashlib.sha256(f"{self.seed} {name}".encode("utf-8", "surrogateescape")).digest()
        return int.from_bytes(digest[:_DRAWN_BYTES], "big") < self.share * 2.0 ** (8 * _DRAWN_BYTES)


@dataclass
class Tally:
    """How many of how many were looked at.

    Attributes:
        looked_at: whose content was read.
        all: that there are.
    """

    looked_at: int = 0
    all: int = 0

    def draws(self, sample: Sample | None, name: str) -> bool:
        """Whether one more is to be looked at, which is counted."""
        is_drawn = sample is None or sample.takes(name)
        self.all += 1
        self.looked_at += is_drawn
        return is_drawn
