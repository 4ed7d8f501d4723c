"""What of a log tells the electric power of the drive: topics of currents and voltages, by type and name."""

from __future__ import annotations

from collections.abc import Mapping

from pipeline.sources.candidates import ELECTRIC, PowerSource, Signal
from pipeline.sources.message_types import find_type


def choose_power(types: Mapping[str, str]) -> PowerSource | None:
    """Currents of motors by the types of their messages, else by names of numbers, else the battery's.

    Args:
        types: message type by topic, of one robot.
    """
    typed = {topic: power for topic, kind in types.items() if (power := find_type(kind).power) is not None}
    motors = [topic for topic in sorted(typed) if not typed[topic].is_whole]
    readings = {topic: find_type(kind).number for topic, kind in types.items()}
    numbers = {topic: number.field for topic, number in readings.items() if number is not None}
    drawn, volts = (
        [Signal(topic, numbers[topic]) for topic in sorted(numbers) if end.search(topic.lower())]
        for end in (ELECTRIC["current"], ELECTRIC["voltage"])
    )
    if not motors and drawn:
        return PowerSource(tuple(drawn), tuple(volts), "numbers whose names say current and voltage")
    for topic in [*motors, *(topic for topic in sorted(typed) if typed[topic].is_whole)]:
        power = typed[topic]
        voltages = [Signal(topic, field) for field in power.voltage] or volts
        reason = (
            "of the whole battery, other consumers included" if power.is_whole else "motors by their type"
        )
        currents = tuple(Signal(topic, field) for field in power.current)
        return PowerSource(currents, tuple(voltages), reason, power.sign)
    return None
