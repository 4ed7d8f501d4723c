"""What logs that are dropped on the page, and the work on them, may cost."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of a workbench.

    Attributes:
        log_bytes: the largest log that is taken in.
        all_bytes: most that all logs together may hold that were taken in and are not worked off.
        logs: how many these may be.
        silence_s: a log that stops coming for so long is given up [s].
        timeout_s: longest time for an analysis or a diagnosis [s].
        memory_bytes: most memory for one.
    """

    log_bytes: int = 16_000_000_000
    all_bytes: int = 32_000_000_000
    logs: int = 20
    silence_s: float = 60.0
    timeout_s: float = 1800.0
    memory_bytes: int = 4_000_000_000
