"""Examination of a log: from the columns of its candidates to a `Recording`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np
import polars as pl

from pipeline.core import Floats, SlipError, enumerate_texts, format_duration
from pipeline.logs import LogData
from pipeline.recording.command_scale import measure_command_scale, roll
from pipeline.recording.evidence import (
    RATES,
    SPEEDS,
    USUAL,
    WHEELS,
    Axis,
    Reversal,
    Units,
    find_body_units,
    find_frame,
    find_pose_unit,
    find_reversed,
    find_steering_unit,
    find_wheel_unit,
    is_named_measured,
    is_unit_exact,
    rate_command,
)
from pipeline.recording.geometry import (
    Geometry,
    Length,
    explain_wheels,
    measure_car,
    measure_controller,
    measure_geometry,
)
from pipeline.recording.motion import Motion, measure_motion
from pipeline.recording.outages import find_outages
from pipeline.recording.readings import SIDES, Bent, Explained, Held, Reading
from pipeline.recording.score import CLEAR, FEWEST_STEPS, compare, fit
from pipeline.recording.wheel_scales import compare_sides, find_odd_joints, measure_wheel, snap
from pipeline.run import LIVE_SHARE, Alignment
from pipeline.sources import (
    CONFIGURED,
    Configuration,
    DriveForm,
    DriveSection,
    DriveSource,
    OutageSection,
    PoseContent,
    Sources,
    Vehicle,
)
from pipeline.stages import (
    Extraction,
    Finding,
    choose_sides,
    find_sideways_share,
    find_timeout,
    list_steered,
    report_timeout,
)


@dataclass(frozen=True)
class Evidence:
    """How the motion follows a signal.

    Attributes:
        name: its topics.
        role: ``command``, ``wheels``, ``gyro``, or empty if it is not used.
        reason: why it is not used, or nothing is known of it; else empty.
        margin: Vuong's statistic of the motion with it against the motion alone; None if too little of it is
            recorded.
        ahead, turned: motion over signal, in the signal's units; zero where it is not excited.
        late_s: delay of the motion [s].
    """

    name: str
    role: str
    reason: str = ""
    margin: float | None = None
    ahead: float = 0.0
    turned: float = 0.0
    late_s: float = 0.0


@dataclass(frozen=True)
class Recording:
    """What is in a log.

    Attributes:
        sources: topic of every role.
        configuration: the user's, completed by what the log shows.
        findings: what was decided, and why.
        kind: kind of vehicle that the signals show; empty if they show none.
        geometry: lengths by the signals.
        evidence: on every signal that was tried.
        alignment: corrections of the command; None where nothing shows them.
    """

    sources: Sources
    configuration: Configuration
    findings: tuple[Finding, ...] = ()
    kind: str = ""
    geometry: Geometry = field(default_factory=Geometry)
    evidence: tuple[Evidence, ...] = ()
    alignment: Alignment | None = None


_STILL = 0.1
"""Gain of the motion on the drive below which a body stands: on ice it is .13 to .26 of the wheels."""
_EXPLAINED = 0.9
"""Share of the motion that a signal in a strange unit explains, and vibration does not."""
_SMALLEST_M = 0.1
"""Radius of a wheel [m] that counts as small."""
_EQUAL = 0.02
"""Deviation of both gains from one within which a signal measures the motion."""
_MOST = 20
"""Candidates of a role that are compared, the likeliest by type and name: each costs a fit."""
_BOTH_WAYS = 0.02
"""Share of a drive in one direction from which on it goes that way."""
_NEAR = 0.03
"""Spread of the logarithm of a gyro's scale."""
_AHEAD_S = 0.02
"""Time by which a command is stamped after its recording [s] that is another clock's, and no rounding's."""
_TAKEN_M = 0.1
"""Radius of wheels [m] whose speeds tell none, as of metres a second: any other gives the same slip."""
_MARGIN = 4.0
"""Gain of another command over the one by type and name that decides [nats]."""


def examine(
    data: LogData,
    sources: Sources,
    configuration: Configuration,
    vehicle: Vehicle,
    *,
    is_known: bool,
    where: str,
) -> Recording:
    """Decide which reading of a log's signals makes its pose move as it does.

    Args:
        data: columns of the chosen pose, the gyro and every candidate for a command and for wheels.
        sources: the pose, and candidates by type and name, the likeliest first.
        configuration: the user's; what it gives is not decided here.
        vehicle: the log's, or any of its kind.
        is_known: whether its geometry is known.
        where: the log, for error messages.
    """
    if sources.pose is None:
        return Recording(sources, configuration)
    try:
        examination = Examination(data, sources, configuration, vehicle, is_known=is_known, where=where)
    except SlipError:
        # The stage `extract` raises it again.
        return Recording(sources, configuration)
    return examination.run()


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


