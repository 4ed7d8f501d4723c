"""Terrain map of the slip to expect, from the runs of a results folder and their positions on Earth."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import polars as pl

from pipeline.core import Floats, SlipError, finite_or_none, format_count, format_share, interpolate_linearly
from pipeline.datasets.compared_runs import find_material, measure_runs
from pipeline.datasets.pooling import ComparisonError
from pipeline.datasets.terrain import (
    CELL_M,
    LARGEST_CELL_M,
    SMALLEST_CELL_M,
    Drive,
    PassEffect,
    TerrainMap,
    compare_passes,
    list_crossings,
    measure_pass_effects,
    name_frames,
    sum_cells,
)
from pipeline.logs import LogIndex, TopicColumns, Wanted, open_log, read_topics
from pipeline.sources import find_type
from pipeline.stages import FEWEST_MESSAGES, from_local_plane, read_fixes, to_local_plane
from pipeline.store import Manifest, Store, find_recorded_log, lack_runs

_ROUNDS = 3
_OUTLIERS = 3.0
"""Multiple of the median distance above which a fix is an outlier (multipath)."""
WORST_FIT_M = 3.0
"""Largest median distance between poses and fixes [m] that agree: the error of a simple receiver."""
_LEAST_EXTENT = 5.0
"""Smallest extent of a run, in median distances: a run on the spot does not determine the heading."""
_SITE_M = 20_000.0
"""Distance within which runs share a local plane [m]."""
_ANCHOR_DIGITS = 2
"""Decimal places of an anchor [deg], so that maps of one site made at different times have the same cells."""


@dataclass(frozen=True)
class Beside:
    """Satellite fixes of a log, which the tables of its run do not contain.

    Attributes:
        times: times of the fixes since the run's start [s], shape (n,).
        fixes: latitude, longitude [deg] and altitude [m], shape (n, 3).
        reason: reason why there are no fixes; empty if there are.
    """

    times: Floats = field(default_factory=lambda: np.zeros(0))
    fixes: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    reason: str = ""


def read_beside(manifest: Manifest) -> Beside:
    """Read the fixes of a run from its log.

    A log that is missing or has changed is not read; the reason then states this.
    """
    try:
        path = find_recorded_log(manifest, hint="Analyze it where it is now.")
        index = open_log(path)
        wanted = _list_wanted(index)
        if not wanted:
            return Beside(reason="its log has no fixes of satellites")
        data = read_topics(index, wanted)
        if data.sha256 != manifest.part("log").get("sha256"):
            what = "the log is another one than the run was made of"
            raise ComparisonError("log_changed", what, where=str(path), hint="Analyze it again.")
    except SlipError as error:
        return Beside(reason=error.what)
    start = manifest.part("stages", "extract", "context").get("start_ns")
    begin = start if isinstance(start, int) else index.start_ns
    receivers = [_take_fixes(one, begin) for one in data.topics if find_type(one.type_name).fix]
    # Several receivers are not mixed.
    fixes = max(receivers, key=len, default=np.zeros((0, 4)))
    reason = "" if fixes.size else "its log has no fixes of satellites"
    return Beside(fixes[:, 0], fixes[:, 1:], reason)


def _list_wanted(index: LogIndex) -> list[Wanted]:
    wanted: dict[str, tuple[str, ...]] = {}
    for channel in index.channels:
        kind = find_type(channel.type_name)
        if kind.fix is not None:
            wanted[channel.topic] = (
                kind.fix.latitude,
                kind.fix.longitude,
                kind.fix.altitude,
                kind.fix.status,
            )
    return [Wanted(topic, fields) for topic, fields in wanted.items()]


def _find_times(columns: TopicColumns, start_ns: int) -> Floats:
    """Times since the run's start [s], from header stamps if these are in the run's clock."""
    header = columns.header_time
    recorded: Floats = np.asarray((columns.log_time - start_ns) * 1e-9, dtype=np.float64)
    if header is None or not header.size:
        return recorded
    stamped: Floats = np.asarray((header - start_ns) * 1e-9, dtype=np.float64)
    return stamped if abs(float(np.median(stamped - recorded))) < 1.0 else recorded


def _take_fixes(columns: TopicColumns, start_ns: int) -> Floats:
    latitude, longitude, altitude, there = read_fixes(columns)
    rows = np.column_stack((_find_times(columns, start_ns), latitude, longitude, altitude))
    return _sort(rows[there])


def _sort(rows: Floats) -> Floats:
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    new: Floats = rows[np.diff(rows[:, 0], prepend=-math.inf) > 0.0]
    return new


@dataclass(frozen=True)
class RunFrame:
    """Transform of a run's map into a frame that it shares with other runs.

    Attributes:
        frame: name of the frame.
        anchor: latitude and longitude [deg] of the frame's origin; None for a frame without georeference.
        turn: rotation of the run's map [rad].
        east, north: position of the run's origin in the frame [m].
        distance_m: median distance between poses and fixes [m]; NaN if no fixes were needed.
    """

    frame: str
    anchor: tuple[float, float] | None = None
    turn: float = 0.0
    east: float = 0.0
    north: float = 0.0
    distance_m: float = math.nan

    def move(self, position: Floats) -> Floats:
        """Transform positions in the run's map [m], shape (n, 2), into the frame."""
        moved = (position[:, 0] + 1j * position[:, 1]) * np.exp(1j * self.turn)
        return np.stack((moved.real + self.east, moved.imag + self.north), axis=1)


