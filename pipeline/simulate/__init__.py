"""Logs with known physics: for teaching, and for judging the estimators.

A `Scenario` says everything about a run; `simulate_run` drives it and `write_log` records it. The
physics is written here a second time, independently: nothing is shared with the models that are fitted.
"""

from pipeline.simulate.case_table import Case
from pipeline.simulate.cases import (
    find_case,
    list_cases,
    list_effects,
    make_scenario,
    simulate_case,
    write_samples,
)
from pipeline.simulate.drivetrain import Drive
from pipeline.simulate.errors import SimulateError
from pipeline.simulate.layouts import LAYOUTS, CommandTopic, Layout, PoseTopic, WheelTopic
from pipeline.simulate.mujoco_vehicle import MACHINES, SkidSteer, simulate_skid_steer
from pipeline.simulate.platforms import PLATFORMS, Platform
from pipeline.simulate.record import write_log
from pipeline.simulate.run import SimulatedRun, simulate_run
from pipeline.simulate.scenario import (
    Clock,
    Disturbance,
    Encoders,
    Ground,
    Imu,
    PoseSensor,
    Program,
    Recording,
    Scenario,
    State,
)
from pipeline.simulate.vehicles import VEHICLES, Vehicle, find_vehicle
