"""Axes of figures."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias, TypeVar

import altair as alt

Picture: TypeAlias = alt.Chart | alt.LayerChart | alt.FacetChart | alt.VConcatChart
Channel = TypeVar("Channel", alt.X, alt.Y)


def make_axis(
    channel: type[Channel],
    field: str,
    title: str | None,
    domain: Sequence[float] = (),
    *,
    scale: Mapping[str, Any] | None = None,
    **look: Any,  # noqa: ANN401 - whatever Vega-Lite knows of an axis
) -> Channel:
    """A quantitative axis with its numbers written out.

    Args:
        channel: horizontal or vertical.
        field: the column.
        title: what it is, with its unit.
        domain: both ends, kept as they are; empty for those of the values.
        scale: more of the scale, in place of the domain.
        look: more of the axis.
    """
    chosen = scale or ({"domain": list(domain), "nice": False} if domain else None)
    axis = alt.Axis(title=title, **{"format": ",~r", **look})
    return channel(f"{field}:Q", axis=axis, scale=alt.Scale(**chosen) if chosen else alt.Undefined)