def find_anchor(beside: Beside, anchors: list[tuple[float, float]]) -> tuple[float, float]:
    """Origin of the local plane of a run: a near one of ``anchors``, else a new one, which is added."""
    latitude, longitude = np.median(beside.fixes[:, :2], axis=0).tolist()
    for anchor in anchors:
        both = np.array([anchor, (latitude, longitude)])
        away = to_local_plane(both[:, 0], both[:, 1], np.zeros(2))[1]
        if math.hypot(*away[:2]) < _SITE_M:
            return anchor
    anchors.append((round(latitude, _ANCHOR_DIGITS), round(longitude, _ANCHOR_DIGITS)))
    return anchors[-1]


def locate_on_earth(
    times: Floats, position: Floats, beside: Beside, anchor: tuple[float, float]
) -> RunFrame | str:
    """Transform of a run's map onto the plane at an anchor, or the reason why it is unknown.

    Rotation and translation by least squares between poses and fixes (Horn, 1987, in the plane), with
    outliers removed by their distance.

    Args:
        times: times of the poses [s], increasing, shape (n,).
        position: position of base_link in the run's map [m], shape (n, 2); NaN if unknown.
        beside: fixes, at least one.
        anchor: latitude and longitude [deg] of the plane's origin.
    """
    known = np.isfinite(position).all(axis=1)
    times, position = times[known], position[known]
    inside = (beside.times >= times.min(initial=np.inf)) & (beside.times <= times.max(initial=-np.inf))
    if np.count_nonzero(inside) < FEWEST_MESSAGES:
        return "its poses and its fixes do not share a time"
    fixes = np.concatenate(([[*anchor, beside.fixes[0, 2]]], beside.fixes[inside]))
    there = to_local_plane(*fixes.T)[1:, :2]
    here = interpolate_linearly(beside.times[inside], times, position)
    one, other = here[:, 0] + 1j * here[:, 1], there[:, 0] + 1j * there[:, 1]
    inliers = np.ones(one.size, dtype=bool)
    turn, shift, away = 1.0 + 0.0j, 0.0j, np.zeros(one.size)
    for _ in range(_ROUNDS):
        middles = one[inliers].mean(), other[inliers].mean()
        product = np.sum(np.conj(one[inliers] - middles[0]) * (other[inliers] - middles[1]))
        turn = product / max(abs(product), 1e-12)
        shift = middles[1] - turn * middles[0]
        away = np.abs(other - turn * one - shift)
        inliers = away <= max(_OUTLIERS * float(np.median(away)), 1e-6)
    distance = float(np.median(away))
    extent = float(np.sqrt(np.mean(np.abs(one[inliers] - one[inliers].mean()) ** 2)))
    if distance > WORST_FIT_M:
        return f"its poses and its fixes are {distance:.1f} m apart"
    if extent < _LEAST_EXTENT * distance:
        return f"it extends over {extent:.1f} m only, and its fixes are {distance:.1f} m off"
    name = f"earth {anchor[0]:.2f} {anchor[1]:.2f}"
    return RunFrame(name, anchor, float(np.angle(turn)), float(shift.real), float(shift.imag), distance)


