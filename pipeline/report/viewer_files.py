"""Files of a run for viewers and spreadsheets: a log of slip topics, layouts that show it, and tables."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from typing import Literal

import numpy as np
import polars as pl
import polars.selectors as cs

from pipeline.core import Floats, Ints, quote_formulas
from pipeline.logs.writer import Given, LogWriter
from pipeline.report import writing_export
from pipeline.store import Manifest, check_size, name_damage, replace_file, temporary_beside
from schemas import contract_of

_AGREE_NS = 1_000_000_000
"""Largest offset of two clocks that agree [ns]: it is the latency of the messages."""
_PATH_POSES = 5000
"""Poses of the whole path: those that a screen can show."""
_LEVELS = {"info": 20, "warning": 30, "error": 40}
_TWIST, _POSE = "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/PoseStamped"
_NUMBER = "std_msgs/msg/Float64"
LAYOUTS = {"foxglove-layout": "foxglove.json", "plotjuggler-layout": "plotjuggler.xml"}
"""Layouts of viewers, as files of the folder `layouts`."""


def write_slip_log(manifest: Manifest, slip: pl.DataFrame, path: Path, frame_id: str = "map") -> Path:
    """Write velocities, slip, poses, segments and findings of a run as MCAP.

    Topics are `/slip/pose`, `/slip/path`, `/slip/segment`, `/slip/findings` and `/slip/velocity/measured`; of
    each input `/slip/velocity/ideal_INPUT`, `/slip/slip_INPUT`, `/slip/modulus_INPUT`; and of a model
    `/slip/velocity/model_INPUT` and `/slip/residual_modulus_INPUT`.

    Args:
        manifest: the run.
        slip: its table `slip`, with the columns of the model to show.
        path: the file; an existing one is replaced when the new one is complete.
        frame_id: fixed frame of the poses.

    Raises:
        LogError: the path cannot be written.
    """
    velocities, shift_ns = manifest.read("velocities"), _find_shift(manifest)

    def write(topic: str, kind: str, stamps: Ints, fields: dict[str, Given], frame: str = "") -> None:
        stamped = {"header.frame_id": frame, **fields} if frame else fields
        header = stamps if frame else None
        writer.write_columns(topic, kind, stamps + shift_ns, stamped, header_time=header)

    def write_velocity(topic: str, rows: pl.DataFrame, prefix: str) -> None:
        names = {"linear.x": "x", "linear.y": "y", "angular.z": "w"}
        fields = {f"twist.{field}": rows[f"{prefix}_{axis}"].to_numpy() for field, axis in names.items()}
        write(topic, _TWIST, rows["stamp"].to_numpy(), dict(fields), "base_link")

    def write_number(topic: str, rows: pl.DataFrame, name: str) -> None:
        write(topic, _NUMBER, rows["stamp"].to_numpy(), {"data": rows[name].to_numpy()})

    log = manifest.part("log")
    with LogWriter(path) as writer:
        named = {"log": str(log.get("path", "")), "sha256": str(log.get("sha256", ""))}
        writer.metadata("slip", {"run": manifest.run, "key": manifest.key, **named})
        stamps = velocities["stamp"].to_numpy()
        # Not odometry: its two covariances, which are unknown, would be four fifths of the file.
        write("/slip/pose", _POSE, stamps, dict(_fill_poses(velocities, "pose.")), frame_id)
        write("/slip/segment", "std_msgs/msg/Int32", stamps, {"data": velocities["segment"].to_numpy()})
        write_velocity("/slip/velocity/measured", velocities, "v")
        thinned = velocities.gather_every(max(velocities.height // _PATH_POSES, 1))
        whole = {field: values[None, :] for field, values in _fill_poses(thinned, "poses[].pose.").items()}
        if velocities.height:
            write("/slip/path", "nav_msgs/msg/Path", stamps[:1], dict(whole), frame_id)
        for (name,), rows in slip.group_by(pl.col("input").cast(pl.String), maintain_order=True):
            write_velocity(f"/slip/velocity/ideal_{name}", rows, "f")
            write_velocity(f"/slip/slip_{name}", rows, "g")
            write_number(f"/slip/modulus_{name}", rows, "modulus")
            known = rows.drop_nulls("residual_modulus")
            if not known.is_empty():
                write_velocity(f"/slip/velocity/model_{name}", known, "model")
                write_number(f"/slip/residual_modulus_{name}", known, "residual_modulus")
        _write_findings(writer, manifest, velocities, shift_ns)
    return path


def _find_shift(manifest: Manifest) -> int:
    """Offset from stamps to the recorder's clock [ns]; zero where both agree to a second."""
    poses = manifest.read("poses")
    late = float((poses["log_time"] - poses["stamp"]).median() or 0.0) if poses.height else 0.0  # type: ignore[arg-type]
    return 0 if abs(late) < _AGREE_NS else int(late)


