"""One log while it is examined: how its signals are read, and what was corrected so far."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np
import polars as pl

from pipeline.core import Floats, SlipError
from pipeline.recording.evidence import RATES, RIMS, SPEEDS, WHEELS, Axis, Units
from pipeline.recording.motion import CLEAR, Motion
from pipeline.recording.readings import Bent, Explained, Held, Reading
from pipeline.sources import (
    CONFIGURED,
    Configuration,
    DriveForm,
    DriveSection,
    DriveSource,
    Vehicle,
)
from pipeline.stages import Extraction, Finding, Given

TAKEN_M = 0.1
"""Radius of wheels [m] whose speeds tell none, as of metres a second: any other gives the same slip."""
_AHEAD_S = 0.02
"""Time by which a command is stamped after its recording [s] that is another clock's, and no rounding's."""
_AS_RECORDED: Mapping[str, Mapping[str, str]] = {
    "imu": {"unit": 'unit = "rad/s"'},
    "pose": {"up": 'up = "z"', "heading_deg": "heading_deg = 0", "unit": 'unit = "m"'},
    "wheels": {"unit": 'unit = "rad/s"', "steering_unit": 'steering_unit = "rad"'},
    "command": {
        "late_s": "late_s = 0",
        "unit": 'unit = "m/s"',
        "yaw_unit": 'yaw_unit = "rad/s"',
        "steering_unit": 'steering_unit = "rad"',
    },
}
"""Lines of run.toml that keep a correction from being made; the defaults of other keys do not."""


@dataclass
class Candidate:
    """A candidate for a command or for wheels.

    Attributes:
        source: its topics.
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
    def is_sure(self) -> bool:
        """Whether the motion follows it."""
        return self.reading.explained is not None and self.reading.explained.is_sure

    def sign(self, axis: Axis) -> int:
        """Sign against the pose; zero where it is not clear."""
        return self.reading.explained.sign(axis) if self.reading.explained is not None else 0

    def sign_as_motion(self, axis: Axis) -> int:
        """The same of a signal that states a motion.

        A body that turns far more than it states turns by something else, as wheels that slip: a wrong sign
        changes no size.
        """
        explained = self.reading.explained
        is_far = (
            explained is not None
            and self.reading.form == "body"
            and abs(float(explained.turned.gains[0])) > _MOST_GAIN
        )
        return 0 if axis == "turned" and is_far else self.sign(axis)


_MOST_GAIN = 2.0
"""Largest turn of a body over that which a signal states as its motion."""


def is_crossed(drive: Candidate) -> bool:
    """Whether one side counts backward: by the motion ahead, of a body command by turning, too."""
    explained = drive.reading.explained
    if explained is None or not explained.crossed:
        return False
    sizes = [abs(float(explained.ahead.t[0])), abs(float(explained.turned.t[0]))]
    return sizes[0] > CLEAR and (drive.reading.form == "sides" or sizes[1] > CLEAR)


