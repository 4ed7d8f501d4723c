"""`slip predict`: what to expect of a vehicle on a terrain before driving there."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, cast

from cyclopts import Parameter

from pipeline.cli.output import print_result

_LABEL = 26
_WORDS = (
    ("median_modulus", "slip, median modulus", "m/s"),
    ("t_mrmse_m", "error over 2 s", "m"),
    ("ideal_t_mrmse_m", "of the ideal model", "m"),
)


def predict(
    *,
    vehicle: Annotated[str, Parameter(help="vehicle preset, for example warthog")],
    terrain: Annotated[str, Parameter(help="terrain to drive on, for example ice")],
    known: Path = Path("results"),
    input: Literal["command", "measured"] = "command",  # noqa: A002 - the word of the other verbs
    model: Path | None = None,
    out: Annotated[Path | None, Parameter(help="the same as --known")] = None,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Say what to expect of a vehicle on a terrain: its model, slip, and error over 2 s, with intervals.

    Intervals hold 95 of 100 runs that may come. A terrain on which the vehicle never drove is one like the
    others it has driven on.

    Args:
        vehicle: vehicle preset, for example warthog.
        terrain: terrain to drive on, for example ice.
        known: results folder with diagnosed runs of the vehicle.
        input: what the model is fed with.
        model: model file to write.
        out: the same as --known.
        json: print one JSON object.
        quiet: print nothing.
    """
    from pipeline.analysis import prediction as predictions  # noqa: PLC0415
    from pipeline.analysis.fleet import find_estimates  # noqa: PLC0415 - heavy
    from pipeline.fleet.forecast import forecast_vehicle  # noqa: PLC0415
    from pipeline.models.model_text import write_model  # noqa: PLC0415
    from pipeline.store import Store  # noqa: PLC0415

    store = Store(out or known)
    forecast = forecast_vehicle(find_estimates(store), vehicle, terrain, input)
    prediction = predictions.predict_deployment(store, forecast)
    if model is not None:
        write_model(predictions.make_model_file(prediction), model)
    told = predictions.describe_prediction(prediction)
    content = {**told, "model": None if model is None else str(model)}
    return print_result(content, lambda: _describe(content), json=json, quiet=quiet)


def _describe(content: Mapping[str, object]) -> list[str]:
    here, elsewhere = content["runs_on_terrain"], content["runs_elsewhere"]
    there = f"{here} run{'s' * (here != 1)} there, {elsewhere} elsewhere"
    lines = [f"{content['vehicle']} on {content['terrain']}: {there}"]
    for effect in cast("Sequence[Mapping[str, object]]", content["effects"]):
        parameters = cast("Mapping[str, Mapping[str, object]]", effect["parameters"])
        lines += [
            f"  {effect['id']}.{name}".ljust(_LABEL + 2) + _bound(number, str(number["unit"]))
            for name, number in parameters.items()
        ]
    if not content["effects"]:
        lines.append("  the ideal model: most runs name no effect")
    lines += [
        f"{words:<{_LABEL + 2}}{_bound(cast('Mapping[str, object]', content[key]), unit)}"
        for key, words, unit in _WORDS
    ]
    return lines if content["model"] is None else [*lines, f"written: {content['model']}"]


def _bound(number: Mapping[str, object], unit: str) -> str:
    shown = f"{number['value']:.3g}" + ("" if unit == "1" else f" {unit}")
    cut = " (at its bound)" if number.get("at_bound") else ""
    return f"{shown} [{number['low']:.3g}, {number['high']:.3g}]{cut}"
