"""`slip stage`: one stage alone, from the stored tables of the one before."""

from dataclasses import replace
from typing import Annotated, Literal

from cyclopts import Parameter

from pipeline.cli.choices import Choices, build_options
from pipeline.cli.output import CLEAN, LOSSY, print_result, show_progress


def stage(  # noqa: D417 - the shared choices document themselves
    name: Literal["extract", "align", "velocity", "slip", "aggregate"],
    log: Annotated[str, Parameter(help="a log, or the name of a run that has results")],
    /,
    *,
    choices: Annotated[Choices, Parameter(name="*")] = Choices(),  # noqa: B008 - frozen
    force: bool = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Run one stage of a log; stages before it are reused where nothing changed.

    Args:
        name: the stage.
        force: compute again what is already there.
        json: print one JSON object.
        quiet: print nothing.
    """
    from pipeline.analysis.analyze import analyze_log  # noqa: PLC0415 - heavy
    from pipeline.analysis.lookup import find_log  # noqa: PLC0415 - heavy

    options = replace(build_options(choices), force=force, through=name)
    path = find_log(log, options.out)
    with show_progress(path.name, quiet=quiet or json) as progress:
        outcome = analyze_log(path, options, progress)
    tables = {table: entry.rows for table, entry in sorted(outcome.manifest.tables.items())}
    content = {"run": outcome.manifest.run, "computed": list(outcome.computed), "rows": tables}
    done = ", ".join(outcome.computed) or "nothing: all is as before"
    lines = [f"run       {outcome.manifest.run}", f"computed  {done}"]
    lines += [f"  {table:<12}{rows:>9} rows" for table, rows in tables.items()]
    print_result(content, lambda: [*lines, f"in        {outcome.manifest.folder}"], json=json, quiet=quiet)
    return LOSSY if outcome.lossy else CLEAN
