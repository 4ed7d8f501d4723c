"""Charts as plain Vega-Lite: their parts, colours and ranges, and the JavaScript that draws them."""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import subprocess
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import polars as pl

from pipeline.core import find_cache_folder, python_command, require_package
from pipeline.store import replace_file

SCHEMA = "https://vega.github.io/schema/vega-lite/v6.4.1.json"
"""Schema of the specifications."""

Channel = dict[str, object]

_TYPES = {"Q": "quantitative", "N": "nominal", "T": "temporal"}


def encode_column(name: str, **look: object) -> Channel:
    """Encoding of a column.

    Args:
        name: column with ``Q`` (quantitative) or ``N`` (nominal): ``t:Q``; ``sum(t):Q`` is its sum.
        look: axis, scale, legend, title, format and other Vega-Lite properties of an encoding.
    """
    column, _, kind = name.partition(":")
    aggregate, bracket, inner = column.rstrip(")").partition("(")
    what: Channel = {"aggregate": aggregate, "field": inner} if bracket else {"field": column}
    return {**what, "type": _TYPES[kind], **look}


class Chart(dict[str, Any]):
    """Vega-Lite specification of one mark over named rows, or of several charts.

    Every call returns a new chart; nothing is validated or deep-copied.
    """

    @classmethod
    def of_rows(cls, name: str) -> Chart:
        """Chart of the rows of that name, without a mark."""
        return cls(data={"name": name})

    def mark(self, kind: str, **look: object) -> Chart:
        """Draw the rows as `line`, `point`, `rule`, ..."""
        return self.properties(mark={"type": kind, **look})

    def encode(self, **channels: object) -> Chart:
        """Set channels: a column as for `encode_column` or by its name, several columns, or a value."""
        named = {name: _complete(name, value) for name, value in channels.items()}
        return self.properties(encoding={**self.get("encoding", {}), **named})

    def filter(self, predicate: str) -> Chart:
        """Select the rows for which the expression is true."""
        return self.properties(transform=[{"filter": predicate}])

    def properties(self, **given: object) -> Chart:
        """Set width, height, title, usermeta, ..."""
        return Chart({**self, **given})


def layer(*charts: Chart) -> Chart:
    """Overlay charts."""
    return Chart(layer=list(charts))


def stack(*charts: Chart) -> Chart:
    """Stack charts vertically."""
    return Chart(vconcat=list(charts))


def _complete(name: str, value: object) -> object:
    if isinstance(value, list):
        return [_complete(name, one) for one in value]
    if isinstance(value, str):
        value = encode_column(value)
    # The second end of a span has the type of the first.
    if name in {"x2", "y2"} and isinstance(value, dict):
        return {key: what for key, what in value.items() if key != "type"}
    return value


def make_axis(
    column: str,
    title: str | None,
    domain: Sequence[float] = (),
    *,
    scale: Mapping[str, object] | None = None,
    **look: object,
) -> Channel:
    """Quantitative axis with its numbers written out.

    Args:
        column: column of the axis.
        title: quantity with its unit.
        domain: both ends, fixed; empty for those of the values.
        scale: scale properties, used instead of the domain.
        look: other properties of the axis.
    """
    chosen = scale or ({"domain": list(domain), "nice": False} if domain else None)
    axis = {"title": title, "format": ",~r", **look}
    return encode_column(f"{column}:Q", axis=axis, **({"scale": chosen} if chosen else {}))


_LONE_SHARE = 0.01
_WIDEST_RATIO = 2.0
_ROOM = 0.25


def usual_ends(values: pl.Series, *, exact: bool) -> tuple[float, float]:
    """Lower and upper end of a line: ``exact``, or without the most extreme 1 % of the values."""
    share = 0.0 if exact else _LONE_SHARE / 2.0
    low, high = np.quantile(values.to_numpy(), (share, 1.0 - share)).tolist()
    return low, high


def find_range(
    lines: pl.DataFrame, usual: tuple[float, float]
) -> tuple[float, float, tuple[float, float] | None]:
    """Axis range of lines over time: all values, or without isolated peaks that would flatten the rest.

    Args:
        lines: rows with ``t`` [s] and ``value``, null where a line breaks.
        usual: range without isolated peaks.

    Returns:
        Both ends, which include zero; peaks are cut if they would more than double the range: then also the
        value furthest outside and its time [s].
    """
    lines = lines.drop_nulls("value")
    values = lines["value"].to_numpy()
    lowest, highest = min(float(values.min()), 0.0), max(float(values.max()), 0.0)
    low, high = min(usual[0], 0.0), max(usual[1], 0.0)
    room = _ROOM * (high - low)
    if room == 0.0 or highest - lowest <= _WIDEST_RATIO * (high - low):
        return lowest, highest, None
    low, high = max(low - room, lowest), min(high + room, highest)
    furthest = int(np.argmax(np.maximum(values - high, low - values)))
    return low, high, (float(values[furthest]), float(lines["t"][furthest]))