class Examination:
    """One log: its motion, its candidates, and what was decided so far."""

    def __init__(
        self,
        data: LogData,
        sources: Sources,
        configuration: Configuration,
        vehicle: Vehicle,
        *,
        is_known: bool,
        where: str,
    ) -> None:
        self.is_known = is_known
        self.sources, self.configuration, self.vehicle = sources, configuration, vehicle
        # Every candidate takes part in the clocks, the body command beside commanded wheels, too.
        equal = replace(sources, others={**sources.others, "command": ()}, power=None)
        self.findings: list[Finding] = []
        self.changes: dict[str, dict[str, object]] = {}
        self.extraction = Extraction(data, equal, configuration, vehicle, where)
        self.ahead = self._find_ahead()
        if self.ahead is not None:
            equal = replace(equal, command=self.ahead[0])
            section = msgspec.structs.replace(configuration.command, time="log")
            by_log = msgspec.structs.replace(configuration, command=section)
            self.extraction = Extraction(data, equal, by_log, vehicle, where)
        drives = dict.fromkeys((*sources.rank_drives("command"), *sources.rank_drives("wheels")))
        self.moves_sideways = vehicle.kinematics.has_inputs("sideways") or any(
            find_sideways_share(data.topics, one) for one in drives
        )
        self.driven: Explained | None = None

    def run(self) -> Recording:
        """See `examine`."""
        try:
            motion = measure_motion(self.extraction.poses())
            gyro = self._read_gyro()
        except SlipError:
            motion = None
        if motion is None:
            return Recording(self.sources, self.configuration)
        if gyro is not None and self._is_in_degrees(gyro, motion):
            # Headings of positions alone are made of the gyro.
            self.extraction.take_degrees()
            motion, gyro = measure_motion(self.extraction.poses()) or motion, self._read_gyro()
        drives = self._read_drives(motion)
        gyros = [] if gyro is None else [gyro]
        readings = [*(drive.reading for drive in drives), *gyros]
        for one in readings:
            one.explain(motion)
        for drive in drives:
            self._settle_steering(drive, motion)
            self._settle_turn(drive, motion)
        drives = self._leave_out_sizes(drives)
        motion = self._turn(motion, readings)
        command, wheels = self._choose_roles(drives)
        self._settle_stamps(command)
        self._report_turn(command)
        motion = self._settle_lengths(motion, readings, command, wheels)
        is_judged = self._settle_wheels(command, wheels, motion)
        kind = self._find_kind(wheels, motion)
        if wheels is not None and not kind and self._leave_out_steered(wheels):
            wheels = None
        if command is not None and command.reading.form == "steering":
            kind = kind or "ackermann"
        if not is_judged:
            self._report_signs(motion, command, wheels, gyro)
        if wheels is not None and self.changes.get("wheels", {}).keys() & {"sign", "exchanged"}:
            self._read_again(wheels, motion, (kind if kind == "ackermann" else "") or "differential")
        self._find_units(command, wheels)
        alignment = self._measure_command(command, wheels, kind, motion)
        used = (("command", command), ("wheels", wheels))
        roles = {id(one.reading): role for role, one in used if one is not None}
        roles |= {id(gyro): "gyro"} if gyro is not None else {}
        return Recording(
            self._name_sources(command, wheels),
            self._complete(),
            tuple(self.findings),
            kind,
            # Lengths that are known are not measured again.
            Geometry() if self.is_known or kind == "omni" else self._measure(command, wheels),
            tuple(describe(one, roles) for one in (*(drive.reading for drive in drives), *gyros)),
            alignment,
        )

    # Signals.

    def _find_ahead(self) -> tuple[DriveSource, float] | None:
        """A candidate for the command that is stamped after it was recorded, and by how much [s]."""
        late = {key: one.latency_s for key, one in self.extraction.clocks.items() if one.clock == "header"}
        if self.configuration.command.time is not None:
            return None
        for source in self.sources.rank_drives("command"):
            own = {signal.topic for signal in source.signals}
            rest = [latency for topic, latency in late.items() if topic not in own]
            ahead = -min((late.get(topic, 0.0) for topic in own), default=0.0)
            if ahead > _AHEAD_S and rest and min(rest) > -_AHEAD_S:
                return source, ahead
        return None

    def _settle_stamps(self, command: Candidate | None) -> None:
        """Take the times of recording of a command that is stamped after it was recorded."""
        if self.ahead is None or command is None or command.source.signals != self.ahead[0].signals:
            return
        what = (
            f"the stamps of {command.source} lie {format_duration(self.ahead[1])} after they were recorded, "
            "and those of the other topics do not: its clock runs ahead"
        )
        self._correct("command", what, 'time = "log"', {"time": "log"})

    def _read_gyro(self) -> Reading | None:
        imu = self.extraction.imu()
        if not imu.height:
            return None
        return Reading("gyro", str(self.sources.imu), None, _hold(imu, "rate_z"))

    def _read_drives(self, motion: Motion) -> list[Candidate]:
        commands, wheels = (self.sources.rank_drives(role) for role in ("command", "wheels"))
        drives, taken = [], set()
        for is_measured, sources in ((False, commands), (True, wheels)):
            for rank, source in enumerate(sources[:_MOST]):
                key = (source.form, source.signals)
                reading = None if key in taken else self._read(source, is_measured=is_measured)
                if reading is None and key not in taken and is_measured and source == self.sources.wheels:
                    reading = self._read_by_motion(source, motion)
                taken.add(key)
                if reading is not None:
                    drives.append(Candidate(source, reading, rank, is_measured))
        return drives

    def _read(
        self,
        source: DriveSource,
        *,
        is_measured: bool,
        kind: str = "differential",
        section: DriveSection | None = None,
    ) -> Reading | None:
        """The signals of a source, with unit lengths; None if they cannot be read as the user says."""
        section = section or self._find_section(source, is_measured=is_measured)
        self.extraction.vehicle = unit = self._make_unit(source, kind)
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

    def _make_unit(self, source: DriveSource, kind: str) -> Vehicle:
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

    def _find_section(self, source: DriveSource, *, is_measured: bool) -> DriveSection:
        """What the user says of a source: of the topic that is named, or of any if none is."""
        of_role = self.configuration.wheels if is_measured else self.configuration.command
        chosen = self.sources.wheels if is_measured else self.sources.command
        is_another = chosen is not None and chosen.reason == CONFIGURED and chosen.signals != source.signals
        return DriveSection() if is_another else of_role

    def _read_by_motion(self, source: DriveSource, motion: Motion) -> Reading | None:
        """Joints whose names show no side, each put on the side on which it turns; None without."""
        columns = self.extraction.columns.get(source.signals[0].topic)
        if (
            source.form is not DriveForm.JOINTS
            or columns is None
            or self.configuration.wheels.left is not None
        ):
            return None
        times, joints = self.extraction.read_rates(source)
        body = np.column_stack([motion.body.real, motion.yaw])
        sides: dict[str, list[str]] = {"left": [], "right": []}
        for name, rate in joints.items():
            signal = Held(times, rate)
            if not signal.moves:
                continue
            keep = signal.is_there(motion.steps)
            if keep.sum() < FEWEST_STEPS:
                continue
            steps = motion.steps.take(keep)
            made = fit(signal.integrate(steps, 0.0, 0.0), body[keep], steps)
            if min(abs(made.t)) > CLEAR:
                sides["left" if made.gains[0] * made.gains[1] < 0.0 else "right"].append(name)
        if not (sides["left"] and sides["right"]):
            return None
        names = {side: ", ".join(joined) for side, joined in sides.items()}
        what = (
            f"the joints of {source} do not name their side; by the motion {names['left']} are left and "
            f"{names['right']} right"
        )
        line = "; ".join(
            f"{side} = [{', '.join(repr(one) for one in listed)}]" for side, listed in sides.items()
        )
        self._correct("wheels", what, line.replace("'", '"'), dict(sides))
        section = self._complete().wheels
        return self._read(source, is_measured=True, section=section)

    # Frame of the pose.

    def _turn(self, motion: Motion, readings: Sequence[Reading]) -> Motion:
        """The motion in the frame in which the readings explain it, and the readings fitted to it."""
        source, section = self.sources.pose, self.configuration.pose
        if source is None or source.content is not PoseContent.POSE:
            return motion
        turned, margin = find_frame(motion, readings)
        if not margin:
            return motion
        if section.heading_deg is not None:
            text = (
                f"by the motion the heading of {source} is {turned.offset_deg:.0f} degrees off (or as much "
                "less half a turn), but [pose] in run.toml gives heading_deg, which is taken as it is given"
            )
            self.findings.append(Finding("pose_contradicted", "warning", text, where="pose", value=margin))
            return motion
        if turned.flip:
            text = (
                f"the headings of {source} turn against its own path: its frame is of the other hand; "
                "correct what publishes it"
            )
            self.findings.append(Finding("pose_flipped", "error", text, where="pose", value=margin))
        for one in readings:
            one.explain(turned)
        return turned

    # Roles.

    def _choose_roles(self, drives: Sequence[Candidate]) -> tuple[Candidate | None, Candidate | None]:
        """Command and wheels: those by type and name, unless the motion says otherwise."""
        if self._is_still(drives):
            for one in drives:
                one.reading.explained = None
        sure = [one for one in drives if one.is_sure and not one.reading.is_constant]
        earliest = min(
            (
                one.reading.explained.lag + one.reading.explained.delay
                for one in sure
                if one.reading.explained
            ),
            default=0.0,
        )
        named = command = self._find(drives, self.sources.command)
        # Plain numbers have their roles by name alone: the motion may follow both, and tell them apart. Where
        # it does not follow the command, the vehicle is driven by other means.
        is_followed = any(one is command for one in sure)
        rivals = [
            one for one in sure if not one.is_measured or (is_followed and one.source.form is DriveForm.SIDES)
        ]
        if rivals and (command is None or command.source.reason != CONFIGURED):
            rates = {id(one): rate_command(one.reading, one.rank, earliest) for one in rivals}
            best = max(rivals, key=lambda one: rates[id(one)])
            if command is None or rates[id(best)] > rates.get(id(command), -np.inf) + _MARGIN:
                if command is not None:
                    self._report_command(best, command)
                command = best
        wheels = self._find(drives, self.sources.wheels)
        if wheels is not None and command is not None and wheels.source.signals == command.source.signals:
            # What is named as a command measures what the other asks for.
            is_sides = named is not None and named is not command and named.reading.form == "sides"
            return command, named if is_sides else None
        if wheels is None and self.sources.wheels is None:
            # A pair of sides that is no command measures the wheels.
            is_free = command is None
            spare = [one for one in rivals if one is not command and one.reading.form == "sides"]
            spare = [
                one
                for one in spare
                if is_free or one.source.form is DriveForm.SIDES or is_named_measured(one.reading.name)
            ]
            wheels = max(spare, key=lambda one: -one.rank, default=None)
            if wheels is not None and command is not None and command.reading.form == "sides":
                wheels = wheels if is_named_measured(wheels.reading.name) else None
        return command, wheels

    def _is_still(self, drives: Sequence[Candidate]) -> bool:
        """Whether the body hardly moves where the drive does: it is stuck, lifted, or another body."""
        first = self._find(drives, self.sources.command) or self._find(drives, self.sources.wheels)
        made = None if first is None else first.reading.explained
        if first is None or made is None or first.reading.form == "steering":
            return False
        scale = self.vehicle.wheel_radius_m if self.is_known and first.reading.form == "sides" else 1.0
        least = _STILL * scale if self.is_known or first.reading.form == "body" else _STILL * _SMALLEST_M
        fits = [made.ahead, made.turned, *([made.aside[0]] if made.aside is not None else [])]
        gains = max(abs(float(one.gains[0])) for one in fits)
        return gains < least and max(made.shares) < _EXPLAINED

    def _find(self, drives: Sequence[Candidate], source: DriveSource | None) -> Candidate | None:
        return next(
            (one for one in drives if source is not None and one.source.signals == source.signals), None
        )

    def _name_sources(self, command: Candidate | None, wheels: Candidate | None) -> Sources:
        """The sources with these roles, without notes on a choice by name that no longer holds."""
        made = self.sources
        for role, drive in (("command", command), ("wheels", wheels)):
            before, source = getattr(made, role), None if drive is None else drive.source
            if source is None or source == before:
                continue
            rest = [one for one in (before, *made.others.get(role, ())) if one is not None and one != source]
            notes = tuple(note for note in made.notes if not note.startswith(f"{role}:"))
            made = replace(made, others={**made.others, role: tuple(rest)}, notes=notes)
            made = replace(made, command=source) if role == "command" else replace(made, wheels=source)
        return made

    def _report_command(self, chosen: Candidate, other: Candidate) -> None:
        text = (
            f"{chosen.source} is taken for the command, and not {other.source}: the motion follows the first "
            "later, and the second measures it or is not followed; [command] in run.toml names another"
        )
        self.findings.append(Finding("role_by_motion", "info", text, where="command"))

    def _read_again(self, wheels: Candidate, motion: Motion, kind: str = "differential") -> bool:
        """Read the wheels as corrected, or of another kind of vehicle; whether the body turns by them."""
        section = self._complete().wheels
        reading = self._read(wheels.source, is_measured=True, kind=kind, section=section)
        made = None if reading is None else reading.explain(motion)
        if reading is None or made is None or (kind == "ackermann" and not made.sign("turned")):
            return False
        wheels.reading = reading
        return True

    def _find_kind(self, wheels: Candidate | None, motion: Motion) -> str:
        """A car, if joints of the wheels' topic steer and the body turns by them; else nothing."""
        given = self.configuration.vehicle.list_values().get("kind")
        kind = str(given or (self.vehicle.kind if self.is_known else "ackermann"))
        if self.moves_sideways:
            # Wheels of which each moves the body sideways as those with rollers do.
            is_mecanum = wheels is not None and wheels.reading.form == "sides" and wheels.sign("aside")
            return "" if self.is_known else "mecanum" if is_mecanum else "omni"
        if wheels is None or wheels.source.form is not DriveForm.JOINTS or kind != "ackermann":
            return ""
        return "ackermann" if self._read_again(wheels, motion, kind) else ""

    def _leave_out_steered(self, wheels: Candidate) -> bool:
        """Leave out wheels beside joints that steer, of a vehicle that is no car; whether there are any."""
        is_given = self.is_known or "kind" in self.configuration.vehicle.list_values()
        if is_given or wheels.source.form is not DriveForm.JOINTS:
            return False
        steered = list_steered(self.extraction.columns[wheels.source.signals[0].topic])
        if not steered:
            return False
        text = (
            f"not used: {wheels.source}: {enumerate_texts(steered)} steer, so this is not a differential "
            "drive, and it does not turn as a car that steers by the middle of them (several axles steer, or "
            "each wheel by itself); steering_joint and left and right under [wheels] and "
            '[vehicle] kind = "ackermann" in run.toml take it for a car'
        )
        self.findings.append(Finding("wheels_steered", "warning", text, where="wheels"))
        self.sources = replace(self.sources, wheels=None)
        return True

    # Positions in other units, and signals that lack something.

    def _settle_lengths(
        self,
        motion: Motion,
        readings: Sequence[Reading],
        command: Candidate | None,
        wheels: Candidate | None,
    ) -> Motion:
        """The motion in metres, and the readings fitted to it."""
        source = self.sources.pose
        if source is None or source.content is not PoseContent.POSE or self.configuration.pose.unit:
            return motion
        gains: dict[str, float | None] = {"body": None, "sides": None, "steering": None}
        for drive in (command, wheels):
            made = None if drive is None else drive.reading.explained
            if drive is not None and made is not None and drive.sign("ahead") and not is_crossed(drive):
                gains[drive.reading.form] = abs(float(made.ahead.gains[0]))
        radius = self.vehicle.wheel_radius_m if self.is_known else None
        unit = find_pose_unit(gains["body"] or gains["steering"], gains["sides"], radius)
        if unit == "m":
            return motion
        self._correct("pose", f"the positions of {source} are in {unit}", f'unit = "{unit}"', {"unit": unit})
        self.extraction.configuration = self._complete()
        scaled = measure_motion(self.extraction.poses())
        if scaled is None:
            return motion
        scaled = scaled.turn(flip=motion.flip, offset_deg=motion.offset_deg)
        for one in readings:
            one.explain(scaled)
        return scaled

    def _leave_out_sizes(self, drives: Sequence[Candidate]) -> list[Candidate]:
        """The candidates without wheel speeds that are sizes alone, as of sensors that know no direction."""
        asked = [
            one.reading.first.values
            for one in drives
            if one.reading.form == "body" and one.is_sure and one.reading.first is not None
        ]
        back = max((min(_share_back(one), _share_back(-one)) for one in asked), default=0.0)
        signed = []
        for one in drives:
            sides = [] if one.reading.form != "sides" else one.reading.inputs
            if back < _BOTH_WAYS or not sides or any(side.values.min() < 0.0 for side in sides):
                signed.append(one)
                continue
            text = (
                f"not used: {one.source}: its speeds have no sign: they are never below zero, though the "
                "body is driven forward and backward"
            )
            self.findings.append(Finding("wheels_unsigned", "warning", text, where="wheels"))
            for role in ("command", "wheels"):
                if getattr(self.sources, role) == one.source:
                    others = self.sources.rank_drives(role)
                    left = next((other for other in others if other.signals != one.source.signals), None)
                    self.sources = replace(self.sources, **{role: left})  # type: ignore[arg-type]
        return signed

    def _is_in_degrees(self, gyro: Reading, motion: Motion) -> bool:
        """Whether a gyro turns out to be in degrees per second, and is corrected."""
        made = gyro.explain(motion)
        if made is None or not made.sign("turned") or self.configuration.imu.unit is not None:
            return False
        apart = np.log(abs(float(made.turned.gains[0])) / RATES["deg/s"])
        if abs(apart) > 4.0 * _NEAR:
            return False
        what = f"the gyro of {gyro.name} is in degrees per second"
        self._correct("imu", what, 'unit = "deg/s"', {"unit": "deg/s"})
        return True

    # Sides and signs.

    def _settle_wheels(self, command: Candidate | None, wheels: Candidate | None, motion: Motion) -> bool:
        """Correct single encoders, the wheels read anew after each; whether signs of sides are judged."""
        if wheels is None:
            return self._report_sides(motion, command, wheels)
        if not wheels.is_measured and self.configuration.wheels != DriveSection():
            self._read_again(wheels, motion)
        # An encoder that dies is on no other scale before.
        if self.leave_out(wheels, command, motion):
            wheels.reading.explained = None
            self._read_again(wheels, motion)
        if self._settle_joints(wheels, motion):
            self._read_again(wheels, motion)
        is_judged = self._report_sides(motion, command, wheels)
        if "reversed" in self.changes.get("wheels", {}):
            # What is wrong beside a side that is corrected shows now.
            is_judged = not self._read_again(wheels, motion)
        if self._settle_scales(wheels, motion):
            self._read_again(wheels, motion)
        return is_judged

    def _report_sides(self, motion: Motion, command: Candidate | None, wheels: Candidate | None) -> bool:
        """A side that is dead or counts backward; whether one was found."""
        if wheels is not None and wheels.reading.form == "sides" and self._report_dead(wheels):
            return True
        of_wheels = wheels is not None and wheels.is_sure and is_crossed(wheels)
        of_command = command is not None and command.is_sure and is_crossed(command)
        if of_wheels and wheels is not None and wheels.reading.explained is not None and not of_command:
            # Of a heading that was turned the command tells which way is ahead.
            is_behind = bool(motion.offset_deg) and command is not None and command.sign("ahead") < 0
            is_right = (wheels.reading.explained.ahead.gains[0] > 0.0) != is_behind
            side = "right" if is_right else "left"
            margin = wheels.reading.explained.sign_margin
            self._correct(
                "wheels",
                f"the {side} wheels' encoder counts backward",
                f'reversed = "{side}"',
                {"reversed": side},
                margin,
            )
            return True
        if of_command and command is not None and command.reading.explained is not None:
            explained = command.reading.explained
            # A body command reaches the right side as speed plus turn.
            is_right = (
                (explained.ahead.gains[0] < 0.0)
                if command.reading.form == "body"
                else explained.ahead.gains[0] > 0
            )
            side = "right" if is_right else "left"
            also = (
                "and its encoder with it"
                if of_wheels
                else "and its encoder counts what it does"
                if wheels is not None
                else "as far as commands and poses tell"
            )
            text = (
                f"the {side} side of the drive runs backward against its command, {also}: the polarity of "
                "its motor is wrong; exchange its wires, or turn its sign in the driver"
            )
            self.findings.append(
                Finding("motor_reversed", "error", text, where="command", value=explained.sign_margin)
            )
            return True
        return False

    def _settle_joints(self, wheels: Candidate, motion: Motion) -> bool:
        """Correct single wheels that contradict all others of a topic of joints; whether there are any."""
        section, reading = self._complete().wheels, wheels.reading
        is_free = section.factors is None and section.left is None and section.right is None
        if wheels.source.form is not DriveForm.JOINTS or reading.form != "sides" or not is_free:
            return False
        times, rates = self.extraction.read_rates(wheels.source)
        chosen = choose_sides(sorted(rates), section)
        sides = {joint: side for side, joints in chosen.items() for joint in joints}
        late = (0.0, 0.0) if reading.explained is None else (reading.explained.lag, reading.explained.delay)
        turning = {
            joint: measure_wheel(Held(times, rates[joint]), motion, late, reading.inputs)
            for joint in sorted(sides)
        }
        factors, idle = find_odd_joints(turning, sides)
        factors = {joint: float(f"{factor:.4g}") for joint, factor in factors.items()}
        for joint, factor in factors.items():
            how = "counts backward" if factor < 0.0 else "counts"
            if abs(factor) != 1.0:
                how += f" {1.0 / abs(factor):.3g} times as fast as"
            else:
                how += " against"
            what = f"{joint} of {wheels.source} {how} the other wheels"
            line = ", ".join(f'"{name}" = {value:g}' for name, value in factors.items())
            self._correct("wheels", what, f"factors = {{{line}}}", {"factors": factors})
        for side, joints in chosen.items():
            left = [joint for joint in joints if joint not in idle]
            if left == joints or self.moves_sideways:
                continue
            lost = enumerate_texts([joint for joint in joints if joint in idle])
            named = ", ".join(f'"{joint}"' for joint in left)
            line = f"{side} = [{named}]"
            what = (
                f"the drive does not turn {lost} of {wheels.source}, as it does the other wheels of its side"
            )
            self._correct("wheels", what, line, {side: left})
        return bool(factors or idle)

    def _settle_scales(self, wheels: Candidate, motion: Motion) -> bool:
        """Correct a side whose encoder counts on another scale than the other; whether one does."""
        reading, made = wheels.reading, wheels.reading.explained
        first, second = reading.first, reading.second
        is_free = self._complete().wheels.factors is None
        if reading.form != "sides" or first is None or second is None or made is None or not is_free:
            return False
        late = (made.lag, made.delay)
        left, right = (measure_wheel(one, motion, late, (first, second)) for one in (first, second))
        scale = compare_sides(left, right)
        if scale is None:
            return False
        counts = {"left": abs(float(left.gains[0])), "right": abs(float(right.gains[0]))}
        side, other = ("left", "right") if scale > 1.0 else ("right", "left")
        if self.is_known:
            # What does not explain all of a wheel's turning makes both seem low.
            high, low = (abs(np.log(counts[one] * self.vehicle.wheel_radius_m)) for one in (side, other))
            side, other = (other, side) if low - high > 0.5 * abs(np.log(scale)) else (side, other)
        factor = float(f"{1.0 / snap(counts[side] / counts[other]):.4g}")
        what = (
            f"the {side} wheels' encoder counts {1.0 / factor:.3g} times as much as the {other} one for "
            "the same motion (another gear or resolution?)"
        )
        self._correct("wheels", what, f"factors = {{{side} = {factor:g}}}", {"factors": {side: factor}})
        return True

    def leave_out(self, wheels: Candidate, command: Candidate | None, motion: Motion | None) -> bool:
        """Leave out where an encoder reads nothing while all else goes on; whether any is left out."""
        reading, section = wheels.reading, self._complete().wheels
        if section.ignore is not None or reading.dead_side or not reading.inputs:
            return False
        names = SIDES if reading.form == "sides" else ("both",)
        sides = {name: one for name, one in zip(names, (reading.first, reading.second), strict=False) if one}
        made = reading.explained
        late = (0.0, 0.0) if made is None else (made.lag, made.delay)
        asked = command.reading if command is not None and command.is_sure else None
        outages = find_outages(sides, late, asked, motion)
        if not outages:
            return False
        kind = "ackermann" if reading.form == "steering" else "differential"
        self.extraction.vehicle = self._make_unit(wheels.source, kind)
        table = self.extraction.read_drive(wheels.source, section, held=False)
        stamps = table["t"].to_numpy()
        clock = (table["log_time"].to_numpy() - self.extraction.data.index.start_ns) / 1e9
        words = {
            "the commands": asked,
            "the poses": motion,
            "the other wheels": asked is None or motion is None,
        }
        witnesses = [word for word, is_there in words.items() if is_there]
        texts, spans = [], []
        for one in outages:
            inside = (stamps >= one.start) & (stamps < one.end)
            columns = [name for name in (*SIDES, "speed") if one.side in {name, "both"}]
            is_read = table.filter(pl.Series(inside)).filter(pl.any_horizontal(pl.col(columns).is_finite()))
            ends = [max(one.start, stamps[0]), *is_read["t"].to_list(), min(one.end, stamps[-1])]
            is_silent = is_read.height < 2 or max(np.diff(ends)) > 0.5 * (ends[-1] - ends[0])  # noqa: PLR2004
            reads = "nothing" if is_silent else one.reads
            start, end = (
                at if np.isinf(at) else float(np.interp(at, stamps, clock)) for at in (one.start, one.end)
            )
            when = f"from {start:.0f} to {end:.0f} s"
            if end == np.inf:
                when = f"from {start:.0f} s on"
            elif start == -np.inf:
                when = f"until {end:.0f} s"
            who = (
                "both wheels' encoders read"
                if one.side == "both"
                else f"the {one.side} wheels' encoder reads"
            )
            texts.append(f"{who} nothing {when} ({_READS[reads]} while {enumerate_texts(witnesses)} go on)")
            # In hundredths, which the line of the text has as well.
            first = None if np.isinf(start) else float(np.floor(1e2 * start) / 1e2)
            last = None if np.isinf(end) else float(np.ceil(1e2 * end) / 1e2)
            spans.append(OutageSection(side=one.side, start_s=first, end_s=last))  # type: ignore[arg-type]
        self.changes.setdefault("wheels", {})["ignore"] = spans
        text = (
            f"{'; '.join(texts)}: left out, as ignore = {_write_spans(spans)} under [wheels] in run.toml "
            "does; ignore = [] takes it as recorded"
        )
        begin = None if np.isinf(outages[0].start) else outages[0].start
        self.findings.append(
            Finding("encoder_dead", "warning", text, where="wheels", t_start=begin, count=len(outages))
        )
        return True

    def _report_dead(self, wheels: Candidate) -> bool:
        dead = wheels.reading.dead_side
        if not dead:
            return False
        other = next(side for side in SIDES if side != dead)
        text = (
            f"the {dead} wheels' encoder reads the same throughout while the {other} wheels turn: it is "
            f"dead (take --input command, or correct [wheels] {dead})"
        )
        self.findings.append(Finding("wheel_dead", "error", text, where=f"wheels {dead}"))
        return True

    def _report_signs(
        self, motion: Motion, command: Candidate | None, wheels: Candidate | None, gyro: Reading | None
    ) -> None:
        signs: dict[tuple[str, Axis], int] = {}
        for name, drive in (("command", command), ("wheels", wheels)):
            if drive is not None:
                axes: tuple[Axis, ...] = ("ahead", "turned", "aside")
                sign = drive.sign if drive is command else drive.sign_as_motion
                signs |= {(name, axis): sign(axis) for axis in axes}
        if gyro is not None and gyro.explained is not None:
            signs["gyro", "turned"] = gyro.explained.sign("turned")
        up, offset = motion.up, motion.offset_deg
        if up != "z" and -1 in {sign for (_, axis), sign in signs.items() if axis == "turned"}:
            # Neither way along another axis is usual.
            up, offset = f"-{up}", -offset
            signs = {key: sign if key[1] == "ahead" else -sign for key, sign in signs.items()}
        if offset and -1 in {sign for (_, axis), sign in signs.items() if axis == "ahead"}:
            offset += 180.0
            signs = {key: sign if key[1] == "turned" else -sign for key, sign in signs.items()}
        made = find_reversed(signs)
        if made.rivals:
            self._report_either(made, signs, command, wheels)
        else:
            for fault in made.faults:
                if fault == "pose_backward":
                    offset += 180.0
                elif fault == "pose_mirrored":
                    up, offset = up.removeprefix("-") if up.startswith("-") else f"-{up}", -offset
                else:
                    self._report_fault(fault, command, wheels)
        self._report_frame(up, 180.0 - (180.0 - offset) % 360.0, signs)

    def _report_frame(self, up: str, offset: float, signs: dict[tuple[str, Axis], int]) -> None:
        source = self.sources.pose
        who, drivers = _name_witnesses(signs, "turned"), _name_witnesses(signs, "ahead")
        if up != "z":
            direction, axis = ("down" if up.startswith("-") else "up"), up.removeprefix("-")
            what = f"the {axis} axis of the poses of {source} points {direction}"
            if axis == "z":
                what += " (north, east, down)"
            else:
                what += ", as of motion capture or of a camera's optical frame: the body turns about it"
            self._correct("pose", f"{what}, as {who} show", f'up = "{up}"', {"up": up})
        if offset:
            side = "right" if offset > 0.0 else "left"
            off = f"{abs(offset):.0f} degrees to the {side}"
            what = f"the heading of {source} is {off} of the course of {drivers}"
            if abs(offset) == _HALF_TURN:
                what = (
                    f"the poses of {source} look to the rear where {drivers} drive ahead (a sensor that is "
                    "mounted backward, or base_link points to the rear)"
                )
            self._correct("pose", what, f"heading_deg = {offset:g}", {"heading_deg": float(f"{offset:g}")})

    def _report_fault(
        self, fault: str, command: Candidate | None, wheels: Candidate | None, others: Sequence[str] = ()
    ) -> None:
        """Correct or report a fault; the sign of a gyro is fitted by `stages.align`."""
        drive = wheels if fault.startswith("wheels") else command
        if fault == "gyro" or drive is None:
            return
        change: dict[str, object] = dict(_CHANGES.get(fault, {}))
        is_car = drive.reading.form == "steering"
        if change and (drive.reading.form == "sides" or (is_car and fault == "wheels_both")):
            what = f"the speed of {drive.source} counts backward" if is_car else _FAULTS[fault]
            line = ", ".join(f"{key} = {str(value).lower()}" for key, value in change.items())
            self._correct("wheels", what, line, change)
            return
        role = "wheels" if drive is wheels else "command"
        faults = "; or ".join(_FAULTS[one] for one in (fault, *others))
        text = f"{drive.source} contradicts all other signals: {faults}"
        self.findings.append(Finding(f"{role}_reversed", "error", text, where=role))

    def _report_either(
        self,
        made: Reversal,
        signs: dict[tuple[str, Axis], int],
        command: Candidate | None,
        wheels: Candidate | None,
    ) -> None:
        """Two signals that contradict each other, with what mends the one and the other."""
        ways = (made.faults, *made.rivals)
        if all(len(names) == 1 and names[0].startswith("command") for names in ways):
            self._report_fault(made.faults[0], command, wheels, [names[0] for names in made.rivals])
            return
        against = sorted({name for (name, _), sign in signs.items() if sign < 0})
        verbs = {"ahead": "drive", "turned": "turn", "aside": "move sideways"}
        axes = sorted({axis for (_, axis), sign in signs.items() if sign < 0})
        remedies = {fault: f"{text}{_REMEDIES.get(fault, '')}" for fault, text in _FAULTS.items()}
        options = "; or ".join(
            " and ".join(remedies[name] for name in names) for names in (made.faults, *made.rivals)
        )
        text = (
            f"{' and '.join(_AGAINST[name] for name in against)} and the poses "
            f"{' and '.join(verbs[axis] for axis in axes)} opposite ways, and no third signal tells which of "
            f"them is wrong: either {options}"
        )
        self.findings.append(Finding("signs_contradict", "error", text, where=f"{against[0]}, pose"))

    # Units.

    def _settle_steering(self, drive: Candidate, motion: Motion) -> None:
        """Read a steering angle in the unit in which the body turns by it; which one it is is told later."""
        reading = drive.reading
        section = self._find_section(drive.source, is_measured=drive.is_measured)
        is_free = drive.source.form is DriveForm.STEERING and section.steering_unit is None
        if not is_free or drive.source.signals[1].unit or not isinstance(reading.second, Bent):
            return
        tried = {"rad": reading, "deg": replace(reading, second=reading.second.rescale(np.pi / 180.0))}
        nats, lengths = {}, dict[str, float | None]()
        for unit, one in tried.items():
            made = one.explain(motion) if unit != "rad" else one.explained
            nats[unit] = 0.0 if made is None else float((made.turned.blocks - made.none[1]).sum())
            turns = made is not None and made.sign("turned") and made.sign("ahead")
            lengths[unit] = (
                abs(float(made.ahead.gains[0] / made.turned.gains[0])) if made is not None and turns else None
            )
        known = self.vehicle.wheelbase_m if self.is_known else None
        drive.steering = find_steering_unit(nats, lengths, known, str(drive.source))
        if drive.steering.likeliest[1] == "deg":
            reading.second, reading.explained = tried["deg"].second, tried["deg"].explained

    def _settle_turn(self, drive: Candidate, motion: Motion) -> None:
        """Read a body command as speed and steering angle where the body turns by these, as some cars do."""
        reading, made = drive.reading, drive.reading.explained
        first, second = reading.first, reading.second
        is_open = not (self.is_known or self.moves_sideways or drive.is_measured or reading.form != "body")
        if not is_open or first is None or second is None or made is None or len(reading.inputs) < len(SIDES):
            return
        bent = Bent(first, second.times, second.values)
        steered = Reading("steering", reading.name, first, bent)
        other = steered.explain(motion)
        if other is None or not other.sign("turned") or made.crossed:
            return
        one, two = ((each.turned.blocks, each.none[1]) for each in (other, made))
        if one[0].size == two[0].size and compare(one[0] - one[1], two[0] - two[1]) > CLEAR:
            drive.reading, drive.source = steered, replace(drive.source, form=DriveForm.STEERING)
            drive.is_angle = True

    def _report_turn(self, command: Candidate | None) -> None:
        """A body command that holds steering angles; see `_settle_turn`."""
        if command is None or not command.is_angle:
            return
        speed, turn = command.source.signals
        text = (
            f"{command.source} holds steering angles in place of yaw rates: the vehicle turns by the speed "
            f'times their tangent: read so, as speed_topic = "{speed}" and steering_topic = "{turn}" under '
            "[command] in run.toml do"
        )
        self.findings.append(Finding("command_corrected", "warning", text, where="command"))

    def _find_units(self, command: Candidate | None, wheels: Candidate | None) -> None:
        for role, one in (("command", command), ("wheels", wheels)):
            if one is not None and one.reading.form == "steering":
                self._report_units(role, one, one.steering)
        if command is not None and command.reading.form != "sides" and self._is_usable(command):
            explained = command.reading.explained
            if explained is None:
                return
            # A car turns by its wheelbase, and not by a unit.
            turns = command.reading.form == "body" and command.sign("turned")
            gains = [
                abs(float(one.gains[0])) if is_seen else None
                for is_seen, one in ((command.sign("ahead"), explained.ahead), (turns, explained.turned))
            ]
            beside = None if wheels is None or not wheels.is_sure else wheels.reading.explained
            if wheels is not None and beside is not None and wheels.reading.form == "body":
                # What wheels do of a command is its unit on any ground.
                fits = (("ahead", beside.ahead), ("turned", beside.turned))
                gains = [
                    gain / abs(float(one.gains[0])) if gain and wheels.sign(axis) else gain  # type: ignore[arg-type]
                    for gain, (axis, one) in zip(gains, fits, strict=True)
                ]
            units = find_body_units(gains, explained.shares, str(command.source))
            self._report_units("command", command, units, gains)
        if wheels is not None and wheels.reading.form == "sides" and not is_crossed(wheels):
            self._find_wheel_unit(command, wheels)

    def _report_units(
        self, role: str, drive: Candidate, units: Units, gains: Sequence[float | None] = (None, None)
    ) -> None:
        """Correct units of a drive, or tell two readings that are as likely."""
        section = getattr(self.configuration, role)
        turn_key, turn = (
            ("steering_unit", "steering angle") if drive.steering is units else ("yaw_unit", "yaw rate")
        )
        for index, (key, what) in enumerate((("unit", "speed"), (turn_key, turn))):
            unit, of = units.likeliest[index], f"the {what} of {drive.source}"
            if getattr(section, key) is not None or not unit:
                continue
            if unit not in USUAL:
                speed, gain = units.likeliest[0], gains[0]
                is_sure = speed in USUAL or gain is None or is_unit_exact(gain, speed)
                unsure = ", or has no unit, as percent of a throttle, whose gains say nothing of the robot"
                text = f"{of} is in {unit}{'' if is_sure else unsure}"
                self._correct(role, text, f'{key} = "{unit}"', {key: unit})
            elif units.rival is not None and units.rival[index] != unit:
                other, gain = units.rival[index], gains[index]
                seen = "" if gain is None else f": the body moves {gain:.3g} times as far as it says"
                text = (
                    f"{of} may be in {other}{seen}; it is taken as {unit}, and no other signal tells which "
                    f'({key} = "{other}" under [{role}] in run.toml takes it so, {key} = "{unit}" settles it)'
                )
                self.findings.append(Finding("unit_undecided", "warning", text, where=role, value=gain))

    def _find_wheel_unit(self, command: Candidate | None, wheels: Candidate) -> None:
        """Unit of wheel speeds by the controller of a known vehicle, else by the motion."""
        explained, share = wheels.reading.explained, 1.0
        radius = self.vehicle.wheel_radius_m if self.is_known else None
        driven = None
        if radius is not None and command is not None:
            driven = self.driven = explain_wheels(command.reading, wheels.reading)
        if driven is not None and radius is not None and command is not None and driven.sign("ahead") > 0:
            # Wheels follow a command closely on any ground.
            of_command = radius if command.reading.form == "sides" else self._command_factors()[0]
            gain = of_command / float(driven.ahead.gains[0])
        elif explained is not None and wheels.is_sure and wheels.sign("ahead"):
            gain, share = float(explained.ahead.gains[0]), explained.shares[0]
        else:
            return
        self._correct_wheel_unit(wheels, gain, share, radius)

    def _correct_wheel_unit(
        self, wheels: Candidate, gain: float, share: float, radius: float | None = None
    ) -> None:
        """Correct the unit of wheel speeds, unless the type or the user gives it; see `find_wheel_unit`."""
        if wheels.source.signals[0].unit or self.configuration.wheels.unit is not None:
            return
        unit = find_wheel_unit(gain, share, str(wheels.source), radius)
        what = f"the wheel speeds of {wheels.source} are in "
        taken = (
            "" if radius is not None else f": taken as those of wheels of {_TAKEN_M} m, which alters no slip"
        )
        if not unit:
            what += f"no usual unit (ticks, or turns before a gear?){taken}"
            scale = float(f"{gain / _TAKEN_M:.4g}")
            self._correct("wheels", what, f"scale = {scale:g}", {"scale": scale})
        elif unit != "rad/s":
            what += f"{unit}{taken if unit == 'm/s' else ''}"
            self._correct("wheels", what, f'unit = "{unit}"', {"unit": unit})

    def _is_usable(self, drive: Candidate) -> bool:
        return drive.is_sure and not is_crossed(drive)

    # Scale of the command, and how long it is valid.

    def _measure_command(
        self, command: Candidate | None, wheels: Candidate | None, kind: str, motion: Motion | None
    ) -> Alignment | None:
        """Corrections of the command as it is read with all others; its time-out goes into the configuration.

        Args:
            command: the candidate for it.
            wheels: the candidate for them.
            kind: of the vehicle, if its signals show it.
            motion: of the poses; None where wheels stand in for them.
        """
        if command is None:
            return None
        vehicle, made = self.vehicle, self._complete()
        if kind and not self.is_known:
            vehicle = msgspec.structs.replace(vehicle, kind=kind)
        self.extraction.vehicle = vehicle
        try:
            asked = self.extraction.read_drive(command.source, made.command, held=True)
            got = pl.DataFrame()
            if wheels is not None:
                got = self.extraction.read_drive(wheels.source, made.wheels, held=False)
        except SlipError:
            return None
        is_body = command.reading.form == "body"
        alignment = Alignment(track_multiplier=vehicle.controller_track_multiplier)
        if self.is_known or not is_body:
            gain, made_of = None, command.reading.explained
            if is_body and made_of is not None and command.sign("ahead") > 0:
                gain = float(made_of.ahead.gains[0]) / self._command_factors()[0]
            late = None if self.driven is None else (self.driven.lag, self.driven.delay)
            alignment, findings = measure_command_scale(
                asked, got, vehicle, body_commanded=is_body, gain=gain, late=late
            )
            self.findings += findings
        rates = motion.rates if got.is_empty() and motion is not None else None
        if rates is None and not got.is_empty():
            rates = roll(got, vehicle)
        timeout = None if rates is None else find_timeout(*rates, asked, vehicle)
        if timeout is not None:
            hold_s = made.command.hold_s or timeout.seconds
            self.changes.setdefault("command", {})["hold_s"] = hold_s
            self.findings.append(report_timeout(timeout, hold_s))
        return alignment

    # Geometry.

    def _measure(self, command: Candidate | None, wheels: Candidate | None) -> Geometry:
        made = Geometry()
        car = next(
            (one for one in (wheels, command) if one is not None and one.reading.form == "steering"), None
        )
        if car is not None and car.reading.explained is not None and car.sign("turned"):
            return measure_car(car.reading.explained, is_measured=car is wheels)
        if wheels is None or wheels.reading.form != "sides":
            sides = command if command is not None and command.reading.form == "sides" else None
        else:
            sides = wheels
        if (
            sides is not None
            and sides.is_sure
            and not is_crossed(sides)
            and sides.reading.explained is not None
        ):
            rolled, effective = measure_geometry(sides.reading.explained)
            factor = self._wheel_factor()
            made = replace(made, rolled=_scale(rolled, factor), effective=effective)
        if (
            command is not None
            and wheels is not None
            and wheels.reading.form == "sides"
            and command.reading.form == "body"
        ):
            lengths = measure_controller(command.reading, wheels.reading)
            if lengths is not None:
                speed, rate = self._command_factors()
                radius = _scale(lengths[0], speed * self._wheel_factor())
                made = replace(made, radius=radius, track=_scale(lengths[1], speed / rate))
        changes = self.changes.get("wheels", {})
        return replace(made, is_taken="scale" in changes or changes.get("unit") == "m/s")

    def _command_factors(self) -> tuple[float, float]:
        """Factors from a body command as it was read to m/s and rad/s."""
        changes = self.changes.get("command", {})
        return SPEEDS[str(changes.get("unit", "m/s"))], RATES[str(changes.get("yaw_unit", "rad/s"))]

    def _wheel_factor(self) -> float:
        """Factor from the radius of raw wheel speeds to that of rad/s."""
        changes = self.changes.get("wheels", {})
        if changes.get("unit") == "m/s":
            return _TAKEN_M
        return 1.0 / WHEELS[str(changes.get("unit", "rad/s"))] / float(str(changes.get("scale", 1.0)))

    # What the user reads, and what the stages read.

    def _correct(
        self, section: str, what: str, line: str, change: dict[str, object], margin: float | None = None
    ) -> None:
        """Apply a correction, or tell it where the user's configuration decides otherwise."""
        default = type(getattr(self.configuration, section))()
        given = [
            key
            for key in change
            if getattr(getattr(self.configuration, section), key) != getattr(default, key)
        ]
        name = "pose_turned" if section == "pose" else f"{section}_corrected"
        if "up" in change and not given and self.configuration.pose.axes != default.axes:
            given = ["axes"]
        if given and section == "pose":
            text = f"{what}, but [pose] in run.toml gives {', '.join(given)}, which is taken as it is given"
            self.findings.append(Finding("pose_contradicted", "warning", text, where=section, value=margin))
            return
        if given:
            text = f"{what}, but [{section}] in run.toml gives {', '.join(given)}: correct it"
            self.findings.append(Finding("signs_contradict", "error", text, where=section))
            return
        self.changes.setdefault(section, {}).update(change)
        settled = [text for key, text in _AS_RECORDED[section].items() if key in change]
        otherwise = "".join(f"; {text} takes them as recorded" for text in settled)
        text = f"{what}: corrected, as {line} under [{section}] in run.toml does{otherwise}"
        self.findings.append(Finding(name, "warning", text, where=section, value=margin))

    def _complete(self) -> Configuration:
        sections = {
            name: msgspec.structs.replace(getattr(self.configuration, name), **change)
            for name, change in self.changes.items()
        }
        return msgspec.structs.replace(self.configuration, **sections)


