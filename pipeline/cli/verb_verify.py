"""`slip verify`: hash results and logs again."""

from __future__ import annotations

import re
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from pipeline.cli.choices import KeyFile, use_key
from pipeline.cli.output import CLEAN, FAILED, print_result, show_progress
from pipeline.cli.results_place import open_results
from pipeline.core.errors import SlipError

if TYPE_CHECKING:
    from pipeline.batch.verification import Verification
    from pipeline.store.sampling import Sample


def verify(  # noqa: D417 - arguments document themselves
    results: Annotated[Path | None, Parameter(help="results folder (default: results)")] = None,
    /,
    *,
    out: Annotated[Path, Parameter(show=False)] = Path("results"),
    logs: bool = True,
    follow_remote: Annotated[bool, Parameter(negative=())] = False,
    sample: str | None = None,
    seed: str | None = None,
    key: KeyFile = None,
    seal: Annotated[bool, Parameter(negative=())] = False,
    repair: Annotated[bool, Parameter(negative=())] = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Check that results, and the logs they were made of, are still what they were.

    Args:
        logs: read the logs, too.
        follow_remote: ask addresses, such as s3://, that only the results name: who wrote them chose those.
        sample: read only a random share of files and logs, for example 5%; all runs are looked at.
        seed: draws another share (default: one of its own for every day).
        seal: seal results that no key seals as they are, where nothing is wrong with them; needs --key.
        repair: say what can be made again, and have it made by the next batch over its log.
        json: print one JSON object.
        quiet: print nothing.
    """
    from pipeline.batch.verification import verify_results  # noqa: PLC0415 - only for this verb

    use_key(key)
    drawn = parse_sample(sample, seed)
    place = open_results(results or out)
    store = place.open_store()
    if seal:
        (place.mirror or store).seal()
    with show_progress("verify", quiet=quiet or json) as tell:
        found = verify_results(
            store,
            mirror=place.mirror,
            logs=logs,
            tell=tell,
            repair=repair,
            follow_remote=follow_remote,
            sample=drawn,
        )
    print_result(_as_json(found, repair=repair), lambda: _describe(found), json=json, quiet=quiet)
    return CLEAN if found.is_clean else FAILED


def parse_sample(text: str | None, seed: str | None) -> Sample | None:
    """The sample of ``5%``, its seed by default that of the UTC day; None where none is asked for.

    Raises:
        SlipError: ``bad_sample``.
    """
    from pipeline.store.sampling import Sample  # noqa: PLC0415 - only where it is asked for

    if text is None:
        if seed is not None:
            raise SlipError("bad_sample", "--seed does nothing by itself", hint="Add --sample, as 5%")
        return None
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*%", text.strip())
    percent = float(match[1]) if match else 0.0
    if not 0.0 < percent <= 100.0:  # noqa: PLR2004 - all of it
        hint = "Write for example 5%"
        raise SlipError("bad_sample", f"{text!r} is no share of the files", hint=hint)
    return Sample(percent / 100.0, seed or f"{datetime.now(UTC):%Y-%m-%d}")


def _as_json(found: Verification, *, repair: bool) -> dict[str, object]:
    files, logs, gone, remote = (
        [
            {"run": problem.run, "path": str(problem.path), "code": problem.code, "message": problem.what}
            for problem in problems
        ]
        for problems in (found.files, found.logs, found.gone, found.remote)
    )
    answer = {
        "runs": found.checked,
        "files": files,
        "logs": logs,
        "gone": gone,
        "remote": remote,
        "seal": found.examination.seal,
        "read": {"files": asdict(found.examination.files), "logs": asdict(found.read_logs)},
        "unlisted": list(found.unlisted),
    }
    return answer | ({"repairs": [asdict(each) for each in found.repairs]} if repair else {})


def _describe(found: Verification) -> list[str]:
    lines = [f"{found.checked} runs looked at"]
    files, read_logs = found.examination.files, found.read_logs
    is_sample = (files.looked_at, read_logs.looked_at) != (files.all, read_logs.all)
    read = "all that was read" if is_sample or found.remote else "all"
    if is_sample:
        lines.append(
            f"sample   {files.looked_at} of {files.all} files and "
            f"{read_logs.looked_at} of {read_logs.all} logs were read"
        )
    lines += [f"damaged  {problem.path}: {problem.what}" for problem in found.files]
    lines += [f"log      {problem.path}: {problem.what} ({problem.run})" for problem in found.logs]
    lines += [f"gone     {problem.path} ({problem.run})" for problem in found.gone]
    lines += [f"remote   {problem.path} ({problem.run})" for problem in found.remote]
    if found.remote:
        lines.append("Only the results name these addresses; they are asked with --follow-remote.")
    if found.examination.seal == "not_checked":
        lines.append("The results are sealed with a key; --key FILE checks the seal.")
    lines += [f"{each.action:<8} {each.subject}: {each.what}" for each in found.repairs]
    if found.examination.seal != "none":
        lines += [f"unlisted {name}: slip did not write it with the key" for name in found.unlisted]
    elif found.unlisted and not found.repairs:
        lines.append(
            f"{len(found.unlisted)} files were written before there was a list of them: "
            "`slip verify --repair` puts them on it."
        )
    if found.is_clean:
        lines.append(f"{read} is as it was written")
    else:
        if any(each.action == "queued" for each in found.repairs):
            lines.append("`slip batch` over those logs makes it again.")
        elif found.files and not found.repairs:
            lines.append("`slip verify --repair` has the next batch over its log make again what can be.")
        lines += ["Copy changed logs from their origin."] if found.logs else []
    return lines
