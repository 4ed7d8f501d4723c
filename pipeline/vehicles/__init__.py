"""Vehicles and configuration: presets, `run.toml` and `fleet.toml`, and the choice of topics.

A vehicle is geometry and limits. A configuration says what the log cannot say itself. What neither says is
chosen by type and name, with a reason that is printed.
"""

from pipeline.vehicles.configuration import Configuration, DriveSection
from pipeline.vehicles.errors import ConfigurationError
from pipeline.vehicles.loading import list_configuration_files, load_configuration
from pipeline.vehicles.presets import Vehicle, find_preset, list_presets, resolve_vehicle
from pipeline.vehicles.sources import DriveForm, DriveSource, PoseSource, Signal, Sources, TopicSource
from pipeline.vehicles.topics import DEFAULT_INTERVAL, choose_sources
from pipeline.vehicles.units import convert_unit

__all__ = [
    "DEFAULT_INTERVAL",
    "Configuration",
    "ConfigurationError",
    "DriveForm",
    "DriveSection",
    "DriveSource",
    "PoseSource",
    "Signal",
    "Sources",
    "TopicSource",
    "Vehicle",
    "choose_sources",
    "convert_unit",
    "find_preset",
    "list_configuration_files",
    "list_presets",
    "load_configuration",
    "resolve_vehicle",
]
