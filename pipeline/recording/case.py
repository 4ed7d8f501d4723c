"""One log while it is examined: how its signals are read, and what is decided so far."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np
import polars as pl

from pipeline.core import Floats, SlipError, format_line
from pipeline.recording.evidence import RATES, RIMS, SPEEDS, WHEELS, Axis, Units
from pipeline.recording.extract import Extraction, Given
from pipeline.recording.findings import Finding
from pipeline.recording.geometry import Geometry, roll_wheels
from pipeline.recording.motion import CLEAR, NO_MOTION, Motion
from pipeline.recording.readings import NO_SIGNAL, UNEXPLAINED, Bent, Explained, Held, Reading
from pipeline.run import Alignment
from pipeline.sources import (
    AS_RECORDED,
    CONFIGURED,
    Configuration,
    DriveForm,
    DriveSection,
    DriveSource,
    Sources,
    Vehicle,
)

TAKEN_M = 0.1
"""Radius of wheels [m] whose speeds tell none, as of metres a second: any other gives the same slip."""
_AHEAD_S = 0.02
"""Time by which a command is stamped after its recording [s] that is another clock's, and no rounding's."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A candidate for a command or for wheels.

    Attributes:
        source: its topics; none where the log has nothing for the role.
        reading: its signals.
        rank: its place by type and name among those of its role.
        is_measured: whether type and name say that it is measured.
        steering: unit of its steering angle.
        is_angle: whether a type of body commands holds speed and steering angle.
    """

    source: DriveSource
    reading: Reading
    rank: int
    is_measured: bool
    steering: Units = field(default_factory=lambda: Units(("", "rad")))
    is_angle: bool = False

    @property
    def is_there(self) -> bool:
        """Whether the log has it."""
        return bool(self.source.signals)

    @property
    def is_sure(self) -> bool:
        """Whether the motion follows it."""
        return self.reading.explained.is_sure

    def sign(self, axis: Axis) -> int:
        """Sign against the motion; zero where it is not clear."""
        return self.reading.explained.sign(axis)

    def is_of(self, source: DriveSource | None) -> bool:
        """Whether it is that of a source."""
        return source is not None and self.source.signals == source.signals

    def sign_as_motion(self, axis: Axis) -> int:
        """The same of a signal that states a motion.

        A body that turns far more than it states turns by something else, as wheels that slip: a wrong sign
        changes no size.
        """
        explained = self.reading.explained
        is_far = self.reading.form == "body" and abs(float(explained.turned.gains[0])) > _MOST_GAIN
        return 0 if axis == "turned" and is_far else self.sign(axis)


NO_CANDIDATE = Candidate(DriveSource(DriveForm.BODY, (), ""), Reading(), 0, is_measured=False)
"""What a log has for a role for which it has nothing."""
_MOST_GAIN = 2.0
"""Largest turn of a body over that which a signal states as its motion."""


_APART = 2.0
"""Ratio of the gains of two halves from which on they are not one unit's: nearly the square root of the least
factor between two units, 3.6."""


def are_apart(halves: Sequence[float]) -> bool:
    """Whether the gains of both halves of a drive contradict each other."""
    if not halves:
        return False
    low, high = sorted(abs(gain) for gain in halves)
    return high >= _APART * low or min(halves) < 0.0 < max(halves)


def is_crossed(drive: Candidate) -> bool:
    """Whether one side counts backward: by the motion ahead, of a body command by turning, too."""
    explained = drive.reading.explained
    if not explained.crossed:
        return False
    sizes = [abs(float(explained.ahead.t[0])), abs(float(explained.turned.t[0]))]
    return sizes[0] > CLEAR and (drive.reading.form == "sides" or sizes[1] > CLEAR)


@dataclass(frozen=True, eq=False)
class Case:
    """One log and all that is decided of it: what a question is asked with, and what it answers by.

    A question gives the case with its own answer; nothing that is decided is edited later. Findings and
    corrections are added only.

    Attributes:
        given: the log, with what was known of it before.
        extraction: its columns at one clock.
        sources: topics of every role, without those that are left out.
        ahead: a candidate for the command that is stamped after it was recorded, and by how much [s].
        findings: what the user reads.
        changes: corrections as keys of the configuration, by section.
        moves_sideways: whether the base may move to the side.
        motion: of the body, by its poses, or of the wheels that stand in for them.
        gyro: its reading.
        drives: all candidates for commands and wheels that can be read.
        command, wheels: those of them that have the roles.
        kind: of the vehicle, if its signals show it.
        driven: what the wheels do of the command.
        is_scaled: whether what is commanded has a unit, so that the controller's lengths can be told from it.
        is_still: whether the body hardly moves where the drive does.
        in_bursts: whether the base stops before the next command, by which its gain is not known.
        is_judged: whether a side of the wheels is dead or reversed, which explains all signs.
        geometry: lengths by the signals.
        alignment: corrections of the command; None where nothing shows them.
        refused: why the poses say nothing; None if they may.
    """

    given: Given
    extraction: Extraction
    sources: Sources
    ahead: tuple[DriveSource, float] | None
    findings: list[Finding] = field(default_factory=list)
    changes: dict[str, dict[str, object]] = field(default_factory=dict)
    moves_sideways: bool = False
    motion: Motion = NO_MOTION
    gyro: Reading = field(default_factory=Reading)
    drives: tuple[Candidate, ...] = ()
    command: Candidate = NO_CANDIDATE
    wheels: Candidate = NO_CANDIDATE
    kind: str = ""
    driven: Explained = UNEXPLAINED
    is_scaled: bool = True
    is_still: bool = False
    in_bursts: bool = False
    is_judged: bool = False
    geometry: Geometry = field(default_factory=Geometry)
    alignment: Alignment | None = None
    refused: Finding | None = None

    @property
    def is_known(self) -> bool:
        """Whether the vehicle's geometry is known."""
        return self.given.is_known

    @property
    def vehicle(self) -> Vehicle:
        """The vehicle as it is given."""
        return self.given.vehicle

    @property
    def track_m(self) -> float | None:
        """Distance of the vehicle's sides [m]; None where it is not known."""
        return self.vehicle.track_width_m if self.is_known else None

    @property
    def configuration(self) -> Configuration:
        """The user's configuration."""
        return self.given.configuration

    @property
    def has_pose(self) -> bool:
        """Whether a pose is recorded; else wheels stand in for it."""
        return self.given.sources.pose is not None

    def fit(self, motion: Motion) -> Case:
        """All readings with another motion that they explain."""
        one, other = (
            replace(each, reading=each.reading.fitted(motion)) for each in (self.command, self.wheels)
        )
        return replace(
            self,
            motion=motion,
            gyro=self.gyro.fitted(motion),
            drives=tuple(replace(each, reading=each.reading.fitted(motion)) for each in self.drives),
            command=one,
            # Wheels that are the motion explain nothing.
            wheels=other if self.has_pose else self.wheels,
        )

    def leave_out(self, source: DriveSource) -> Case:
        """Take a candidate for no role."""
        sources = self.sources
        for role in ("command", "wheels"):
            chosen = getattr(sources, role)
            rest = [one for one in sources.rank_drives(role) if one.signals != source.signals]
            if chosen is not None and chosen not in rest:
                chosen = rest[0] if rest else None
            others = {**sources.others, role: tuple(one for one in rest if one is not chosen)}
            notes = tuple(note for note in sources.notes if source.signals[0].topic not in note)
            sources = replace(sources, others=others, notes=notes, **{role: chosen})
        return replace(self, sources=sources)

    # Signals.

    def read_gyro(self) -> Reading:
        """The yaw rate of the gyro."""
        imu = self.extraction.imu()
        if not imu.height:
            return Reading()
        return Reading("gyro", str(self.sources.imu), NO_SIGNAL, _hold(imu, "rate_z"))

    def read(
        self,
        source: DriveSource,
        *,
        is_measured: bool,
        kind: str = "differential",
        section: DriveSection | None = None,
    ) -> Reading:
        """The signals of a source, with unit lengths; nothing if they cannot be read as the user says."""
        section = section or self.find_section(source, is_measured=is_measured)
        unit = self.make_unit(source, kind)
        try:
            table = self.extraction.read_drive(source, section, unit, held=True)
        except SlipError:
            return Reading()
        if source.form is DriveForm.BODY:
            names = ("body_x", "body_w", *(["body_y"] if self.moves_sideways else []))
            signals = (_hold(table, name, may_stand=not is_measured) for name in names)
            return Reading("body", str(source), *signals)
        if unit.kind == "ackermann":
            speed = _hold(table, "speed", may_stand=not is_measured)
            bent = Bent(speed, *_column(table, "steering")) if speed.moves else NO_SIGNAL
            return Reading("steering", str(source), speed, bent)
        names = ("left", "right", *(["sideways"] if self.moves_sideways else []))
        reading = Reading("sides", str(source), *(_hold(table, name) for name in names))
        if self.moves_sideways and section.reversed is None:
            backward = msgspec.structs.replace(section, reversed="right")
            table = self.extraction.read_drive(source, backward, unit, held=True)
            return replace(reading, third_crossed=_hold(table, "sideways"))
        return reading

    def read_again(self, kind: str = "differential") -> Case:
        """The case with its wheels as corrected; the same case if they cannot be read."""
        section = self.complete().wheels
        reading = self.read(self.wheels.source, is_measured=True, kind=kind, section=section)
        if self.has_pose:
            case, reading = self, reading.fitted(self.motion)
            is_read = reading.explained.is_known
        else:
            motion = roll_wheels(reading)
            is_read = motion.is_known
            case = self.fit(motion) if is_read else self
        return replace(case, wheels=replace(self.wheels, reading=reading)) if is_read else self

    def make_unit(self, source: DriveSource, kind: str) -> Vehicle:
        """A vehicle of unit lengths whose inputs are those of a source."""
        if source.form is DriveForm.STEERING:
            kind = "ackermann"
        elif self.moves_sideways:
            kind = "omni" if source.form is DriveForm.BODY else "mecanum"
        return Vehicle(
            id="unit",
            name="unit",
            kind=kind,
            units=self.vehicle.units,
            wheel_radius_m=1.0,
            track_width_m=1.0,
            wheelbase_m=1.0,
        )

    def find_section(self, source: DriveSource, *, is_measured: bool) -> DriveSection:
        """What the user says of a source: of the topic that is named, or of any if none is."""
        of_role = self.configuration.wheels if is_measured else self.configuration.command
        chosen = self.sources.wheels if is_measured else self.sources.command
        if chosen is None or chosen.signals == source.signals:
            return of_role
        if chosen.reason == CONFIGURED:
            return DriveSection()
        # A clock is one topic's.
        return msgspec.structs.replace(of_role, late_s=None)

    # What the user reads, and what the stages read.

    def correct(
        self,
        section: str,
        fault: str,
        values: Mapping[str, object],
        line: str,
        change: dict[str, object],
        margin: float | None = None,
        usual: str = "",
        halves: Sequence[float] = (),
    ) -> bool:
        """Apply a correction, or tell it where the configuration or parts of the drive say otherwise.

        Args:
            section: of the configuration.
            fault: what is wrong, a key of `pipeline.words.findings.FAULTS`.
            values: of its template.
            line: of run.toml that corrects it.
            change: keys with their values.
            margin: Vuong's statistic of the correction.
            usual: unit that takes speeds as they are recorded.
            halves: gains by which it is made, in both halves of the drive; none where a statistic over its
                blocks decides.

        Returns:
            Whether it was applied.
        """
        as_recorded = {**AS_RECORDED[section]} | ({"unit": usual} if usual else {})
        wrong = {**values, "fault": fault, "value": margin, "line": line}
        if self._contradict(section, wrong, change, as_recorded):
            return False
        if are_apart(halves):
            wrong |= {"halves": list(halves)}
            self.findings.append(Finding("halves_contradict", "warning", section, wrong))
            return False
        self.changes.setdefault(section, {}).update(change)
        otherwise = [format_line(key, as_recorded[key]) for key in change if key in as_recorded]
        wrong |= {"kind": "corrected", "otherwise": otherwise[:1]}
        name = "pose_turned" if section == "pose" else f"{section}_corrected"
        self.findings.append(Finding(name, "warning", section, wrong))
        return True

    def _contradict(
        self,
        section: str,
        wrong: Mapping[str, object],
        keys: Collection[str],
        as_recorded: Mapping[str, object],
    ) -> bool:
        """Tell what contradicts keys of the configuration; what keeps the log as it is recorded is obeyed.

        Args:
            section: of the configuration.
            wrong: a fault, a key of `pipeline.words.findings.FAULTS`, with the values of its template and the
                line that would correct it.
            keys: of the section, that would correct it.
            as_recorded: values of keys that keep it as it is recorded.

        Returns:
            Whether the user gives one of them.
        """
        asked = getattr(self.configuration, section)
        # Both say which axis points up.
        keys = ["axes"] if "up" in keys and asked.up is None else keys
        given = {key: value for key in keys if (value := getattr(asked, key)) is not None}
        is_as_recorded = all(value == as_recorded.get(key) for key, value in given.items())
        about = {**wrong, "given": [format_line(key, value) for key, value in given.items()]}
        if given and is_as_recorded:
            self.findings.append(Finding("kept_as_recorded", "warning", section, about))
        elif given:
            about["kind"] = "configured"
            self.findings.append(Finding("signs_contradict", "error", section, about))
        return bool(given)

    def complete(self) -> Configuration:
        """The user's configuration with the corrections."""
        sections = {
            name: msgspec.structs.replace(getattr(self.configuration, name), **change)
            for name, change in self.changes.items()
        }
        return msgspec.structs.replace(self.configuration, **sections)

    def command_factors(self) -> tuple[float, float]:
        """Factors from a body command as it was read to m/s and rad/s."""
        changes = self.changes.get("command", {})
        return SPEEDS[str(changes.get("unit", "m/s"))], RATES[str(changes.get("yaw_unit", "rad/s"))]

    def wheel_factor(self, role: str = "wheels") -> float:
        """Factor from the radius of raw wheel speeds to that of rad/s."""
        changes = self.changes.get(role, {})
        if changes.get("unit") in RIMS:
            return TAKEN_M / SPEEDS[str(changes["unit"])]
        return 1.0 / WHEELS[str(changes.get("unit", "rad/s"))] / float(str(changes.get("scale", 1.0)))


