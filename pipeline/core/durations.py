"""Durations in words, the same on every screen and page."""

_MINUTE, _HOUR = 60.0, 3600.0
# Below this share of the recording it is worth saying how much of it could be compared.
_NEARLY_ALL = 0.95


def say_duration(seconds: float) -> str:
    """Seconds in the two units that matter: `3.2 s`, `10 min 48 s`, `2 h 03 min`."""
    if seconds < _MINUTE:
        return f"{round(seconds, 1):g} s"
    whole = round(seconds)
    if whole < _HOUR:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def say_recorded(recorded_s: float, compared_s: object = None) -> str:
    """How long a log is, and how much of it has slip where that is clearly less."""
    text = say_duration(recorded_s)
    if isinstance(compared_s, int | float) and compared_s < _NEARLY_ALL * recorded_s:
        text += f", {say_duration(compared_s)} of it compared"
    return text
