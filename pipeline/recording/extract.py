"""The extract stage: from the columns of a log to tables of commands, wheels, poses and gyro."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Self

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from pipeline.core import PERIODS, ROUNDING_S, Flags, Floats, Ints, SlipError, rigid
from pipeline.logs import TopicColumns
from pipeline.recording import pose_topics, topic_values
from pipeline.recording.clocks import Recorded, TopicClock, align_clocks, find_pauses
from pipeline.recording.drive import (
    SIGNALS,
    interpolate_readings,
    is_angle,
    is_of_wheels,
    read_angles,
    read_joints,
    read_pair,
    read_rates,
    read_signal,
    read_speed,
    smooth_differences,
)
from pipeline.recording.echo import check_echo
from pipeline.recording.findings import Finding, StageError, blame_damage
from pipeline.recording.log_columns import LogColumns
from pipeline.recording.lost_messages import fill_gaps
from pipeline.recording.pose_topics import read_bodies
from pipeline.recording.rates import differentiate_angle, report_jumps
from pipeline.recording.tilt import lean
from pipeline.recording.topic_values import (
    Span,
    find_spans_given,
    find_spans_of_state,
    forget_states,
    is_inside,
)
from pipeline.sources import (
    DEFAULT_INTERVAL,
    UNKNOWN_VEHICLE,
    Configuration,
    DriveForm,
    DriveSection,
    DriveSource,
    IntervalSection,
    OutageSection,
    PoseContent,
    PoseSource,
    Sources,
    Vehicle,
    find_type,
    list_presets,
)

if TYPE_CHECKING:
    from pipeline.recording.satellite import Turning

# The extract stage: from the columns of a log to tables of commands, wheels, poses and gyro.
#
# All times are converted to one base (see `clocks`); nothing is resampled here. Rows that break their
# contract are written as well: the store moves them to quarantine, where they can be inspected.

Stamps = Ints

_LONGEST_STEP_S = 1.0
"""Longest time between two readings of wheels over which their motion is integrated: a second, as that of a
reading that is repeated."""
_DEFAULT_SECTION = IntervalSection(topic=DEFAULT_INTERVAL[0], equals=DEFAULT_INTERVAL[1])


@dataclass(frozen=True)
class Given:
    """A log with what is known of it: what its examination and its extraction start from.

    Attributes:
        log: columns of the wanted topics (see `topic_values.list_wanted`).
        sources: topic of each role; before an examination, candidates by type and name, the likeliest first.
        configuration: units, signs, clocks, intervals.
        vehicle: the log's, or `UNKNOWN_VEHICLE` of its kind.
        where: the log, for error messages.
    """

    log: LogColumns
    sources: Sources
    configuration: Configuration
    vehicle: Vehicle
    where: str

    @property
    def is_known(self) -> bool:
        """Whether the vehicle's geometry is known."""
        return self.vehicle.id != UNKNOWN_VEHICLE

    def may_move_sideways(self, sources: Sources) -> bool:
        """Whether the vehicle may move to the side, by its kind or by what it is asked or measured to do."""
        drives = dict.fromkeys((*sources.rank_drives("command"), *sources.rank_drives("wheels")))
        return self.vehicle.kinematics.has_inputs("sideways") or any(
            topic_values.find_sideways_share(self.log.data.topics, one) for one in drives
        )


@dataclass(frozen=True)
class Extracted:
    """Result of the extract stage.

    Attributes:
        tables: commands, wheels, poses, imu, empty without a source.
        findings: findings of the stage.
        start_ns: stamp at which t is zero.
        paused_s: total of the silences that do not count, see `clocks.find_pauses`.
        clocks: by topic: the time used and the latency of the recording [s].
        frames: reference frame and child frame of the poses; empty if not recorded.
    """

    tables: Mapping[str, pl.DataFrame]
    findings: tuple[Finding, ...]
    start_ns: int
    paused_s: float
    clocks: Mapping[str, Mapping[str, str | float]]
    frames: tuple[str, str] = ("", "")


def extract_tables(given: Given) -> Extracted:
    """Make the tables of the stage.

    Raises:
        StageError: a role's topic contains no usable data.
    """
    return Extraction(given).run()