def name_map(manifest: Manifest) -> str | None:
    """The map frame of a run's poses from the configuration; None if it has none."""
    run = manifest.part("configuration").get("run")
    name = run.get("map") if isinstance(run, Mapping) else None
    return str(name) if name else None


PAGE, GEOJSON = "terrain.html", "terrain.geojson"
_DIGITS = 8
"""Decimal places of degrees: a resolution of one millimetre."""
_HINT = "Analyze logs first: slip analyze LOG... --terrain NAME."


def draw_up_terrain(store: Store, *, cell_m: float = CELL_M, fed: str | None = None) -> TerrainMap:
    """Map slip by position over the runs of the results.

    Runs share a frame if their logs have satellite fixes, or if their configurations name the same map.
    Every other run has its own frame.

    Args:
        store: the results.
        cell_m: side of a cell [m].
        fed: input u; None: the measured wheels if every run has them, else the command.

    Raises:
        ComparisonError: ``nothing_to_map``; ``bad_cell``.
    """
    if not SMALLEST_CELL_M <= cell_m <= LARGEST_CELL_M:
        what = f"a cell of {cell_m:g} m is not possible"
        raise ComparisonError("bad_cell", what, hint=f"Give {SMALLEST_CELL_M:g} to {LARGEST_CELL_M:g} m.")
    compared, runs, _ = measure_runs(
        find_material(store, ("dataset",), trusted_only=True, tables=("aggregates", "slip", "velocities"))
    )
    notes = list(compared.notes)
    if runs.is_empty():
        raise lack_runs("nothing_to_map", "there is no run to map", store.root, _HINT, notes)
    measured = runs.filter(pl.col("input").cast(pl.String) == "measured")["run"].n_unique()
    source = fed or ("measured" if measured == len(compared.manifests) else "command")
    # Runs with another length scale than most are excluded.
    length_scale = float(runs["length_scale"][0])
    anchors: list[tuple[float, float]] = []
    tables, places = [], dict[str, RunFrame]()
    reasons: dict[str, list[str]] = {}
    for row in compared.labels.sort("run").iter_rows(named=True):
        manifest = compared.manifests[row["run"]]
        motion = _read_motion(manifest, source)
        if motion.is_empty():
            notes.append(f"left out, no slip on the {source} input: {manifest.run}")
            continue
        beside = read_beside(manifest)
        located = _locate_run(manifest, motion, beside, anchors)
        frame = RunFrame(f"run {manifest.run}") if isinstance(located, str) else located
        crossed = list_crossings(_make_drive(row, motion, frame, manifest, length_scale), cell_m)
        if crossed.is_empty():
            notes.append(f"left out, too short a time in every cell of {cell_m:g} m: {manifest.run}")
            continue
        if isinstance(located, str):
            reasons.setdefault(located, []).append(manifest.run)
        places[manifest.run] = frame
        tables.append(crossed)
    for reason, names in reasons.items():
        note = f"not placed with other runs, {reason} and [run] map names none: {', '.join(names)}"
        notes.append(note)
    if not tables:
        what = f"no run crosses a cell of {cell_m:g} m with slip on the {source} input"
        hint = "Give larger cells (--cell) or the other --input."
        raise lack_runs("nothing_to_map", what, store.root, hint, notes)
    crossings = pl.concat(tables)
    origins = {frame.frame: frame.anchor for frame in places.values() if frame.anchor is not None}
    cell_table = _locate(sum_cells(crossings, cell_m), origins)
    frames = {
        name: {run: places[run].distance_m for run in members} for name, members in name_frames(crossings)
    }
    keys = tuple(f"{run}/{compared.manifests[run].key}" for run in sorted(places))
    cell_table = cell_table.with_columns(
        pl.lit(source, pl.Enum(["command", "measured"])).alias("input"), pl.lit(cell_m).alias("cell")
    )
    effects = tuple(measure_pass_effects(crossings))
    return TerrainMap(
        cell_table,
        effects,
        compare_passes(crossings),
        frames,
        origins,
        source,
        cell_m,
        crossings.height,
        keys,
        tuple(notes),
    )


