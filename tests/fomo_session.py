"""A session in the format of FoMo: made-up driving in CSV files and a text of poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

RADIUS_M, TRACK_M = 0.30, 1.08
START_US = 1_760_456_485_500_000
EFFECTIVE_TRACK = 1.5
"""The vehicle turns so many times less than its wheels ask for."""

FLAT = "timestamp,value"
ODOMETRY = "t,px,py,pz,qx,qy,qz,qw,tlx,tly,tlz,tax,tay,taz,tax,tay,taz"
"""As the data set's files begin: the last three names stand twice, and the rows end before them."""


def write_session(folder: Path, *, duration_s: float = 90.0, imu: bool = True) -> Path:
    """Write a session of a Warthog that drives curves.

    Args:
        folder: to write it into.
        duration_s: of the session [s].
        imu: whether it has one.
    """
    (folder / "metadata").mkdir(parents=True)
    fine = np.arange(0.0, duration_s, 0.005)
    speed = np.where(fine < 3.0, 0.0, 0.9 + 0.3 * np.sin(0.31 * fine))
    asked = np.where(fine < 3.0, 0.0, 0.5 * np.sin(0.23 * fine) + 0.3 * np.sign(np.sin(0.11 * fine)))
    left, right = ((speed + side * asked * TRACK_M / 2.0) / RADIUS_M for side in (-1.0, 1.0))
    turned = asked / EFFECTIVE_TRACK
    yaw = np.cumsum(turned) * 0.005
    x, y = (np.cumsum(speed * wave(yaw)) * 0.005 for wave in (np.cos, np.sin))
    noise = np.random.default_rng(5)

    def write(name: str, head: str, rate_hz: float, *columns: np.ndarray, late_s: float = 0.0) -> None:
        at = np.arange(late_s, duration_s - 0.01, 1.0 / rate_hz)
        times = START_US + np.round(at * 1e6).astype(np.int64)
        values = [np.interp(at, fine, column) for column in columns]
        rows = zip(times.tolist(), *(value.tolist() for value in values), strict=True)
        lines = [",".join(map(str, row)) for row in rows]
        (folder / name).write_text("\n".join([head, *lines, ""]))

    nothing = np.zeros(fine.size)
    write("metadata/cmd_velocity_left.csv", FLAT, 49.0, left)
    write("metadata/cmd_velocity_right.csv", FLAT, 49.0, right, late_s=0.004)
    write("metadata/velocity_left.csv", FLAT, 4.0, left)
    write("metadata/velocity_right.csv", FLAT, 4.0, right, late_s=0.1)
    for side, wheel in (("left", left), ("right", right)):
        write(f"metadata/current_{side}.csv", FLAT, 1.0, 4.0 * wheel)
        write(f"metadata/voltage_{side}.csv", FLAT, 1.0, nothing + 47.0)
    write(
        "odom.csv", ODOMETRY, 10.0,
        *[nothing] * 6, nothing + 1.0, speed, *[nothing] * 4, asked,
    )  # fmt: skip
    if imu:
        gyro = turned + noise.normal(0.0, 0.002, fine.size)
        write("vectornav.csv", "t,ax,ay,az,lx,ly,lz", 100.0, nothing, nothing, gyro, nothing, nothing,
              nothing + 9.81)  # fmt: skip
    at = np.arange(0.0, duration_s - 0.01, 0.1)
    east, north = (np.interp(at, fine, way) + noise.normal(0.0, 0.003, at.size) for way in (x, y))
    poses = [
        f"{START_US / 1e6 + time:.9f} {255855.0 + e:.9f} {5242729.0 + n:.9f} 643.600000000 0 0 0 1"
        for time, e, n in zip(at.tolist(), east.tolist(), north.tolist(), strict=True)
    ]
    (folder / "gt.txt").write_text("\n".join([*poses, ""]))
    return folder