_HALF_TURN = 180.0
_AS_RECORDED: Mapping[str, Mapping[str, str]] = {
    "imu": {"unit": 'unit = "rad/s"'},
    "pose": {"up": 'up = "z"', "heading_deg": "heading_deg = 0", "unit": 'unit = "m"'},
    "wheels": {"unit": 'unit = "rad/s"', "steering_unit": 'steering_unit = "rad"'},
    "command": {
        "unit": 'unit = "m/s"',
        "yaw_unit": 'yaw_unit = "rad/s"',
        "steering_unit": 'steering_unit = "rad"',
    },
}
"""Lines of run.toml that keep a correction from being made; the defaults of other keys do not."""
_AGREE = {"command": "commands", "wheels": "wheels", "gyro": "the gyro"}
_AGAINST = {"command": "the commands", "wheels": "the measured wheels", "gyro": "the gyro"}
_FAULTS = {
    "pose_backward": "the frame of the poses points to the rear, as that of a sensor that is mounted "
    "backward",
    "pose_mirrored": "the poses' frame is of the other hand, as north, east, down",
    "command_ahead": "the sign of linear.x is wrong where it is sent, or both motors are reversed",
    "command_turned": "the sign of angular.z or of the steering is inverted, or left and right are exchanged",
    "command_aside": "the sign of linear.y is wrong where it is sent",
    "command_mirrored": "left and right are exchanged where it is sent",
    "command_both": "its sign is wrong where it is sent, or both motors are wired backward",
    "wheels_both": "both encoders count backward",
    "wheels_exchanged": "left and right encoders are exchanged",
    "wheels_exchanged_both": "both encoders count backward, and are exchanged",
    "gyro": "the gyro is mounted upside down",
}
_CHANGES: Mapping[str, Mapping[str, object]] = {
    "wheels_both": {"sign": -1},
    "wheels_exchanged": {"exchanged": True},
    "wheels_exchanged_both": {"sign": -1, "exchanged": True},
}
_REMEDIES = {
    "pose_backward": " (heading_deg = 180 under [pose] in run.toml)",
    "pose_mirrored": ' (up = "-z" under [pose] in run.toml)',
    "wheels_both": " (sign = -1 under [wheels] in run.toml)",
    "wheels_exchanged": " (exchanged = true under [wheels] in run.toml)",
    "wheels_exchanged_both": " (sign = -1 and exchanged = true under [wheels] in run.toml)",
}


