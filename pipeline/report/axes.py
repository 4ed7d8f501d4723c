"""Axes of figures."""

from collections.abc import Mapping, Sequence

from pipeline.report.vega import Channel, encode_column


def make_axis(
    column: str,
    title: str | None,
    domain: Sequence[float] = (),
    *,
    scale: Mapping[str, object] | None = None,
    **look: object,
) -> Channel:
    """A quantitative axis with its numbers written out.

    Args:
        column: what it is the axis of.
        title: what it is, with its unit.
        domain: both ends, kept as they are; empty for those of the values.
        scale: more of the scale, in place of the domain.
        look: more of the axis.
    """
    chosen = scale or ({"domain": list(domain), "nice": False} if domain else None)
    axis = {"title": title, "format": ",~r", **look}
    return encode_column(f"{column}:Q", axis=axis, **({"scale": chosen} if chosen else {}))
