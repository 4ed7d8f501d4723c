"""Measured wheels that repeat the commands, as a controller in open loop publishes them."""

from collections.abc import Sequence

import numpy as np
import polars as pl

from pipeline.core import arrays
from pipeline.recording.findings import Finding
from pipeline.sources import Vehicle

_RECENT_S = 0.5
"""Age [s] up to which a command may be what the wheels repeat: the usual timeout of a controller."""
_EXACTLY = 1e-5
"""Relative difference of numbers that are equal up to the precision of a message."""
_FEWEST_CHANGES = 50
"""Least number of changes of the wheels' reading for a judgment: one or two seconds of driving."""
_REPEATED = 0.9
"""Fraction of the changes of the wheels' reading that are recent commands, above which nothing was measured:
1 in open loop, at most 0.04 of the recordings' encoders and 0.02 of exact ones behind a lag of 20 ms."""


def check_echo(
    commands: pl.DataFrame, wheels: pl.DataFrame, vehicle: Vehicle, *, body_commanded: bool
) -> list[Finding]:
    """Report measured wheels that repeat the commands: a controller in open loop says what it was asked for.

    Encoders have steps and noise, and even a fast drive passes through speeds that were never commanded.

    Args:
        commands: table `commands` as extracted.
        wheels: table `wheels` as extracted.
        vehicle: its vehicle.
        body_commanded: whether the command was a body command.
    """
    if min(commands.height, wheels.height) < _FEWEST_CHANGES:
        return []
    kinematics = vehicle.kinematics
    names = [one.name for one in kinematics.inputs]
    commands, wheels = (_keep_readings(table, names) for table in (commands, wheels))
    if min(commands.height, wheels.height) < _FEWEST_CHANGES:
        return []
    asked, read = (
        # An input that no message has is none, as sideways speeds of wheels are.
        np.nan_to_num(np.stack(roll({name: table[name].to_numpy() for name in names}, vehicle), axis=-1))
        for table, roll in (
            (commands, kinematics.asked if body_commanded else kinematics.forward),
            (wheels, kinematics.forward),
        )
    )
    equal = _EXACTLY * np.abs(asked).max(axis=0)
    changed = 1 + np.flatnonzero((np.abs(np.diff(read, axis=0)) > equal).any(axis=1))
    if changed.size < _FEWEST_CHANGES:
        return []
    stamps = commands["t"].to_numpy()
    last = arrays.hold_indices(wheels["t"].to_numpy()[changed], stamps)
    repeats = np.zeros(changed.size, dtype=bool)
    # The clocks of two topics differ: the command may be recorded just after what repeats it.
    for back in range(-2, arrays.count_steps(stamps, _RECENT_S)):
        command = asked[np.clip(last - back, 0, stamps.size - 1)]
        repeats |= (np.abs(read[changed] - command) <= equal).all(axis=1)
    share = float(repeats.mean())
    if share < _REPEATED:
        return []
    return [Finding("wheels_from_commands", "warning", "wheels", {"value": share})]


def _keep_readings(table: pl.DataFrame, names: Sequence[str]) -> pl.DataFrame:
    """Rows in which every input is known that any row has."""
    known = table.select(pl.col(names).cast(pl.Float64).is_finite().fill_null(value=False))
    rows = [known[name] for name in names if known[name].any()]
    return table.filter(pl.all_horizontal(rows)) if rows else table.clear()