def _read_motion(manifest: Manifest, source: str) -> pl.DataFrame:
    """Valid rows of `slip` of an input, with positions."""
    slip = manifest.read("slip").filter(pl.col("input").cast(pl.String) == source, ~pl.col("suspect"))
    where = manifest.read("velocities").select("stamp", "x", "y", "yaw", "roll", "pitch")
    return slip.join(where.unique("stamp"), on="stamp").sort("t")


def _locate_run(
    manifest: Manifest, motion: pl.DataFrame, beside: Beside, anchors: list[tuple[float, float]]
) -> RunFrame | str:
    """Transform of a run into a frame that it may share, or the reason why it shares none."""
    reason = beside.reason
    if not reason:
        position = motion.select("x", "y").to_numpy()
        pose = locate_on_earth(motion["t"].to_numpy(), position, beside, find_anchor(beside, anchors))
        if isinstance(pose, RunFrame):
            return pose
        reason = pose
    name = name_map(manifest)
    return reason if name is None else RunFrame(f"map {name}")


def _make_drive(
    row: Mapping[str, object], motion: pl.DataFrame, frame: RunFrame, manifest: Manifest, length_scale: float
) -> Drive:
    column = {one.name: one.to_numpy() for one in motion.select(pl.col(pl.Float64))}
    moved = frame.move(np.stack((column["x"], column["y"]), axis=1))
    turn = length_scale * np.abs(column["f_w"])
    ideal = np.sqrt(column["f_x"] ** 2 + column["f_y"] ** 2 + turn**2)
    lean = np.arccos(np.clip(np.cos(column["roll"]) * np.cos(column["pitch"]), -1.0, 1.0))
    # Angles that never change were not measured.
    level = not (np.ptp(column["roll"]) > 0.0 or np.ptp(column["pitch"]) > 0.0)
    times = column["t"]
    drawn = manifest.read("power").drop_nulls("power") if "power" in manifest.tables else pl.DataFrame()
    power = np.full(times.size, np.nan)
    if not drawn.is_empty():
        known = drawn["t"].to_numpy()
        inside = (times >= known[0]) & (times <= known[-1])
        power[inside] = np.interp(times[inside], known, drawn["power"].to_numpy())
    columns = {
        "t": times,
        "x": moved[:, 0],
        "y": moved[:, 1],
        "heading": column["yaw"] + frame.turn + np.where(column["f_x"] < 0.0, math.pi, 0.0),
        "ideal": ideal,
        "slip": column["modulus"],
        "turn": turn,
        "energy": _find_energy(row, column),
        "lean": np.full(times.size, np.nan) if level else lean,
        "power": power,
        "transitory": motion["transitory"].to_numpy().astype(np.float64),
    }
    run, dataset, vehicle, terrain = (str(row[name]) for name in ("run", "dataset", "vehicle", "terrain"))
    return Drive(run, dataset, vehicle, terrain, frame.frame, columns)


def _find_energy(row: Mapping[str, object], column: Mapping[str, Floats]) -> Floats:
    """Kinetic energy of the slip velocity [J], as in `slip compare`; NaN without mass and size."""
    mass, gyration = row["mass"], row["squared_gyration"]
    if not isinstance(mass, float) or not isinstance(gyration, float):
        return np.full(column["g_x"].size, np.nan)
    moved: Floats = column["g_x"] ** 2 + column["g_y"] ** 2 + gyration * column["g_w"] ** 2
    return 0.5 * mass * moved


