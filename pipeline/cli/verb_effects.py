"""`slip effects`: the catalogue of physical effects, and the page of one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from pipeline.cli.output import print_result

if TYPE_CHECKING:
    from pipeline.models.effect import Effect


def effects(  # noqa: D417 - the arguments document themselves
    effect: Annotated[str | None, Parameter(help="id of an effect; without one, all are listed")] = None,
    /,
    *,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """List the physical effects, or print one's page: formula, parameters, source, twins, what shows it.

    Args:
        json: print one JSON object.
        quiet: print nothing but errors.
    """
    from pipeline.identification.describe import describe_effect, list_pages  # noqa: PLC0415 - heavy
    from pipeline.models.catalogue import find_effect, list_effects  # noqa: PLC0415 - heavy

    chosen = list_effects() if effect is None else (find_effect(effect),)
    pages = list_pages(chosen) if effect is None else [describe_effect(chosen[0])]
    content = {"effects": [_as_json(item) for item in chosen]}
    return print_result(content, lambda: "\n".join(pages).split("\n"), json=json, quiet=quiet)


def _as_json(effect: type[Effect]) -> dict[str, object]:
    from pipeline.identification.describe import describe_effect  # noqa: PLC0415 - heavy

    return {
        "id": effect.id,
        "place": effect.place.name.lower(),
        "kinds": list(effect.kinds),
        "parameters": [
            {"name": p.name, "unit": p.unit, "about": p.about, "typical": p.typical}
            for p in effect.parameters
        ],
        "needs": [need.value for need in effect.needs],
        "confused_with": list(effect.confused_with),
        "equivalent_to": list(effect.equivalent_to),
        "page": describe_effect(effect),
    }
