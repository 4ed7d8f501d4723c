"""Logs with known physics: for teaching, and for judging the estimators.

A `Scenario` says everything about a run; `simulate_run` drives it and `write_log` records it. The
physics is written here a second time, independently: nothing is shared with the models that are fitted.
"""

from pipeline.simulate.cases import (
    Case,
    find_case,
    list_cases,
    list_effects,
    make_scenario,
    simulate_case,
    write_log,
    write_samples,
)
from pipeline.simulate.drivetrain import Drive
from pipeline.simulate.facts import (
    LAYOUTS,
    VEHICLES,
    CommandTopic,
    Layout,
    PoseTopic,
    SimulateError,
    Vehicle,
    WheelTopic,
    find_vehicle,
)
from pipeline.simulate.messages import SimulatedRun, simulate_run
from pipeline.simulate.mujoco_vehicle import MACHINES, SkidSteer, simulate_skid_steer
from pipeline.simulate.platforms import PLATFORMS, Platform
from pipeline.simulate.scenario import (
    INCIDENTS,
    TRACTION,
    Clock,
    Disturbance,
    Encoders,
    Ground,
    Imu,
    Incident,
    IncidentKind,
    PoseSensor,
    Program,
    Recording,
    Scenario,
    State,
)
