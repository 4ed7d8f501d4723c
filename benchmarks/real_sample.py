"""Write data_samples/recorded from a checkout of its public source: CHECKOUT is sousarbarb/optiodom."""

import argparse
from pathlib import Path

import numpy as np

from pipeline.logs.writer import LogWriter

PLACE = Path(__file__).parents[1] / "data_samples" / "recorded"
RUN = "data/diff/circular/231220200121/231220200121_run-01.csv"
TICKS_A_TURN = 43.7 * 64.0
"""Gear ratio times encoder counts, of the set's own metadata."""

START_NS = 1_600_000_000_000_000_000
"""The source has times from zero: a date that no recording has."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("checkout", type=Path)


def run(asked: argparse.Namespace) -> int:
    """Columns of the source: time [s], x, y [m], heading [rad] of OptiTrack, ticks right and left."""
    t, x, y, yaw, right, left = np.loadtxt(asked.checkout / RUN, delimiter=",").T
    times = START_NS + np.round(t * 1e9).astype(np.int64)
    angles = np.stack([left, right], axis=1) * (2.0 * np.pi / TICKS_A_TURN)
    # Ticks are counted between two poses: speeds are those of the middle, angles those of the end.
    middle = times[:-1] + np.diff(times) // 2
    PLACE.mkdir(exist_ok=True)
    with LogWriter(PLACE / "diff_circular.mcap") as log:
        log.write_columns(
            "/mocap/pose",
            "geometry_msgs/msg/PoseStamped",
            times,
            {
                "header.frame_id": "map",
                "pose.position.x": x,
                "pose.position.y": y,
                "pose.orientation.z": np.sin(yaw / 2.0),
                "pose.orientation.w": np.cos(yaw / 2.0),
            },
            header_time=times,
        )
        log.write_columns(
            "/joint_states",
            "sensor_msgs/msg/JointState",
            middle,
            {
                "name": ["left_wheel_joint", "right_wheel_joint"],
                "position": np.cumsum(angles, axis=0)[1:],
                "velocity": angles[1:] / np.diff(t)[:, None],
            },
            header_time=middle,
        )
    (PLACE / "LICENSE").write_bytes((asked.checkout / "LICENSE").read_bytes())
    print(PLACE)
    return 0
