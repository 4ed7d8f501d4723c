"""Models of the literature on the command line: their list and their pages."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.cli.conventions import print_result

if TYPE_CHECKING:
    from pipeline.models.literature import LiteratureModel


def literature(name: str | None = None, /, *, json: bool = False) -> int:
    """List motion models of the literature, or show one.

    `slip model new FILE --from NAME` makes a model file of it.

    Args:
        name: of a model.
        json: print one JSON object.
    """
    from pipeline.models.literature import MODELS, find_model  # noqa: PLC0415 - heavy

    if name is None:
        rows = [_list_model(model) for model in MODELS]
        return print_result({"models": [_as_json(model) for model in MODELS]}, lambda: rows, json=json)
    model = find_model(name)
    return print_result(_as_json(model), lambda: _describe_model(model), json=json)


def _as_json(model: LiteratureModel) -> dict[str, object]:
    return {
        "name": model.name,
        "title": model.title,
        "formula": list(model.formula),
        "source": model.source,
        "link": model.link,
        "kinds": list(model.kinds),
        "numbers": model.count_numbers(),
        "effects": list(model.effects),
        "terms": dict(model.terms),
        "needs": model.needs,
    }


def _list_model(model: LiteratureModel) -> str:
    number = model.count_numbers()
    count = f"{number} number{'s' * (number != 1)}" if not model.needs else "not available"
    return f"{model.name:<28} {count:<14} {model.title}"


def _describe_model(model: LiteratureModel) -> list[str]:
    lines = [f"{model.name}: {model.title}", "", *(f"    {formula}" for formula in model.formula), ""]
    lines += [f"vehicles  {', '.join(model.kinds)}"]
    if model.needs:
        lines += [f"not available: it needs {model.needs}"]
    else:
        lines += [f"numbers   {model.count_numbers()}"]
        lines += [f"effects   {', '.join(model.effects)}"] if model.effects else []
        lines += [f"formula   {channel} += {text}" for channel, text in model.terms.items()]
    source = f"{model.source}, {model.link}" if model.link else model.source
    return [*lines, f"source    {source}"]