_READS = {
    "nothing": "no reading is recorded",
    "zero": "zero is recorded",
    "one value": "one value is repeated",
    "noise": "noise is recorded",
}


def _write_spans(spans: Sequence[OutageSection]) -> str:
    """As a line of TOML."""
    parts = []
    for one in spans:
        ends = {"start_s": one.start_s, "end_s": one.end_s}
        keys = [f'side = "{one.side}"', *(f"{key} = {at:g}" for key, at in ends.items() if at is not None)]
        parts.append(f"{{{', '.join(keys)}}}")
    return f"[{', '.join(parts)}]"


def _name_witnesses(signs: Mapping[tuple[str, Axis], int], axis: Axis) -> str:
    """The signals that show in which way a body turns, or drives."""
    there = {name for (name, of), sign in signs.items() if sign and of == axis}
    return enumerate_texts([word for name, word in _AGREE.items() if name in there]) or "the other signals"


def _column(table: pl.DataFrame, name: str) -> tuple[Floats, Floats]:
    """Times and values of a column."""
    return table["t"].to_numpy(), table[name].cast(pl.Float64).fill_null(np.nan).to_numpy()


def _hold(table: pl.DataFrame, name: str, *, may_stand: bool = False) -> Held:
    """A column as a signal, which counts in the intervals in which commands are live."""
    return Held(*_column(table, name), may_stand=may_stand, counts=table["active"].to_numpy())


