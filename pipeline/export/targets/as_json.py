"""The whole model as one JSON object."""

import json
import math

from pipeline.core.numbers import finite_or_none, pick
from pipeline.export.target import Current, Target
from pipeline.models.formula.formula_effect import FormulaEffect
from pipeline.models.model_file import ModelFile

_GEOMETRY = ("wheel_radius_m", "track_width_m", "wheelbase_m", "controller_track_multiplier")


def write(file: ModelFile, current: Current) -> str:
    """The model with values, intervals and units; numbers that are not finite are null."""
    vehicle = file.model.vehicle
    effects = []
    for effect in file.model:
        parameters = {}
        for parameter in effect.parameters:
            low, high = file.intervals.get(f"{effect.id}.{parameter.name}", (math.nan, math.nan))
            numbers = {"value": effect.values[parameter.name], "low": low, "high": high}
            parameters[parameter.name] = {
                **{key: finite_or_none(number) for key, number in numbers.items()},
                "unit": parameter.unit,
            }
        item: dict[str, object] = {
            "id": effect.id,
            "place": effect.place.name.lower(),
            "parameters": parameters,
        }
        if isinstance(effect, FormulaEffect):
            item["formulas"] = effect.formulas
        effects.append(item)
    content = {
        "vehicle": pick(vehicle, "id", "kind", *_GEOMETRY),
        "effects": effects,
        "fit": _plain(file.fit),
        **({"warnings": list(file.warnings)} if file.warnings else {}),
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _plain(value: object) -> object:
    """A value as JSON can hold it."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


TARGET = Target("json", "the model with values, intervals and units", "the handbook, Models", write)
