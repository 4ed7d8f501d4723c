"""`slip trend`: what changed over the runs of a vehicle."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.types import NonNegativeFloat

from pipeline.cli.choices import KeyFile, use_key
from pipeline.cli.output import CLEAN, print_result
from pipeline.core.errors import SlipError

if TYPE_CHECKING:
    from pipeline.fleet.trend import Trend

ALERT = 4


def trend(  # noqa: D417 - arguments document themselves
    results: Annotated[Path, Parameter(help="results folder")] = Path("results"),
    /,
    *,
    by: Annotated[
        str, Parameter(help="whose slip and health: dataset, vehicle, terrain, or several of them")
    ] = "dataset",
    threshold: Annotated[
        NonNegativeFloat, Parameter(help="relative change of slip that raises an alert")
    ] = 0.1,
    limit: Annotated[
        tuple[str, ...], Parameter(help="QUANTITY=VALUE, an alert where the last run is above", negative="")
    ] = (),
    out: Annotated[Path | None, Parameter(help="the same as RESULTS")] = None,
    key: KeyFile = None,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Follow slip, fitted parameters and data health over dates; exit code 4 when something moved.

    Writes trend.html and trend.json, which a batch keeps up to date. Parameters are followed by vehicle,
    whatever ground its runs were on, from four runs on; a change counts where it is more than chance allows
    and worth a name. Slip and health take eight runs and the threshold. What moved with a parameter is told
    with it.

    Args:
        json: print one JSON object.
        quiet: print nothing.
    """
    from pipeline.analysis.trend import describe_trend, follow_trend, write_trend  # noqa: PLC0415 - heavy
    from pipeline.store import Store  # noqa: PLC0415 - heavy

    if not math.isfinite(threshold):
        raise SlipError("bad_limit", f"{threshold} is no threshold", hint="Write --threshold 0.1 for a tenth")
    use_key(key)
    store = Store(out or results)
    names = tuple(name.strip() for name in by.split(",") if name.strip())
    found = follow_trend(store, names, threshold=threshold, limits=dict(map(_read_limit, limit)))
    page = write_trend(store, found)
    print_result(
        {**describe_trend(found), "page": str(page)}, lambda: _describe(found, page), json=json, quiet=quiet
    )
    return ALERT if found.alerts else CLEAN


def _read_limit(text: str) -> tuple[str, float]:
    name, _, value = text.rpartition("=")
    try:
        limit = float(value)
    except ValueError:
        limit = math.nan
    if not math.isfinite(limit):
        raise SlipError(
            "bad_limit", f"{text!r} is no limit", hint="Write --limit QUANTITY=VALUE, as median_modulus=1.2"
        )
    return name.strip() or text, limit


def _describe(found: Trend, page: Path) -> list[str]:
    from pipeline.fleet.parameter_trend import say_power  # noqa: PLC0415 - heavy
    from pipeline.fleet.trend import describe_quiet  # noqa: PLC0415 - heavy

    quiet = describe_quiet(found.series, found.parameters)
    lines = [f"!! {alert.text}" for alert in found.alerts] or [quiet]
    # What could not be tested is in the notes.
    for one in (one for one in found.parameters if not one.need):
        unit = "" if one.unit == "1" else f" {one.unit}"
        label = f"{one.vehicle} {one.label}"
        runs = one.points.height
        lines.append(
            f"{label:<34}{runs:>4} run{'s' * (runs != 1):<2} latest {one.latest:.3g}{unit}, {say_power(one)}"
        )
    for group in dict.fromkeys(one.group for one in found.series):
        own = [one for one in found.series if one.group == group]
        slip = next((one for one in own if one.quantity.startswith("median_modulus")), own[0])
        runs = slip.points.height
        latest = f"{slip.quantity} latest {slip.latest:.3g} {slip.unit}"
        lines.append(f"{group:<34}{runs:>4} run{'s' * (runs != 1):<2} {latest}")
    return [*lines, *(f"! {note}" for note in found.notes), f"page    {page}"]
