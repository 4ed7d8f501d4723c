"""One look for every figure: colours, type, axes.

The categorical colours follow Okabe and Ito (2008) and stay apart under the common colour blindnesses; the
ramp of slip is monotonous in lightness, so that it also survives a grey print. A figure is drawn in the light
colours; the page exchanges each for its dark twin where the reader's system asks for it.
"""

from types import MappingProxyType

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
    """The Vega-Lite configuration that every figure shares, in the light colours."""
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
