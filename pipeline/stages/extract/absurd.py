"""Numbers that no robot can have recorded: they are no numbers, and that is said."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.core.arrays import Flags
from pipeline.logs import Ragged, TopicColumns
from pipeline.stages.finding import Finding

_LARGEST = 1e12
"""In SI units, beyond every position, angle, speed and acceleration on Earth; its powers stay finite."""


def remove_absurd(topics: Sequence[TopicColumns]) -> tuple[tuple[TopicColumns, ...], list[Finding]]:
    """Put NaN where a number is infinite or larger than 1e12.

    Args:
        topics: columns as they were read.

    Returns:
        The columns, and a finding for each topic that had such numbers.
    """
    cleaned, findings = [], []
    for columns in topics:
        fields, count = dict(columns.fields), 0
        for name, column in columns.fields.items():
            values = column.values if isinstance(column, Ragged) else column
            if not isinstance(values, np.ndarray) or values.dtype.kind != "f":
                continue
            wrong = np.abs(values) > _LARGEST
            if wrong.any():
                count += int(wrong.sum())
                good = _without(values, wrong)
                fields[name] = replace(column, values=good) if isinstance(column, Ragged) else good
        cleaned.append(replace(columns, fields=fields) if count else columns)
        if count:
            text = (
                f"{count} numbers of {columns.topic} are infinite or beyond 1e12: they count as not recorded"
            )
            findings.append(Finding("absurd_values", "warning", text, where=columns.topic, count=count))
    return tuple(cleaned), findings


def _without(values: NDArray[np.generic], wrong: Flags) -> NDArray[np.generic]:
    good = values.copy()
    good[wrong] = np.nan
    return good
