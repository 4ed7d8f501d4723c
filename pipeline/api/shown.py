"""What a notebook shows: rungs and numbers as tables, small HTML."""

from collections.abc import Mapping, Sequence
from html import escape

import polars as pl

from pipeline.report.run import number_in, objects_in

_ERRORS = ("t_mrmse_m", "r_mrmse_rad", "explained_share")
_DIGITS = 4


def tabulate_ladder(content: Mapping[str, object]) -> pl.DataFrame:
    """Rungs: what each adds, and the held-out errors over 2 s [m], [rad] with it."""
    rows, before = [], set[str]()
    for rung in objects_in(content, "ladder"):
        effects = rung.get("effects")
        names = [str(name) for name in effects] if isinstance(effects, list | tuple) else []
        added = ", ".join(name for name in names if name not in before)
        rows.append({"added": added or "ideal", **{key: number_in(rung, key) for key in _ERRORS}})
        before |= set(names)
    return pl.DataFrame(rows, schema={"added": pl.String, **dict.fromkeys(_ERRORS, pl.Float64)})


def tabulate_parameters(numbers: Mapping[str, Mapping[str, object]]) -> pl.DataFrame:
    """Numbers by ``effect.parameter``: value, 95 % interval (null without one), unit."""
    rows = [
        {
            "parameter": label,
            **{key: number_in(number, key) for key in ("value", "low", "high")},
            "unit": str(number.get("unit", "1")),
        }
        for label, number in numbers.items()
    ]
    values = dict.fromkeys(("value", "low", "high"), pl.Float64)
    return pl.DataFrame(rows, schema={"parameter": pl.String, **values, "unit": pl.String})


def write_html(title: str, frame: pl.DataFrame, notes: Sequence[str] = ()) -> str:
    """A small table with a title and lines below it; whatever stands in it is text, never markup."""
    head = "".join(f"<th>{escape(name)}</th>" for name in frame.columns)
    body = "".join(
        f"<tr>{''.join(f'<td>{escape(_say(value))}</td>' for value in row)}</tr>" for row in frame.rows()
    )
    lines = "".join(f"<div>{escape(note)}</div>" for note in notes)
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>" if frame.height else ""
    return f"<div><b>{escape(title)}</b>{table}{lines}</div>"


def _say(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.{_DIGITS}g}" if isinstance(value, float) else str(value)
