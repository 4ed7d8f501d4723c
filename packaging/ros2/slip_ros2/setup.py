"""Package of ROS 2 that adds `ros2 slip`; colcon builds it."""

from setuptools import setup

NAME = "slip_ros2"

setup(
    name=NAME,
    version="1.0.0",
    description="ros2 slip: slip of ground vehicles from recordings",
    license="MIT",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/watch.launch.py"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    entry_points={"ros2cli.command": ["slip = slip_ros2.command:SlipCommand"]},
)