def is_crossed(drive: Candidate) -> bool:
    """Whether one side counts backward: by the motion ahead, of a body command by turning, too."""
    explained = drive.reading.explained
    if explained is None or not explained.crossed:
        return False
    sizes = [abs(float(explained.ahead.t[0])), abs(float(explained.turned.t[0]))]
    return sizes[0] > CLEAR and (drive.reading.form == "sides" or sizes[1] > CLEAR)


def _share_back(speeds: Floats) -> float:
    """Share of the moving samples in which something goes backward."""
    top = float(np.quantile(np.abs(speeds), 0.95)) if speeds.size else 0.0
    moving = np.abs(speeds) > LIVE_SHARE * top
    return float(np.mean(speeds[moving] < 0.0)) if moving.any() else 0.0


def _scale(length: Length | None, factor: float) -> Length | None:
    return None if length is None else Length(length.value * factor, length.error * factor)


def describe(reading: Reading, roles: Mapping[int, str]) -> Evidence:
    """How the motion follows a reading, with its role by identity."""
    made, role = reading.explained, roles.get(id(reading), "")
    if made is None:
        sizes = [one.values.size for one in (reading.first, reading.second) if one is not None]
        is_constant = not reading.inputs and max(sizes, default=0) >= FEWEST_STEPS
        why = "it is the same throughout" if is_constant else "too little of it is recorded beside the motion"
        return Evidence(reading.name, role, why)
    gains = (float(made.ahead.gains[0]), float(made.turned.gains[0]))
    reason = "" if role else "another is as likely" if made.is_sure else "the motion does not follow it"
    if not role and made.is_sure and max(abs(gain - 1.0) for gain in gains) < _EQUAL:
        reason = "it measures the motion"
    return Evidence(
        reading.name,
        role,
        reason,
        made.moves,
        *gains,
        made.lag + made.delay,
    )
