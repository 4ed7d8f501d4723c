"""Export of a model as JSON."""

import json
import math
from collections.abc import Mapping
from datetime import date, time
from types import MappingProxyType

from pipeline.core import pick
from pipeline.export import Target
from pipeline.models import FormulaEffect, ModelFile, Number

_GEOMETRY = ("wheel_radius_m", "track_width_m", "wheelbase_m", "controller_track_multiplier")


def write_json_object(file: ModelFile) -> str:
    """Write the model without the values in doubt, which are listed with their reasons."""
    return dump_model(file, file.list_doubtful())


def dump_model(file: ModelFile, omitted: Mapping[str, Number] = MappingProxyType({})) -> str:
    """The model as JSON with values, intervals and units; numbers that are not finite become null.

    Args:
        file: the model.
        omitted: the values in doubt to leave out, by label.
    """
    vehicle = file.model.vehicle
    effects, numbers = [], file.list_numbers()
    for effect in file.model:
        labels = {parameter.name: f"{effect.id}.{parameter.name}" for parameter in effect.parameters}
        parameters = {
            name: numbers[label].to_json() for name, label in labels.items() if label not in omitted
        }
        item: dict[str, object] = {
            "id": effect.id,
            "place": effect.place.name.lower(),
            "parameters": parameters,
        }
        if isinstance(effect, FormulaEffect):
            item["formulas"] = effect.formulas
        effects.append(item)
    stand_ins = pick(vehicle, *vehicle.stand_ins)
    warnings = list(filter(None, [vehicle.format_unknown()]))
    content = {
        "vehicle": {
            **pick(vehicle, "id", "name", "kind", *_GEOMETRY),
            **dict.fromkeys(stand_ins),
            **({"stand_ins": stand_ins} if stand_ins else {}),
        },
        "effects": effects,
        "fit": _plain(file.fit),
        **({"omitted": {label: number.reason for label, number in omitted.items()}} if omitted else {}),
        **({"warnings": warnings} if warnings else {}),
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _plain(value: object) -> object:
    """Value in a form that JSON can represent."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value.isoformat() if isinstance(value, date | time) else value


JSON_OBJECT = Target(
    "json",
    "the model with values, intervals and units",
    "the handbook, Models",
    write_file=write_json_object,
)