def _fill_poses(rows: pl.DataFrame, prefix: str) -> dict[str, Floats]:
    half = 0.5 * rows["yaw"].to_numpy()
    turn = {f"{prefix}orientation.z": np.sin(half), f"{prefix}orientation.w": np.cos(half)}
    return {f"{prefix}position.{axis}": rows[axis].to_numpy() for axis in "xyz"} | turn


def _write_findings(writer: LogWriter, manifest: Manifest, velocities: pl.DataFrame, shift_ns: int) -> None:
    """Write each finding as a line of a log panel, one that has no time at the start."""
    rows = manifest.read("findings").sort(pl.col("t_start").fill_null(0.0), maintain_order=True)
    if rows.is_empty():
        return
    start_ns = (
        int(velocities["stamp"][0]) - round(float(velocities["t"][0]) * 1e9) if velocities.height else 0
    )
    stamps = start_ns + np.rint(rows["t_start"].fill_null(0.0).to_numpy() * 1e9).astype(np.int64)
    levels = [_LEVELS.get(str(name), 20) for name in rows["severity"].cast(pl.String)]
    fields: dict[str, Given] = {
        "stamp.sec": stamps // 10**9,
        "stamp.nanosec": stamps % 10**9,
        "level": np.array(levels, dtype=np.uint8),
        "name": rows["id"].to_list(),
        "msg": rows["text"].to_list(),
    }
    writer.write_columns("/slip/findings", "rcl_interfaces/msg/Log", stamps + shift_ns, fields)


def write_layout(name: str, path: Path) -> Path:
    """Write a layout of `LAYOUTS`, of Foxglove and Lichtblick, or of PlotJuggler, that shows such a log.

    Raises:
        ReportError: ``export_not_written``.
    """
    with writing_export(where=path):
        path.parent.mkdir(parents=True, exist_ok=True)
        shipped = resources.files("pipeline.report").joinpath("layouts", LAYOUTS[name])
        replace_file(path, shipped.read_bytes())
    return path


def write_tables(manifest: Manifest, to: Literal["csv", "parquet"], folder: Path) -> list[Path]:
    """Write every table of a run as `<table>.csv` or `<table>.parquet`.

    In CSV, a column with a unit in its contract has it in its heading, for example `v_x [m/s]`, and a text
    that a spreadsheet would take for a formula has a quote in front. Parquet has units and frames in its
    metadata.

    Args:
        manifest: the run.
        to: the format.
        folder: output folder; created if missing, and filled when all tables are written.

    Returns:
        The files, sorted.

    Raises:
        ReportError: ``export_not_written``.
    """
    with writing_export(where=folder), _fill_folder(folder) as draft:
        for table in sorted(manifest.tables):
            path, target = manifest.path(table), draft / f"{table}.{to}"
            check_size(path, manifest.count_rows(table))
            with name_damage(path):
                if to == "parquet":
                    shutil.copyfile(path, target)
                    continue
                frame = pl.scan_parquet(path, glob=False)
                texts = (cs.string() | cs.enum() | cs.categorical()).cast(pl.String)
                heads = {name: _name_column(table, name) for name in frame.collect_schema().names()}
                frame.with_columns(quote_formulas(texts)).rename(heads).sink_csv(target)
    return [folder / f"{table}.{to}" for table in sorted(manifest.tables)]


@contextmanager
def _fill_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder whose files stand in ``folder`` when the block ends without an error."""
    is_new = not folder.is_dir()
    folder.parent.mkdir(parents=True, exist_ok=True)
    draft = temporary_beside(folder if is_new else folder / "draft")
    draft.mkdir()
    try:
        yield draft
        if is_new:
            draft.rename(folder)
        else:
            for path in draft.iterdir():
                path.replace(folder / path.name)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _name_column(table: str, name: str) -> str:
    contract = contract_of(table)
    if name not in contract.schema.columns():
        return name
    unit = contract.metadata_of(name).get("unit", "")
    return f"{name} [{unit}]" if unit and unit != "1" else name
