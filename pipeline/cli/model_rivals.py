"""Models of the literature: their list, their pages, and runs on which they are compared."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from pipeline.cli.conventions import CLEAN, print_json, print_lines, print_note, print_result
from pipeline.cli.model_runs import gather_runs
from pipeline.core.program import INPUT_WORDS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.cli.verb_model import On
    from pipeline.models.literature import LiteratureModel
    from pipeline.models.model_file import ModelFile

Against = Annotated[
    list[Literal["literature", "learned"]] | None,
    Parameter(
        help="compare with models of the literature, or with learned ones (the extra learn)",
        consume_multiple=True,
    ),
]


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
    return print_result(_as_json(model), lambda: _format_model(model), json=json)


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
    count = f"{number} number{'s' * (number != 1)}"
    return f"{model.name:<28} {count:<14} {model.title}"


def _format_model(model: LiteratureModel) -> list[str]:
    lines = [f"{model.name}: {model.title}", "", *(f"    {formula}" for formula in model.formula), ""]
    lines += [f"vehicles  {', '.join(model.kinds)}"]
    lines += [f"needs     {model.needs}"] if model.needs else []
    lines += [f"numbers   {model.count_numbers()}"]
    lines += [f"effects   {', '.join(model.effects)}"] if model.effects else []
    lines += [f"formula   {channel} += {text}" for channel, text in model.terms.items()]
    source = f"{model.source}, {model.link}" if model.link else model.source
    return [*lines, f"source    {source}"]


def compare_rivals(
    files: Mapping[str, ModelFile], spoken: On, against: list[Literal["literature", "learned"]]
) -> int:
    """Fit models, those of the literature and learned ones to runs, and print their held-out errors.

    Args:
        files: models by the name of their file; may be empty.
        spoken: the runs, and how the answer is printed.
        against: what they are compared with.
    """
    from pipeline.job.model_contest import contest_models  # noqa: PLC0415 - heavy
    from pipeline.models.literature import list_models  # noqa: PLC0415 - heavy

    quiet = spoken.quiet or spoken.json
    known = next((file.model.vehicle for file in files.values()), None)
    vehicle, runs = gather_runs(spoken.on, known, spoken.vehicle_of, spoken.results, quiet=quiet)
    contest = contest_models(files, runs, vehicle, against, spoken.input)
    warnings = [text for file in files.values() for text in file.warnings]
    warnings += [contest.chosen.warning] if contest.chosen.warning else []
    if "literature" in against and len(list_models(vehicle)) == 1:
        warnings.append(
            f"no model of the literature but the ideal one describes a {vehicle.kind} vehicle: "
            "`slip model literature` lists each model with its vehicles"
        )
    if spoken.json:
        print_json({**contest.to_json(), "warnings": warnings})
    elif not spoken.quiet:
        words = INPUT_WORDS[contest.chosen.source.value]
        print_lines(
            [f"{words} of {', '.join(contest.runs)} ({contest.chosen.reason})", *contest.format_lines()]
        )
        for text in warnings:
            print_note(f"slip: {text}")
    return CLEAN
