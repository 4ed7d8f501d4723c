"""Simulated logs through the stages, as a run goes through them, without a results folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from pipeline.job.work import as_recorded
from pipeline.logs import open_log, read_topics
from pipeline.run import read_drive
from pipeline.simulate import (
    Disturbance,
    Encoders,
    Imu,
    PoseSensor,
    Program,
    Scenario,
    simulate_run,
    write_log,
)
from pipeline.sources import Configuration, DriveForm, Sources, choose_sources, convert, resolve_vehicle
from pipeline.stages.align import Aligned, align_tables
from pipeline.stages.checks import run_checks
from pipeline.stages.extract import Extracted, extract_tables
from pipeline.stages.reading import list_wanted
from pipeline.stages.slip_stage import SlipResult, compute_slip
from pipeline.stages.trust import Samples, gather_samples
from pipeline.stages.velocity import VelocityResult, compute_velocities
from schemas import contract_of

if TYPE_CHECKING:
    from pipeline.stages import Finding

EXACT = PoseSensor(noise_m=0.0, noise_rad=0.0, noise_z_m=0.0, noise_tilt_rad=0.0)
"""A localization without any error."""

ICP = PoseSensor(noise_m=0.004, noise_rad=0.002, drift_m=0.01, drift_rad=0.002)
"""A localization as in the field."""

PLAIN = Scenario(
    duration_s=60.0,
    effects={"drive_lag": 0.3},
    program=Program(lead_s=0.5),
    encoders=Encoders(noise_radps=0.002),
    imu=Imu(noise_radps=0.001),
)
"""A vehicle of which nothing is odd but a mild lag of its drive: no vehicle is without."""

FIELD = replace(
    PLAIN, effects={"drive_lag": 0.3, "effective_track": 1.8}, pose=ICP, disturbance=Disturbance(0.01, 0.015)
)
"""A skid-steer with the usual localization."""


@dataclass(frozen=True)
class Taken:
    """A log after the slip stage.

    Attributes:
        findings: of all stages and checks.
    """

    sources: Sources
    configuration: Configuration
    aligned: Aligned
    extracted: Extracted
    motion: VelocityResult
    result: SlipResult
    findings: tuple[Finding, ...]

    @property
    def velocities(self) -> pl.DataFrame:
        return self.motion.table

    def slip(self, name: str) -> pl.DataFrame:
        """Slip of one input."""
        return self.result.slip.filter(pl.col("input") == name)

    def windows(self, name: str) -> pl.DataFrame:
        """Windows of one input."""
        return self.result.windows.filter(pl.col("input") == name)

    def ids(self) -> set[str]:
        """Ids of everything noticed."""
        return {finding.id for finding in self.findings}

    def warned(self) -> set[str]:
        """Ids of what is more than a piece of information."""
        return {finding.id for finding in self.findings if finding.severity != "info"}

    def finding(self, name: str) -> Finding:
        """The only finding of an id."""
        (found,) = [finding for finding in self.findings if finding.id == name]
        return found


TakeThrough = Callable[..., Taken]


def record(scenario: Scenario, path: Path) -> Path:
    """Simulate a scenario and write its log."""
    write_log(simulate_run(scenario), path)
    return path


def take(
    log: Path,
    settings: Mapping[str, object] | None = None,
    *,
    inputs: Sequence[str] = ("command", "measured"),
) -> Taken:
    """Take a log through extract, align, velocity, slip and the checks."""
    index = open_log(log)
    configuration = convert(settings or {}, "test")
    recorded = index.metadata.get("deployment", {}).get("vehicle")
    vehicle = resolve_vehicle(configuration.vehicle, recorded=recorded, where=log.name)
    sources = choose_sources(index.channels, configuration, vehicle, where=log.name)
    types = {channel.topic: channel.type_name for channel in index.channels}
    data = read_topics(index, list_wanted(sources, types))
    extracted = extract_tables(data, sources, configuration, vehicle, where=log.name)
    body = sources.command is not None and sources.command.form is DriveForm.BODY
    raw = {name: keep_good_rows(name, as_recorded(name, frame)) for name, frame in extracted.tables.items()}
    aligned = align_tables(
        raw, vehicle, hold_s=configuration.command.hold_s, body_commanded=body, where=log.name
    )
    tables = aligned.tables
    motion = compute_velocities(
        tables["poses"],
        tables["imu"],
        aligned.alignment.gyro,
        configuration.velocity,
        where=log.name,
        wheels=read_drive(tables["wheels"], aligned.vehicle),
    )
    result = compute_slip(
        motion.table,
        tables["commands"],
        tables["wheels"],
        vehicle=aligned.vehicle,
        configuration=configuration,
        hold_s=aligned.alignment.hold_s,
        inputs=inputs,
        where=log.name,
    )
    samples = gather_samples(motion.table, result.inputs, result.cut, body_commanded=body)
    checked = run_checks(samples, aligned.vehicle)
    findings = (*extracted.findings, *aligned.findings, *motion.findings, *result.findings, *checked)
    return Taken(sources, configuration, aligned, extracted, motion, result, findings)


def keep_good_rows(table: str, frame: pl.DataFrame) -> pl.DataFrame:
    """What the store would give back: rows that keep their contract."""
    if frame.is_empty():
        return frame
    schema = contract_of(table).schema
    named = frame.with_columns(pl.lit("x").alias(name) for name in ("run", "dataset", "vehicle", "terrain"))
    good, _ = schema.filter(named.select(list(schema.columns())))
    return pl.DataFrame(good).select(frame.columns)


def make_samples(times: np.ndarray, measured: np.ndarray, velocity: np.ndarray) -> Samples:
    """Samples of measured wheels and of what the vehicle did, v_x, v_y and v_w each, shape (n, 3)."""
    step = float(np.median(np.diff(times)))
    yaw = np.cumsum(velocity[:, 2]) * step
    place = np.cumsum((velocity[:, 0] + 1j * velocity[:, 1]) * np.exp(1j * yaw)) * step
    return Samples(
        times=times,
        segment=np.zeros(times.size, dtype=np.int32),
        steady=np.ones(times.size, dtype=bool),
        step=np.zeros(times.size, dtype=np.int32),
        position=np.column_stack((place.real, place.imag)),
        yaw=yaw,
        velocity=velocity,
        gyro=np.full(times.size, np.nan),
        command=None,
        measured=measured,
        body_commanded=False,
    )


def rms(values: pl.Series | np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.asarray(values) ** 2)))


def slope(x: pl.Series, y: pl.Series) -> float:
    """Least squares gain of y on x."""
    return float(np.sum(x.to_numpy() * y.to_numpy()) / np.sum(x.to_numpy() ** 2))