def open_case(given: Given) -> Case:
    """A log of which nothing is decided yet."""
    # Every candidate takes part in the clocks, the body command beside commanded wheels, too.
    equal = replace(given.sources, others={**given.sources.others, "command": ()})
    extraction = Extraction(replace(given, sources=equal))
    ahead = _find_ahead(given, extraction)
    if ahead is not None:
        equal = replace(equal, command=ahead[0])
        section = msgspec.structs.replace(given.configuration.command, time="log")
        by_log = msgspec.structs.replace(given.configuration, command=section)
        extraction = Extraction(replace(given, sources=equal, configuration=by_log))
    moves_sideways = given.may_move_sideways(given.sources)
    return Case(given, extraction, given.sources, ahead, moves_sideways=moves_sideways)


def _find_ahead(given: Given, extraction: Extraction) -> tuple[DriveSource, float] | None:
    """A candidate for the command that is stamped after it was recorded, and by how much [s]."""
    late = {key: one.latency_s for key, one in extraction.clocks.items() if one.clock == "header"}
    if given.configuration.command.time is not None:
        return None
    for source in given.sources.rank_drives("command"):
        own = {signal.topic for signal in source.signals}
        rest = [latency for topic, latency in late.items() if topic not in own]
        ahead = -min((late.get(topic, 0.0) for topic in own), default=0.0)
        if ahead > _AHEAD_S and rest and min(rest) > -_AHEAD_S:
            return source, ahead
    return None


def _column(table: pl.DataFrame, name: str) -> tuple[Floats, Floats]:
    """Times and values of a column."""
    return table["t"].to_numpy(), table[name].cast(pl.Float64).fill_null(np.nan).to_numpy()


def _hold(table: pl.DataFrame, name: str, *, may_stand: bool = False) -> Held:
    """A column as a signal, which counts in the intervals in which commands are live."""
    return Held(*_column(table, name), may_stand=may_stand, counts=table["active"].to_numpy())
