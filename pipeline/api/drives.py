"""What to drive next: plans, and plans compared with what was driven."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from pipeline import plan as planning
from pipeline.analysis import Options
from pipeline.api.opening import Opener, Progress, open_quietly, show_nothing
from pipeline.core import SlipError, format_count, format_duration, name_first
from pipeline.estimation import DiagnosisInput, diagnose_runs, load_recording
from pipeline.estimation.stored_diagnosis import find_diagnosis, read_recording
from pipeline.plan import SAFETY, CheckedPlan, Plan
from pipeline.report.drive_pages import leave_plan, write_drive
from pipeline.results import RunDiagnosis
from pipeline.sources import Vehicle, find_preset, list_presets
from pipeline.store import Manifest, Store

_TIME, _AREA = "60s", "20x10m"
_LONGEST_SUGGESTED_S = 300.0
"""Longest drive that is suggested without being asked for."""


@dataclass(frozen=True)
class PlannedDrive:
    """A plan, and where it was written.

    Attributes:
        plan: the drive, and what it promises.
        files: the files that were written.
        driven_s: length of the logs so far [s]; 0 without logs.
        lossy: whether one of them had losses.
        report: the report that shows it; None without one.
        warning: why the report of the run does not show it; empty without a reason.
        recorded: topics of the recorded commands, where the plan's is none of them.
    """

    plan: Plan
    files: tuple[Path, ...]
    driven_s: float
    lossy: bool = False
    report: Path | None = None
    warning: str = ""
    recorded: tuple[str, ...] = ()

    def to_json(self) -> dict[str, object]:
        """The object of `slip plan --json`."""
        return {**self.plan.to_json(), "files": [str(file) for file in self.files]}

    def describe(self, said: str = "") -> list[str]:
        """The plan on one screen, what it will decide first.

        Args:
            said: flags that the next command needs again.
        """
        lines = self._describe(said)
        return lines if self.report is None else [*lines, f"report       {self.report} shows it"]

    def _describe(self, said: str) -> list[str]:
        made, files, driven_s = self.plan, self.files, self.driven_s
        runs = (
            f"after {format_count(len(made.runs), 'run')} of {format_duration(driven_s)}" if made.runs else ""
        )
        if not made.questions:
            return [f"no open question {runs}: no cause is undecided, and each number is known well enough"]
        ground = f"{made.area.length_m:g} x {made.area.width_m:g} m"
        rows = planning.tabulate_questions(made.list_rows(), f"open {runs}".strip()).align()
        most = f"limits       {made.limits.format(steered=made.steered)}"
        if not made.manoeuvres:
            nothing = f"no drive on {ground} of level ground answers an open question: no file is written"
            return [nothing, *(f"  {row}" for row in rows), most]
        names = [
            f"{number} x {name}" for name, number in Counter(name for name, _ in made.manoeuvres).items()
        ]
        return [
            made.summarize(),
            *(f"  {row}" for row in rows),
            f"drive        {made.commands.duration_s:.0f} s on {ground}: {', '.join(names)}",
            (
                "place        start in the middle, heading along the length; "
                f"end within {made.home_m:.1f} m of it"
            ),
            most,
            f"play         ros2 bag play {files[2]}    # {made.type_name} on {made.topic}",
            *self._describe_topic(),
            f"page         {files[-1]}",
            *(f"safety       {text}" for text in SAFETY),
            f"afterwards   slip plan --check {shlex.quote(str(files[0]))} NEW.mcap{said}",
        ]

    def _describe_topic(self) -> list[str]:
        """That no log holds commands on the topic of the plan."""
        if not self.recorded:
            return []
        text = f"the log holds no commands on {self.plan.topic}, those are on {name_first(self.recorded)}"
        return [f"topic        {text}: --topic names the one that the base obeys"]


def list_plan_files(folder: Path) -> list[Path]:
    """The files that a plan may write to a folder."""
    return [folder / name for name in planning.FILES]


def plan_drive(
    names: Sequence[str],
    options: Options,
    folder: Path,
    *,
    vehicle: str | None = None,
    time: str = _TIME,
    area: str = _AREA,
    max_speed: float | None = None,
    max_yaw_rate: float | None = None,
    max_acceleration: float | None = None,
    topic: str | None = None,
    type_name: str | None = None,
    opened: Opener = open_quietly,
    progress: Progress = show_nothing,
) -> PlannedDrive:
    """Plan the drive that tells most of what logs left open, as `slip plan` does, and write it.

    Args:
        names: logs or runs of one vehicle; without one the plan covers all effects of the vehicle.
        options: how logs are analyzed, and the folder of results.
        folder: folder of the plan.
        vehicle: vehicle preset, where there are no logs.
        time: longest duration, for example 60s or 2min.
        area: free area: length along the initial heading, and width.
        max_speed: highest speed [m/s]; None for what the runs commanded, as for the yaw rate.
        max_yaw_rate: highest yaw rate [rad/s].
        max_acceleration: highest acceleration [m/s^2].
        topic: topic of the commands; None for the recorded one.
        type_name: message type of that topic.
        opened: how logs and runs are opened.
        progress: how the stages of the plan are shown.

    Raises:
        SlipError: a text cannot be read, there is no vehicle, or nothing can be planned from the runs.
    """
    seconds = planning.parse_time(time)
    gathered = _gather(names, options, opened) if names else None
    chosen = find_preset(vehicle or "") if gathered is None else gathered.vehicle
    if chosen is None:
        known = ", ".join(preset.id for preset in list_presets())
        what = f"no preset is called {vehicle!r}" if vehicle else "a plan needs a run or a vehicle"
        raise SlipError("no_vehicle", what, hint=f"Give a log, a run, or --vehicle as one of {known}.")
    # Report wrong options before a long diagnosis.
    ground = planning.parse_area(area, chosen)
    with progress(names[0] if names else vehicle or "plan") as notify:
        notify("diagnosis")
        studied, first = planning.Studied(chosen), None
        if gathered is not None:
            first = gathered.manifests[0]
            stored = find_diagnosis(options.out, first) if len(gathered.manifests) == 1 else None
            studied = planning.study(gathered.recordings, chosen, notify, stored)
        limits = planning.choose_limits(
            chosen,
            studied.largest,
            speed_mps=max_speed,
            yaw_rate_radps=max_yaw_rate,
            acceleration_mps2=max_acceleration,
        )
        usual = planning.choose_topic(chosen, first)
        played = (topic or usual[0], type_name or usual[1])
        made = planning.make_plan(studied, limits, ground, seconds, played, notify)
    files = write_drive(made, folder, options.out)
    if gathered is None:
        return PlannedDrive(made, files, studied.driven_s)
    commands = {name: None for one in gathered.manifests for name in planning.list_commands(one)}
    drive = PlannedDrive(
        made,
        files,
        studied.driven_s,
        gathered.lossy,
        recorded=() if played[0] in commands else tuple(commands),
    )
    if len(gathered.manifests) != 1:
        return drive
    # The plan of one stored run is shown with it.
    report, warning = None, ""
    try:
        report = leave_plan(Store(options.out), gathered.manifests[0], made)
    except (SlipError, OSError) as error:
        warning = f"the report of the run does not show the plan: {error}"
    return replace(drive, report=report, warning=warning)


def suggest_plan(run: str, options: Options) -> str | None:
    """The flags of a `slip plan` that decides which effects act, where the diagnosis of a run leaves it open.

    Args:
        run: a stored run.
        options: with the folder of results.

    Returns:
        Empty where the usual drive decides it; None where no drive of a few minutes on the usual area does.
    """
    vehicle, recordings, manifests, _ = _gather([run], options, open_quietly)
    known = find_diagnosis(options.out, manifests[0])
    return None if known is None else _suggest(recordings, vehicle, manifests[0], known)


def _suggest(
    recordings: Sequence[DiagnosisInput], vehicle: Vehicle, first: Manifest, known: RunDiagnosis
) -> str | None:
    """Flags of the plan that decides something of what a diagnosis of runs leaves undecided."""
    if not known.undecided:
        return None
    seconds, flags = planning.parse_time(_TIME), ""
    try:
        studied, area = planning.study(recordings, vehicle, known=known), planning.parse_area(_AREA, vehicle)
        limits, played = (
            planning.choose_limits(vehicle, studied.largest),
            planning.choose_topic(vehicle, first),
        )
        while seconds <= _LONGEST_SUGGESTED_S:
            made = planning.make_plan(studied, limits, area, seconds, played)
            choices = [one for one in made.questions if one.kind == "separation"]
            if any(one in made.decided for one in choices):
                return flags
            longer = min(one.longer_s for one in choices)
            if longer <= seconds:
                return None
            seconds, flags = longer, f" --time {longer:g}s"
    except SlipError:
        # What cannot be planned is not suggested.
        return None
    return None


@dataclass(frozen=True)
class DrivenPlan:
    """A plan beside what was driven.

    Attributes:
        checked: which promises were kept.
        earlier: the runs that the plan was made of.
        following: flags of the `slip plan` that decides what is still undecided; None where none does.
        lossy: whether a log had losses.
    """

    checked: CheckedPlan
    earlier: Sequence[str]
    following: str | None
    lossy: bool

    def describe(self) -> list[str]:
        """What was promised, and what was measured."""
        rows = [
            f"{'kept' if one['kept'] else 'NOT KEPT':<9} {one['question']}: "
            f"promised {one['promised']}, {one['measured']}"
            for one in self.checked.outcomes
        ]
        rows += [f"open      {text}" for text in self.checked.open]
        return rows or ["the plan promised nothing"]


def check_drive(
    path: Path,
    names: Sequence[str],
    options: Options,
    *,
    opened: Opener = open_quietly,
    progress: Progress = show_nothing,
) -> DrivenPlan:
    """Compare a plan's promises with the joint diagnosis of the earlier runs and the drive.

    Args:
        path: the plan, or its folder.
        names: logs or runs that were driven by it.
        options: how logs are analyzed, and the folder of results.
        opened: how logs and runs are opened.
        progress: how the stages of the diagnosis are shown.

    Raises:
        SlipError: there is no log, it is of another vehicle, or it does not play the plan.
    """
    stored = planning.read_plan(path)
    if not names:
        what = "a check needs the log that was driven"
        raise SlipError("no_log", what, where=str(path), hint="Give it as well.")
    drive = _gather(names, options, opened)
    new = len(drive.recordings)
    before = [name for name in stored.runs if name not in {*names, *(one.name for one in drive.recordings)}]
    if stored.vehicle != drive.vehicle.id:
        what = f"the plan is for {stored.vehicle}, and the log is of {drive.vehicle.id}"
        hint = "Check a plan with logs of the vehicle it was made for."
        raise SlipError("other_vehicle", what, where=str(path), hint=hint)
    vehicle, recordings, manifests, lossy = _gather(before, options, opened, drive)
    with progress(names[0]) as notify:
        notify("diagnosis")
        driven = [load_recording(recording, vehicle) for recording in drive.recordings]
        planning.require_played((path if path.is_dir() else path.parent) / "plan.csv", driven, vehicle)
        together = [*recordings[new:], *drive.recordings]
        diagnosis = diagnose_runs(together, vehicle).runs[0]
        following = _suggest(together, vehicle, manifests[0], diagnosis)
    return DrivenPlan(planning.check_plan(stored, diagnosis), before, following, lossy)


class _Gathered(NamedTuple):
    """Runs of one vehicle, and whether one had losses."""

    vehicle: Vehicle
    recordings: list[DiagnosisInput]
    manifests: list[Manifest]
    lossy: bool


def _gather(
    names: Sequence[str], options: Options, opened: Opener, known: _Gathered | None = None
) -> _Gathered:
    """Runs of one vehicle, each once, after those that are known already."""
    recordings = [] if known is None else [*known.recordings]
    manifests = [] if known is None else [*known.manifests]
    vehicles = [] if known is None else [known.vehicle] * len(recordings)
    lossy = known is not None and known.lossy
    for name in names:
        with opened(name, options) as one:
            vehicle, recording = read_recording(one.manifest)
        lossy |= one.lossy
        if recording.sha256 and any(recording.sha256 == known.sha256 for known in recordings):
            continue
        vehicles.append(vehicle)
        recordings.append(recording)
        manifests.append(one.manifest)
    if other := next((vehicle for vehicle in vehicles if vehicle != vehicles[0]), None):
        fields = other.__struct_fields__
        differing = [name for name in fields if getattr(other, name) != getattr(vehicles[0], name)]
        what = f"the runs are of different vehicles (in {', '.join(differing)}), and a plan is for one"
        where = ", ".join(recording.name for recording in recordings)
        raise SlipError("several_vehicles", what, where=where, hint="Give runs of one vehicle.")
    return _Gathered(vehicles[0], recordings, manifests, lossy)