def round_up(value: float) -> float:
    """Round up to two significant digits, for example 1.53 to 1.6."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / unit - 1e-9) * unit:.12g}")


# Common style of all figures: colours, type, axes.
#
# The categorical colours follow Okabe and Ito (2008) and are distinguishable under the common colour
# blindnesses. The slip ramp is monotonous in lightness, so it also works in greyscale print. A figure is
# drawn in light colours; the page replaces each by its dark counterpart if the reader's system requests it.

MEASURED = "#1f2a33"
ON_COMMAND = "#0072b2"
ON_MEASURED = "#00916e"
MODEL = "#a8518a"
SLIP = "#c8501e"
DRIVETRAIN = "#5b86b8"
GROUND = "#a8763e"
CROSS = "#8b949c"
INK = "#38424b"
QUIET = "#6b757e"
GRID = "#e6e9ec"
SHADE = "#eceff1"
SUSPECT = "#f8ddd6"
MARK = "#00b3d6"
PAPER = "#ffffff"

SLIP_RAMP = ("#b3c3cc", "#e2ad52", "#d06a30", "#9c2439", "#4a1035")

INPUT_COLOURS = MappingProxyType({"command": ON_COMMAND, "measured": ON_MEASURED})

DARK_TWINS = MappingProxyType(
    {
        MEASURED: "#eef2f5",
        ON_COMMAND: "#58b4ec",
        ON_MEASURED: "#2fc59b",
        MODEL: "#e39bca",
        SLIP: "#f2813f",
        DRIVETRAIN: "#7da7d9",
        GROUND: "#d0a066",
        CROSS: "#8f9aa4",
        INK: "#c9d1d8",
        QUIET: "#95a0aa",
        GRID: "#2a3138",
        SHADE: "#20262c",
        SUSPECT: "#43252a",
        MARK: "#3fd5f2",
        PAPER: "#14181c",
        SLIP_RAMP[0]: "#46535d",
        SLIP_RAMP[1]: "#90492f",
        SLIP_RAMP[2]: "#d66c30",
        SLIP_RAMP[3]: "#f0b050",
        SLIP_RAMP[4]: "#fff0c8",
    }
)

_FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', 'DejaVu Sans', Arial, sans-serif"


def chart_config() -> dict[str, object]:
    """Common Vega-Lite configuration of all figures, in light colours."""
    axis = {
        "domain": False,
        "grid": True,
        "gridColor": GRID,
        "labelColor": QUIET,
        "labelFontSize": 11,
        "labelPadding": 6,
        "labelSeparation": 5,
        "labelFlush": False,
        "tickCount": 6,
        "ticks": False,
        "titleColor": INK,
        "titleFontSize": 11.5,
        "titleFontWeight": 500,
        "titlePadding": 10,
    }
    legend = {
        "labelColor": INK,
        "labelFontSize": 11.5,
        "labelLimit": 260,
        "orient": "top",
        "padding": 0,
        "symbolStrokeWidth": 2.5,
        "titleColor": INK,
        "titleFontSize": 11.5,
        "titleFontWeight": 500,
        "titleLimit": 400,
        "offset": 12,
    }
    return {
        "background": "transparent",
        "font": _FONT,
        # Prints "56 %" as in sentences; Vega needs the complete locale.
        "locale": {
            "number": {
                "decimal": ".",
                "thousands": ",",
                "grouping": [3],
                "currency": ["", ""],
                "percent": "\u202f%",
            }
        },
        "axis": axis,
        "legend": legend,
        "view": {"stroke": None},
        "line": {"strokeWidth": 1.2, "strokeJoin": "round", "strokeCap": "round"},
        "title": {
            "anchor": "start",
            "color": INK,
            "fontSize": 11.5,
            "fontWeight": 500,
            "frame": "group",
            "subtitleColor": QUIET,
            "subtitleFontSize": 11,
            "subtitlePadding": 3,
            "offset": 8,
        },
        "rule": {"color": QUIET},
        "text": {"color": INK, "fontSize": 11.5},
        "concat": {"spacing": 18},
    }


_DIGITS = 4

Columns = dict[str, object]


def build_spec(drawing: Drawing) -> dict[str, object]:
    """Vega-Lite specification of a drawing in light colours, without its rows."""
    return {"$schema": SCHEMA, **drawing.chart, "config": chart_config()}


def fill_spec(drawing: Drawing) -> dict[str, object]:
    """Specification including its rows, for a single picture."""
    rows = {name: _round_floats(frame).to_dicts() for name, frame in drawing.rows.items()}
    spec = {**build_spec(drawing), "datasets": rows, "background": PAPER, "padding": 12}
    spec.pop("usermeta", None)
    return spec


def share_rows(drawings: Iterable[Drawing]) -> dict[str, Columns]:
    """Rows of all drawings, each name once, as `pack_rows` has them."""
    return pack_rows({name: frame for drawing in drawings for name, frame in drawing.rows.items()})


def pack_rows(frames: Mapping[str, pl.DataFrame]) -> dict[str, Columns]:
    """Rows by name as columns; texts are encoded as indices into a list of levels.

    Returns:
        By name, columns: a list of numbers, or ``{"levels": [...], "codes": [...]}`` for texts.
    """
    packed: dict[str, Columns] = {}
    for name, frame in sorted(frames.items()):
        columns = packed[name] = {}
        for column in _round_floats(frame).iter_columns():
            columns[column.name] = column.to_list()
            if column.dtype == pl.String:
                levels = column.unique(maintain_order=True)
                codes = column.replace_strict(levels, list(range(levels.len())), return_dtype=pl.Int64)
                columns[column.name] = {"levels": levels.to_list(), "codes": codes.to_list()}
    return packed


def _round_floats(frame: pl.DataFrame) -> pl.DataFrame:
    return frame.with_columns(pl.col(pl.Float64, pl.Float32).round(_DIGITS) + 0.0)


# Drawing JavaScript: Vega, Vega-Lite and Vega-Embed, from the Python package that contains them.
#
# Bundling takes most of a second and always gives the same text, so it is cached in the user's cache folder.
# A missing, damaged or read-only cache only costs that second.

_EXPOSE = "window.vegaEmbed = vegaEmbed;"


def load_bundle() -> str:
    """Script that defines ``vegaEmbed`` on the window, suitable for a script element."""
    require_package("vl_convert", "", "a page with figures")
    path = cache_path()
    with contextlib.suppress(OSError):
        digest, _, body = path.read_bytes().partition(b"\n")
        if hashlib.sha256(body).hexdigest().encode() == digest:
            return body.decode()
    import vl_convert  # noqa: PLC0415 - starting its JavaScript engine is what the cache avoids

    script: str = vl_convert.javascript_bundle(_EXPOSE)
    # A closing tag inside a string literal would end the script element.
    script = script.replace("</script", "<\\/script").replace("<!--", "<\\!--")
    body = script.encode()
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, hashlib.sha256(body).hexdigest().encode() + b"\n" + body, durable=False)
    return script


def can_draw() -> bool:
    """Whether the package that draws figures is installed."""
    return find_spec("vl_convert") is not None


def warm_bundle() -> None:
    """Bundle in a separate process, so that it overlaps with reading the log.

    The bundler holds the interpreter lock while it works, so a thread would not help. Returns immediately;
    does nothing if the cache is filled or cannot be written, or without the bundler.
    """
    if not can_draw():
        return
    path = cache_path()
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
    if not path.is_file() and os.access(path.parent, os.W_OK):
        threading.Thread(target=_bundle_apart, name="bundle", daemon=True).start()


def _bundle_apart() -> None:
    with contextlib.suppress(OSError):
        subprocess.run(  # noqa: S603 - our own words
            python_command("-c", "from pipeline.report.theme import load_bundle; load_bundle()"),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            check=False,
        )


def cache_path() -> Path:
    """Cache path of the bundle of the installed version."""
    what = hashlib.sha256(_EXPOSE.encode()).hexdigest()[:8]
    return find_cache_folder() / f"vega-{version('vl-convert-python')}-{what}.js"


@dataclass(frozen=True)
class Drawing:
    """Figure of one run.

    Attributes:
        chart: chart that refers to rows by name.
        rows: rows by the name used in the chart; the same name means the same rows in every figure.
        note: remark on the interpretation, for example on omitted points; may be empty.
        words: the same in a sentence or two, as alternative text.
    """

    chart: Chart
    rows: Mapping[str, pl.DataFrame]
    note: str = ""
    words: str = ""
