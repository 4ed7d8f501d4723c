"""Vehicles and configuration: presets, `run.toml` and `fleet.toml`, their merging, and the choice of topics.

A vehicle is geometry and limits. A configuration adds what the log does not contain. Anything else is chosen
by type and name, with a reason that is printed.
"""

from typing import TYPE_CHECKING

from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.sources.candidates import *
    from pipeline.sources.configuration import *
    from pipeline.sources.kinematics import *
    from pipeline.sources.layers import *
    from pipeline.sources.message_types import *
    from pipeline.sources.one_vehicle import *
    from pipeline.sources.recognition import *
    from pipeline.sources.topics import *
else:
    __getattr__ = open_door(
        __name__,
        {
            "candidates": (
                "COMMANDED",
                "CONFIGURED",
                "DEAD_RECKONED",
                "FILTERED",
                "MEASURED",
                "DriveForm",
                "DriveSource",
                "PoseContent",
                "PoseSource",
                "Signal",
                "Sources",
                "is_localization",
            ),
            "configuration": (
                "AS_RECORDED",
                "LENGTH_UNITS",
                "RADII_M",
                "RANGES",
                "UNKNOWN_VEHICLE",
                "Configuration",
                "ConfigurationError",
                "DriveSection",
                "IntervalSection",
                "OutageSection",
                "TruthSection",
                "OwnUnit",
                "PoseSection",
                "StandIn",
                "Vehicle",
                "VehicleSection",
                "VelocitySection",
                "check_geometry",
                "convert_unit",
                "find_preset",
                "list_factors",
                "list_presets",
                "list_ranges",
                "resolve_vehicle",
            ),
            "kinematics": ("list_kinds",),
            "layers": (
                "FLEET_FILE",
                "RUN_FILE",
                "Fault",
                "convert",
                "convert_to",
                "is_model",
                "match_globs",
                "list_configuration_files",
                "explain_unread",
                "load_configuration",
                "merge",
            ),
            "message_types": (
                "MessageType",
                "PoseFields",
                "describe_types",
                "find_type",
                "plain_type",
                "read_tables",
            ),
            "one_vehicle": (
                "Owner",
                "agree_on_vehicle",
                "load_vehicle",
            ),
            "recognition": (
                "Controller",
                "Description",
                "Recognized",
                "VehicleSource",
                "apply_parameters",
                "find_alike_vehicles",
                "list_contradictions",
                "list_metadata",
                "make_vehicle",
                "read_description",
                "read_frames",
                "read_parameters",
                "recognize_vehicle",
            ),
            "topics": (
                "DEFAULT_INTERVAL",
                "STRING_TYPE",
                "choose_sources",
                "find_pose_fields",
                "find_robots",
                "list_named",
            ),
        },
    )