class Extraction:
    """One log's extraction: columns, common clocks, and findings.

    `examine` reads every candidate of a log by it; a run reads the chosen sources.
    """

    def __init__(self, given: Given) -> None:
        self.log, self.data = given.log, given.log.data
        self.findings = list(given.log.findings)
        topics = self.data.topics
        self.sources = sources = given.sources
        self.configuration = configuration = given.configuration
        self.vehicle, self.where = given.vehicle, given.where
        self.frames = ("", "")
        self._orders: dict[str, Ints] = {}
        # What is recorded beside the command explains it: it takes no part in clocks and in the time base.
        beside = sources.body_beside
        aside = None if beside is None else beside.signals[0].topic
        self.columns: dict[str, TopicColumns] = {}
        for topic in dict.fromkeys(columns.topic for columns in topics if columns.topic != aside):
            joined, findings = self.log.join(topic)
            self.findings += findings
            if joined is not None:
                self.columns[topic] = joined
        if (
            configuration.imu.unit == "deg/s"
            and sources.imu is not None
            and sources.imu.topic in self.columns
        ):
            turned = topic_values.turn_to_radians(self.columns[sources.imu.topic])
            self.columns[sources.imu.topic] = turned
        unfit = self.data.unfit
        used = (
            {one.topic for one in topic_values.list_wanted(sources, self.data.index.types)} if unfit else ()
        )
        self.findings += [self._report_left_out(one) for one in unfit if one.topic in used]
        pose = sources.pose
        self._drive = next((one.signals[0].topic for one in (sources.command, sources.wheels) if one), "")
        self.chain = (
            pose_topics.chain_poses(topics, pose, self.where, drive=self._drive)
            if pose and pose.from_transforms
            else None
        )
        self.paused_s = 0.0
        self.clocks = self._align()
        self.start_ns = self._find_start()

    def configure(self, **sections: object) -> Self:
        """The same log with other sections of the configuration."""
        configuration = msgspec.structs.replace(self.configuration, **sections)
        return type(self)(Given(self.log, self.sources, configuration, self.vehicle, self.where))

    def take_pose(self, pose: PoseSource) -> Self:
        """The same log with other poses, or one of the tracks between which they alternate."""
        sources = replace(self.sources, pose=pose)
        return type(self)(Given(self.log, sources, self.configuration, self.vehicle, self.where))

    def run(self) -> Extracted:
        """All tables."""
        tables = {"poses": self.poses(), "commands": self._commands, "wheels": self._wheels}
        tables["imu"] = self.imu()
        clocks: dict[str, dict[str, str | float]] = {
            clock.topic: {"clock": clock.clock, "latency_s": round(clock.latency_s, 6)}
            for clock in self.clocks.values()
        }
        return Extracted(tables, tuple(self.findings), self.start_ns, self.paused_s, clocks, self.frames)

    def _report_left_out(self, columns: TopicColumns) -> Finding:
        """Messages of a topic that lack the fields that its other type has."""
        topic, count = columns.topic, columns.log_time.size
        others = self.log.list_types(self.data.of(topic))
        values = {"count": count, "type": columns.type_name, "others": others}
        if count:
            first, last = ((int(time) - self.data.index.start_ns) / 1e9 for time in columns.log_time[[0, -1]])
            values |= {"first_s": first, "last_s": last}
        return Finding("type_left_out", "warning", topic, values)

    def _align(self) -> dict[str, TopicClock]:
        asked = self._asked_clocks()
        recorded = {
            topic: Recorded(
                topic, columns.log_time, columns.publish_time, columns.header_time, asked.get(topic)
            )
            for topic, columns in self.columns.items()
            if not pose_topics.is_transforms(columns)
        }
        if self.chain is not None and self.sources.pose is not None:
            topic, times = self.sources.pose.topic, self.chain
            recorded[topic] = Recorded(topic, times.log_time, times.log_time, times.time, asked.get(topic))
        clocks, findings = self.log.once(align_clocks, recorded)
        self.findings += findings
        pauses = find_pauses(times.log_time for times in recorded.values())
        self.paused_s = sum(after - last for last, after in pauses) / 1e9
        return clocks

    def _asked_clocks(self) -> dict[str, str | None]:
        asked: dict[str, str | None] = {}
        for source, section in (
            (self.sources.command, self.configuration.command),
            (self.sources.wheels, self.configuration.wheels),
        ):
            for signal in source.signals if source else ():
                asked[signal.topic] = section.time
        pose = self.sources.pose
        if pose is not None and pose.wheels is not None:
            asked |= {signal.topic: self.configuration.wheels.time for signal in pose.wheels.signals}
        elif pose is not None:
            asked[pose.topic] = self.configuration.pose.time
        if self.sources.imu:
            asked[self.sources.imu.topic] = self.configuration.imu.time
        return asked

    def _find_start(self) -> int:
        firsts = [
            int(clock.stamp[clock.usable].min()) for clock in self.clocks.values() if clock.usable.any()
        ]
        return min(firsts, default=0)

    def _seconds(self, stamp: Stamps) -> Floats:
        return (stamp - self.start_ns).astype(np.float64) / 1e9

    def _ordered(self, topic: str) -> tuple[TopicColumns, TopicClock, Ints] | None:
        """A topic with its clock, and the order of its usable messages in time."""
        columns, clock = self.columns.get(topic), self.clocks.get(topic)
        if columns is None or clock is None:
            return None
        if topic not in self._orders:
            self._orders[topic] = self._order(clock)
        return columns, clock, self._orders[topic]

    def _order(self, clock: TopicClock) -> Ints:
        """Usable messages in the order of their stamps; disorder is reported."""
        usable = np.flatnonzero(clock.usable)
        stamp, topic = clock.stamp[usable], clock.topic
        late = int((np.diff(stamp) < 0).sum())
        twice = int((np.diff(np.sort(stamp)) == 0).sum())
        if late:
            self.findings.append(Finding("out_of_order", "info", topic, {"count": late}))
        if twice:
            self.findings.append(Finding("duplicate_stamps", "warning", topic, {"count": twice}))
        return usable[np.argsort(stamp, kind="stable")]

    @cached_property
    def _spans(self) -> list[Span] | None:
        """Spans of live commands; None without restriction."""
        sections = self.configuration.interval
        spans = find_spans_given(sections, self.where)
        source = self.sources.interval
        if self.configuration.use_intervals == "all" or (source is None and not sections):
            return None
        if source is not None:
            ordered = self._ordered(source.topic)
            asked = [section for section in sections if section.topic] or [_DEFAULT_SECTION]
            if ordered is not None:
                columns, clock, order = ordered
                states = topic_values.texts(columns, "data")
                times, said = self._seconds(clock.stamp[order]), [states[i] for i in order.tolist()]
                known = forget_states(times, said, columns.log_time[order], self.data.losses)
                held = [span for section in asked for span in find_spans_of_state(times, said, section)]
                taken = [span for section in asked for span in find_spans_of_state(*known, section)]
                self._report_unknown(source.topic, held, taken)
                spans += taken
            states = [section.equals or DEFAULT_INTERVAL[1] for section in asked]
            values = " or ".join(map(repr, states))
            if not spans:
                said_so, lost = f"{source.topic} never says {values}", blame_damage(self.data.losses)
                if lost:
                    said_so = f"what can be read of {source.topic} does not say {values}{lost}"
                what = f"{said_so}, so that no command counts"
                hint = "Set another `equals` in [[interval]], or take everything with --interval all."
                raise StageError("no_interval", what, where=self.where, hint=hint)
            counted = {"count": len(spans), "states": states}
            self.findings.append(Finding("interval_applied", "info", source.topic, counted))
        return spans

    def _report_unknown(self, topic: str, held: Sequence[Span], taken: Sequence[Span]) -> None:
        """Tell for how long a state is not held, since it may have changed in what was lost."""
        end = float(self._seconds(np.array([self.data.index.end_ns]))[0])
        held_s, taken_s = (sum(min(last, end) - first for first, last in one) for one in (held, taken))
        if held_s > taken_s + ROUNDING_S:
            self.findings.append(Finding("state_unknown", "warning", topic, {"seconds": held_s - taken_s}))

    def find_tracks(self) -> Ints | None:
        """Number of each recorded pose's track, of two between which they alternate; None of one track."""
        if self.sources.pose is None or self.sources.pose.wheels is not None:
            return None
        stamp, _, arrays, _ = self._recorded_poses(self.sources.pose)
        return self._find_tracks(self._seconds(stamp), arrays.position)

    def _find_tracks(self, times: Floats, position: Floats) -> Ints | None:
        return self.log.once(pose_topics.find_tracks, times, position, self.configuration.velocity.jump_m)

    def poses(self) -> pl.DataFrame:
        """Table of the poses, upright and cut into segments."""
        source, spans = self.sources.pose, self._spans
        if source is None:
            return pl.DataFrame()
        stamp, log_time, arrays, breaks = self._recorded_poses(source)
        times = self._seconds(stamp)
        if source.track:
            rows = pose_topics.choose_track(self._find_tracks(times, arrays.position), source)
            stamp, log_time, arrays, times = stamp[rows], log_time[rows], arrays.take(rows), times[rows]
            breaks = np.diff(np.cumsum(breaks)[rows], prepend=0) > 0
        position, quaternion, leant = topic_values.put_upright(arrays, self.configuration.pose)
        if leant:
            leaning = {"lean_deg": float(np.degrees(leant))}
            self.findings.append(Finding("body_upside_down", "warning", source.topic, leaning))
        position, quaternion = self._lean(source, times, position, quaternion)
        limits = self.configuration.velocity
        track = self.log.once(
            pose_topics.cut_track, times, position, quaternion, breaks, limits, source.topic
        )
        self.findings += track.findings
        if source.wheels is not None:
            # Wheels at rest repeat their pose, and each reading is new all the same.
            track = replace(track, held=np.zeros_like(track.held))
        return pl.DataFrame(
            {
                **self._time_columns(times, stamp, log_time),
                "segment": track.segment.astype(np.int32),
                **{name: track.position[:, i] for i, name in enumerate("xyz")},
                **{f"q_{name}": track.quaternion[:, i] for i, name in enumerate("xyzw")},
                "held": track.held,
                "corrected": arrays.corrected if arrays.corrected is not None else np.zeros_like(track.held),
                "active": is_inside(times, spans),
            }
        )

    def _lean(
        self, source: PoseSource, times: Floats, position: Floats, quaternion: Floats
    ) -> tuple[Floats, Floats]:
        """Positions and quaternions, those in the plane with the slopes that an IMU tells."""
        imu = self._timed(self.sources.imu.topic) if self.sources.imu and source.wheels is None else None
        if imu is None:
            return position, quaternion
        turn = pose_topics.find_turn(self.data.topics, topic_values.frame_of(imu.columns))
        leaning = self.log.once(lean, times, position, quaternion, imu, turn)
        if leaning is None:
            return position, quaternion
        position, quaternion, steepest, angle = leaning
        values = {
            "value": steepest,
            "topic": source.topic,
            "imu": imu.columns.topic,
            "mounted_rad": float(angle),
        }
        self.findings.append(Finding("slope_by_imu", "info", "pose", values))
        return position, quaternion

    def _recorded_poses(self, source: PoseSource) -> tuple[Stamps, Stamps, topic_values.PoseArrays, Flags]:
        """Stamps, log times and poses of base_link in time order, and clock jumps."""
        topic = source.topic
        clock, columns = self.clocks.get(topic), self.columns.get(topic)
        if clock is None or not clock.usable.any():
            raise self._nothing("pose", topic)
        if source.wheels is not None:
            return self._follow_wheels(source.wheels, clock)
        if self.chain is not None:
            chain, order = self.chain, self._order(clock)
            arrays = topic_values.PoseArrays(
                chain.position, chain.quaternion, chain.parent, chain.child, chain.corrected
            )
            arrays, log_times = arrays.take(order), chain.log_time
            self.findings += pose_topics.report_chain(chain, source, self.data.topics, self._drive)
        elif columns is None:
            raise self._nothing("pose", topic)
        elif source.content is PoseContent.POSE:
            arrays, log_times = self._read_poses(source, columns), columns.log_time
            self.findings += pose_topics.report_frame(topic, arrays.parent)
            located = self._head_positions(source, arrays)
            order = self._order(clock) if located is None else located.rows
            arrays = arrays.take(order) if located is None else located.arrays
        else:
            order, arrays = self._locate_vehicle(source)
            log_times = columns.log_time
        self.frames = (arrays.parent, arrays.child)
        stamp, log_time = clock.stamp[order], log_times[order]
        breaks = _find_breaks(clock, log_time)
        if self.chain is None and source.content is PoseContent.POSE:
            arrays, findings = pose_topics.to_base_link(arrays, self.data.topics, topic)
            self.findings += findings
        return stamp, log_time, arrays, breaks

    def _follow_wheels(
        self, source: DriveSource, clock: TopicClock
    ) -> tuple[Stamps, Stamps, topic_values.PoseArrays, Flags]:
        """Stamps, log times and poses of measured wheels that roll without slip, and clock jumps."""
        wheels, findings = interpolate_readings(
            self.read_drive(source, self.configuration.wheels, self.vehicle, held=False)
        )
        self.findings += findings
        self._refuse_echo(wheels)
        kinematics = self.vehicle.kinematics
        inputs = {
            one.name: wheels[f"{one.name}_aligned"].cast(pl.Float64).fill_null(np.nan).to_numpy(writable=True)
            for one in kinematics.inputs
        }
        known = np.logical_and.reduce([np.isfinite(values) for values in inputs.values()])
        if known.sum() < topic_values.FEWEST_MESSAGES:
            raise self._nothing("wheels", source.signals[0].topic)
        ahead, aside, turning = kinematics.forward(
            {name: values[known] for name, values in inputs.items()}, self.vehicle
        )
        stamp, log_time = (wheels[name].to_numpy()[known] for name in ("stamp", "log_time"))
        elapsed = np.diff(self._seconds(stamp))
        # Across a gap the segment is cut, and nothing is known of the motion.
        elapsed[elapsed > _LONGEST_STEP_S] = 0.0
        turned = 0.5 * (turning[1:] + turning[:-1]) * elapsed
        yaw = np.append(0.0, np.cumsum(turned))
        velocity = ahead + 1j * aside
        moved = 0.5 * (velocity[1:] + velocity[:-1]) * elapsed * np.exp(1j * (yaw[:-1] + 0.5 * turned))
        path = np.append(0.0, np.cumsum(moved))
        flat = np.zeros(path.size)
        arrays = topic_values.PoseArrays(
            np.column_stack((path.real, path.imag, flat)),
            np.column_stack((flat, flat, np.sin(0.5 * yaw), np.cos(0.5 * yaw))),
            "",
            "",
        )
        return stamp, log_time, arrays, _find_breaks(clock, log_time)

    def _refuse_echo(self, wheels: pl.DataFrame) -> None:
        """Refuse wheels that repeat the commands where nothing else is measured."""
        command = self.sources.command
        body_commanded = command is not None and command.form is DriveForm.BODY
        if check_echo(self._commands, wheels, self.vehicle, body_commanded=body_commanded):
            what = (
                "the log holds no pose, and its measured wheels repeat the commands: a controller in open "
                "loop reports what it was asked for, and nothing was measured"
            )
            hint = "Record the encoders, or a localization."
            raise StageError("no_pose", what, where=self.where, hint=hint)

    def _read_poses(self, source: PoseSource, columns: TopicColumns) -> topic_values.PoseArrays:
        pose = source.fields or find_type(columns.type_name).pose
        if pose is not None and pose.angle:
            asked = self.configuration.pose.yaw_unit
            unit = asked or topic_values.find_angle_unit(columns, pose)
            if unit != (asked or pose.angle_unit):
                self.findings.append(Finding("heading_unit", "warning", source.topic))
            pose = msgspec.structs.replace(pose, angle_unit=unit)
        if pose is None or not pose.names:
            return topic_values.read_pose_topic(columns, pose)
        arrays, name = read_bodies(columns, pose, source.name, self.vehicle)
        self.findings.append(Finding("body_chosen", "info", source.topic, {"body": name}))
        return arrays

    def _head_positions(
        self, source: PoseSource, arrays: topic_values.PoseArrays
    ) -> topic_values.Located | None:
        """Poses with the course as heading if a topic gives positions alone; otherwise None.

        A vehicle that moves sideways may keep one heading.
        """
        receiver = self._timed(source.topic)
        if (
            receiver is None
            or self.vehicle.kinematics.has_inputs("sideways")
            or not pose_topics.lacks_heading(arrays)
        ):
            return None
        from pipeline.recording.satellite import head_positions  # noqa: PLC0415 - few logs need it

        located = head_positions(arrays, receiver, self._list_turnings(source), self._read_ahead())
        self.findings += () if located is None else located.findings
        return located

    def _read_ahead(self) -> tuple[Floats, Floats] | None:
        """Times [s] and forward speed [m/s] of the wheels, else of the command."""
        drives = (read_speed(table, self.vehicle) for table in (self._wheels, self._commands))
        return next((drive for drive in drives if drive is not None), None)

    def _locate_vehicle(self, source: PoseSource) -> tuple[Ints, topic_values.PoseArrays]:
        """Messages of a satellite receiver that give a pose, in time order, and these poses."""
        from pipeline.recording.satellite import locate_vehicle  # noqa: PLC0415 - few logs need it

        receiver, beside = self._timed(source.topic), self._timed(source.velocity)
        if receiver is None:
            raise self._nothing("pose", source.topic)
        lever, findings = pose_topics.find_antenna(
            self.data.topics, topic_values.frame_of(receiver.columns), source.topic
        )
        made = locate_vehicle(receiver, beside, self._list_turnings(source), self._read_ahead(), lever)
        self.findings += [*findings, *made.findings]
        if not made.rows.size:
            times = receiver.times[receiver.order]
            if times.size < topic_values.FEWEST_MESSAGES:
                raise self._nothing("pose", source.topic)
            rate = 1.0 / max(float(np.median(np.diff(times))), 1e-3)
            slow = f" (at least {pose_topics.SLOW_HZ:g} Hz are needed)" if rate < pose_topics.SLOW_HZ else ""
            what = (
                f"the positions of {source.topic} come at {rate:.2g} Hz{slow} and show no course that can be "
                "the heading of the vehicle"
            )
            hint = "Record an IMU beside them, a faster receiver, or a localization with a heading."
            raise StageError("no_pose", what, where=self.where, hint=hint)
        return made.rows, made.arrays

    def _list_turnings(self, source: PoseSource) -> list["Turning"]:
        """Sensors that turn with a vehicle of which positions alone are recorded."""
        from pipeline.recording.satellite import list_turnings, read_headings  # noqa: PLC0415 - few logs need it

        imu = self._timed(self.sources.imu.topic) if self.sources.imu else None
        turnings = [] if imu is None else list_turnings(imu)
        for signal in source.headings:
            number = self._timed(signal.topic)
            turnings += [] if number is None else read_headings(number, signal.field)
        return turnings

    def own_speed(self) -> tuple[Floats, Floats]:
        """Times [s] and speeds [m/s] that are recorded with the positions of the pose; empty without any."""
        source = self.sources.pose
        receiver = None if source is None else self._timed(source.velocity or source.topic)
        if source is None or receiver is None:
            return np.zeros(0), np.zeros(0)
        return topic_values.read_own_speed(receiver, source)

    def _timed(self, topic: str) -> topic_values.Receiver | None:
        ordered = self._ordered(topic)
        if ordered is None:
            return None
        columns, clock, order = ordered
        # Messages with equal stamps have no position on a track.
        order = order[np.diff(clock.stamp[order], prepend=np.iinfo(np.int64).min) > 0]
        return topic_values.Receiver(columns, self._seconds(clock.stamp), order)

    def _time_columns(self, times: Floats, stamp: Stamps, log_time: Stamps) -> dict[str, NDArray[np.generic]]:
        return {"t": times, "stamp": stamp, "log_time": log_time}

    def _nothing(self, role: str, topic: str) -> StageError:
        return StageError(
            f"no_{role}",
            f"the topic {topic!r} chosen as {role} has no readable message{blame_damage(self.data.losses)}",
            where=self.where,
            hint=f"Choose another with {role}.topic in run.toml; `slip inspect` lists what there is.",
        )

    @cached_property
    def _commands(self) -> pl.DataFrame:
        section = self.configuration.command
        table = self.read_drive(self.sources.command, section, self.vehicle, held=True)
        beside = self.sources.body_beside
        if beside is None or table.is_empty():
            return table
        topic = beside.signals[0].topic
        columns, findings = self.log.join(topic)
        self.findings += findings
        if columns is None:
            return table
        order = np.argsort(columns.log_time, kind="stable")
        at = np.searchsorted(columns.log_time[order], table["log_time"].to_numpy(), side="right") - 1
        values = {
            name: read_signal(columns, beside, number, DriveSection(), self.vehicle)[order][at]
            for number, name in enumerate(("body_x", "body_w"))
        }
        return table.with_columns(
            pl.Series(name, np.where(at >= 0, value, np.nan)).fill_nan(None) for name, value in values.items()
        )

    def read_drive(
        self, source: DriveSource | None, section: DriveSection, vehicle: Vehicle, *, held: bool
    ) -> pl.DataFrame:
        """Table of a drive; empty without one.

        Args:
            source: its topics.
            section: units, signs and names of joints.
            vehicle: in whose inputs it is.
            held: whether its values are commands, held until the next one.
        """
        if source is None:
            return pl.DataFrame()
        if source.form is DriveForm.JOINTS:
            columns, clock, order = self._require(source.signals[0].topic, held=held)
            drive, findings = read_joints(columns, self._seconds(clock.stamp), section, vehicle)
            self.findings += findings
            order = order[is_of_wheels(columns, drive)[order]]
            drive = {name: series[order] for name, series in drive.items()}
            stamp, log_time = clock.stamp[order], columns.log_time[order]
        else:
            stamp, log_time, (first, second) = self._read_pair(source, section, vehicle, held=held)
            topic = source.signals[0].topic
            if source.form is DriveForm.BODY:
                first, second = self._smooth(topic, stamp, (first, second), held=held)
            nominal = not held and topic_values.is_of_base(source, {topic: self.columns[topic].type_name})
            sideways = self._read_sideways(source, vehicle, held=held)
            drive = read_pair(
                source.form, first, second, section, vehicle, nominal=nominal, sideways=sideways
            )
        if section.late_s:
            stamp = stamp - round(section.late_s * 1e9)
        if not held and section.scale is not None:
            self.findings.append(Finding("encoder_scale_given", "info", "wheels", {"value": section.scale}))
        times = self._seconds(stamp)
        empty = np.full(times.size, np.nan)
        names = [name for name in SIGNALS if held or not name.startswith("body")]
        values = {
            name: drive[name] * (1.0 if name == "steering" else section.scale or 1.0)
            if name in drive
            else empty
            for name in names
        }
        frame = pl.DataFrame(
            {**self._time_columns(times, stamp, log_time), **values, "active": is_inside(times, self._spans)}
        )
        if section.interpolate:
            frame = fill_gaps(frame)
        if section.ignore:
            frame = self._leave_out(frame, section.ignore, held=held)
        return frame.with_columns(
            pl.lit(None, dtype=pl.Float64).alias(name) for name in names if name not in drive
        )

    def _smooth(
        self, topic: str, stamp: Stamps, speeds: tuple[Floats, Floats], *, held: bool
    ) -> tuple[Floats, Floats]:
        """Speeds of an odometry, by its own positions where they are differences of these that scatter."""
        columns, _, order = self._require(topic, held=held)
        pose = find_type(columns.type_name).pose
        if pose is None or pose.names or not (pose.orientation or pose.angle) or order.size != stamp.size:
            return speeds
        places = topic_values.read_pose_topic(columns, pose).take(order)
        yaw = rigid.euler_from_quaternions(places.quaternion)[2]
        made = smooth_differences(self._seconds(stamp), places.position[:, :2], yaw, speeds)
        if made is None:
            return speeds
        self.findings.append(Finding("speeds_of_positions", "info", topic))
        return made

    def _leave_out(self, frame: pl.DataFrame, spans: Sequence[OutageSection], *, held: bool) -> pl.DataFrame:
        """A drive without the readings that are none: rows of it, values, or commands that are not live."""
        seconds = (frame["log_time"].to_numpy() - self.data.index.start_ns) / 1e9
        for one in spans:
            inside = np.ones(seconds.size, dtype=bool)
            inside &= True if one.start_s is None else seconds >= one.start_s
            inside &= True if one.end_s is None else seconds < one.end_s
            if held and one.side == "both":
                frame = frame.with_columns(active=pl.col("active") & ~pl.Series(inside))
                continue
            sides = {one.side, "sideways"} if one.side != "both" else set(SIGNALS)
            frame = frame.with_columns(
                pl.when(pl.Series(inside)).then(np.nan).otherwise(pl.col(name)).alias(name)
                for name in sides.intersection(frame.columns)
            )
            if not held:
                frame, seconds = frame.filter(~pl.Series(inside)), seconds[~inside]
        return frame

    def read_rates(self, source: DriveSource) -> tuple[Floats, dict[str, Floats]]:
        """Times [s] and rates [rad/s] of all joints of a topic that turn, by name."""
        columns, clock, order = self._require(source.signals[0].topic, held=False)
        times = self._seconds(clock.stamp)
        return times[order], {name: rate[order] for name, rate in read_rates(columns, times).items()}

    def read_angles(self, source: DriveSource) -> dict[str, Floats]:
        """Angles [rad] of all joints of a topic in order of time, by name."""
        columns, clock, order = self._require(source.signals[0].topic, held=False)
        angles = read_angles(columns, self._seconds(clock.stamp))
        return {name: angle[order] for name, angle in angles.items()}

    @cached_property
    def _wheels(self) -> pl.DataFrame:
        """Measured wheels; a topic without wheels is left out unless it is configured."""
        source = self.sources.wheels
        section = self.configuration.wheels
        try:
            return self.read_drive(source, section, self.vehicle, held=False)
        except SlipError as error:
            if source is None or section != DriveSection():
                raise
            self.findings.append(Finding("no_measured_wheels", "info", str(source), {"why": error.what}))
            return pl.DataFrame()

    def _require(self, topic: str, *, held: bool) -> tuple[TopicColumns, TopicClock, Ints]:
        ordered = self._ordered(topic)
        if ordered is None:
            raise self._nothing("command" if held else "wheels", topic)
        return ordered

    def _read_sideways(self, source: DriveSource, vehicle: Vehicle, *, held: bool) -> Floats | None:
        """Speed to the left of a body motion [m/s], in the order of `_read_pair`; None if it has none.

        Raises:
            StageError: ``no_sideways``, the vehicle moves sideways, and the measurement does not include it.
        """
        if source.form is not DriveForm.BODY:
            return None
        topic = source.signals[0].topic
        signal = topic_values.sideways_field(source, {topic: self.columns[topic].type_name})
        moves = vehicle.kinematics.has_inputs("sideways")
        if signal is None:
            if moves and not held:
                what = f"{source} does not say how {vehicle.name} moves sideways"
                hint = "Configure an odometry, or a JointState of all wheels."
                raise StageError("no_sideways", what, where=topic, hint=hint)
            return None
        columns, _, order = self._require(topic, held=held)
        # A message without the number asks for none.
        sideways = np.nan_to_num(topic_values.numbers(columns, signal.field)[order])
        if not moves and held:
            self.findings += self._check_sideways(sideways, topic, vehicle)
        return sideways if moves else None

    def _check_sideways(self, sideways: Floats, topic: str, vehicle: Vehicle) -> list[Finding]:
        """Commands that this kind of vehicle cannot follow, since it moves along its wheels only."""
        share = topic_values.asks_sideways(sideways)
        if share == 0.0:
            return []
        values = {
            "value": share,
            "vehicle": vehicle.name,
            "vehicle_kind": vehicle.kind,
            "presets": [one.id for one in list_presets() if one.kinematics.has_inputs("sideways")],
        }
        return [Finding("sideways_command", "error", topic, values)]

    def _read_pair(
        self, source: DriveSource, section: DriveSection, vehicle: Vehicle, *, held: bool
    ) -> tuple[Stamps, Stamps, tuple[Floats, Floats]]:
        """Two signals at common times: held commands at all stamps, measurements at those of the first."""
        series = []
        for number, signal in enumerate(source.signals):
            columns, clock, order = self._require(signal.topic, held=held)
            values = read_signal(columns, source, number, section, vehicle)[order]
            if is_angle(source, section):
                times = self._seconds(clock.stamp[order])
                self.findings += report_jumps(signal.topic, times, {str(signal): values})
                values = differentiate_angle(times, values)
            series.append((clock.stamp[order], columns.log_time[order], values))
        (first, log_first, a), (second, log_second, b) = series
        if np.array_equal(first, second):
            return first, log_first, (a, b)
        if not held:
            return _join_sides(series)
        union, index = np.unique(np.concatenate((first, second)), return_index=True)
        log_time = np.concatenate((log_first, log_second))[index]
        known = union >= max(first[0], second[0])
        union, log_time = union[known], log_time[known]
        at = [np.searchsorted(stamps, union, side="right") - 1 for stamps in (first, second)]
        return union, log_time, (a[at[0]], b[at[1]])

    def imu(self) -> pl.DataFrame:
        """Table of the gyro; empty without one."""
        source = self.sources.imu
        ordered = self._ordered(source.topic) if source else None
        if ordered is None:
            return pl.DataFrame()
        columns, clock, order = ordered
        rates, forces = topic_values.read_imu(columns)
        times = self._seconds(clock.stamp[order])
        rates[:, 2] *= self.configuration.imu.sign or 1
        return pl.DataFrame(
            {
                **self._time_columns(times, clock.stamp[order], columns.log_time[order]),
                **{f"rate_{axis}": rates[order, i] for i, axis in enumerate("xyz")},
                **{f"acceleration_{axis}": forces[order, i] for i, axis in enumerate("xyz")},
                "active": is_inside(times, self._spans),
            }
        )


