"""`slip verify`: hash results and logs again."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from pipeline.cli.output import CLEAN, FAILED, print_result, show_progress
from pipeline.cli.results_place import open_results

if TYPE_CHECKING:
    from pipeline.batch.verification import Verification


def verify(  # noqa: D417 - arguments document themselves
    results: Annotated[Path | None, Parameter(help="results folder (default: results)")] = None,
    /,
    *,
    out: Annotated[Path, Parameter(show=False)] = Path("results"),
    logs: bool = True,
    repair: Annotated[bool, Parameter(negative=())] = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Check that results, and the logs they were made of, are still what they were.

    Args:
        logs: read the logs, too.
        repair: say what can be made again, and have it made by the next batch over its log.
        json: print one JSON object.
        quiet: print nothing.
    """
    from pipeline.batch.verification import verify_results  # noqa: PLC0415 - only for this verb

    place = open_results(results or out)
    with show_progress("verify", quiet=quiet or json) as tell:
        found = verify_results(place.open_store(), mirror=place.mirror, logs=logs, tell=tell, repair=repair)
    print_result(_as_json(found, repair=repair), lambda: _describe(found), json=json, quiet=quiet)
    return CLEAN if found.is_clean else FAILED


def _as_json(found: Verification, *, repair: bool) -> dict[str, object]:
    files, logs, gone = (
        [
            {"run": problem.run, "path": str(problem.path), "code": problem.code, "message": problem.what}
            for problem in problems
        ]
        for problems in (found.files, found.logs, found.gone)
    )
    answer = {
        "runs": found.checked,
        "files": files,
        "logs": logs,
        "gone": gone,
        "unlisted": list(found.unlisted),
    }
    return answer | ({"repairs": [asdict(each) for each in found.repairs]} if repair else {})


def _describe(found: Verification) -> list[str]:
    lines = [f"{found.checked} runs looked at"]
    lines += [f"damaged  {problem.path}: {problem.what}" for problem in found.files]
    lines += [f"log      {problem.path}: {problem.what} ({problem.run})" for problem in found.logs]
    lines += [f"gone     {problem.path} ({problem.run})" for problem in found.gone]
    lines += [f"{each.action:<8} {each.subject}: {each.what}" for each in found.repairs]
    if found.unlisted and not found.repairs:
        lines.append(
            f"{len(found.unlisted)} files were written before there was a list of them: "
            "`slip verify --repair` puts them on it."
        )
    if found.is_clean:
        lines.append("all is as it was written")
    else:
        again = (
            "`slip batch` over those logs makes it again"
            if any(each.action == "queued" for each in found.repairs)
            else "`slip verify --repair` has the next batch over its log make again what can be"
        )
        lines += [f"{again}."] if found.files else []
        lines += ["Copy changed logs from their origin."] if found.logs else []
    return lines