class Case:
    """One log: its candidates, and what was decided so far."""

    def __init__(self, given: Given) -> None:
        self.is_known = given.is_known
        self.sources, self.configuration, self.vehicle = given.sources, given.configuration, given.vehicle
        # Every candidate takes part in the clocks, the body command beside commanded wheels, too.
        equal = replace(self.sources, others={**self.sources.others, "command": ()})
        self.findings: list[Finding] = []
        self.changes: dict[str, dict[str, object]] = {}
        self.extraction = Extraction(replace(given, sources=equal))
        self.ahead = _find_ahead(self)
        if self.ahead is not None:
            equal = replace(equal, command=self.ahead[0])
            section = msgspec.structs.replace(self.configuration.command, time="log")
            by_log = msgspec.structs.replace(self.configuration, command=section)
            self.extraction = Extraction(replace(given, sources=equal, configuration=by_log))
        self.moves_sideways = given.may_move_sideways(self.sources)
        self.driven: Explained | None = None
        # Whether what is commanded has a unit, so that the controller's lengths can be told from it.
        self.is_scaled = True
        # Whether the body hardly moves where the drive does.
        self.is_still = False
        # Whether the base stops before the next command, by which its gain is not known.
        self.in_bursts = False

    def leave_out(self, source: DriveSource) -> None:
        """Take a candidate for no role."""
        for role in ("command", "wheels"):
            chosen = getattr(self.sources, role)
            rest = [one for one in self.sources.rank_drives(role) if one.signals != source.signals]
            if chosen is not None and chosen not in rest:
                chosen = rest[0] if rest else None
            others = {**self.sources.others, role: tuple(one for one in rest if one is not chosen)}
            notes = tuple(note for note in self.sources.notes if source.signals[0].topic not in note)
            self.sources = replace(self.sources, others=others, notes=notes, **{role: chosen})

    # Signals.

    def read_gyro(self) -> Reading | None:
        """The yaw rate of the gyro; None without one."""
        imu = self.extraction.imu()
        if not imu.height:
            return None
        return Reading("gyro", str(self.sources.imu), None, _hold(imu, "rate_z"))

    def read(
        self,
        source: DriveSource,
        *,
        is_measured: bool,
        kind: str = "differential",
        section: DriveSection | None = None,
    ) -> Reading | None:
        """The signals of a source, with unit lengths; None if they cannot be read as the user says."""
        section = section or self.find_section(source, is_measured=is_measured)
        self.extraction.vehicle = unit = self.make_unit(source, kind)
        try:
            table = self.extraction.read_drive(source, section, held=True)
        except SlipError:
            return None
        if source.form is DriveForm.BODY:
            names = ("body_x", "body_w", *(["body_y"] if self.moves_sideways else []))
            signals = (_hold(table, name, may_stand=not is_measured) for name in names)
            return Reading("body", str(source), *signals)
        if unit.kind == "ackermann":
            speed = _hold(table, "speed")
            bent = Bent(speed, *_column(table, "steering")) if speed.moves else None
            return Reading("steering", str(source), speed, bent)
        names = ("left", "right", *(["sideways"] if self.moves_sideways else []))
        reading = Reading("sides", str(source), *(_hold(table, name) for name in names))
        if self.moves_sideways and section.reversed is None:
            backward = msgspec.structs.replace(section, reversed="right")
            reading.third_crossed = _hold(self.extraction.read_drive(source, backward, held=True), "sideways")
        return reading

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

    def read_again(self, wheels: Candidate, motion: Motion, kind: str = "differential") -> bool:
        """Read the wheels as corrected, or of another kind of vehicle; whether the body turns by them."""
        section = self.complete().wheels
        reading = self.read(wheels.source, is_measured=True, kind=kind, section=section)
        made = None if reading is None else reading.explain(motion)
        if reading is None or made is None or (kind == "ackermann" and not made.sign("turned")):
            return False
        wheels.reading = reading
        return True

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
    ) -> None:
        """Apply a correction, or tell it where the user's configuration decides otherwise.

        Args:
            section: of the configuration.
            fault: what is wrong, a key of `pipeline.words.findings.FAULTS`.
            values: of its template.
            line: of run.toml that corrects it.
            change: keys with their values.
            margin: Vuong's statistic of the correction.
            usual: unit that takes speeds as they are recorded.
        """
        default = type(getattr(self.configuration, section))()
        given = [
            key
            for key in change
            if getattr(getattr(self.configuration, section), key) != getattr(default, key)
        ]
        name = "pose_turned" if section == "pose" else f"{section}_corrected"
        if "up" in change and not given and self.configuration.pose.axes != default.axes:
            given = ["axes"]
        wrong = {**values, "kind": "configured", "fault": fault, "given": given, "value": margin}
        if given and section == "pose":
            self.findings.append(Finding("pose_contradicted", "warning", section, wrong))
            return
        if given:
            self.findings.append(Finding("signs_contradict", "error", section, wrong))
            return
        self.changes.setdefault(section, {}).update(change)
        as_recorded = {**_AS_RECORDED[section]} | ({"unit": f'unit = "{usual}"'} if usual else {})
        settled = [text for key, text in as_recorded.items() if key in change]
        wrong |= {"kind": "corrected", "line": line, "otherwise": settled}
        self.findings.append(Finding(name, "warning", section, wrong))

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


def _find_ahead(case: Case) -> tuple[DriveSource, float] | None:
    """A candidate for the command that is stamped after it was recorded, and by how much [s]."""
    late = {key: one.latency_s for key, one in case.extraction.clocks.items() if one.clock == "header"}
    if case.configuration.command.time is not None:
        return None
    for source in case.sources.rank_drives("command"):
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