def _locate(cell_table: pl.DataFrame, origins: Mapping[str, tuple[float, float]]) -> pl.DataFrame:
    """The cells with latitude and longitude of their centres, if their frame is georeferenced."""
    parts = []
    for (frame,), mine in cell_table.group_by("frame", maintain_order=True):
        anchor = origins.get(str(frame))
        both = [pl.lit(None, pl.Float64)] * 2
        if anchor is not None:
            degrees = from_local_plane(mine.select("x", "y").to_numpy(), anchor)
            both = [pl.lit(pl.Series(values)) for values in degrees]
        parts.append(mine.with_columns(both[0].alias("latitude"), both[1].alias("longitude")))
    return pl.concat(parts)


def list_features(drawn: TerrainMap) -> list[dict[str, object]]:
    """Georeferenced cells as GeoJSON polygons (RFC 7946: longitude before latitude, counterclockwise)."""
    placed = drawn.cell_table.filter(pl.col("latitude").is_not_null())
    features: list[dict[str, object]] = []
    for (frame,), squares in placed.group_by("frame", maintain_order=True):
        half = 0.5 * drawn.cell_m
        corners = [
            from_local_plane(
                squares.select(pl.col("x") + dx * half, pl.col("y") + dy * half).to_numpy(),
                drawn.origins[str(frame)],
            )
            for dx, dy in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))
        ]
        shown = squares.drop("i", "j", "x", "y", "latitude", "longitude", "cell")
        for index, row in enumerate(shown.iter_rows(named=True)):
            ring = [
                [round(float(longitude[index]), _DIGITS), round(float(latitude[index]), _DIGITS)]
                for latitude, longitude in corners
            ]
            geometry = {"type": "Polygon", "coordinates": [ring]}
            features.append({"type": "Feature", "geometry": geometry, "properties": row})
    return features


def describe_terrain(drawn: TerrainMap) -> dict[str, object]:
    """The JSON object of `slip fleet map --terrain`."""
    return {
        "input": drawn.input,
        "cell_m": drawn.cell_m,
        "cells": drawn.cell_table.drop("i", "j", "input", "cell").to_dicts(),
        "frames": [
            {
                "frame": name,
                "runs": [
                    {"run": run, "fix_distance_m": finite_or_none(away)} for run, away in members.items()
                ],
            }
            for name, members in drawn.frames.items()
        ],
        "slip_by_passes": [_describe_effect(effect) for effect in drawn.effects],
        "crossings": drawn.crossings,
        "notes": list(drawn.notes),
    }


def _describe_effect(effect: PassEffect) -> dict[str, object]:
    low, high = effect.beside_time
    return {
        "dataset": effect.dataset,
        "change_per_pass": finite_or_none(effect.change),
        "low": finite_or_none(effect.low),
        "high": finite_or_none(effect.high),
        "level": effect.level,
        "beside_time": {"low": finite_or_none(low), "high": finite_or_none(high)},
        "is_significant": effect.is_significant,
        "crossings": effect.crossings,
        "repeated": effect.repeated,
        "places": effect.places,
        "most_passes": effect.most,
        "sentence": effect.describe(),
    }


def list_lines(drawn: TerrainMap, written: Mapping[str, Path]) -> list[str]:
    """Lines for the screen."""
    lines = []
    for frame, members in drawn.frames.items():
        mine = drawn.cell_table.filter(pl.col("frame") == frame)
        slip = float(np.median(mine["slip"].to_numpy()))
        most = int(mine["passes"].to_numpy().max())
        count = format_count(len(members), "run")
        size = f"{mine.height} cells of {drawn.cell_m:g} m"
        lines.append(f"{frame}: {count}, {size}, up to {most} passes, median slip {format_share(slip)}")
    lines += [effect.describe() for effect in drawn.effects]
    lines += [f"! {note}" for note in drawn.notes]
    return [*lines, *(f"{'page' if name == PAGE else 'written':<8}{path}" for name, path in written.items())]
