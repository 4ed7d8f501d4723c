"""The catalogue of effects as pages: what the effects' own files say, and nothing else."""

import functools
import math
from collections.abc import Iterable

from pipeline.export import export_model, list_targets
from pipeline.models import find_effect, list_effects
from pipeline.models.effect import Effect, Place
from pipeline.models.model import Model
from pipeline.models.model_file import ModelFile
from pipeline.models.parameter import Parameter
from pipeline.run import MotionError
from pipeline.sources import Vehicle, list_presets

FOLDER = "effects"
_PLACES = {
    Place.COMMAND: "On the command, before the wheels",
    Place.DRIVE: "Between command and wheels",
    Place.KINEMATICS: "Between wheels and body",
    Place.BODY: "The body itself",
    Place.GROUND: "On the ground",
    Place.CENTRE: "The centre of rotation",
    Place.LOCALIZATION: "In the localization",
}


def write_effect_pages() -> dict[str, str]:
    """Pages by path: the list, and one page an effect."""
    pages = {f"{FOLDER}/{kind.id}.md": _write_page(kind) for kind in list_effects()}
    return {f"{FOLDER}/index.md": _write_list(), **pages}


def escape(text: str) -> str:
    """Text as Markdown shows it, character by character."""
    for sign in "\\*<|[]":
        text = text.replace(sign, f"\\{sign}")
    return text


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table; empty where there are no rows."""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    names = list(head)
    return "\n".join(["| " + " | ".join(names) + " |", "|" + " --- |" * len(names), *lines]) if lines else ""


def _vehicle_of(kind: type[Effect]) -> Vehicle:
    wanted = "ackermann_car" if kind.kinds == ("ackermann",) else "husky_a200"
    return next(vehicle for vehicle in list_presets() if vehicle.id == wanted)


def _usual(kind: type[Effect]) -> Effect:
    return kind().change(**{p.name: p.typical for p in kind.parameters if not p.instead_of})


def _write_list() -> str:
    parts = [
        "# Catalogue of effects",
        (
            f"Physical effects that the ideal model lacks, {len(list_effects())} in all, in the order in "
            "which a command meets them. Each is shown here at the typical size of its "
            "parameters; its page has formula, parameters, source, and similar effects. `slip effects` "
            "prints the same on a terminal."
        ),
    ]
    for place, title in _PLACES.items():
        rows = [
            (f"[{kind.id}]({kind.id}.md)", escape(_usual(kind).describe_motion(_vehicle_of(kind))))
            for kind in list_effects()
            if kind.place is place
        ]
        parts += [f"## {title}", table(("effect", "at its typical size"), rows)]
    return "\n\n".join(parts) + "\n"


def _write_page(kind: type[Effect]) -> str:
    page = kind.find_page()
    first, _, rest = page.partition("\n")
    title = first.partition(":")[0]
    vehicle = _vehicle_of(kind)
    said = escape(_usual(kind).describe_motion(vehicle))
    parts = [
        f"# {title}",
        f"`{kind.id}` · {escape(first.partition(': ')[2])}",
        "\n".join(
            line if line.startswith("    ") else escape(line) for line in rest.strip("\n").splitlines()
        ),
        f"At its typical size on {vehicle.name}: *{said}*.",
        "## Parameters",
        table(("name", "what it is", "unit", "bounds", "neutral", "typical"), map(_row, kind.parameters)),
        *_list_limits(kind),
        "## Excitation and similar effects",
        _list_facts(kind),
        *_describe_exports(kind),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _row(p: Parameter) -> tuple[str, ...]:
    low, high = p.bounds
    neutral = "-" if math.isnan(p.neutral) else f"{p.neutral:g}"
    return (f"`{p.name}`", escape(p.about), p.unit, f"{low:g} to {high:g}", neutral, f"{p.typical:g}")


def _list_limits(kind: type[Effect]) -> list[str]:
    lines = []
    for p in kind.parameters:
        if p.plausible:
            lines.append(
                f"- `{p.name}` has an observed range of {p.plausible.low:g} to {p.plausible.high:g}: "
                f"{escape(p.plausible.source)}. Outside of it the effect is reported only "
                "as tentative, where nothing else halves the error."
            )
        if p.least:
            lines.append(
                f"- `{p.name}` within {p.least.size:g} of neutral is below the detection threshold: "
                f"{escape(p.least.reason)}."
            )
    return ["\n".join(lines)]


def _list_facts(kind: type[Effect]) -> str:
    def link(ids: Iterable[str]) -> str:
        return ", ".join(f"[{each}]({each}.md)" for each in ids if find_effect(each))

    facts = [
        ("acts", _PLACES[kind.place].lower()),
        ("exists on", ", ".join(kind.kinds)),
        ("shown by", "; ".join(need.value for need in kind.needs)),
        ("looks like", link(kind.confused_with)),
        ("cannot be told from", link(kind.equivalent_to)),
        ("where", escape(kind.equivalent_when) if kind.equivalent_to else ""),
        ("in straight driving alone, or turning alone, the same as", link(kind.same_in_one_motion)),
        ("contains", link(kind.contains)),
    ]
    return "\n".join(f"- **{name}**: {text}" for name, text in facts if text)


def _describe_exports(kind: type[Effect]) -> list[str]:
    rows = [(f"`{name}`", ", ".join(f"`{each}`" for each in names)) for name, names in list_settings(kind)]
    shown = table(("`slip model export --to`", "what it changes"), rows)
    return ["## Parameters of controllers that take it", shown] if rows else []


@functools.cache
def list_settings(kind: type[Effect]) -> list[tuple[str, list[str]]]:
    """Targets with the settings that change or appear in their exports when a model has this effect."""
    vehicle, effect = _vehicle_of(kind), _usual(kind)
    found = []
    for target in list_targets():
        if target.name in {"json", "python"}:
            continue
        try:
            with_it = _read_settings(Model(vehicle, (effect,)), target.name, target.corrects)
            without = _read_settings(Model(vehicle), target.name, target.corrects)
        except MotionError:
            continue  # this target is not for this kind of vehicle
        names = [name for name, text in with_it.items() if without.get(name) != text]
        if names:
            found.append((target.name, names))
    return found


def _read_settings(model: Model, target: str, corrects: tuple[str, ...]) -> dict[str, str]:
    text = export_model(ModelFile(model), target, dict.fromkeys(corrects, 1.0) or None)
    found: dict[str, str] = {}
    for line in text.splitlines():
        bare = line.strip()
        if bare.startswith(("#", "<!--")) or not bare:
            continue
        name, sign, value = bare.replace("<", "").replace(">", "=").partition(":" if ":" in bare else "=")
        fields = bare.split("\t")
        if len(fields) > 3:  # noqa: PLR2004 - QGroundControl's columns: vehicle, component, name, value
            name, sign, value = fields[2], "=", fields[3]
        if sign and value.strip():
            found[name.strip()] = value.strip()
    return found
