"""The velocity lines that layouts draw."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipeline.report import theme
from pipeline.report.exports import topics
from pipeline.report.run import INPUT_WORDS

if TYPE_CHECKING:
    from pipeline.report.exports.source import ExportSource

_FIELDS = {"x": "linear.x", "y": "linear.y", "w": "angular.z"}


@dataclass(frozen=True)
class VelocityLine:
    """A velocity in the derived log.

    Attributes:
        topic: of type TwistStamped.
        label: in the legend.
        colour: as in the report.
    """

    topic: str
    label: str
    colour: str

    def path(self, axis: str, separator: str = ".") -> str:
        """Message path of the component `x`, `y` or `w`."""
        return f"{self.topic}{separator}twist{separator}{_FIELDS[axis].replace('.', separator)}"


def list_series(source: ExportSource) -> list[VelocityLine]:
    """Measured, ideal on every input, and the model's where there is one."""
    lines = [VelocityLine(topics.MEASURED, "measured", theme.MEASURED)]
    lines += [
        VelocityLine(topics.name_ideal(name), f"ideal {INPUT_WORDS[name]}", theme.INPUT_COLOURS[name])
        for name in source.inputs
    ]
    if source.model is not None:
        lines.append(VelocityLine(topics.MODEL, "model", theme.MODEL))
    return lines
