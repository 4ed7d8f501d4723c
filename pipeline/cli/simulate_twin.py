"""`slip simulate --twin`: a log's commands replayed through the twin of a model."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.cli.conventions import print_result
from pipeline.cli.model_runs import gather_runs, open_model, open_shown
from pipeline.core.program import SlipError, naming_os_errors

if TYPE_CHECKING:
    from pipeline.job.twin_replay import TwinReplay
    from pipeline.models.model_file import ModelFile
    from pipeline.run.recording import MotionRun

_WORDS = {"ideal": "ideal model", "model": "kinematic model", "twin": "twin in MuJoCo"}


def replay(
    twin: str, log: str | None, page: Path | None, results: Path, *, trust_code: bool, json: bool
) -> int:
    """Replay commands, print errors over 2 s, and write the page.

    Args:
        twin: a model file; or a log or a run, whose own model and commands are taken.
        log: the log or run to replay; None for that of ``twin``.
        page: the page to write; None for none.
        results: results folder.
        trust_code: trust the Python that the model file names.
        json: print one JSON object.

    Raises:
        SlipError: a file cannot be read, or the twin cannot be made.
    """
    from pipeline.job.twin_replay import replay_twin  # noqa: PLC0415 - heavy
    from pipeline.job.twin_world import load_mujoco  # noqa: PLC0415

    # An analysis may take a minute: what is missing is said before it.
    load_mujoco()
    file, run = _open(twin, log, results, trust_code=trust_code, quiet=json)
    result = replay_twin(file, run)
    if page is not None:
        _write_page(page, result)
    return print_result(result.to_json(), lambda: describe_replay(result, page), json=json)


def _open(
    twin: str, log: str | None, results: Path, *, trust_code: bool, quiet: bool
) -> tuple[ModelFile, MotionRun]:
    from pipeline.job.options import Options  # noqa: PLC0415
    from pipeline.job.twin_replay import find_run_model  # noqa: PLC0415 - heavy

    if Path(twin).suffix == ".toml":
        file = open_model(Path(twin), trust_code=trust_code)
        if log is None:
            what, hint = "no log is named whose commands are replayed", f"slip simulate RUN --twin {twin}"
            raise SlipError("no_runs", what, where="--twin", hint=hint)
    else:
        options = Options(out=results, report=False, diagnosis=True)
        with open_shown(twin, options, quiet=quiet) as opened:
            file = find_run_model(opened.manifest, results)
    _, (run,) = gather_runs([log or twin], file.model.vehicle, None, results, quiet=quiet)
    return file, run


def _write_page(path: Path, result: TwinReplay) -> None:
    from pipeline.report.twin_page import render_twin  # noqa: PLC0415 - heavy
    from pipeline.store.files import replace_file  # noqa: PLC0415 - heavy

    text = render_twin(result.to_json(), describe_replay(result, None), result.paths, result.horizon_errors)
    hint = "Check the folder and its permissions."
    with naming_os_errors(SlipError, "page_unwritable", "the page cannot be written", where=path, hint=hint):
        replace_file(path, text.encode())


def describe_replay(result: TwinReplay, page: Path | None) -> list[str]:
    """The errors as a table, what the twin is made of and what it lacks, as lines.

    Args:
        result: the replay.
        page: the page that was written; None for none.
    """
    judged = "each prediction under numbers fitted without its 10 s" if result.is_seen else "not fitted to it"
    lines = [
        f"run       {result.run}    {result.body.vehicle.name}",
        f"model     {', '.join(result.model.ids) or 'ideal'}",
        f"judged    {result.predictions} predictions of 2 s from measured poses, {judged}",
        "",
        f"{'':<18}{'position':>12}{'heading':>12}",
    ]
    for side, error in result.errors.items():
        position, heading = 100.0 * error.t_mrmse_m, math.degrees(error.r_mrmse_rad)
        lines.append(f"{_WORDS[side]:<18}{position:>9.2f} cm{heading:>8.2f} deg")
    lines += ["", *_describe_verdict(result)]
    if result.body.controller:
        names = ", ".join(effect.id for effect in result.body.controller)
        lines.append(f"MuJoCo has no element for: {names}. The replay applies it before the servos.")
    lines += [f"note      {note}" for note in result.body.notes]
    return [*lines, *([f"page      {page}"] if page is not None else [])]


def _describe_verdict(result: TwinReplay) -> list[str]:
    share = result.reproduced
    lines = [f"The twin reproduces {100.0 * share:.0f} % of what the model explains."]
    if math.isnan(share):
        lines = ["The model explains nothing of this log beyond the ideal one, and so does the twin."]
    if not result.is_worse and not result.missing:
        return lines
    model = result.errors["model"].t_mrmse_m
    lines += [
        f"Contact of wheels cannot reproduce {one.effect}: without it the model errs by "
        f"{100.0 * one.t_mrmse_m:.2f} cm, not {100.0 * model:.2f} cm. {one.motion.rstrip('.')}."
        for one in result.missing
    ]
    if result.is_worse and not result.missing:
        lines.append("All of its effects are in the twin: contact reproduces one of them in part only.")
    return lines
