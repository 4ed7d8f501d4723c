"""Watch a recording while it is written: `ros2 launch slip_ros2 watch.launch.py folder:=bags`."""

from __future__ import annotations

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration

ARGUMENTS = {
    "folder": (None, "folder that the recorder writes to, or one MCAP file"),
    "results": ("results", "folder of results"),
    "vehicle": ("", "preset of the vehicle; empty for the robot description of the recording"),
    "quiet_s": ("30", "seconds without new data after which the watch ends"),
}
"""Arguments of the launch file, by name: default and description."""


def start_watch(context: LaunchContext) -> list[ExecuteProcess]:
    """The process that watches, with the options that are not empty."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    command = ["slip", "watch", given["folder"], "--results", given["results"]]
    options = {"--for": given["quiet_s"], "--vehicle": given["vehicle"]}
    for option, value in options.items():
        command += [option, value] if value else []
    return [ExecuteProcess(cmd=command, name="slip_watch", output="screen")]


def generate_launch_description() -> LaunchDescription:
    """What `ros2 launch` calls."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start_watch)])
