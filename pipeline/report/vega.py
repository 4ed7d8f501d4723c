"""Charts as plain Vega-Lite: every call makes a new one; nothing is validated or copied deeply."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

SCHEMA = "https://vega.github.io/schema/vega-lite/v6.4.1.json"
"""What the specifications are written in."""

Channel = dict[str, object]

_TYPES = {"Q": "quantitative", "N": "nominal"}
# The second end of a span has the type of the first.
_ENDS = frozenset({"x2", "y2"})


def encode_column(name: str, **look: object) -> Channel:
    """The encoding of a column.

    Args:
        name: of the column, with ``Q`` (quantitative) or ``N`` (nominal): ``t:Q``; ``sum(t):Q`` is its sum.
        look: axis, scale, legend, title, format and whatever else Vega-Lite knows of an encoding.
    """
    column, _, kind = name.partition(":")
    aggregate, bracket, inner = column.rstrip(")").partition("(")
    what: Channel = {"aggregate": aggregate, "field": inner} if bracket else {"field": column}
    return {**what, "type": _TYPES[kind], **look}


@dataclass(frozen=True)
class Chart:
    """A Vega-Lite chart: one mark over rows that have a name, or several charts.

    Attributes:
        view: whatever is neither encoding nor transform.
        encoding: channels of the mark.
        transforms: what is done to the rows first.
    """

    view: Mapping[str, object]
    encoding: Mapping[str, object] = field(default_factory=dict)
    transforms: tuple[Mapping[str, object], ...] = ()

    @classmethod
    def of_rows(cls, name: str) -> Chart:
        """A chart of the rows that are called so, still without a mark."""
        return cls({"data": {"name": name}})

    def mark(self, kind: str, **look: object) -> Chart:
        """Draw the rows as `line`, `point`, `rule`, ..."""
        return self.properties(mark={"type": kind, **look})

    def encode(self, **channels: object) -> Chart:
        """Set channels: a column as of `encode_column` or by its name alone, several columns, a value."""
        named = {name: _complete(name, value) for name, value in channels.items()}
        return replace(self, encoding={**self.encoding, **named})

    def filter(self, predicate: str) -> Chart:
        """Keep the rows for which the expression is true."""
        return self._transform({"filter": predicate})

    def calculate(self, name: str, expression: str) -> Chart:
        """Add a column."""
        return self._transform({"calculate": expression, "as": name})

    def _transform(self, step: Mapping[str, object]) -> Chart:
        return replace(self, transforms=(*self.transforms, step))

    def properties(self, **given: object) -> Chart:
        """Set width, height, title, usermeta, ..."""
        return replace(self, view={**self.view, **given})

    def resolve_scale(self, **channels: str) -> Chart:
        """Say which scales the parts do not share."""
        return self.properties(resolve={"scale": channels})

    def to_dict(self) -> dict[str, object]:
        """The specification."""
        view: dict[str, object] = {"encoding": dict(self.encoding)} if self.encoding else {}
        if self.transforms:
            view["transform"] = list(self.transforms)
        return {**self.view, **view}


def layer(*charts: Chart) -> Chart:
    """Charts on top of each other."""
    return Chart({"layer": [chart.to_dict() for chart in charts]})


def stack(*charts: Chart) -> Chart:
    """Charts below each other."""
    return Chart({"vconcat": [chart.to_dict() for chart in charts]})


def _complete(name: str, value: object) -> object:
    if isinstance(value, str):
        value = encode_column(value)
    elif isinstance(value, list):
        return [_complete(name, one) for one in value]
    if name in _ENDS and isinstance(value, dict):
        return {key: what for key, what in value.items() if key != "type"}
    return value
