"""A recording while it is written: what is known of it so far, and what to drive.

A look is `slip analyze` of the recording as it is, again and again, in a process of its own that gives its
memory back and ends at once on Ctrl-C. The reader takes the whole chunks of an unfinished file.

Repeated tests of growing evidence exceed any threshold in the end by chance. An effect therefore passes a
stricter test here than in a finished recording, and passes it in two successive looks.
"""

import json
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from pipeline.core import naming_os_errors, pick, pick_finite, python_command
from pipeline.estimation.decision import LEAST_T
from pipeline.estimation.driving_need import find_goal
from pipeline.logs import LogError, is_finished, list_files
from pipeline.logs.index import LISTING, find_parts
from pipeline.results import (
    ABOVE_FLOOR,
    RunDiagnosis,
    find_refusal,
    measure_excess,
    read_findings,
    read_result,
)
from pipeline.words import (
    describe_need,
    describe_separation,
    format_finding,
    has_dead_encoder,
    is_open,
    suggest_drive,
)

RUNNING_T = 2.0 * LEAST_T
"""Threshold of t for naming in a running log, `LEAST_T` in a finished one: `make bench NAME=watch` counts
retracted names."""
_MOST_ASKS = 3
"""Largest number of manoeuvres to ask for at once: as many as can be read while driving."""
_MOST_EVENTS = 100
_POLL_S = 0.25
"""Interval between two checks of the file's size [s]."""
_REST = 2.0
"""Shortest pause after a look, as a multiple of its length: a look takes a third of a core at most."""

Look: TypeAlias = dict[str, Any]
"""The object of one look, a line of `slip watch --json`."""


def choose_recording(path: Path) -> Path:
    """Recording to follow: the file or split recording itself, or the newest file of a folder.

    Raises:
        LogError: ``log_not_found``; ``not_a_recording``, the folder holds no MCAP file.
    """
    if not path.is_dir():
        if not path.is_file():
            raise LogError("log_not_found", "there is no such file", where=str(path), hint="Check the path")
        return path
    files = [file for file in list_files(path) if file.suffix == ".mcap"]
    if not files:
        what = "the folder holds no MCAP file"
        hint = "Start the recorder first, or name the folder it writes to"
        raise LogError("not_a_recording", what, where=str(path), hint=hint)
    with suppress(LogError):
        find_parts(path)
        return path
    return max(files, key=lambda file: file.stat().st_mtime_ns)


def follow(path: Path, arguments: Sequence[str], *, every_s: float, quiet_s: float) -> Iterator[Look]:
    """Analyze a recording again and again until it is closed.

    Args:
        path: path from `choose_recording`.
        arguments: options of `slip analyze`.
        every_s: shortest time from one look to the next [s].
        quiet_s: time without growth after which the recording counts as ended [s].

    Yields:
        The result of `summarize` for each look, with ``log`` and ``closed``.

    Raises:
        LogError: ``log_gone``, a file was removed.
    """
    before: Sequence[str] = ()
    state, grown, due, is_seen = (-1, False), 0.0, 0.0, True
    while True:
        begin, hint = time.monotonic(), "Leave the files of a recording where they are until it ends"
        with naming_os_errors(LogError, "log_gone", "the recording cannot be read", where=path, hint=hint):
            files = find_parts(path)[0]
            # Before the look, which then holds all of a closed recording.
            is_closed = not path.is_dir() or (path / LISTING).exists()
            is_closed = is_closed and all(map(is_finished, files))
            last, state = state, (sum(file.stat().st_size for file in files), is_closed)
        if state != last:
            grown, is_seen = begin, False
        is_over = is_closed or begin - grown > quiet_s
        if not is_seen and (is_over or begin >= due):
            answer = _analyze(path, arguments)
            end = time.monotonic()
            due, is_seen = max(begin + every_s, end + _REST * (end - begin)), True
            diagnosis = read_result(answer.get("diagnosis") or {}, RunDiagnosis)
            known = summarize(answer, diagnosis, None if is_closed else before)
            yield {"log": str(path), "closed": is_closed, **known}
            before = list_passing(diagnosis)
        elif is_over:
            return
        else:
            time.sleep(_POLL_S)