def _join_sides(
    series: Sequence[tuple[Stamps, Stamps, Floats]],
) -> tuple[Stamps, Stamps, tuple[Floats, Floats]]:
    """Two measurements at the times of the first, while neither is silent.

    Args:
        series: stamps, log times and values of each.
    """
    (first, log_first, a), (second, _, b) = series
    known = (first >= second[0]) & (first <= second[-1]) & ~_find_silent(first, second, b)
    return first[known], log_first[known], (a[known], np.interp(first[known], second, b))


def _find_silent(at: Stamps, stamps: Stamps, values: Floats) -> Flags:
    """Times in a long silence between two readings.

    After a reading of zero a wheel may stand whose changes alone are published.
    """
    steps = np.diff(stamps)
    if not steps.size:
        return np.zeros(at.size, dtype=bool)
    longest = max(_LONGEST_STEP_S * 1e9, PERIODS * float(np.quantile(steps, 0.75)))
    last = np.searchsorted(stamps, at, side="right") - 1
    before = np.clip(last, 0, steps.size - 1)
    return np.asarray(
        (last == before) & (steps[before] > longest) & (values[before] != 0.0) & (stamps[before] != at)
    )


def _find_breaks(clock: TopicClock, log_time: Stamps) -> Flags:
    """Whether the clock jumped before each message, shape (n,)."""
    breaks = np.zeros(log_time.size, dtype=bool)
    for jump in clock.breaks:
        breaks[np.flatnonzero(log_time >= jump)[:1]] = True
    return breaks
