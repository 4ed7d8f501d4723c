"""Reading a task: log, vehicle sheet and held-out stretch as arrays, with numpy and mcap-ros2-support."""

import csv
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Read:
    """A task; times count from the first command [s].

    Attributes:
        id: of the task.
        folder: where it is.
        sheet: vehicle.toml.
        commands: time, speed ahead [m/s], yaw rate [rad/s] or, of a car, steering angle [rad], of log and
            held-out stretch, shape (n, 3).
        log_end_s: end of the log.
        poses: time, x [m], y [m], yaw [rad], shape (m, 4).
        windows: first time, x, y, yaw, last time, shape (k, 5).
    """

    id: str
    folder: Path
    sheet: dict[str, Any]
    commands: Floats
    log_end_s: float
    poses: Floats
    windows: Floats

    @property
    def is_car(self) -> bool:
        """Whether it steers."""
        return bool(self.sheet["kind"] == "ackermann")


def read_task(folder: Path) -> Read:
    """Read a task's folder."""
    task = tomllib.loads((folder / "task.toml").read_text("utf-8"))
    sheet = tomllib.loads((folder / task["vehicle"]).read_text("utf-8"))
    topics = task["topics"]
    rows: dict[str, list[tuple[Any, ...]]] = {"commands": [], "poses": []}
    wanted = {topics[key]: key for key in rows}
    with (folder / task["log"]).open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, _, told in reader.iter_decoded_messages(topics=list(wanted)):
            key = wanted[channel.topic]
            stamp = told.header.stamp.sec * 1_000_000_000 + told.header.stamp.nanosec
            values = _read_pose(told) if key == "poses" else _read_command(told)
            rows[key].append((stamp, *values))
    later = _read_csv(folder / task["held_out"]["commands"])
    windows = _read_csv(folder / task["held_out"]["windows"])
    turn = "steering_rad" if "steering_rad" in later else "yaw_rate_radps"
    rows["commands"] += list(zip(later["stamp_ns"], later["speed_mps"], later[turn], strict=True))
    first = rows["commands"][0][0]
    commands, poses = (_count_from(first, rows[key]) for key in ("commands", "poses"))
    ends = _count_from(first, list(zip(windows["end_ns"], strict=True)))
    begun = _count_from(
        first, list(zip(*(windows[key] for key in ("start_ns", "x", "y", "yaw")), strict=True))
    )
    poses = poses[np.argsort(poses[:, 0], kind="stable")]
    poses[:, 3] = np.unwrap(poses[:, 3])
    return Read(
        task["id"],
        folder,
        sheet,
        _stop_when_silent(commands, sheet.get("command_timeout_s", np.inf)),
        float((later["stamp_ns"][0] - first) * 1e-9),
        poses,
        np.column_stack((begun, ends)),
    )


def _read_pose(told: Any) -> tuple[float, float, float]:  # noqa: ANN401 - made from the log's schema
    place, turn = told.pose.pose.position, told.pose.pose.orientation
    yaw = np.arctan2(
        2.0 * (turn.w * turn.z + turn.x * turn.y), 1.0 - 2.0 * (turn.y * turn.y + turn.z * turn.z)
    )
    return place.x, place.y, float(yaw)


def _read_command(told: Any) -> tuple[float, float]:  # noqa: ANN401 - made from the log's schema
    if hasattr(told, "drive"):
        return told.drive.speed, told.drive.steering_angle
    return told.twist.linear.x, told.twist.angular.z


def _read_csv(path: Path) -> dict[str, list[Any]]:
    with path.open(encoding="ascii", newline="") as stream:
        rows = list(csv.DictReader(stream))
    return {name: [(int if name.endswith("_ns") else float)(row[name]) for row in rows] for name in rows[0]}


def _count_from(first_ns: int, rows: list[tuple[Any, ...]]) -> Floats:
    return np.array([((row[0] - first_ns) * 1e-9, *row[1:]) for row in rows], dtype=np.float64)


def _stop_when_silent(commands: Floats, timeout_s: float) -> Floats:
    """Commands with a stop where none came for the controller's timeout."""
    silent = np.flatnonzero(np.diff(commands[:, 0]) > timeout_s)
    stops = np.column_stack((commands[silent, 0] + timeout_s, np.zeros((silent.size, 2))))
    return np.insert(commands, silent + 1, stops, axis=0)


def list_tasks(ring: Path) -> list[Path]:
    """Folders of the tasks of a ring, or of all rings below a folder."""
    return sorted(path.parent for path in ring.rglob("task.toml"))


def walk_velocities(edges: Floats, velocity: Floats) -> Floats:
    """Poses x, y, yaw at the edges of cells of constant body velocity (v_x, v_y, v_w), shape (n + 1, 3)."""
    step = np.diff(edges)
    yaw = np.concatenate(([0.0], np.cumsum(velocity[:, 2] * step)))
    turn = np.exp(0.5j * (yaw[:-1] + yaw[1:]))
    place = np.concatenate(([0.0], np.cumsum((velocity[:, 0] + 1j * velocity[:, 1]) * turn * step)))
    return np.column_stack((place.real, place.imag, yaw))


def predict_windows(read: Read, edges: Floats, poses: Floats) -> list[list[float]]:
    """Ends of the windows: their first poses, moved as a dead-reckoned path moves in the same time."""
    first, last = (
        np.column_stack([np.interp(read.windows[:, column], edges, poses[:, i]) for i in range(3)])
        for column in (0, 4)
    )
    x, y, yaw = read.windows[:, 1:4].T
    moved = ((last[:, 0] - first[:, 0]) + 1j * (last[:, 1] - first[:, 1])) * np.exp(1j * (yaw - first[:, 2]))
    ends = np.column_stack((x + moved.real, y + moved.imag, yaw + last[:, 2] - first[:, 2]))
    rounded: list[list[float]] = np.round(ends, 6).tolist()
    return rounded
