"""Export of the effects of a model as a table for LaTeX."""

import math
import re

from pipeline.core import make_plain, split_interval
from pipeline.export import Facts, Target, quote_name
from pipeline.models import ModelFile, Number, name_term

_SPECIAL = str.maketrans(
    {
        **{sign: f"\\{sign}" for sign in "&%$#_{}"},
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
    }
)
_HEAD = ("Effect", "Parameter", "Value", r"95\,\% interval", "Unit")


def write_tabular(file: ModelFile) -> str:
    """The effects with values, 95 % intervals and units as a `tabular`; a letter marks a value in doubt.

    It needs no package. Where each value comes from stands in the comments above it.
    """
    facts, own = Facts(file), file.list_own()
    name = quote_name(facts.vehicle.name)
    about = [f"{name}: {LATEX.about}.", *facts.list_origin(), facts.vehicle.format_unknown()]
    comments = [*filter(None, about), *(f"  {line}" for line in facts.list_sources())]
    marks = dict[str, str]()
    rows = [
        [
            _escape(name_term(effect.id)),
            rf"{_escape(parameter.about)}, \texttt{{{_escape(parameter.name)}}}{run and f', {_escape(run)}'}",
            *_format_value(number, marks),
            re.sub(r"\\textasciicircum\{\}(\d+)", r"\\textsuperscript{\1}", _escape(number.unit))
            if number.unit != "1"
            else "",
        ]
        for effect in file.model
        for parameter in effect.parameters
        if effect.is_used(parameter)
        for run, number in own.get(
            f"{effect.id}.{parameter.name}", {"": file.find_number(effect, parameter)}
        ).items()
    ]
    notes = [
        rf"\multicolumn{{{len(_HEAD)}}}{{l}}{{\textsuperscript{{{mark}}} {_escape(reason)}}} \\"
        for reason, mark in marks.items()
    ]
    lines = [rf"{' & '.join(row)} \\" for row in rows]
    table = [r"\begin{tabular}{llrll}", r"\hline", rf"{' & '.join(_HEAD)} \\", r"\hline", *lines, r"\hline"]
    return "\n".join([*(f"% {make_plain(line)}" for line in comments), *table, *notes, r"\end{tabular}", ""])


def _format_value(number: Number, marks: dict[str, str]) -> tuple[str, str]:
    """A value with the digits that its interval supports, and the interval; notes the mark of its doubt."""
    if not math.isfinite(number.value):
        return "--", "--"
    mark = ""
    if number.doubt:
        letter = marks.setdefault(number.reason, chr(ord("a") + len(marks)))
        mark = rf"\textsuperscript{{{letter}}}"
    if not math.isfinite(number.high - number.low):
        return f"${number.value:.4g}${mark}", "--"
    value, low, high = split_interval(number.value, number.low, number.high)
    return f"${value}${mark}", f"${low}$ to ${high}$"


def _escape(text: str) -> str:
    return make_plain(text).translate(_SPECIAL)


LATEX = Target(
    "latex",
    "a table of the effects with values, 95 % intervals and units",
    "the handbook, Give the answer to a controller",
    write_file=write_tabular,
    takes_doubtful=True,
)