def _analyze(path: Path, arguments: Sequence[str]) -> dict[str, Any]:
    """The run's object of `slip analyze`, or one with a ``problem``."""
    command = python_command(
        "-m", "pipeline", "analyze", "--json", "--no-report", *arguments, "--", str(path)
    )
    output = None
    # The robot's own processes go first.
    with subprocess.Popen(  # noqa: S603 - this program itself
        ["nice", *command],  # noqa: S607 - of every system
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as process:
        try:
            # A signal that another thread receives does not interrupt a wait without an end.
            while output is None:
                with suppress(subprocess.TimeoutExpired):
                    output = process.communicate(timeout=_POLL_S)[0]
        finally:
            process.kill()
    answer = json.loads(output or b"{}")
    errors = answer.get("errors") or [{"message": f"the analysis ended with code {process.returncode}"}]
    return next(iter(answer.get("runs", [])), {"problem": errors[0]["message"]})


def summarize(answer: dict[str, Any], diagnosis: RunDiagnosis, before: Sequence[str] | None) -> Look:
    """What is known after a look, and what to drive for the rest.

    Args:
        answer: the run's object of `slip analyze`.
        diagnosis: of the same.
        before: result of `list_passing` for the look before; None for a closed recording.

    Returns:
        ``t_s``, recorded time [s]; ``slip``, median slip modulus [m/s] by input; ``error``, of the model so
        far over 2 s of driving that was not fitted; ``known``, from `list_known`; ``drive_next``, sentences;
        ``events``; ``enough``, whether more such driving changes nothing; ``vehicle``, that its lengths are a
        guess, else empty; ``faults``, sentences on dead sensors and wrong signals; ``problem``, why there is
        no answer yet, else empty.
    """
    findings, ladder, known = read_findings(answer), diagnosis.ladder, list_known(diagnosis, before)
    # All effects are reported, within the share that is the goal, and the model is at the noise floor.
    is_enough = (
        bool(known)
        and {row["effect"] for row in known} == {one.id for one in diagnosis.effects if not one.corrected}
        and all(row["is_narrow"] for row in known)
        and not diagnosis.undecided
        and 0.0 < measure_excess(diagnosis) < ABOVE_FLOOR
    )
    asks = [describe_separation(one) for one in diagnosis.undecided]
    asks += [part for name in diagnosis.unobservable_why for part in suggest_drive(name).split("; ")]
    asks = [*list(dict.fromkeys(asks))[:_MOST_ASKS], describe_need(diagnosis)]
    events = [one for one in findings if one.t_start is not None]
    reasons = [one for one in diagnosis.findings if one.where == "diagnosis"]
    refusal = find_refusal(findings) or (None if ladder else next(iter(reasons), None))
    return {
        "t_s": answer.get("log", {}).get("duration_s", 0.0),
        "slip": {name: one["median_modulus"] for name, one in answer.get("by_input", {}).items()},
        "error": pick_finite(ladder[-1], "t_mrmse_m", "r_mrmse_rad") if ladder else None,
        "known": known,
        "drive_next": [] if is_enough else list(filter(None, asks)),
        "events": [
            {**pick(one, "id", "t_start", "t_end"), "text": format_finding(one)}
            for one in events[-_MOST_EVENTS:]
        ],
        "enough": is_enough,
        "vehicle": next((format_finding(one) for one in findings if one.id == "vehicle_fitted"), ""),
        "faults": [
            format_finding(one)
            for one in findings
            if one != refusal and (one.severity == "error" or has_dead_encoder([one]))
        ],
        "problem": answer.get("problem") or (format_finding(refusal) if refusal else ""),
    }


def list_passing(diagnosis: RunDiagnosis) -> list[str]:
    """Ids of the effects that pass the test of a running log, regardless of the look before."""
    passing = []
    for effect in diagnosis.effects:
        evidence = None if effect.growth is None else effect.growth.evidence
        # Without a curve it was not searched for.
        t = np.nan_to_num(evidence.t[-1]) if evidence is not None and evidence.t else 0.0
        if t >= RUNNING_T:
            passing.append(effect.id)
    return passing


def list_known(diagnosis: RunDiagnosis, before: Sequence[str] | None) -> list[dict[str, Any]]:
    """Parameters of the effects that may be reported after a look; corrected clocks are none.

    Args:
        diagnosis: of the recording so far.
        before: result of `list_passing` for the look before; None for a closed recording.

    Returns:
        ``effect``, ``parameter``, ``value``, ``low`` and ``high`` (95 %), ``unit`` of each; ``is_known``,
        whether the recording tells how large it is; ``is_narrow``, whether the interval is as narrow as more
        driving is meant to make it.
    """
    passing = list_passing(diagnosis)
    return [
        {
            "effect": effect.id,
            "parameter": name,
            **pick_finite(value, "value", "low", "high"),
            "unit": value.unit,
            "is_known": not is_open(effect.id, name, value),
            "is_narrow": not value.doubt
            and 0.5 * (value.high - value.low) <= find_goal(effect.id, name, value.value),
        }
        for effect in diagnosis.effects
        if not effect.corrected and (before is None or (effect.id in passing and effect.id in before))
        for name, value in effect.parameters.items()
    ]
